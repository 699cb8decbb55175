"""Was the diagnosis right? Runs to findings through files, findings against what was hidden, the tables that count it.

`Outcome` is one set of runs. An effect counts as found when it is among the causes, or when it is a rival in a class of at
most three that comes with a next experiment. Wrong is a cause of grade certain that matters and is not there.
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.run import RunTableError
from jtqd.sysid.diagnosis.findings import CERTAIN, Cause, Findings, Gap, Place
from jtqd.sysid.diagnosis.run_files import diagnose
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.options import joints_of
from jtqd.sysid.runs.run_file import RunError
from validation.diagnosis.entries import SENSOR, Columns, Joint
from validation.diagnosis.recorder import Recorder, csv_text, record
from validation.generator.plant import RUN_S
from validation.study import Share, share

REFUSED: Final = "refused"
"""Verdict of runs that the reader does not take, or that end in a traceback."""
LARGEST_CLASS: Final = 3
_PLACES: Final = 3  # of the largest gap that may be right
_MOMENT_S: Final = 0.3  # tolerance of a time
_MOMENT: Final = re.compile(r"(run\d+)(?:\.csv)? ([\d.]+) s")
_HELD: Final = re.compile(
    r"(run\d+)\S*: j(\d)\.(\w+): found exactly (\S+) (?:.*from ([\d., ]+) s on)?.*(clipped|stuck) channel"
)
_RELEVANCE: Final = 0.005

Truth = Mapping[str, Any]


def write(
    folder: Path, runs: Sequence[Columns], joints: Mapping[int, Joint], recorder: Recorder, seed: int
) -> tuple[list[Path], dict[int, Path]]:
    """Write run1.csv.. and joint1.yaml.. and return their paths; nothing in them tells what is hidden."""
    paths = []
    for k, table in enumerate(record(runs, recorder, seed)):
        paths.append(folder / f"run{k + 1}.csv")
        paths[-1].write_text(csv_text(table, recorder), encoding="utf-8")
    files = {}
    for number, joint in joints.items():
        files[number] = folder / f"joint{number}.yaml"
        files[number].write_text(yaml.safe_dump(dict(joint), sort_keys=False), encoding="utf-8")
    return paths, files


def judged(runs: Sequence[Columns], joints: Mapping[int, Joint], recorder: Recorder, seed: int) -> Findings:
    """Return what `jtq diagnose` finds in the recorded files; verdict `REFUSED` with the error where there is nothing."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        paths, files = write(Path(folder), runs, joints, recorder, seed)
        try:
            read = read_runs(paths, segments=True)  # as the command does
            return diagnose(read, joints_of(files, read))
        except (ConfigError, RunError, RunTableError) as error:
            text = str(error).replace(folder, "")
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
    return Findings(REFUSED, (text,), (), tuple(joints))


@dataclass(frozen=True)
class Outcome:
    """kind: nothing, one, least (one at its minimum), two, unknown. wanted: (name, joint) hidden; causes: those that matter;
    named, classed: per hidden effect whether it is a cause, or a rival of one; wrong: certain names of what is not there;
    inside: per parameter whether its interval holds the truth; gain_share: part of the true model's gain; settled: the next
    experiment made the class one (None: not needed or not run); place: whether the map is right.
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
        """Per hidden effect: among the causes, or in a class that the next experiment settles where that was run."""
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
        causes=tuple((c.name, c.joint, c.names) for c in findings.causes if c.matters),
        named=tuple(_among(t, findings.causes) for t in library),
        classed=tuple(_classed(t, findings) for t in library),
        wrong=tuple(
            f"{c.name} of {c.joint}"
            for c in findings.causes
            if c.grade == CERTAIN
            and c.matters
            and (c.name, c.joint) not in wanted
            and c.name not in not_wrong
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


def _among(truth: Truth, causes: Sequence[Cause]) -> bool:
    return any((c.name, c.joint) == (truth["name"], truth["joint"]) for c in causes)


def members(cause: Cause) -> set[tuple[str, Any]]:
    """Return (name, joint) of the effects of a cause's class; one of another joint has it in its name."""
    found: set[tuple[str, Any]] = {(cause.name, cause.joint)}
    for text in cause.names[1:]:
        name, _, where = text.partition(" of ")
        other = SENSOR if where == "the sensor" else int(where.removeprefix("joint ") or 0)
        found.add((name, other or cause.joint))
    return found


def _classed(truth: Truth, findings: Findings) -> bool:
    """Return whether a class holds it that is small enough and comes with the experiment that settles it."""
    return findings.next_experiment is not None and any(
        1 < len(c.names) <= LARGEST_CLASS and (truth["name"], truth["joint"]) in members(c)
        for c in findings.causes
    )


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
    whether nothing is explained and a channel check reports which channel clips or is stuck, where (`_channel_reported`).
    """
    if _channel_reported(truth, findings):
        return True
    if findings.verdict != "unexplained" or not findings.gaps:
        return False
    largest = findings.gaps[0]
    if truth["joint"] not in ("sensor", largest.joint):
        return False
    return any(_hit(place, right) for place in shown(largest) for right in truth["places"]) or _moments_hit(
        shown(largest), truth["places"], run_s
    )


def _channel_reported(truth: Truth, findings: Findings) -> bool:
    """Return whether the user reads that a right place of axis "channel" clips, at its value within 1 %; or that it is
    stuck, at moments of which most are right.
    """
    if findings.verdict not in ("unexplained", "insufficient_data"):
        return False
    lines = filter(None, map(_HELD.search, dict.fromkeys((*findings.reasons, *findings.channel_notes))))
    checks = [line.groups() for line in lines]
    spans = [(r["run"], r["low"], r["high"]) for r in truth["places"] if r["axis"] == "time"]
    for right in truth["places"]:
        if right["axis"] == "channel" and right.get("stuck"):
            named = [
                any(run == r and low - _MOMENT_S <= float(t) <= high + _MOMENT_S for r, low, high in spans)
                for run, joint, channel, _, times, word in checks
                if truth["joint"] in ("sensor", int(joint)) and (channel, word) == (right["channel"], "stuck")
                for t in re.findall(r"\d[\d.]*", times or "")
            ]
            if named and sum(named) > 0.5 * len(named):
                return True
        elif right["axis"] == "channel":
            for _, _, channel, value, _, word in checks:
                clips = word == "clipped" and channel == right["channel"]
                if clips and right["low"] <= abs(float(value)) <= right["high"]:
                    return True
    return False


def shown(gap: Gap) -> Sequence[Place]:
    return gap.localisation[:_PLACES]


def _hit(place: Place, right: Mapping[str, Any]) -> bool:
    """Return whether a bin overlaps a right place; times are the matter of `_moments_hit`."""
    if right["axis"] == "channel":  # the matter of `_channel_reported`
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


# Tables.


def generator_shares(outcomes: Sequence[Outcome]) -> list[Share]:
    """Return the table of trials of the generator; rows without trials are left out."""
    of = _by_kind(outcomes)
    one, least = ([o for o in of[kind] if o.verdict != "invisible"] for kind in ("one", "least"))
    hidden = [*one, *of["two"]]
    classed = sum(not all(o.named) and all(o.found) for o in one)
    rows = [
        share(
            "hidden effect at 3x its minimum: a cause, or in a class of at most 3",
            _found(one),
            0.95,
            f"{classed} in a class, {len(of['one']) - len(one)} not visible in their runs",
        ),
        share("the same at 1x its minimum (no target)", _found(least), None, "a cause or in a class"),
        share("certain and wrong", [bool(o.wrong) for o in hidden], -0.02),
        share(
            "nothing hidden: a cause that matters",
            [bool(o.causes) for o in of["nothing"]],
            -0.01,
            f"else than no_gap: {sum(o.verdict != 'no_gap' for o in of['nothing'])}",
        ),
        share("two effects at once: both found", _found(of["two"]), 0.85),
        share(
            "not in the library: unexplained, right place in the map",
            [bool(o.place) for o in of["unknown"]],
            0.90,
            f"unexplained: {sum(o.verdict == 'unexplained' for o in of['unknown'])}",
        ),
        _covered_share("95 % intervals of parameters cover the truth", hidden, 0.90, 0.98),
        _gain(hidden),
    ]
    return [row for row in rows if row is not None]


def bench_shares(outcomes: Sequence[Outcome], real: bool = False) -> list[Share]:
    """Return the table of trials on a bench; rows without sets are left out. real: of a bench that `beyond` is for."""
    of = _by_kind(beyond(outcomes) if real else outcomes)
    known = [*of["single"], *of["half"], *of["pair"], *of["nothing"]]
    named, foreign = [*known, *of["beside"]], of["foreign"]
    rows = [
        share(
            "single, three times visible: a cause, or class of at most 3",
            _found(of["single"]),
            0.98,
            _alone_text(of["single"]),
        ),
        share("half of that size", _found(of["half"]), 0.92, _alone_text(of["half"])),
        share("pairs: both", _found(of["pair"]), 0.90, _alone_text(of["pair"])),
        share(
            "certain and wrong",
            [bool(o.wrong) for o in named],
            -0.02,
            _most(n for o in named for n in o.wrong),
        ),
        share(
            "nothing hidden: a cause, or unexplained",
            [bool(o.causes) or o.verdict == "unexplained" for o in of["nothing"]],
            -0.01,
            _verdicts(of["nothing"]),
        ),
        share("foreign: refused and placed", [bool(o.place) for o in foreign], 0.90, _verdicts(foreign)),
        share(
            "foreign worth more than the relevance called no_gap",
            [o.verdict == "no_gap" and not o.slight for o in foreign],
            -0.0,
            f"{sum(o.slight for o in foreign)} worth less",
        ),
        share("cause beside a foreign effect: found", _found(of["beside"]), 0.80, _verdicts(of["beside"])),
        _covered_share("95 % intervals hold the truth", known, 0.93, 0.97),
    ]
    return [row for row in rows if row is not None]


def beyond(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the sets as they are beside the set with nothing hidden of the same seed: names that this one has as well are
    not wrong; what it names already cannot be found, and a set without it is left out.
    """
    plain = {o.seed: o for o in outcomes if o.kind == "nothing"}
    out = []
    for o in outcomes:
        if o.kind == "nothing":
            out.append(replace(o, wrong=()))
        elif o.seed in plain:
            there = {f"{name} of {joint}" for name, joint, _ in plain[o.seed].causes}
            if not any(f"{name} of {joint}" in there for name, joint in o.wanted):
                out.append(replace(o, wrong=tuple(w for w in o.wrong if w not in there)))
    return out


def lost_to_wrong(full: Mapping[str, Outcome], recorded: Mapping[str, Outcome]) -> list[str]:
    """Return the sets in which the recorder makes a wrong name of a found one: keys."""
    return [
        key
        for key, o in recorded.items()
        if o.kind in ("single", "half", "pair")
        and all(full[key].found)
        and not full[key].wrong
        and not all(o.found)
        and o.wrong
    ]


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per outcome that is not what it should be, for the developers."""
    lines = []
    for o in outcomes:
        if o.kind in _BAD and _BAD[o.kind](o):
            found = ", ".join(f"{n} of {j} {list(c[1:]) or ''}".strip() for n, j, c in o.causes) or "nothing"
            shown = f"; shown: {' | '.join(o.shown)}" if o.kind in ("unknown", "foreign") else ""
            hidden = " + ".join(o.detail) or " + ".join(f"{n} of {j}" for n, j in o.wanted) or "nothing"
            lines.append(f"{o.kind} seed {o.seed}: hidden {hidden}; {o.verdict}: {found}{shown}")
    return lines


_BAD: Final[dict[str, Callable[[Outcome], bool]]] = {
    "nothing": lambda o: bool(o.causes) or o.verdict != "no_gap",
    **dict.fromkeys(("unknown", "foreign"), lambda o: not o.place),
    **dict.fromkeys(
        ("one", "two", "single", "half", "pair", "beside"), lambda o: not all(o.found) or bool(o.wrong)
    ),
}
"""Kind -> whether an outcome is not what it should be."""


def coverage_by_parameter(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per effect and parameter whose intervals miss more often than 10 % and two times at least."""
    all_of: Counter[tuple[str, str]] = Counter()
    missed: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if o.kind in ("one", "two"):
            for name, parameter, good in o.inside:
                all_of[name, parameter] += 1
                missed[name, parameter] += not good
    return [
        f"{name} {parameter}: {k} of {all_of[name, parameter]} intervals miss the truth"
        for (name, parameter), k in missed.most_common()
        if k >= 2 and k > 0.1 * all_of[name, parameter]
    ]


def _by_kind(outcomes: Iterable[Outcome]) -> dict[str, list[Outcome]]:
    found: dict[str, list[Outcome]] = defaultdict(list)
    for o in outcomes:
        found[o.kind].append(o)
    return found


def _found(outcomes: Sequence[Outcome]) -> list[bool]:
    return [all(o.found) for o in outcomes]


def _alone_text(outcomes: Sequence[Outcome]) -> str:
    return f"{sum(all(o.named) for o in outcomes)} among the causes"


def _verdicts(outcomes: Sequence[Outcome]) -> str:
    return _most(o.verdict for o in outcomes)


def _most(names: Iterable[str]) -> str:
    return ", ".join(f"{n} {name}" for name, n in Counter(names).most_common(4))


def _covered_share(what: str, outcomes: Sequence[Outcome], low: float, high: float) -> Share | None:
    found = share(what, [good for o in outcomes for _, _, good in o.inside], None)
    if found is None:
        return None
    target = f"{100 * low:.0f} to {100 * high:.0f} %"
    return replace(found, target=target, reached=low <= found.value <= high)


def _gain(hidden: Sequence[Outcome]) -> Share | None:
    """Return the gain as a share of the true model's: sums of squares that go away, over all trials."""
    there = [o.gain for o in hidden if o.gain is not None]
    if not there:
        return None
    got = [b * b - a * a for b, a, _ in there]
    could = [b * b - t * t for b, _, t in there]
    shares = sorted(g / c for g, c in zip(got, could, strict=True) if c > 0.0)
    value = float(np.median(shares)) if shares else float("nan")
    low, high = shares[int(0.05 * len(shares))], shares[min(int(0.95 * len(shares)), len(shares) - 1)]
    return Share(
        "gain, as share of what the true model would gain",
        value,
        low,
        high,
        "at least 90 %",
        value >= 0.9,
        len(shares),
        "median with 5 and 95 % quantiles; of all trials together "
        f"{100 * sum(got) / max(sum(could), 1e-9):.0f} %",
    )
