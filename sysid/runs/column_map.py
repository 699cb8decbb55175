"""Column map: where the columns of a run table come from in somebody else's file, and what is known beside them.

    time_s: "stamp_s + 1e-9 * stamp_ns"                    a column, or an expression of columns (`expressions`)
    j1.link_position_rad: {column: angle, scale: 0.0175}   value = scale * cell + offset
    j1.load: {mass_kg: 1.5, lever_m: 0.2}                  the torque reference is a known load
    j2.load: {inertia_kgm2: 0.03}                          ... or what turns, and nothing pulls at it
    j3.load: {torque_nm: "model_torque - payload_torque"}  ... or a rigid-body model's torque
    j1.drive: {voltage_v: "duty * 12", resistance_ohm: 2.0, back_emf_vs_per_rad: 0.01}
    j1.joint_file: joint1.yaml                             beside the map

A known load is a pendulum on the joint's axis, q its link position [rad], positive along positive current:

    torque_nm = inertia d2q/dt2 + mass g lever sin(q - hangs_at)

A drive that gives no current gives its voltage; the winding's inductance is left out (it settles within a row):

    current_a = (voltage - back_emf omega_m) / resistance
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import Verbatim
from jtqd.estimator.decoder import (
    Field,
    FieldError,
    Text,
    field_of,
    in_file,
    limits,
    parsed,
    read,
    read_values,
)
from jtqd.estimator.run import COLUMN_NAMES
from jtqd.models.files import load_yaml
from jtqd.sysid.runs.expressions import Expression, ExpressionError, parse
from jtqd.sysid.runs.wild import wild_rows

TIME: Final = "time_s"
JOINTS: Final = range(1, 8)
GRAVITY_M_S2: Final = 9.80665
WINDOW_S: Final = 0.05
"""Longest piece of a position to which a cubic is fitted for its velocity and acceleration."""
_QUIET: Final = 0.02
_FEWEST_ROWS: Final = 7
_WILD_RAD: Final = 0.1
_SOURCE: Final = (
    "a column of the file, an expression of columns, or {column: either, scale: 1.0, offset: 0.0}"
)


@dataclass(frozen=True)
class Column:
    """value = scale * cell + offset, in the target's SI unit; name: a column or an expression. A negative scale flips the
    sign.
    """

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class KnownLoad:
    """What hangs on a joint whose torque nobody measured: a pendulum, or the torque that a model gives.

    torque_nm: a column or an expression [Nm], else None; mass [kg] at lever [m] from the axis, inertia about the axis
    [kg m2], hangs_at: link position at rest [rad].
    """

    torque_nm: str | None = None
    mass_kg: float = 0.0
    lever_m: float = 0.0
    inertia_kgm2: float = 0.0
    hangs_at_rad: float = 0.0
    gravity_m_s2: float = GRAVITY_M_S2

    def torque(self, time_s: FloatArray, position_rad: FloatArray) -> FloatArray:
        """Return what the joint exerts on the pendulum [n, Nm] at link positions [n] of one piece without gaps."""
        _, acceleration = motion_of(time_s, position_rad)
        weight = self.mass_kg * self.gravity_m_s2 * self.lever_m * np.sin(position_rad - self.hangs_at_rad)
        return self.inertia_kgm2 * acceleration + weight


@dataclass(frozen=True)
class VoltageDrive:
    """A drive that gives its voltage [V] (a column or an expression) and no current; back EMF: motor side, Vs/rad."""

    voltage_v: Text
    resistance_ohm: Annotated[float, limits("ohm", gt=0.0)]
    back_emf_vs_per_rad: Annotated[float, limits("Vs/rad", ge=0.0)]

    def current(self, voltage_v: FloatArray, motor_velocity_rad_s: FloatArray) -> FloatArray:
        """Return the current of the winding [n, A]."""
        return (voltage_v - self.back_emf_vs_per_rad * motor_velocity_rad_s) / self.resistance_ohm


@dataclass(frozen=True)
class ColumnMap:
    """Where each target column comes from; known loads and voltage drives by joint; joint files named by `jN.joint_file`.

    where: the map's file, for messages.
    """

    columns: Mapping[str, Column]
    joint_files: Mapping[int, Path]
    loads: Mapping[int, KnownLoad] | None = None
    drives: Mapping[int, VoltageDrive] | None = None
    where: str = ""

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object], where: str, folder: Path) -> ColumnMap:
        """Check a column map read from YAML.

        `TARGET: NAME` is short for `TARGET: {column: NAME, scale: 1.0, offset: 0.0}`. Raises ConfigError.
        """
        with in_file(where):
            values = read_values(_keys(), mapping)
            columns = {key: values[key] for key in targets() if key in values}
            loads = {n: values[f"j{n}.load"] for n in JOINTS if f"j{n}.load" in values}
            drives = {n: values[f"j{n}.drive"] for n in JOINTS if f"j{n}.drive" in values}
            for n, load in loads.items():
                _check_load(n, load, columns)
            for n in drives:
                _check_drive(n, columns)
        files = {n: folder / values[f"j{n}.joint_file"] for n in JOINTS if f"j{n}.joint_file" in values}
        return cls(columns, files, loads, drives, where)

    @classmethod
    def load(cls, path: Path) -> ColumnMap:
        """Read a column map file. Raises ConfigError."""
        mapping = load_yaml(path)
        return cls.from_mapping(mapping, str(path), path.parent)

    @property
    def known_loads(self) -> tuple[int, ...]:
        """Joints whose reference is a known load, not a sensor."""
        return tuple(sorted(self.loads or ()))

    def sources(self) -> dict[str, Column]:
        """Return every column or expression that is read: targets, `jN.load` (a torque) and `jN.drive` (a voltage)."""
        found = dict(self.columns)
        found |= {f"j{n}.load": Column(x.torque_nm) for n, x in (self.loads or {}).items() if x.torque_nm}
        return found | {f"j{n}.drive": Column(x.voltage_v) for n, x in (self.drives or {}).items()}

    def parsed(self, header: list[str], file: str) -> dict[str, Expression]:
        """Return the expression of every source for a file with these columns; `file` names it and its place.

        Raises ExpressionError: file, key, what was found and what was expected.
        """
        found = {}
        for key, column in self.sources().items():
            try:
                found[key] = parse(column.name, header, f"{key} of {self.where}" if self.where else key)
            except ExpressionError as error:
                raise ExpressionError(f"{file} {error}") from None
        return found

    def completed(self, values: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Return the targets [n] of one piece without gaps: torques of known loads and currents of voltage drives added.

        values: every source's, by its key.
        """
        found = {key: value for key, value in values.items() if key in self.columns}
        time = found[TIME]
        for n, load in (self.loads or {}).items():
            if load.torque_nm is not None:
                found[f"j{n}.torque_nm"] = values[f"j{n}.load"]
            else:
                found[f"j{n}.torque_nm"] = load.torque(time, found[f"j{n}.link_position_rad"])
        for n, drive in (self.drives or {}).items():
            speed = found.get(f"j{n}.motor_velocity_rad_s")
            if speed is None:
                speed = motion_of(time, found[f"j{n}.motor_position_rad"])[0]
            found[f"j{n}.current_a"] = drive.current(values[f"j{n}.drive"], speed)
        return found

    def remarks(self) -> list[str]:
        """Return one line for everything in the run table that was computed and not recorded."""
        lines = []
        for n, load in (self.loads or {}).items():
            what = (
                f"{load.torque_nm!r} of a model"
                if load.torque_nm is not None
                else f"a known load of {load.mass_kg:g} kg at {load.lever_m:g} m and {load.inertia_kgm2:g} kg m2"
            )
            lines.append(
                f"j{n}.torque_nm is {what}: taken as true, no effect of a torque sensor is looked for; what is "
                "wrong with the load is taken for the joint's"
            )
        for n, drive in (self.drives or {}).items():
            lines.append(
                f"j{n}.current_a is computed from {drive.voltage_v!r}, {drive.resistance_ohm:g} ohm and "
                f"{drive.back_emf_vs_per_rad:g} Vs/rad: a wrong resistance shows as torque_constant, a wrong back EMF "
                "as viscous_friction"
            )
        return lines


def targets() -> list[str]:
    """Return the columns of a run table."""
    return [TIME, *(f"j{joint}.{quantity}" for joint in JOINTS for quantity in COLUMN_NAMES)]


def motion_of(time_s: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return velocity and acceleration [n]: of the cubic through a window of the position around each row, ends held.

    The window is the shortest in which the position's noise (rounding included) is below _QUIET of the motion's largest
    acceleration, WINDOW_S at most: what is longer rounds the reversals off. Rows are taken as even (Savitzky and Golay 1964,
    doi 10.1021/ac60214a047). A wild sample (`wild`) is taken to lie between its neighbours: it would be in all the window.
    """
    wild = wild_rows(position, _WILD_RAD)
    if wild.any():
        position = np.interp(time_s, time_s[~wild], position[~wild])
    step = float(np.median(np.diff(time_s)))
    longest = min(
        max(_FEWEST_ROWS // 2, round(0.5 * WINDOW_S / step)),
        (len(position) - 1) // 2,
    )
    if longest < 2:
        velocity = np.gradient(position, time_s)
        return velocity, np.gradient(velocity, time_s)
    weights = _weights(longest, step)
    largest = float(np.max(np.abs(np.correlate(position, weights[1], mode="valid"))))
    noise = float(np.std(np.diff(position, 4))) / math.sqrt(
        70.0
    )  # of white noise; of the motion next to nothing
    half = longest
    for half in range(min(_FEWEST_ROWS // 2, longest), longest + 1):
        weights = _weights(half, step)
        if noise * float(np.linalg.norm(weights[1])) <= _QUIET * largest:
            break
    slope, bend = (np.correlate(position, each, mode="valid") for each in weights)
    return np.pad(slope, half, mode="edge"), np.pad(bend, half, mode="edge")


def _weights(half: int, step: float) -> tuple[FloatArray, FloatArray]:
    """Weights [2 half + 1] of a cubic's slope and second derivative in its middle."""
    at = np.arange(-half, half + 1) * step
    cubic = np.linalg.pinv(np.column_stack((np.ones_like(at), at, at * at, at**3)))
    return cubic[1], 2.0 * cubic[2]


def _name(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("found no text")
    return value


@dataclass(frozen=True)
class _ColumnFile:
    column: Annotated[str, parsed(_name, "a column of the file, or an expression of columns")]
    scale: Annotated[float, limits("target units per cell unit")] = 1.0
    offset: Annotated[float, limits("target units")] = 0.0

    def __post_init__(self) -> None:
        if self.scale == 0.0:
            raise FieldError("column", "scale", self.scale, "a number other than 0")


def _column(value: Any) -> Column:
    if isinstance(value, str):
        return Column(value)
    if not isinstance(value, dict):
        raise ValueError("found neither a text nor a mapping")
    file = read(_ColumnFile, value)
    return Column(file.column, file.scale, file.offset)


@dataclass(frozen=True)
class _Model:
    torque_nm: Text


@dataclass(frozen=True)
class _Turning:
    """A load that only turns."""

    inertia_kgm2: Annotated[float, limits("kg m2", ge=0.0)]
    hangs_at_rad: Annotated[float, limits("rad")] = 0.0
    gravity_m_s2: Annotated[float, limits("m/s2", ge=0.0, le=30.0)] = GRAVITY_M_S2


@dataclass(frozen=True)
class _Pendulum:
    """A load that hangs; left out, its inertia is that of a point."""

    mass_kg: Annotated[float, limits("kg", ge=0.0)]
    lever_m: Annotated[float, limits("m", ge=0.0)]
    inertia_kgm2: Annotated[float, limits("kg m2", ge=0.0)] = math.nan
    hangs_at_rad: Annotated[float, limits("rad")] = 0.0
    gravity_m_s2: Annotated[float, limits("m/s2", ge=0.0, le=30.0)] = GRAVITY_M_S2


def _load(value: Any) -> KnownLoad:
    keys = value if isinstance(value, dict) else {}
    if "torque_nm" in keys:
        return KnownLoad(read(_Model, value).torque_nm)
    if "inertia_kgm2" in keys and "mass_kg" not in keys:
        return KnownLoad(**vars(read(_Turning, value)))
    load = KnownLoad(**vars(read(_Pendulum, value)))
    return (
        replace(load, inertia_kgm2=load.mass_kg * load.lever_m * load.lever_m)
        if math.isnan(load.inertia_kgm2)
        else load
    )


@cache
def _keys() -> tuple[Field, ...]:
    """Return how every key of a column map is read."""
    column = Annotated[Column, parsed(_column, _SOURCE)]
    section = "a mapping of keys to values"
    kinds = {
        "joint_file": Text,
        "load": Annotated[KnownLoad, parsed(_load, section)],
        "drive": Annotated[VoltageDrive, parsed(lambda value: read(VoltageDrive, value), section)],
    }
    keys = [field_of(key, column, optional=key != TIME) for key in targets()]
    for joint in JOINTS:
        keys += [field_of(f"j{joint}.{key}", kind, optional=True) for key, kind in kinds.items()]
    return tuple(keys)


def _check_load(joint: int, load: KnownLoad, columns: Mapping[str, Column]) -> None:
    key = f"j{joint}.load"
    if f"j{joint}.torque_nm" in columns:
        found = Verbatim(f"it beside 'j{joint}.torque_nm'")
        raise FieldError("map", key, found, f"one reference of joint {joint}")
    if load.torque_nm is None and f"j{joint}.link_position_rad" not in columns:
        expected = "the angle of the load (from a motor encoder: its column with scale 1/gear_ratio)"
        raise FieldError("map", key, Verbatim(f"no 'j{joint}.link_position_rad'"), expected)


def _check_drive(joint: int, columns: Mapping[str, Column]) -> None:
    key, velocity, position = (
        f"j{joint}.drive",
        f"j{joint}.motor_velocity_rad_s",
        f"j{joint}.motor_position_rad",
    )
    if f"j{joint}.current_a" in columns:
        raise FieldError("map", key, Verbatim(f"it beside 'j{joint}.current_a'"), "one of them")
    if not {velocity, position} & set(columns):
        found = Verbatim(f"neither '{velocity}' nor '{position}'")
        raise FieldError("map", key, found, "one: the back EMF needs the motor's speed")
