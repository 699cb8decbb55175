"""Fits from known loads: two payloads on an unknown arm, nothing mounted, too little. Runs of a joint with plain laws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.command import main
from jtqd.sysid.fit.few_runs import fit_few_runs
from jtqd.sysid.fit.known_load import Teacher, fit_teacher
from jtqd.sysid.fit.signals import RunSignals, run_signals
from jtqd.sysid.runs.column_map import SHARP, KnownLoad
from jtqd.sysid.runs.tables import write_run

FILE = shipped("joint1.yaml")
JOINT = load_joint(FILE)
STIFFNESS = 14_000.0
GAIN = 0.97
ARM = np.array((2.4, -1.3, 0.12))
LEVER_M = 0.3
SETTINGS = EstimatorSettings(method="fused")


def run_of(
    seed: int, mass_kg: float, seconds: float = 10.0, *, arm: bool = True, one_way: bool = False
) -> tuple[RunTable, np.ndarray]:
    """A run with a payload, Coulomb, viscous and load friction; and its true torque [n]."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1e-3)
    f, p = rng.uniform(0.1, 0.45, 3), rng.uniform(0.0, 6.0, 3)
    a = rng.uniform(0.3, 0.8, 3)
    ramp = np.clip((t - 0.3) / 1.0, 0.0, 1.0)
    ramp = ramp * ramp * (3.0 - 2.0 * ramp)
    if one_way:
        q = 0.35 * t * ramp
    else:
        q = ramp * sum(x * np.sin(2.0 * np.pi * y * t + z) for x, y, z in zip(a, f, p, strict=True))
    acceleration = np.gradient(np.gradient(q, 1e-3), 1e-3)
    weight = mass_kg * 9.80665 * LEVER_M
    torque = weight * np.sin(q) + mass_kg * LEVER_M**2 * acceleration
    if arm:
        torque = torque + ARM @ np.array((np.sin(q), np.cos(q), acceleration))
    motor = JOINT.gear_ratio * (q + torque / STIFFNESS)
    w = np.gradient(motor, 1e-3) / JOINT.gear_ratio
    lost = np.tanh(w / 0.01) * (2.5 + 0.1 * np.abs(torque)) + 1.5 * w
    reflected = JOINT.rotor_inertia_kgm2 * JOINT.gear_ratio**2
    needed = torque + lost + reflected * np.gradient(w, 1e-3)
    current = needed / (GAIN * JOINT.gear_ratio * JOINT.torque_constant_nm_per_a)
    columns = JointColumns(
        current_a=current + 0.01 * rng.normal(size=len(t)),
        motor_position_rad=motor,
        motor_velocity_rad_s=JOINT.gear_ratio * w,
        link_position_rad=np.round((q + 4e-6 * rng.normal(size=len(t))) / 1.2e-5) * 1.2e-5,
        temperature_c=np.full(len(t), 25.0),
    )
    return RunTable(t, {1: columns}), torque


def signals_of(masses: list[float], first: int = 0) -> tuple[list[RunSignals], list[FloatArray]]:
    made = [run_of(first + k, mass) for k, mass in enumerate(masses)]
    signals = []
    for k, (mass, (table, _)) in enumerate(zip(masses, made, strict=True)):
        columns = table.joint(1, JOINT.gear_ratio)
        assert columns.link_position_rad is not None
        load = KnownLoad(None, mass, LEVER_M, mass * LEVER_M**2, arm="unknown")
        part = load.torque(table.time_s, columns.link_position_rad, SHARP)
        signals.append(run_signals(f"{k}", JOINT, SETTINGS, table.time_s, columns, part))
    return signals, [torque for _, torque in made]


@pytest.mark.parametrize("two", [True, False], ids=["two encoders", "one encoder"])
def test_the_arm_is_found_and_completes_the_teacher(two: bool) -> None:
    signals, true = signals_of([1.0, 8.0, 1.0, 8.0, 1.0, 8.0])
    teacher = fit_teacher(signals, JOINT, two_encoders=two)
    spread = np.sqrt(np.diag(teacher.covariance))
    assert np.all(np.abs(teacher.arm - ARM) < 4.0 * spread)
    assert spread[:2].max() < 0.3
    assert not teacher.refusal(JOINT)
    assert teacher.stiffness_share < 0.03 if two else teacher.stiffness_share > 0.5
    for run, torque in zip(signals, true, strict=True):
        done = teacher.complete(run)
        assert done.arm is None
        assert done.teacher_nm is not None
        error = np.convolve(done.raw_sensor_nm - torque, np.full(100, 0.01), "same")[done.moving]
        assert np.sqrt(np.mean(error**2)) < 0.15
        assert np.abs(np.mean(error)) < 4.0 * done.teacher_nm.max()
    assert max(np.abs(torque).max() for torque in true) == pytest.approx(teacher.load_nm, rel=0.1)


def test_equal_payloads_tell_no_arm() -> None:
    signals, _ = signals_of([8.0] * 6)
    teacher = fit_teacher(signals, JOINT, two_encoders=True)
    assert "payloads that differ by 10 Nm" in teacher.refusal(JOINT)
    different = fit_teacher(signals_of([1.0, 8.0] * 3)[0], JOINT, two_encoders=True)
    assert different.sigma_nm < 0.3 * teacher.sigma_nm


def test_a_whole_teacher_stays_as_it_is() -> None:
    signals, _ = signals_of([4.0])
    run = replace(signals[0], arm=None)
    teacher = Teacher(ARM, np.eye(3), 0.01)
    assert teacher.complete(run) is run


def written(folder: Path, masses: dict[str, list[float]], load: str, **options: bool) -> Path:
    seed = 0
    for name, each in masses.items():
        (folder / name).mkdir()
        for mass in each:
            write_run(folder / name / f"{seed}.csv", run_of(seed, mass, **options)[0])
            seed += 1
    (folder / "map.yaml").write_text(f"j1.load: {load}\n")
    return folder


def fit(folder: Path, names: list[str], out: Path) -> int:
    runs = [str(folder / name) for name in names]
    return main(
        ["losses", *runs, "--joint", str(FILE), "--columns", str(folder / "map.yaml"), "--out", str(out)]
    )


BOTH = (
    "{light: {mass_kg: 1.0, lever_m: 0.3, arm: unknown}, heavy: {mass_kg: 8.0, lever_m: 0.3, arm: unknown}}"
)


def test_two_payloads_give_a_joint_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path, {"light": [1.0] * 4, "heavy": [8.0] * 4}, BOTH)
    assert fit(folder, ["light", "heavy"], tmp_path / "out.yaml") == 0
    report = capsys.readouterr().out
    assert "Nm sin q" in report
    assert "not determined" not in report
    joint: Joint = load_joint(tmp_path / "out.yaml")
    assert joint.fused is not None
    assert joint.fused.torsion is not None
    assert joint.fused.torsion.stiffness_nm_per_rad == pytest.approx(STIFFNESS, rel=0.04)
    assert joint.provenance["fused"]["known_loads"]


def test_one_payload_on_an_unknown_arm_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path, {"heavy": [8.0] * 6}, "{mass_kg: 8.0, lever_m: 0.3, arm: unknown}")
    assert fit(folder, ["heavy"], tmp_path / "out.yaml") == 3
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert "needed: payloads that differ by 10 Nm, each moved both ways" in lines[0]
    assert not (tmp_path / "out.yaml").exists()


def test_motion_one_way_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path, {"light": [1.0] * 3, "heavy": [8.0] * 3}, BOTH, one_way=True)
    assert fit(folder, ["light", "heavy"], tmp_path / "out.yaml") == 3
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert not (tmp_path / "out.yaml").exists()


def test_nothing_mounted_tells_no_stiffness_and_no_load_friction(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(tmp_path, {"free": [0.0] * 6}, "{inertia_kgm2: 0.0}", arm=False)
    assert fit(folder, ["free"], tmp_path / "out.yaml") == 0
    report = capsys.readouterr().out
    assert "not determined: stiffness" in report
    assert "not determined: load friction" in report
    joint = load_joint(tmp_path / "out.yaml")
    assert joint.fused is not None
    assert joint.fused.torsion is None
    loss = joint.fused.loss.positive
    assert loss.constant_nm[1] == pytest.approx(2.5, abs=0.3)
    assert joint.fused.sigma.load * max(joint.fused.sigma.scale) > 0.05


def test_few_runs_hold_what_the_teacher_does_not_know() -> None:
    signals, _ = signals_of([1.0, 8.0, 1.0, 8.0])
    teacher = fit_teacher(signals, JOINT, two_encoders=False)
    done = [teacher.complete(run) for run in signals]
    doubtful = [replace(run, teacher_nm=np.full(len(run.sensor_nm), 2.0)) for run in done]
    sure, unsure = (fit_few_runs(runs, JOINT).fused.sigma for runs in (done, doubtful))
    assert min(unsure.scale) * unsure.current_nm > 1.5
    assert unsure.current_nm > 1.5 * sure.current_nm
