"""Columns in other units than the run table's, found by their size and named: degrees, rpm, counts, mNm, mA, ms.

Nothing is converted: a factor that is only suspected belongs into the column map, by the hand of who knows the file. What
is compared holds whatever the friction may be, to a factor of two or so; the units looked for are further apart.

    velocity = d(position)/dt            motor turns = G link turns            sensor torque = slope * G Kt i + friction
    sensor torque = K (theta_m/G - theta_l)                                    peaks = a few times rated torque
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns
from jtqd.sysid.runs.channels import MOVING_RAD_S, TURNED_RAD, RunIssue, gear_ratio_of, integral

DEGREES: Final = 180.0 / math.pi
RPM: Final = 60.0 / (2.0 * math.pi)
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
_BLOCK_S: Final = 0.05


@dataclass(frozen=True)
class _Unit:
    """value in this unit = factor * value in SI; `name` in messages."""

    name: str
    factor: float


_ANGLES: Final = (
    _Unit("degrees", DEGREES),
    _Unit("revolutions", 1.0 / (2.0 * math.pi)),
    *(
        _Unit(f"encoder counts ({2**bits} per revolution)", 2**bits / (2.0 * math.pi))
        for bits in range(10, 25)
    ),
)
_SPEEDS: Final = (
    _Unit("rpm", RPM),
    _Unit("degrees per second", DEGREES),
    _Unit("revolutions per second", 1.0 / (2.0 * math.pi)),
    *(
        _Unit(f"encoder counts per second ({2**bits} per revolution)", 2**bits / (2.0 * math.pi))
        for bits in range(10, 25)
    ),
)


def unit_issues(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Return what looks like another unit in the measured columns of one joint; an empty list is good.

    time_s [n]; run: columns as read; `where` names run and joint. The first column that is off is named; what follows
    from it is not reported a second time.
    """
    return (
        _speed(time_s, run, joint, where)
        or _angles(time_s, run, joint, where)
        or _fast(time_s, run, joint, where)
        or _torque_and_current(time_s, run, joint, where)
        or _torsion(run, joint, where)
    )


def temperature_issue(time_s: FloatArray, run: JointColumns, where: str) -> RunIssue | None:
    """A temperature that no joint has, or a step that none makes: it would be a moment of the run, not its warmth."""
    if run.temperature_c is None:
        return None
    steps = np.abs(np.diff(run.temperature_c))
    jumps = np.flatnonzero(steps > _STEP_K + _WARMING_K_PER_S * np.diff(time_s))
    if len(jumps):
        return RunIssue(
            "temperature_c_step",
            f"{where}.temperature_c: found a step of {steps[jumps[0]]:.3g} degC at {time_s[jumps[0] + 1]:.3f} s, expected "
            f"none above {_STEP_K:g}; not used",
        )
    middle = float(np.median(run.temperature_c))
    if -60.0 < middle < _HOTTEST_C:
        return None
    guess = "kelvin or tenths of a degree" if 200.0 < middle < 450.0 else "another unit, or a dead channel"
    return RunIssue(
        "temperature_c_unit",
        f"{where}.temperature_c: found {middle:.4g} degC as median, expected -60 to {_HOTTEST_C:g}: {guess} suspected; "
        "not used",
    )


def _speed(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Motor velocity against the derivative of the motor position."""
    position, velocity = run.motor_position_rad, run.motor_velocity_rad_s
    if position is None or velocity is None:
        return []
    step = max(1, round(_BLOCK_S / float(np.median(np.diff(time_s)))))
    by_velocity = np.diff(integral(time_s, velocity)[::step])
    by_position = np.diff(position[::step])
    if not np.any(by_position) or not np.any(by_velocity):
        return []
    turning = np.abs(by_position) > 0.2 * float(np.max(np.abs(by_position)))
    ratio = abs(float(np.median(by_velocity[turning] / by_position[turning])))
    if abs(ratio - 1.0) < _CLOSE or ratio == 0.0:
        return []
    at = f"{where}.motor_velocity_rad_s"
    ratio_is = f"found {ratio:.4g} times the derivative of motor_position_rad"
    if (name := _named(ratio, _SPEEDS)) is not None:
        text = f"{at}: {ratio_is}, expected the same: {name} suspected, expected rad/s"
    elif (name := _named(1.0 / ratio, _ANGLES)) is not None:
        text = f"{where}.motor_position_rad: {ratio_is}, expected the same: {name} suspected, expected rad"
    elif _near(ratio, 1000.0) or _near(ratio, 1e6):
        unit = "milliseconds" if ratio < 1e5 else "microseconds"
        text = f"{where}: time_s: {ratio_is}, expected the same: {unit} suspected, expected seconds"
    elif _near(ratio, 1.0 / joint.gear_ratio):
        text = (
            f"{at}: {ratio_is}, expected the same: the joint side's velocity suspected, expected the motor's"
        )
    elif _near(ratio, 1.0 / 6.0):
        text = f"{at}: {ratio_is}, expected the same: rpm beside degrees suspected, expected rad/s and rad"
    else:
        return []  # a scale without a name: `check_channels` reports it
    return [RunIssue("motor_velocity_rad_s_unit", text)]


def _angles(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Motor against link position."""
    ratio = gear_ratio_of(time_s, run)
    if ratio is None:
        return []
    off = abs(ratio) / joint.gear_ratio
    ratio_is = f"found {abs(ratio):.5g} motor turns per turn of the link, gear_ratio of {joint.name} is {joint.gear_ratio:g}"
    for channel, factor in (("motor_position_rad", off), ("link_position_rad", 1.0 / off)):
        name = _named(factor, _ANGLES)
        if name is not None:
            return [
                RunIssue(f"{channel}_unit", f"{where}.{channel}: {ratio_is}: {name} suspected, expected rad")
            ]
    if _near(off, 1.0 / joint.gear_ratio):
        text = f"{where}.motor_position_rad: {ratio_is}: an angle of the joint side suspected, expected the motor's"
        return [RunIssue("motor_position_rad_unit", text)]
    return []


def _fast(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Return an issue for a motor faster than motors are: all angles are in degrees or counts."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if velocity is None:
        return []
    top = float(np.quantile(np.abs(velocity), 0.99))
    if top < _FASTEST_MOTOR_RAD_S:
        return []
    position = run.motor_position_rad if run.motor_position_rad is not None else run.link_position_rad
    whole = position is not None and bool(np.all(position == np.round(position)))
    guess = "encoder counts" if whole or top > 1e5 else "degrees"
    return [
        RunIssue(
            "motor_velocity_rad_s_unit",
            f"{where}: found a motor speed of {top:.4g} rad/s ({top / joint.gear_ratio:.4g} rad/s of the joint), "
            f"expected less than {_FASTEST_MOTOR_RAD_S:g} rad/s: {guess} suspected in positions and velocities, "
            "expected rad and rad/s",
        )
    ]


def _torque_and_current(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Sensor torque against motor torque, and both against rated torque: the one that is out of size is named."""
    torque, current = run.torque_nm, run.current_a
    if torque is None or current is None:
        return []
    rated = joint.rated_torque_nm
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * current
    sizes = {"torque_nm": _peak(torque) / rated, "current_a": _peak(motor) / rated}
    slope = _slope(time_s, run, joint, motor)
    usual = slope is None or _SLOPE[0] < abs(slope) < _SLOPE[1]
    if usual and max(sizes.values()) < _PEAK:
        return []
    if usual:  # both too large alike: what they share is the joint file
        return [
            RunIssue(
                "joint_file",
                f"{where}: found peaks of {sizes['torque_nm']:.3g} times rated_torque_nm ({rated:g} Nm) of {joint.name}, "
                f"expected at most {_PEAK:g}: a joint file of another joint, or mNm and mA",
            )
        ]
    assert slope is not None
    ratio_is = f"found {abs(slope):.3g} Nm at the sensor per Nm of the motor (G Kt i), friction aside, expected about 1"
    large = max(sizes, key=lambda name: sizes[name])
    if abs(slope) > 1.0:
        channel, name = "torque_nm", _torque_name(abs(slope))
        if sizes["torque_nm"] < _PEAK and sizes["current_a"] < 0.01:
            channel, name = "current_a", "kA, or a value relative to rated current,"
    elif large == "current_a" and sizes["current_a"] >= _PEAK:
        channel = "current_a"
        name = "mA or counts" if 1.0 / abs(slope) > 100.0 else "per mille of rated current, or counts,"
    elif _SLOPE[0] < abs(slope) * joint.gear_ratio < _SLOPE[1]:
        channel, name = "torque_nm", "torque of the motor side (or kNm)"
    else:
        channel, name = "torque_nm", "kNm or a signal in volts"
    expected = "A" if channel == "current_a" else "Nm"
    text = f"{where}.{channel}: {ratio_is}: {name} suspected, expected {expected}, or a joint file of another joint"
    return [RunIssue(f"{channel}_unit", text)]


def _torque_name(slope: float) -> str:
    if 200.0 < slope < 5000.0:
        return "mNm"
    if 5.0 < slope < 15.0:
        return "inch pounds or kgf cm"
    return "mNm or counts"


def _slope(time_s: FloatArray, run: JointColumns, joint: Joint, motor_nm: FloatArray) -> float | None:
    """d(sensor)/d(motor torque) in motion, with friction's sign, velocity and a constant beside it; None: not excited."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    assert run.torque_nm is not None
    if velocity is None or not np.any(velocity):
        return None
    speed = velocity / joint.gear_ratio
    moving = np.abs(speed) > MOVING_RAD_S
    if np.count_nonzero(moving) < 100:
        return None
    scale = float(np.std(motor_nm[moving]))
    if scale == 0.0:
        return None
    v = speed[moving] / float(np.max(np.abs(speed)))
    x = np.column_stack((motor_nm[moving] / scale, np.sign(v), v, np.ones(len(v))))
    solution, *_ = np.linalg.lstsq(x, run.torque_nm[moving], rcond=None)
    left = run.torque_nm[moving] - x @ solution
    if float(np.std(x[:, 0] * solution[0])) < 2.0 * float(np.std(left)):
        return None  # friction, not load, makes most of the current: a slope would say nothing
    return float(solution[0]) / scale


def _torsion(run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Sensor torque against the torsion between both encoders: the absolute scale of both angles."""
    motor, link, torque = run.motor_position_rad, run.link_position_rad, run.torque_nm
    if motor is None or link is None or torque is None:
        return []
    twist = motor / joint.gear_ratio - link
    twist, torque = twist - np.mean(twist), torque - np.mean(torque)
    energy = float(twist @ twist) * float(torque @ torque)
    if energy == 0.0 or float(np.ptp(motor)) < TURNED_RAD:
        return []
    both = float(twist @ torque)
    if both * both < 0.5 * energy:
        return []  # something else than the spring is in the torsion: errors of encoders, next to no torque
    stiffness = abs(float(torque @ torque) / both)
    off = joint.stiffness_nm_per_rad / stiffness
    if 1.0 / _STIFFNESS < off < _STIFFNESS:
        return []
    name = "degrees" if 20.0 < off < 170.0 else "another unit"
    return [
        RunIssue(
            "position_unit",
            f"{where}: found a stiffness of {stiffness:.3g} Nm/rad between torque_nm and the torsion of both positions, "
            f"{joint.name} has {joint.stiffness_nm_per_rad:.3g}: {name} suspected in motor_position_rad "
            "and link_position_rad, expected rad, or a joint file of another joint",
        )
    ]


def _named(ratio: float, units: tuple[_Unit, ...]) -> str | None:
    return next((unit.name for unit in units if _near(ratio, unit.factor)), None)


def _near(ratio: float, factor: float) -> bool:
    return abs(ratio / factor - 1.0) < _CLOSE


def _peak(values: FloatArray) -> float:
    return float(np.quantile(np.abs(values), 0.99))
