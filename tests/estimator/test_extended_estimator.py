"""Estimators of joints with effects give the truth where it is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import ExtendedInputs
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.effects.effect_signals import PLAIN, extended

TOB = EstimatorSettings(method="tob")
G, KT, K = PLAIN.gear_ratio, PLAIN.torque_constant_nm_per_a, PLAIN.stiffness_nm_per_rad
WARM_C = 41.0


# ---- the truth is known: constant torque and velocity, the reading that the effect would give

Loss = Callable[
    [float, float, FloatArray], Any
]  # torque, velocity, motor angle -> what the motor loses besides
LOSSES: list[tuple[str, dict[str, float], Loss]] = [
    ("coulomb_friction", {"coulomb_nm": 5.5}, lambda tau, v, q: 1.5 * math.tanh(v / 0.02)),
    ("viscous_friction", {"viscous_nms_per_rad": 4.0}, lambda tau, v, q: v),
    (
        "stribeck_friction",
        {"stribeck_nm": 1.2, "stribeck_velocity_rad_s": 0.3},
        lambda tau, v, q: 1.2 * math.exp(-((v / 0.3) ** 2)) * math.tanh(v / 0.02),
    ),
    (
        "load_dependent_friction",
        {"load_coefficient": 0.12},
        lambda tau, v, q: 0.12 * abs(tau) * math.tanh(v / 0.02),
    ),
    ("friction_asymmetry", {"asymmetry_nm": 0.4}, lambda tau, v, q: 0.4 * abs(math.tanh(v / 0.02))),
    (
        "temperature_dependent_friction",
        {"viscous_per_k": 0.02, "coulomb_per_k": 0.01, "reference_c": 25.0},
        lambda tau, v, q: (
            3.0 * v * (math.exp(-0.32) - 1.0) + 4.0 * math.tanh(v / 0.02) * (math.exp(-0.16) - 1.0)
        ),
    ),
    (
        "torque_ripple",
        {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 0.7},
        lambda tau, v, q: 0.4 * np.cos(2.0 * q + 0.7),
    ),
    (
        "cogging",
        {"amplitude_nm": 0.3, "order_per_motor_rev": 12.0, "phase_rad": -0.4},
        lambda tau, v, q: 0.3 * np.cos(12.0 * q - 0.4),
    ),
    (
        "kinematic_error",
        {"amplitude_rad": 2e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.5},
        lambda tau, v, q: tau * G * 4e-4 * np.cos(2.0 * q + 0.5),
    ),
]

Reading = Callable[[FloatArray], Any]  # motor torque over G Kt [A] -> current that is read
READINGS: list[tuple[str, dict[str, float], Reading]] = [
    ("torque_constant", {"torque_constant_nm_per_a": 0.07}, lambda i: i * KT / 0.07),
    ("current_offset", {"offset_a": 0.08}, lambda i: i + 0.08),
    (
        "torque_constant_temperature",
        {"per_k": -0.002, "reference_c": 26.0},
        lambda i: i / (1.0 - 0.002 * (WARM_C - 26.0)),
    ),
    (
        "torque_constant_saturation",  # I (1 - k |I|) = i, solved for I
        {"saturation_per_a": 0.02},
        lambda i: np.sign(i) * (1.0 - np.sqrt(1.0 - 4.0 * 0.02 * np.abs(i))) / 0.04,
    ),
]


def steady(joint: Joint, tau: float, v: float, lost: Any, read: Reading) -> FloatArray:
    """Torques [400] that `tob` estimates at constant torque and velocity, the losses being friction and `lost`."""
    count = 400
    q = G * v * np.arange(count) * 1e-3
    motor = tau + FrictionModel(PLAIN.friction).torque(v) + lost(tau, v, q)
    current = np.broadcast_to(read(np.broadcast_to(motor, count) / (G * KT)), count)
    estimator = make_estimator(joint, TOB)
    link = q / G - tau / K
    return np.array(
        [
            estimator.step(1e-3, float(current[k]), q[k], G * v, link[k], WARM_C).torque_nm
            for k in range(count)
        ]
    )


@pytest.mark.parametrize(("name", "p", "law"), LOSSES, ids=[each[0] for each in LOSSES])
@pytest.mark.parametrize(("tau", "v"), [(12.0, 0.3), (12.0, -0.3), (-20.0, 0.15), (-6.0, -0.02)])
def test_a_loss_is_taken_off(name: str, p: dict[str, float], law: Loss, tau: float, v: float) -> None:
    found = steady(extended(PLAIN, (name, p)), tau, v, law, lambda i: i)
    assert np.isnan(found[0])  # starts
    assert found[-100:] == pytest.approx(tau, abs=1e-6)
    plain = steady(PLAIN, tau, v, law, lambda i: i)
    assert float(np.abs(plain[-100:] - tau).max()) > 0.01


@pytest.mark.parametrize(("name", "p", "read"), READINGS, ids=[each[0] for each in READINGS])
@pytest.mark.parametrize(("tau", "v"), [(12.0, 0.3), (-20.0, 0.15), (7.0, -0.2)])
def test_the_motor_torque_is_the_true_one(
    name: str, p: dict[str, float], read: Reading, tau: float, v: float
) -> None:
    found = steady(extended(PLAIN, (name, p)), tau, v, lambda *_: 0.0, read)
    assert found[-100:] == pytest.approx(tau, abs=1e-9)


def test_without_an_estimate_the_torque_is_the_motors() -> None:
    joint = extended(PLAIN, ("load_dependent_friction", {"load_coefficient": 0.1}))
    inputs = ExtendedInputs(joint, TOB)
    for before, torque in ((math.nan, G * KT * 3.0), (10.0, 10.0)):
        current, _ = inputs.step(1e-3, 3.0, 0.0, 50.0, 0.0, math.nan, before)
        assert current == pytest.approx(3.0 - 0.1 * torque / (G * KT))


def test_several_effects_at_once() -> None:
    joint = extended(
        PLAIN,
        ("current_offset", {"offset_a": 0.05}),
        ("torque_constant", {"torque_constant_nm_per_a": 0.084}),
        ("load_dependent_friction", {"load_coefficient": 0.1}),
        ("torque_ripple", {"amplitude_nm": 0.2, "order_per_motor_rev": 1.0}),
        ("torque_ripple", {"amplitude_nm": 0.3, "order_per_motor_rev": 2.0, "phase_rad": 1.0}),
    )

    def lost(tau: float, v: float, q: FloatArray) -> Any:
        return 0.1 * abs(tau) * math.tanh(v / 0.02) + 0.2 * np.cos(q) + 0.3 * np.cos(2.0 * q + 1.0)

    found = steady(joint, -15.0, 0.3, lost, lambda i: i * KT / 0.084 + 0.05)
    assert found[-100:] == pytest.approx(-15.0, abs=1e-6)


def test_inertias_are_those_of_the_effects() -> None:
    joint = extended(
        PLAIN, ("rotor_inertia", {"rotor_inertia_kgm2": 1e-4}), ("link_inertia", {"link_inertia_kgm2": 0.1})
    )
    estimator = make_estimator(joint, TOB)
    assert type(estimator) is JointEstimator
    assert (estimator.joint.rotor_inertia_kgm2, estimator.joint.link_inertia_kgm2) == (1e-4, 0.1)


# ---- torsion: the link at which the plain spring K carries the torque


def corrected_link(joint: Joint, q: FloatArray, link: FloatArray, v: float = 0.3) -> FloatArray:
    inputs = ExtendedInputs(joint, EstimatorSettings(method="tob", bandwidth_rad_s=5000.0))
    return np.array(
        [inputs.step(1e-3, 1.0, a, G * v, b, math.nan, math.nan)[1] for a, b in zip(q, link, strict=True)]
    )


def test_the_plain_spring_carries_the_torque() -> None:
    tau = 20.0 * np.sin(np.arange(4000) * 2e-3)
    q = G * 0.3 * np.arange(4000) * 1e-3
    d = np.linspace(-6e-3, 6e-3, 200001)
    hard = np.interp(tau, 13000.0 * d + 2e9 * d**3, d)
    late = np.concatenate(([0.0], 0.3 * (np.arange(3999) + 1) * 1e-3 - 0.3 * 2e-3))
    rows: list[tuple[str, dict[str, float], FloatArray, float]] = [
        (
            "nonlinear_stiffness",
            {"stiffness_nm_per_rad": 13000.0, "cubic_nm_per_rad3": 2e9},
            q / G - hard,
            1e-3,
        ),
        (
            "nonlinear_stiffness",
            {"cubic_nm_per_rad3": 2e9},
            q / G - np.interp(tau, K * d + 2e9 * d**3, d),
            1e-3,
        ),
        (
            "kinematic_error",
            {"amplitude_rad": 2e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.5},
            q / G + 2e-4 * np.sin(2.0 * q + 0.5) - tau / K,
            1e-9,
        ),
        ("lost_motion", {"width_rad": 4e-4}, q / G - tau / K - 2e-4 * np.sign(tau), 1e-9),
        (
            "encoder_eccentricity",
            {"amplitude_rad": 1e-4, "phase_rad": 0.3, "motor_side": 1.0},
            q / G - 1e-4 / G * np.sin(q + 0.3) - tau / K,
            1e-9,
        ),
        ("channel_delay", {"delay_s": 2e-3, "channel": 2.0}, late - tau / K, 1e-9),
    ]
    for name, p, link, limit in rows:
        found = K * (q / G - corrected_link(extended(PLAIN, (name, p)), q, link))
        keep = np.abs(tau) > 1e-3  # inside the play the torque is 0
        np.testing.assert_allclose(found[keep][3:], tau[keep][3:], atol=limit * 20.0, err_msg=name)


def test_an_eccentric_link_encoder_is_put_right() -> None:
    true = 0.3 * np.arange(4000) * 1e-3
    read = true + 1e-4 * np.sin(true + 0.3)
    p = {"amplitude_rad": 1e-4, "phase_rad": 0.3}
    found = corrected_link(extended(PLAIN, ("encoder_eccentricity", p)), G * true, read)
    np.testing.assert_allclose(found, true, atol=2e-8)  # its own angle is wrong by 1e-4


@pytest.mark.parametrize("inertia", [None, 9e-5])
def test_an_eccentric_motor_encoder_makes_no_torque_of_the_rotor(inertia: float | None) -> None:
    """At a constant 0.5 to 2.5 rad/s, read with an error of 2 mrad: the observer makes inertia of it, but knows better.

    inertia: of the rotor, as another effect of the file.
    """
    p = {"amplitude_rad": 2e-3, "phase_rad": 0.3, "motor_side": 1.0}
    others = () if inertia is None else (("rotor_inertia", {"rotor_inertia_kgm2": inertia}),)
    for v in (0.5, 1.5, 2.5):
        true = G * v * np.arange(4000) * 1e-3
        read = true + 2e-3 * np.sin(true + 0.3)
        speed = G * v * (1.0 + 2e-3 * np.cos(true + 0.3))

        def swing(joint: Joint, read: FloatArray = read, speed: FloatArray = speed) -> float:
            """Of the torque, once settled."""
            one = make_estimator(joint, TOB)
            rows = zip(read.tolist(), speed.tolist(), strict=True)
            torque = [one.step(1e-3, 0.5, q, w, q / G, math.nan).torque_nm for q, w in rows]
            return float(np.std(torque[2000:]))

        known, unknown = (
            swing(extended(PLAIN, *others, ("encoder_eccentricity", p))),
            swing(extended(PLAIN, *others)),
        )
        rotor = (inertia or PLAIN.rotor_inertia_kgm2) * G
        assert unknown < rotor * 2e-3 * (G * v) ** 2, "the observer's filter takes its part"
        assert known < 0.12 * unknown, (v, known, unknown)


def test_hysteresis_follows_the_deflection() -> None:
    """Triangles of 1 mrad: the twist settles at H/K in the direction of the deflection."""
    d = 1e-3 * np.abs((np.arange(4000) / 1000.0 + 1.0) % 2.0 - 1.0)
    joint = extended(PLAIN, ("hysteresis", {"torque_nm": 1.5, "travel_rad": 1e-4}))
    link = -d
    twist = link - corrected_link(joint, np.zeros(4000), link, 0.0)
    for k, sign in ((900, 1.0), (1900, -1.0), (2900, 1.0), (3900, -1.0)):
        assert twist[k] * K == pytest.approx(1.5 * sign, abs=1e-6)


def test_a_late_current_is_brought_forward() -> None:
    t = np.arange(4000) * 1e-3
    late, true = 3.0 * np.sin(8.0 * (t - 3e-3)), 3.0 * np.sin(8.0 * t)
    inputs = ExtendedInputs(extended(PLAIN, ("channel_delay", {"delay_s": 3e-3, "channel": 1.0})), TOB)
    found = np.array([inputs.step(1e-3, i, 0.0, 0.0, 0.0, math.nan, math.nan)[0] for i in late])
    assert np.abs(found - true)[50:].max() < 0.1 * np.abs(late - true).max()
