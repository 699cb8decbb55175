"""Offset of the current sensor while the power stage is off or the joint rests: an additional row of the regression.

While a joint turns, an offset of the current and an asymmetric friction are the same torque in every sample. With the power
stage off no current flows, whatever friction does: what is read then is the current sensor's own error, which only effects
of the current measurement (hook `current_a`) explain. So each run that has such a rest (column `jN.enabled`) adds one row
per joint to its normal equations,

    reading / sigma = sum over effects of current_a(effect, no current) / sigma + noise of unit variance

and an effect that would need another reading pays for it like for any other misfit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect, ScalarFunctions, State, Values
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.findings import JointName
from jtqd.sysid.diagnosis.noise import Sums
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.signals import JointSignals

SETTLED_S: Final = 0.1
"""After the stage went off: the current dies away, and what it twisted springs back. Left out at the other end too."""
SHORTEST_S: Final = 0.3
"""Of what is left of a rest without power: less is no reading."""
DRIFT: Final = 5e-4
"""Of the rated torque over G Kt: what the zero of a current sensor may change by between the reading and the motion, half of
what is called an effect at all (`evidence.RELEVANT`). All readings of a joint together are no more certain than this.
"""
_BLOCK_S: Final = 0.1


@dataclass(frozen=True)
class Reading:
    """What the current of a joint reads without power in one run [A], less what the joint file knows of it; noise_a: its
    standard deviation by noise alone; drift_a: what all readings of the joint may have in common beside the motion;
    seconds: of all rests together.
    """

    joint: Joint
    current_a: float
    noise_a: float
    drift_a: float
    seconds: float


Readings = Mapping[int, Reading]
"""One run's, by the number of the joint."""


def reading(s: JointSignals) -> Reading | None:
    """Return the reading of one joint in one run, None without a rest without power that is long enough."""
    if s.off is None or not s.off.any():
        return None
    step = float(np.median(np.diff(s.time_s)))
    edge, least = round(SETTLED_S / step), round(SHORTEST_S / step)
    block = max(1, round(_BLOCK_S / step))
    bounds = np.flatnonzero(np.diff(np.concatenate(([0], s.off.astype(np.int8), [0]))))
    means: list[float] = []
    samples = 0
    for first, last in zip(bounds[::2] + edge, bounds[1::2] - edge, strict=True):
        if last - first >= least:
            many = (last - first) // block
            means += s.current_a[first : first + many * block].reshape(many, block).mean(axis=1).tolist()
            samples += last - first
    if not means:
        return None
    noise = float(np.std(means, ddof=1)) / np.sqrt(len(means)) if len(means) > 1 else 0.0
    known = sum(unpowered(EFFECTS[e.name], e.parameters, s.joint) for e in s.joint.effects)
    rated_a = s.joint.rated_torque_nm / (s.joint.gear_ratio * s.joint.torque_constant_nm_per_a)
    return Reading(s.joint, float(np.mean(means)) - known, float(noise), DRIFT * rated_a, samples * step)


def readings(signals: Sequence[Sequence[JointSignals]]) -> list[Readings]:
    """Return the readings of every run."""
    out: list[Readings] = []
    for run in signals:
        found = {s.number: reading(s) for s in run}
        out.append({n: r for n, r in found.items() if r is not None})
    return out


def unpowered(effect: Effect, p: Values, joint: Joint) -> float:
    """Return what the effect makes the current of a joint read without current and at rest [A]."""
    if "current_a" not in effect.hooks:
        return 0.0
    rest = State(**dict.fromkeys(State.__slots__, 0.0))
    return float(effect.current_a(p, rest, joint, ScalarFunctions()))


def with_readings(
    sums: Sequence[Sums], found: Sequence[Readings], rows: Iterable[UnpoweredColumn]
) -> list[Sums]:
    """Return the runs' normal equations with a row for every reading; rows: what the columns read (`unpowered_columns`,
    or of refined parameters), in the order of the columns. Runs without a reading are returned as they are.
    """
    if not any(found):
        return list(sums)
    rows = list(rows)
    counts: dict[int, int] = {}
    for run in found:
        for number in run:
            counts[number] = counts.get(number, 0) + 1
    out = []
    for one, run in zip(sums, found, strict=True):
        gram = one.gram
        for number, r in run.items():
            row = np.zeros(len(gram))
            for where, column, of in rows:
                if where == number:
                    row[column] += of
            row[-1] += r.current_a
            # the drift is common to all readings of the joint: however many there are, it stays
            row /= np.hypot(r.noise_a, r.drift_a * np.sqrt(counts[number]))
            gram = gram + np.outer(row, row)
        out.append(Sums(gram, one.rows + len(run)) if run else one)
    return out


UnpoweredColumn = tuple[JointName, int, float]
"""Joint, column (-1: the residual), what it reads without power [A]."""


def unpowered_columns(
    candidates: Sequence[EffectCandidate], joints: Mapping[int, Joint]
) -> list[UnpoweredColumn]:
    """Return what the search's columns read without power, those that read something."""
    out: list[UnpoweredColumn] = []
    for c in candidates:
        if "current_a" in c.effect.hooks and isinstance(c.joint, int):
            for column, p in zip(c.columns, c.term.basis, strict=True):
                value = unpowered(c.effect, p, joints[c.joint])
                if value:
                    out.append((c.joint, column, value))
    return out
