"""Figures of the residual over time, before and after, and which runs are drawn."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.findings import Findings, Trace
from jtqd.sysid.diagnosis.report.words import balance_title
from jtqd.sysid.report.numbers import number
from jtqd.sysid.report.page import LIGHT, page_svg, thinned

MOST: Final = 6
"""Figures on a page; the other runs are in its table."""
FIRST: Final = 2
"""Of them, shown without a click."""
WIDE_IN: Final = 9.2
NARROW_IN: Final = 4.4
_BUCKETS: Final = {WIDE_IN: 360, NARROW_IN: 160}
_VISIBLE_GAIN: Final = 0.1
"""Least part of the residual's energy that the causes remove in a figure shown without a click."""
_FLOOR_SIGMAS: Final = 2.0


@dataclass(frozen=True)
class TraceRow:
    """One run, joint and balance in the table: root mean squares [Nm]."""

    run: str
    joint: int
    balance: str
    before: str
    after: str


@dataclass(frozen=True)
class Picture:
    """One trace as SVG, wide and narrow; text: its alternative text; opened: shown without a click; data: the curves as
    JSON for `traces.js`.
    """

    title: str
    text: str
    wide: str
    narrow: str
    opened: bool
    data: str


def rms(x: Any) -> float:
    """Root mean square without NaN; NaN for nothing."""
    good = np.isfinite(x)
    return float(np.sqrt(np.mean(np.square(x[good])))) if good.any() else float("nan")


def trace_rows(findings: Findings) -> list[TraceRow]:
    """Return the table of all traces."""
    return [
        TraceRow(t.run, t.joint, balance_title(t.balance), number(rms(t.before_nm)), number(rms(t.after_nm)))
        for t in findings.traces
    ]


def chosen_traces(findings: Findings) -> list[Trace]:
    """Return the traces to draw: one run of each balance, then another of each, at most MOST.

    Balances come in the order of the gaps. With causes the first run of a balance is the one whose energy they reduce by
    the median share; without causes it is the one with most energy.
    """
    groups: dict[tuple[int, str], list[Trace]] = {(g.joint, g.balance): [] for g in findings.gaps}
    for trace in findings.traces:
        groups.setdefault((trace.joint, trace.balance), []).append(trace)
    ranked = [_ranked(group, bool(findings.causes)) for group in groups.values()]
    most = max((len(group) for group in ranked), default=0)
    rounds = [group[k] for k in range(most) for group in ranked if k < len(group)]
    return rounds[:MOST]


def _ranked(group: Sequence[Trace], both: bool) -> list[Trace]:
    if not both:
        return sorted(group, key=lambda t: -_energy(t.before_nm))
    ordered = sorted(group, key=lambda t: -_removed_share(t))
    middle = (len(ordered) - 1) // 2
    return ordered[middle : middle + 1] + ordered[:middle] + ordered[middle + 1 :]


def _energy(values: Any) -> float:
    return float(np.sum(np.nan_to_num(values) ** 2))


def _removed_share(trace: Trace) -> float:
    """Return the part of the residual's energy that the causes remove."""
    there = _energy(trace.before_nm)
    return 1.0 - _energy(trace.after_nm) / there if there > 0.0 else 0.0


def pictures(findings: Findings) -> list[Picture]:
    """Return the figures, in the order of `chosen_traces`. Raises ImportError without matplotlib."""
    floors = {(g.joint, g.balance): g.noise_floor_nm for g in findings.gaps}
    both = bool(findings.causes)
    traces = chosen_traces(findings)
    first = {(t.joint, t.balance): k for k, t in reversed(list(enumerate(traces)))}
    visible = [k for k in sorted(first.values()) if both and _removed_share(traces[k]) > _VISIBLE_GAIN]
    opened = visible[:FIRST] or [0]
    return [_picture(trace, k, floors, both, k in opened) for k, trace in enumerate(traces)]


def _picture(
    trace: Trace, place: int, floors: Mapping[tuple[int, str], float], both: bool, opened: bool
) -> Picture:
    floor = floors.get((trace.joint, trace.balance), float("nan"))
    text = (
        f"Residual of joint {trace.joint}, {balance_title(trace.balance)}, over {number(trace.time_s[-1])} s of run "
        f"{trace.run}: {number(rms(trace.before_nm))} Nm rms"
    )
    text += (
        f" before, {number(rms(trace.after_nm))} Nm rms with the causes in the simulation." if both else "."
    )
    wide, narrow = (
        page_svg(partial(_figure, trace, width, floor, both), f"p{place}{name}")
        for width, name in ((WIDE_IN, "w"), (NARROW_IN, "n"))
    )
    title = f"{trace.run}, joint {trace.joint}, {balance_title(trace.balance)}"
    return Picture(title, text, wide, narrow, opened, _data(trace, floor, both))


def _data(trace: Trace, floor: float, both: bool) -> str:
    """Return the curves of a figure as JSON: 16 bits a value, base64, which is finer than any screen."""
    curves = [_curve("before", "simulation as it is", "before", trace.before_nm, "Nm", tall=True)]
    if both:
        curves.append(_curve("after", "with the causes", "after", trace.after_nm, "Nm", tall=True))
    curves.append(_curve("soft", "velocity [rad/s]", "velocity", trace.velocity_rad_s, "rad/s"))
    curves.append(_curve("soft", "torque [Nm]", "torque", trace.torque_nm, "Nm"))
    step = float(np.median(np.diff(trace.time_s))) if len(trace.time_s) > 1 else 1.0
    content = {
        "start_s": round(float(trace.time_s[0]), 6),
        "step_s": float(f"{step:.9g}"),
        "floor_nm": float(f"{floor:.4g}") if np.isfinite(floor) else None,
        "curves": curves,
    }
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _curve(
    role: str, title: str, short: str, values: FloatArray, unit: str, *, tall: bool = False
) -> dict[str, Any]:
    good = np.isfinite(values)
    largest = float(np.max(np.abs(values[good]))) if good.any() else 0.0
    scale = largest / 32767.0 or 1.0
    whole = np.where(good, np.round(np.where(good, values, 0.0) / scale), -32768.0).astype("<i2")
    text = base64.b64encode(whole.tobytes()).decode("ascii")
    named = {"role": role, "title": title, "short": short, "unit": unit, "tall": tall}
    return {**named, "scale": float(f"{scale:.6g}"), "values": text}


def _figure(trace: Trace, width: float, floor: float, both: bool) -> Any:
    """Panels over time: residual before, after on the same scale, velocity, sensor torque."""
    curves = [("before", "simulation as it is", trace.before_nm)]
    if both:
        curves.append(("after", "with the causes", trace.after_nm))
    figure, axes = _panels(len(curves), width)
    top = _limit([values for _, _, values in curves], floor)
    buckets = _BUCKETS[width]
    for axis, (role, title, values) in zip(axes, curves, strict=False):
        if np.isfinite(floor):
            sigma = _FLOOR_SIGMAS * floor
            axis.axhspan(-sigma, sigma, color=LIGHT["noise"], linewidth=0.0, zorder=0)
        (line,) = axis.plot(*thinned(trace.time_s, values, buckets), color=LIGHT[role], linewidth=0.8)
        line.set_gid(role)
        axis.set_ylim(-top, top)
        axis.set_ylabel("[Nm]")
        axis.set_title(f"{title}: {number(rms(values))} Nm rms", loc="left", fontsize=9.5, color=LIGHT[role])
    for axis, name, values in zip(
        axes[len(curves) :],
        ("velocity [rad/s]", "torque [Nm]"),
        (trace.velocity_rad_s, trace.torque_nm),
        strict=True,
    ):
        axis.plot(*thinned(trace.time_s, values, buckets // 2), color=LIGHT["soft"], linewidth=0.8)
        axis.set_title(name, loc="left", fontsize=8.5, color=LIGHT["soft"], pad=2)
        axis.locator_params(axis="y", nbins=3)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(trace.time_s[0], trace.time_s[-1])
    return figure


def _panels(curves: int, width: float) -> tuple[Any, Any]:
    """Return figure and axes: `curves` tall ones, two low ones."""
    from matplotlib import pyplot as plt

    heights = [3.0] * curves + [1.2, 1.2]
    height = 0.9 + 0.43 * sum(heights)
    figure, axes = plt.subplots(len(heights), 1, sharex=True, figsize=(width, height), height_ratios=heights)
    # margins in inches; a layout engine would draw everything twice
    figure.subplots_adjust(
        left=0.62 / width,
        right=1.0 - 0.12 / width,
        top=1.0 - 0.24 / height,
        bottom=0.45 / height,
        hspace=0.45,
    )
    return figure, axes


def _limit(curves: Sequence[Any], floor: float) -> float:
    """Half the height of the residual's axes: all of every curve, the noise band too."""
    heights = [float(np.nanmax(np.abs(c))) for c in curves if np.isfinite(c).any()]
    if np.isfinite(floor):
        heights.append(1.3 * _FLOOR_SIGMAS * floor)
    return 1.08 * max(heights, default=1.0) or 1.0
