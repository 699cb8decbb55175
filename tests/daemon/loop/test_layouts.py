"""The same quantities in other TPDOs: the estimates are the same bit for bit, and flags, replay and names follow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.config import Config, as_booted
from jtqd.daemon.core.input_pdos import (
    JointInputs,
    drive_places,
    input_pdos,
    names_of_inputs,
    sensor_index,
)
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.shared import cycle_record as cr
from jtqd.drivers.drive import tpdos_as_json
from jtqd.estimator.errors import ConfigError
from tests.daemon.loop.cycle_helpers import SCALE
from tests.daemon.loop.one_drive import MS, NUMBER_OF, OneDrive, config_with

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
    ("tpdos", "more", "said"),
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
        (
            [{**SCATTERED[0], "number": 5}],
            {},
            "number': found 5, expected a whole number from 1 to 4",
        ),
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
    tmp_path: Path, tpdos: Any, more: Any, said: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        config_with(tmp_path, tpdos, **more)
    assert said in str(caught.value)
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
        withdrawn=np.zeros(count, np.uint8),
        velocity=[np.array([each.motor_velocity_rad_s for each in records])],
    )
    rows.go_on(0, count)
    assert rows.samples[0].tobytes() == b"".join(cr.JOINT.pack(*each) for each in records)
    assert 3 <= np.isnan([each.dt_s for each in records]).sum() < 40
