"""How large the gap is in each balance, against the noise floor of the data, and where it lives. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.events import Burst, Prepared
from jtqd.sysid.diagnosis.findings import Gap, Place, Trace
from jtqd.sysid.diagnosis.leftover import MOST, Leftover, Told, less_nuisances, places_told
from jtqd.sysid.diagnosis.refine import Refined
from jtqd.sysid.diagnosis.regressors import LINE
from jtqd.sysid.diagnosis.signals import Channel, Line
from jtqd.sysid.diagnosis.structure import SIGNIFICANT, AxisMap, axis_maps

_SAME: Final = 0.02
"""Two runs whose velocities and loads differ by less than this part of their rms are repetitions."""
_PLACES_PER_AXIS: Final = 3
_LEAST_SHARE: Final = 0.02
"""Of the gap, from which a further bin is worth a line."""
_TRACE_POINTS: Final = 4000
QUADRANT_NAMES: Final = ("v+ load+", "v+ load-", "v- load+", "v- load-")


def channel_gaps(prepared: Prepared, refined: Refined, left: Leftover | None) -> tuple[Gap, ...]:
    """Return the gaps of all channels, largest excess over the floor first; places of what is left over where `left`
    is given (nothing named), else of the whole gap.
    """
    residuals = _raw(prepared)
    # where the gap lives: without what each run has of its own, which would hide a small effect
    shown = _calm(prepared, refined) if left is None else less_nuisances(prepared, refined)
    maps = axis_maps(prepared.runs, shown, prepared.step_s) if left is None else left.maps
    out = []
    for channel, parts in residuals.items():
        everything = np.concatenate(parts)
        rmse = float(np.sqrt(np.nanmean(everything**2)))
        floor, origin = _floor(prepared, refined, channel)
        floor = min(floor, rmse)  # changes from run to run that work against each other are not noise
        mine = [m for m in maps if m.channel == channel]
        noise = float(np.sqrt(np.nanmean(np.concatenate(prepared.unexplained[channel]) ** 2)))
        every = [p for m in mine for p in _bins(m, noise)]
        judge = None if left is None else left.judges[channel]
        lines = [] if left is None else [x for x in left.lines if x.channel == channel]
        by_axis = {m.axis: m for m in mine}
        told = places_told(prepared.runs, channel, shown[channel], judge, lines, by_axis)
        excess = max(rmse**2 - noise**2, 1e-30)
        places = _places(told, by_axis, noise, excess, left is not None)
        out.append(Gap(channel.joint, channel.balance, rmse, floor, origin, tuple(places), tuple(every)))
    if left is not None:  # what is not explained comes first, wherever the gap is largest
        energy = left.by_channel()
        return tuple(sorted(out, key=lambda g: -energy.get(Channel(g.joint, g.balance), 0.0)))
    return tuple(sorted(out, key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2))


def _raw(prepared: Prepared) -> dict[Channel, list[FloatArray]]:
    """Residuals of the simulation with the joint file [run][n]; torsion without each run's zero; NaN where invalid."""
    out: dict[Channel, list[FloatArray]] = {}
    for r, run in enumerate(prepared.runs):
        for channel, d in run.channels.items():
            x = np.where(prepared.seen(r, channel), d.residual, np.nan)
            if channel.balance == "torsion":
                x = x - np.nanmean(x)
            out.setdefault(channel, []).append(x)
    return out


def _floor(prepared: Prepared, refined: Refined, channel: Channel) -> tuple[float, str]:
    """Return the noise floor [Nm] and where it was taken from."""
    repeats = _repeats(prepared, channel)
    if repeats is not None:
        return repeats, "repeated runs"
    noise = np.concatenate(prepared.unexplained[channel])
    square = float(np.nanmean(noise**2))
    drift, count = 0.0, 0
    usual = np.array([g.name != LINE for g in prepared.groups])
    for run, u in zip(refined.runs, refined.nuisances, strict=True):
        d = run.channels[channel]
        part = (d.nuisances @ (u * usual)[d.families])[d.valid]
        if channel.balance == "torsion" and len(part):
            part = part - part.mean()
        drift += float(part @ part)
        count += len(part)
    return float(
        np.sqrt(square + drift / max(count, 1))
    ), "what no effect explains, and changes from run to run"


def _repeats(prepared: Prepared, channel: Channel) -> float | None:
    """Return rms of half the difference of repeated runs times sqrt 2 [Nm]; None without repetitions."""
    differences = []
    runs = prepared.runs
    for a in range(len(runs)):
        for b in range(a):
            one, two = runs[a], runs[b]
            if len(one.time_s) != len(two.time_s) or not _alike(
                one.axes[channel.joint], two.axes[channel.joint]
            ):
                continue
            x, y = one.channels[channel], two.channels[channel]
            both = x.valid & y.valid
            d = (x.residual - y.residual)[both]
            differences.append(d - d.mean() if channel.balance == "torsion" and len(d) else d)
    if not differences or sum(map(len, differences)) < 200:
        return None
    return float(np.sqrt(0.5 * np.mean(np.concatenate(differences) ** 2)))


def _alike(one: dict[str, FloatArray], two: dict[str, FloatArray]) -> bool:
    for axis in ("velocity", "load"):
        scale = float(np.sqrt(np.mean(one[axis] ** 2)))
        apart = float(np.sqrt(np.mean((one[axis] - two[axis]) ** 2)))
        limit = _SAME if axis == "velocity" else 0.1
        if scale <= 0.0 or apart > limit * scale:
            return False
    return True


def _bins(m: AxisMap, floor: float) -> list[Place]:
    """Return all bins of an axis that were visited, with their share of the axis' energy above the floor."""
    return [p for k, p in enumerate(_every_bin(m, floor)) if m.count[k] > 0]


def _every_bin(m: AxisMap, floor: float) -> list[Place]:
    excess = np.maximum(np.nan_to_num(m.square_nm2) - floor**2, 0.0) * m.count
    total = max(float(excess.sum()), 1e-30)
    return [
        Place(
            m.axis,
            _bin_name(m, k),
            float(excess[k]) / total,
            float(m.edges[k]),
            float(m.edges[k + 1]),
            m.unit,
            float(np.sqrt(m.square_nm2[k])),
        )
        for k in range(len(m.count))
    ]


def _places(
    told: Sequence[Told], maps: Mapping[str, AxisMap], floor: float, excess_nm2: float, significant: bool
) -> list[Place]:
    """Return the places, first one of each that tells (`places`), then more bins of their axes, then the other axes by
    their structure; significant: leave out axes that could be chance, and what others tell already.
    """
    ranked: list[list[Place]] = []
    for t in told:
        if t.burst is not None:
            ranked.append([_moments(t.burst, excess_nm2)])
        elif t.line is not None:
            ranked.append([_line(t.line, excess_nm2)])
        else:
            bins = _every_bin(maps[t.axis], floor)
            ranked.append([bins[k] for k in t.bins[:_PLACES_PER_AXIS]])
    if not significant:
        others = [m for m in maps.values() if all(t.axis != m.axis for t in told)]
        others.sort(key=lambda m: (m.p >= SIGNIFICANT, -m.energy_nm2))
        ranked += [sorted(_bins(m, floor), key=lambda p: -p.share)[:_PLACES_PER_AXIS] for m in others]
    first = [places[0] for places in ranked[:MOST] if places]
    return first + [p for places in ranked for p in places if p not in first and p.share > _LEAST_SHARE]


def _moments(burst: Burst, excess_nm2: float) -> Place:
    start = burst.times[0][1]
    end = start + (1.0 if burst.what == "seconds" else 0.1)
    share = min(burst.excess_nm2 / excess_nm2, 1.0)
    return Place("time", burst.name, share, start, end, "s", float(np.sqrt(burst.excess_nm2)))


def _line(line: Line, excess_nm2: float) -> Place:
    hertz = line.unit == "Hz"
    name = f"{line.order:.3g} Hz" if hertz else f"order {line.order:.2f} per motor revolution"
    rms = line.amplitude_nm / 2**0.5
    share = min(rms**2 / excess_nm2, 1.0)
    return Place("frequency", name, share, line.order, line.order, line.unit, rms)


def _bin_name(m: AxisMap, k: int) -> str:
    if m.axis == "quadrant":
        return QUADRANT_NAMES[k]
    return f"{m.edges[k]:.3g} to {m.edges[k + 1]:.3g} {m.unit}".strip()


def _causes(prepared: Prepared, refined: Refined, channel: Channel) -> list[FloatArray]:
    """Return what the causes explain, per run [n]: before less after, the runs' own changes in neither."""
    return [
        run.channels[channel].residual - left.channels[channel].residual
        for run, left in zip(prepared.runs, refined.runs, strict=True)
    ]


def _after(prepared: Prepared, refined: Refined) -> dict[Channel, list[FloatArray]]:
    """Return what the causes leave, less what each run has of its own where that makes it smaller [run][n]: fitted to the
    whitened residual of few seconds it need not.
    """
    out = less_nuisances(prepared, refined)
    for channel, parts in out.items():
        for r, run in enumerate(refined.runs):
            plain = np.where(prepared.seen(r, channel), run.channels[channel].residual, np.nan)
            if np.nansum(plain**2) < np.nansum(parts[r] ** 2):
                parts[r] = plain
    return out


def _calm(prepared: Prepared, refined: Refined) -> dict[Channel, list[FloatArray]]:
    """Return the residual with the joint files, less what each run has of its own [run][n]."""
    after = _after(prepared, refined)
    return {c: [a + b for a, b in zip(after[c], _causes(prepared, refined, c), strict=True)] for c in after}


def traces(prepared: Prepared, refined: Refined) -> tuple[Trace, ...]:
    """Return the residual before and after for plots, thinned, one per run and channel."""
    out = []
    after = _after(prepared, refined)
    raw = _calm(prepared, refined)
    for r, run in enumerate(prepared.runs):
        for channel in run.channels:
            every = max(1, len(run.time_s) // _TRACE_POINTS)
            axes = run.axes[channel.joint]
            out.append(
                Trace(
                    run.name,
                    channel.joint,
                    channel.balance,
                    run.time_s[::every],
                    raw[channel][r][::every],
                    after[channel][r][::every],
                    axes["velocity"][::every],
                    axes["load"][::every],
                )
            )
    return tuple(out)
