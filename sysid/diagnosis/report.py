"""Report of a diagnosis, made from the findings alone: what a person reads on the terminal and as one self-contained page.

Both print `summary`: headline, table of entries, what remains, what to measure next. The pictures of the page show
simulation against measurement over time, before and after, and their difference. The page needs jinja2 and matplotlib.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted, finite, table_lines
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    CERTAIN,
    EFFECTIVE,
    INSUFFICIENT,
    NO_GAP,
    ONE_OF,
    SENSOR,
    UNEXPLAINED,
    CandidateEvidence,
    Cause,
    Findings,
    Gap,
    JointName,
    Place,
    Provenance,
    Trace,
    file_values,
    priors,
)
from jtqd.sysid.diagnosis.next_experiment import PLAN_FILE
from jtqd.sysid.planner.experiments import EXPERIMENTS
from jtqd.sysid.report import page
from jtqd.sysid.report.numbers import (
    DASH,
    number,
    pair,
    rounded,
    short,
    unit_name,
    with_interval,
    with_unit,
)
from jtqd.sysid.report.page import LIGHT, page_svg, thinned

BADGES: Final = {
    NO_GAP: ("good", "no gap"),
    CAUSE: ("after", "cause found"),
    AMBIGUOUS: ("warn", "ambiguous"),
    UNEXPLAINED: ("bad", "unexplained"),
    INSUFFICIENT: ("warn", "insufficient data"),
}
"""Colour and text beside the headline."""
BALANCES: Final = {
    "motor": "motor balance (current against torque)",
    "torsion": "torsion (both encoders against torque)",
}
MOST_ROWS: Final = 4
"""Rows of the table; smaller entries that matter are listed below it."""
MOST_INPUTS: Final = 6
"""Inputs whose hash the line of provenance has; all are in findings.json."""
_MOMENTS: Final = {"events": "events that noise does not explain", "seconds": "seconds with a deviating mean"}
"""Lists of moments among the places, by their first word."""
_PROPER: Final = {"coulomb": "Coulomb", "stribeck": "Stribeck"}
_UNIT_ENDING: Final = re.compile(
    r"_(nms_per_rad|nm_per_(rad3|rad|a|s)|per_k_nm|rad_s|kgm2|nm|rad|per_motor_rev|a|s|c)$"
)


class Row(NamedTuple):
    """One entry of the table: place, name in words, the file's value -> the one found, its 95 % interval, share of the gap,
    grade; more: its further parameters.
    """

    place: str
    entry: str
    found: str
    interval: str
    share: str
    grade: str
    more: str = ""


HEADS: Final = Row("place", "entry", "file -> found", "95 % interval", "share", "grade")


class Summary(NamedTuple):
    """All that is shown before the first picture. headline: at most two sentences; lines: texts by their titles, "" where
    there is nothing to state.
    """

    headline: tuple[str, ...]
    notes: tuple[str, ...]
    rows: tuple[Row, ...]
    lines: Mapping[str, str]


def summary(findings: Findings) -> Summary:
    """Return what is shown of findings."""
    causes, small = by_size(findings)
    files = findings.joint_files
    experiment = findings.next_experiment or {}
    reasons = findings.reasons if findings.verdict == UNEXPLAINED else ()
    reasons = findings.reasons[1:] if findings.verdict == INSUFFICIENT else reasons
    lines = {
        "also": ", ".join(f"{_of(c)} {_size(c, files)} ({_grade(c)})" for c in causes[MOST_ROWS:]),
        "too small to matter": ", ".join(f"{_of(c)} {_size(c, files)}" for c in small),
        "grades": _grades(causes, findings),
        "remains": _remains(findings),
        "measure next": _next(str(experiment.get("why", ""))),
        "run it": str(experiment.get("command") or ""),
        "these runs cannot tell": _untold(findings),
    }
    notes = (*map(in_words, reasons), *(f"outlier run: {odd.text}" for odd in findings.outlier_runs))
    return Summary(headline(findings), notes, tuple(_row(c, files) for c in causes[:MOST_ROWS]), lines)


def terminal_lines(findings: Findings) -> list[str]:
    """Return the summary for a terminal."""
    s = summary(findings)
    lines = [f"{findings.verdict}: {' '.join(s.headline)}", *(f"  {note}" for note in s.notes)]
    if s.rows:
        table = [HEADS, *(r._replace(grade=f"{r.grade} ({r.more})" if r.more else r.grade) for r in s.rows)]
        lines += [f"  {line}" for line in table_lines([row[:-1] for row in table], range(6))]
    lines += [text if name == "grades" else f"{name}: {text}" for name, text in s.lines.items() if text]
    lines += [provenance_text(findings.provenance)] if findings.provenance else []
    return [line.replace("\u00a0", " ") for line in lines]


def provenance_text(made: Provenance | None, most: int = MOST_INPUTS) -> str:
    """Return date, version, inputs with the first 12 digits of their sha256, and the command line; "" for None."""
    if made is None:
        return ""
    inputs = [f"{name} {sha256[:12]}" for name, sha256 in made.inputs.items()]
    more = f" and {len(inputs) - most} more" if len(inputs) > most else ""
    return f"{made.date}, jtqd {made.version}, sha256 of {', '.join(inputs[:most])}{more}: {made.command}"


def by_size(findings: Findings) -> tuple[list[Cause], list[Cause]]:
    """Return the entries that matter, by their share, and those too small to matter, by their size."""
    matter = [c for c in findings.causes if c.matters]
    causes = sorted(matter, key=lambda c: -(finite(c.explained_share) or 0.0))
    small = [c for c in (*findings.causes, *findings.too_small) if c not in matter and c.rms_nm > 0.0]
    return causes, sorted(small, key=lambda c: -c.rms_nm)


def headline(findings: Findings) -> tuple[str, ...]:
    """Return the result in at most two sentences, the largest entry first."""
    causes, small = by_size(findings)
    if findings.verdict == INSUFFICIENT:
        first = in_words(findings.reasons[0]) if findings.reasons else ""
        return (f"{_joined(': ', 'These runs are not sufficient to judge the simulation', first)}.",)
    if findings.verdict == NO_GAP:
        limit = f"what remains is below {100.0 * findings.relevance:.2g} % of rated torque"
        number = counted(len(small), "entry", "entries")
        more = f"and {number} {'is' if len(small) == 1 else 'are'} too small to matter" if small else ""
        return (f"The simulation agrees with these runs: {_joined(', ', limit, more)}.",)
    left = findings.unexplained
    rest = f"{short(left.rms_nm)} Nm rms at joint {left.joint}" if left is not None and left.matters else ""
    if not causes:
        where = _joined(", ", rest, _remaining_places(findings, 1)) if rest else ""
        return (f"{_joined(': ', 'No entry explains the gap', where)}.",)
    second = _joined(", but ", _gain(findings), f"{rest} remain unexplained" if rest else "")
    found = _headline_cause(causes[0], findings.joint_files)
    return (found, f"{_capital(second)}.") if second else (found,)


def _headline_cause(cause: Cause, files: Mapping[int, Joint]) -> str:
    """Return the largest entry, its share and size; of several alike that these runs do not distinguish, all of them."""
    names = listed([_of(cause), *(_rival(name, cause.joint) for name in cause.rivals[:2])], "or")
    text = _joined(
        " of ", f"{_capital(names)} explains {_percent(cause.explained_share)}".rstrip(), "the gap"
    )
    size = _size(cause, files)
    if cause.grade != ONE_OF:
        return f"{_joined(': ', text, size)} ({cause.grade})."
    return f"{text} ({size} if it is {entry_title(cause)})." if size else f"{text}."


def _gain(findings: Findings) -> str:
    gain = findings.gain
    if gain is None or not math.isfinite(gain.rmse_before_nm + gain.rmse_after_nm):
        return ""
    before, after = gain.rmse_before_nm, gain.rmse_after_nm
    where = f" at joint {gain.joint}" if len(findings.joints) > 1 and gain.joint else ""
    if after >= before:
        return f"the extended model errs by {short(after)} Nm{where} on held-out runs, no less than the joint file"
    old, new = pair(before, after) if short(before) == short(after) else (short(before), short(after))
    return f"the extended model errs by {new} instead of {old} Nm{where} on held-out runs"


def _row(cause: Cause, files: Mapping[int, Joint]) -> Row:
    found = interval = ""
    more = []
    for name, v in cause.parameters.items():
        if name == cause.leading:
            found, interval = with_interval(v.value, v.ci95, v.unit, in_file(cause, files))
        elif name != "channel":
            size = rounded(v.value, v.unit) if v.fitted else f"{v.value:g} {unit_name(v.unit)}".rstrip()
            more.append(f"{parameter_title(name)} {size}")
    title, share = entry_title(cause), _percent(cause.explained_share)
    return Row(place(cause.joint), title, found, interval, share, _grade(cause), ", ".join(more))


def in_file(cause: Cause, files: Mapping[int, Joint]) -> float | None:
    """Return what the joint file has for the leading parameter, or implies (a gain of 1); None: there is no such value."""
    known = file_values(cause.name, cause.joint, files).get(cause.leading)
    return known.value if known is not None and (known.key or known.value) else None


def _size(cause: Cause, files: Mapping[int, Joint]) -> str:
    """Return the leading parameter of a cause, rounded; "" without a parameter."""
    if not cause.leading:
        return ""
    value = cause.parameters[cause.leading]
    return rounded(value.value, value.unit, in_file(cause, files))


def _percent(share: float) -> str:
    if not share > 0.0:
        return ""
    return "<1 %" if share < 0.005 else f"{100.0 * share:.0f} %"


def _grade(cause: Cause) -> str:
    if cause.grade != ONE_OF:
        return cause.grade
    return f"one of {1 + len(cause.rivals)}: or {', '.join(_rival(n, cause.joint) for n in cause.rivals)}"


def _rival(name: str, joint: JointName) -> str:
    """Return a rival in words: "its torque constant", "sensor offset", "Coulomb friction of joint 2"."""
    title, _, where = name.partition(" of ")
    words = effect_title(title)
    if where:
        return words if where.endswith(SENSOR) and words.startswith("sensor") else f"{words} of {where}"
    return words if joint == SENSOR else f"its {words}"


def _grades(causes: Sequence[Cause], findings: Findings) -> str:
    """Return what the grades in the table mean, and the priors that a certain entry rests on."""
    sure = [c for c in causes if c.grade == CERTAIN]
    doubtful = next((c for c in causes if c.grade == EFFECTIVE), None)
    texts = []
    if sure:
        given = _priors_behind(sure, findings)
        texts.append(f"certain: given {given}" if given else "certain: no other set is nearly as good")
    if any(c.grade == ONE_OF for c in causes):
        texts.append("one of: these runs do not distinguish them")
    if doubtful is not None:
        why = f" ({entry_title(doubtful)}: {doubtful.doubts[0]})" if doubtful.doubts else ""
        texts.append(f"effective: predicts, but what it stands for is not settled{why}")
    return f"{'; '.join(texts)}." if texts else ""


def _priors_behind(causes: Sequence[Cause], findings: Findings) -> str:
    """Return the priors of these entries, and of all effects that would scale the same balance, by their sizes."""
    names = [c.name for c in causes]
    for c in causes:
        scaling = [e.name for e in EFFECTS.values() if e.scales_all or e.scales_balance == c.balance]
        names += scaling if c.name in scaling else []
    absent = {c.name for c in findings.candidates if math.isnan(c.delta_bic)}  # of a sensor that is none
    rows = {row.name: row for row in priors(findings.trust) if row.name not in absent}
    sizes: dict[str, list[str]] = {}
    for row in (rows[name] for name in dict.fromkeys(names) if name in rows):
        sizes.setdefault(f"{row.size}{' (as set)' if row.set_by_user else ''}", []).append(
            effect_title(row.name)
        )
    return ", ".join(f"{listed(of)} ± {size}" for size, of in sizes.items())


def _next(why: str) -> str:
    """Return the kinds of motion that an experiment has, and the first of its reasons."""
    kinds = [kind.replace("_", " ") for kind in EXPERIMENTS if f"{kind}: " in why]
    reason, _, more = why.partition(". ")[0].rstrip(".").partition("; ")
    others = f", and {1 + more.count('; ')} more" if more else ""
    first = f"{in_words(reason)}{others}"
    return f"{listed(kinds)}, because {first}" if kinds else first


def _remains(findings: Findings) -> str:
    left = findings.unexplained
    if left is None or (findings.verdict == NO_GAP and not left.rms_nm):
        return ""
    if not left.rms_nm:
        return "no structure beyond noise and run-to-run variation"
    size = f"{short(left.rms_nm)} Nm rms ({left.percent_of_rated:.2g} % of rated) at joint {left.joint}"
    what = _joined(
        ", ", size, f"{left.balance} balance", _remaining_places(findings, 2) if left.matters else ""
    )
    return f"{what}; it {'matters' if left.matters else 'would matter'} from {short(left.relevant_nm)} Nm"


def _remaining_places(findings: Findings, most: int) -> str:
    """Return the largest places of the residual that remains."""
    left = findings.unexplained
    gaps = (g for g in findings.gaps if left and (g.joint, g.balance) == (left.joint, left.balance))
    return next((places(gap, most) for gap in gaps), "")


def places(gap: Gap, most: int) -> str:
    """Return the largest places of a gap."""
    return ", ".join(f"{_percent(p.share)} of it {where(p)}" for p in gap.localisation[:most])


def _untold(findings: Findings) -> str:
    """Return what these runs cannot tell, by the motion that would, or the channel that lacks."""
    motions: dict[str, dict[str, list[JointName]]] = {}
    for each in findings.cannot_be_told:
        needed = f"would take {each.experiment.replace('_', ' ')}" if each.experiment else each.why
        motions.setdefault(needed, {}).setdefault(each.name, []).append(each.joint)
    many = len(findings.joints) > 1
    return "; ".join(
        f"{', '.join(_named(name, joints, many) for name, joints in names.items())} ({needed})"
        for needed, names in motions.items()
    )


def _named(name: str, joints: Iterable[JointName], many: bool) -> str:
    """Return "lost motion of joints 1 and 2"; without the joints where there is one, or where it is the sensor's."""
    numbers = sorted({j for j in joints if isinstance(j, int)})
    return _joined(" of ", effect_title(name), joints_text(numbers) if many else "")


def joints_text(numbers: Sequence[int]) -> str:
    """Return "joint 1" or "joints 1 and 2", "" for none."""
    return f"joint{'s' if len(numbers) > 1 else ''} {listed([str(n) for n in numbers])}" if numbers else ""


def effect_title(name: str) -> str:
    """Return the name of an effect in words: "stribeck_friction" is "Stribeck friction"."""
    return " ".join(_PROPER.get(word, word) for word in name.split("_"))


def entry_title(cause: Cause) -> str:
    """Return an entry in words: of an effect with a value of the file, this value where nothing else of it was found."""
    values = [p.name for p in EFFECTS[cause.name].parameters if p.key]
    others = {p.name for p in EFFECTS[cause.name].parameters if not p.key}
    only = values and others and not any(cause.parameters[n].fitted for n in others & {*cause.parameters})
    return parameter_title(values[0]) if only else effect_title(cause.name)


def parameter_title(name: str) -> str:
    """Return the name of a parameter in words, without its unit: "amplitude_nm" is "amplitude"."""
    return effect_title(_UNIT_ENDING.sub("", name))


def in_words(text: str) -> str:
    """Return a text with names of effects, experiments and grades as words: "link_inertia" is "link inertia"."""
    names = {*EFFECTS, *EXPERIMENTS, ONE_OF}
    return " ".join(effect_title(w) if w.strip(",;:.()") in names else w for w in text.split())


def place(joint: JointName) -> str:
    """Return where an effect is: "joint 1" or "torque sensor"."""
    return "torque sensor" if joint == SENSOR else f"joint {joint}"


def _of(cause: Cause) -> str:
    """Return effect and place: "torque ripple of joint 1", "sensor gain"."""
    title = entry_title(cause)
    if cause.joint == SENSOR:
        return title if title.startswith(SENSOR) else f"{title} of the torque sensor"
    return f"{title} of {place(cause.joint)}"


def listed(items: Sequence[str], word: str = "and") -> str:
    """Return "a", "a and b", "a, b and c"."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {word} {items[-1]}"


def _joined(between: str, *texts: str) -> str:
    """Return the texts that are not empty, with something between them."""
    return between.join(filter(None, texts))


def _capital(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"


def bin_name(bin_: Place) -> str:
    """Return the name of a bin as it is written."""
    return bin_.bin.replace(bin_.unit, unit_name(bin_.unit)) if bin_.unit else bin_.bin


def where(place_: Place) -> str:
    """Return a place with its preposition: "at velocity 0 to 0.1 rad/s", "in bursts, ...", "in a line at order 3.57 ..."."""
    what, _, moments = place_.bin.partition(":")
    if what in _MOMENTS:
        return f"in {_MOMENTS[what]}, the strongest {moments.split(',')[0].strip()}"
    if place_.bin.startswith("order"):
        return f"in a line at {bin_name(place_)}"
    return f"at {place_.axis.replace('_', ' ')} {bin_name(place_)}"


# The page.

TEMPLATE: Final = "report.html.j2"
_SUMMARY: Final = "summary.html.j2"
WIDE_IN: Final = 9.2
_HIGH_IN: Final = 2.6
"""Size of a figure and of a panel [inch]."""
_BUCKETS: Final = 360
"""Parts of a curve, each drawn by its extremes."""
_FLOOR_SIGMAS: Final = 2.0
"""Half width of the band of noise, in standard deviations."""
_TITLE: Final[dict[str, Any]] = {"loc": "right", "fontsize": 8.0, "color": LIGHT["soft"], "pad": 3.0}
_TORQUE: Final = {"motor": "motor torque G Kt i", "torsion": "torque by the twist"}


def render(findings: Findings) -> str:
    """Return the page. The same findings give the same text. Needs jinja2 and matplotlib (ImportError without them)."""
    content = {
        **_head(findings, whole=True),
        "made": provenance_text(findings.provenance, most=len(findings.runs) + 8),
        "picture": picture(findings),
        "gaps": [(gap, places(gap, most=3)) for gap in findings.gaps],
        "looked_at": [candidate_row(each) for each in findings.candidates],
        "priors": priors(findings.trust),
        "gains": {each.run: each for each in findings.gain.runs} if findings.gain else {},
        "next": findings.next_experiment,
        "plan_file": PLAN_FILE,
    }
    filters: dict[str, Callable[..., str]] = {
        "number": number,
        "effect_title": effect_title,
        "in_words": in_words,
        "capital": _capital,
    }
    return page.render("jtqd.sysid.diagnosis", TEMPLATE, content, filters)


def summary_html(findings: Findings) -> str:
    """Return the first part of the page alone: headline, table of entries, lines. Raises ImportError without jinja2."""
    return page.render("jtqd.sysid.diagnosis", _SUMMARY, _head(findings, whole=False))


def _head(findings: Findings, *, whole: bool) -> dict[str, Any]:
    """Return what the summary shows; whole: the page is around it."""
    scope = ", ".join(filter(None, (findings.runs_text, joints_text(findings.joints))))
    badge = BADGES[findings.verdict]
    return {"f": findings, "badge": badge, "scope": scope, "s": summary(findings), "whole": whole}


def candidate_row(each: CandidateEvidence) -> tuple[str, str, str, str]:
    """Return name, place, why it is or is not in the set, and the smallest size that would be."""
    texts = []
    for name, value in each.minimum.items():
        if math.isfinite(value.value) and value.value > 0.0:
            size = with_unit(value.value, value.unit, 2)
            texts.append(size if len(each.minimum) == 1 else f"{size} {parameter_title(name)}")
    return effect_title(each.name), place(each.joint), in_words(each.reason), ", ".join(texts) or DASH


class Picture(NamedTuple):
    """A trace as SVG; text: its alternative text."""

    title: str
    text: str
    svg: str


def worst_trace(findings: Findings) -> tuple[Trace, bool] | None:
    """Return the trace to draw, and whether its run was held out; None without traces.

    It is of the balance that the gain is of (without one, of the largest gap), and of the run on which the extended model
    errs most there; where no run was held out, the joint file.
    """
    gain = findings.gain
    of = [gain] if gain else findings.gaps[:1]
    shown = [t for t in findings.traces if (t.joint, t.balance) in [(x.joint, x.balance) for x in of]]
    errors = {each.run: each.rmse_after_nm for each in gain.runs} if gain else {}
    worst = max(shown, key=lambda t: (errors.get(t.run, 0.0), float(np.nansum(t.before_nm**2))), default=None)
    return None if worst is None else (worst, worst.run in errors)


def picture(findings: Findings) -> Picture | None:
    """Return the figure of the worst run, None without traces. Raises ImportError without matplotlib."""
    found = worst_trace(findings)
    if found is None:
        return None
    trace, held_out = found
    floors = {(g.joint, g.balance): g.noise_floor_nm for g in findings.gaps}
    sides = [("before", "simulation as it is", trace.before_nm)]
    if findings.causes or findings.too_small:
        sides.append(("after", "with the entries found", trace.after_nm))
    title = f"{trace.run}, joint {trace.joint}, {BALANCES[trace.balance]}"
    errors = ", ".join(f"{number(rms(rest))} Nm rms {name}" for _, name, rest in sides)
    text = (
        f"Measured and simulated torque of {title}, over {number(trace.time_s[-1])} s; difference: {errors}"
    )
    floor = floors.get((trace.joint, trace.balance), math.nan)
    svg = page_svg(partial(_figure, trace, sides, floor), "p")
    return Picture(f"{title}{': the worst held-out run' if held_out else ''}", text, svg)


def rms(x: FloatArray) -> float:
    """Root mean square without NaN; NaN for nothing."""
    good = np.isfinite(x)
    return float(np.sqrt(np.mean(np.square(x[good])))) if good.any() else math.nan


def _figure(trace: Trace, sides: Sequence[tuple[str, str, FloatArray]], floor: float) -> Any:
    """Panels over time: measured against simulated torque, one per side (role, title, measured less simulated [n]); the
    differences, with a band of two standard deviations of the noise; velocity.
    """
    from matplotlib import pyplot as plt

    ratios = [_HIGH_IN] * (len(sides) + 1) + [0.4 * _HIGH_IN]
    size = (WIDE_IN, 0.9 + 0.48 * sum(ratios))
    figure, axes = plt.subplots(
        len(ratios), 1, sharex=True, figsize=size, height_ratios=ratios, layout="constrained"
    )
    *torques, difference, velocity = axes

    def curve(axis: Any, values: FloatArray, role: str, label: str) -> None:
        points = thinned(trace.time_s, values, _BUCKETS)
        (line,) = axis.plot(*points, color=LIGHT[role], linewidth=0.8, label=label)
        line.set_gid(f"{role}_{list(axes).index(axis)}")

    for axis, (role, title, rest) in zip(torques, sides, strict=True):
        curve(axis, trace.measured_nm, "ink", "measured")
        curve(axis, trace.measured_nm - rest, role, title)
        axis.set_title(_TORQUE[trace.balance], **_TITLE)
        curve(difference, rest, role, f"{title}: {number(rms(rest))} Nm rms")
    band = _FLOOR_SIGMAS * floor
    if math.isfinite(band):
        difference.axhspan(-band, band, color=LIGHT["noise"], linewidth=0.0, zorder=0)
    difference.set_title("measured less simulated", **_TITLE)
    curve(velocity, trace.velocity_rad_s, "soft", "velocity")
    velocity.set_title("velocity", **_TITLE)
    velocity.set(ylabel="[rad/s]", xlabel="time [s]", xlim=(trace.time_s[0], trace.time_s[-1]))
    for axis in (*torques, difference):
        axis.set_ylabel("[Nm]")
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.0}
        axis.legend(**place, ncols=2, fontsize=8.0, frameon=False, labelcolor="linecolor")
    return figure
