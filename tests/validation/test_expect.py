"""What a data sheet makes of a bench: its values, in their places; and a table from a tiny study."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from jtqd.sim_can.towing.bench_file import TowingBench
from validation.goals import expect
from validation.goals.identify import the_four

TYPICAL = the_four()[1]


def bench(sheet: expect.Sheet, folder: Path) -> TowingBench:
    made = sheet.bench(TYPICAL, folder).bench()
    assert isinstance(made, TowingBench)
    return made


def test_values_of_a_data_sheet_are_those_of_the_bench(tmp_path: Path) -> None:
    sheet = expect.Sheet(17, 14, 1e-4, 3e-3, 0.05, 20_000.0, 50.0, 1.6)
    one = bench(sheet, tmp_path).joints[0]
    assert one.measurement.link_counts_per_rev == 1 << 17
    assert one.measurement.link_noise_rad == pytest.approx(math.pi / (1 << 17))
    assert one.measurement.motor_counts_per_rev == 1 << 14
    assert one.measurement.link_errors[0].amplitude_rad == pytest.approx(1e-4)
    assert one.measurement.link_errors[1].amplitude_rad == pytest.approx(1e-4 * 1.5 / 4.0)
    assert one.measurement.motor_errors[0].amplitude_rad == pytest.approx(3e-3)
    assert one.measurement.current_noise_a == 0.05
    assert one.gear.stiffness_nm_per_rad[0] == 20_000.0
    assert one.gear.stiffness_nm_per_rad[2] == pytest.approx(20_000.0 * 16.8 / 11.4)
    assert one.joint.gear_ratio == 50.0
    assert one.friction.coulomb_nm == pytest.approx(1.6)
    assert one.friction.load_nm == pytest.approx(3.0)


def test_another_ratio_leaves_torque_and_inertia_at_the_joint(tmp_path: Path) -> None:
    (tmp_path / "as_it_is").mkdir()
    before = bench(expect.Sheet(), tmp_path / "as_it_is").joints[0]
    after = bench(expect.Sheet(ratio=50.0), tmp_path).joints[0]

    def at_the_joint(one: object) -> tuple[float, ...]:
        joint, motor = one.joint, one.motor  # type: ignore[attr-defined]
        g = joint.gear_ratio
        return (
            g * joint.torque_constant_nm_per_a,
            g * motor.torque_constant_nm_per_a,
            g * g * motor.rotor_inertia_kgm2,
            g * motor.cogging[0].amplitude_nm,
        )

    assert at_the_joint(after) == pytest.approx(at_the_joint(before))


def test_without_values_the_bench_is_as_it_is(tmp_path: Path) -> None:
    made = bench(expect.Sheet(), tmp_path)
    was = TYPICAL.bench()
    assert isinstance(was, TowingBench)
    assert made.joints[1].measurement == was.joints[1].measurement
    assert made.joints[1].gear == was.joints[1].gear
    assert made.joints[1].motor == was.joints[1].motor


def test_a_coarser_encoder_is_a_larger_error() -> None:
    fine, coarse = (
        expect.expected(TYPICAL, expect.Sheet(link_bits=bits), expect.SIZES["tiny"], 1, 2)
        for bits in (19, 13)
    )
    assert coarse.rmse_nm["ours_zeros"].value > 1.5 * fine.rmse_nm["ours_zeros"].value
    assert coarse.half_nm["ours_zeros"] > 1.5 * fine.half_nm["ours_zeros"]
    table = expect.table_of([fine, coarse])
    assert [row[0] for row in table.rows] == ["link_bits 19", "link_bits 13"]
