"""Events: moments at which a channel leaves its noise, and seconds whose mean deviates without a visible cause.

Events are no effect of the library, and a least-squares fit gives them more weight than anything else. So they are looked
for in the residual of the causes first; where there are some, the search is made again without them
(`Dataset.without_events`). Everything in Nm^2 unless a name has another unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.sysid.diagnosis.noise import past_valid, whiten
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel

BLOCK_S: Final = 1.0
_BURST_S: Final = 0.05
_FAR: Final = 60.0
"""Whitened energy of a stretch against the median: Gaussian noise over ten samples never reaches a twentieth of it."""
_APART_S: Final = 0.3
_JOIN_S: Final = 0.5
"""Onset and end of one event are at most this far apart."""
_OUTLYING: Final = 8.0
"""Mean of a second against the median of all: a normal one is in 10^7 seconds once."""
_OUTLYING_PART: Final = 1.0 / 3.0
"""Of the size from which means over seconds are not noise: the same for seconds that stand out."""
MOST_OF_THE_TIME: Final = 0.1
"""What takes more of the time than this is no event but a condition."""


@dataclass(frozen=True)
class Burst:
    """Moments, strongest first: (run, time [s]); excess: energy of the residual above what it is elsewhere [Nm^2];
    share: of all energy; what: "events", or "seconds" that are off as a whole.
    """

    channel: Channel
    excess_nm2: float
    share: float
    times: tuple[tuple[str, float], ...]
    what: str = "events"

    @property
    def name(self) -> str:
        """Text of its place: what, and the first moments."""
        return f"{self.what}: " + ", ".join(f"{run} {t:.1f} s" for run, t in self.times[:6])


@dataclass(frozen=True)
class EventLimits:
    """From where on one channel has events: ar: autoregression of its noise; step_s: seconds to a bin; jump_nm,
    wander_nm: by how much an event moves, and means over seconds wander, at least [Nm].
    """

    ar: FloatArray
    step_s: float
    jump_nm: float
    wander_nm: float


@dataclass(frozen=True)
class Events:
    """Of one channel: the burst, and where its events are, per run [n]."""

    burst: Burst
    masks: tuple[BoolArray, ...]

    @property
    def part(self) -> float:
        """Part of the time that the events take."""
        return sum(int(m.sum()) for m in self.masks) / max(sum(len(m) for m in self.masks), 1)


def events(
    runs: Sequence[RunData], channel: Channel, parts: Sequence[FloatArray], limits: EventLimits
) -> Events | None:
    """Return the events of a channel's residual `parts` [run][n], NaN where not valid; None without any.

    Stretches whose whitened energy is far above the usual, where the residual itself moves by jump_nm or more. A jump, a
    dip, a dropped reading: whitening makes a short peak of each. What lies between two stretches close together is one.
    """
    wide = max(4, round(_BURST_S / limits.step_s))
    energies = [_white_energy(x, limits.ar, wide) for x in parts]
    everything = np.concatenate(energies)
    good = np.isfinite(everything)
    if good.sum() < 50:
        return None
    usual = float(np.median(everything[good]))
    found: list[tuple[float, str, float]] = []
    masks = []
    for run, x, energy in zip(runs, parts, energies, strict=True):
        mask = np.zeros(len(x), bool)
        end = -(10**9)  # of the event before
        for k in np.flatnonzero(np.nan_to_num(energy) > _FAR * usual).tolist():
            first = max(0, (k - 1) * wide)
            near = x[first : (k + 2) * wide]
            near = near[np.isfinite(near)]
            if len(near) > 2 and float(np.ptp(near)) > limits.jump_nm:
                found.append((float(energy[k] / usual), run.name, float(run.time_s[k * wide])))
                mask[end if 0 < first - end <= _JOIN_S / limits.step_s else first : (k + 2) * wide] = True
                end = (k + 2) * wide
        masks.append(mask)
    if not found:
        return None
    inside = np.concatenate([x[m] for x, m in zip(parts, masks, strict=True)]) ** 2
    outside = np.concatenate([x[~m] for x, m in zip(parts, masks, strict=True)]) ** 2
    usual = float(np.nanmean(outside)) if np.isfinite(outside).any() else 0.0
    whole = float(np.nansum(inside) + np.nansum(outside))
    excess = max(float(np.nansum(inside - usual)), 0.0)
    count = int(np.isfinite(inside).sum() + np.isfinite(outside).sum())
    burst = Burst(channel, excess / count, excess / max(whole, 1e-30), _moments(found))
    return Events(burst, tuple(masks))


def bursts(
    runs: Sequence[RunData],
    residuals: Mapping[Channel, list[FloatArray]],
    limits: Mapping[Channel, EventLimits],
) -> dict[Channel, Events]:
    """Return the events of all channels that have any, see `events`."""
    found = {c: events(runs, c, parts, limits[c]) for c, parts in residuals.items()}
    return {c: e for c, e in found.items() if e is not None}


def _white_energy(x: FloatArray, ar: FloatArray, wide: int) -> FloatArray:
    """Return the mean square of the whitened residual over stretches of `wide`, NaN where not all is valid."""
    good = past_valid(np.isfinite(x), len(ar))
    white = np.where(good, whiten(np.nan_to_num(x), ar), np.nan)
    many = len(white) // wide
    result: FloatArray = (white[: many * wide].reshape(many, wide) ** 2).mean(axis=1)
    return result


def _moments(found: list[tuple[float, str, float]]) -> tuple[tuple[str, float], ...]:
    """Return (run, time) strongest first, one per event."""
    kept: list[tuple[str, float]] = []
    for _, run, t in sorted(found, reverse=True):
        if all(run != r or abs(t - u) > _APART_S for r, u in kept):
            kept.append((run, t))
    return tuple(kept)


def wandering(
    runs: Sequence[RunData],
    residuals: Mapping[Channel, Sequence[FloatArray]],
    limits: Mapping[Channel, EventLimits],
) -> list[Burst]:
    """Return channels whose residual, averaged over seconds, is not where it should be although no condition explains it
    (rms of the means above wander_nm, or above a third of it in seconds that stand far out of all others): a zero that
    jumps, a joint that is not always the same. times: the worst seconds.
    """
    out = []
    for channel, parts in residuals.items():
        step_s, least_nm = limits[channel].step_s, limits[channel].wander_nm
        block = max(2, round(BLOCK_S / step_s))
        means: list[tuple[float, str, float]] = []
        for run, x in zip(runs, parts, strict=True):
            many = len(x) // block
            mean, use = block_means(x, block)
            middle = run.time_s[: many * block : block][use] + 0.5 * block * step_s
            means += [(abs(float(m)), run.name, float(t)) for m, t in zip(mean[use], middle, strict=True)]
        sizes = np.array([m for m, _, _ in means])
        energy = float(np.mean(sizes**2)) if means else 0.0
        far = sizes[sizes > _OUTLYING * np.median(sizes)] if means else sizes
        outlying = float(np.sum(far**2)) / max(len(sizes), 1)
        if energy > least_nm**2 or outlying > (_OUTLYING_PART * least_nm) ** 2:
            total = float(np.nanmean(np.concatenate(parts) ** 2))
            out.append(Burst(channel, energy, energy / total, _moments(means)[:6], "seconds"))
    return out


def block_means(x: FloatArray, block: int) -> tuple[FloatArray, BoolArray]:
    """Return the mean of every whole block [n // block], and which blocks have more than half of their samples."""
    many = len(x) // block
    cut = x[: many * block].reshape(many, block)
    seen = np.isfinite(cut).sum(axis=1)
    mean: FloatArray = np.nansum(cut, axis=1) / np.maximum(seen, 1)
    return mean, np.asarray(seen > block // 2, np.bool_)
