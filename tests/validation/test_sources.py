"""What an error is made of: its parts against closed forms, the true torsion against the bench's own, and the steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.observer import low_pass
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate
from jtqd.sim_can.towing.bench_file import TowingBench
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.fit.torsion import deflection
from tests.sysid.fit.fused_signals import FUSED
from validation.goals.plants import plant_file
from validation.goals.sources import PARTS, SOURCES, day_zeros, main, parts_of, true_torsion

PLANT = plant_file("bad_day", shipped("plants/bad_day.yaml"))


def test_parts_are_found_as_they_were_put_in_and_add_up() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(8000) * 1e-3
    link = 1.6 * np.sin(1.9 * t) + 0.9 * np.sin(0.7 * t)
    motor = 101.0 * link
    noise = rng.normal(0.0, 0.1, len(t))
    error = 0.5 + 0.4 * np.cos(2.0 * motor + 0.3) + 0.3 * np.sin(2.0 * link) + noise
    found = parts_of(error, motor, link, 1e-3)
    assert found.sum() == pytest.approx(float(np.mean(error * error)))
    named = dict(zip(PARTS, found, strict=True))
    assert named["constant in a run"] == pytest.approx(float(error.mean()) ** 2)
    assert named["motor's turn"] == pytest.approx(0.08, rel=0.1)
    assert named["link's turn"] == pytest.approx(float(np.var(0.3 * np.sin(2.0 * link))), rel=0.15)
    assert named["the rest"] == pytest.approx(0.01, rel=0.1)
    wave = np.sin(2.0 * math.pi * 0.3 * t)
    slow = parts_of(wave, 50.0 * t, 0.0 * t, 1e-3)
    assert slow[PARTS.index("slower than 1 Hz")] > 0.7 * float(np.mean(wave * wave))


def test_the_true_torsion_deflects_as_the_bench_does() -> None:
    """Without noise and slips: the deflection of the true parameters, through the spring, is the torque but for damping."""
    changed = PLANT.changed(SOURCES["noise of link encoder and current"]).changed(
        SOURCES["slips of the gear"]
    )
    bench = changed.bench()
    assert isinstance(bench, TowingBench)
    commands = (
        JointCommand.velocity(lambda t: 0.8 * math.sin(2.0 * t)),
        JointCommand.current(lambda t: 5.0 * math.sin(1.3 * t)),
    )
    run = emulate(bench, commands, 4.0, seed=3, day=bench.run_to_run.nominal_day)
    for number, side in enumerate(bench.joints, start=1):
        torsion = replace(true_torsion(side), zero_rad=0.0)
        signals = run_signals("a", side.joint, FUSED, run.table.time_s, run.table.joints[number])
        d = deflection(torsion, signals)[signals.moving]
        k1, k2, k3 = side.gear.stiffness_nm_per_rad
        first, second = torsion.hardening_rad
        size = np.abs(d)
        spring = (
            k1 * size + (k2 - k1) * np.maximum(size - first, 0) + (k3 - k2) * np.maximum(size - second, 0)
        )
        torque = np.ascontiguousarray(run.joint_torque_nm[:, number - 1])
        true = low_pass(torque, run.table.dt_s, FUSED.bandwidth_rad_s)[signals.moving]
        assert np.sqrt(np.mean((np.sign(d) * spring - true) ** 2)) < 0.3


def test_zeros_of_the_days_are_those_of_the_bench() -> None:
    bench = PLANT.bench()
    assert isinstance(bench, TowingBench)
    assert PLANT.changed(SOURCES["zeros of the encoders, by day"]).bench().run_to_run.link_zero_rad == 0.0  # type: ignore[union-attr]
    assert not day_zeros(bench, [], 500, 1)


@pytest.mark.campaign
def test_the_command_prints_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--tiny"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in (*PARTS, "the true torsion", "the torque itself, as old as ours"))
