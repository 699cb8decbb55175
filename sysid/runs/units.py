"""Columns in other units than the run table's, found by their size: degrees, rpm, counts, mNm, mA, ms.

Nothing is converted: a suspected factor belongs into the column map. What is compared holds whatever the friction may be, to
a factor of about two; the units looked for are further apart.

    velocity = d(position)/dt            motor turns = G link turns            sensor torque = slope * G Kt i + friction
    sensor torque = K (theta_m/G - theta_l)                                    peaks = a few times rated torque
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.runs.channels import TURNED_RAD, Channels, RunIssue

_CLOSE: Final = 0.05
"""Relative: two angle channels are proportional to each other, so that a factor between them is sharp."""
_SLOPE: Final = (0.2, 5.0)
"""Sensor torque per motor torque, friction aside, is 1; a joint file's torque constant is not wrong by more than this."""
_STIFFNESS: Final = 10.0
"""A joint file's stiffness is not wrong by more than this factor."""
_FASTEST_MOTOR_RAD_S: Final = 1000.0
_PEAK: Final = 10.0
"""Times rated torque; joints are overloaded two- or threefold."""
_HOTTEST_C: Final = 150.0
_STEP_K, _WARMING_K_PER_S = 2.0, 1.0  # between two samples: resolution, and more than any joint warms
_ENCODERS: Final = {2**bits: 2**bits / (2.0 * math.pi) for bits in range(10, 25)}
_ANGLES: Final = {
    "degrees": 180.0 / math.pi,
    "revolutions": 1.0 / (2.0 * math.pi),
    **{f"encoder counts ({counts} per revolution)": factor for counts, factor in _ENCODERS.items()},
}
"""Unit of an angle -> its value per rad."""
_SPEEDS: Final = {
    "rpm": 60.0 / (2.0 * math.pi),
    "degrees per second": 180.0 / math.pi,
    "revolutions per second": 1.0 / (2.0 * math.pi),
    **{
        f"encoder counts per second ({counts} per revolution)": factor for counts, factor in _ENCODERS.items()
    },
}
"""Unit of a velocity -> its value per rad/s."""


def unit_issues(c: Channels) -> list[RunIssue]:
    """Return at most one issue for the columns of a joint: what follows from the first wrong unit is not reported again."""
    for check in (_velocity, _angles, _motor_speed, _torque_and_current, _torsion):
        found = check(c)
        if found is not None:
            return [found]
    return []


def temperature_issue(c: Channels) -> RunIssue | None:
    """Return an issue for a temperature that no joint has, or a step that no joint can make."""
    temperature, time_s = c.run.temperature_c, c.time_s
    if temperature is None:
        return None
    steps = np.abs(np.diff(temperature))
    jumps = np.flatnonzero(steps > _STEP_K + _WARMING_K_PER_S * np.diff(time_s))
    if len(jumps):
        text = (
            f"found a step of {steps[jumps[0]]:.3g} degC at {time_s[jumps[0] + 1]:.3f} s, expected none above {_STEP_K:g}; "
            "not used"
        )
        return c.issue("temperature_c", "step", text)
    middle = float(np.median(temperature))
    if -60.0 < middle < _HOTTEST_C:
        return None
    guess = "kelvin or tenths of a degree" if 200.0 < middle < 450.0 else "another unit, or a dead channel"
    text = f"found {middle:.4g} degC as median, expected -60 to {_HOTTEST_C:g}: {guess} suspected; not used"
    return c.issue("temperature_c", "unit", text)


def _velocity(c: Channels) -> RunIssue | None:
    """Motor velocity against the derivative of the motor position."""
    if c.motor_steps is None:
        return None
    by_position, by_velocity = c.motor_steps
    if not np.any(by_position) or not np.any(by_velocity):
        return None
    turning = np.abs(by_position) > 0.2 * float(np.max(np.abs(by_position)))
    ratio = abs(float(np.median(by_velocity[turning] / by_position[turning])))
    if _near(ratio, 1.0) or ratio == 0.0:
        return None
    channel, expected = "motor_velocity_rad_s", "rad/s"
    if (unit := _named(ratio, _SPEEDS)) is not None:
        pass
    elif (unit := _named(1.0 / ratio, _ANGLES)) is not None:
        channel, expected = "motor_position_rad", "rad"
    elif _near(ratio, 1000.0) or _near(ratio, 1e6):
        unit = "milliseconds" if ratio < 1e5 else "microseconds"
        channel, expected = "time_s", "seconds"
    elif _near(ratio, 1.0 / c.joint.gear_ratio):
        unit, expected = "the joint side's velocity", "the motor's"
    elif _near(ratio, 1.0 / 6.0):
        unit, expected = "rpm and degrees", "rad/s and rad"
    else:
        return None  # a scale without a name: `check_channels` reports it
    at = f"{c.where}: time_s" if channel == "time_s" else f"{c.where}.{channel}"
    text = (
        f"found {ratio:.4g} times the derivative of motor_position_rad, expected the same: {unit} suspected"
    )
    return RunIssue("motor_velocity_rad_s_unit", f"{at}: {text}, expected {expected}")


def _angles(c: Channels) -> RunIssue | None:
    """Motor against link position."""
    if c.gear_ratio is None:
        return None
    turns, gear = abs(c.gear_ratio), c.joint.gear_ratio
    off = turns / gear
    found = f"found {turns:.5g} motor turns per turn of the link, gear_ratio of {c.joint.name} is {gear:g}"
    for channel, factor in (("motor_position_rad", off), ("link_position_rad", 1.0 / off)):
        if (unit := _named(factor, _ANGLES)) is not None:
            return c.issue(channel, "unit", f"{found}: {unit} suspected, expected rad")
    if _near(off, 1.0 / gear):
        text = f"{found}: an angle of the joint side suspected, expected the motor's"
        return c.issue("motor_position_rad", "unit", text)
    return None


def _motor_speed(c: Channels) -> RunIssue | None:
    """Return an issue for a motor faster than motors are: all angles are in degrees or counts."""
    if c.motor_velocity is None:
        return None
    top = float(np.quantile(np.abs(c.motor_velocity), 0.99))
    if top < _FASTEST_MOTOR_RAD_S:
        return None
    position = c.run.link_position_rad if c.run.motor_position_rad is None else c.run.motor_position_rad
    whole = position is not None and bool(np.all(position == np.round(position)))
    text = (
        f"{c.where}: found a motor speed of {top:.4g} rad/s ({top / c.joint.gear_ratio:.4g} rad/s of the joint), expected "
        f"less than {_FASTEST_MOTOR_RAD_S:g} rad/s: {'encoder counts' if whole or top > 1e5 else 'degrees'} suspected in "
        "positions and velocities, expected rad and rad/s"
    )
    return RunIssue("motor_velocity_rad_s_unit", text)


def _torque_and_current(c: Channels) -> RunIssue | None:
    """Sensor torque against motor torque, and both against rated torque: the one that is out of size is reported."""
    torque, motor = c.run.torque_nm, c.motor_nm
    if torque is None or motor is None:
        return None
    rated = c.joint.rated_torque_nm
    sizes = {"torque_nm": _peak(torque) / rated, "current_a": _peak(motor) / rated}
    slope = _slope(c, torque, motor)
    if slope is None or _SLOPE[0] < abs(slope) < _SLOPE[1]:
        if max(sizes.values()) < _PEAK:
            return None
        # both are too large alike: the joint file is common to them
        text = (
            f"{c.where}: found peaks of {sizes['torque_nm']:.3g} times rated_torque_nm ({rated:g} Nm) of {c.joint.name}, "
            f"expected at most {_PEAK:g}: a joint file of another joint, or mNm and mA"
        )
        return RunIssue("joint_file", text)
    size = abs(slope)
    if size > 1.0:
        channel = "torque_nm"
        unit = (
            "mNm"
            if 200.0 < size < 5000.0
            else "inch pounds or kgf cm"
            if 5.0 < size < 15.0
            else "mNm or counts"
        )
        if sizes["torque_nm"] < _PEAK and sizes["current_a"] < 0.01:
            channel, unit = "current_a", "kA, or a value relative to rated current,"
    elif sizes["current_a"] > sizes["torque_nm"] and sizes["current_a"] >= _PEAK:
        channel = "current_a"
        unit = "mA or counts" if 1.0 / size > 100.0 else "per mille of rated current, or counts,"
    elif _SLOPE[0] < size * c.joint.gear_ratio < _SLOPE[1]:
        channel, unit = "torque_nm", "torque of the motor side (or kNm)"
    else:
        channel, unit = "torque_nm", "kNm or a signal in volts"
    text = (
        f"found {size:.3g} Nm at the sensor per Nm of the motor (G Kt i), friction aside, expected about 1: {unit} "
        f"suspected, expected {'A' if channel == 'current_a' else 'Nm'}, or a joint file of another joint"
    )
    return c.issue(channel, "unit", text)


def _slope(c: Channels, torque: FloatArray, motor_nm: FloatArray) -> float | None:
    """Return d(sensor)/d(motor torque) in motion, with friction's sign, velocity and a constant; None: not excited."""
    moving = c.moving
    if c.speed is None or np.count_nonzero(moving) < 100:
        return None
    scale = float(np.std(motor_nm[moving]))
    if scale == 0.0:
        return None
    v = c.speed[moving] / float(np.max(np.abs(c.speed)))
    x = np.column_stack((motor_nm[moving] / scale, np.sign(v), v, np.ones(len(v))))
    solution, *_ = np.linalg.lstsq(x, torque[moving], rcond=None)
    residual = torque[moving] - x @ solution
    if float(np.std(x[:, 0] * solution[0])) < 2.0 * float(np.std(residual)):
        return None  # friction, not load, makes most of the current
    return float(solution[0]) / scale


def _torsion(c: Channels) -> RunIssue | None:
    """Sensor torque against the torsion between both encoders: the absolute scale of both angles."""
    motor, link, torque = c.run.motor_position_rad, c.run.link_position_rad, c.run.torque_nm
    if motor is None or link is None or torque is None:
        return None
    twist = motor / c.joint.gear_ratio - link
    twist, torque = twist - np.mean(twist), torque - np.mean(torque)
    energy = float(twist @ twist) * float(torque @ torque)
    if energy == 0.0 or float(np.ptp(motor)) < TURNED_RAD:
        return None
    both = float(twist @ torque)
    if both * both < 0.5 * energy:
        return None  # the torsion is not the spring's: encoder errors, hardly any torque
    stiffness = abs(float(torque @ torque) / both)
    off = c.joint.stiffness_nm_per_rad / stiffness
    if 1.0 / _STIFFNESS < off < _STIFFNESS:
        return None
    text = (
        f"{c.where}: found a stiffness of {stiffness:.3g} Nm/rad between torque_nm and the torsion of both positions, "
        f"{c.joint.name} has {c.joint.stiffness_nm_per_rad:.3g}: {'degrees' if 20.0 < off < 170.0 else 'another unit'} "
        "suspected in motor_position_rad and link_position_rad, expected rad, or a joint file of another joint"
    )
    return RunIssue("position_unit", text)


def _named(ratio: float, units: dict[str, float]) -> str | None:
    return next((name for name, factor in units.items() if _near(ratio, factor)), None)


def _near(ratio: float, factor: float) -> bool:
    return abs(ratio / factor - 1.0) < _CLOSE


def _peak(values: FloatArray) -> float:
    return float(np.quantile(np.abs(values), 0.99))
