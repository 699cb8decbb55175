"""Render findings as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import yaml

from jtqd.estimator.effects.effect import Effect
from jtqd.estimator.errors import ConfigError
from jtqd.sysid.diagnosis.findings import AMBIGUOUS, CAUSE, INSUFFICIENT, UNEXPLAINED, Findings
from jtqd.sysid.diagnosis.next_experiment import MOTION_FILE, PLAN_FILE, campaign_command, joint_motion_file
from jtqd.sysid.diagnosis.report import views
from jtqd.sysid.diagnosis.report.pictures import pictures, trace_rows
from jtqd.sysid.diagnosis.report.views import gap_views
from jtqd.sysid.diagnosis.report.words import BADGES, gain_sentence, listed, verdict_sentence
from jtqd.sysid.report import page
from jtqd.sysid.report.numbers import number

TEMPLATE: Final = "report.html.j2"


def render(findings: Findings, made: str = "", effects: Mapping[str, Effect] | None = None) -> str:
    """Return the page. The same findings give the same text.

    Args:
        findings: all that is shown.
        made: when and by what, one line for the foot of the page.
        effects: the library, for equations and tell-tales; default: the one that ships.

    Needs jinja2 and matplotlib (ImportError without them).
    """
    colour, badge = BADGES[findings.verdict]
    drawn = pictures(findings)
    evidence = views.evidence_views(findings.candidates)
    content = {
        "f": findings,
        "made": made,
        "badge": badge,
        "badge_colour": colour,
        "sentence": verdict_sentence(findings),
        "gain_sentence": gain_sentence(findings),
        "scope": _scope(findings),
        "has_gap": findings.verdict in {CAUSE, AMBIGUOUS, UNEXPLAINED},
        "reasons_first": findings.verdict in {UNEXPLAINED, INSUFFICIENT},
        "causes": views.cause_views(findings, library() if effects is None else effects),
        "gaps": gap_views(findings.gaps),
        "left": views.left_view(findings),
        "evidence": evidence,
        "shown": max(views.SHOWN, sum(1 for row in evidence if row.state)),
        "gains": views.gain_views(findings.gain),
        "reasons": [views.reason_in_words(each) for each in findings.reasons],
        "pictures": drawn,
        "closed": sum(1 for each in drawn if not each.opened),
        "traces": trace_rows(findings),
        "next": _next(findings),
    }
    return page.render("jtqd.sysid.diagnosis.report", TEMPLATE, content)


def library() -> Mapping[str, Effect]:
    """Return the effects that ship, by name."""
    from jtqd.estimator.effects import EFFECTS

    return EFFECTS


def _scope(findings: Findings) -> str:
    """Return what was looked at, e.g. "6 runs, joints 1 and 2"."""
    runs = findings.runs_text
    if not findings.joints:
        return runs
    names = listed([str(j) for j in findings.joints])
    return f"{runs}, joint{'s' if len(findings.joints) > 1 else ''} {names}"


def _next(findings: Findings) -> dict[str, Any] | None:
    """Why, the plan as YAML, and what it amounts to."""
    if findings.next_experiment is None:
        return None
    plan = findings.next_experiment.get("plan")
    made = _motions(findings.next_experiment)
    return {
        "why": findings.next_experiment["why"],
        "file": PLAN_FILE,
        "command": findings.next_experiment.get("command") or campaign_command(),
        "motions": [(file, _runs_of(motion)) for file, motion in made],
        "amount": plan_amount(plan)
        if plan is not None
        else _runs_text([run["duration_s"] for _, motion in made for run in motion["runs"]]),
        "yaml": "" if plan is None else yaml.safe_dump(plan, sort_keys=False, allow_unicode=True),
    }


def _motions(experiment: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """File and content of every motion of a joint alone."""
    found = [(MOTION_FILE, experiment.get("motion"))]
    found += [(joint_motion_file(each["joint"]), each["motion"]) for each in experiment.get("joints", ())]
    return [(file, motion) for file, motion in found if motion]


def _runs_of(motion: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, what is done beside it, and length of every run of one joint."""
    return [(run["name"], run["what"], f"{number(run['duration_s'])} s") for run in motion["runs"]]


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
