"""Was the diagnosis right? Pure comparison of findings with what was hidden.

`Outcome` is one set of runs; the table of the campaign counts them. An effect counts as found when a cause names it alone,
or when it is in a class of at most three that comes with a next experiment.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from jtqd.sysid.diagnosis.findings import Cause, Findings, Gap, Place
from validation.hidden.profiles import RUN_S

LARGEST_CLASS: Final = 3
_PLACES: Final = 3  # of the largest gap that may be right
_MOMENT_S: Final = 0.3  # tolerance of a time
_MOMENT: Final = re.compile(r"(run\d+)(?:\.csv)? ([\d.]+) s")
_HELD: Final = re.compile(
    r"(run\d+)\S*: j(\d)\.(\w+): found exactly (\S+) (?:.*from ([\d., ]+) s on)?.*(clipped|stuck) channel"
)
_RELEVANCE: Final = 0.005

Truth = Mapping[str, Any]


@dataclass(frozen=True)
class Outcome:
    """kind: nothing, one, least (one at its minimum), two, unknown. wanted: (name, joint) hidden; per item found alone,
    in a class, not at all; wrong: single names of causes that are not there; inside: per parameter whether its interval
    holds the truth; gain_share: part of the true model's gain; settled: the next experiment made the class one (None:
    not needed or not run); place: whether the map is right.
    """

    kind: str
    seed: int
    wanted: tuple[tuple[str, Any], ...]
    verdict: str
    causes: tuple[tuple[str, Any, tuple[str, ...]], ...] = ()
    named: tuple[bool, ...] = ()
    classed: tuple[bool, ...] = ()
    wrong: tuple[str, ...] = ()
    inside: tuple[tuple[str, str, bool], ...] = ()
    gain: tuple[float, float, float] | None = None  # rms before, after, after with the true model
    settled: bool | None = None
    place: bool | None = None
    slight: bool = False  # what is in no library is worth less than the relevance
    shown: tuple[str, ...] = ()  # what the map of the largest gap shows first
    detail: Sequence[str] = ()

    @property
    def found(self) -> tuple[bool, ...]:
        """Per hidden effect: named alone, or in a class that the next experiment settles where that was run."""
        late = self.settled is not False
        return tuple(n or (c and late) for n, c in zip(self.named, self.classed, strict=True))


def score(
    kind: str,
    seed: int,
    truth: Sequence[Truth],
    findings: Findings,
    *,
    run_s: float = RUN_S,
    not_wrong: Collection[str] = (),
    **more: Any,
) -> Outcome:
    """Return the outcome of one diagnosis of runs of about `run_s`; not_wrong: names that the recorder put there itself."""
    wanted = tuple((t["name"], t["joint"]) for t in truth)
    library = [t for t in truth if "places" not in t]
    strange = [t for t in truth if "places" in t]
    return Outcome(
        kind=kind,
        seed=seed,
        wanted=wanted,
        verdict=findings.verdict,
        causes=tuple((c.name, c.joint, c.names) for c in findings.causes),
        named=tuple(_alone(t, findings.causes) is not None for t in library),
        classed=tuple(_classed(t, findings) for t in library),
        wrong=tuple(
            f"{c.name} of {c.joint}"
            for c in findings.causes
            if len(c.names) == 1 and (c.name, c.joint) not in wanted and c.name not in not_wrong
        ),
        inside=tuple(item for t in library for item in intervals(t, findings.causes)),
        shown=tuple(
            f"j{g.joint} {g.balance} {p.axis} {p.bin} {p.share:.2f}"
            for g in findings.gaps[:1]
            for p in shown(g)
        ),
        place=place_is_right(strange[0], findings, run_s) if strange else None,
        slight=any(t["parameters"].get("of_rated", 1.0) <= _RELEVANCE for t in strange),
        **more,
    )


def _alone(truth: Truth, causes: Sequence[Cause]) -> Cause | None:
    for c in causes:
        if c.name == truth["name"] and c.joint == truth["joint"] and len(c.names) == 1:
            return c
    return None


def _classed(truth: Truth, findings: Findings) -> bool:
    """Return whether a class holds it that is small enough and comes with the experiment that settles it."""
    if findings.next_experiment is None:
        return False
    label = (
        f"{truth['name']} of {'the sensor' if truth['joint'] == 'sensor' else 'joint ' + str(truth['joint'])}"
    )
    for c in findings.causes:
        first = c.joint == truth["joint"] and c.name == truth["name"]
        other = label in c.names or (truth["name"] in c.names[1:])
        if 1 < len(c.names) <= LARGEST_CLASS and (first or other):
            return True
    return False


def intervals(truth: Truth, causes: Sequence[Cause]) -> list[tuple[str, str, bool]]:
    """Return (effect, parameter, whether its 95 % interval holds the truth) of a cause that names the truth first."""
    for c in causes:
        if (c.name, c.joint) == (truth["name"], truth["joint"]):
            out = []
            for parameter, found in c.parameters.items():
                value = truth["parameters"].get(parameter)
                low, high = found.ci95
                if value is not None and high > low:
                    out.append(
                        (c.name, parameter, _between(value, low, high, parameter.endswith("phase_rad")))
                    )
            return out
    return []


def _between(value: float, low: float, high: float, angle: bool) -> bool:
    if angle:
        value += 2 * np.pi * np.ceil((low - value) / (2 * np.pi))
    return bool(low <= value <= high)


def place_is_right(truth: Truth, findings: Findings, run_s: float = RUN_S) -> bool:
    """Return whether the verdict is "unexplained" and the map of the largest gap points at one of the right places; or
    whether nothing is explained and a channel check says which channel clips or is stuck, where (`_channel_said`).
    """
    if _channel_said(truth, findings):
        return True
    if findings.verdict != "unexplained" or not findings.gaps:
        return False
    largest = findings.gaps[0]
    if truth["joint"] not in ("sensor", largest.joint):
        return False
    return any(_hit(place, right) for place in shown(largest) for right in truth["places"]) or _moments_hit(
        shown(largest), truth["places"], run_s
    )


def _channel_said(truth: Truth, findings: Findings) -> bool:
    """Return whether the user is told that a right place of axis "channel" clips, at its value within 1 %; or that it is
    stuck, at moments of which most are right.
    """
    if findings.verdict not in ("unexplained", "insufficient_data"):
        return False
    lines = filter(None, map(_HELD.search, dict.fromkeys((*findings.reasons, *findings.channel_notes))))
    said = [line.groups() for line in lines]
    spans = [(r["run"], r["low"], r["high"]) for r in truth["places"] if r["axis"] == "time"]
    for right in truth["places"]:
        if right["axis"] == "channel" and right.get("stuck"):
            named = [
                any(run == r and low - _MOMENT_S <= float(t) <= high + _MOMENT_S for r, low, high in spans)
                for run, joint, channel, _, times, word in said
                if truth["joint"] in ("sensor", int(joint)) and (channel, word) == (right["channel"], "stuck")
                for t in re.findall(r"\d[\d.]*", times or "")
            ]
            if named and sum(named) > 0.5 * len(named):
                return True
        elif right["axis"] == "channel":
            for _, _, channel, value, _, word in said:
                clips = word == "clipped" and channel == right["channel"]
                if clips and right["low"] <= abs(float(value)) <= right["high"]:
                    return True
    return False


def shown(gap: Gap) -> Sequence[Place]:
    """Return the places that a reader sees first."""
    return gap.localisation[:_PLACES]


def _hit(place: Place, right: Mapping[str, Any]) -> bool:
    """Return whether a bin overlaps a right place; times are the matter of `_moments_hit`."""
    if right["axis"] == "channel":  # the matter of `_channel_said`
        return False
    low, high = right["low"], right["high"]
    if right["axis"] == "frequency":
        orders = "rev" in place.unit or "order" in place.bin
        same = place.axis == "frequency" or (place.axis == "motor_angle" and orders)
        return same and orders == ("rev" in right["unit"]) and place.low <= high and place.high >= low
    if place.axis != right["axis"] or right["axis"] == "time":
        return False
    if right["axis"] == "link_angle":
        turn = 2 * np.pi
        ahead = (low - place.low) % turn  # start of the right place within the bin, or of the bin within it
        return bool(ahead <= place.high - place.low or (place.low - low) % turn <= high - low)
    return bool(place.low <= high and place.high >= low)


def _moments_hit(places: Sequence[Place], right: Sequence[Mapping[str, Any]], run_s: float) -> bool:
    """Return whether most of the moments that the map names (run and time) are right, and at least twice as many as moments
    drawn at random would be: where something is wrong half of the time, naming times is no answer unless all are right.
    """
    spans = [(r["run"], r["low"], r["high"]) for r in right if r["axis"] == "time"]
    named = [(run, float(t)) for p in places if p.axis == "time" for run, t in _MOMENT.findall(p.bin)]
    hits = [
        any(run == r and low - _MOMENT_S <= t <= high + _MOMENT_S for r, low, high in spans)
        for run, t in named
    ]
    chance = sum(_covered([(low, high) for r, low, high in spans if r == run], run_s) for run, _ in named)
    return bool(hits) and sum(hits) >= max(0.5 * len(hits), min(2.0 * chance, len(hits)))


def _covered(spans: Sequence[tuple[float, float]], run_s: float) -> float:
    """Return the part of a run that is within the tolerance of these times."""
    t = np.arange(0.0, run_s, 0.02)
    near = np.zeros(len(t), bool)
    for low, high in spans:
        near |= (t >= low - _MOMENT_S) & (t <= high + _MOMENT_S)
    return float(near.mean())
