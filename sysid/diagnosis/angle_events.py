"""Events locked to the angle of the link: a range of angle that costs torque per pass (a rubbing cover, a pulling cable).

Where the runs begin at different angles, often only one of them reaches the range, a few times; then no other run can
confirm a map over the angle. The passes of that run confirm each other instead: every one deviates, and the rest of the
time nothing does. The chance of this for moments that have nothing to do with the angle is hypergeometric (Fisher's exact
test): the time of the runs that reach the range is cut into pieces as long as a pass, and the pieces that deviate are
those of the range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import hypergeom

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.regressors import Index

_WIDEST_RAD: Final = 1.0
"""Of a range; what depends on more of the turn is no matter of passes."""
_MOST_OF_IT: Final = (0.9, 0.7)
"""Part of the residual's energy that lies in the range; the second where passes that only touch its edges make the first
one uncertain.
"""
_DEVIATES: Final = 0.25
"""Part of the range's mean square from which a piece of time deviates."""
_SURE: Final = 0.01
"""Largest chance over all ranges looked at."""
_FEWEST: Final = 2
_SHORTEST_S: Final = 0.02
"""Of a pass; a touch of the range's edge is none."""


@dataclass(frozen=True)
class TurnRange:
    """Bins of the link angle, those that hold most first, and the passes of them; around: these bins and the next on either
    side, through which the ends of the range may cut.
    """

    bins: tuple[int, ...]
    passes: tuple[tuple[int, int, int], ...]  # run, first sample, sample after the last
    around: tuple[int, ...]


def turn_range(
    places: Sequence[Index], parts: Sequence[FloatArray], edges: FloatArray, step_s: float
) -> TurnRange | None:
    """Return the range of the link's turn whose passes hold most of the residual, None if there is none for certain.

    places [run][n]: bin of the link angle; parts [run][n]: residual [Nm], NaN where not valid; edges [b+1] rad.
    """
    bins = len(edges) - 1
    square = np.zeros(bins)
    for place, x in zip(places, parts, strict=True):
        good = np.isfinite(x)
        square += np.bincount(place[good], x[good] ** 2, minlength=bins)
    width = float(edges[1] - edges[0])
    widest = min(int(_WIDEST_RAD / width), bins - 1)
    circular = float(edges[-1] - edges[0]) > 2.0 * np.pi - 1.5 * width
    for part in _MOST_OF_IT:
        first, count = _narrowest(square, part, widest, circular)
        inside = (np.arange(first, first + count) % bins).tolist()
        found = _passes(places, parts, inside, round(_SHORTEST_S / step_s))
        if len(found) >= _FEWEST and _chance(found, parts, bins * widest) < _SURE:
            wider = range(first - 1, first + count + 1)
            around = {k % bins for k in wider if circular or 0 <= k < bins}
            largest_first = sorted(inside, key=lambda k: -square[k])
            return TurnRange(tuple(largest_first), tuple(found), tuple(sorted(around)))
    return None


def predicted_by_passes(
    found: TurnRange, places: Sequence[Index], parts: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return at every sample of a pass the mean of its bin over the other passes, zero elsewhere [run][n], Nm."""
    out = [np.zeros(len(x)) for x in parts]
    bins = 1 + max(int(place.max()) for place in places)
    sums, counts = np.zeros((len(found.passes), bins)), np.zeros((len(found.passes), bins))
    for k, (r, a, b) in enumerate(found.passes):
        place, x = places[r][a:b], parts[r][a:b]
        good = np.isfinite(x)
        sums[k] = np.bincount(place[good], x[good], minlength=bins)
        counts[k] = np.bincount(place[good], minlength=bins)
    others = (sums.sum(axis=0) - sums) / np.maximum(counts.sum(axis=0) - counts, 1.0)
    for k, (r, a, b) in enumerate(found.passes):
        out[r][a:b] = others[k][places[r][a:b]]
    return out


def _narrowest(square: FloatArray, part: float, widest: int, circular: bool) -> tuple[int, int]:
    """Return first bin and number of bins of the narrowest window that holds this part of the energy; (0, 0): none does."""
    whole = float(square.sum())
    for count in range(1, widest + 1):
        turned = np.concatenate((square, square[: count - 1] if circular else []))
        held = np.convolve(turned, np.ones(count), mode="valid")
        best = int(np.argmax(held))
        if held[best] > part * whole > 0.0:
            return best, count
    return 0, 0


def _passes(
    places: Sequence[Index], parts: Sequence[FloatArray], inside: Sequence[int], shortest: int
) -> list[tuple[int, int, int]]:
    out = []
    for r, (place, x) in enumerate(zip(places, parts, strict=True)):
        there = np.isin(place, inside)
        for a, b in _stretches(there):
            if np.isfinite(x[a:b]).sum() >= max(shortest, 1):
                out.append((r, a, b))
    return out


def _stretches(there: NDArray[np.bool_]) -> list[tuple[int, int]]:
    steps = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    return [(int(a), int(b)) for a, b in zip(steps[::2], steps[1::2], strict=True)]


def _chance(found: Sequence[tuple[int, int, int]], parts: Sequence[FloatArray], looked_at: int) -> float:
    """Return the chance of so many deviating passes among so many pieces of time, over all ranges looked at."""
    within = [_mean_square(parts[r][a:b]) for r, a, b in found]
    length = max(int(np.median([b - a for _, a, b in found])), 1)
    limit = _DEVIATES * float(np.nanmean(np.concatenate([parts[r][a:b] for r, a, b in found]) ** 2))
    elsewhere = []
    for r in {r for r, _, _ in found}:
        x = parts[r].copy()
        for q, a, b in found:
            if q == r:
                x[a:b] = np.nan
        elsewhere += [_mean_square(x[k : k + length]) for k in range(0, len(x) - length + 1, length)]
    rest = np.asarray(elsewhere)
    rest = rest[np.isfinite(rest)]
    hits, strays = int((np.asarray(within) > limit).sum()), int((rest > limit).sum())
    chance = hypergeom.sf(hits - 1, len(within) + len(rest), hits + strays, len(within))
    return float(looked_at * chance)


def _mean_square(x: FloatArray) -> float:
    good = np.isfinite(x)
    return float(np.mean(x[good] ** 2)) if good.any() else float("nan")
