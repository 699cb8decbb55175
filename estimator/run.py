"""A run as arrays: the recorded one (`RunTable`), what the observer saw of it, and its estimates.

A run table is checked once and read-only; columns that can be derived are derived on request.

Column names in messages are those of the files: `time_s`, `j1.current_a`, `j1.motor_position_rad`, ...
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray, StatusArray
from jtqd.estimator.status import NAMES


class RunTableError(ValueError):
    """The columns of a run cannot be used; one line that names column, found and expected."""


_SAME: Final = 1e-9
"""Of the travel: what rounding leaves between a position and the one that it was made of."""


@dataclass(frozen=True, slots=True)
class JointColumns:
    """Columns [n] of one joint, None where the run has none; SI units.

    Motor position and velocity are motor side, the rest is joint side. torque_nm is measured: what the
    joint exerts on the coupling, positive along its own positive current. enabled: 0 where the drive's power
    stage is off, else 1; None: nothing is known of it.
    """

    current_a: FloatArray | None = None
    motor_position_rad: FloatArray | None = None
    motor_velocity_rad_s: FloatArray | None = None
    link_position_rad: FloatArray | None = None
    link_velocity_rad_s: FloatArray | None = None
    torque_nm: FloatArray | None = None
    temperature_c: FloatArray | None = None
    enabled: FloatArray | None = None

    def __post_init__(self) -> None:
        for item in fields(self):
            column = getattr(self, item.name)
            if column is not None:
                object.__setattr__(self, item.name, _read_only(column, item.name))

    def __repr__(self) -> str:
        there = {
            item.name: column for item in fields(self) if (column := getattr(self, item.name)) is not None
        }
        return f"JointColumns({max(map(len, there.values()), default=0)} rows: {', '.join(there)})"

    def map(self, change: Callable[[str, FloatArray], FloatArray]) -> JointColumns:
        """Return a copy with `change(name, column)` in place of each column that is there."""
        columns = {item.name: getattr(self, item.name) for item in fields(self)}
        return JointColumns(**{name: None if x is None else change(name, x) for name, x in columns.items()})

    def two_encoders(self, gear_ratio: float) -> bool:
        """Return whether both sides of the gear were measured: positions that are each other through the ratio are one."""
        motor, link = self.motor_position_rad, self.link_position_rad
        if motor is None or link is None:
            return False
        apart = float(np.ptp(motor / gear_ratio - link))
        return apart > _SAME * float(np.ptp(link)) or float(np.ptp(motor)) == 0.0

    def derived(self, time_s: FloatArray, gear_ratio: float) -> JointColumns:
        """Return a copy in which missing positions and velocities are derived from what is there.

        A velocity is the central difference of its own position (second order, also for uneven steps; it
        looks one sample ahead, so it is for runs, not for the loop). Where one side of the gear has no
        encoder its position and velocity are the other side's through gear_ratio, the torsion neglected.
        Nothing else is made up.
        """
        q_m, w_m, q_l, w_l = (
            self.motor_position_rad,
            self.motor_velocity_rad_s,
            self.link_position_rad,
            self.link_velocity_rad_s,
        )
        if q_m is None and q_l is not None:
            q_m = q_l * gear_ratio
        elif q_l is None and q_m is not None:
            q_l = q_m / gear_ratio
        if w_m is None and self.motor_position_rad is None and w_l is not None:
            w_m = w_l * gear_ratio
        if w_m is None and q_m is not None:
            w_m = _slope(q_m, time_s)
        if w_l is None and self.link_position_rad is None and w_m is not None:
            w_l = w_m / gear_ratio
        if w_l is None and q_l is not None:
            w_l = _slope(q_l, time_s)
        return replace(
            self,
            motor_position_rad=q_m,
            motor_velocity_rad_s=w_m,
            link_position_rad=q_l,
            link_velocity_rad_s=w_l,
        )


INPUTS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
"""Columns that an estimator takes, in its order, after the time step."""
COLUMN_NAMES: Final = tuple(item.name for item in fields(JointColumns))
"""Names of a joint's columns without the prefix `jN.`."""


@dataclass(frozen=True, slots=True)
class RunTable:
    """One run: time_s [n], strictly increasing, and the columns of its joints (key: joint number).

    Raises RunTableError for fewer than 2 samples, unequal lengths, time that does not increase, values that
    are not finite; the message names the column and the first bad sample.
    """

    time_s: FloatArray
    joints: Mapping[int, JointColumns]

    def __post_init__(self) -> None:
        time_s = _read_only(self.time_s, "time_s")
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "joints", MappingProxyType(dict(self.joints)))
        if len(time_s) < 2:
            raise RunTableError(f"time_s: found {len(time_s)} samples, expected at least 2")
        _check_finite(time_s, "time_s")
        steps = np.diff(time_s)
        if not np.all(steps > 0.0):
            k = int(np.argmin(steps > 0.0)) + 1
            raise RunTableError(
                f"time_s: found {time_s[k]:g} after {time_s[k - 1]:g} at sample {k}, expected increasing time"
            )
        for number, columns in self.joints.items():
            for name in COLUMN_NAMES:
                column = getattr(columns, name)
                if column is None:
                    continue
                if len(column) != len(time_s):
                    raise RunTableError(
                        f"j{number}.{name}: found {len(column)} samples, expected {len(time_s)} as in time_s"
                    )
                _check_finite(column, f"j{number}.{name}")

    def __repr__(self) -> str:
        first, last = self.time_s[0], self.time_s[-1]
        joints = ", ".join(map(str, self.joints))
        return f"RunTable({len(self.time_s)} rows, {first:g} to {last:g} s, joints {joints})"

    def __reduce__(self) -> tuple[type[RunTable], tuple[FloatArray, dict[int, JointColumns]]]:
        """Copy and pickle through a plain dict: a mapping proxy can do neither."""
        return RunTable, (self.time_s, dict(self.joints))

    @property
    def dt_s(self) -> FloatArray:
        """Steps [n] as `Estimator.run` takes them; the first sample has none and gets 0."""
        return np.diff(self.time_s, prepend=self.time_s[0])

    def joint(self, number: int, gear_ratio: float) -> JointColumns:
        """Return a joint's columns, derivable ones filled in; RunTableError for an absent joint."""
        if number not in self.joints:
            have = ", ".join(f"j{n}" for n in self.joints) or "none"
            raise RunTableError(f"j{number}: found no columns of this joint, the run has {have}")
        return self.joints[number].derived(self.time_s, gear_ratio)

    def estimator_inputs(self, number: int, gear_ratio: float) -> tuple[FloatArray, ...]:
        """Return (dt_s, current, motor position, motor velocity, link position) of a joint, each [n].

        Raises RunTableError naming the column that is missing and cannot be derived.
        """
        columns = self.joint(number, gear_ratio)
        inputs = [self.dt_s]
        for name in INPUTS:
            column = getattr(columns, name)
            if column is None:
                raise RunTableError(f"j{number}.{name}: missing, and no column to derive it from")
            inputs.append(column)
        return tuple(inputs)


@dataclass(frozen=True, slots=True)
class ObservedRun:
    """Outputs of the fused observer over a run, arrays [n]; NaN where it was not running.

    Torques [Nm, joint side], velocity [rad/s, joint side]; waves [n, 4]: filtered cos and sin of 2 and 4 times
    the motor angle; temperature [n], NaN where unknown; direction [n], -1 to 1; dt_s [n], time since the sample before;
    open_nm [n]: what the torsion's slip leaves open to either side; ahead_nm [n]: the torsion that went through its own
    filter only, less torsion_nm, which is as old as raw_nm; turn [n, 2]: filtered cos and sin of the motor angle, [0, 2]
    where they are not known; behind_rad2 [n]: product of what the tracking filter leaves of this deflection and the last, 0
    without it, [0] where it is not known.
    """

    status: StatusArray
    raw_nm: FloatArray
    velocity_rad_s: FloatArray
    torsion_nm: FloatArray
    waves: FloatArray
    temperature_c: FloatArray
    direction: FloatArray
    dt_s: FloatArray
    open_nm: FloatArray
    ahead_nm: FloatArray
    turn: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    behind_rad2: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True)
class EstimateRun:
    """Fields of `Estimate` as read-only arrays [n], and the network's features [n, 6 or 7], NaN where not running.

    torque_rate_nm_s, load_nm: of the link (`detection`), load of the sample before; NaN where not known.
    """

    torque_nm: FloatArray
    sigma_nm: FloatArray
    status: StatusArray
    tob_nm: FloatArray
    physics_nm: FloatArray
    network_nm: FloatArray
    torque_rate_nm_s: FloatArray
    load_nm: FloatArray
    features: FloatArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            getattr(self, name).setflags(write=False)

    def __repr__(self) -> str:
        codes, counts = np.unique(self.status, return_counts=True)
        found = ", ".join(f"{NAMES[int(code)]} {count}" for code, count in zip(codes, counts, strict=True))
        return f"EstimateRun({len(self.status)} rows: {found})"


def _slope(position: FloatArray, time_s: FloatArray) -> FloatArray:
    result: FloatArray = np.gradient(position, time_s)
    return result


def _read_only(column: FloatArray, name: str) -> FloatArray:
    array = np.asarray(column, np.float64)
    if array.ndim != 1:
        raise RunTableError(f"{name}: found an array of shape {array.shape}, expected one dimension")
    array = array.view()
    array.setflags(write=False)
    return array


def _check_finite(column: FloatArray, name: str) -> None:
    good = np.isfinite(column)
    if not good.all():
        k = int(np.argmin(good))
        raise RunTableError(f"{name}: found {column[k]} at sample {k}, expected finite numbers")
