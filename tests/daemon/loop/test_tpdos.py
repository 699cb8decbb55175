"""Other TPDOs and fewer: numbers in other places, no link position, no velocity, frames that a drive sends by itself."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.daemon.config import Config, as_booted, load_config
from jtqd.daemon.core.input_pdos import (
    InputPdo,
    JointInputs,
    drive_places,
    input_pdos,
    names_of_inputs,
    sensor_index,
)
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.replay.logged import _held
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.shared import cycle_record as cr
from jtqd.drivers.drive import tpdos_as_json
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import SCALE
from tests.daemon.loop.one_drive import MS, NUMBER_OF, OneDrive, config_with
from tests.daemon.snapshots import counted
from tests.shipped_bench import shipped_bench

SCATTERED = [
    {"number": 1, "cob_id": 0x381, "objects": [0x60410010, 0x60640020]},
    {"number": 2, "cob_id": 0x281, "objects": [0x60610008, 0x606C0020, 0x60780010]},
    {"number": 4, "cob_id": 0x481, "objects": [0x60E40120, 0x10010008]},
]
ONE_AND_ONE = [
    {"number": 3, "cob_id": 0x181, "objects": [0x60E40120, 0x606C0020]},
    {"number": 1, "cob_id": 0x281, "objects": [0x60780010, 0x60410010, 0x60640020]},
]


def run(config: Config, count: int = 400) -> bytes:
    drive = OneDrive(config)
    return b"".join(cr.JOINT.pack(*drive.step(k)) for k in range(count))


@pytest.mark.parametrize("tpdos", [SCATTERED, ONE_AND_ONE])
def test_estimates_are_the_same_bit_for_bit_wherever_the_numbers_lie(tmp_path: Path, tpdos: Any) -> None:
    usual = run(config_with(tmp_path, []))
    assert run(config_with(tmp_path, tpdos)) == usual
    torque = [cr.JointRecord(*each).torque_nm for each in cr.JOINT.iter_unpack(usual)]
    assert np.isfinite(torque).sum() > 300


@pytest.mark.parametrize(
    ("tpdos", "flags"),
    [
        # a kind counts as there when all PDOs with one of its quantities are
        (SCATTERED, [0, cr.FLAG_POSITION, cr.FLAG_MOTION]),
        (ONE_AND_ONE, [0, 0]),
        ([], [cr.FLAG_MOTION, cr.FLAG_POSITION]),
    ],
)
def test_any_pdo_that_is_missing_makes_the_joint_stale(tmp_path: Path, tpdos: Any, flags: list[int]) -> None:
    both = cr.FLAG_POSITION | cr.FLAG_MOTION
    for missing, expected in enumerate(flags):
        drive = OneDrive(config_with(tmp_path, tpdos))
        for k in range(20):
            assert drive.step(k).input_flags & both == both
        record = drive.step(20, missing)
        assert record.input_flags & both == expected
        assert record.status == 4
        assert np.isnan(record.torque_nm)


def test_the_layout_of_the_drives_takes_the_place_of_the_wanted_one(tmp_path: Path) -> None:
    """As the boot reports it, and as a log's provenance has it."""
    wanted, found = config_with(tmp_path, []), config_with(tmp_path, SCATTERED)
    report = {"1": {"tpdos": tpdos_as_json(found.joints[0].tpdos)}}
    booted = as_booted(wanted, report)
    assert booted.joints[0].tpdos == found.joints[0].tpdos
    assert booted.joints[1] == wanted.joints[1], "absent: as it is wanted"
    assert [pdo.name for pdo in input_pdos(booted)][:4] == [
        "381h drive 1 TPDO1",
        "281h drive 1 TPDO2",
        "481h drive 1 TPDO4",
        "182h drive 2 TPDO1",
    ]
    assert sensor_index(booted, 1) == 5
    assert names_of_inputs(booted, 0) == (
        "381h drive 1 TPDO1 and 481h drive 1 TPDO4",
        "381h drive 1 TPDO1 and 281h drive 1 TPDO2",
    )
    assert as_booted(wanted, {"1": {"tpdos": tpdos_as_json(wanted.joints[0].tpdos)}}) == wanted


@pytest.mark.parametrize(
    ("tpdos", "more", "reported"),
    [
        (
            SCATTERED[:2],
            {},
            "joint_1.tpdos': no TPDO carries 60E4h:1 (link position); TPDO1 carries 0x60410010",
        ),
        (
            [{**SCATTERED[0], "cob_id": 0x391}],
            {},
            "TPDO1 has COB-ID 391h, expected one of 181h, 281h, 381h, 481h",
        ),
        ([{**SCATTERED[0], "number": 5}], {}, "number': found 5, expected a whole number from 1 to 4"),
        ([*SCATTERED[:2], {**SCATTERED[2], "number": 2}], {}, "found number 1, 2, 2, expected each once"),
        (
            [*SCATTERED[:2], {**SCATTERED[2], "cob_id": 0x281}],
            {},
            "found cob_id 381h, 281h, 281h, expected each once",
        ),
        (
            SCATTERED,
            {"temperature": True},
            "found cob_id 381h, 281h, 481h, expected each once, TPDO3 is that of",
        ),
        ([{**SCATTERED[0], "objects": [0x60640010]}], {}, "6064h:0 is mapped with 16 bits, expected 32"),
        (
            [{**SCATTERED[0], "objects": [0x60640020, 0x60E40120, 0x60410010]}],
            {},
            "10 bytes mapped, a frame holds 8",
        ),
        (
            [{**SCATTERED[0], "objects": [0x60640020, 0x00050008]}],
            {},
            "0005h:0: no such object can be mapped",
        ),
    ],
)
def test_a_layout_that_cannot_be_is_refused_in_one_line(
    tmp_path: Path, tpdos: Any, more: Any, reported: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        config_with(tmp_path, tpdos, **more)
    assert reported in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("less", [{}, {"link_position": False, "motor_velocity": False}])
def test_a_replay_of_rows_reads_the_same_places(tmp_path: Path, less: Any) -> None:
    """What a replay puts into the intake's fields is what the loop has read from the frames.

    A log's steps tell no time of cycles that a joint has missed: a derived velocity is taken as it was logged.
    """
    config = config_with(tmp_path, [] if less else SCATTERED, objects=less)
    live, again = OneDrive(config), OneDrive(config)
    count = 120
    records = [live.step(k, missing={40: 0, 80: 1}.get(k)) for k in range(count)]
    both = cr.FLAG_POSITION | cr.FLAG_MOTION
    flags = np.array([each.input_flags for each in records])
    groups = JointInputs(drive_places(0, config.joints[0].tpdos, config.joints[0].objects), None, **SCALE)
    fresh = [
        (flags & sum(f for f, pdos in ((1, groups.positions), (2, groups.motion)) if n in pdos)) != 0
        for n in range(len(config.joints[0].tpdos))
    ]
    values = [
        np.array([[NUMBER_OF[name](k) if name else 0x55 for k in range(count)] for name in pdo.names])
        for pdo in config.joints[0].tpdos
    ]
    rest = len(input_pdos(config)) - len(values)
    dt_s = np.array([each.dt_s if each.input_flags & both == both else 0.0 for each in records])
    rows = CycleRows(
        again.intake,
        [again.cycle],
        fresh=np.array([*fresh, *[np.zeros(count, np.bool_)] * rest]).astype(np.uint8),
        values=[*values, *[np.zeros((2, count), np.int64)] * rest],
        celsius=np.zeros((0, count)),
        cycle=np.arange(1000, 1000 + count),
        counter=np.arange(count) % 240 + 1,
        sync_ns=(MS + np.cumsum(np.rint(dt_s * 1e9)).astype(np.int64))[None],
        wanted=np.ones((1, count), np.uint8),
        flags=np.zeros((1, count), np.uint8),
        velocity=[np.array([each.motor_velocity_rad_s for each in records])],
    )
    rows.go_on(0, count)
    assert rows.samples[0].tobytes() == b"".join(cr.JOINT.pack(*each) for each in records)
    assert 3 <= np.isnan([each.dt_s for each in records]).sum() < 40


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
    usual, derived = torques(tmp_path, {}), torques(tmp_path, {"motor_velocity": False})
    both = np.isfinite(usual) & np.isfinite(derived)
    apart = (usual - derived)[both]
    rms, p99 = np.sqrt(np.mean(apart**2)) / RATED, np.quantile(np.abs(apart), 0.99) / RATED
    print(
        f"\nderived velocity: {both.sum()} estimates, RMS {rms:.2%}, 99 % within {p99:.2%} of the rated torque"
    )
    assert both.sum() > 2000
    assert rms < 0.02


@pytest.mark.parametrize(
    ("method", "objects", "reported"),
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
def test_what_cannot_be_is_refused_in_one_line(
    tmp_path: Path, method: str, objects: Any, reported: str
) -> None:
    content = shipped_bench("bench_paper.yaml")
    content["estimator"] = {"method": method}
    content["joint_1"]["objects"] = objects
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "c.yaml")
    assert reported in str(caught.value)
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


I32 = struct.Struct("<ii")
AGE = 5 * MS
EVENT = InputPdo(0x181, 8, I32, 1, "181h", AGE)
SYNCED = InputPdo(0x281, 8, I32, 1, "281h")


def frame(cob_id: int, *values: int) -> bytes:
    return struct.pack("<IB3x8s", cob_id, 8, I32.pack(*values))


def sync(k: int) -> bytes:
    return struct.pack("<IB3x8s", 0x80, 0, bytes([k % 240 + 1]))


def cycle(intake: Intake, k: int, frames: list[tuple[bytes, int]], *, own: bool = True) -> bool:
    """Cycle k, whose SYNC is at k ms, with these frames and their stamps; returns whether nothing was missing."""
    intake.begin(k % 240 + 1)
    every = [(sync(k), k * MS), *frames] if own else frames
    marks = [own and n == 0 for n in range(len(every))]
    complete = intake.take(
        b"".join(data for data, _ in every), [stamp for _, stamp in every], marks, len(every)
    )
    intake.close()
    return complete


def test_a_frame_counts_until_it_is_too_old() -> None:
    intake = Intake([EVENT])
    cycle(intake, 10, [(frame(0x181, 1, 2), 10 * MS + 300_000)])
    assert intake.fresh(0)
    assert intake.values(0) == (1, 2)
    for k in range(11, 16):
        cycle(intake, k, [])
        assert intake.fresh(0), "10.3 ms is at most 5 ms before"
        assert intake.values(0) == (1, 2)
    cycle(intake, 16, [])
    assert not intake.fresh(0)
    assert counted(intake)["stale_inputs"] == 1
    cycle(intake, 17, [(frame(0x181, 3, 4), 16 * MS + 900_000)])
    assert intake.values(0) == (3, 4), "also one that came before this SYNC"
    assert intake.fresh(0)
    assert counted(intake)["late_frames"] == counted(intake)["duplicate_frames"] == 0


@pytest.mark.parametrize(
    ("age_ns", "fresh"), [(AGE, True), (AGE + 1, False), (-AGE, True), (-AGE - 1, False)]
)
def test_the_limit_is_exact_and_on_both_sides(age_ns: int, fresh: bool) -> None:
    """A stamp far behind the SYNC is that of a clock that was set back."""
    intake = Intake([EVENT])
    cycle(intake, 100, [(frame(0x181, 1, 2), 100 * MS - age_ns)])
    assert intake.fresh(0) == fresh


def test_nobody_waits_for_it_and_the_others_keep_their_rules() -> None:
    intake = Intake([EVENT, SYNCED])
    for k in range(1, 30):
        assert cycle(intake, k, [(frame(0x281, k, 6), k * MS + 100)]), (
            "the other one is all that is waited for"
        )
        assert intake.fresh(1)
        assert not intake.fresh(0)
    assert not cycle(intake, 30, [(frame(0x181, 1, 2), 30 * MS + 100)])
    assert intake.fresh(0)
    assert not intake.fresh(1)
    assert not cycle(intake, 31, [(frame(0x281, 31, 6), 31 * MS + 100)]), "it may be the missing one"


def test_several_in_one_cycle_are_no_conflict_and_the_last_counts() -> None:
    intake = Intake([EVENT])
    cycle(intake, 1, [(frame(0x181, n, n), MS + n) for n in range(4)])
    assert intake.values(0) == (3, 3)
    assert counted(intake)["duplicate_frames"] == 0
    data, stamp = frame(0x181, 9, 9), 2 * MS - 1000
    intake.drain(data, [stamp], [False], 1)
    cycle(intake, 2, [])
    assert intake.values(0) == (9, 9), "one between the cycles"


def test_not_of_a_node_that_has_restarted_until_it_is_configured_and_has_sent_again() -> None:
    intake = Intake([EVENT])
    cycle(intake, 1, [(frame(0x181, 1, 1), MS + 1)])
    boot_up = struct.pack("<IB3x8s", 0x701, 1, bytes(8))
    cycle(intake, 2, [(boot_up, 2 * MS + 1)])
    assert not intake.fresh(0)
    intake.configured(1)
    cycle(intake, 3, [])
    assert not intake.fresh(0), "what it sent before means nothing"
    cycle(intake, 4, [(frame(0x181, 2, 2), 4 * MS + 1)])
    assert intake.fresh(0)


def test_not_without_the_echo_of_the_sync_and_not_beside_a_foreign_one() -> None:
    intake = Intake([EVENT])
    cycle(intake, 1, [(frame(0x181, 1, 1), MS + 1)], own=False)
    assert not intake.fresh(0)
    cycle(intake, 2, [(frame(0x181, 1, 1), 2 * MS + 1), (sync(7), 2 * MS + 2)])
    assert not intake.fresh(0)


def test_a_replay_holds_the_last_frame_and_does_not_guess_one_that_is_not_in_the_log() -> None:
    there = np.array([0, 1, 0, 0, 1, 0, 0, 1], np.bool_)
    left_out = np.array([0, 0, 0, 0, 0, 1, 0, 0], np.bool_)
    data = np.arange(8, dtype=np.uint8)[:, None] * np.ones((1, 8), np.uint8)
    known, held = _held(there, left_out, data)
    assert known.tolist() == [False, True, True, True, True, False, False, True]
    assert held[known, 0].tolist() == [1, 1, 1, 4, 7]


ACYCLIC = [
    {"number": 1, "cob_id": 0x181, "objects": [0x60640020, 0x60E40120], "type": 255},
    {"number": 2, "cob_id": 0x281, "objects": [0x606C0020, 0x60780010, 0x60410010]},
]


def test_the_configuration_says_how_old(tmp_path: Path) -> None:
    config = config_with(tmp_path, ACYCLIC, max_age_ms=2.5)
    assert [pdo.age_ns for pdo in input_pdos(config)][:3] == [2_500_000, 0, 0]


@pytest.mark.parametrize(
    ("tpdos", "more", "reported"),
    [
        (ACYCLIC, {}, "key 'joint_1.max_age_ms': missing, expected ms because TPDO1 has type 255"),
        (
            [{**ACYCLIC[0], "type": 3}, ACYCLIC[1]],
            {"max_age_ms": 2},
            "found type 3, expected 1, 0, 254 or 255",
        ),
        (
            ACYCLIC,
            {"max_age_ms": 0},
            "joint_1.max_age_ms': found 0, expected a number in ms from 0.1 to 1000",
        ),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, tpdos: Any, more: Any, reported: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config_with(tmp_path, tpdos, **more)
    assert reported in str(caught.value)
