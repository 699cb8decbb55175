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
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError, Section
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

    voltage_v: str
    resistance_ohm: float
    back_emf_vs_per_rad: float

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
        full = {
            key: {"column": value} if isinstance(value, str) and key in targets() else value
            for key, value in mapping.items()
        }
        section = Section(full, where)
        columns: dict[str, Column] = {}
        for key in targets():
            value = section.raw(key, expected=_SOURCE) if key == TIME else section.raw(key, None)
            if key in full:
                if not isinstance(value, dict):
                    raise section.error(key, value, _SOURCE)
                columns[key] = _column(section.required(key))
        files = {
            joint: folder / section.text(f"j{joint}.joint_file")
            for joint in JOINTS
            if f"j{joint}.joint_file" in full
        }
        loads = {n: _load(section, n, columns) for n in JOINTS if f"j{n}.load" in full}
        drives = {n: _drive(section, n, columns) for n in JOINTS if f"j{n}.drive" in full}
        section.finish()
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


def _column(section: Section) -> Column:
    scale = section.number("scale", unit="target units per cell unit", default=1.0)
    if scale == 0.0:
        raise section.error("scale", scale, "a number other than 0")
    name = section.raw("column", expected="a column of the file, or an expression of columns")
    if not isinstance(name, str):
        raise section.error("column", name, "a column of the file, or an expression of columns")
    column = Column(
        name,
        scale,
        section.number("offset", unit="target units", default=0.0),
    )
    section.finish()
    return column


def _load(section: Section, joint: int, columns: Mapping[str, Column]) -> KnownLoad:
    key = f"j{joint}.load"
    if f"j{joint}.torque_nm" in columns:
        raise ConfigError(
            f"{section.where}: key '{key}': found it beside 'j{joint}.torque_nm', expected one reference of joint {joint}"
        )
    inner = section.required(key)
    if inner.has("torque_nm"):
        load = KnownLoad(inner.text("torque_nm"))
    else:
        bare = inner.has("inertia_kgm2") and not inner.has("mass_kg")  # it only turns
        mass = 0.0 if bare else inner.number("mass_kg", unit="kg", low=0.0)
        lever = 0.0 if bare else inner.number("lever_m", unit="m", low=0.0)
        inertia = inner.number("inertia_kgm2", unit="kg m2", low=0.0, default=mass * lever * lever)
        load = KnownLoad(
            None,
            mass,
            lever,
            inertia,
            inner.number("hangs_at_rad", unit="rad", default=0.0),
            inner.number("gravity_m_s2", unit="m/s2", low=0.0, high=30.0, default=GRAVITY_M_S2),
        )
        if f"j{joint}.link_position_rad" not in columns:
            raise ConfigError(
                f"{section.where}: key '{key}': found no 'j{joint}.link_position_rad', expected the angle of the load "
                "(from a motor encoder: its column with scale 1/gear_ratio)"
            )
    inner.finish()
    return load


def _drive(section: Section, joint: int, columns: Mapping[str, Column]) -> VoltageDrive:
    key = f"j{joint}.drive"
    if f"j{joint}.current_a" in columns:
        raise ConfigError(
            f"{section.where}: key '{key}': found it beside 'j{joint}.current_a', expected one of them"
        )
    if not {f"j{joint}.motor_velocity_rad_s", f"j{joint}.motor_position_rad"} & set(columns):
        raise ConfigError(
            f"{section.where}: key '{key}': found neither 'j{joint}.motor_velocity_rad_s' nor "
            f"'j{joint}.motor_position_rad', expected one: the back EMF needs the motor's speed"
        )
    inner = section.required(key)
    drive = VoltageDrive(
        inner.text("voltage_v"),
        inner.number("resistance_ohm", unit="ohm", above=0.0),
        inner.number("back_emf_vs_per_rad", unit="Vs/rad", low=0.0),
    )
    inner.finish()
    return drive
