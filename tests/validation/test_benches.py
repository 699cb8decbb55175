"""The benches are what they say: equations in closed form, the same set for the same seed, effects as large as told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.validation.balances import binned, expected, rms, signals, slow_enough
from validation.diagnosis.benches import Bench, hidden_size, key, sizes
from validation.diagnosis.entries import ENTRIES, SENSOR, Hidden, Set
from validation.diagnosis.measured_bench import JOINTS, MeasuredBench, acceleration, recordings
from validation.diagnosis.mujoco_bench import JointPlant, MujocoBench, model_xml
from validation.diagnosis.oracle import residuals

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


@pytest.mark.parametrize(
    ("name", "variant"), [(n, v) for n in MujocoBench.effects for v in MujocoBench(1).variants(n)]
)
def test_an_effect_moves_the_balances_by_its_equation(
    name: str, variant: str, mujoco_bench: MujocoBench
) -> None:
    place = mujoco_bench.places(name)[0]
    factor = 10.0 if name == "kinematic_error" else 3.0
    drawn = mujoco_bench.draw(
        SEED, [Hidden(name, place, factor * ENTRIES[name].bench.start, variant)], quiet=True
    )
    number = 1 if place == SENSOR else int(place)
    joint, parameters = drawn.joints[number], drawn.truth[0]["parameters"]
    assert drawn.truth[0]["joint"] == (SENSOR if variant == "sensor" else place)
    for run in drawn.runs:
        s = signals(run, number, joint)
        clear = s.moving & slow_enough(name, parameters, s)
        formula = expected(name, parameters, s, joint, run["j1.temperature_c"])
        for found, wanted in zip((s.motor_nm, s.torsion_nm), formula, strict=True):
            want, left = binned(wanted, clear), binned(found - wanted, clear)
            assert rms(left) < 0.03 * rms(want) + 3e-4 * joint["rated_torque_nm"]


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
    usable = [name for name in frozen if 3.0 * frozen[name] <= ENTRIES[name.split()[0]].bench.largest]
    assert len(usable) >= 0.9 * len(frozen)


def test_what_would_break_a_joint_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen: dict[str, Any] = {"sensor_gain": 0.2}
    monkeypatch.setattr("validation.diagnosis.benches.sizes", lambda bench: frozen)
    assert hidden_size("mujoco", "sensor_gain", 1.0) == 0.2
    assert hidden_size("mujoco", "sensor_gain", 3.0) is None
