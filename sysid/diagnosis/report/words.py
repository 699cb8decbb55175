"""Names of effects, joints and conditions in words, and the verdict as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    SENSOR,
    UNEXPLAINED,
    Cause,
    Findings,
    Gain,
    Gap,
    JointName,
    Place,
)
from jtqd.sysid.report.numbers import SPACE, number, percent, unit_name, with_interval

BADGES: Final = {
    NO_GAP: ("good", "no gap"),
    CAUSE: ("after", "cause found"),
    AMBIGUOUS: ("warn", "ambiguous"),
    UNEXPLAINED: ("bad", "unexplained"),
    INSUFFICIENT: ("warn", "insufficient data"),
}
"""Colour and text beside the verdict's sentence."""
BALANCES: Final = {
    "motor": "motor balance (current against sensor)",
    "torsion": "torsion (both encoders against sensor)",
}
AXES: Final = {
    "velocity": "velocity",
    "load": "load",
    "current": "current",
    "quadrant": "quadrant",
    "temperature": "temperature",
    "motor_angle": "motor angle",
    "link_angle": "link angle",
    "time": "time in the run",
    "frequency": "frequency",
}
MOMENTS: Final = {"events": "events that noise does not explain", "seconds": "seconds with a deviating mean"}
"""Lists of moments among the places, by their first word."""
_PROPER: Final = {"coulomb": "Coulomb", "stribeck": "Stribeck"}
_UNIT_ENDINGS: Final = (
    "_nms_per_rad",
    "_nm_per_rad3",
    "_nm_per_rad",
    "_nm_per_a",
    "_nm_per_s",
    "_per_k_nm",
    "_rad_s",
    "_kgm2",
    "_nm",
    "_rad",
    "_a",
    "_s",
    "_c",
)


def effect_title(name: str) -> str:
    """Return the name of an effect in words: "stribeck_friction" is "Stribeck friction"."""
    return " ".join(_PROPER.get(word, word) for word in name.split("_"))


def parameter_title(name: str) -> str:
    """Return the name of a parameter in words, without its unit: "amplitude_nm" is "amplitude"."""
    for ending in _UNIT_ENDINGS:
        if name.endswith(ending) and len(name) > len(ending):
            return effect_title(name.removesuffix(ending))
    return effect_title(name)


def place(joint: JointName) -> str:
    """Return where an effect is: "joint 1" or "torque sensor"."""
    return "torque sensor" if joint == SENSOR else f"joint {joint}"


def of_place(name: str, joint: JointName) -> str:
    """Return effect and place: "torque ripple of joint 1", "sensor gain"."""
    title = effect_title(name)
    return title if joint == SENSOR and title.startswith("sensor") else f"{title} of {place(joint)}"


def listed(items: Sequence[str], word: str = "and") -> str:
    """Return "a", "a and b", "a, b and c"."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {word} {items[-1]}"


def cause_phrase(cause: Cause) -> str:
    """Return one cause; a class is listed whole: "either link inertia or channel delay of joint 1"."""
    titles = [effect_title(name) for name in cause.names]
    if len(titles) <= 1:
        return of_place(cause.name, cause.joint)
    if len(titles) == 2:
        return f"either {titles[0]} or {titles[1]} ({place(cause.joint)})"
    return f"one of {listed(titles, 'or')} ({place(cause.joint)})"


def _known_phrases(causes: Sequence[Cause]) -> list[str]:
    """Return the causes that are distinguished from all others; an effect of both joints is one phrase."""
    joints: dict[str, list[JointName]] = {}
    for cause in causes:
        joints.setdefault(cause.name, []).append(cause.joint)
    phrases = []
    for name, places in joints.items():
        numbers = sorted({p for p in places if isinstance(p, int)})
        if len(numbers) > 1:
            phrases.append(f"{effect_title(name)} of joints {listed([str(n) for n in numbers])}")
        else:
            phrases += [of_place(name, n) for n in numbers]
        if SENSOR in places:
            phrases.append(of_place(name, SENSOR))
    return phrases


def verdict_sentence(findings: Findings) -> str:
    """Return the verdict as one sentence."""
    worst = findings.gaps[0] if findings.gaps else None
    if findings.verdict == NO_GAP:
        return f"The simulation explains these runs{_left(worst, '; ')}."
    if findings.verdict == INSUFFICIENT:
        return "These runs are not sufficient to assess the simulation."
    if findings.verdict == UNEXPLAINED:
        rest = f"a gap that no effect of the library explains: {_unexplained(worst)}."
        if not findings.causes:
            return f"The simulation has {rest}"
        found = listed(_known_phrases(findings.causes))
        return f"A part of the simulation error has a certain cause, {found}; beside it there is {rest}"
    known = _known_phrases([c for c in findings.causes if len(c.names) <= 1])
    classes = [cause_phrase(c) for c in findings.causes if len(c.names) > 1]
    if not known and not classes:
        return "The simulation has a gap."
    text = f"Cause of the simulation error: {listed(known + classes)}"
    return f"{text}; these runs cannot distinguish the alternatives." if classes else f"{text}."


CERTAIN_BIC: Final = 100.0
CERTAIN_HELD_OUT: Final = 0.5
"""Evidence, and part of it on held-out runs, from which a cause is called certain; below both it is likely."""


def evidence_in_words(cause: Cause) -> str:
    """Return how sure a cause is: "certain", or "likely"; of a class that it is one of them."""
    sure = cause.delta_bic >= CERTAIN_BIC and cause.held_out_gain >= CERTAIN_HELD_OUT
    word = "certain" if sure else "likely"
    return f"{word} that it is one of {len(cause.names)}" if len(cause.names) > 1 else word


def gain_sentence(findings: Findings) -> str:
    """Return what the extended model is worth on held-out runs, "" where that was not measured."""
    gain = findings.gain
    if gain is None or not findings.causes:
        return ""
    before = gain.rmse_before_nm
    if not before > 0.0:
        return ""
    return (
        f"With {'it' if len(findings.causes) == 1 else 'them'}, the error on held-out runs falls from "
        f"{number(before)} to {number(gain.rmse_after_nm)}{SPACE}Nm, by {gain_interval(gain)}"
        + (f", {gain.judged_beside}." if gain.judged_beside else ".")
    )


def gain_interval(gain: Gain) -> str:
    """Return the drop of the error with its interval: "0.192 Nm (95 % interval 0.185 to 0.198)"."""
    drop = gain.rmse_before_nm - gain.rmse_after_nm
    value, ends = with_interval(drop, gain.ci95, "Nm")
    return f"{value} (95{SPACE}% interval {ends})" if ends else value


def bin_name(bin_: Place) -> str:
    """Return the name of a bin as it is written."""
    return bin_.bin.replace(bin_.unit, unit_name(bin_.unit)) if bin_.unit else bin_.bin


def where(place_: Place) -> str:
    """Return a place with its preposition: "at velocity 0 to 0.1 rad/s", "in bursts, ...", "in a line at order 3.57 ..."."""
    what, _, moments = place_.bin.partition(":")
    if what in MOMENTS:
        return f"in {MOMENTS[what]}, the strongest {moments.split(',')[0].strip()}"
    if place_.bin.startswith("order"):
        return f"in a line at {bin_name(place_)}"
    return f"at {AXES.get(place_.axis, effect_title(place_.axis))} {bin_name(place_)}"


def _left(gap: Gap | None, joined: str) -> str:
    if gap is None:
        return ""
    return f"{joined}the remaining error of {number(gap.rmse_nm)}{SPACE}Nm is noise ({number(gap.noise_floor_nm)}{SPACE}Nm)"


def _unexplained(gap: Gap | None) -> str:
    if gap is None:
        return "the residual is above the noise"
    text = (
        f"{place(gap.joint)}, residual {number(gap.rmse_nm)}{SPACE}Nm, "
        f"noise floor {number(gap.noise_floor_nm)}{SPACE}Nm"
    )
    if gap.localisation:
        top = gap.localisation[0]
        text += f"; {percent(top.share)} of it {where(top)}"
    return text


def balance_title(balance: str) -> str:
    """Return the balance in words."""
    return BALANCES.get(balance, balance)
