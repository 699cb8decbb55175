"""From an order to run tables: what is hidden goes into the plant, all runs are integrated side by side and measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from validation.hidden.integrator import Truth, integrate
from validation.hidden.measure import measured
from validation.hidden.menu import MENU, SENSOR, deviation, parameters
from validation.hidden.nominal import Drift, draw_drift, draw_joint
from validation.hidden.order import Hidden, Order
from validation.hidden.plant import Array, Plant
from validation.hidden.profiles import STEP_S, Reference, draw_motion, driven_motion, kinds
from validation.hidden.strange import Strange
from validation.hidden.unknown import Oddity, draw_unknown

_JOINTS, _MOTIONS, _DRIFT, _NOISE, _EFFECTS = range(
    5
)  # streams of one seed: each effect of it leaves the others alone
_LATER: Final = 10**6  # stream of further runs


class Bench:
    """One case while it is made: joints, motions, drift, what is hidden, tables as they come."""

    def __init__(self, order: Order, references: Sequence[Reference] = ()) -> None:
        self.order = order
        rng = self.stream(_JOINTS)
        self.joints = (draw_joint(rng, 1), draw_joint(rng, 2))
        rng = self.stream(_MOTIONS)
        chosen = kinds(rng, order.profile, order.runs)
        self.motions = [
            draw_motion(rng, kind, self.joints, k, order.runs, order.duration_s)
            for k, kind in enumerate(chosen)
        ]
        later = (_LATER,) if references else ()
        rng = self.stream(_DRIFT, *later)
        drifts = max(order.runs, len(references))
        self.drifts = [draw_drift(rng) for _ in range(drifts)]
        if order.quiet:
            self.drifts = [Drift(np.ones(2), 0.0, np.zeros(2)) for _ in range(drifts)]
        self._noise = (_NOISE, *later)
        self.oddities: list[tuple[int, Oddity, dict[str, Any]]] = []
        self.truth = [self._truth(k, item) for k, item in enumerate(order.effects)]
        if references:
            rng = self.stream(_MOTIONS, _LATER)
            longest = max(len(r.velocity_rad_s) for r in references)
            self.motions = [
                driven_motion(rng, r, k, len(references), longest) for k, r in enumerate(references)
            ]
        self.tables: list[dict[str, Array] | None] = [None] * len(self.motions)

    def noise(self, run: int) -> np.random.Generator:
        """Return the generator of one run's noise."""
        return self.stream(*self._noise, run)

    def stream(self, *key: int) -> np.random.Generator:
        """Return a generator of its own for this part of the case."""
        return np.random.default_rng([self.order.seed, *key])

    def _truth(self, k: int, item: Hidden | tuple[Any, ...]) -> dict[str, Any]:
        hidden = item if isinstance(item, Hidden) else Hidden(*item)
        row = 0 if hidden.joint == SENSOR else int(hidden.joint) - 1
        nominal = self.joints[row]
        if hidden.name not in MENU:
            return self._unknown(k, hidden, row)
        values = parameters(hidden.name, nominal, hidden.size, self.stream(_EFFECTS, k), hidden.fixed)
        at_sensor = MENU[hidden.name].at_sensor or (
            hidden.name == "channel_delay" and values["channel"] == 0.0
        )
        return {
            "name": hidden.name,
            "joint": SENSOR if at_sensor else row + 1,
            "parameters": values,
            "size": deviation(hidden.name, nominal, values),
        }

    def _unknown(self, k: int, hidden: Hidden, row: int) -> dict[str, Any]:
        size = None if hidden.size is None else float(hidden.size)  # type: ignore[arg-type]
        stream = self.stream(_EFFECTS, k)
        oddity, chosen = draw_unknown(hidden.name, stream, self.joints[row], self.motions, row, size)
        entry = {
            "name": hidden.name,
            "joint": SENSOR if oddity.faults else row + 1,
            "parameters": dict(oddity.numbers),
            "size": chosen,
            "places": list(oddity.places),
        }
        self.oddities.append((row, oddity, entry))
        return entry


def integrate_together(flat: list[tuple[Bench, int]]) -> None:
    """Integrate these runs side by side and put each table into its set."""
    pairs = [one.joints for one, _ in flat]
    nominal = Plant(pairs, np.ones((2, len(flat))))
    plant = Plant(pairs, np.stack([one.drifts[k].viscous for one, k in flat], axis=1))
    strange = Strange(len(flat))
    for b, (one, k) in enumerate(flat):
        for item in one.truth:
            if item["name"] in MENU:
                row = 0 if item["joint"] == SENSOR else item["joint"] - 1
                plant.hide(item["name"], row, b, item["parameters"])
        for row, oddity, entry in one.oddities:
            _add(oddity, entry, row, b, k, plant, strange)
    truth = integrate(plant, nominal, [one.motions[k] for one, k in flat], strange)
    _add_slips(flat, strange)
    _add_dead_times(flat, truth)
    for b, (one, k) in enumerate(flat):
        stream = one.noise(k)
        faults = strange.faults.get(b, [])
        one.tables[k] = measured(
            truth, plant, b, one.motions[k], one.drifts[k], stream, one.order.quiet, faults
        )


def _add(  # noqa: PLR0917
    oddity: Oddity, entry: dict[str, Any], row: int, b: int, k: int, plant: Plant, strange: Strange
) -> None:
    """Put what run k of a case has of an oddity into bench b of the batch."""
    for name, value in oddity.numbers.items():
        strange.numbers[name][row, b] = value
    if oddity.wave is not None:
        amplitude, order, phase = oddity.wave
        plant.waves.append((row, b, amplitude, order, phase))
    if oddity.phases:
        strange.numbers["vibration_rad"][row, b] = oddity.phases[k]
    if oddity.waits:
        strange.waits[row, b] = list(oddity.waits[k])
    if oddity.faults:
        strange.faults[b] = oddity.faults[k]
        entry["places"] += [_moment(k, f.start, f.start + f.count) for f in oddity.faults[k]]
    if oddity.bursts:
        strange.bursts += [(row, b, *burst) for burst in oddity.bursts[k]]
        entry["places"] += [_moment(k, first, last) for first, last, _ in oddity.bursts[k]]


def _add_slips(flat: list[tuple[Bench, int]], strange: Strange) -> None:
    """Say where slips show: at their moments, and while the torsion stands far from its mean over the run."""
    for row, b in sorted({(row, b) for row, b, *_ in strange.slips}):
        one, k = flat[b]
        entry = next(e for r, o, e in one.oddities if r == row and o.waits)
        cycles, jumps = zip(
            *[(c, jump) for r, i, c, jump in strange.slips if (r, i) == (row, b)], strict=True
        )
        edges = [0, *cycles, len(one.motions[k].on)]
        level = np.concatenate(([0.0], np.cumsum(jumps)))
        away = np.abs(level - np.average(level, weights=np.diff(edges)))
        entry["places"] += [_moment(k, c, c) for c in cycles]
        entry["places"] += [
            _moment(k, edges[i], edges[i + 1]) for i in range(len(level)) if away[i] > 0.5 * away.max()
        ]


def _add_dead_times(flat: list[tuple[Bench, int]], truth: Truth) -> None:
    """Say when the current of a joint in motion was within its dead band."""
    for b, (one, k) in enumerate(flat):
        for row, oddity, entry in one.oddities:
            if "dead_band_a" not in oddity.numbers:
                continue
            small = np.abs(truth.current_a[:, row, b]) < oddity.numbers["dead_band_a"]
            moving = np.abs(truth.motor_rad_s[:, row, b]) > 0.03 * one.joints[row]["gear_ratio"]
            edges = np.flatnonzero(np.diff((small & moving).astype(int), prepend=0, append=0))
            spans = edges.reshape(-1, 2)
            entry["places"] += [_moment(k, int(a), int(z)) for a, z in spans if z - a > 20]


def _moment(k: int, first: int, last: int) -> dict[str, Any]:
    """Return a place on the time axis of run k."""
    return {"axis": "time", "run": f"run{k + 1}", "low": first * STEP_S, "high": last * STEP_S}
