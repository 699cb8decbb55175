"""Plans of a campaign (schema jtq.plan/1): frozen, checked, to and from YAML, and as set-points at 1 kHz.

A plan gives the commands of two joints on a towing bench, or of one that is moved alone, segment by segment. `expand` makes
set-points of a run, millisecond by millisecond; `check_run` and `check_plan` hold them against the plan's own limits. All
but `load_plan` is pure.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, Verbatim, finite
from jtqd.estimator.decoder import FieldError, Text, below, choice, in_file, limits, parsed, read, read_kind
from jtqd.models.files import load_yaml
from jtqd.sysid.motion.setpoints import (
    MOST_JOINTS,
    OTHER_ONE,
    PERIOD_S,
    Limits,
    Mark,
    MotionError,
    Setpoints,
    check_setpoints,
    partner_of,
    path,
)
from jtqd.sysid.planner.fourier import CurrentFile, FourierSeries, FourierTrajectory, SeriesFile

SCHEMA: Final = "jtq.plan/1"
DEFAULT_RAMP_S: Final = 0.5
LONGEST_S: Final = 3600.0
"""Of one segment. A run is one log and one table in memory."""
SHORTEST_OFF_S: Final = 1.5
"""Of one segment without power: standing, switching off and on again take about half a second of it."""

DEFAULT_LIMITS: Final = Limits(
    current_a=10.0, velocity_rad_s=3.3, torque_nm=60.0, travel_rad=60.0, temperature_c=70.0
)
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_RESERVED: Final = ("plan", "campaign")
"""The campaign's own files beside those of the runs."""


@dataclass(frozen=True)
class Plateau:
    """Both joints are taken to their targets within ramp_s and held there for hold_s.

    Attributes:
        velocity_rad_s: of the velocity joint, joint side, own frame. current_a: of the other joint, own frame.
        hold_s, ramp_s: seconds.
    """

    velocity_rad_s: Annotated[float, limits("rad/s")]
    current_a: Annotated[float, limits("A")]
    hold_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)]
    ramp_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)] = DEFAULT_RAMP_S

    @property
    def duration_s(self) -> float:
        """Ramp and hold."""
        return self.ramp_s + self.hold_s

    @property
    def moving(self) -> bool:
        """Whether velocity or current is other than zero at its end."""
        return self.velocity_rad_s != 0.0 or self.current_a != 0.0

    def to_mapping(self) -> dict[str, Any]:
        """Plain numbers, ready for YAML."""
        return {"kind": "plateau", **{item.name: getattr(self, item.name) for item in fields(self)}}


@dataclass(frozen=True)
class Rest:
    """Both targets are taken to zero within ramp_s and stay there for hold_s [s]."""

    hold_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)]
    ramp_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)] = DEFAULT_RAMP_S

    @property
    def duration_s(self) -> float:
        """Ramp and hold."""
        return self.ramp_s + self.hold_s

    def to_mapping(self) -> dict[str, Any]:
        """Plain numbers, ready for YAML."""
        return {"kind": "rest", "hold_s": self.hold_s, "ramp_s": self.ramp_s}


@dataclass(frozen=True)
class Off:
    """Both joints stand and their drives are off for hold_s [s], the way there and back included: what the current reads
    then is its sensor's own error. Must begin at rest.
    """

    hold_s: Annotated[float, limits("s", ge=SHORTEST_OFF_S, le=LONGEST_S)]

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        return self.hold_s

    def to_mapping(self) -> dict[str, Any]:
        """Plain numbers, ready for YAML."""
        return {"kind": "power_off", "hold_s": self.hold_s}


@dataclass(frozen=True)
class Fourier:
    """Eq. (10) for the velocity joint and a Fourier series for the other joint's current; from rest to rest."""

    velocity: FourierTrajectory
    current: FourierSeries

    @property
    def duration_s(self) -> float:
        """Of both series."""
        return self.velocity.duration_s

    def to_mapping(self) -> dict[str, Any]:
        """Plain numbers, ready for YAML."""
        return {
            "kind": "fourier",
            "duration_s": self.duration_s,
            "velocity": self.velocity.to_mapping(),
            "current": self.current.to_mapping(),
        }


Segment = Plateau | Rest | Fourier | Off


@dataclass(frozen=True)
class Run:
    """One run: its name (also that of its files), the joint in velocity mode, its segments in order, the other joint.

    current_joint: in torque mode; left out, the other one of joints 1 and 2; None: the velocity joint is moved alone, and
    no segment has a current. Raises ValueError for joints that are no pair.
    """

    name: str
    velocity_joint: int
    segments: tuple[Segment, ...]
    current_joint: int | None = OTHER_ONE

    def __post_init__(self) -> None:
        object.__setattr__(self, "current_joint", partner_of(self.velocity_joint, self.current_joint))

    @property
    def joints(self) -> tuple[int, ...]:
        """Numbers of the joints that are moved, rising."""
        moved = (self.velocity_joint, *(() if self.current_joint is None else (self.current_joint,)))
        return tuple(sorted(moved))

    @property
    def duration_s(self) -> float:
        """Sum over the segments."""
        return sum(segment.duration_s for segment in self.segments)

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        segments = [segment.to_mapping() for segment in self.segments]
        if self.current_joint is None:
            for each in segments:
                each.pop("current", None)
                each.pop("current_a", None)
            return {"name": self.name, "joint": self.velocity_joint, "segments": segments}
        pair: dict[str, Any] = {"velocity_joint": self.velocity_joint}
        if self.joints != (1, 2):
            pair["current_joint"] = self.current_joint
        return {"name": self.name, **pair, "segments": segments}


@dataclass(frozen=True)
class Plan:
    """A campaign: name, limits of the runs on a towing bench, the runs in order, and the limits of joints moved alone."""

    name: str
    limits: Limits
    runs: tuple[Run, ...]
    alone: Mapping[int, Limits] = field(default_factory=dict)

    @classmethod
    def from_mapping(cls, mapping: object, where: str) -> Plan:
        """Check a plan read from YAML; `where` is the file's name for the messages. Raises ConfigError."""
        with in_file(where):
            return read(_PlanFile, mapping).plan()

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        return {
            "schema": SCHEMA,
            "name": self.name,
            "limits": {each.name: finite(getattr(self.limits, each.name)) for each in fields(_LimitsFile)},
            **({"alone": [_of_joint(*each) for each in sorted(self.alone.items())]} if self.alone else {}),
            "runs": [run.to_mapping() for run in self.runs],
        }

    def limits_of(self, run: Run | Setpoints) -> Limits:
        """Return what holds in a run. Raises ConfigError for a joint that is moved alone without limits."""
        if run.current_joint is not None:
            return self.limits
        if run.velocity_joint not in self.alone:
            raise ConfigError(
                f"alone: found no limits of joint {run.velocity_joint}, expected them of a joint that is moved alone"
            )
        return self.alone[run.velocity_joint]

    @property
    def sha256(self) -> str:
        """Hash of the content (hex), whatever the layout of the file: two plans are the same when this is."""
        text = json.dumps(self.to_mapping(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def duration_s(self) -> float:
        """Sum over the runs, without what lies between them."""
        return sum(run.duration_s for run in self.runs)

    def to_yaml(self) -> str:
        """Return the plan as a file; `from_mapping` of it gives the same plan."""
        return yaml.safe_dump(self.to_mapping(), sort_keys=False, default_flow_style=None, width=120)


def load_plan(path: Path) -> Plan:
    """Read a plan file. Raises ConfigError."""
    mapping = load_yaml(path)
    return Plan.from_mapping(mapping, str(path))


@dataclass(frozen=True)
class _LimitsFile:
    """`limits` of a plan; a key left out has its value in DEFAULT_LIMITS, temperature_c: null means no limit."""

    current_a: Annotated[float, limits("A", gt=0.0)] = DEFAULT_LIMITS.current_a
    velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)] = DEFAULT_LIMITS.velocity_rad_s
    torque_nm: Annotated[float, limits("Nm", gt=0.0)] = DEFAULT_LIMITS.torque_nm
    travel_rad: Annotated[float, limits("rad", gt=0.0)] = DEFAULT_LIMITS.travel_rad
    temperature_c: Annotated[float, limits("degC", gt=0.0)] | None = DEFAULT_LIMITS.temperature_c

    def limits(self) -> Limits:
        temperature_c = math.inf if self.temperature_c is None else self.temperature_c
        return Limits(self.current_a, self.velocity_rad_s, self.torque_nm, self.travel_rad, temperature_c)


@dataclass(frozen=True)
class _AloneLimits:
    """Limits of a joint that is moved alone; its travel is that of its own encoder, its temperature's limit the plan's."""

    joint: Annotated[int, limits(ge=1, le=MOST_JOINTS)]
    current_a: Annotated[float, limits("A", gt=0.0)]
    velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    torque_nm: Annotated[float, limits("Nm", gt=0.0)]
    travel_rad: Annotated[tuple[float, float], limits("rad")]

    def __post_init__(self) -> None:
        if not self.travel_rad[0] < self.travel_rad[1]:
            raise FieldError("alone", "travel_rad", list(self.travel_rad), "two rising numbers in rad")

    def limits(self, plan: Limits) -> Limits:
        low, high = self.travel_rad
        return Limits(
            current_a=self.current_a,
            velocity_rad_s=self.velocity_rad_s,
            torque_nm=self.torque_nm,
            travel_rad=high - low,
            temperature_c=plan.temperature_c,
            position_rad=(low, high),
        )


def _of_joint(number: int, limits: Limits) -> dict[str, Any]:
    """Return limits of a joint that is moved alone, plain."""
    values = {name: getattr(limits, name) for name in ("current_a", "velocity_rad_s", "torque_nm")}
    return {"joint": number, **values, "travel_rad": list(limits.position_rad)}


_Number = Annotated[int, limits(ge=1, le=MOST_JOINTS)]


def _run_name(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise FieldError("run", "", value, "a text")
    if not _NAME.fullmatch(value) or value in _RESERVED:
        raise ValueError("found another name")
    return value


_RunName = Annotated[
    str,
    parsed(
        _run_name,
        "letters, digits and . _ + -, beginning with a letter or digit, not 'plan' or 'campaign'",
    ),
]


@dataclass(frozen=True)
class _AloneRun:
    """A run of a joint that is moved alone."""

    name: _RunName
    joint: _Number
    segments: tuple[Mapping[str, Any], ...] = ()

    @property
    def joints(self) -> tuple[int, int | None]:
        return self.joint, None


@dataclass(frozen=True)
class _PairRun:
    """A run of two joints on a towing bench."""

    name: _RunName
    velocity_joint: _Number
    segments: tuple[Mapping[str, Any], ...] = ()
    current_joint: _Number | None = None

    def __post_init__(self) -> None:
        if self.current_joint is None and self.velocity_joint > 2:
            raise FieldError("run", "current_joint", MISSING, f"a whole number from 1 to {MOST_JOINTS}")
        if self.current_joint == self.velocity_joint:
            raise FieldError("run", "current_joint", self.current_joint, "another joint than velocity_joint")

    @property
    def joints(self) -> tuple[int, int | None]:
        return self.velocity_joint, OTHER_ONE if self.current_joint is None else self.current_joint


def _run(mapping: Mapping[str, Any]) -> Run:
    file = read(_AloneRun, mapping) if "joint" in mapping else read(_PairRun, mapping)
    if not file.segments:
        raise FieldError("run", "segments", Verbatim("none"), "a list of at least one segment")
    segments: list[Segment] = []
    for n, section in enumerate(file.segments):
        with below(f"segments[{n}]"):
            each = _segment(section, alone=isinstance(file, _AloneRun))
            before = segments[-1] if segments else None
            if isinstance(each, Fourier | Off) and isinstance(before, Plateau) and before.moving:
                expected = "a rest before it, because the plateau before it ends in motion"
                raise FieldError("run", "kind", section["kind"], expected)
            segments.append(each)
    joint, other = file.joints
    return Run(file.name, joint, tuple(segments), other)


@dataclass(frozen=True)
class _PlanFile:
    schema: Annotated[str, choice((SCHEMA,))]
    name: Text
    runs: tuple[Mapping[str, Any], ...] = ()
    limits: _LimitsFile = _LimitsFile()
    alone: tuple[_AloneLimits, ...] = ()

    def plan(self) -> Plan:
        """Return the plan. Raises FieldError."""
        if not self.runs:
            raise FieldError("plan", "runs", Verbatim("none"), "a list of at least one run")
        runs: list[Run] = []
        for n, section in enumerate(self.runs):
            with below(f"runs[{n}]"):
                run = _run(section)
                if any(run.name == each.name for each in runs):
                    raise FieldError("run", "name", run.name, "a unique name")
                runs.append(run)
        limits = self.limits.limits()
        return Plan(self.name, limits, tuple(runs), {each.joint: each.limits(limits) for each in self.alone})


@dataclass(frozen=True)
class _Turning:
    """A plateau of a joint that is moved alone."""

    velocity_rad_s: Annotated[float, limits("rad/s")]
    hold_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)]
    ramp_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)] = DEFAULT_RAMP_S

    def segment(self) -> Plateau:
        return Plateau(self.velocity_rad_s, 0.0, self.hold_s, self.ramp_s)


@dataclass(frozen=True)
class _AloneFourier:
    """A fourier segment of a joint that is moved alone."""

    duration_s: Annotated[float, limits("s", ge=0.1, le=LONGEST_S)]
    velocity: SeriesFile

    def segment(self) -> Fourier:
        one = self.velocity
        trajectory = FourierTrajectory(one.omega_rad_s, one.a, one.b, self.duration_s)
        return Fourier(trajectory, no_current(trajectory))


@dataclass(frozen=True)
class _PairFourier(_AloneFourier):
    current: CurrentFile

    def segment(self) -> Fourier:
        one = self.current
        series = FourierSeries(one.omega_rad_s, one.a, one.b, self.duration_s, one.offset_a)
        return replace(super().segment(), current=series)


_ALONE: Final[Mapping[str, type]] = {"plateau": _Turning, "rest": Rest, "fourier": _AloneFourier}
_PAIR: Final[Mapping[str, type]] = {
    "plateau": Plateau,
    "rest": Rest,
    "power_off": Off,
    "fourier": _PairFourier,
}


def _segment(section: Mapping[str, Any], *, alone: bool) -> Segment:
    """`alone`: no segment has a current; without power a joint that carries a load would fall."""
    found = read_kind(_ALONE if alone else _PAIR, section)
    return found if isinstance(found, Plateau | Rest | Off) else found.segment()


def no_current(velocity: FourierTrajectory) -> FourierSeries:
    """Return the current of a joint that nothing tows."""
    return FourierSeries(velocity.omega_rad_s, (0.0,), (0.0,), velocity.duration_s)


def smooth_step(x: FloatArray) -> FloatArray:
    """10 x^3 - 15 x^4 + 6 x^5: from 0 to 1 over x in 0..1 with first and second derivative zero at both ends."""
    result: FloatArray = x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
    return result


def expand(run: Run) -> Setpoints:
    """Set-points of a run at 1 kHz, from rest.

    A plateau or rest begins where the segment before it ended: both targets go to their new values on one smooth step
    (velocity and acceleration continuous) and then hold. Ramp, hold, Fourier series and time
    without power are a mark each; "ramp" marks have no values.
    """
    velocities: list[FloatArray] = []
    currents: list[FloatArray] = []
    marks: list[Mark] = []
    off: list[tuple[int, int]] = []
    velocity = current = 0.0
    count = 0
    for segment in run.segments:
        if isinstance(segment, Fourier):
            n = samples(segment.duration_s)
            time_s = np.arange(n) * PERIOD_S
            velocities.append(segment.velocity.velocity(time_s))
            currents.append(segment.current.value(time_s))
            marks.append(Mark("fourier", count * PERIOD_S, (count + n) * PERIOD_S))
            count += n
            continue  # from rest to rest
        if isinstance(segment, Off):
            n = samples(segment.duration_s)
            velocities.append(np.full(n, velocity))  # at rest, or Setpoints refuses it
            currents.append(np.full(n, current))
            marks.append(Mark("power_off", count * PERIOD_S, (count + n) * PERIOD_S))
            off.append((count, count + n))
            count += n
            continue
        target = (segment.velocity_rad_s, segment.current_a) if isinstance(segment, Plateau) else (0.0, 0.0)
        ramp, hold = samples(segment.ramp_s), samples(segment.hold_s)
        if (velocity, current) == target:  # nothing to ramp: all of it is held
            ramp, hold = 0, ramp + hold
        share = np.concatenate((smooth_step(np.arange(1, ramp + 1) / max(ramp, 1)), np.ones(hold)))
        velocities.append(velocity + (target[0] - velocity) * share)
        currents.append(current + (target[1] - current) * share)
        middle, end = (count + ramp) * PERIOD_S, (count + ramp + hold) * PERIOD_S
        if ramp:
            marks.append(Mark("ramp", count * PERIOD_S, middle))
        if hold:
            kind = "plateau" if isinstance(segment, Plateau) else "rest"
            marks.append(Mark(kind, middle, end, *target))
        velocity, current = target
        count += ramp + hold
    if run.current_joint is None:
        marks = [replace(mark, current_a=None) for mark in marks]
    return Setpoints(
        run.velocity_joint,
        np.concatenate(velocities),
        np.concatenate(currents),
        tuple(marks),
        tuple(off),
        run.current_joint,
    )


def samples(duration_s: float) -> int:
    """Return the number of set-points in a time, to the nearest one."""
    return round(duration_s / PERIOD_S)


def travel_rad(setpoints: Setpoints) -> float:
    """Return the largest distance of the velocity joint from where the run begins [rad], joint side, either way."""
    return float(np.abs(path(setpoints)).max())


def check_run(run: Run, limits: Limits) -> Setpoints:
    """Set-points of a run that keeps the limits, does not jump, and ends at rest.

    Raises:
        ConfigError: naming the run, the quantity, when, what was found and the limit.
    """
    last = run.segments[-1]
    if isinstance(last, Plateau) and last.moving:
        raise ConfigError(
            f"run '{run.name}': found a plateau as last segment, expected rest or fourier, because a run must end at rest"
        )
    if not any(samples(segment.duration_s) for segment in run.segments):
        raise ConfigError(f"run '{run.name}': found no duration in its segments, expected more than 0 s")
    setpoints = expand(run)
    try:
        check_setpoints(setpoints, limits)
    except MotionError as error:
        raise ConfigError(f"run '{run.name}': {error}") from None
    return setpoints


def check_plan(plan: Plan) -> dict[str, Setpoints]:
    """Set-points of every run by its name. Raises ConfigError as check_run."""
    return {run.name: check_run(run, plan.limits_of(run)) for run in plan.runs}


def marks_of(run: Run, setpoints: Setpoints) -> dict[str, Any]:
    """Return the content of NAME.json: which segment was when, in seconds of the run table (to about a cycle)."""
    return {
        "run": run.name,
        "velocity_joint": run.velocity_joint,
        "current_joint": run.current_joint,
        "segments": [
            {
                "kind": mark.kind,
                "start_s": mark.start_s,
                "end_s": mark.end_s,
                "velocity_joint": run.velocity_joint,
                "velocity_rad_s": mark.velocity_rad_s,
                "current_a": mark.current_a,
            }
            for mark in setpoints.marks
        ],
    }
