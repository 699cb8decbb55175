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
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, Section, finite
from jtqd.estimator.decoder import decode, limits
from jtqd.models.files import load_yaml
from jtqd.sysid.excitation.fourier import FourierSeries, FourierTrajectory
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

SCHEMA: Final = "jtq.plan/1"
DEFAULT_RAMP_S: Final = 0.5
LONGEST_S: Final = 3600.0
"""Of one segment. A run is one log and one table in memory."""
SHORTEST_OFF_S: Final = 1.5
"""Of one segment without power: standing, switching off and on again take about half a second of it."""

DEFAULT_LIMITS: Final = Limits(
    current_a=10.0, velocity_rad_s=3.3, torque_nm=60.0, travel_rad=60.0, temperature_c=70.0
)
_LIMIT_UNITS: Final = {
    "current_a": "A",
    "velocity_rad_s": "rad/s",
    "torque_nm": "Nm",
    "travel_rad": "rad",
    "temperature_c": "degC",
}
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
        top = Section(mapping, where)
        top.text("schema", (SCHEMA,))
        name = top.text("name")
        limits = _limits(top)
        sections = top.sections("runs")
        if not sections:
            raise top.error("runs", top.raw("runs", None), "a list of at least one run")
        runs = tuple(_run(section) for section in sections)
        seen: set[str] = set()
        for section, run in zip(sections, runs, strict=True):
            if run.name in seen:
                raise section.error("name", run.name, "a unique name")
            seen.add(run.name)
        alone = dict(_alone_limits(section, limits) for section in top.sections("alone"))
        top.finish()
        return cls(name, limits, runs, alone)

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        return {
            "schema": SCHEMA,
            "name": self.name,
            "limits": {name: finite(getattr(self.limits, name)) for name in _LIMIT_UNITS},
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


def _limits(top: Section) -> Limits:
    """`limits` of a plan; a key left out has its value in DEFAULT_LIMITS, temperature_c: null means no limit."""
    section = top.section("limits", optional=True)
    if section is None:
        return DEFAULT_LIMITS
    values = {
        name: section.number(name, unit, above=0.0, default=getattr(DEFAULT_LIMITS, name))
        for name, unit in _LIMIT_UNITS.items()
        if name != "temperature_c" or section.raw(name, 0.0) is not None
    }
    section.finish()
    return _limits_from(values)


def _limits_from(values: Mapping[str, float]) -> Limits:
    """Return limits by their names; a temperature that is left out is not supervised."""
    return Limits(
        current_a=values["current_a"],
        velocity_rad_s=values["velocity_rad_s"],
        torque_nm=values["torque_nm"],
        travel_rad=values["travel_rad"],
        temperature_c=values.get("temperature_c", math.inf),
    )


@dataclass(frozen=True)
class _AloneLimits:
    """Limits of a joint that is moved alone; its travel is that of its own encoder, its temperature's limit the plan's."""

    joint: Annotated[int, limits(ge=1, le=MOST_JOINTS)]
    current_a: Annotated[float, limits("A", gt=0.0)]
    velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)]
    torque_nm: Annotated[float, limits("Nm", gt=0.0)]
    travel_rad: Annotated[tuple[float, float], limits("rad")]


def _of_joint(number: int, limits: Limits) -> dict[str, Any]:
    """Return limits of a joint that is moved alone, plain."""
    values = {name: getattr(limits, name) for name in ("current_a", "velocity_rad_s", "torque_nm")}
    return {"joint": number, **values, "travel_rad": list(limits.position_rad)}


def _alone_limits(section: Section, plan: Limits) -> tuple[int, Limits]:
    found = decode(_AloneLimits, section)
    low, high = found.travel_rad
    if not low < high:
        raise section.error("travel_rad", [low, high], "two rising numbers in rad")
    return found.joint, Limits(
        current_a=found.current_a,
        velocity_rad_s=found.velocity_rad_s,
        torque_nm=found.torque_nm,
        travel_rad=high - low,
        temperature_c=plan.temperature_c,
        position_rad=(low, high),
    )


def _joints_of(section: Section) -> tuple[int, int | None]:
    """Velocity joint and current joint of a run; None for one that is moved alone (`joint`)."""
    if section.has("joint"):
        return section.integer("joint", low=1, high=MOST_JOINTS), None
    joint = section.integer("velocity_joint", low=1, high=MOST_JOINTS)
    if joint <= 2 and not section.has("current_joint"):
        return joint, OTHER_ONE
    other = section.integer("current_joint", low=1, high=MOST_JOINTS)
    if other == joint:
        raise section.error("current_joint", other, "another joint than velocity_joint")
    return joint, other


def _run(section: Section) -> Run:
    name = section.text("name")
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise section.error(
            "name",
            name,
            "letters, digits and . _ + -, beginning with a letter or digit, not 'plan' or 'campaign'",
        )
    joint, other = _joints_of(section)
    inner = section.sections("segments")
    if not inner:
        raise section.error("segments", section.raw("segments", None), "a list of at least one segment")
    segments = tuple(_segment(each, alone=other is None) for each in inner)
    for before, one, each in zip((None, *segments), segments, inner, strict=False):
        if isinstance(one, Fourier | Off) and isinstance(before, Plateau) and before.moving:
            kind = one.to_mapping()["kind"]
            raise each.error("kind", kind, "a rest before it, because the plateau before it ends in motion")
    section.finish()
    return Run(name, joint, segments, other)


@dataclass(frozen=True)
class _Turning:
    """A plateau of a joint that is moved alone."""

    velocity_rad_s: Annotated[float, limits("rad/s")]
    hold_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)]
    ramp_s: Annotated[float, limits("s", ge=0.0, le=LONGEST_S)] = DEFAULT_RAMP_S


def _segment(section: Section, *, alone: bool) -> Segment:
    """`alone`: no segment has a current; without power a joint that carries a load would fall."""
    kinds = ("plateau", "rest", "fourier") if alone else ("plateau", "rest", "power_off", "fourier")
    kind = section.text("kind", kinds)
    if kind == "fourier":
        return _fourier(section, alone=alone)
    if kind == "power_off":
        return decode(Off, section)
    if kind == "rest":
        return decode(Rest, section)
    if alone:
        turning = decode(_Turning, section)
        return Plateau(turning.velocity_rad_s, 0.0, turning.hold_s, turning.ramp_s)
    return decode(Plateau, section)


def no_current(velocity: FourierTrajectory) -> FourierSeries:
    """Return the current of a joint that nothing tows."""
    return FourierSeries(velocity.omega_rad_s, (0.0,), (0.0,), velocity.duration_s)


def _fourier(section: Section, *, alone: bool) -> Fourier:
    duration_s = section.number("duration_s", "s", low=0.1, high=LONGEST_S)
    velocity = section.required("velocity")
    current = None if alone else section.required("current")
    section.finish()
    try:
        trajectory = FourierTrajectory.from_section(velocity, duration_s)
        return Fourier(
            trajectory,
            no_current(trajectory) if current is None else FourierSeries.from_section(current, duration_s),
        )
    except ConfigError as error:
        if str(error).startswith(section.where):
            raise
        raise ConfigError(f"{section.where}: key '{section.path}': {error}") from None


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
