"""How large an effect must be to be visible in a bench: from the bench alone, by somebody who knows what is hidden.

    python -m validation oracle --bench mujoco --write
    python -m validation oracle --bench measured --reported --sets 4 --seed 1

The oracle knows the effect's trace: the same set without noise, with and without the effect. Its matched filter,

    a = d' S^-1 r / d' S^-1 d        S = diag(sigma^2) + Z V Z'

gives 1 where the effect is there in its size; r: residuals of both balances of all joints and runs in bins of 10 ms; Z: one
zero, Coulomb and viscous friction of each run's own; sigma, V: from sets with nothing hidden, with what the joint files
leave in runs that they were not fitted to. The scatter of a over those sets, times the size, times `SEEN`, is the smallest
visible size; not less than what moves a balance by `RELEVANT` of rated torque rms, since nobody asks for less. Nothing of
the diagnosis is in it: a better diagnosis does not get smaller effects to find, nor a worse one larger ones. What an effect
can be confused with is not in it either.

--reported: from which size the diagnosis would report each effect on runs in which nothing is hidden, beside the unexplained
residual that these runs have. Of each effect the smallest size of the sets' findings (`minimum` of `candidates` in
findings.json) as its leading parameter.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Mapping
from typing import Final

import numpy as np

from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings
from validation.diagnosis.benches import FILE, bench_option, key, made, sizes
from validation.diagnosis.entries import ENTRIES, Array, Bench, Columns, Hidden, Joint, Set
from validation.diagnosis.recorder import PRESETS
from validation.diagnosis.scores import judged
from validation.study import Report, Table

SEEN: Final = 4.2
"""Standard deviations: sqrt(10 + log n) for n of a few thousand independent bins, the usual threshold of BIC."""
RELEVANT: Final = 0.002
"""Of rated torque, rms over all runs in the balance that shows most: three times it is little more than half a percent."""
BIN: Final = 10
SLOW_RAD_S: Final = 0.03
NEAR: Final = 3
_BLOCK: Final = 100
_SEED0: Final = 700_000  # of the sets that the sizes come from; campaigns draw elsewhere
Balance = tuple[Array, Array]
"""Residual [m] in bins and what each run has of its own [m, k]."""


def residuals(run: Columns, joints: Mapping[int, Joint]) -> list[Balance]:
    """Return motor and torsion balance of each joint of one run, NaN where friction has no direction."""
    out: list[Balance] = []
    for number, joint in joints.items():
        name = f"j{number}"
        gear, friction = float(joint["gear_ratio"]), joint["friction"]
        v = run[f"{name}.motor_velocity_rad_s"] / gear
        torque = run[f"{name}.torque_nm"]
        step = float(np.median(np.diff(run["time_s"])))
        link_velocity = run.get(f"{name}.link_velocity_rad_s", v)
        link_nm = joint["link_inertia_kgm2"] * np.gradient(link_velocity, step)
        direction = np.where(np.abs(v) > SLOW_RAD_S, np.sign(v), np.nan)
        motor = gear * (
            joint["torque_constant_nm_per_a"] * run[f"{name}.current_a"]
            - joint["rotor_inertia_kgm2"] * np.gradient(v * gear, step)
        )
        motor = (
            motor
            - friction["coulomb_nm"] * direction
            - friction["viscous_nms_per_rad"] * v
            - torque
            - link_nm
        )
        own = np.column_stack((np.ones_like(v), direction, v))
        out.append((_binned(motor) + _near_reversals(_binned(direction)), _binned(own)))
        if f"{name}.link_position_rad" in run:
            twist = run[f"{name}.motor_position_rad"] / gear - run[f"{name}.link_position_rad"]
            torsion = joint["stiffness_nm_per_rad"] * twist + joint["damping_nms_per_rad"] * (
                v - link_velocity
            )
            out.append((_binned(torsion - torque - link_nm), _binned(np.ones((len(v), 1)))))
    return out


def _near_reversals(direction: Array) -> Array:
    """Return NaN within `NEAR` bins of one without a direction, else 0: drive filters and stiction are seen there."""
    without = np.convolve(~np.isfinite(direction), np.ones(2 * NEAR + 1), "same") > 0.5
    return np.where(without, np.nan, 0.0)


def _binned(x: Array) -> Array:
    m = len(x) // BIN
    means: Array = x[: m * BIN].reshape(m, BIN, *x.shape[1:]).mean(axis=1)
    return means


class Oracle:
    """The oracle of one bench, trained on `count` sets with nothing hidden."""

    def __init__(self, bench: Bench, count: int = 6) -> None:
        self.bench = bench
        self.seeds = [_SEED0 + k for k in range(count)]
        self.quiet = [bench.draw(seed, quiet=True) for seed in self.seeds]
        unseen = bench.unseen()
        noisy = [unseen.draw(seed) for seed in self.seeds]
        self.scales = [_scale(s.joints) for s in noisy]
        self.base = [self._balances(q) for q in self.quiet]
        self.left = [self._balances(s) for s in noisy]
        self._learn()

    def _balances(self, drawn: Set) -> list[list[Balance]]:
        return [residuals(run, drawn.joints) for run in drawn.runs]

    def _learn(self) -> None:
        """sigma and V per kind of balance (0 motor, 1 torsion), relative to rated torque."""
        rows: dict[int, list[Array]] = {}
        noise: dict[int, list[Array]] = {}
        for scale, runs in zip(self.scales, self.left, strict=True):
            for run in runs:
                for r, z in run:
                    k = z.shape[1]
                    there = np.isfinite(r) & np.isfinite(z).all(axis=1)
                    if there.sum() < 50:
                        continue
                    c, *_ = np.linalg.lstsq(z[there], r[there] / scale, rcond=1e-6)
                    rows.setdefault(k, []).append(c)
                    noise.setdefault(k, []).append(r[there] / scale - z[there] @ c)
        self.sigma = {k: float(np.sqrt(np.mean([_long(e) for e in x]))) for k, x in noise.items()}
        # the median: in a run at one speed zero, Coulomb and viscous friction are one, and their fits are anything
        self.own = {k: np.diag(np.median(np.square(x), axis=0) / 0.455) for k, x in rows.items()}

    def visible(self, name: str, variant: str = "") -> float:
        """Return the smallest visible relative size of an effect; inf where its trace is nothing."""
        amplitudes, traces = [], []
        start = ENTRIES[name].bench.start
        for k, seed in enumerate(self.seeds):
            places = self.bench.places(name)
            hidden = Hidden(name, places[k % len(places)], start, variant)
            there = self._balances(self.bench.draw(seed, [hidden], quiet=True))
            top = bottom = 0.0
            squares: dict[int, list[Array]] = {}
            for run, zero, left in zip(there, self.base[k], self.left[k], strict=True):
                for which, ((r1, z), (r0, _), (r, _)) in enumerate(zip(run, zero, left, strict=True)):
                    usable = np.isfinite(r1) & np.isfinite(r0) & np.isfinite(r) & np.isfinite(z).all(axis=1)
                    d = (r1 - r0)[usable] / self.scales[k]
                    weighted = self._whitened(d, z[usable])
                    top += float(weighted @ r[usable]) / self.scales[k]
                    bottom += float(weighted @ d)
                    squares.setdefault(which, []).append(d * d)
            if bottom <= 0.0:
                return float("inf")
            amplitudes.append(top / bottom)
            traces.append(max(float(np.sqrt(np.mean(np.concatenate(x)))) for x in squares.values()))
        scatter = float(np.sqrt(np.mean(np.square(amplitudes))))
        relevant = RELEVANT / float(np.median(traces))
        return max(SEEN * scatter, relevant) * abs(start)

    def _whitened(self, d: Array, z: Array) -> Array:
        """Return S^-1 d by the matrix inversion lemma."""
        k = z.shape[1]
        variance = self.sigma[k] ** 2
        inner = np.linalg.inv(self.own[k] + 1e-12 * np.eye(k)) + z.T @ z / variance
        x: Array = d / variance - z @ np.linalg.solve(inner, z.T @ d) / variance**2
        return x


def _long(e: Array) -> float:
    """Return the variance per bin of noise [m], as sums over a second have it: noise that is slow counts as it should."""
    blocks = e[: len(e) // _BLOCK * _BLOCK].reshape(-1, _BLOCK).sum(axis=1)
    return max(float(np.mean(blocks**2)) / _BLOCK if len(blocks) else 0.0, float(np.var(e)))


def _scale(joints: Mapping[int, Joint]) -> float:
    return min(float(j["rated_torque_nm"]) for j in joints.values())


def reported_sizes(found: Findings, joints: Mapping[int, Joint]) -> dict[str, float]:
    """Return per effect its smallest size relative to the joint (`entries.OnBench`), of the joint where it is least;
    infinite where no size shows.
    """
    out: dict[str, float] = {}
    for c in found.candidates:
        joint = joints[c.joint if isinstance(c.joint, int) else min(joints)]
        if c.name in ENTRIES:
            out[c.name] = min(out.get(c.name, math.inf), _size(c) / ENTRIES[c.name].bench.unit(joint))
    return out


def _size(c: CandidateEvidence) -> float:
    """Return the size of the parameter that carries the effect, infinite where another one shows it first."""
    found = c.minimum.get(ENTRIES[c.name].bench_parameter)
    return math.inf if found is None else found.value


def options(parser: argparse.ArgumentParser) -> None:
    bench_option(parser)
    parser.add_argument("--sets", type=int, default=6, help="with nothing hidden (default 6)")
    parser.add_argument("--write", action="store_true", help=f"freeze the visible sizes in {FILE.name}")
    parser.add_argument("--reported", action="store_true", help="sizes that the diagnosis would report")
    parser.add_argument("--seed", type=int, default=1, help="of the sets of --reported (default 1)")


def run(options: argparse.Namespace) -> Report:
    """Return the visible sizes and, with --write, freeze them; or those that would be reported."""
    bench = made(options.bench)
    return _reported(bench, options.sets, options.seed) if options.reported else _visible(bench, options)


def _visible(bench: Bench, options: argparse.Namespace) -> Report:
    oracle = Oracle(bench, options.sets)
    found, rows = {}, []
    for name, variant in [(each, v) for each in bench.effects for v in bench.variants(each)]:
        size, largest = oracle.visible(name, variant), ENTRIES[name].bench.largest
        if np.isfinite(size):
            found[key(name, variant)] = float(f"{size:.3g}")
        note = "" if 3.0 * size <= largest else "three times this is out of range: not hidden"
        rows.append((key(name, variant), f"{size:.3g}", f"{largest:g}", note))
    if options.write:
        everything = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
        everything[bench.name] = found
        FILE.write_text(json.dumps(everything, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    table = Table(("effect", "visible from", "largest hidden", "note"), rows, f"bench {bench.name}")
    return Report([table], {"sets from": oracle.seeds[0]}, values=found)


def _reported(bench: Bench, count: int, seed: int) -> Report:
    found: dict[str, list[float]] = defaultdict(list)
    left = []
    for k in range(count):
        drawn = bench.draw(1000 * seed + k)
        findings = judged(drawn.runs, drawn.joints, PRESETS["full"], k)
        for name, size in reported_sizes(findings, drawn.joints).items():
            found[name].append(size)
        if findings.unexplained is not None:
            left.append(findings.unexplained.percent_of_rated)
    visible = sizes(bench.name)
    medians = {name: float(np.median(sizes_found)) for name, sizes_found in found.items()}
    rows = []
    for name, size in sorted(medians.items()):
        seen = ", ".join(f"{x:.2g}" for k, x in visible.items() if k.split()[0] == name) or "-"
        text = f"{size:.2g}" if math.isfinite(size) else "-"
        rows.append((name, text, seen, f"{ENTRIES[name].bench.largest:g}"))
    head = ("effect", "smallest size reported", "visible from", "largest hidden")
    note = f"unexplained residual, worst run: median {np.median(left):.2g} % of rated"
    title = f"bench {bench.name}, {count} sets with nothing hidden"
    return Report([Table(head, rows, title)], {"seed": seed}, [note], medians)
