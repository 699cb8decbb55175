"""Guards: criteria by which an effect that improves the fit is not accepted as a cause.

The search asks whether an effect lowers the deviance of the whitened residual. An effect that does may still be wrong: a
parameter may lie at the end of what is physically possible, the effect may raise the plain error of the torque on runs that
it was not fitted to, or two large effects may cancel each other. Each guard gives one line with what it found. Whether the
size of an effect is the same in all runs is asked in `stability`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import TORSION
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.findings import joint_text
from jtqd.sysid.diagnosis.gain import (
    falls_nm,
    free_run_errors,
    judged_squares,
    left_out_steps,
    noise_squares,
    squares_beside,
)
from jtqd.sysid.diagnosis.mixed_model import ENOUGH_RUNS
from jtqd.sysid.diagnosis.refine import PresentEffect, Refined, contributions, parameter, places
from jtqd.sysid.diagnosis.search import Hypothesis

_AT_BOUND: Final = 1e-6
"""Part of a range within which a value lies at its end."""
_FACTOR: Final = {"torque_constant_nm_per_a": 2.0, "gain": 2.0}
"""By how much a value may differ from the file's, either way: more is another motor or another unit, not an error."""
_LEAST: Final = {"rotor_inertia_kgm2": 0.05}
"""Part of the file's value below which it is none: every motor has a rotor."""
_CANCELLED: Final = 0.3
"""Two effects whose sum is smaller than this part of each cancel each other."""


def nothing_of(best: Hypothesis) -> list[dict[str, float]]:
    """Return per chosen candidate the parameters at which it is no effect."""
    return [dict(c.term.combine([0.0] * c.size)) for c in best.chosen]


def objections(
    dataset: Dataset, best: Hypothesis, refined: Refined, *, bounds_only: bool = False
) -> list[tuple[int, str]]:
    """Return the causes (by place) that are refused, and why. The first of four tests that refuses any decides:

    1. Bounds: all causes with a parameter at a bound.
    2. Held-out runs: the cause that helps least, if it raises the error there, or if all causes together lower the error of
       no balance.
    3. Free run, only where no torque was measured: of the causes that raise the error of the position, the one that helps
       least on held-out runs.
    4. Cancelling: the smaller of two causes that cancel each other.

    The other causes must be fitted again before the next call. bounds_only: test 1 alone.
    """
    nothing = nothing_of(best)
    bound = [
        (k, beyond_bounds(p, none)) for k, (p, none) in enumerate(zip(refined.present, nothing, strict=True))
    ]
    bound = [(k, why) for k, why in bound if why]
    if bound or bounds_only or not refined.present:
        return bound
    steps = left_out_steps(refined)
    falls = held_out_gains(dataset, refined, steps)
    worst = int(np.argmin(falls))
    if falls[worst] <= 0.0 or max(falls_nm(judged_squares(dataset, refined, steps)[0]).values()) <= 0.0:
        return [(worst, "it raises the error on held-out runs")]
    if dataset.no_torque:
        harmful = [k for k in range(len(refined.present)) if free_run_fall(dataset, refined, k) < 0.0]
        if harmful:
            worst = min(harmful, key=lambda k: falls[k])
            return [(worst, "it raises the error of the position in a free run on held-out runs")]
    pair = cancelling(dataset, refined.present)
    if pair is None:
        return []
    other = refined.present[pair[1]]
    return [(pair[0], f"it cancels {other.effect.name} of {joint_text(other.joint)}")]


def beyond_bounds(p: PresentEffect, nothing: dict[str, float]) -> str:
    """Return which parameter lies outside of, or at the end of, what is plausible, "" for none; nothing: the values at which
    the effect is none (a joint file's own value may be at the end).
    """
    for name, value in p.values.items():
        q = parameter(p.effect, name)
        if name == "phase_rad" or q.fixed or (name not in p.free and q.low <= value <= q.high):
            continue  # what is not free is switched off: no size of it was asked for
        room = _AT_BOUND * (q.high - q.low if np.isfinite(q.high - q.low) else max(abs(value), 1.0))
        room = min(room, 1e-3 * abs(value - nothing.get(name, 0.0)))
        if not q.low + room < value < q.high - room:
            return f"{name} {value:.4g} {q.unit} is at the end of what is plausible ({q.low:g} to {q.high:g})"
        usual, factor = nothing.get(name, 0.0), _FACTOR.get(name, np.inf)
        least = max(usual / factor, _LEAST.get(name, 0.0) * usual)
        if usual > 0.0 and not least <= value < usual * factor:
            return f"{name} {value:.4g} {q.unit} is not physical: the file has {usual:.4g}"
    return ""


def cancelling(dataset: Dataset, present: Sequence[PresentEffect]) -> tuple[int, int] | None:
    """Return two causes that are large and cancel each other in the channel where they are largest, the smaller first."""
    parts = [contributions(dataset, p) for p in present]
    sizes = [{c: _rms(x) for c, x in part.items()} for part in parts]
    for a in range(len(present)):
        for b in range(a):
            for c in sizes[a].keys() & sizes[b].keys():
                if sizes[a][c] < max(sizes[a].values()) or sizes[b][c] < max(sizes[b].values()):
                    continue
                together = _rms([x + y for x, y in zip(parts[a][c], parts[b][c], strict=True)])
                if together < _CANCELLED * min(sizes[a][c], sizes[b][c]):
                    return (a, b) if sizes[a][c] < sizes[b][c] else (b, a)
    return None


def held_out_gains(dataset: Dataset, refined: Refined, steps: Sequence[FloatArray]) -> list[float]:
    """Return per cause by how much it lowers the squared error of the balances it acts in, each run with the parameters of
    all others (`left_out_steps`), as a part of what is there without it; at or below zero it is better left out.

    What a run has of its own (zero and friction of the day) counts as little as it is usual: it can be several times an
    effect, and by chance lie against it in the mean of the runs. With fewer than ENOUGH_RUNS the plain error decides.
    """
    enough = refined.mixed.runs >= ENOUGH_RUNS
    floor = noise_squares(dataset)
    out = []
    for p, mine in zip(refined.present, places(refined.present), strict=True):
        here = contributions(dataset, p)
        without, within = 0.0, 0.0
        for c, parts in here.items():
            for r, (run, step) in enumerate(zip(refined.runs, steps, strict=True)):
                d = run.channels[c]
                left = (d.residual - d.regressors @ step[d.index])[d.valid]
                own = [k for k, i in enumerate(d.index) if mine.start <= i < mine.stop]
                part = parts[r] + (d.regressors[:, own] @ step[d.index[own]])[d.valid]
                if c.balance == TORSION and len(left):
                    left, part = left - left.mean(), part - part.mean()
                both = np.column_stack((left, left + part))
                own_changes = d.nuisances[d.valid] if enough else np.empty((len(both), 0))
                weights = floor[c] / refined.variances[d.families] if enough else np.empty(0)
                squares = squares_beside(both, own_changes, weights)
                within, without = within + float(squares[0]), without + float(squares[1])
        out.append(1.0 - within / without if without > 0.0 else 0.0)
    return out


def free_run_fall(dataset: Dataset, refined: Refined, cause: int) -> float:
    """Return which part of the squared error of the position in a free run one cause takes away on held-out runs; 0 where
    it has no part in it (the spring is on the other side of the torque).
    """
    _, (before, after) = free_run_errors(dataset, refined, left_out_steps(refined), cause)
    return 1.0 - (after / before) ** 2 if before > 0.0 else 0.0


def _rms(parts: Sequence[FloatArray]) -> float:
    whole = np.concatenate(parts) if parts else np.zeros(1)
    return float(np.sqrt(np.mean(whole**2))) if len(whole) else 0.0
