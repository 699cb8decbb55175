"""Result of a diagnosis as frozen values: the source of findings.json (schema jtq.findings/1), report and exit status."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.limits import PRIORS, RELEVANCE


class FileValue(NamedTuple):
    """What the file has. value: of the file, or of no effect (a gain of 1, an amplitude of 0), None where there is none to
    compare with; key: the file's key, "" where it has none.
    """

    value: float | None
    key: str

    def change(self, found: float) -> float | None:
        """Return the relative change, None from nothing or zero."""
        if self.value is None or self.value == 0.0 or not math.isfinite(found):
            return None
        return found / self.value - 1.0


def file_values(
    effect_name: str, where: int | str, parameters: Iterable[str], joints: Mapping[int, Joint]
) -> dict[str, FileValue]:
    """Return the joint file's value of each parameter of an effect of joint `where` (or "sensor").

    An effect that is in the file under `effects` has its value there; else a parameter that stands for a key of the file has
    that key's; any other has the value that means no effect.
    """
    joint = joints.get(where) if isinstance(where, int) else next(iter(joints.values()), None)
    effect = EFFECTS.get(effect_name)
    if joint is None or effect is None:
        return {}
    listed = next((item.parameters for item in joint.effects if item.name == effect_name), None)
    known = {parameter.name: parameter for parameter in effect.parameters}
    found = {}
    for name in parameters:
        parameter = known.get(name)
        key = parameter.key if parameter else ""
        if listed is not None and name in listed:
            found[name] = FileValue(float(listed[name]), f"effects: {effect_name}.{name}")
        elif key:
            found[name] = FileValue(float(attrgetter(key)(joint)), key)
        else:
            found[name] = FileValue(parameter.neutral if parameter else 0.0, "")
    return found


SCHEMA: Final = "jtq.findings/1"
NO_GAP: Final = "no_gap"
CAUSE: Final = "cause"
AMBIGUOUS: Final = "ambiguous"
UNEXPLAINED: Final = "unexplained"
INSUFFICIENT: Final = "insufficient_data"
VERDICTS: Final = (NO_GAP, CAUSE, AMBIGUOUS, UNEXPLAINED, INSUFFICIENT)

CERTAIN: Final = "certain"
ONE_OF: Final = "one_of"
EFFECTIVE: Final = "effective"

SENSOR: Final = "sensor"
JointName = int | str
"""1 to 7, or SENSOR."""


def shows_at(where: JointName, number: int) -> bool:
    """Return whether what is wrong at a joint or the sensor shows in the balances of joint `number`."""
    return where in (SENSOR, number)


def joint_text(joint: JointName) -> str:
    """Return "joint 2", or "the sensor"."""
    return "the sensor" if joint == SENSOR else f"joint {joint}"


@dataclass(frozen=True)
class Value:
    """A parameter with its 95 % interval."""

    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Cause:
    """One entry of the set: a value of the file that is wrong, or an effect that is present.

    names: its class, itself first: what these runs cannot distinguish it from. grade: certain, one_of or effective; rivals:
    of one_of; given: what certainty rests on, the priors of its kind in words.
    """

    name: str
    joint: JointName
    names: tuple[str, ...]
    parameters: Mapping[str, Value]
    delta_evidence: float  # twice the log evidence that the best set without it lacks
    held_out_gain: float  # share of the held-out squared error that it takes away
    rms_nm: float  # of its contribution over the runs, in the balance where it is largest
    balance: str  # "motor" or "torsion": where it is largest
    explained_share: float = math.nan  # of all that is structure in these runs, as squares
    grade: str = CERTAIN
    rivals: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    matters: bool = True  # above the relevance

    @property
    def key(self) -> tuple[object, ...]:
        """Effect, joint, and what tells several of one effect apart."""
        return self.name, self.joint, *(v.value for n, v in self.parameters.items() if v.ci95[0] == v.ci95[1])


class Present(NamedTuple):
    """An effect of the extended model: the set and all values of the file, with the values that predict."""

    name: str
    joint: JointName
    values: Mapping[str, float]


@dataclass(frozen=True)
class Untold:
    """What these runs cannot tell: why, and the kind of motion that would (`planner.experiments.EXPERIMENTS`)."""

    name: str
    joint: JointName
    why: str
    experiment: str


@dataclass(frozen=True)
class CandidateEvidence:
    """Evidence of one effect against the baseline alone; why it was not chosen, and the smallest size detectable."""

    name: str
    joint: JointName
    delta_bic: float
    held_out_gain: float
    shared: float  # part of its column that the chosen causes share, 0 to 1; NaN without causes
    minimum: Mapping[str, Value]  # minimum detectable size of its leading parameter(s); value inf: invisible
    reason: str  # "chosen", "class of X", "below threshold", "invisible in these runs", "needs temperature_c", ...
    at_minimum: tuple[Mapping[str, float], ...] = ()  # all parameters at that size, per way of looking for it
    minimum_rms_nm: float = math.nan  # what it contributes at that size, rms over the runs; inf: invisible


@dataclass(frozen=True)
class Place:
    """Part `share` of the gap's excess energy lies in this bin. axis: velocity, load, current, quadrant, temperature,
    motor_angle, link_angle, time, frequency; low, high in `unit`.
    """

    axis: str
    bin: str
    share: float
    low: float
    high: float
    unit: str
    rms_nm: float = math.nan


@dataclass(frozen=True)
class Gap:
    """One balance of one joint: residual of the simulation, noise floor, where it lives (largest share first).

    map: all bins of all axes, for the report's picture; localisation holds the few that matter.
    """

    joint: int
    balance: str
    rmse_nm: float
    noise_floor_nm: float
    floor_from: str  # "repeated runs" or "what no effect and no map can explain"
    localisation: tuple[Place, ...]
    map: tuple[Place, ...] = field(default=(), repr=False)


class RunGain(NamedTuple):
    """Error on one run, with the parameters of all other runs."""

    run: str
    rmse_before_nm: float
    rmse_after_nm: float


@dataclass(frozen=True)
class Gain:
    """Held-out error before and after, leave-one-run-out; ci95: of rmse_before - rmse_after [Nm]; joint, balance: whose
    error it is (0, "": not stated).
    """

    rmse_before_nm: float
    rmse_after_nm: float
    split: str
    ci95: tuple[float, float]
    runs: tuple[RunGain, ...] = ()
    joint: int = 0
    balance: str = ""


@dataclass(frozen=True)
class Trace:
    """For plots: one run, one joint, one balance, binned; arrays [n].

    before_nm, after_nm: measured less simulated, by the joint file and with the entries found; measured_nm: motor torque
    G Kt i at the joint (motor), or the torque that the twist makes (torsion); velocity_rad_s, torque_nm: of the joint.
    """

    run: str
    joint: int
    balance: str
    time_s: FloatArray
    before_nm: FloatArray
    after_nm: FloatArray
    velocity_rad_s: FloatArray
    torque_nm: FloatArray
    measured_nm: FloatArray


@dataclass(frozen=True)
class UnexplainedResidual:
    """What the entries leave that is structure, in the balance and run where it is most: rms [Nm], part of the rated torque,
    share of all structure; from `relevant_nm` on it matters.
    """

    joint: int
    balance: str
    rms_nm: float
    of_rated: float
    share: float
    relevant_nm: float
    matters: bool


@dataclass(frozen=True)
class OutlierRun:
    """A run that differs from all others and is not used: what ("gain", "zero", "delay") of which column differs by `value`
    from the mean of the others, whose standard deviation is `usual`. others: deviations that fit nearly as well.

    unit: "" for a gain (0.07: it reads 7 % more; -2: the opposite), "of rated" (torque; of a current, its torque),
    "s" (late).
    """

    run: str
    what: str
    channel: str
    joint: JointName
    value: float
    usual: float
    unit: str
    others: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """One line for people."""
        channel = "torque_nm" if self.joint == SENSOR else f"j{self.joint}.{self.channel}"
        either = f", or it differs in the {' or '.join(self.others)}" if self.others else ""
        if self.what == "gain" and self.value < -1.0:
            return (
                f"{self.run}: {channel} has the opposite direction of that in the other runs, {-1.0 - self.value:.3g} times "
                f"as large{either}: a matter of this run, which is not used"
            )
        what, scale, unit = {
            "gain": ("reads", 100.0, "%"),
            "zero": ("has its zero", 100.0, "% of rated torque"),
            "delay": ("is", 1000.0, "ms"),
        }[self.what]
        sides = {"gain": ("more", "less"), "zero": ("higher", "lower"), "delay": ("later", "earlier")}[
            self.what
        ]
        side = sides[0] if self.value > 0.0 else sides[1]
        return (
            f"{self.run}: {channel} {what} {abs(scale * self.value):.3g} {unit} {side} than in the other runs, which differ "
            f"by {scale * self.usual:.2g} {unit} among themselves{either}: a matter of this run, which is not used"
        )


@dataclass(frozen=True)
class Provenance:
    """When, by what and of what: date ISO 8601, command line, sha256 by name of the inputs (runs, joint files, map)."""

    date: str
    version: str
    command: str
    inputs: Mapping[str, str]


class PriorRow(NamedTuple):
    """Prior of an entry: standard deviation for people, and whether the user set it."""

    name: str
    size: str
    set_by_user: bool


def priors(trust: Mapping[str, float]) -> list[PriorRow]:
    """Return the priors in force; trust: factor on the size by name."""
    return [
        PriorRow(name, scaled_text(prior.text, trust.get(name, 1.0)), name in trust)
        for name, prior in PRIORS.items()
    ]


def scaled_text(text: str, factor: float) -> str:
    """Return the size of a prior in words times a factor: "10 %" by 0.5 is "5 %"."""
    found = re.match(r"[\d.]+", text)
    if factor == 1.0 or found is None:
        return text if factor == 1.0 else f"{factor:.3g} times {text}"
    return f"{float(found[0]) * factor:.3g}{text[found.end() :]}"


@dataclass(frozen=True)
class Findings:
    """All of it. runs: all that were given; used: those of them that anything was found in, empty for all; gaps: largest
    excess first; causes: entries that matter, largest first; too_small: the others; reasons: lines for people; trust:
    factors on the sizes of priors that the user set.
    """

    verdict: str
    reasons: tuple[str, ...]
    runs: tuple[str, ...]
    joints: tuple[int, ...]
    gaps: tuple[Gap, ...] = ()
    causes: tuple[Cause, ...] = ()
    candidates: tuple[CandidateEvidence, ...] = ()
    gain: Gain | None = None
    channel_notes: tuple[str, ...] = ()
    next_experiment: Mapping[str, Any] | None = None  # {"why": text, "plan": mapping of jtq.plan/1}
    traces: tuple[Trace, ...] = field(default=(), repr=False)
    joint_files: Mapping[int, Joint] = field(default_factory=dict, repr=False)  # to compare what was found
    explained_share: float = math.nan
    unexplained: UnexplainedResidual | None = None
    outlier_runs: tuple[OutlierRun, ...] = ()
    too_small: tuple[Cause, ...] = ()
    cannot_be_told: tuple[Untold, ...] = ()
    predicts: tuple[Present, ...] = ()
    used: tuple[str, ...] = ()
    relevance: float = RELEVANCE
    trust: Mapping[str, float] = field(default_factory=dict)
    provenance: Provenance | None = None

    @property
    def used_runs(self) -> tuple[str, ...]:
        """Runs that what was found is of."""
        return self.used or self.runs

    @property
    def runs_text(self) -> str:
        """How many runs were used, e.g. "6 of 7 runs"."""
        used, count = len(self.used_runs), len(self.runs)
        return counted(count, "run") if used == count else f"{used} of {counted(count, 'run')}"


_NO_GAP_MEASURED: Final[dict[str, Any]] = {
    "joint": None,
    "rmse_nm": None,
    "noise_floor_nm": None,
    "localisation": [],
}
_NOT_MEASURED: Final = (
    "plain_nm",
    "free_run_before_rad_s",
    "free_run_after_rad_s",
    "free_run_position_before_rad",
    "free_run_position_after_rad",
)
"""Keys of the gain that are null."""
_NO_GAIN_MEASURED: Final = {"rmse_before_nm": None, "rmse_after_nm": None, "split": None, "ci95": None}


def to_mapping(
    findings: Findings, *, sha256: Mapping[str, str] | None = None, files: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the findings as findings.json has them: dicts, lists, texts and finite numbers only.

    The keys of the schema are always there, whatever the verdict: a program that reads `gap.rmse_nm` need not ask first.
    What has no value is null; NaN and infinity, which JSON does not have, are null as well (an unlimited interval, an
    effect that no size would make visible). Further keys may be ignored.

    sha256: hash of each run's file by the run's name; files: names of what was written beside findings.json.
    """
    mapping = {
        "schema": SCHEMA,
        "verdict": findings.verdict,
        "gap": _gap(findings.gaps[0]) if findings.gaps else _NO_GAP_MEASURED,
        "causes": [_cause(each, findings.joint_files) for each in findings.causes],
        "gain": _NO_GAIN_MEASURED if findings.gain is None else _gain(findings.gain),
        "explained_share": findings.explained_share,
        "unexplained": None if findings.unexplained is None else _unexplained(findings.unexplained),
        "next_experiment": _without_table(findings.next_experiment),
        "reasons": findings.reasons,
        "outlier_runs": [_outlier_run(each) for each in findings.outlier_runs],
        "too_small": [_cause(each, findings.joint_files) for each in findings.too_small],
        "cannot_be_told": [vars(each) for each in findings.cannot_be_told],
        "joints": findings.joints,
        "runs": [
            {"name": name, "sha256": (sha256 or {}).get(name), "used": name in findings.used_runs}
            for name in findings.runs
        ],
        "gaps": [_gap(each) for each in findings.gaps],
        "candidates": [_candidate(each) for each in findings.candidates],
        "channel_notes": findings.channel_notes,
        "relevance": findings.relevance,
        "priors": [each._asdict() for each in priors(findings.trust)],
        "provenance": None if findings.provenance is None else vars(findings.provenance),
        "files": list(files),
    }
    result: dict[str, Any] = plain(mapping)
    return result


def plain(value: Any) -> Any:
    """Return the same value with what JSON knows: numpy's numbers and arrays become plain, NaN and infinity None.

    Raises TypeError for anything else.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Iterable):
        return [plain(item) for item in value]
    raise TypeError(f"found {type(value).__name__} in findings, expected plain values")


def _gap(gap: Gap) -> dict[str, Any]:
    return {
        "joint": gap.joint,
        "rmse_nm": gap.rmse_nm,
        "noise_floor_nm": gap.noise_floor_nm,
        "localisation": [_place(each) for each in gap.localisation],
        "balance": gap.balance,
        "floor_from": gap.floor_from,
    }


def _place(place: Place) -> dict[str, Any]:
    return {
        "axis": place.axis,
        "bin": place.bin,
        "share": place.share,
        "low": place.low,
        "high": place.high,
        "unit": place.unit,
        "rms_nm": place.rms_nm,
    }


def _without_table(experiment: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The positions of a motion are a file of their own."""
    return experiment and {k: value for k, value in experiment.items() if k not in {"table", "tables"}}


def _cause(cause: Cause, joints: Mapping[int, Joint]) -> dict[str, Any]:
    return {
        "name": cause.name,
        "joint": cause.joint,
        "class": list(cause.names),
        "parameters": _values(cause, joints),
        "grade": cause.grade,
        "matters": cause.matters,
        "rivals": list(cause.rivals),
        "given": list(cause.given),
        "evidence": {"delta_bic": cause.delta_evidence, "held_out_gain": cause.held_out_gain},
        "rms_nm": cause.rms_nm,
        "balance": cause.balance,
        "explained_share": cause.explained_share,
    }


def _unexplained(left: UnexplainedResidual) -> dict[str, Any]:
    return {
        "joint": left.joint,
        "balance": left.balance,
        "rms_nm": left.rms_nm,
        "percent_of_rated": 100.0 * left.of_rated,
        "share": left.share,
        "relevant_nm": left.relevant_nm,
        "matters": left.matters,
    }


def _outlier_run(odd: OutlierRun) -> dict[str, Any]:
    return {
        "run": odd.run,
        "what": odd.what,
        "channel": odd.channel,
        "joint": odd.joint,
        "value": odd.value,
        "usual": odd.usual,
        "unit": odd.unit,
        "or": odd.others,
        "text": odd.text,
    }


def _values(cause: Cause, joints: Mapping[int, Joint]) -> dict[str, Any]:
    """Value, interval and unit; and with joint files the file's value and the relative change."""
    known = file_values(cause.name, cause.joint, cause.parameters, joints)
    found: dict[str, Any] = {}
    for name, each in cause.parameters.items():
        found[name] = {"value": each.value, "ci95": each.ci95, "unit": each.unit}
        if name in known:
            found[name] |= {"file_value": known[name].value, "change": known[name].change(each.value)}
    return found


def _candidate(candidate: CandidateEvidence) -> dict[str, Any]:
    return {
        "name": candidate.name,
        "joint": candidate.joint,
        "evidence": {"delta_bic": candidate.delta_bic, "held_out_gain": candidate.held_out_gain},
        "shared": candidate.shared,
        "minimum": {
            name: {"value": each.value, "unit": each.unit} for name, each in candidate.minimum.items()
        },
        "minimum_rms_nm": candidate.minimum_rms_nm,
        "reason": candidate.reason,
    }


def _gain(gain: Gain) -> dict[str, Any]:
    return {
        "rmse_before_nm": gain.rmse_before_nm,
        "rmse_after_nm": gain.rmse_after_nm,
        "split": gain.split,
        "ci95": gain.ci95,
        "joint": gain.joint or None,
        "balance": gain.balance or None,
        **dict.fromkeys(_NOT_MEASURED),
        "runs": [each._asdict() for each in gain.runs],
    }
