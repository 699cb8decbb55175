"""What a person reads of a diagnosis: headline, table of entries, what remains, what to measure next; report and terminal
alike print `summary`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted
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
    Cause,
    FileValue,
    Findings,
    JointName,
    Place,
    Provenance,
    Value,
    file_values,
    priors,
)
from jtqd.sysid.planner.experiments import EXPERIMENTS
from jtqd.sysid.report.numbers import unit_name

BADGES: Final = {
    NO_GAP: ("good", "no gap"),
    CAUSE: ("after", "cause found"),
    AMBIGUOUS: ("warn", "ambiguous"),
    UNEXPLAINED: ("bad", "unexplained"),
    INSUFFICIENT: ("warn", "insufficient data"),
}
"""Colour and text beside the headline."""
BALANCES: Final = {
    "motor": "motor balance (current against sensor)",
    "torsion": "torsion (both encoders against sensor)",
}
MOST_ROWS: Final = 4
"""Rows of the table; smaller entries that matter are listed below it."""
MOST_INPUTS: Final = 6
"""Inputs whose hash the line of provenance has; all are in findings.json."""
_MOMENTS: Final = {"events": "events that noise does not explain", "seconds": "seconds with a deviating mean"}
"""Lists of moments among the places, by their first word."""
_PROPER: Final = {"coulomb": "Coulomb", "stribeck": "Stribeck"}
_UNIT_ENDINGS: Final = (
    *("_nms_per_rad", "_nm_per_rad3", "_nm_per_rad", "_nm_per_a", "_nm_per_s", "_per_k_nm", "_rad_s"),
    *("_kgm2", "_nm", "_rad", "_per_motor_rev", "_a", "_s", "_c"),
)
_PREFIXED: Final = ("rad", "s", "A")
_ALIKE: Final = {
    "torque_constant": "sensor_gain",
    "load_dependent_friction": "torque_constant",
    "sensor_gain": "torque_constant",
}
"""Entries that runs with little variation distinguish by their priors: the other's prior is stated beside a certain one."""


@dataclass(frozen=True)
class Row:
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


@dataclass(frozen=True)
class Summary:
    """All that is shown before the first picture. headline: at most two sentences; also: entries that have no row; small:
    those too small to matter; foot: what grades rest on; texts are "" where there is nothing to state.
    """

    headline: tuple[str, ...]
    notes: tuple[str, ...]
    rows: tuple[Row, ...]
    also: str
    small: str
    foot: str
    remains: str
    next: str
    command: str
    untold: str


def summary(findings: Findings) -> Summary:
    """Return what is shown of findings."""
    causes, small = by_size(findings)
    files = findings.joint_files
    experiment = findings.next_experiment or {}
    reasons = findings.reasons if findings.verdict == UNEXPLAINED else ()
    reasons = findings.reasons[1:] if findings.verdict == INSUFFICIENT else reasons
    return Summary(
        headline(findings),
        (*map(in_words, reasons), *(f"outlier run: {odd.text}" for odd in findings.outlier_runs)),
        tuple(_row(c, files) for c in causes[:MOST_ROWS]),
        ", ".join(f"{_of(c)} {_sized(c, files)} ({_grade(c)})" for c in causes[MOST_ROWS:]),
        ", ".join(f"{_of(c)} {_sized(c, files)}" for c in small),
        _foot(causes, findings),
        _remains(findings),
        _next(str(experiment.get("why", ""))),
        str(experiment.get("command") or ""),
        _untold(findings),
    )


def terminal_lines(findings: Findings) -> list[str]:
    """Return the summary for a terminal."""
    s = summary(findings)
    lines = [f"{findings.verdict}: {' '.join(s.headline)}", *(f"  {note}" for note in s.notes)]
    table = [("place", "entry", "file -> found", "95 % interval", "share", "grade")]
    for r in s.rows:
        grade = f"{r.grade} ({r.more})" if r.more else r.grade
        table.append((r.place, r.entry, r.found, r.interval, r.share, grade))
    wide = [max(len(row[k]) for row in table) for k in range(5)]
    if s.rows:
        cells = ([c.ljust(w) for c, w in zip(row, [*wide, 0], strict=True)] for row in table)
        lines += [f"  {'  '.join(row)}".rstrip() for row in cells]
    named = (
        ("also", s.also),
        ("too small to matter", s.small),
        ("", s.foot),
        ("remains", s.remains),
        ("measure next", s.next),
        ("run it", s.command),
        ("these runs cannot tell", s.untold),
        ("", provenance_text(findings.provenance)),
    )
    lines += [f"{name}: {text}" if name else text for name, text in named if text]
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
    causes = sorted((c for c in findings.causes if c.matters), key=lambda c: -_share(c))
    small = [*(c for c in findings.causes if not c.matters), *findings.too_small]
    return causes, sorted(small, key=lambda c: -c.rms_nm)


def headline(findings: Findings) -> tuple[str, ...]:
    """Return the result in at most two sentences, the largest entry first."""
    causes, small = by_size(findings)
    left = findings.unexplained
    if findings.verdict == INSUFFICIENT:
        first = f": {in_words(findings.reasons[0])}" if findings.reasons else ""
        return (f"These runs are not sufficient to judge the simulation{first}.",)
    if findings.verdict == NO_GAP:
        count, limit = len(small), f"what remains is below {100.0 * findings.relevance:.2g} % of rated torque"
        more = (
            f", and {counted(count, 'entry', 'entries')} {'is' if count == 1 else 'are'} too small to matter"
        )
        return (f"The simulation agrees with these runs: {limit}{more if count else ''}.",)
    rest = "" if left is None or not left.matters else f"{short(left.rms_nm)} Nm rms"
    if not causes:
        where = _places(findings, 1)
        size = f": {rest} at joint {left.joint}{f', {where}' if where else ''}" if rest and left else ""
        return (f"No entry explains the gap{size}.",)
    gain = _gain(findings)
    if rest and left is not None:
        gain += f"{', but ' if gain else ''}{rest} at joint {left.joint} remain unexplained"
    found = _headline_causes(causes, findings.joint_files)
    return (found, *([f"{gain[0].upper()}{gain[1:]}."] if gain else []))


def _headline_causes(causes: Sequence[Cause], files: Mapping[int, Joint]) -> str:
    first = causes[0]
    share = _percent(_share(first))
    names = listed([_of(first), *(_rival(name, first.joint) for name in first.rivals[:2])], "or")
    value = _sized(first, files)
    if first.grade == ONE_OF:
        grade = f" ({value} if it is {effect_title(first.name)})" if value else ""
    else:
        grade = f"{f': {value}' if value else ''} ({first.grade})"
    text = f"{names[0].upper()}{names[1:]} explains {f'{share} of ' if share else ''}the gap{grade}"
    if len(causes) > 1:
        second, more = causes[1], len(causes) - 2
        text += f"; {' '.join(filter(None, (_of(second), _percent(_share(second)))))} ({_grade(second)})"
        text += f" and {counted(more, 'smaller entry', 'smaller entries')}" if more else ""
    return f"{text}."


def _gain(findings: Findings) -> str:
    gain = findings.gain
    if gain is None or not math.isfinite(gain.rmse_before_nm + gain.rmse_after_nm):
        return ""
    before, after = gain.rmse_before_nm, gain.rmse_after_nm
    if after < before:
        old, new = short(before), short(after)
        old, new = (old, new) if old != new else _pair(before, after)
        return f"the extended model errs by {new} instead of {old} Nm on held-out runs"
    return f"the extended model errs by {short(after)} Nm on held-out runs, no less than the joint file"


def _row(cause: Cause, files: Mapping[int, Joint]) -> Row:
    lead, known = leading(cause, files)
    found = interval = ""
    if lead:
        old, new, interval, unit = quantity(cause.parameters[lead], known)
        found = f"{f'{old} -> ' if old else ''}{new} {unit}".rstrip()
    rest = (
        f"{parameter_title(name)} {_plain(value)}"
        for name, value in cause.parameters.items()
        if name not in {lead, "channel"}
    )
    return Row(
        place(cause.joint),
        effect_title(cause.name),
        found,
        interval,
        _percent(_share(cause)),
        _grade(cause),
        ", ".join(rest),
    )


def leading(cause: Cause, files: Mapping[int, Joint]) -> tuple[str, FileValue | None]:
    """Return the parameter that stands for a cause, the first that is fitted, and what the joint file has ("": none)."""
    fitted = [n for n, v in cause.parameters.items() if v.ci95[0] != v.ci95[1]] or list(cause.parameters)
    if not fitted:
        return "", None
    return fitted[0], file_values(cause.name, cause.joint, files).get(fitted[0])


def quantity(value: Value, known: FileValue | None) -> tuple[str, str, str, str]:
    """Return the file's value, the one found, its interval and the unit: all with one power of ten and as many places, by
    two digits of half the interval's width. "" for what there is not.
    """
    old = _in_file(known)
    low, high = value.ci95
    ends = [low, high] if math.isfinite(low + high) and high > low else []
    factor, unit, power = _scale(value.unit, max(abs(x) for x in (value.value, *ends, old or 0.0)))
    half = 0.5 * (high - low) * factor if ends else 0.0
    places = 1 - _order(half) if half else 2 - _order(value.value * factor)
    least = 0.5 * 10.0**-places if half else 0.0
    texts = [_at(x * factor if abs(x * factor) > least else 0.0, places, power) for x in (value.value, *ends)]
    before = "" if old is None else _at(old * factor, places, power)
    return before, texts[0], f"[{texts[1]}, {texts[2]}]" if ends else "", unit


def _in_file(known: FileValue | None) -> float | None:
    """Return the value that the joint file has, or that it implies (a gain of 1); None for one that is not there."""
    return known.value if known is not None and (known.key or known.value) else None


def _scale(unit: str, size: float) -> tuple[float, str, str]:
    """Return factor, unit and power of ten, as text, of a handy number."""
    if unit in _PREFIXED and 0.0 < size < 0.1:
        return (1e6, f"µ{unit}", "") if size < 1e-3 else (1e3, f"m{unit}", "")
    if size and not 1e-3 <= size < 1e5:
        return 10.0 ** -_order(size), unit_name(unit), f"e{_order(size):+03d}"
    return 1.0, unit_name(unit), ""


def _at(x: float, places: int, power: str) -> str:
    """Return x with decimal places; one digit at least of what is not zero."""
    if x and abs(x) < 0.5 * 10.0 ** -max(places, 0):
        places = -_order(x)
    return f"{x:.{min(max(places, 0), 9)}f}{power}" if x else "0"


def _order(x: float) -> int:
    return math.floor(math.log10(abs(x)) + 1e-9) if x else 0


def short(x: float) -> str:
    """Return x with two digits."""
    return _at(x, 1 - _order(x), "") if math.isfinite(x) else "-"


def _pair(old: float, new: float, power: str = "") -> tuple[str, str]:
    """Return two values with as many places as it takes to see the difference."""
    apart = -_order(new - old) if new != old else 0
    places = max(1 - _order(max(abs(old), abs(new))), apart)
    return _at(old, places, power), _at(new, places, power)


def _sized(cause: Cause, files: Mapping[int, Joint]) -> str:
    """Return "4.0 -> 5.3 Nm", or what was found where the file has no such value."""
    lead, known = leading(cause, files)
    if not lead:
        return ""
    value = cause.parameters[lead]
    old = _in_file(known)
    factor, unit, power = _scale(value.unit, max(abs(value.value), abs(old or 0.0)))
    new = value.value * factor
    if old is None:
        return f"{_at(new, 1 - _order(new), power)} {unit}".rstrip()
    before, after = _pair(old * factor, new, power)
    return f"{before} -> {after} {unit}".rstrip()


def _plain(value: Value) -> str:
    factor, unit, power = _scale(value.unit, abs(value.value))
    fitted = value.ci95[0] != value.ci95[1]
    number = (
        _at(value.value * factor, 1 - _order(value.value * factor), power) if fitted else f"{value.value:g}"
    )
    return f"{number} {unit if fitted else unit_name(value.unit)}".rstrip()


def _share(cause: Cause) -> float:
    return cause.explained_share if math.isfinite(cause.explained_share) else 0.0


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


def _foot(causes: Sequence[Cause], findings: Findings) -> str:
    """Return what the grades in the table mean, and the priors that a certain entry rests on."""
    grades = {c.grade for c in causes}
    texts = []
    if CERTAIN in grades:
        sure = [c.name for c in causes if c.grade == CERTAIN]
        names = dict.fromkeys([*sure, *(_ALIKE[n] for n in sure if n in _ALIKE)])
        rows = {row.name: row for row in priors(findings.trust)}
        sizes: dict[str, list[str]] = {}
        for row in (rows[n] for n in names if n in rows):
            sizes.setdefault(f"{row.size}{' (as set)' if row.set_by_user else ''}", []).append(
                effect_title(row.name)
            )
        given = ", ".join(f"{listed(of)} ± {size}" for size, of in sizes.items())
        texts.append(f"certain: given {given}" if given else "certain: no other set is nearly as good")
    if ONE_OF in grades:
        texts.append("one of: these runs do not distinguish them")
    if EFFECTIVE in grades:
        texts.append("effective: predicts, but what it stands for is not settled")
    return f"{'; '.join(texts)}." if texts else ""


def _next(why: str) -> str:
    """Return the kinds of motion that an experiment has, and the first sentence of its reason."""
    kinds = [kind.replace("_", " ") for kind in EXPERIMENTS if f"{kind}: " in why]
    first = in_words(why.partition(". ")[0].rstrip("."))
    return f"{listed(kinds)}, because {first}" if kinds else first


def _remains(findings: Findings) -> str:
    left = findings.unexplained
    if left is None or (findings.verdict == NO_GAP and not left.rms_nm):
        return ""
    if not left.rms_nm:
        return "no structure beyond noise and run-to-run variation"
    where = _places(findings) if left.matters else ""
    return (
        f"{short(left.rms_nm)} Nm rms ({left.percent_of_rated:.2g} % of rated) at joint {left.joint}, {left.balance} balance"
        f"{f', {where}' if where else ''}; it {'matters' if left.matters else 'would matter'} from "
        f"{short(left.relevant_nm)} Nm"
    )


def _places(findings: Findings, most: int = 2) -> str:
    """Return the largest places of the residual that remains."""
    left = findings.unexplained
    gaps = [
        g for g in findings.gaps if left is not None and (g.joint, g.balance) == (left.joint, left.balance)
    ]
    return ", ".join(f"{_percent(p.share)} of it {where(p)}" for g in gaps[:1] for p in g.localisation[:most])


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
    numbers = [str(n) for n in sorted({j for j in joints if isinstance(j, int)})]
    title = effect_title(name)
    if not many or not numbers:
        return title
    return f"{title} of joint{'s' if len(numbers) > 1 else ''} {listed(numbers)}"


def effect_title(name: str) -> str:
    """Return the name of an effect in words: "stribeck_friction" is "Stribeck friction"."""
    return " ".join(_PROPER.get(word, word) for word in name.split("_"))


def parameter_title(name: str) -> str:
    """Return the name of a parameter in words, without its unit: "amplitude_nm" is "amplitude"."""
    for ending in _UNIT_ENDINGS:
        if name.endswith(ending) and len(name) > len(ending):
            return effect_title(name.removesuffix(ending))
    return effect_title(name)


def in_words(text: str) -> str:
    """Return a text with names of effects as words: "class of link_inertia" is "class of link inertia"."""
    return " ".join(
        effect_title(w) if "_" in w and w.strip(",;:").islower() and "." not in w else w for w in text.split()
    )


def place(joint: JointName) -> str:
    """Return where an effect is: "joint 1" or "torque sensor"."""
    return "torque sensor" if joint == SENSOR else f"joint {joint}"


def _of(cause: Cause) -> str:
    """Return effect and place: "torque ripple of joint 1", "sensor gain"."""
    title = effect_title(cause.name)
    if cause.joint == SENSOR:
        return title if title.startswith(SENSOR) else f"{title} of the torque sensor"
    return f"{title} of {place(cause.joint)}"


def listed(items: Sequence[str], word: str = "and") -> str:
    """Return "a", "a and b", "a, b and c"."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {word} {items[-1]}"


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


def balance_title(balance: str) -> str:
    """Return the balance in words."""
    return BALANCES.get(balance, balance)
