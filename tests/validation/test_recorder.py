"""The recorder does what its settings say, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.sysid.runs.files import read_runs
from validation.diagnosis.entries import Columns
from validation.diagnosis.recorder import PRESETS, Recorder, csv_text, record
from validation.diagnosis.scores import write

N = 2000
JOINT = {
    "name": "j",
    "gear_ratio": 100.0,
    "torque_constant_nm_per_a": 0.1,
    "rotor_inertia_kgm2": 6e-5,
    "stiffness_nm_per_rad": 16000.0,
    "damping_nms_per_rad": 8.0,
    "link_inertia_kgm2": 0.1,
    "rated_torque_nm": 40.0,
    "friction": {"coulomb_nm": 4.0, "viscous_nms_per_rad": 3.0},
}


def a_run(begin: float = 0.0) -> Columns:
    t = 1e-3 * np.arange(N)
    q = 12.0 * np.sin(1.7 * t + begin)
    return {
        "time_s": t,
        "j1.current_a": 2.0 * np.cos(3.0 * t) + 0.123456789,
        "j1.motor_position_rad": 100.0 * q,
        "j1.motor_velocity_rad_s": 2040.0 * np.cos(1.7 * t + begin),
        "j1.link_position_rad": q,
        "j1.torque_nm": 20.0 * np.cos(3.0 * t) + 0.1,
        "j1.temperature_c": 30.0 + 5.0 * t,
    }


def one(recorder: Recorder, seed: int = 1) -> Columns:
    (table,) = record([a_run()], recorder, seed)
    return table


def test_a_full_recorder_changes_nothing() -> None:
    for name, x in one(Recorder()).items():
        assert np.allclose(x, a_run()[name], rtol=1e-11, atol=0.0), name


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_it_is_a_function_of_run_settings_and_seed(name: str) -> None:
    first, again = one(PRESETS[name]), one(PRESETS[name])
    assert all(np.array_equal(first[key], again[key]) for key in first)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_the_text_holds_the_values(name: str) -> None:
    table = one(PRESETS[name])
    lines = csv_text(table, PRESETS[name]).splitlines()
    assert lines[0] == ",".join(table)
    cells = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    assert np.array_equal(cells, np.column_stack(list(table.values())))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_can_be_read(name: str, tmp_path: Path) -> None:
    paths, _ = write(tmp_path, [a_run(), a_run(0.4)], {1: JOINT}, PRESETS[name], 3)
    runs = read_runs(paths, segments=True)
    assert len(runs) == 2
    assert len(runs[0].table.time_s) > 90


@pytest.mark.parametrize(("digits", "step"), [(7, 1e-3), (6, 1e-2), (5, 1e-1)])
def test_digits_are_significant_ones(digits: int, step: float) -> None:
    """Of 1000 to 1200 rad of motor position the steps are as large as the digits left behind the point."""
    q = one(Recorder(digits=digits))["j1.motor_position_rad"]
    far, near = np.abs(q) > 1000.0, np.abs(q) < 100.0
    assert np.allclose(q[far] / step, np.round(q[far] / step), atol=1e-4)
    assert np.max(np.abs(q - a_run()["j1.motor_position_rad"])[far]) == pytest.approx(0.5 * step, rel=0.1)
    assert np.max(np.abs(q - a_run()["j1.motor_position_rad"])[near]) < 0.06 * step


def test_single_precision_and_fixed_decimals() -> None:
    table = one(Recorder(float32=True))
    assert np.array_equal(
        table["j1.torque_nm"].astype(np.float32), a_run()["j1.torque_nm"].astype(np.float32)
    )
    assert np.allclose(table["time_s"], a_run()["time_s"], rtol=1e-11, atol=0.0)
    fixed = one(Recorder(decimals=3))
    assert np.array_equal(fixed["j1.current_a"], np.round(a_run()["j1.current_a"], 3))


def test_a_slower_recorder_takes_every_so_many_rows() -> None:
    table = one(Recorder(rate_hz=250.0))
    assert np.array_equal(table["j1.torque_nm"], one(Recorder())["j1.torque_nm"][::4])


def test_jitter_of_sampling_is_told_by_the_stamps_and_that_of_stamps_is_not() -> None:
    sampled, stamped = one(Recorder(sampling_jitter=0.1)), one(Recorder(stamp_jitter=0.1))
    for table in (sampled, stamped):
        steps = np.diff(table["time_s"])
        assert np.std(steps) == pytest.approx(np.sqrt(2.0) * 1e-4, rel=0.1)
        assert steps.min() > 0.0
    true = 20.0 * np.cos(3.0 * sampled["time_s"]) + 0.1
    assert np.max(np.abs(sampled["j1.torque_nm"] - true)) < 1e-4
    assert np.array_equal(stamped["j1.torque_nm"], one(Recorder())["j1.torque_nm"])


def test_rounded_stamps_rise_and_lie_on_their_grid() -> None:
    t = one(PRESETS["rounded_stamps"])["time_s"]
    assert np.allclose(t / 1e-3, np.round(t / 1e-3), atol=1e-6)
    assert np.diff(t).min() > 0.0
    assert len(np.unique(np.round(np.diff(t), 6))) == 2  # 3 and 4 ms at 300 Hz


def test_rows_get_lost_in_losses() -> None:
    recorder = Recorder(lost=0.1, lost_rows=4.0)
    steps = np.round(np.diff(np.concatenate([one(recorder, seed)["time_s"] for seed in range(8)])) * 1000.0)
    gaps = steps[steps > 1.0] - 1.0
    assert gaps.sum() / (8 * N) == pytest.approx(0.1, rel=0.3)
    assert gaps.mean() == pytest.approx(4.0, rel=0.3)


def test_channels_have_ages_and_hold_their_values() -> None:
    table = one(Recorder(age_s={"torque_nm": 0.01}, held_hz={"temperature_c": 10.0}))
    assert np.allclose(table["j1.torque_nm"][10:], a_run()["j1.torque_nm"][:-10])
    assert np.array_equal(table["j1.current_a"], one(Recorder())["j1.current_a"])
    assert len(np.unique(table["j1.temperature_c"])) == 20
    half = one(Recorder(age_s={"torque_nm": 0.0005}))["j1.torque_nm"]
    assert np.allclose(half[1:], 0.5 * (a_run()["j1.torque_nm"][1:] + a_run()["j1.torque_nm"][:-1]))


def test_the_drives_filter_is_a_first_order_low_pass() -> None:
    """A ramp comes out late by the time constant, once it is settled."""
    run = a_run()
    run["j1.motor_velocity_rad_s"] = 50.0 * run["time_s"]
    (table,) = record([run], Recorder(velocity_filter_s=0.02), 1)
    late = run["j1.motor_velocity_rad_s"] - table["j1.motor_velocity_rad_s"]
    assert late[500:] == pytest.approx(50.0 * 0.02, rel=0.05)
    assert np.allclose(table["j1.motor_position_rad"], run["j1.motor_position_rad"], rtol=1e-10)


def test_wrapped_angles_are_the_same_angles() -> None:
    q = one(Recorder(wrapped=True))["j1.motor_position_rad"]
    assert q.min() >= -np.pi
    assert q.max() < np.pi + 1e-9
    assert np.allclose(np.exp(1j * q), np.exp(1j * a_run()["j1.motor_position_rad"]), atol=1e-8)


def test_several_runs_in_one_file_have_pauses() -> None:
    (table,) = record([a_run(), a_run(0.4)], Recorder(one_file=True, pause_s=3.0), 1)
    steps = np.diff(table["time_s"])
    assert len(table["time_s"]) == 2 * N
    assert np.flatnonzero(steps > 0.0015).tolist() == [N - 1]
    assert steps[N - 1] == pytest.approx(3.0)


@pytest.mark.parametrize(
    "wrong", [{"digits": 0}, {"lost": 1.0}, {"lost_rows": 0.5}, {"age_s": {"torque_nm": -1e-3}}]
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(Recorder(), **wrong)
