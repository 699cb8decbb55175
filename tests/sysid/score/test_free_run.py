"""The free run: closed forms where there are some, else a fine integration of the same physics written out here."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import State
from jtqd.estimator.joint import Effect, Friction, Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import plant_of_joint
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals
from jtqd.sysid.score.free_run import free_run, windows

RATE_HZ = 1000.0
INERTIA = (
    0.5  # kg m2: rotor behind the gear; no link inertia, so that the gear transmits what the sensor reads
)
JOINT = Joint(
    name="free",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.08,
    rotor_inertia_kgm2=0.5e-4,
    stiffness_nm_per_rad=1e4,
    damping_nms_per_rad=5.0,
    link_inertia_kgm2=0.0,
    rated_torque_nm=50.0,
    friction=Friction(coulomb_nm=4.0, viscous_nms_per_rad=3.0),
)
FREE = replace(JOINT, friction=Friction(0.0, 0.0))


def signals_of(
    joint: Joint,
    velocity: FloatArray,
    current: FloatArray,
    sensor: FloatArray,
    number: int = 1,
    *,
    turned: float = 0.0,
) -> JointSignals:
    """Signals [n] as the diagnosis makes them of a noiseless run; turned: link angle at its beginning."""
    n = len(velocity)
    time = np.arange(n) / RATE_HZ
    link = turned + np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1])))) / RATE_HZ
    acceleration = np.gradient(velocity, time)
    gear = sensor + joint.link_inertia_kgm2 * acceleration
    state = State(
        current_a=current,
        current_rate_a_s=np.gradient(current, time),
        direction=np.sign(velocity),
        link_acceleration_rad_s2=acceleration,
        link_position_rad=link,
        link_velocity_rad_s=velocity,
        motor_acceleration_rad_s2=joint.gear_ratio * acceleration,
        motor_position_rad=joint.gear_ratio * link,
        temperature_c=np.full(n, 35.0),
        time_s=time,
        torque_nm=gear,
        torque_rate_nm_s=np.gradient(sensor, time),
        torsion_rad=gear / joint.stiffness_nm_per_rad,
        torsion_rate_rad_s=np.gradient(gear, time) / joint.stiffness_nm_per_rad,
        velocity_rad_s=velocity,
        coupling_position_rad=link if number == 1 else -link,
    )
    zero = np.zeros(n)
    return JointSignals(
        run="run",
        number=number,
        joint=joint,
        time_s=time,
        state=state,
        motor_nm=zero,
        torsion_nm=None,
        moving=np.ones(n, bool),
        sensor_nm=sensor,
        current_a=current,
        quick_nm=zero,
    )


def test_viscous_friction_lets_the_velocity_decay_as_the_closed_form_says() -> None:
    joint = replace(JOINT, friction=Friction(0.0, 3.0))
    time = np.arange(501) / RATE_HZ
    decay = 1.7 * np.exp(-3.0 / INERTIA * time)
    zero = np.zeros(501)
    assert free_run(signals_of(joint, decay, zero, zero), joint).rmse_rad_s < 1e-4
    # no friction at all: the velocity stays, so the error is the decay itself
    still = free_run(signals_of(FREE, decay, zero, zero), FREE).rmse_rad_s
    assert still == pytest.approx(math.sqrt(float(np.mean((1.7 - decay[1:]) ** 2))), rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_coulomb_friction_brakes_evenly_and_then_holds(sign: float) -> None:
    joint = replace(JOINT, friction=Friction(4.0, 0.0))
    time = np.arange(501) / RATE_HZ
    velocity = sign * np.maximum(1.5 - 4.0 / INERTIA * time, 0.0)
    zero = np.zeros(501)
    assert free_run(signals_of(joint, velocity, zero, zero), joint).rmse_rad_s < 1e-4
    # 3.9 Nm do not move it from rest, 4.1 Nm move it with what they have left
    rest = np.zeros(501)
    holding, moving = (np.full(501, sign * nm / 8.0) for nm in (3.9, 4.1))
    assert free_run(signals_of(joint, rest, holding, zero), joint).rmse_rad_s == 0.0
    away = free_run(signals_of(joint, rest, moving, zero), joint).rmse_rad_s
    assert away == pytest.approx(0.1 / INERTIA * math.sqrt(float(np.mean(time[1:] ** 2))), rel=1e-3)


def _wave(n: int, size: float, seconds: float, phase: float = 0.0) -> FloatArray:
    result: FloatArray = size * np.sin(2.0 * math.pi * np.arange(n) / (RATE_HZ * seconds) + phase)
    return result


def _integrated(name: str, p: dict[str, float], turned: float, number: int) -> JointSignals:
    """A run of 1.2 s of a joint that has the effect, by Euler steps of 50 us of equations written out for each effect.

    What is measured: current and torque after the effect, and the motion.
    """
    n, fine = 1201, 20
    h = 1.0 / (RATE_HZ * fine)
    true_torque, true_current = _wave(n, 9.0, 1.3, 0.4), _wave(n, 1.6, 0.7, 0.2)
    inertia = INERTIA
    if name == "rotor_inertia":
        inertia += 1e4 * (p["rotor_inertia_kgm2"] - JOINT.rotor_inertia_kgm2)
    if name == "link_inertia":
        inertia += p["link_inertia_kgm2"] - JOINT.link_inertia_kgm2
    v, angle = 0.9, turned
    velocity = np.empty(n)
    for k in range(n):
        velocity[k] = v
        for m in range(fine):
            x = k + m / fine
            low = min(k, n - 2)
            current = true_current[low] + (x - low) * (true_current[low + 1] - true_current[low])
            tau = true_torque[low] + (x - low) * (true_torque[low + 1] - true_torque[low])
            push = PUSHES[name](p, (v, angle, tau, current)) if name in PUSHES else 0.0
            free = v + h / inertia * (8.0 * current - tau + push)
            size = 4.0 + 3.0 * abs(v)
            if name in FRICTIONS:
                size += FRICTIONS[name](p, (v, angle, tau, current))
            v = math.copysign(max(abs(free) - h / inertia * size, 0.0), free)
            angle += h * v
    current, torque = true_current, true_torque
    if name == "current_offset":
        current = true_current + p["offset_a"]
    coupling = angle_of(velocity, turned) * (1.0 if number == 1 else -1.0)
    if name == "sensor_gain":
        torque = p["gain"] * true_torque
    elif name == "sensor_offset":
        torque = true_torque + p["offset_nm"]
    elif name == "sensor_crosstalk":
        torque = true_torque + p["amplitude_nm"] * np.cos(coupling + p["phase_rad"])
    elif name == "sensor_drift":
        torque = true_torque + p["rate_nm_per_s"] * np.arange(n) / RATE_HZ
    return signals_of(JOINT, velocity, current, torque, number, turned=turned)


def angle_of(velocity: FloatArray, turned: float) -> FloatArray:
    steps = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1])))) / RATE_HZ
    result: FloatArray = turned + steps
    return result


Acting = tuple[float, float, float, float]
"""Velocity, link angle, transmitted torque, current: of the truth."""
FRICTIONS: dict[str, Callable[[dict[str, float], Acting], float]] = {
    "coulomb_friction": lambda p, x: p["coulomb_nm"] - 4.0,
    "viscous_friction": lambda p, x: (p["viscous_nms_per_rad"] - 3.0) * abs(x[0]),
    "stribeck_friction": lambda p, x: (
        p["stribeck_nm"] * math.exp(-((x[0] / p["stribeck_velocity_rad_s"]) ** 2))
    ),
    "load_dependent_friction": lambda p, x: p["load_coefficient"] * abs(x[2]),
    "friction_asymmetry": lambda p, x: p["asymmetry_nm"] * (1.0 if x[0] > 0.0 else -1.0),
    "temperature_dependent_friction": lambda p, x: (
        3.0 * abs(x[0]) * (math.exp(-p["viscous_per_k"] * (35.0 - p["reference_c"])) - 1.0)
    ),
}
"""Friction beside Coulomb and viscous [Nm], positive against the motion."""
PUSHES: dict[str, Callable[[dict[str, float], Acting], float]] = {
    "torque_ripple": lambda p, x: -p["amplitude_nm"] * math.cos(2.0 * 100.0 * x[1] + p["phase_rad"]),
    "cogging": lambda p, x: -p["amplitude_nm"] * math.cos(6.0 * 100.0 * x[1] + p["phase_rad"]),
    "kinematic_error": lambda p, x: (
        -x[2] * 100.0 * p["amplitude_rad"] * 2.0 * math.cos(2.0 * 100.0 * x[1] + p["phase_rad"])
    ),
    "unbalance": lambda p, x: -p["moment_nm"] * math.sin(x[1] + p["phase_rad"]),
    "torque_constant": lambda p, x: 100.0 * (p["torque_constant_nm_per_a"] - 0.08) * x[3],
    "torque_constant_saturation": lambda p, x: -8.0 * p["saturation_per_a"] * x[3] * abs(x[3]),
    "torque_constant_temperature": lambda p, x: 8.0 * p["per_k"] * (35.0 - p["reference_c"]) * x[3],
}
"""Torque that pushes [Nm, joint side]."""


EFFECTS = {
    "coulomb_friction": {"coulomb_nm": 5.5},
    "viscous_friction": {"viscous_nms_per_rad": 5.0},
    "stribeck_friction": {"stribeck_nm": 2.0, "stribeck_velocity_rad_s": 0.3},
    "load_dependent_friction": {"load_coefficient": 0.2},
    "friction_asymmetry": {"asymmetry_nm": 1.2},
    "temperature_dependent_friction": {"viscous_per_k": 0.03, "coulomb_per_k": 0.0, "reference_c": 20.0},
    "torque_ripple": {"amplitude_nm": 6.0, "order_per_motor_rev": 2.0, "phase_rad": 0.5},
    "cogging": {"amplitude_nm": 3.5, "order_per_motor_rev": 6.0, "phase_rad": 0.5},
    "kinematic_error": {"amplitude_rad": 0.003, "order_per_motor_rev": 2.0, "phase_rad": 1.0},
    "unbalance": {"moment_nm": 2.0, "phase_rad": 0.7},
    "torque_constant": {"torque_constant_nm_per_a": 0.095},
    "torque_constant_saturation": {"saturation_per_a": 0.15},
    "torque_constant_temperature": {"per_k": -0.01, "reference_c": 20.0},
    "rotor_inertia": {"rotor_inertia_kgm2": 0.8e-4},
    "link_inertia": {"link_inertia_kgm2": 0.3},
    "current_offset": {"offset_a": 0.15},
    "sensor_gain": {"gain": 1.15},
    "sensor_offset": {"offset_nm": 1.5},
    "sensor_crosstalk": {"amplitude_nm": 2.0, "share": 0.0, "phase_rad": 0.3},
    "sensor_drift": {"rate_nm_per_s": 0.9, "per_k_nm": 0.0, "reference_c": 25.0},
}


@pytest.mark.parametrize(
    ("name", "number", "turned"),
    [(name, 1, 0.6) for name in sorted(EFFECTS)] + [("sensor_crosstalk", 2, -1.1), ("unbalance", 2, -1.1)],
)
def test_the_right_effect_explains_the_run_and_without_it_the_error_is_far_larger(
    name: str, number: int, turned: float
) -> None:
    signals = _integrated(name, EFFECTS[name], turned, number)
    without = free_run(signals, JOINT).rmse_rad_s
    with_it = free_run(signals, replace(JOINT, effects=(Effect(name, EFFECTS[name]),))).rmse_rad_s
    print(f"{name}: {without:.4f} -> {with_it:.5f} rad/s")
    assert with_it < 0.006
    assert without > 9.0 * with_it


def test_a_run_without_any_effect_has_next_to_no_error() -> None:
    assert free_run(_integrated("none", {}, 0.0, 1), JOINT).rmse_rad_s < 5e-4


def test_windows_cover_the_run_and_begin_in_the_measured_state() -> None:
    signals = _integrated("current_offset", EFFECTS["current_offset"], 0.0, 1)
    time = signals.state.time_s
    index = windows(time, 0.3)
    assert time[index[0]].tolist() == pytest.approx([0.0, 0.3, 0.6, 0.9])
    assert time[index[-1]] - time[index[0]] == pytest.approx(np.full(4, 0.3))
    # half as long: the offset has half the time to show
    assert free_run(signals, JOINT, 0.15).rmse_rad_s < 0.75 * free_run(signals, JOINT, 0.3).rmse_rad_s
    whole = windows(time, 1e3)
    assert time[whole[0]].tolist() == [0.0]
    assert time[whole[-1, 0]] - time[whole[0, 0]] == pytest.approx(1.2)


@pytest.mark.parametrize("number", [1, 2])
def test_the_emulated_bench_runs_free_as_its_joint_file_says(number: int) -> None:
    shipped_joint = load_joint(shipped("joint1.yaml"))
    joint = replace(shipped_joint, efficiency=None, fused=None, friction=Friction(3.0, 2.0))
    table = emulate_run(
        plant_of_joint(joint),
        (
            JointCommand.velocity(lambda t: 1.2 * math.sin(2.1 * t)),
            JointCommand.current(lambda t: 2.5 * math.sin(1.3 * t)),
        ),
        8.0,
    )
    signals = joint_signals("emulated", table, number, joint, BaseLoss(joint))
    floor = free_run(signals, joint).rmse_rad_s
    weaker = Effect("torque_constant", {"torque_constant_nm_per_a": 0.95 * joint.torque_constant_nm_per_a})
    wrong = free_run(signals, replace(joint, effects=(weaker,))).rmse_rad_s
    print(f"joint {number}: {floor:.4f} rad/s, torque constant 5 % less: {wrong:.4f} rad/s")
    assert floor < 0.01  # what a current that rings between two samples leaves at the reversals
    assert wrong > 15.0 * floor
