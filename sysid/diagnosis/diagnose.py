"""The diagnosis from run tables and joint files to findings: the order of its steps. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import Effect
from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.events import Prepared, without_events
from jtqd.sysid.diagnosis.evidence import RELEVANT
from jtqd.sysid.diagnosis.extended_joint import fold
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Findings,
    JointName,
)
from jtqd.sysid.diagnosis.leftover import events_left
from jtqd.sysid.diagnosis.mixed_model import Mixed
from jtqd.sysid.diagnosis.next_experiment import next_experiment
from jtqd.sysid.diagnosis.noise import Noise, noise_model, run_sums, saturated_residuals
from jtqd.sysid.diagnosis.powerless import columns_of, readings, with_readings
from jtqd.sysid.diagnosis.refine import present_causes, refine
from jtqd.sysid.diagnosis.regressors import (
    EffectCandidate,
    RunData,
    bin_samples,
    column_moments,
    contribution,
    families,
    gain_columns,
    run_data,
)
from jtqd.sysid.diagnosis.search import HELD_OUT, Hypothesis, Search
from jtqd.sysid.diagnosis.signals import (
    BaseLoss,
    Channel,
    JointSignals,
    Line,
    SignalsError,
    about_zero,
    joint_signals,
    with_one_sensor,
)
from jtqd.sysid.diagnosis.structure import frequency_lines, order_lines, sharpened
from jtqd.sysid.diagnosis.verdict import conclude

# Joints that have a torque sensor each: diagnosed one by one, reported together. Pure.


_WORST_FIRST: Final = (UNEXPLAINED, AMBIGUOUS, CAUSE, INSUFFICIENT, NO_GAP)


def one_sensor(runs: Sequence[tuple[str, RunTable]], numbers: Sequence[int]) -> bool:
    """Return whether the joints' torque columns are the same measurement in every run that has them all."""
    for _, table in runs:
        columns = [table.joints[n].torque_nm for n in numbers if n in table.joints]
        there = [c for c in columns if c is not None]
        for other in there[1:]:
            scale = max(float(np.abs(there[0]).max()), 1e-9)
            if float(np.abs(there[0] - other).max()) > 1e-6 * scale:
                return False
    return True


def together(parts: Sequence[Findings]) -> Findings:
    """Return the findings of several joints as one: the verdict that asks for most, the gain of the largest cause."""
    verdict = min((f.verdict for f in parts), key=_WORST_FIRST.index)
    with_gain = [f for f in parts if f.gain is not None]
    leading = max(with_gain, key=lambda f: f.causes[0].rms_nm) if with_gain else None
    plans = [f.next_experiment for f in parts if f.next_experiment is not None]
    return Findings(
        verdict,
        tuple(f"joint {n}: {reason}" for f in parts for n in f.joints[:1] for reason in f.reasons),
        parts[0].runs,
        tuple(n for f in parts for n in f.joints),
        tuple(sorted((g for f in parts for g in f.gaps), key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2)),
        tuple(sorted((c for f in parts for c in f.causes), key=lambda c: -c.rms_nm)),
        tuple(sorted((c for f in parts for c in f.candidates), key=lambda c: -c.delta_bic)),
        None if leading is None else leading.gain,
        channel_notes=tuple(dict.fromkeys(note for f in parts for note in f.channel_notes)),
        next_experiment=plans[0] if plans else None,
        traces=tuple(t for f in parts for t in f.traces),
    )


FEWEST_RUNS: Final = 2
SHORTEST_MOVING_S: Final = 5.0
SLOWEST_HZ: Final = 50.0
SAME_RATE: Final = 0.05
_PASSES: Final = 2
COGGING_ORDERS: Final = np.arange(5.0, 101.0)
"""Per motor revolution, where cogging is looked for."""
ORDER_STEP_S: Final = 0.002
STRONG_LINE: Final = 25.0
_SIDELOBES: Final = 0.25
_LOWEST_ORDER: Final = 0.7
_MOST_LINES: Final = 4


def diagnose(runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint]) -> Findings:
    """Return what the joint files' simulation gets wrong in these runs.

    runs: (name, table); joints: nominal joint per number. Never raises for what is in the tables: data that cannot
    serve give the verdict insufficient_data with its reasons. Joints with a sensor each are diagnosed one by one. Where a
    cause has the name of an effect that a file already has, the diagnosis is made again without that effect, so that what
    is reported is the whole of it.
    """
    numbers = tuple(sorted(n for n in joints if any(n in table.joints for _, table in runs)))
    if len(numbers) > 1 and not one_sensor(runs, numbers):
        return together([diagnose(runs, {n: joints[n]}) for n in numbers])
    folded = {n: fold(joint) for n, joint in joints.items()}
    findings = _diagnosed(runs, folded, numbers)
    for n in numbers:
        new = {c.name for c in findings.causes if c.joint in (n, "sensor")}
        kept = tuple(e for e in folded[n].effects if e.name not in new)
        if len(kept) < len(folded[n].effects):
            folded[n] = replace(folded[n], effects=kept)
    if any(len(fold(joints[n]).effects) > len(folded[n].effects) for n in numbers):
        whole = _diagnosed(runs, folded, numbers)
        findings = replace(whole, gaps=findings.gaps)
    return findings


def _diagnosed(
    runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint], numbers: tuple[int, ...]
) -> Findings:
    names = tuple(name for name, _ in runs)
    usable, reasons = _usable(runs, joints, numbers)
    if not usable:
        there = {n: joints[n] for n in numbers}
        plan = next_experiment([], there, "; ".join(reasons)) if there else None
        return Findings(INSUFFICIENT, tuple(reasons), names, numbers, next_experiment=plan)
    prepared = _prepared(usable, joints)
    least = RELEVANT * max(joints[n].rated_torque_nm for n in numbers)
    noise, search, best = _searched(prepared, least)
    refined = refine(prepared, present_causes(best), noise)
    found = events_left(prepared, refined, noise, joints)
    if found:  # no effect makes them: they shall bend none
        prepared = without_events(prepared, found)
        noise, search, best = _searched(prepared, least)
        refined = refine(prepared, present_causes(best), noise)
    findings = conclude(prepared, search, best, refined, noise, joints, names, numbers)
    return replace(findings, channel_notes=tuple(reasons))


def _usable(
    runs: Sequence[tuple[str, RunTable]], joints: Mapping[int, Joint], numbers: Sequence[int]
) -> tuple[list[list[JointSignals]], list[str]]:
    """Return the signals of the runs that can serve, none if too few do, and why others cannot."""
    if not numbers:
        return [], ["found no joint that both the runs and the joint files have"]
    out: list[list[JointSignals]] = []
    trouble: list[str] = []
    bases = {n: BaseLoss(joints[n]) for n in numbers}
    rates = [1.0 / float(np.median(np.diff(table.time_s))) for _, table in runs]
    usual = float(np.median(rates))
    for (name, table), rate in zip(runs, rates, strict=True):
        if rate < SLOWEST_HZ:
            trouble.append(f"{name}: found {rate:.3g} samples per second, expected at least {SLOWEST_HZ:.0f}")
            continue
        if abs(rate / usual - 1.0) > SAME_RATE:  # bins of another length have another noise
            trouble.append(
                f"{name}: found {rate:.0f} samples per second, expected {usual:.0f} as in the others"
            )
            continue
        mine = []
        for n in numbers:
            if n not in table.joints:
                continue
            try:
                mine.append(joint_signals(name, table, n, joints[n], bases[n]))
            except SignalsError as error:
                trouble.append(str(error))
        if mine:
            out.append([_less_known(s) for s in about_zero(mine, bases)])
    common = {tuple(s.number for s in run) for run in out}
    if len(common) > 1:  # only what every run has can be stacked
        keep = set.intersection(*(set(c) for c in common))
        out = [[s for s in run if s.number in keep] for run in out]
        out = [run for run in out if run]
    _same_balances(out)
    out = [with_one_sensor(run) for run in out]
    if not out:
        return [], trouble or ["found no run that can serve"]
    if len(out) < FEWEST_RUNS:
        return [], [
            *trouble,
            f"found {len(out)} run that can serve, expected at least {FEWEST_RUNS}: a gain is measured on runs left out",
        ]
    moving = sum(float(s.moving.sum()) * float(np.median(np.diff(s.time_s))) for run in out for s in run)
    if moving < SHORTEST_MOVING_S:
        return [], [
            *trouble,
            f"found {moving:.1f} s in motion in all runs, expected at least {SHORTEST_MOVING_S:.0f} s",
        ]
    return out, trouble


def _same_balances(runs: list[list[JointSignals]]) -> None:
    """Leave out the torsion balance of a joint that not every run has: what is stacked must be there in all."""
    lacking = {s.number for run in runs for s in run if s.torsion_nm is None}
    for run in runs:
        run[:] = [replace(s, torsion_nm=None, twist_rad=None) if s.number in lacking else s for s in run]


def _less_known(s: JointSignals) -> JointSignals:
    """Return the signals less what the joint file's own effects explain, at the torsion that the encoders saw."""
    motor, torsion, usual = s.motor_nm, s.torsion_nm, s.state.torsion_rad
    if s.twist_rad is not None:
        s.state.torsion_rad = s.twist_rad
    for item in s.joint.effects:
        found = contribution(EFFECTS[item.name], item.parameters, s)
        motor = motor - found.get("motor", 0.0)
        if torsion is not None and "torsion" in found:
            torsion = torsion - found["torsion"]
    s.state.torsion_rad = usual
    return replace(s, motor_nm=motor, torsion_nm=torsion)


def _prepared(signals: list[list[JointSignals]], joints: Mapping[int, Joint]) -> Prepared:
    samples = bin_samples(s for run in signals for s in run)
    step = samples * float(np.median(np.diff(signals[0][0].time_s)))
    candidates = library_candidates(signals, joints)
    candidates += _found_orders(signals, joints, candidates)
    lines = strange_lines(signals, candidates, samples, step)
    groups = families([s.number for s in signals[0]], lines)
    runs = [run_data(run, candidates, samples, groups) for run in signals]
    leave = gain_columns(candidates)
    unexplained = {c: saturated_residuals(runs, c, leave) for c in runs[0].channels}
    return Prepared(signals, runs, candidates, samples, step, unexplained, groups, lines, readings(signals))


def library_candidates(
    signals: Sequence[Sequence[JointSignals]], joints: Mapping[int, Joint]
) -> list[EffectCandidate]:
    """Return every term of every effect that these runs have the channels for, columns numbered."""
    out: list[EffectCandidate] = []
    first = 0
    numbers = [s.number for s in signals[0]]
    for effect in EFFECTS.values():
        for n in numbers:
            for term in effect.terms(joints[n]):
                at_sensor = effect.at_sensor_of(term.basis[0])
                if at_sensor and n != numbers[0]:
                    continue
                where: JointName = "sensor" if at_sensor else n
                if not _seen(effect, signals, n):
                    continue
                shown = [contribution(effect, term.basis[0], s) for s in signals[0] if s.number == n]
                size = max((float(np.abs(v).max()) for found in shown for v in found.values()), default=0.0)
                if size > 0.0 and np.isfinite(size):
                    out.append(
                        EffectCandidate(effect, where, term, first, effect.largest(joints[n], term.basis[-1]))
                    )
                    first += len(term.basis)
    return out


def _seen(effect: Effect, signals: Sequence[Sequence[JointSignals]], number: int) -> bool:
    """Return whether the runs have what the effect needs."""
    for run in signals:
        for s in run:
            if s.number == number:
                for name in effect.needs:
                    if not np.isfinite(np.asarray(getattr(s.state, name), np.float64)).any():
                        return False
    return True


def _found_orders(
    signals: Sequence[Sequence[JointSignals]],
    joints: Mapping[int, Joint],
    candidates: Sequence[EffectCandidate],
) -> list[EffectCandidate]:
    """Return cogging at integer orders that stand out of the residual's order spectrum."""
    first = candidates[-1].columns.stop if candidates else 0
    out: list[EffectCandidate] = []
    step = float(np.median(np.diff(signals[0][0].time_s)))
    every = max(1, round(ORDER_STEP_S / step))
    step *= every
    bare = [run_data(run, [], every) for run in signals]
    for s in signals[0]:
        channel = Channel(s.number, "motor")
        parts = [np.where(r.channels[channel].valid, r.channels[channel].residual, np.nan) for r in bare]
        there = {
            round(c.term.basis[0]["order_per_motor_rev"])
            for c in candidates
            if c.effect.name == "cogging" and c.joint == s.number
        }
        for line in order_lines(bare, {channel: parts}, step, COGGING_ORDERS)[:4]:
            order = round(line.order)
            if order >= 5 and abs(line.order - order) < 0.06 and order not in there:
                term = EFFECTS["cogging"].term_of_order(float(order))
                if term is None:
                    continue
                out.append(EffectCandidate(EFFECTS["cogging"], s.number, term, first))
                first += len(term.basis)
                there.add(order)
    return out


def strange_lines(
    signals: Sequence[Sequence[JointSignals]],
    candidates: Sequence[EffectCandidate],
    samples: int,
    step_s: float,
) -> list[Line]:
    """Return strong lines of the residuals at orders and frequencies that no candidate has; no sidelobes of others."""
    bare = [run_data(run, [], samples) for run in signals]
    residuals = {c: saturated_residuals(bare, c) for c in bare[0].channels}
    known = {
        (c.joint, float(c.term.basis[0]["order_per_motor_rev"]))
        for c in candidates
        if "order_per_motor_rev" in c.term.basis[0]
    }
    out: list[Line] = []
    for line in order_lines(bare, residuals, step_s):
        stronger = any(
            o.channel == line.channel and o.unit == line.unit and abs(o.order - line.order) < _SIDELOBES
            for o in out
        )
        near = any(j == line.channel.joint and abs(o - line.order) < _SIDELOBES for j, o in known)
        if line.ratio > STRONG_LINE and line.order > _LOWEST_ORDER and not stronger and not near:
            out.append(sharpened(line, bare, residuals[line.channel], step_s))
    out += [line for line in frequency_lines(bare, residuals, step_s) if line.ratio > STRONG_LINE][:1]
    return out[:_MOST_LINES]


def _searched(prepared: Prepared, least_nm: float) -> tuple[Noise, Search, Hypothesis]:
    """Return noise model and best hypothesis: the noise first from what nothing explains, then from what the best
    hypothesis leaves, which is more by what the many columns of the first have fitted of the noise itself.
    """
    runs, candidates = prepared.runs, prepared.candidates
    columns = candidates[-1].columns.stop if candidates else 0
    groups = prepared.groups
    sigma = np.array([g.sigma for g in groups])
    moments = column_moments(runs, columns)
    unpowered = columns_of(candidates, prepared.joints)
    residuals = prepared.unexplained
    for k in range(_PASSES):
        noise = noise_model(runs, residuals, prepared.step_s)
        sums = [run_sums(run, noise, columns, len(groups)) for run in runs]
        sums = with_readings(sums, prepared.readings, unpowered)
        mixed = Mixed(sums, columns, sigma)
        effective = mixed.rows / noise.inflation
        search = Search(mixed, candidates, effective, moments, least_nm, prepared.readings, unpowered)
        best = _held(search, search.run())
        if k + 1 < _PASSES:
            residuals = {c: left_over(runs, best, c) for c in residuals}
    return noise, search, best


def _held(search: Search, best: Hypothesis) -> Hypothesis:
    """Return the hypothesis without candidates that do not help on runs left out."""
    while best.chosen:
        weak = []
        for c in best.chosen:
            without = search.hypothesis([o for o in best.chosen if o is not c], best.model)
            evidence = without.model.deviance - best.model.deviance
            if search.held_out(best, c) < HELD_OUT * evidence:
                weak.append((evidence, c))
        if not weak:
            return best
        weakest = min(weak, key=lambda pair: pair[0])[1]
        best = search.hypothesis([c for c in best.chosen if c is not weakest], best.model)
    return best


def left_over(runs: Sequence[RunData], best: Hypothesis, channel: Channel) -> list[FloatArray]:
    """Return the residual less the chosen effects and each run's own changes [n], NaN where not valid."""
    out = []
    columns = {c: float(b) for c, b in zip(best.model.columns, best.model.beta, strict=True)}
    for run, u in zip(runs, best.model.nuisances, strict=True):
        if channel not in run.channels:
            continue
        d = run.channels[channel]
        weights = np.array([columns.get(int(k), 0.0) for k in d.index])
        rest = d.residual - d.regressors @ weights - d.nuisances @ u[d.families]
        out.append(np.where(d.valid, rest, np.nan))
    return out
