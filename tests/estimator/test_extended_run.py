"""Estimators of joints with effects: step by step as over whole runs; free without effects; nothing makes them raise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from jtqd.daemon.config import load_config
from jtqd.daemon.loop.process import build_estimator, warm_up
from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import acting_effects, needs_torque
from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.estimator import ExtendedEstimator, FusedEstimator, JointEstimator
from jtqd.estimator.methods import AnyNetwork, estimate_columns, load_network, make_estimator
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import METHODS, EstimatorSettings
from tests.estimator.effects.effect_signals import PLAIN, extended
from tests.estimator.estimator_helpers import small_network, with_faults
from tests.estimator.fused_configuration import configured, networks
from tests.estimator.fused_helpers import fused_joint, fused_network, temperatures, twisted
from tests.estimator.test_extended_estimator import LOSSES, READINGS

SEED, COUNT = 31, 1500
TOB = EstimatorSettings(method="tob")
ALL: dict[str, dict[str, float]] = {
    **{name: p for name, p, _ in (*LOSSES, *READINGS)},
    "nonlinear_stiffness": {"stiffness_nm_per_rad": 13000.0, "cubic_nm_per_rad3": 2e8},
    "hysteresis": {"torque_nm": 1.5, "travel_rad": 2e-4},
    "lost_motion": {"width_rad": 2e-4},
    "encoder_eccentricity": {"amplitude_rad": 1e-4, "phase_rad": 0.3},
    "channel_delay": {"delay_s": 2e-3, "channel": 1.0},
    "rotor_inertia": {"rotor_inertia_kgm2": 9e-5},
    "link_inertia": {"link_inertia_kgm2": 0.1},
    "unbalance": {"moment_nm": 1.0},
    "sensor_offset": {"offset_nm": 1.0},
    "sensor_gain": {"gain": 1.1},
    "sensor_drift": {"rate_nm_per_s": 0.01},
    "sensor_crosstalk": {"amplitude_nm": 0.3},
}


MOTOR_SIDE = "encoder_eccentricity of the motor"
ENTRIES = {
    **{name: (name, p) for name, p in ALL.items()},
    MOTOR_SIDE: ("encoder_eccentricity", {"amplitude_rad": 5e-3, "phase_rad": 0.3, "motor_side": 1.0}),
}


def network_for(method: str) -> AnyNetwork | None:
    data = {"network": small_network().data, "fused": fused_network().data}.get(method)
    return None if data is None else load_network(method, data)


def len_or_name(names: tuple[str, ...]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} effects"


def faulty_run(seed: int, count: int) -> tuple[FloatArray, JointColumns]:
    """Reversals, rests, NaN and infinities, gaps in time, a temperature with gaps."""
    m = twisted(seed, count)
    time_s = np.cumsum(m.dt_s)
    for at in np.random.default_rng(seed).integers(0, count, 4):
        time_s[at:] += 0.08  # longer than max_gap_s
    inputs = with_faults(m, seed).arrays()[1:]
    return time_s, JointColumns(*inputs, temperature_c=temperatures("gaps", seed, count))


WITH_TORQUE = {"load_dependent_friction", "kinematic_error"}
SETS = [*((name,) for name in sorted(ENTRIES)), tuple(sorted(ALL)), tuple(sorted(set(ALL) - WITH_TORQUE))]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("names", SETS, ids=len_or_name)
def test_step_by_step_is_the_whole_run(method: str, names: tuple[str, ...]) -> None:
    joint = extended(fused_joint(), *(ENTRIES[name] for name in names))
    network, settings = network_for(method), EstimatorSettings(method=method)
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
    for name in ("torque_nm", "sigma_nm", "physics_nm", "network_nm"):
        np.testing.assert_allclose(
            getattr(run, name), [getattr(e, name) for e in steps], rtol=1e-9, atol=1e-9, err_msg=name
        )


def test_every_effect_was_there() -> None:
    assert set(ALL) == set(EFFECTS)
    with_torque = {name for name in ALL if needs_torque(extended(PLAIN, (name, ALL[name])))}
    assert with_torque == WITH_TORQUE


# ---- what costs nothing, what is forgotten, what never raises


def test_without_acting_effects_the_estimator_is_the_plain_one() -> None:
    none = ("sensor_offset", "sensor_gain", "sensor_drift", "sensor_crosstalk", "unbalance", "link_inertia")
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
    joint = extended(fused_joint(), *((name, p) for name, p in ALL.items()))
    estimator = make_estimator(joint, EstimatorSettings(method=method), network_for(method))
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
