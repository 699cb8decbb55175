"""Plans of a campaign (schema jtq.plan/1): frozen, checked, to and from YAML, and as set-points at 1 kHz.

A plan gives the commands of both joints in every run, segment by segment. `expand` makes set-points of a run, millisecond
by millisecond; `check_run` and `check_plan` hold them against the plan's own limits. All but `load_plan` is pure.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, Section, finite
from jtqd.estimator.decoder import decode, limits
from jtqd.models.files import load_yaml
from jtqd.sysid.excitation.fourier import FourierSeries, FourierTrajectory
from jtqd.sysid.motion.setpoints import PERIOD_S, Limits, Mark, MotionError, Setpoints, check_setpoints

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
    """One run: its name (also that of its files), the joint in velocity mode, and its segments in order."""

    name: str
    velocity_joint: int
    segments: tuple[Segment, ...]

    @property
    def duration_s(self) -> float:
        """Sum over the segments."""
        return sum(segment.duration_s for segment in self.segments)

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        return {
            "name": self.name,
            "velocity_joint": self.velocity_joint,
            "segments": [segment.to_mapping() for segment in self.segments],
        }


@dataclass(frozen=True)
class Plan:
    """A campaign: name, limits that hold in every run, and the runs in order."""

    name: str
    limits: Limits
    runs: tuple[Run, ...]

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
        top.finish()
        return cls(name, limits, runs)

    def to_mapping(self) -> dict[str, Any]:
        """Plain values, ready for YAML."""
        return {
            "schema": SCHEMA,
            "name": self.name,
            "limits": {name: finite(getattr(self.limits, name)) for name in _LIMIT_UNITS},
            "runs": [run.to_mapping() for run in self.runs],
        }

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
    return Limits(**values)


def _run(section: Section) -> Run:
    name = section.text("name")
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise section.error(
            "name",
            name,
            "letters, digits and . _ + -, beginning with a letter or digit, not 'plan' or 'campaign'",
        )
    joint = section.integer("velocity_joint", low=1, high=2)
    inner = section.sections("segments")
    if not inner:
        raise section.error("segments", section.raw("segments", None), "a list of at least one segment")
    segments = tuple(_segment(each) for each in inner)
    for before, one, each in zip((None, *segments), segments, inner, strict=False):
        if isinstance(one, Fourier | Off) and isinstance(before, Plateau) and before.moving:
            kind = one.to_mapping()["kind"]
            raise each.error("kind", kind, "a rest before it, because the plateau before it ends in motion")
    section.finish()
    return Run(name, joint, segments)


def _segment(section: Section) -> Segment:
    kind = section.text("kind", ("plateau", "rest", "power_off", "fourier"))
    if kind == "fourier":
        return _fourier(section)
    if kind == "power_off":
        return decode(Off, section)
    return decode(Rest, section) if kind == "rest" else decode(Plateau, section)


def _fourier(section: Section) -> Fourier:
    duration_s = section.number("duration_s", "s", low=0.1, high=LONGEST_S)
    velocity, current = section.required("velocity"), section.required("current")
    section.finish()
    try:
        return Fourier(
            FourierTrajectory.from_section(velocity, duration_s),
            FourierSeries.from_section(current, duration_s),
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
    return Setpoints(
        run.velocity_joint, np.concatenate(velocities), np.concatenate(currents), tuple(marks), tuple(off)
    )


def samples(duration_s: float) -> int:
    """Return the number of set-points in a time, to the nearest one."""
    return round(duration_s / PERIOD_S)


def travel_rad(setpoints: Setpoints) -> float:
    """Return the largest distance of the velocity joint from where the run begins [rad], joint side, either way."""
    position = np.cumsum(setpoints.velocity_rad_s) * PERIOD_S
    return float(np.abs(position).max())


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
    return {run.name: check_run(run, plan.limits) for run in plan.runs}


def marks_of(run: Run, setpoints: Setpoints) -> dict[str, Any]:
    """Return the content of NAME.json: which segment was when, in seconds of the run table (to about a cycle)."""
    return {
        "run": run.name,
        "velocity_joint": run.velocity_joint,
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
