"""Report of a diagnosis: one self-contained HTML page, made from the findings alone.

Before the first picture it states what the terminal does (`words`). The pictures show simulation against measurement over
time, before and after, and their difference. Needs jinja2 and matplotlib.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings, Gap, JointName, Place, Trace, priors
from jtqd.sysid.diagnosis.next_experiment import PLAN_FILE, campaign_command, motions_of
from jtqd.sysid.diagnosis.words import (
    BADGES,
    BALANCES,
    bin_name,
    effect_title,
    in_words,
    joints_text,
    parameter_title,
    place,
    provenance_text,
    summary,
)
from jtqd.sysid.planner.plan import Plan
from jtqd.sysid.report import page
from jtqd.sysid.report.numbers import DASH, number, percent, unit_name, with_unit
from jtqd.sysid.report.page import LIGHT, page_svg, thinned

TEMPLATE: Final = "report.html.j2"
_HOT: Final = 2.0
"""A bin with this many times its even share of the gap is marked."""
_EVEN: Final = 1.5
"""An axis without a bin above this many even shares is not shown."""
MOST: Final = 4
"""Figures on a page."""
WIDE_IN: Final = 9.2
NARROW_IN: Final = 4.4
_BUCKETS: Final = {WIDE_IN: 360, NARROW_IN: 160}
_FLOOR_SIGMAS: Final = 2.0
_BEFORE, _AFTER = "simulation as it is", "with the entries found"
_TORQUE: Final = {"motor": "motor torque G Kt i", "torsion": "torque by the twist"}


def render(findings: Findings) -> str:
    """Return the page. The same findings give the same text. Needs jinja2 and matplotlib (ImportError without them)."""
    content = {
        "f": findings,
        "made": provenance_text(findings.provenance, most=len(findings.runs) + 8),
        "badge": BADGES[findings.verdict],
        "scope": ", ".join(filter(None, (findings.runs_text, joints_text(findings.joints)))),
        "s": summary(findings),
        "looked_at": [candidate_row(each) for each in findings.candidates],
        "gaps": [(gap, BALANCES[gap.balance], gap_axes(gap)) for gap in findings.gaps],
        "priors": priors(findings.trust),
        "gains": {each.run: each for each in findings.gain.runs} if findings.gain else {},
        "pictures": pictures(findings),
        "next": _next(findings),
    }
    filters: dict[str, Callable[..., str]] = {"number": number, "effect_title": effect_title}
    return page.render("jtqd.sysid.diagnosis", TEMPLATE, content, filters)


def candidate_row(each: CandidateEvidence) -> tuple[str, str, str, str]:
    """Return name, place, why it is or is not in the set, and the smallest size that would be."""
    texts = []
    for name, value in each.minimum.items():
        if math.isfinite(value.value) and value.value > 0.0:
            size = with_unit(value.value, value.unit, 2)
            texts.append(size if len(each.minimum) == 1 else f"{size} {parameter_title(name)}")
    return effect_title(each.name), place(each.joint), in_words(each.reason), ", ".join(texts) or DASH


class Bar(NamedTuple):
    """One bin: height (1: the largest of all axes of the gap), whether it is marked, all of it as a text."""

    height: float
    hot: bool
    text: str


class Axis(NamedTuple):
    """The gap over one operating condition; uneven: largest share in units of an even one; even: height of an even share;
    ends: of the axis.
    """

    title: str
    bars: tuple[Bar, ...]
    ends: tuple[str, str]
    peak: str
    uneven: float
    even: float


def gap_axes(gap: Gap) -> list[Axis]:
    """Return the axes over which a gap is uneven, the most uneven first; one at least, where there is a map."""
    axes: dict[str, list[Place]] = {}
    for each in gap.map:
        axes.setdefault(each.axis, []).append(each)
    # where the gap is small beside the noise, the excess of some bins is larger than that of all
    whole = {name: max(1.0, sum(max(p.share, 0.0) for p in places)) for name, places in axes.items()}
    even = [p.share / whole[name] * len(places) for name, places in axes.items() for p in places]
    found = [_axis(name, places, whole[name], max([_HOT, *even])) for name, places in axes.items()]
    found.sort(key=lambda axis: -axis.uneven)
    return [axis for k, axis in enumerate(found) if axis.uneven > _EVEN or k == 0]


def _axis(name: str, places: Sequence[Place], whole: float, highest: float) -> Axis:
    """Return one axis; whole: what its shares are parts of; highest: full height, in units of an even share."""
    ordered, count = sorted(places, key=lambda each: (each.low, each.high)), len(places)
    shares = [each.share / whole for each in ordered]
    texts = [
        f"{bin_name(p)}: {percent(share)}{f', {number(p.rms_nm)} Nm rms' if math.isfinite(p.rms_nm) else ''}"
        for p, share in zip(ordered, shares, strict=True)
    ]
    top = max(range(count), key=shares.__getitem__)
    ends = ordered[0].low, ordered[-1].high
    named = name == "quadrant" or not all(map(math.isfinite, ends))
    unit = unit_name(ordered[top].unit)
    low, high = (bin_name(ordered[k]) if named else f"{number(ends[k])} {unit}".rstrip() for k in (0, -1))
    bars = tuple(
        Bar(max(s, 0.0) * count / highest, s * count > _HOT, text)
        for s, text in zip(shares, texts, strict=True)
    )
    peak = f"{percent(shares[top])} at {bin_name(ordered[top])}"
    return Axis(name.replace("_", " "), bars, (low, high), peak, shares[top] * count, 1.0 / highest)


def _next(findings: Findings) -> dict[str, Any] | None:
    """Why, the plan as YAML, and what it amounts to; nothing of a plan that `jtq campaign` would refuse."""
    experiment = findings.next_experiment
    if experiment is None:
        return None
    plan, motions = experiment.get("plan"), motions_of(experiment)
    durations_s = [run["duration_s"] for motion, _ in motions.values() for run in motion["runs"]]
    if plan is not None:
        with suppress(ConfigError):
            durations_s = [run.duration_s for run in Plan.from_mapping(dict(plan), PLAN_FILE).runs]
    return {
        "why": in_words(experiment["why"]),
        "file": PLAN_FILE,
        "command": experiment.get("command") or campaign_command(),
        "motions": [
            (file, [(run["name"], run["what"], f"{number(run['duration_s'])} s") for run in motion["runs"]])
            for file, (motion, _) in motions.items()
        ],
        "amount": _amount(durations_s),
        "yaml": "" if plan is None else yaml.safe_dump(plan, sort_keys=False, allow_unicode=True),
    }


def _amount(durations_s: Sequence[float]) -> str:
    """Return how long some runs are, e.g. "4 runs, 12 minutes of motion"; "" for none."""
    if not durations_s:
        return ""
    seconds = sum(durations_s)
    length = f"{number(seconds)} s" if seconds < 120.0 else f"{number(seconds / 60.0, 2)} minutes"
    return f"{counted(len(durations_s), 'run')}, {length} of motion"


class Picture(NamedTuple):
    """One trace as SVG, wide and narrow; text: its alternative text; data: the curves as JSON for `traces.js`."""

    title: str
    text: str
    wide: str
    narrow: str
    data: str


class Line(NamedTuple):
    """One curve of a panel; role: its colour; curve, less: which arrays of the data it is the first of, less the second."""

    role: str
    title: str
    curve: str
    less: str = ""


class Panel(NamedTuple):
    """Curves on one scale [unit]; residual: about zero, with the band of the noise."""

    title: str
    unit: str
    height: float
    lines: tuple[Line, ...]
    residual: bool = False


def rms(x: Any) -> float:
    """Root mean square without NaN; NaN for nothing."""
    good = np.isfinite(x)
    return float(np.sqrt(np.mean(np.square(x[good])))) if good.any() else float("nan")


def chosen_traces(findings: Findings) -> list[Trace]:
    """Return the traces to draw, one per balance, at most MOST: first the balance that the gain is of (not stated: that of
    the largest entry) with the run on which the extended model errs most; of the others the run with most error before.
    """
    gain, errors = findings.gain, held_out(findings)
    order: list[tuple[JointName | None, str | None]] = [(gain.joint, gain.balance)] if gain else []
    order += [(c.joint, c.balance) for c in findings.causes[:1]]
    order += [(g.joint, g.balance) for g in findings.gaps] + [(t.joint, t.balance) for t in findings.traces]
    chosen = []
    for channel in dict.fromkeys(order):
        group = [t for t in findings.traces if (t.joint, t.balance) == channel]
        size = [(errors.get((*channel, t.run), 0.0), float(np.nansum(t.before_nm**2))) for t in group]
        chosen += [group[size.index(max(size))]] if group else []
    return chosen[:MOST]


def held_out(findings: Findings) -> dict[tuple[JointName | None, str | None, str], float]:
    """Return the extended model's error [Nm] by joint, balance and held-out run, where the gain is measured."""
    gain = findings.gain
    return {(gain.joint, gain.balance, each.run): each.rmse_after_nm for each in gain.runs} if gain else {}


def pictures(findings: Findings) -> list[Picture]:
    """Return the figures, in the order of `chosen_traces`. Raises ImportError without matplotlib."""
    floors = {(g.joint, g.balance): g.noise_floor_nm for g in findings.gaps}
    both = bool(findings.causes or findings.too_small)
    held, drawn = held_out(findings), []
    for k, trace in enumerate(chosen_traces(findings)):
        floor = floors.get((trace.joint, trace.balance), float("nan"))
        title = f"{trace.run}, joint {trace.joint}, {BALANCES[trace.balance]}"
        text = (
            f"Measured and simulated torque of {title}, over {number(trace.time_s[-1])} s: the difference is "
            f"{number(rms(trace.before_nm))} Nm rms"
        )
        text += f" before, {number(rms(trace.after_nm))} Nm rms with the entries found." if both else "."
        if (trace.joint, trace.balance, trace.run) in held:
            title += ": the worst held-out run"
        wide, narrow = (
            page_svg(partial(_figure, trace, width, floor, both), f"p{k}{name}")
            for width, name in ((WIDE_IN, "w"), (NARROW_IN, "n"))
        )
        drawn.append(Picture(title, text, wide, narrow, _data(trace, floor, both)))
    return drawn


def panels(trace: Trace, both: bool) -> list[Panel]:
    """Return the panels of a figure, from above; both: with what the entries change."""
    measured = Line("ink", "measured", "measured")
    sides = [("before", _BEFORE), ("after", _AFTER)] if both else [("before", _BEFORE)]
    torque = _TORQUE.get(trace.balance, "torque")
    return [
        *(Panel(torque, "Nm", 2.6, (measured, Line(s, title, "measured", s))) for s, title in sides),
        Panel("measured less simulated", "Nm", 2.6, tuple(Line(s, t, s) for s, t in sides), residual=True),
        Panel("velocity", "rad/s", 1.1, (Line("soft", "velocity", "velocity"),)),
    ]


def _curves(trace: Trace, both: bool) -> dict[str, FloatArray]:
    found = {"measured": trace.measured_nm, "before": trace.before_nm, "velocity": trace.velocity_rad_s}
    return {**found, "after": trace.after_nm} if both else found


def _data(trace: Trace, floor: float, both: bool) -> str:
    """Return the curves of a figure as JSON: 16 bits a value, base64, which is finer than any screen."""
    step = float(np.median(np.diff(trace.time_s))) if len(trace.time_s) > 1 else 1.0
    content = {
        "start_s": round(float(trace.time_s[0]), 6),
        "step_s": float(f"{step:.9g}"),
        "floor_nm": float(f"{floor:.4g}") if np.isfinite(floor) else None,
        "curves": {name: _coded(values) for name, values in _curves(trace, both).items()},
        "panels": [
            {**p._asdict(), "lines": [line._asdict() for line in p.lines]} for p in panels(trace, both)
        ],
    }
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _coded(values: FloatArray) -> dict[str, Any]:
    good = np.isfinite(values)
    largest = float(np.max(np.abs(values[good]))) if good.any() else 0.0
    scale = largest / 32767.0 or 1.0
    whole = np.where(good, np.round(np.where(good, values, 0.0) / scale), -32768.0).astype("<i2")
    text = base64.b64encode(whole.tobytes()).decode("ascii")
    return {"scale": float(f"{scale:.6g}"), "values": text}


def _figure(trace: Trace, width: float, floor: float, both: bool) -> Any:
    """Panels over time, as `panels` has them."""
    from matplotlib import pyplot as plt

    shown, curves, buckets = panels(trace, both), _curves(trace, both), _BUCKETS[width]
    heights = [p.height for p in shown]
    height = 0.9 + 0.48 * sum(heights)
    figure, axes = plt.subplots(len(heights), 1, sharex=True, figsize=(width, height), height_ratios=heights)
    # margins in inches; a layout engine would draw everything twice
    edges = {"left": 0.62 / width, "right": 1.0 - 0.12 / width, "top": 1.0 - 0.28 / height}
    figure.subplots_adjust(**edges, bottom=0.45 / height, hspace=0.4)
    for k, (axis, panel) in enumerate(zip(axes, shown, strict=True)):
        for line in panel.lines:
            values = curves[line.curve] - curves[line.less] if line.less else curves[line.curve]
            title = f"{number(rms(values))} Nm rms" if panel.residual else line.title
            (drawn,) = axis.plot(
                *thinned(trace.time_s, values, buckets), color=LIGHT[line.role], linewidth=0.8, label=title
            )
            drawn.set_gid(f"{line.role}_{k}")
        if panel.residual:
            top = _limit([curves[line.curve] for line in panel.lines], floor)
            axis.set_ylim(-top, top)
            if np.isfinite(floor):
                sigma = _FLOOR_SIGMAS * floor
                axis.axhspan(-sigma, sigma, color=LIGHT["noise"], linewidth=0.0, zorder=0)
        axis.set_title(panel.title, loc="right", fontsize=8.0, color=LIGHT["soft"], pad=3)
        axis.set_ylabel(f"[{panel.unit}]")
        axis.locator_params(axis="y", nbins=4)
        if len(panel.lines) > 1:
            place = {"loc": "lower left", "bbox_to_anchor": (-0.02, 1.0), "ncols": 2, "borderaxespad": 0.0}
            look = {"fontsize": 8.0, "frameon": False, "labelcolor": "linecolor"}
            axis.legend(**place, **look, handlelength=0.7, columnspacing=0.9)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(trace.time_s[0], trace.time_s[-1])
    return figure


def _limit(curves: list[FloatArray], floor: float) -> float:
    """Half the height of the residual's axes: all of every curve, the noise band too."""
    heights = [float(np.nanmax(np.abs(c))) for c in curves if np.isfinite(c).any()]
    if np.isfinite(floor):
        heights.append(1.3 * _FLOOR_SIGMAS * floor)
    return 1.08 * max(heights, default=1.0) or 1.0
