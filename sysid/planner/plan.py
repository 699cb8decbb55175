"""Plans of motions (schema jtq.plan/1): Fourier series, segments, runs, limits; YAML, and set-points at 1 kHz.

A plan gives the commands of two joints on a towing bench, or of one that is moved alone, segment by segment: plateaus,
rests, rests without power, and Fourier trajectories. `expand` gives the set-points of a run, millisecond by millisecond;
`check_run` and `check_plan` compare them with the plan's limits.

A Fourier trajectory begins and ends at rest. Eq. (10) of the paper adds a polynomial of fifth order to the series of the
velocity, enough for position, velocity and acceleration at both ends. For a current that polynomial would cancel the offset:
the current is multiplied by a smooth step up at its beginning and down at its end instead.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import yaml
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import (
    FieldError,
    Text,
    below,
    check,
    choice,
    in_file,
    json_schema,
    limits,
    parsed,
    read,
    split,
)
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.text import finite
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
    moved_joints,
    partner_of,
    path,
)

# Fourier series -------------------------------------------------------------------------------------------------

RAMP_SHARE: Final = 0.1
"""Part of a current series' duration in which it rises from zero, and in which it falls back to zero."""
MAX_HARMONICS: Final = 50
_AMPLITUDES: Final = f"a list of 1 to {MAX_HARMONICS} finite numbers"


def _amplitudes(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_HARMONICS:
        raise FieldError("fourier", "", value, _AMPLITUDES)
    for item in value:
        if isinstance(item, bool) or not isinstance(item, int | float) or not math.isfinite(item):
            raise FieldError("fourier", "", item, _AMPLITUDES)
    return tuple(float(item) for item in value)


Amplitudes = Annotated[tuple[float, ...], parsed(_amplitudes, _AMPLITUDES)]


@dataclass(frozen=True)
class Series:
    """Amplitudes a, b of sines and cosines of omega_rad_s [rad/s] and its multiples; length duration_s [s].

    Raises FieldError: a number that is not finite, omega or duration not positive, none, too many or unequally many
    amplitudes.
    """

    omega_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    a: Amplitudes
    b: Amplitudes
    duration_s: Annotated[float, limits("s", gt=0.0)]

    def __post_init__(self) -> None:
        check(self, "fourier")
        for key in ("a", "b"):
            with below(key):
                _amplitudes(getattr(self, key))
        if len(self.a) != len(self.b):
            raise FieldError("fourier", "b", list(self.b), f"as many numbers as in 'a', {len(self.a)}")

    def to_mapping(self) -> dict[str, Any]:
        """Return the series as it stands in a plan, in Python's own numbers; the duration belongs to the segment."""
        return {
            "omega_rad_s": float(self.omega_rad_s),
            "a": [float(x) for x in self.a],
            "b": [float(x) for x in self.b],
        }


class FourierTrajectory(Series):
    """Motion of a joint by Eq. (10), joint side, from rest at position 0 to rest at position 0; a, b [rad/s].

        theta(t) = sum_k [a_k/(k w) sin(k w t) - b_k/(k w) cos(k w t)] + sum_j c_j t^(j-1),   k = 1..N, j = 1..6

    with velocity and acceleration as its derivatives. Outside of [0, duration_s] it rests. The motion is linear in (a, b).
    """

    @cached_property
    def polynomial(self) -> FloatArray:
        """c_1..c_6 [rad/s^(j-1)] that take position, velocity and acceleration to zero at both ends.

        In u = t/T the first three coefficients are the start itself; the other three follow from the end in closed form.
        """
        T = self.duration_s
        (p0, v0, a0), (p1, v1, a1) = (
            (0.0 - float(s) for s in self._series(np.float64(time))) for time in (0.0, T)
        )
        d0, d1, d2 = p0, v0 * T, 0.5 * a0 * T * T
        # what remains for u^3, u^4, u^5 at u = 1: value, first and second derivative
        p = p1 - (d0 + d1 + d2)
        v = v1 * T - (d1 + 2.0 * d2)
        a = a1 * T * T - 2.0 * d2
        d3, d4, d5 = 10.0 * p - 4.0 * v + 0.5 * a, -15.0 * p + 7.0 * v - a, 6.0 * p - 3.0 * v + 0.5 * a
        return np.asarray(np.array([d0, d1, d2, d3, d4, d5]) / T ** np.arange(6.0))

    def _series(self, t: Any) -> tuple[Any, Any, Any]:
        """Return position, velocity and acceleration of the bare series at t (scalar or array)."""
        position, velocity, acceleration = 0.0 * t, 0.0 * t, 0.0 * t
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            w = k * self.omega_rad_s
            sine, cosine = np.sin(w * t), np.cos(w * t)
            position = position + (a * sine - b * cosine) / w
            velocity = velocity + (a * cosine + b * sine)
            acceleration = acceleration + (b * cosine - a * sine) * w
        return position, velocity, acceleration

    def motion(self, time_s: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position [rad], velocity [rad/s] and acceleration [rad/s^2], joint side, at time_s [s], any shape."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        position, velocity, acceleration = (
            np.asarray(series + polyval(t, polyder(self.polynomial, order)))
            for order, series in enumerate(self._series(t))
        )
        return position, velocity, acceleration


@dataclass(frozen=True)
class FourierSeries(Series):
    """Current of the driving joint, zero with zero slope and curvature at both ends; a, b, offset_a [A].

        i(t) = r(t) (offset + sum_k [a_k cos(k w t) + b_k sin(k w t)])

    r is a `smooth_step` up over the first RAMP_SHARE of the duration and down over the last. Outside of [0, duration_s] the
    current is zero. Linear in (offset, a, b).
    """

    offset_a: Annotated[float, limits("A")] = 0.0

    def value(self, time_s: ArrayLike) -> FloatArray:
        """Return the current [A] at time_s [s], any shape."""
        t = np.asarray(time_s, dtype=np.float64)
        x = np.clip(np.minimum(t, self.duration_s - t) / (RAMP_SHARE * self.duration_s), 0.0, 1.0)
        series = np.full_like(t, self.offset_a)
        for k, (a, b) in enumerate(zip(self.a, self.b, strict=True), 1):
            phase = k * self.omega_rad_s * t
            series = series + (a * np.cos(phase) + b * np.sin(phase))
        return np.asarray(series * smooth_step(x))

    def to_mapping(self) -> dict[str, Any]:
        """As of `Series`, with the constant current."""
        return super().to_mapping() | {"offset_a": float(self.offset_a)}


def smooth_step(x: FloatArray) -> FloatArray:
    """10 x^3 - 15 x^4 + 6 x^5: from 0 to 1 over x in 0..1 with first and second derivative zero at both ends."""
    result: FloatArray = x * x * x * (10.0 + x * (-15.0 + 6.0 * x))
    return result


# Segments -------------------------------------------------------------------------------------------------------

SCHEMA: Final = "jtq.plan/1"
DEFAULT_RAMP_S: Final = 0.5
LONGEST_S: Final = 3600.0
"""Of one segment. A run is one log and one table in memory."""
SHORTEST_OFF_S: Final = 1.5
"""Of one segment without power: standing, switching off and on again take about half a second of it."""

_Seconds = Annotated[float, limits("s", ge=0.0, le=LONGEST_S)]


class _Held:
    """Targets that are reached within ramp_s and held for hold_s [s]."""

    hold_s: float
    ramp_s = 0.0

    @property
    def duration_s(self) -> float:
        """Ramp and hold."""
        return self.ramp_s + self.hold_s


@dataclass(frozen=True)
class Plateau(_Held):
    """Both joints at their targets: velocity of the velocity joint (joint side), current of the other; own frames."""

    velocity_rad_s: Annotated[float, limits("rad/s")]
    current_a: Annotated[float, limits("A")]
    hold_s: _Seconds
    ramp_s: _Seconds = DEFAULT_RAMP_S

    @property
    def moving(self) -> bool:
        """Whether velocity or current is other than zero at its end."""
        return self.velocity_rad_s != 0.0 or self.current_a != 0.0


@dataclass(frozen=True)
class Rest(_Held):
    """Both targets at zero."""

    hold_s: _Seconds
    ramp_s: _Seconds = DEFAULT_RAMP_S


@dataclass(frozen=True)
class Off(_Held):
    """Both joints stand and their drives are off, switching off and on included: the current then reads the offset of its
    sensor. Must begin at rest.
    """

    hold_s: Annotated[float, limits("s", ge=SHORTEST_OFF_S, le=LONGEST_S)]


@dataclass(frozen=True)
class Fourier:
    """Eq. (10) for the velocity joint and a Fourier series for the other joint's current; from rest to rest."""

    velocity: FourierTrajectory
    current: FourierSeries

    @classmethod
    def alone(cls, velocity: FourierTrajectory) -> Fourier:
        """Return the segment of a joint that is moved alone: the current is zero."""
        return cls(velocity, FourierSeries(velocity.omega_rad_s, (0.0,), (0.0,), velocity.duration_s))

    @property
    def duration_s(self) -> float:
        """Of both series."""
        return self.velocity.duration_s


Segment = Plateau | Rest | Fourier | Off
_KINDS: Final[Mapping[str, type[Segment]]] = {
    "plateau": Plateau,
    "rest": Rest,
    "power_off": Off,
    "fourier": Fourier,
}


def segment_mapping(segment: Segment) -> dict[str, Any]:
    """Return a segment as it stands in a plan."""
    if isinstance(segment, Fourier):
        series = {"velocity": segment.velocity.to_mapping(), "current": segment.current.to_mapping()}
        return {"kind": "fourier", "duration_s": segment.duration_s, **series}
    kind = next(kind for kind, each in _KINDS.items() if isinstance(segment, each))
    return {"kind": kind, **vars(segment)}


@dataclass(frozen=True)
class _FourierFile:
    duration_s: Annotated[float, limits("s", ge=0.1, le=LONGEST_S)]
    velocity: Mapping[str, Any]
    current: Mapping[str, Any]


def _segment(section: Mapping[str, Any], *, alone: bool) -> Segment:
    """Return a segment of a plan. alone: of a joint without a current; without power it would fall under a load."""
    kinds = [kind for kind in _KINDS if not (alone and kind == "power_off")]
    kind, keys = split(section, "kind", Annotated[str, choice(kinds)])
    if kind != "fourier":
        no_current = {"current_a": 0.0} if alone and kind == "plateau" else {}
        found: Segment = read(_KINDS[kind], keys, **no_current)
        return found
    file = read(_FourierFile, keys, **({"current": {}} if alone else {}))
    with below("velocity"):
        velocity = read(FourierTrajectory, file.velocity, duration_s=file.duration_s)
    if alone:
        return Fourier.alone(velocity)
    with below("current"):
        return Fourier(velocity, read(FourierSeries, file.current, duration_s=file.duration_s))


# Runs -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One run: its name (also that of its files), the joint in velocity mode, its segments in order, the other joint.

    current_joint: in torque mode; by default the other one of joints 1 and 2; None: the velocity joint is moved alone, and
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
        return moved_joints(self.velocity_joint, self.current_joint)

    @property
    def duration_s(self) -> float:
        """Sum over the segments."""
        return sum(segment.duration_s for segment in self.segments)

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        segments = [segment_mapping(segment) for segment in self.segments]
        if self.current_joint is None:
            for each in segments:
                each.pop("current", None)
                each.pop("current_a", None)
            return {"name": self.name, "joint": self.velocity_joint, "segments": segments}
        pair = {"velocity_joint": self.velocity_joint}
        if self.joints != (1, 2):
            pair["current_joint"] = self.current_joint
        return {"name": self.name, **pair, "segments": segments}


Point = tuple[float, float, float]
"""Velocity [rad/s], current [A], hold [s]."""


def run_over(
    name: str, velocity_joint: int, points: Iterable[Point], ramp_s: Callable[[float], float], edge_s: float
) -> Run:
    """Return the run from rest over all points, each held after a ramp, back to rest; edge_s: rest at either end.

    ramp_s: length of the ramp for a step of the velocity [rad/s].
    """
    segments: list[Segment] = [Rest(edge_s, 0.0)]
    velocity = 0.0
    for target, current, hold_s in points:
        segments.append(Plateau(target, current, hold_s, ramp_s(target - velocity)))
        velocity = target
    segments.append(Rest(edge_s, ramp_s(velocity)))
    return Run(name, velocity_joint, tuple(segments))


EDGE_S: Final = 1.0
"""Rest before and after Fourier trajectories."""
BETWEEN_S: Final = 2.0
"""Rest between two trajectories: section III of the paper."""


def trajectory_run(
    name: str, velocity_joint: int, *trajectories: Fourier, current_joint: int | None = OTHER_ONE
) -> Run:
    """Return a run of Fourier trajectories with rests before, between and after them."""
    segments: list[Segment] = [Rest(EDGE_S, 0.0)]
    for each in trajectories:
        segments += [each, Rest(BETWEEN_S, 0.0)]
    segments[-1] = Rest(EDGE_S, 0.0)
    return Run(name, velocity_joint, tuple(segments), current_joint)


_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_RESERVED: Final = ("plan", "campaign")
"""Names of the campaign's own files."""


def _run_name(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise FieldError("run", "", value, "a text")
    if not _NAME.fullmatch(value) or value in _RESERVED:
        raise ValueError("found another name")
    return value


_ALPHABET: Final = "letters, digits and . _ + -, beginning with a letter or digit, not 'plan' or 'campaign'"
_RunName = Annotated[str, parsed(_run_name, _ALPHABET)]
_Number = Annotated[int, limits(ge=1, le=MOST_JOINTS)]


@dataclass(frozen=True)
class _AloneRun:
    name: _RunName
    joint: _Number
    segments: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class _PairRun:
    name: _RunName
    velocity_joint: _Number
    segments: tuple[Mapping[str, Any], ...] = ()
    current_joint: _Number | None = None

    def __post_init__(self) -> None:
        if self.current_joint is None and self.velocity_joint > 2:
            raise FieldError("run", "current_joint", MISSING, f"a whole number from 1 to {MOST_JOINTS}")
        if self.current_joint == self.velocity_joint:
            raise FieldError("run", "current_joint", self.current_joint, "another joint than velocity_joint")


def _run(mapping: Mapping[str, Any]) -> Run:
    """Return a run of a plan. Raises FieldError."""
    file = read(_AloneRun, mapping) if "joint" in mapping else read(_PairRun, mapping)
    alone = isinstance(file, _AloneRun)
    if not file.segments:
        raise FieldError("run", "segments", Verbatim("none"), "a list of at least one segment")
    segments: list[Segment] = []
    for n, section in enumerate(file.segments):
        with below(f"segments[{n}]"):
            each = _segment(section, alone=alone)
            before = segments[-1] if segments else None
            if isinstance(each, Fourier | Off) and isinstance(before, Plateau) and before.moving:
                expected = "a rest before it, because the plateau before it ends in motion"
                raise FieldError("run", "kind", section["kind"], expected)
            segments.append(each)
    if isinstance(file, _AloneRun):
        return Run(file.name, file.joint, tuple(segments), None)
    other = OTHER_ONE if file.current_joint is None else file.current_joint
    return Run(file.name, file.velocity_joint, tuple(segments), other)


# Plans ----------------------------------------------------------------------------------------------------------

DEFAULT_LIMITS: Final = Limits(
    current_a=10.0, velocity_rad_s=3.3, torque_nm=60.0, travel_rad=60.0, temperature_c=70.0
)
_Ampere = Annotated[float, limits("A", gt=0.0)]
_RadPerSecond = Annotated[float, limits("rad/s", gt=0.0)]
_NewtonMetre = Annotated[float, limits("Nm", gt=0.0)]


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
        alone = [
            {
                "joint": number,
                "current_a": each.current_a,
                "velocity_rad_s": each.velocity_rad_s,
                "torque_nm": each.torque_nm,
                "travel_rad": list(each.position_rad),
            }
            for number, each in sorted(self.alone.items())
        ]
        return {
            "schema": SCHEMA,
            "name": self.name,
            "limits": {each.name: finite(getattr(self.limits, each.name)) for each in fields(_LimitsFile)},
            **({"alone": alone} if alone else {}),
            "runs": [run.to_mapping() for run in self.runs],
        }

    def limits_of(self, run: Run | Setpoints) -> Limits:
        """Return the limits of a run. Raises ConfigError for a joint that is moved alone without limits."""
        if run.current_joint is not None:
            return self.limits
        if run.velocity_joint not in self.alone:
            raise ConfigError(
                f"alone: found no limits of joint {run.velocity_joint}, expected them of a joint that is moved alone"
            )
        return self.alone[run.velocity_joint]

    @property
    def sha256(self) -> str:
        """Hash of the content (hex), independent of the layout of the file."""
        text = json.dumps(self.to_mapping(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def duration_s(self) -> float:
        """Sum over the runs, without the times between them."""
        return sum(run.duration_s for run in self.runs)

    def to_yaml(self) -> str:
        """Return the plan as a file; `from_mapping` of it gives the same plan."""
        return yaml.safe_dump(self.to_mapping(), sort_keys=False, default_flow_style=None, width=120)


def load_plan(path: Path) -> Plan:
    """Read a plan file. Raises ConfigError."""
    return Plan.from_mapping(load_yaml(path), str(path))


@dataclass(frozen=True)
class _LimitsFile:
    """`limits` of a plan; temperature_c: null means no limit."""

    current_a: _Ampere = DEFAULT_LIMITS.current_a
    velocity_rad_s: _RadPerSecond = DEFAULT_LIMITS.velocity_rad_s
    torque_nm: _NewtonMetre = DEFAULT_LIMITS.torque_nm
    travel_rad: Annotated[float, limits("rad", gt=0.0)] = DEFAULT_LIMITS.travel_rad
    temperature_c: Annotated[float, limits("degC", gt=0.0)] | None = DEFAULT_LIMITS.temperature_c


@dataclass(frozen=True)
class _AloneLimits:
    """`alone` of a plan; travel_rad by the joint's own encoder, the temperature's limit is the plan's."""

    joint: _Number
    current_a: _Ampere
    velocity_rad_s: _RadPerSecond
    torque_nm: _NewtonMetre
    travel_rad: Annotated[tuple[float, float], limits("rad")]

    def __post_init__(self) -> None:
        if not self.travel_rad[0] < self.travel_rad[1]:
            raise FieldError("alone", "travel_rad", list(self.travel_rad), "two rising numbers in rad")


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
        celsius = math.inf if self.limits.temperature_c is None else self.limits.temperature_c
        alone = {
            each.joint: Limits(
                current_a=each.current_a,
                velocity_rad_s=each.velocity_rad_s,
                torque_nm=each.torque_nm,
                travel_rad=each.travel_rad[1] - each.travel_rad[0],
                temperature_c=celsius,
                position_rad=each.travel_rad,
            )
            for each in self.alone
        }
        return Plan(self.name, Limits(**vars(self.limits) | {"temperature_c": celsius}), tuple(runs), alone)


def plan_schema() -> dict[str, Any]:
    """Return the JSON schema of a plan as `Plan.from_mapping` reads it."""

    def segments(*, alone: bool) -> dict[str, Any]:
        kinds = {
            name: json_schema(kind, *(["current_a"] if alone else []))
            for name, kind in _KINDS.items()
            if not (alone and kind is Off) and kind is not Fourier
        }
        file = json_schema(_FourierFile, *(["current"] if alone else []))
        series = {"velocity": FourierTrajectory} | ({} if alone else {"current": FourierSeries})
        file["properties"] |= {name: json_schema(kind, "duration_s") for name, kind in series.items()}
        kinds["fourier"] = file
        for name, each in kinds.items():
            each["properties"]["kind"] = {"const": name}
            each["required"].append("kind")
        return {"type": "array", "minItems": 1, "items": {"anyOf": [*kinds.values()]}}

    runs = [json_schema(each) for each in (_AloneRun, _PairRun)]
    for each, alone in zip(runs, (True, False), strict=True):
        each["properties"]["segments"] = segments(alone=alone)
        each["required"].append("segments")
    plan = json_schema(_PlanFile)
    plan["properties"]["runs"] = {"type": "array", "minItems": 1, "items": {"anyOf": runs}}
    plan["required"].append("runs")
    return plan


# Set-points -----------------------------------------------------------------------------------------------------


def expand(run: Run) -> Setpoints:
    """Return the set-points of a run at 1 kHz, from rest.

    A plateau or rest begins where the segment before it ended: both targets go to their new values on one smooth step
    (velocity and acceleration continuous) and then hold. Ramp, hold, Fourier series and time without power are a mark each;
    "ramp" marks have no values.
    """
    velocities: list[FloatArray] = []
    currents: list[FloatArray] = []
    marks: list[Mark] = []
    off: list[tuple[int, int]] = []
    velocity = current = 0.0
    count = 0

    def add(kind: str, v: FloatArray, i: FloatArray, *target: float) -> None:
        nonlocal count
        velocities.append(v)
        currents.append(i)
        if len(v):
            marks.append(Mark(kind, count * PERIOD_S, (count + len(v)) * PERIOD_S, *target))
        count += len(v)

    for segment in run.segments:
        n = samples(segment.duration_s)
        if isinstance(segment, Fourier):  # from rest to rest
            time_s = np.arange(n) * PERIOD_S
            add("fourier", segment.velocity.motion(time_s)[1], segment.current.value(time_s))
        elif isinstance(segment, Off):  # at rest, or Setpoints refuses it
            off.append((count, count + n))
            add("power_off", np.full(n, velocity), np.full(n, current))
        else:
            plateau = isinstance(segment, Plateau)
            target = (
                (segment.velocity_rad_s, segment.current_a) if isinstance(segment, Plateau) else (0.0, 0.0)
            )
            ramp, hold = samples(segment.ramp_s), samples(segment.hold_s)
            if (velocity, current) == target:  # nothing to ramp: all of it is held
                ramp, hold = 0, ramp + hold
            dv, di = target[0] - velocity, target[1] - current
            share = smooth_step(np.arange(1, ramp + 1) / max(ramp, 1))
            add("ramp", velocity + dv * share, current + di * share)
            ones = np.ones(hold)
            add("plateau" if plateau else "rest", velocity + dv * ones, current + di * ones, *target)
            velocity, current = target
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
    """Return the set-points of a run that keeps the limits, does not jump, and ends at rest.

    Raises ConfigError naming the run, the quantity, when, what was found and the limit.
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
    """Return the set-points of every run by its name. Raises ConfigError as check_run."""
    return {run.name: check_run(run, plan.limits_of(run)) for run in plan.runs}


def marks_of(run: Run, setpoints: Setpoints) -> dict[str, Any]:
    """Return the content of NAME.json: when each segment was, in seconds of the run table (to about a cycle)."""
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


# Partial runs ---------------------------------------------------------------------------------------------------

BACK_RAD: Final = 0.005
"""A joint that is moved alone has come back where it is no further than this from where it began."""


def partial_runs(run: Run) -> tuple[Run, ...]:
    """Return a run cut into runs from rest to rest, NAME~1, NAME~2, ...; the run itself where it cannot be cut.

    A run is cut in the middle of the rests between its motions; a joint that is moved alone must have come back there to
    where it began. A run of one direction, which does not rest, is cut between its plateaus, each with the ramps of the
    run's own ends. A partial run never goes further from its start than the run does.
    """
    moving = [place for place, each in enumerate(run.segments) if not isinstance(each, Rest)]
    if len(moving) < 2 or any(isinstance(each, Off) for each in run.segments):
        return (run,)
    parts = tuple(
        replace(run, name=f"{run.name}~{number}", segments=tuple(each))
        for number, each in enumerate(_cut_at_plateaus(run, moving) or _cut_at_rests(run, moving[-1]), 1)
    )
    far = travel_rad(expand(run)) + BACK_RAD
    if len(parts) < 2 or any(travel_rad(expand(part)) > far for part in parts):
        return (run,)
    return parts


def _cut_at_rests(run: Run, last: int) -> list[list[Segment]]:
    """Cut in the middle of each rest between two motions; last: place of the last motion."""
    parts: list[list[Segment]] = [[]]
    whole = path(expand(run))
    ends = np.cumsum([samples(each.duration_s) for each in run.segments])
    position = whole[np.minimum(ends, len(whole)) - 1]  # at the end of each segment
    moved = False
    for place, each in enumerate(run.segments):
        home = run.current_joint is not None or abs(position[place]) <= BACK_RAD
        if isinstance(each, Rest) and moved and place < last and home:
            # only after a plateau does the rest begin with a ramp down
            ramp_s = each.ramp_s if isinstance(run.segments[place - 1], Plateau) else 0.0
            half_s = 0.5 * (each.duration_s - ramp_s)
            parts[-1].append(Rest(half_s, ramp_s))
            parts.append([Rest(half_s, 0.0)])
            moved = False
            continue
        moved = moved or not isinstance(each, Rest)
        parts[-1].append(each)
    return parts


def _cut_at_plateaus(run: Run, moving: list[int]) -> list[list[Segment]]:
    """Cut a run of plateaus of one direction on a towing bench; nothing for any other run."""
    plateaus = [each for each in run.segments if isinstance(each, Plateau)]
    first, last = run.segments[0], run.segments[-1]
    if run.current_joint is None or len(plateaus) != len(moving) or moving[-1] - moving[0] + 1 != len(moving):
        return []
    if not isinstance(first, Rest) or not isinstance(last, Rest):
        return []
    if not (all(p.velocity_rad_s > 0.0 for p in plateaus) or all(p.velocity_rad_s < 0.0 for p in plateaus)):
        return []
    ramp_s = max(each.ramp_s for each in (plateaus[0], last))
    ends = Rest(first.duration_s, 0.0), Rest(last.hold_s, ramp_s)
    return [[ends[0], replace(each, ramp_s=max(ramp_s, each.ramp_s)), ends[1]] for each in plateaus]
