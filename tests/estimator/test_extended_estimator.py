"""Estimators of joints with effects: each effect undone, steps as whole runs, free without effects, nothing raises."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.daemon.config import load_config
from jtqd.daemon.loop.process import build_estimator, warm_up
from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import ExtendedInputs, acting_effects
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import State
from jtqd.estimator.estimator import (
    ExtendedEstimator,
    FusedEstimator,
    JointEstimator,
    estimate_columns,
    make_estimator,
)
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.network import AnyNetwork, load_network
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import METHODS, EstimatorSettings
from tests.estimator.effects.effect_signals import PLAIN, extended
from tests.estimator.effects.laws import ALL, IDS, LAWS, Law
from tests.estimator.estimator_helpers import small_network, with_faults
from tests.estimator.fused_configuration import configured, networks
from tests.estimator.fused_helpers import fused_joint, fused_network, temperatures, twisted

TOB = EstimatorSettings(method="tob")
G, KT, K = PLAIN.gear_ratio, PLAIN.torque_constant_nm_per_a, PLAIN.stiffness_nm_per_rad
WARM_C = 41.0


# ---- the truth is known: constant torque and velocity, the reading that the effect would give

Reading = Callable[
    [FloatArray, FloatArray], Any
]  # motor torque over G Kt [A], motor angle -> current that is read


def steady(joint: Joint, tau: float, v: float, read: Reading) -> FloatArray:
    """Torques [400] that `tob` estimates at constant torque and velocity, the plain losses being friction alone."""
    q = G * v * np.arange(400) * 1e-3
    current = read(np.full(400, (tau + FrictionModel(PLAIN.friction).torque(v)) / (G * KT)), q)
    estimator = make_estimator(joint, TOB)
    rows = zip(current.tolist(), q.tolist(), (q / G - tau / K).tolist(), strict=True)
    return np.array([estimator.step(1e-3, i, q, G * v, link, WARM_C).torque_nm for i, q, link in rows])


AT_MOTOR = [
    row
    for row in LAWS
    if {"loss_nm", "current_a"} & set(EFFECTS[row.name].hooks)
    and not EFFECTS[row.name].changes_joint
    and not EFFECTS[row.name].rate_based  # nothing changes here
]


@pytest.mark.parametrize(("name", "p", "law"), AT_MOTOR, ids=[row.name for row in AT_MOTOR])
@pytest.mark.parametrize(("tau", "v"), [(12.0, 0.3), (12.0, -0.3), (-20.0, 0.15), (-6.0, -0.02)])
def test_the_motor_torque_is_the_true_one(
    name: str, p: dict[str, float], law: Law, tau: float, v: float
) -> None:
    def read(i: FloatArray, q: FloatArray) -> Any:
        """Solve G Kt i = G Kt i0 + what the effect leaves in the motor balance at i."""
        s = State(
            direction=np.full(400, math.tanh(v / 0.02)),
            link_position_rad=q / G - tau / K,
            motor_position_rad=q,
            temperature_c=np.full(400, WARM_C),
            time_s=np.arange(400) * 1e-3,
            torque_nm=np.full(400, tau),
            torsion_rad=np.full(400, tau / K),
            velocity_rad_s=np.full(400, v),
        )
        s.current_a = i
        for _ in range(60):
            s.current_a = i + law(p, s, PLAIN)[0] / (G * KT)
        return s.current_a

    found = steady(extended(PLAIN, (name, p)), tau, v, read)
    assert np.isnan(found[0])  # starts
    assert found[-100:] == pytest.approx(tau, abs=1e-6)
    assert float(np.abs(steady(PLAIN, tau, v, read)[-100:] - tau).max()) > 0.01


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

    def read(i: FloatArray, q: FloatArray) -> Any:
        lost = 0.1 * 15.0 * math.tanh(0.3 / 0.02) + 0.2 * np.cos(q) + 0.3 * np.cos(2.0 * q + 1.0)
        return (i + lost / (G * KT)) * KT / 0.084 + 0.05

    found = steady(joint, -15.0, 0.3, read)
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


SEED, COUNT = 31, 1500


def network_for(method: str) -> AnyNetwork | None:
    data = {"network": small_network().data, "fused": fused_network().data}.get(method)
    return None if data is None else load_network(method, data)


def faulty_run(seed: int, count: int) -> tuple[FloatArray, JointColumns]:
    """Reversals, rests, NaN and infinities, gaps in time, a temperature with gaps."""
    m = twisted(seed, count)
    time_s = np.cumsum(m.dt_s)
    for at in np.random.default_rng(seed).integers(0, count, 4):
        time_s[at:] += 0.08  # longer than max_gap_s
    inputs = with_faults(m, seed).arrays()[1:]
    return time_s, JointColumns(*inputs, temperature_c=temperatures("gaps", seed, count))


SETS = [*([(row.name, row.parameters)] for row in LAWS), list(ALL.items())]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("entries", SETS, ids=[*IDS, "all"])
def test_step_by_step_is_the_whole_run(method: str, entries: list[tuple[str, dict[str, float]]]) -> None:
    joint = extended(fused_joint(), *entries)
    network, settings = network_for(method), EstimatorSettings(method=method, track_torsion=method == "fused")
    time_s, columns = faulty_run(SEED, COUNT)
    estimator = make_estimator(joint, settings, network)
    given = (
        np.diff(time_s, prepend=time_s[0]),
        columns.current_a,
        columns.motor_position_rad,
        columns.motor_velocity_rad_s,
        columns.link_position_rad,
        columns.temperature_c,
    )
    rows = zip(*(a.tolist() for a in given if a is not None), strict=True)
    steps = [estimator.step(*row) for row in rows]
    run = estimate_columns(joint, settings, network, time_s, columns)
    moving = st.DEGRADED if method == "network" else st.VALID
    assert {moving, st.INVALID, st.STARTING, st.STANDSTILL} <= set(run.status.tolist())
    np.testing.assert_array_equal(run.status, [e.status for e in steps])
    for name in ("torque_nm", "sigma_nm", "tob_nm", "physics_nm", "network_nm"):
        np.testing.assert_array_equal(getattr(run, name), [getattr(e, name) for e in steps], err_msg=name)
    for published in (run.torque_nm, run.sigma_nm):
        assert np.array_equal(np.isfinite(published), np.isin(run.status, list(st.PUBLISHED)))


# ---- what costs nothing, what is forgotten, what never raises


def test_without_acting_effects_the_estimator_is_the_plain_one() -> None:
    none = (
        "sensor_offset",
        "sensor_gain",
        "sensor_drift",
        "sensor_crosstalk",
        "unbalance",
        "link_inertia",
        "gear_damping",
    )
    late_sensor = ("channel_delay", {"delay_s": 1e-3, "channel": 0.0})
    joint = extended(PLAIN, *((name, ALL[name]) for name in none), late_sensor)
    assert acting_effects(joint) == ()
    assert type(make_estimator(joint, TOB)) is JointEstimator
    assert type(make_estimator(PLAIN, TOB)) is JointEstimator
    assert make_estimator(PLAIN, TOB).joint is PLAIN
    assert type(make_estimator(fused_joint(), EstimatorSettings(method="fused"))) is FusedEstimator


def test_reset_forgets_the_torque_and_the_filters() -> None:
    joint = extended(PLAIN, *((name, ALL[name]) for name in ("load_dependent_friction", "channel_delay")))
    one, other = make_estimator(joint, TOB), make_estimator(joint, TOB)
    assert isinstance(one, ExtendedEstimator)
    assert one.joint is joint
    assert one.settings is TOB
    for k in range(50):
        one.step(1e-3, 2.0 + 0.1 * k, 0.1 * k, 30.0, 1e-3 * k)
    one.reset()
    for k in range(20):
        sample = (1e-3, 1.0 - 0.05 * k, 0.03 * k, 30.0, 3e-4 * k)
        assert repr(one.step(*sample)) == repr(other.step(*sample))


@pytest.mark.parametrize("method", METHODS)
def test_no_float_raises(method: str) -> None:
    joint = extended(fused_joint(), *ALL.items())
    estimator = make_estimator(
        joint, EstimatorSettings(method=method, track_torsion=method == "fused"), network_for(method)
    )
    rng = np.random.default_rng(5)
    values = np.array(
        [0.0, -0.0, 1.0, -3.0, 1e-300, 1e30, 1e155, 1e306, -1e308, math.inf, -math.inf, math.nan]
    )
    for _ in range(3000):
        dt, *rest = rng.choice(values, 6).tolist()
        found = estimator.step(1e-3 if rng.random() < 0.5 else dt, *rest)
        assert found.status in {st.STARTING, st.INVALID} or math.isfinite(found.torque_nm)
    good = [estimator.step(1e-3, 1.0, 0.03 * k, 30.0, 3e-4 * k, 25.0) for k in range(60)][-1]
    assert good.status in {st.VALID, st.DEGRADED}


def test_a_missing_column_is_named_as_for_plain_joints() -> None:
    joint = extended(PLAIN, ("torque_constant", ALL["torque_constant"]))
    with pytest.raises(ValueError, match="joint j: the run has no motor_position_rad"):
        estimate_columns(joint, TOB, None, np.arange(3.0), JointColumns(np.zeros(3)))


def test_the_daemon_takes_an_extended_joint_file(tmp_path: Path) -> None:
    """Its loop builds the estimator with the effects of the file, and each joint has its own."""
    path = configured(tmp_path, "fused", networks())
    file = yaml.safe_load((tmp_path / "j2.yaml").read_text())
    file["effects"] = [{"name": name, "parameters": ALL[name]} for name in ("torque_constant", "hysteresis")]
    (tmp_path / "j2.yaml").write_text(yaml.safe_dump(file))
    config = load_config(path)
    plain, more = (build_estimator(config, joint) for joint in config.joints)
    warm_up([plain, more])
    assert type(plain) is FusedEstimator
    assert isinstance(more, ExtendedEstimator)
    assert [e.name for e in more.joint.effects] == ["torque_constant", "hysteresis"]
    found = [more.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n - 1e-3, 25.0) for n in range(50)][-1]
    without = [plain.step(1e-3, 2.0, 0.1 * n, 100.0, 0.001 * n - 1e-3, 25.0) for n in range(50)][-1]
    assert found.status == without.status == st.VALID
    assert abs(found.physics_nm - without.physics_nm) > 0.1


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_correction_that_raises_is_invalid_and_no_repeated_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a step and in the middle of a run; what raised is printed, not lost."""
    joint = extended(PLAIN, ("viscous_friction", ALL["viscous_friction"]))
    m = twisted(3, 1200)
    samples = 0
    real = ExtendedInputs.step

    def step(inputs: ExtendedInputs, *sample: float) -> tuple[float, float]:
        nonlocal samples
        samples += 1
        if samples in range(600, 611):
            raise OverflowError("math range error")
        return real(inputs, *sample)

    monkeypatch.setattr(ExtendedInputs, "step", step)
    estimator = make_estimator(joint, EstimatorSettings(method="tob"))
    run = estimator.run(*m.arrays())
    assert (run.status[599:610] == st.INVALID).all()
    assert np.isnan(run.torque_nm[599:610]).all()
    assert np.isnan(run.physics_nm[599:610]).all()
    assert np.isfinite(run.torque_nm[598])
    assert np.isfinite(run.torque_nm[640:]).all()
