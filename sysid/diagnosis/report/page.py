"""Render findings as one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings, Gap, Place, priors
from jtqd.sysid.diagnosis.next_experiment import MOTION_FILE, PLAN_FILE, campaign_command, joint_motion_file
from jtqd.sysid.diagnosis.report.pictures import pictures
from jtqd.sysid.diagnosis.report.words import (
    BADGES,
    balance_title,
    bin_name,
    effect_title,
    in_words,
    listed,
    parameter_title,
    place,
    provenance_text,
    summary,
)
from jtqd.sysid.report import page
from jtqd.sysid.report.numbers import DASH, number, percent, unit_name, with_unit

TEMPLATE: Final = "report.html.j2"
_HOT: Final = 2.0
"""A bin with this many times its even share of the gap is marked."""
_EVEN: Final = 1.5
"""An axis without a bin above this many even shares is not shown."""


def render(findings: Findings) -> str:
    """Return the page. The same findings give the same text. Needs jinja2 and matplotlib (ImportError without them)."""
    colour, badge = BADGES[findings.verdict]
    content = {
        "f": findings,
        "made": provenance_text(findings.provenance, most=len(findings.runs) + 8),
        "badge": badge,
        "badge_colour": colour,
        "scope": _scope(findings),
        "s": summary(findings),
        "looked_at": [candidate_row(each) for each in findings.candidates],
        "gaps": [
            (
                f"Joint {gap.joint}, {balance_title(gap.balance)}: {number(gap.rmse_nm)} Nm rms, noise "
                f"{number(gap.noise_floor_nm)} Nm (from {gap.floor_from})",
                gap_axes(gap),
            )
            for gap in findings.gaps
        ],
        "priors": [(effect_title(p.name), p.size, p.set_by_user) for p in priors(findings.trust)],
        "runs": _run_rows(findings),
        "pictures": pictures(findings),
        "next": _next(findings),
    }
    return page.render("jtqd.sysid.diagnosis.report", TEMPLATE, content)


def _scope(findings: Findings) -> str:
    """Return what was looked at, e.g. "6 runs, joints 1 and 2"."""
    if not findings.joints:
        return findings.runs_text
    names = listed([str(j) for j in findings.joints])
    return f"{findings.runs_text}, joint{'s' if len(findings.joints) > 1 else ''} {names}"


def candidate_row(each: CandidateEvidence) -> tuple[str, str, str, str]:
    """Return name, place, why it is or is not in the set, and the smallest size that would be."""
    texts = []
    for name, value in each.minimum.items():
        if math.isfinite(value.value) and value.value > 0.0:
            size = with_unit(value.value, value.unit, 2)
            texts.append(size if len(each.minimum) == 1 else f"{size} {parameter_title(name)}")
    return effect_title(each.name), place(each.joint), in_words(each.reason), ", ".join(texts) or DASH


def _run_rows(findings: Findings) -> list[tuple[str, str, str, str]]:
    """Return every run: name, whether it was used, held-out error before and after ("" where it was not measured)."""
    gains = {g.run: g for g in findings.gain.runs} if findings.gain else {}
    rows = []
    for name in findings.runs:
        gain = gains.get(name)
        errors = (number(gain.rmse_before_nm), number(gain.rmse_after_nm)) if gain else ("", "")
        rows.append((name, "" if name in findings.used_runs else "not used", *errors))
    return rows


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
    """Why, the plan as YAML, and what it amounts to."""
    experiment = findings.next_experiment
    if experiment is None:
        return None
    plan = experiment.get("plan")
    made = [(MOTION_FILE, experiment.get("motion"))]
    made += [(joint_motion_file(each["joint"]), each["motion"]) for each in experiment.get("joints", ())]
    motions = [(file, motion["runs"]) for file, motion in made if motion]
    seconds = [run["duration_s"] for _, runs in motions for run in runs]
    return {
        "why": in_words(experiment["why"]),
        "file": PLAN_FILE,
        "command": experiment.get("command") or campaign_command(),
        "motions": [
            (file, [(run["name"], run["what"], f"{number(run['duration_s'])} s") for run in runs])
            for file, runs in motions
        ],
        "amount": plan_amount(plan) if plan is not None else _runs_text(seconds),
        "yaml": "" if plan is None else yaml.safe_dump(plan, sort_keys=False, allow_unicode=True),
    }


def plan_amount(plan: Mapping[str, Any]) -> str:
    """Return how long a plan is, e.g. "4 runs, 12 minutes of motion"; "" for one that `jtq campaign` would refuse."""
    from jtqd.sysid.planner.plan import Plan

    try:
        runs = Plan.from_mapping(dict(plan), PLAN_FILE).runs
    except ConfigError:
        return ""
    return _runs_text([run.duration_s for run in runs])


def _runs_text(durations_s: Sequence[float]) -> str:
    if not durations_s:
        return ""
    seconds, count = sum(durations_s), len(durations_s)
    length = f"{number(seconds)} s" if seconds < 120.0 else f"{number(seconds / 60.0, 2)} minutes"
    return f"{count} run{'s' if count > 1 else ''}, {length} of motion"
