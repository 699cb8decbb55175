"""A torque that is a known load's or a model's is no sensor: what would be a fault of a sensor is none of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.runs.bad_samples import held_values, saturation_limits
from jtqd.sysid.runs.channels import Channels, check_channels
from jtqd.sysid.runs.checks import CheckedRuns, channel_findings, check_runs
from jtqd.sysid.runs.column_map import ColumnMap, motion_of
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.tables import write_run

JOINT: Final[Joint] = replace(
    load_joint(shipped("joint1.yaml")), efficiency=None, effects=(), friction=Friction(3.0, 6.0)
)
T: Final = np.arange(0.0, 12.0, 0.002)
Q, V, A = 0.9 * np.sin(1.8 * T), 1.62 * np.cos(1.8 * T), -2.916 * np.sin(1.8 * T)
INERTIA: Final = JOINT.gear_ratio**2 * JOINT.rotor_inertia_kgm2
SCALE: Final = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a


def run(torque: FloatArray) -> RunTable:
    noise = np.random.default_rng(1).normal(scale=0.02, size=len(T))
    current = (torque + INERTIA * A + 3.0 * np.sign(V) + 6.0 * V + noise) / SCALE
    return RunTable(T, {1: JointColumns(current, motor_position_rad=JOINT.gear_ratio * Q, torque_nm=torque)})


def step_at(row: int) -> FloatArray:
    return np.where(np.arange(len(T)) == row, 8.0, 0.0)


LOADS: Final[dict[str, Callable[[], FloatArray]]] = {
    "nothing is mounted": lambda: np.zeros_like(T),
    "a small inertia": lambda: 0.002 * A,
    "a weight on a drum": lambda: np.full_like(T, 4.0),
    "a weight that is set down and stands": lambda: np.where((T > 4.0) & (T < 6.0), 0.0, 6.0 * np.sin(Q)),
    "a model that is printed in few digits": lambda: np.round(6.0 * np.sin(Q) / 2.0) * 2.0,
    "a model with a blow": lambda: 6.0 * np.sin(Q) + step_at(3000),
    "a model that is late": lambda: np.roll(6.0 * np.sin(3.0 * Q), 60),
}
NO_FAULT_OF_A_SENSOR: Final = {"a model with a blow", "a small inertia"}
"""Those that a sensor may read as well, or with a note only."""


def checked(table: RunTable, *known: int) -> CheckedRuns:
    return check_runs([("r.csv", table)], {1: JOINT}, known)


@pytest.mark.parametrize("what", LOADS)
def test_a_known_load_is_used_as_it_is(what: str) -> None:
    torque = LOADS[what]()
    result = checked(run(torque), 1)
    assert (result.refused, result.notes) == ((), ())
    used = result.runs[0][1].joints[1].torque_nm
    assert used is not None
    assert np.array_equal(used, torque)
    c = Channels(T, run(torque).joints[1], JOINT, "r: j1", known_load=True)
    assert check_channels(c) == []
    assert "torque_nm" not in held_values(c)
    assert "torque_nm" not in saturation_limits([run(torque)], {1: JOINT}, [1])[1]


@pytest.mark.parametrize("what", sorted(set(LOADS) - NO_FAULT_OF_A_SENSOR))
def test_the_same_of_a_sensor_is_its_fault(what: str) -> None:
    result = checked(run(LOADS[what]()))
    assert any("torque_nm" in line for line in (*result.refused, *result.notes))


def test_a_current_is_judged_beside_a_known_load_too() -> None:
    """In milliamperes; dead; of the other sign; held while the load changes."""
    table = run(1.2 * JOINT.rated_torque_nm * np.sin(Q))
    columns = table.joints[1]
    assert columns.current_a is not None
    held = columns.current_a.copy()
    held[1000:4000] = held[1000]
    for current, fault in (
        (1000.0 * columns.current_a, "mA"),
        (-columns.current_a, "sign of current_a, or hangs_at_rad off by pi"),
        (0.0 * columns.current_a, "dead channel"),
        (held, "stuck channel"),
    ):
        result = checked(RunTable(T, {1: replace(columns, current_a=current)}), 1)
        assert any(fault in line for line in (*result.refused, *result.notes)), fault


@pytest.mark.parametrize("factor", [1000.0, 30.0])
def test_a_load_of_another_size_names_mass_and_lever(factor: float) -> None:
    """A mass in grams is no torque in mNm: there is no sensor."""
    table = run(6.0 * np.sin(Q))
    load = factor * 6.0 * np.sin(Q)
    [line] = checked(RunTable(T, {1: replace(table.joints[1], torque_nm=load)}), 1).refused
    assert "mass_kg in g or lever_m in mm" in line
    assert "sensor" not in line


def test_two_known_loads_that_are_opposite_are_two_loads() -> None:
    one = run(6.0 * np.sin(Q)).joints[1]
    two = one.map(lambda _, x: -x)
    table = RunTable(T, {1: one, 2: two})
    assert list(check_runs([("r", table)], {1: JOINT, 2: JOINT}, (1, 2)).runs[0][1].joints) == [1, 2]
    assert list(check_runs([("r", table)], {1: JOINT, 2: JOINT}).runs[0][1].joints) == [1]


def test_the_reader_keeps_a_known_load_of_zero(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    rows = [f"{t:.3f},{q:.6f},{v:.6f}" for t, q, v in zip(T, JOINT.gear_ratio * Q, V, strict=True)]
    path.write_text("\n".join(["t,q,i", *rows]) + "\n")
    mapping: dict[str, object] = {
        "time_s": "t",
        "j1.motor_position_rad": "q",
        "j1.current_a": "i",
        "j1.load": {"torque_nm": "0 * q"},
    }
    [read] = read_runs([path], ColumnMap.from_mapping(mapping, "map", tmp_path), segments=True)
    assert read.known_loads == (1,)
    torque = read.table.joints[1].torque_nm
    assert torque is not None
    assert not torque.any()
    assert not any("dead" in note for note in read.notes)


def written(folder: Path, load: str) -> Path:
    """Two runs of the run table's own names, in folders by payload, and a map with this load alone."""
    for name, gain in (("light", 1.0), ("heavy", 4.0)):
        (folder / name).mkdir()
        write_run(folder / name / "run.csv", replace_link(run(gain * 6.0 * np.sin(Q))))
    (folder / "map.yaml").write_text(f"j1.load: {load}\n")
    return folder


def replace_link(table: RunTable) -> RunTable:
    return RunTable(table.time_s, {1: replace(table.joints[1], link_position_rad=Q)})


BY_RUN: Final = "{light: {mass_kg: 1, lever_m: 0.3}, heavy: {mass_kg: 5, lever_m: 0.3, arm: unknown}}"


def test_each_run_has_the_load_that_its_path_names(tmp_path: Path) -> None:
    folder = written(tmp_path, BY_RUN)
    light, heavy = read_runs([folder / "light", folder / "heavy"], folder / "map.yaml")
    weight = 9.80665 * 0.3 * np.sin(Q)
    torque = light.table.joints[1].torque_nm
    assert torque is not None
    assert torque == pytest.approx(weight + 0.09 * A, abs=0.02)  # not the table's own torque
    assert light.known_loads == heavy.known_loads == (1,)
    assert not light.known_parts
    assert heavy.table.joints[1].torque_nm is None
    assert heavy.known_parts[1] == pytest.approx(5.0 * weight + 0.45 * A, abs=0.1)
    assert any("on an unknown arm" in note for note in heavy.notes)


def test_a_run_on_an_unknown_arm_is_not_diagnosed(tmp_path: Path) -> None:
    folder = written(tmp_path, "{mass_kg: 5, lever_m: 0.3, arm: unknown}")
    read = read_runs([folder / "heavy"], folder / "map.yaml")
    [line] = check_runs([(each.name, each.table) for each in read], {1: JOINT}, (1,)).refused
    assert "no valid torque sensor" in line


@pytest.mark.parametrize(
    ("load", "expected"),
    [
        (
            "{empty: {mass_kg: 1, lever_m: 0.3}}",
            "found none of 'empty' in the path, expected one: j1.load",
        ),
        ("{run: {mass_kg: 1, lever_m: 0.3}, light: {mass_kg: 1, lever_m: 0.3}}", "found 'run' and 'light'"),
        (
            "{light: {mass_kg: 1, lever_m: 0.3, arm: none}}",
            "arm': found 'none', expected one of 'known', 'unknown'",
        ),
    ],
)
def test_a_load_that_is_not_clear_is_refused_in_one_line(tmp_path: Path, load: str, expected: str) -> None:
    folder = written(tmp_path, load)
    with pytest.raises(ValueError, match=r".") as error:
        read_runs([folder / "light"], folder / "map.yaml")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_known_load_is_no_dead_channel(tmp_path: Path) -> None:
    folder = written(tmp_path, "{inertia_kgm2: 0.0}")
    read = read_runs([folder / "light"], folder / "map.yaml")
    assert not channel_findings(read, 1, JOINT)


def test_a_fit_gets_the_ripple_of_an_acceleration_and_its_noise(tmp_path: Path) -> None:
    folder = written(tmp_path, "{inertia_kgm2: 1.0}")
    position = Q + 3e-5 * np.sin(2.0 * np.pi * 20.0 * T) + 1e-6 * np.random.default_rng(2).normal(size=len(T))
    table = run(np.zeros_like(T))
    write_run(
        folder / "light" / "run.csv",
        RunTable(T, {1: replace(table.joints[1], link_position_rad=position)}),
    )
    wave = np.sin(2.0 * np.pi * 20.0 * T)[500:-500]
    ripple = {}
    for segments in (False, True):
        [read] = read_runs([folder / "light"], folder / "map.yaml", segments=segments)
        torque = read.table.joints[1].torque_nm
        assert torque is not None
        ripple[segments] = -2.0 * float(np.mean((torque - A)[500:-500] * wave))
    true = 3e-5 * (2.0 * np.pi * 20.0) ** 2
    assert ripple[False] > 0.9 * true
    assert ripple[True] < ripple[False]


def test_the_acceleration_of_samples_that_jitter_is_as_of_even_ones() -> None:
    """A twentieth of a step, 14 bits: taken as even, 4 rad/s at the joint would be noise of 0.8 mrad."""
    rng = np.random.default_rng(8)
    even = 0.004 * np.arange(5000)
    jittered = even + 2e-4 * rng.normal(size=len(even))
    errors = []
    for t in (even, jittered):
        q = np.round(4.0 * np.sin(t) * 2**14 / (2.0 * np.pi)) * 2.0 * np.pi / 2**14
        _, found = motion_of(t, q)
        errors.append(float(np.std((found + 4.0 * np.sin(t))[50:-50])))
    assert errors[1] < 1.2 * errors[0]


@pytest.mark.parametrize("count", [3, 4, 5, 400])
def test_the_motion_of_few_uneven_rows_and_over_a_clock_that_is_set_is_finite(count: int) -> None:
    """A gap of years is no grid of years."""
    t = 0.004 * np.arange(count) + 1e-4 * np.random.default_rng(9).normal(size=count)
    swing = np.sin(3.0 * t)
    t[count // 2 :] += 1e9
    velocity, acceleration = motion_of(t, swing)
    assert velocity.shape == acceleration.shape == (count,)
    assert np.isfinite(velocity).all()
    assert np.isfinite(acceleration).all()
    if count > 100:
        assert acceleration[60:140] == pytest.approx(-9.0 * swing[60:140], abs=0.5)
