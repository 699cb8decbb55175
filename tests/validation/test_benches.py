"""The benches are what they say: equations in closed form, the same set for the same seed, effects as large as told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from validation.worlds.measured_bench import JOINTS, MeasuredBench, acceleration, recordings
from validation.worlds.mujoco_bench import MujocoBench
from validation.worlds.mujoco_plant import JointPlant, model_xml
from validation.worlds.oracle import hidden_size, key, residuals, sizes
from validation.worlds.sets import SENSOR, Array, Bench, Hidden, Set
from validation.worlds.units import CHANNELS, UNITS

SEED = 11


@pytest.fixture(scope="module")
def mujoco_bench() -> MujocoBench:
    pytest.importorskip(
        "mujoco", reason="mujoco is not installed: pip install -e '.[dev]'; the bench was NOT tested"
    )
    return MujocoBench(runs=2, seconds=6.0)


@pytest.fixture(scope="module")
def plain(mujoco_bench: MujocoBench) -> Set:
    return mujoco_bench.draw(SEED, quiet=True)


def rms(x: Array) -> float:
    return float(np.sqrt(np.nanmean(np.square(x))))


def test_the_nominal_joint_obeys_both_balances(plain: Set) -> None:
    """What is left is the lag of the drives' velocities: below a percent of rated torque, and no zero."""
    rated = min(j["rated_torque_nm"] for j in plain.joints.values())
    for run in plain.runs:
        for left, _ in residuals(run, plain.joints):
            assert rms(left) < 0.005 * rated
            assert abs(float(np.nanmean(left))) < 0.002 * rated


def test_both_joints_carry_the_same_torque_face_to_face(plain: Set) -> None:
    for run in plain.runs:
        assert np.array_equal(run["j1.torque_nm"], run["j2.torque_nm"])
        assert np.max(np.abs(run["j1.link_position_rad"] + run["j2.link_position_rad"])) < 2e-6


def expected(  # noqa: PLR0911
    name: str, drawn: Set, k: int, joint: int
) -> tuple[Array | None, Array | None]:
    """What an effect adds to motor and torsion balance of its joint, from its equation and the measured channels."""
    run, j, p = drawn.runs[k], drawn.joints[joint], drawn.truth[0]["parameters"]
    at = f"j{joint}."
    i, gear = run[at + "current_a"], j["gear_ratio"]
    v, torque = run[at + "motor_velocity_rad_s"] / gear, run[at + "torque_nm"]
    stiffness = j["stiffness_nm_per_rad"]
    angle = run[at + "motor_position_rad"]
    link = run[at + "link_position_rad"]
    d = run[at + "motor_position_rad"] / gear - link
    s = np.sign(v)
    if name == "coulomb_friction":
        return (p["coulomb_nm"] - j["friction"]["coulomb_nm"]) * s, None
    if name == "viscous_friction":
        return (p["viscous_nms_per_rad"] - j["friction"]["viscous_nms_per_rad"]) * v, None
    if name == "stribeck_friction":
        return p["stribeck_nm"] * np.exp(-((v / p["stribeck_velocity_rad_s"]) ** 2)) * s, None
    if name == "load_dependent_friction":
        return p["load_coefficient"] * np.abs(torque) * s, None
    if name == "friction_asymmetry":
        return p["asymmetry_nm"] * np.abs(s), None
    if name == "torque_constant":
        return -gear * (p["torque_constant_nm_per_a"] - j["torque_constant_nm_per_a"]) * i, None
    if name == "torque_constant_saturation":
        return gear * j["torque_constant_nm_per_a"] * p["saturation_per_a"] * i * np.abs(i), None
    if name in ("torque_ripple", "cogging"):
        return p["amplitude_nm"] * np.cos(p["order_per_motor_rev"] * angle + p["phase_rad"]), None
    if name == "current_offset":
        return gear * j["torque_constant_nm_per_a"] * p["offset_a"] * np.ones_like(i), None
    if name == "kinematic_error":
        turn = p["order_per_motor_rev"] * angle + p["phase_rad"]
        slope = gear * p["order_per_motor_rev"] * p["amplitude_rad"] * np.cos(turn)
        return torque * slope, -stiffness * p["amplitude_rad"] * np.sin(turn)
    if name == "nonlinear_stiffness":
        return None, -p["cubic_nm_per_rad3"] * d**3
    if name == "lost_motion":
        return None, stiffness * np.clip(d, -0.5 * p["width_rad"], 0.5 * p["width_rad"])
    if name == "encoder_eccentricity":
        return None, -stiffness * p["amplitude_rad"] * np.sin(link + p["phase_rad"])
    if name == "unbalance":
        load = p["moment_nm"] * np.sin(link + p["phase_rad"])
        return load, load
    if name == "sensor_gain":
        error = (1.0 - 1.0 / p["gain"]) * torque
        return -error, -error
    if name == "sensor_offset":
        error = p["offset_nm"] * np.ones_like(i)
        return -error, -error
    if name == "sensor_crosstalk":
        error = p["amplitude_nm"] * np.cos(run["j1.link_position_rad"] + p["phase_rad"])
        return -error, -error
    if name == "sensor_drift":
        error = p["per_k_nm"] * (run["j1.temperature_c"] - 25.0)
        return -error, -error
    if name == "torque_constant_temperature":
        warm = p["per_k"] * (run[at + "temperature_c"] - 25.0)
        return -gear * j["torque_constant_nm_per_a"] * warm * i, None
    if name == "gear_damping":
        speed = run[at + "motor_velocity_rad_s"] / gear - run[at + "link_velocity_rad_s"]
        return np.zeros_like(i), -(p["damping_nms_per_rad"] - j["damping_nms_per_rad"]) * speed
    assert name == "temperature_dependent_friction", name
    cooler = np.exp(-p["viscous_per_k"] * (run[at + "temperature_c"] - 25.0)) - 1.0
    return j["friction"]["viscous_nms_per_rad"] * v * cooler, None


CLOSED = [n for n in UNITS if n not in ("hysteresis", "rotor_inertia", "link_inertia", "channel_delay")]


@pytest.mark.parametrize("name", CLOSED)
def test_an_effect_moves_the_balances_by_its_equation(name: str, mujoco_bench: MujocoBench) -> None:
    """To a fifth of its own size, or a thousandth of rated torque for what drive filters leave at reversals."""
    place = mujoco_bench.places(name)[0]
    hidden = Hidden(name, place, (10.0 if name == "kinematic_error" else 3.0) * UNITS[name].start)
    drawn = mujoco_bench.draw(SEED, [hidden], quiet=True)
    joint = 1 if place == SENSOR else int(place)
    rated = drawn.joints[joint]["rated_torque_nm"]
    for k, run in enumerate(drawn.runs):
        found = residuals(run, {joint: drawn.joints[joint]})
        for (found_nm, _), wanted in zip(found, expected(name, drawn, k, joint), strict=True):
            left, m = found_nm, len(found_nm)
            trace = np.zeros(m) if wanted is None else wanted[: m * 10].reshape(m, 10).mean(axis=1)
            if name in (
                "cogging",
                "torque_ripple",
                "kinematic_error",
            ):  # faster waves are gone with the mean of a bin, and in the drive's filter
                rate = (
                    drawn.truth[0]["parameters"]["order_per_motor_rev"]
                    * run[f"j{joint}.motor_velocity_rad_s"]
                )
                trace[np.abs(rate[: m * 10 : 10]) > 60.0] = np.nan
                trace[np.abs(rate[9 : m * 10 : 10]) > 60.0] = np.nan
                if np.isfinite(left + trace).sum() < 20:
                    continue
                left = np.where(np.isfinite(trace), left, np.nan)
            assert rms(left - trace) < 0.2 * rms(np.where(np.isfinite(left), trace, np.nan)) + 0.004 * rated


def amplitude(found: Set, plain: Set, trace: Sequence[Array], joint: int, balance: int) -> float:
    """Return how much of a trace [n] per run is in the difference of a balance (0 motor, 1 torsion) of two sets."""
    top = bottom = 0.0
    for run, other, x in zip(found.runs, plain.runs, trace, strict=True):
        own = {joint: plain.joints[joint]}
        d = residuals(run, own)[balance][0] - residuals(other, own)[balance][0]
        shape = x[: len(d) * 10].reshape(len(d), 10).mean(axis=1)
        there = np.isfinite(d)
        top += float(d[there] @ shape[there])
        bottom += float(shape[there] @ shape[there])
    return top / bottom


def test_a_kinematic_error_takes_torque_from_the_motor(mujoco_bench: MujocoBench, plain: Set) -> None:
    """Virtual work: slope of the error times the transmitted torque; where the wave is slow enough to see."""
    drawn = mujoco_bench.draw(SEED, [Hidden("kinematic_error", 1, 0.1)], quiet=True)
    order = drawn.truth[0]["parameters"]["order_per_motor_rev"]
    traces = []
    for k, run in enumerate(drawn.runs):
        loss, _ = expected("kinematic_error", drawn, k, 1)
        assert loss is not None
        traces.append(np.where(np.abs(order * run["j1.motor_velocity_rad_s"]) < 100.0, loss, 0.0))
    assert amplitude(drawn, plain, traces, 1, 0) == pytest.approx(1.0, abs=0.2)


def test_a_free_bench_has_the_inertias_that_it_is_given() -> None:
    """A constant current turns both joints: the torque is that of all inertias, the sensor's that of joint 2's."""
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed: pip install -e '.[dev]'")
    one = JointPlant(100.0, 0.05, 1.0, 2e4, 20.0, 0.12, coulomb=0.0, viscous=0.0)
    model = mujoco.MjModel.from_xml_string(model_xml((one, one)))
    data = mujoco.MjData(model)
    current = 2.0
    data.ctrl[0] = data.act[0] = current
    for _ in range(4000):
        before = float(data.qvel[0])
        mujoco.mj_step(model, data)
    found = (float(data.qvel[0]) - before) / model.opt.timestep
    inertia = one.inertia + one.link_inertia
    expected = one.ratio * one.kt * current / (2.0 * inertia)
    assert found == pytest.approx(expected, rel=1e-4)
    assert -float(data.qfrc_constraint[1]) == pytest.approx(inertia * expected, rel=1e-4)


def test_inertias_are_inertias(mujoco_bench: MujocoBench, plain: Set) -> None:
    for name, balance, side in (("rotor_inertia", 0, "motor"), ("link_inertia", 1, "link")):
        drawn = mujoco_bench.draw(SEED, [Hidden(name, 1, 0.6)], quiet=True)
        joint = drawn.joints[1]
        gear = joint["gear_ratio"]
        p = drawn.truth[0]["parameters"]
        more = (
            (p["rotor_inertia_kgm2"] - joint["rotor_inertia_kgm2"]) * gear**2
            if side == "motor"
            else p["link_inertia_kgm2"] - joint["link_inertia_kgm2"]
        )
        scale = gear if side == "motor" else 1.0
        trace = [more * np.gradient(run[f"j1.{side}_velocity_rad_s"] / scale, 1e-3) for run in drawn.runs]
        assert amplitude(drawn, plain, trace, 1, balance) == pytest.approx(1.0, abs=0.15), name


def test_hysteresis_is_a_loop_of_its_torque(mujoco_bench: MujocoBench) -> None:
    drawn = mujoco_bench.draw(SEED, [Hidden("hysteresis", 1, 0.05)], quiet=True)
    torque = drawn.truth[0]["parameters"]["torque_nm"]
    left = np.concatenate([residuals(run, {1: drawn.joints[1]})[1][0] for run in drawn.runs])
    assert np.quantile(left, 0.98) == pytest.approx(torque, rel=0.1)
    assert np.quantile(left, 0.02) == pytest.approx(-torque, rel=0.1)


@pytest.mark.parametrize("channel", CHANNELS)
def test_a_late_channel_is_late(channel: str, mujoco_bench: MujocoBench, plain: Set) -> None:
    there = mujoco_bench.draw(SEED, [Hidden("channel_delay", 1, 0.004, channel)], quiet=True)
    column = {"sensor": "j1.torque_nm", "current": "j1.current_a", "link": "j1.link_position_rad"}[channel]
    assert there.truth[0]["joint"] == (SENSOR if channel == "sensor" else 1)
    assert there.truth[0]["parameters"]["channel"] == CHANNELS.index(channel)
    for late, on_time in zip(there.runs, plain.runs, strict=True):
        assert np.allclose(late[column][4:], on_time[column][:-4], atol=1e-9)


def test_what_is_hidden_leaves_noise_and_days_alone(mujoco_bench: MujocoBench) -> None:
    plain = mujoco_bench.draw(SEED)
    offset = mujoco_bench.draw(SEED, [Hidden("sensor_offset", SENSOR, 0.05)])
    again = mujoco_bench.draw(SEED)
    for a, b, c in zip(plain.runs, offset.runs, again.runs, strict=True):
        assert all(np.array_equal(a[name], c[name]) for name in a)
        assert np.array_equal(a["j1.current_a"], b["j1.current_a"])
        step = np.max(
            np.abs(b["j1.torque_nm"] - a["j1.torque_nm"] - offset.truth[0]["parameters"]["offset_nm"])
        )
        assert step < 2e-3 * plain.joints[1]["rated_torque_nm"]


@pytest.fixture(scope="module")
def whole(mujoco_bench: MujocoBench) -> tuple[MujocoBench, Set]:
    bench = MujocoBench(runs=1)
    return bench, bench.draw(SEED)


@pytest.mark.parametrize("kind", MujocoBench.foreign)
def test_what_is_foreign_shows(kind: str, whole: tuple[MujocoBench, Set]) -> None:
    bench, without = whole
    place = bench.places(kind)[0]
    drawn = bench.draw(SEED, [Hidden(kind, place)])
    (truth,) = drawn.truth
    assert truth["places"]
    change = 0.0
    for run, other in zip(drawn.runs, without.runs, strict=True):
        for (a, _), (b, _) in zip(residuals(run, drawn.joints), residuals(other, drawn.joints), strict=True):
            change = max(change, float(np.nanmax(np.abs(a - b))))
    assert change > 0.01 * min(j["rated_torque_nm"] for j in drawn.joints.values())


# Measured.


def test_all_usable_recordings_are_there() -> None:
    """Seven of the large actuator, without the dead channel, six of the small one."""
    assert [len(recordings(size)) for size in ("large", "small")] == [7, 6]


@pytest.mark.parametrize("size", ["large", "small"])
def test_the_ladder_is_taken_from_the_recordings_and_the_rest_is_left(size: str) -> None:
    joint = JOINTS[size]
    for run in recordings(size):
        v = run["j1.motor_velocity_rad_s"] / joint["gear_ratio"]
        s = np.tanh(v / 0.02)
        moving = np.abs(v) > 0.05
        left = (
            joint["gear_ratio"] * joint["torque_constant_nm_per_a"] * run["j1.current_a"]
            - joint["gear_ratio"] ** 2 * joint["rotor_inertia_kgm2"] * acceleration(v)
            - joint["friction"]["coulomb_nm"] * s
            - joint["friction"]["viscous_nms_per_rad"] * v
            - run["j1.torque_nm"]
        )[moving]
        assert abs(left.mean()) < 0.005 * joint["rated_torque_nm"]
        assert 1e-3 < rms(left) / joint["rated_torque_nm"] < 0.1


@pytest.mark.parametrize("size", ["large", "small"])
def test_seconds_that_a_ladder_has_not_seen_keep_more_of_everything(size: str) -> None:
    """Only the current differs; a constant, of which a fit to the run itself leaves nothing, is left in most of them."""
    joint = JOINTS[size]
    constants = []
    for fitted, unseen in zip(recordings(size), recordings(size, unseen=True), strict=True):
        differ = {c for c in fitted if not np.array_equal(fitted[c], unseen[c], equal_nan=True)}
        long = fitted["time_s"][-1] > 3.0
        assert differ == ({"j1.current_a"} if long else set())
        if long:
            moving = np.abs(fitted["j1.motor_velocity_rad_s"]) / joint["gear_ratio"] > 0.05
            more = (unseen["j1.current_a"] - fitted["j1.current_a"])[moving]
            more_nm = joint["gear_ratio"] * joint["torque_constant_nm_per_a"] * more
            constants.append(abs(float(more_nm.mean())) / joint["rated_torque_nm"])
    assert max(constants) > 0.001


@pytest.mark.parametrize("name", MeasuredBench.effects)
def test_an_effect_of_nothing_changes_nothing_and_one_of_some_size_does(name: str) -> None:
    bench = MeasuredBench()
    place = bench.places(name)[0]
    plain = bench.draw(3)
    for size, changed in ((1e-12, False), (0.05, True)):
        drawn = bench.draw(3, [Hidden(name, place, size, bench.variants(name)[0])])
        moved = max(
            rms(drawn.runs[k][column] - plain.runs[k][column]) / rms(plain.runs[k][column])
            for k in range(len(plain.runs))
            for column in ("j1.current_a", "j1.torque_nm")
        )
        assert (moved > 1e-4) == changed, name


def test_measured_effects_have_the_size_told() -> None:
    bench = MeasuredBench()
    plain, gain = bench.draw(3), bench.draw(3, [Hidden("sensor_gain", SENSOR, 0.1)])
    for a, b in zip(plain.runs, gain.runs, strict=True):
        assert np.allclose(b["j1.torque_nm"], gain.truth[0]["parameters"]["gain"] * a["j1.torque_nm"])
    saturated = bench.draw(3, [Hidden("torque_constant_saturation", 1, 0.2)])
    k = saturated.truth[0]["parameters"]["saturation_per_a"]
    for a, b in zip(plain.runs, saturated.runs, strict=True):
        i = b["j1.current_a"]
        assert np.allclose(i * (1.0 - k * np.abs(i)), a["j1.current_a"])


@pytest.mark.parametrize("kind", MeasuredBench.foreign)
def test_measured_foreign_kinds_have_places(kind: str) -> None:
    bench = MeasuredBench()
    drawn, plain = bench.draw(5, [Hidden(kind, bench.places(kind)[0])]), bench.draw(5)
    assert drawn.truth[0]["places"]
    assert any(
        not np.array_equal(a[c], b[c])
        for a, b in zip(drawn.runs, plain.runs, strict=True)
        for c in ("j1.current_a", "j1.torque_nm")
    )


# Sizes.


@pytest.mark.parametrize("bench", [MujocoBench, MeasuredBench])
def test_every_effect_of_a_bench_has_a_frozen_size(bench: type[Bench]) -> None:
    frozen = sizes(bench.name)
    assert set(frozen) == {key(name, v) for name in bench.effects for v in bench().variants(name)}
    assert all(size > 0.0 for size in frozen.values())
    usable = [name for name in frozen if 3.0 * frozen[name] <= UNITS[name.split()[0]].largest]
    assert len(usable) >= 0.9 * len(frozen)


def test_what_would_break_a_joint_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen: dict[str, Any] = {"sensor_gain": 0.2}
    monkeypatch.setattr("validation.worlds.oracle.sizes", lambda bench: frozen)
    assert hidden_size("mujoco", "sensor_gain", 1.0) == 0.2
    assert hidden_size("mujoco", "sensor_gain", 3.0) is None
