"""Result of a diagnosis as frozen values: the source of findings.json (schema jtq.findings/1), report and exit status."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from operator import attrgetter
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import Effect
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
        return found / self.value - 1.0 if self.value and math.isfinite(found) else None


def file_values(effect_name: str, where: int | str, joints: Mapping[int, Joint]) -> dict[str, FileValue]:
    """Return the joint file's value of each parameter of an effect of joint `where` (or "sensor"): that under `effects`,
    else of the key that it stands for, else the value that means no effect.
    """
    joint = joints.get(where) if isinstance(where, int) else next(iter(joints.values()), None)
    effect = EFFECTS.get(effect_name)
    if joint is None or effect is None:
        return {}
    listed = next((item.parameters for item in joint.effects if item.name == effect_name), {})
    found = {}
    for p in effect.parameters:
        if p.name in listed:
            found[p.name] = FileValue(float(listed[p.name]), f"effects: {effect_name}.{p.name}")
        elif p.key:
            found[p.name] = FileValue(float(attrgetter(p.key)(joint)), p.key)
        else:
            found[p.name] = FileValue(p.neutral, "")
    return found


SCHEMA: Final = "jtq.findings/1"
NO_GAP: Final = "no_gap"
CAUSE: Final = "cause"
AMBIGUOUS: Final = "ambiguous"
UNEXPLAINED: Final = "unexplained"
INSUFFICIENT: Final = "insufficient_data"

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
class Scope:
    """Effects that are not looked for, and joints whose torque is known.

    out: (joint or "sensor", name); joint None: wherever it may be. known_references: joints whose reference is a known load
    or a model's torque: no sensor effect may touch it, and it has no zero that drifts.
    """

    out: frozenset[tuple[JointName | None, str]] = frozenset()
    known_references: frozenset[int] = frozenset()

    def looks_for(self, name: str, where: JointName, number: int) -> bool:
        """Return whether an effect of a joint or the sensor, seen in the balances of joint `number`, is a candidate."""
        if where == SENSOR and number in self.known_references:
            return False
        return (None, name) not in self.out and (where, name) not in self.out

    @property
    def note(self) -> tuple[str, ...]:
        """One line in the presence of an unexplained residual: which effects were not looked for; none where all were."""
        names = ", ".join(sorted({name for _, name in self.out}))
        return (
            (f"not looked for, as asked: {names}; the unexplained residual may be theirs",) if names else ()
        )


EVERYTHING: Final = Scope()


@dataclass(frozen=True)
class Value:
    """A parameter with its 95 % interval."""

    value: float
    ci95: tuple[float, float]
    unit: str

    @property
    def fitted(self) -> bool:
        """Whether it was found, not given."""
        return self.ci95[0] != self.ci95[1]


@dataclass(frozen=True)
class Cause:
    """One entry of the set: a value of the file that is wrong, or an effect that is present.

    grade: certain, one_of or effective; rivals: of one_of, what these runs cannot distinguish it from; given: what certainty
    rests on, the priors of its kind in words; doubts: why it is not certain.
    """

    name: str
    joint: JointName
    parameters: Mapping[str, Value]
    delta_evidence: float  # twice the log evidence that the best set without it lacks
    rms_nm: float  # of its contribution over the runs, in the balance where it is largest
    balance: str  # "motor" or "torsion": where it is largest
    explained_share: float = math.nan  # of all that is structure in these runs, as squares
    grade: str = CERTAIN
    rivals: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    matters: bool = True  # above the relevance

    @property
    def names(self) -> tuple[str, ...]:
        """Its class, itself first."""
        return (self.name, *(rival for rival in self.rivals if rival != self.name))

    @property
    def leading(self) -> str:
        """The parameter that stands for it: the first that is fitted, else the first; "" without one."""
        fitted = [name for name, value in self.parameters.items() if value.fitted]
        return next(iter([*fitted, *self.parameters]), "")


class Present(NamedTuple):
    """An effect that is present, with all its parameters by name."""

    name: str
    joint: JointName
    values: Mapping[str, float]

    @property
    def effect(self) -> Effect:
        """The effect of the library."""
        return EFFECTS[self.name]


@dataclass(frozen=True)
class Untold:
    """What these runs cannot tell: why, and the kind of motion that would (`planner.experiments.EXPERIMENTS`)."""

    name: str
    joint: JointName
    why: str
    experiment: str


@dataclass(frozen=True)
class CandidateEvidence:
    """Evidence of one effect beyond the set; why it is in the set or not, and the smallest size detectable."""

    name: str
    joint: JointName
    delta_bic: float
    minimum: Mapping[str, Value]  # minimum detectable size of its leading parameter(s); value inf: invisible
    reason: str  # "in the set, certain", "no evidence beyond the set", "needs a temperature", ...

    @property
    def sizes(self) -> dict[str, dict[str, Any]]:
        """Minimum detectable sizes without an interval."""
        return {name: {"value": each.value, "unit": each.unit} for name, each in self.minimum.items()}


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
    """One balance of one joint: residual of the simulation, noise floor, where it lives (largest share first)."""

    joint: int
    balance: str
    rmse_nm: float
    noise_floor_nm: float
    localisation: tuple[Place, ...]


class RunGain(NamedTuple):
    """Error on one run, with the parameters of all other runs."""

    run: str
    rmse_before_nm: float
    rmse_after_nm: float


@dataclass(frozen=True)
class Gain:
    """Held-out error before and after, leave-one-run-out; ci95: of rmse_before - rmse_after [Nm]; joint, balance: whose
    error it is (None: not stated).
    """

    rmse_before_nm: float
    rmse_after_nm: float
    split: str
    ci95: tuple[float, float]
    runs: tuple[RunGain, ...] = ()
    joint: int | None = None
    balance: str | None = None


@dataclass(frozen=True)
class Trace:
    """For plots: one run, one joint, one balance, binned; arrays [n].

    before_nm, after_nm: measured less simulated, by the joint file and with the entries found; measured_nm: motor torque
    G Kt i at the joint (motor), or the torque that the twist makes (torsion); velocity_rad_s: of the joint.
    """

    run: str
    joint: int
    balance: str
    time_s: FloatArray
    before_nm: FloatArray
    after_nm: FloatArray
    velocity_rad_s: FloatArray
    measured_nm: FloatArray


@dataclass(frozen=True)
class UnexplainedResidual:
    """What the entries leave that is structure, in the balance and run where it is most: rms [Nm], also in percent of the
    rated torque, share of all structure; from `relevant_nm` on it matters.
    """

    joint: int
    balance: str
    rms_nm: float
    percent_of_rated: float
    share: float
    relevant_nm: float
    matters: bool


@dataclass(frozen=True)
class OutlierRun:
    """A run that differs from all others and is not used: what ("gain", "zero", "delay") of which column differs by `value`
    from the mean of the others, whose standard deviation is `usual`. others: deviations that fit nearly as well.

    unit: "" for a gain (0.07: it reads 7 % more), "of rated" (torque; of a current, its torque), "s" (late).
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
        verb, scale, unit, more, less = _DEVIATIONS[self.what]
        found = (
            f"{verb} {abs(scale * self.value):.3g} {unit} {more if self.value > 0.0 else less} than in the other runs, "
            f"which differ by {scale * self.usual:.2g} {unit} among themselves"
        )
        return f"{self.run}: {channel} {found}{either}: a matter of this run, which is not used"


_DEVIATIONS: Final = {
    "gain": ("reads", 100.0, "%", "more", "less"),
    "zero": ("has its zero", 100.0, "% of rated torque", "higher", "lower"),
    "delay": ("is", 1000.0, "ms", "later", "earlier"),
}
"""How a run differs -> verb, scale and unit for people, and the words for a positive and a negative deviation."""


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
    rows = []
    for name, prior in PRIORS.items():
        size, _, unit = prior.text.partition(" ")
        text = f"{float(size) * trust[name]:.3g} {unit}" if name in trust else prior.text
        rows.append(PriorRow(name, text, name in trust))
    return rows


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

    def __repr__(self) -> str:
        found = (f"{each.name} of {joint_text(each.joint)} ({each.grade})" for each in self.causes)
        return f"Findings({': '.join((self.verdict, *filter(None, [', '.join(found)])))}; {self.runs_text})"

    @property
    def used_runs(self) -> tuple[str, ...]:
        """Runs that what was found is of."""
        return self.used or self.runs

    @property
    def runs_text(self) -> str:
        """How many runs were used, e.g. "6 of 7 runs"."""
        used, count = len(self.used_runs), len(self.runs)
        return counted(count, "run") if used == count else f"{used} of {counted(count, 'run')}"


def to_mapping(
    findings: Findings, *, sha256: Mapping[str, str] | None = None, files: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the findings as findings.json has them: dicts, lists, texts and finite numbers only.

    The keys of the schema are always there, whatever the verdict: a program that reads `gap.rmse_nm` need not ask first.
    What has no value is null, NaN and infinity too. sha256: hash of each run's file by the run's name; files: names of what
    was written beside findings.json.
    """
    no_gap: dict[str, Any] = {"joint": None, "rmse_nm": None, "noise_floor_nm": None, "localisation": []}
    experiment = findings.next_experiment
    if experiment is not None:  # the positions of a motion are a file of their own
        experiment = {key: value for key, value in experiment.items() if key != "tables"}
    mapping = {
        "schema": SCHEMA,
        "verdict": findings.verdict,
        "gap": findings.gaps[0] if findings.gaps else no_gap,
        "causes": [_cause(each, findings.joint_files) for each in findings.causes],
        "gain": findings.gain or dict.fromkeys(("rmse_before_nm", "rmse_after_nm", "split", "ci95")),
        "explained_share": findings.explained_share,
        "unexplained": findings.unexplained,
        "next_experiment": experiment,
        "reasons": findings.reasons,
        "outlier_runs": [{**vars(each), "text": each.text} for each in findings.outlier_runs],
        "too_small": [_cause(each, findings.joint_files) for each in findings.too_small],
        "cannot_be_told": findings.cannot_be_told,
        "joints": findings.joints,
        "runs": [
            {"name": name, "sha256": (sha256 or {}).get(name), "used": name in findings.used_runs}
            for name in findings.runs
        ],
        "gaps": findings.gaps,
        "candidates": [{**vars(each), "minimum": each.sizes} for each in findings.candidates],
        "channel_notes": findings.channel_notes,
        "relevance": findings.relevance,
        "priors": priors(findings.trust),
        "provenance": findings.provenance,
        "files": files,
    }
    return dict(plain(mapping))


def _cause(cause: Cause, joints: Mapping[int, Joint]) -> dict[str, Any]:
    """Return a cause with its class, and beside each value that of the joint file, if there is one, and the change."""
    known = file_values(cause.name, cause.joint, joints)
    values: dict[str, Any] = {}
    for name, value in cause.parameters.items():
        change = known[name].change(value.value) if name in known else None
        of_file = {"file_value": known[name].value, "change": change} if name in known else {}
        values[name] = {"value": value.value, "ci95": value.ci95, "unit": value.unit} | of_file
    evidence = {
        "delta_bic": cause.delta_evidence,
        "held_out_gain": None,
    }  # of a single entry: promised, not measured
    more = {"class": cause.names, "parameters": values, "evidence": evidence}
    return {key: value for key, value in vars(cause).items() if key != "delta_evidence"} | more


def plain(value: Any) -> Any:
    """Return the same value with what JSON knows: frozen values by field, numpy's numbers and arrays plain, NaN and infinity
    None. Raises TypeError for anything else.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    elif is_dataclass(value):
        value = vars(value)
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Iterable):
        return [plain(item) for item in value]
    raise TypeError(f"found {type(value).__name__} in findings, expected plain values")
