"""Drives that tell less: no link position, no velocity. What is derived, what is recorded, what is refused."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.daemon.config import load_config
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import SCALE
from tests.daemon.loop.one_drive import MS, OneDrive, config_with
from tests.shipped_bench import shipped_bench

BOTH = cr.FLAG_POSITION | cr.FLAG_MOTION
JOINT = load_joint(shipped("joint1.yaml"))
GEAR, RATED = JOINT.gear_ratio, JOINT.rated_torque_nm


def swing(k: int) -> float:
    """Motor position [rad] at cycle k: half a joint's turn to and fro, 0.4 Hz."""
    return math.pi * GEAR * math.sin(2.0 * math.pi * 0.4e-3 * k) / 2.0


def speed(k: int) -> float:
    """Motor velocity [rad/s] at cycle k."""
    return math.pi**2 * GEAR * 0.4 * math.cos(2.0 * math.pi * 0.4e-3 * k)


SWING: dict[str, Callable[[int], int]] = {
    "motor_position": lambda k: round(swing(k) / SCALE["motor_rad_per_count"]),
    "link_position": lambda k: round(swing(k) / GEAR / SCALE["link_rad_per_count"]),
    "motor_velocity": lambda k: round(speed(k) / SCALE["motor_rad_s_per_unit"]),
    "current": lambda k: round(150 * math.sin(2.0 * math.pi * 0.7e-3 * k + 1.0)),
    "statusword": lambda k: 0x27,
}


def torques(directory: Path, objects: Any, count: int = 3000) -> np.ndarray[Any, Any]:
    drive = OneDrive(config_with(directory, [], objects=objects), SWING)
    return np.array([drive.step(k).torque_nm for k in range(count)])


def test_one_encoder_is_a_gear_without_torsion(tmp_path: Path) -> None:
    """The estimate is that of an estimator that is given theta_m/G; the record has no link position."""
    drive = OneDrive(config_with(tmp_path, [], objects={"link_position": False}), SWING)
    other = JointEstimator(JOINT, EstimatorSettings(method="efficiency"))
    assert [pdo.length for pdo in drive.intake.pdos[:2]] == [4, 8]
    for k in range(200):
        record = drive.step(k)
        motor = SWING["motor_position"](k) * SCALE["motor_rad_per_count"]
        expected = other.step(
            0.001 if k else 0.0,
            SWING["current"](k) * SCALE["ampere_per_unit"],
            motor,
            SWING["motor_velocity"](k) * SCALE["motor_rad_s_per_unit"],
            motor / GEAR,
        )
        assert record.input_flags & BOTH == BOTH
        assert math.isnan(record.link_position_rad)
        assert record.motor_position_rad == motor
        assert struct.pack("<d", record.tob_nm) == struct.pack("<d", expected.tob_nm)
    assert record.status == 2


def test_with_one_encoder_the_estimate_is_as_with_two(tmp_path: Path) -> None:
    """Method efficiency has no other use for the link position."""
    one, two = torques(tmp_path, {"link_position": False}), torques(tmp_path, {})
    assert np.array_equal(one, two, equal_nan=True)
    assert np.isfinite(one).sum() > 2000


def test_a_derived_velocity_is_the_mean_since_the_last_position(tmp_path: Path) -> None:
    drive = OneDrive(config_with(tmp_path, [], objects={"motor_velocity": False}), SWING)
    assert [pdo.length for pdo in drive.intake.pdos[:2]] == [8, 4]
    first = drive.step(0)
    assert first.status == 4, "no velocity yet"
    assert first.input_flags & BOTH == cr.FLAG_POSITION
    position = [SWING["motor_position"](k) * SCALE["motor_rad_per_count"] for k in range(60)]
    last, steps = 0, set()
    for k in range(1, 60):
        record = drive.step(k, missing={6: 0, 30: 1}.get(k))
        if record.input_flags & BOTH == BOTH:
            steps.add(k - last)
            expected = (position[k] - position[last]) / (k - last) / 0.001
            assert record.motor_velocity_rad_s == pytest.approx(expected, rel=1e-12)
        else:
            assert record.status == 4
        if record.input_flags & cr.FLAG_POSITION:
            last = k
    assert len(steps) == 2, "over the gap of the position as well; a cycle without current is no gap"


def test_after_a_restart_of_the_drive_no_velocity_is_derived_from_before_it(tmp_path: Path) -> None:
    drive = OneDrive(config_with(tmp_path, [], objects={"motor_velocity": False}), SWING)
    for k in range(10):
        drive.step(k)
    drive.cycle.begin_again()
    assert drive.step(10).status == 4
    record = drive.step(11)
    assert (record.dt_s, record.input_flags & BOTH) == (0.0, BOTH), "the estimator starts with it"


def test_what_a_derived_velocity_costs(tmp_path: Path) -> None:
    """The same motion with the drive's velocity and without, 1e-4 rad per count, 1 kHz (`pytest -s` prints it)."""
    told, derived = torques(tmp_path, {}), torques(tmp_path, {"motor_velocity": False})
    both = np.isfinite(told) & np.isfinite(derived)
    apart = (told - derived)[both]
    rms, p99 = np.sqrt(np.mean(apart**2)) / RATED, np.quantile(np.abs(apart), 0.99) / RATED
    print(
        f"\nderived velocity: {both.sum()} estimates, RMS {rms:.2%}, 99 % within {p99:.2%} of the rated torque"
    )
    assert both.sum() > 2000
    assert rms < 0.02


@pytest.mark.parametrize(
    ("method", "objects", "said"),
    [
        (
            "fused",
            {"link_position": False},
            "key 'joint_1.objects.link_position': found false, expected a link position because estimator.method fused "
            "estimates from the torsion of the gear; tob and efficiency do without",
        ),
        (
            "network",
            {"link_position": False},
            "estimator.method network uses a network with the link position",
        ),
        ("efficiency", {"current": False}, "key 'joint_1.objects.current': found False, expected a"),
        (
            "efficiency",
            {"motor_position": {"by": "60A9h"}},
            "found '60A9h', expected one of 608Fh, 6092h, 60A8h",
        ),
        ("efficiency", {"current": {"by": "6076h", "factor": 1.0}}, "found both by and factor"),
        (
            "efficiency",
            {"motor_position": {"shaft": "motor"}},
            "shaft': expected only for the motor by 6092h",
        ),
        ("efficiency", {"statusword": {"by": "608Fh"}}, "expected an object of type U16, no sign, no factor"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path, method: str, objects: Any, said: str) -> None:
    content = shipped_bench("bench_paper.yaml")
    content["estimator"] = {"method": method}
    content["joint_1"]["objects"] = objects
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "c.yaml")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_cycles_and_their_stamps(tmp_path: Path) -> None:
    """A step within the stamps' accuracy is the period's: the derived velocity does not take their noise."""
    drive = OneDrive(config_with(tmp_path, [], objects={"motor_velocity": False}), SWING)
    drive.step(0)
    drive.intake.begin(2)
    frames = [struct.pack("<IB3x8s", 0x80, 0, bytes([2])), *drive.frames(1)]
    drive.intake.take(b"".join(frames), [2 * MS + 4000] * 3, [True, False, False], 3)
    drive.intake.close()
    drive.cycle.observe(2 * MS + 4000, False, True)
    record = cr.JointRecord._make(drive.cycle.sample)
    step = SWING["motor_position"](1) - SWING["motor_position"](0)
    assert record.motor_velocity_rad_s == pytest.approx(
        step * SCALE["motor_rad_per_count"] / 0.001, rel=1e-12
    )
