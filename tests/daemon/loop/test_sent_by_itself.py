"""TPDOs of transmission types 0, 254 and 255: fresh by their stamps, waited for by nobody, replayed as they were."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.core.input_pdos import InputPdo, input_pdos
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.replay.logged import _held
from jtqd.estimator.errors import ConfigError
from tests.daemon.loop.one_drive import config_with
from tests.daemon.snapshots import counted

MS = 1_000_000
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


TPDOS = [
    {"number": 1, "cob_id": 0x181, "objects": [0x60640020, 0x60E40120], "type": 255},
    {"number": 2, "cob_id": 0x281, "objects": [0x606C0020, 0x60780010, 0x60410010]},
]


def test_the_configuration_says_how_old(tmp_path: Path) -> None:
    config = config_with(tmp_path, TPDOS, max_age_ms=2.5)
    assert [pdo.age_ns for pdo in input_pdos(config)][:3] == [2_500_000, 0, 0]


@pytest.mark.parametrize(
    ("tpdos", "more", "said"),
    [
        (TPDOS, {}, "key 'joint_1.max_age_ms': missing, expected ms because TPDO1 has type 255"),
        ([{**TPDOS[0], "type": 3}, TPDOS[1]], {"max_age_ms": 2}, "found type 3, expected 1, 0, 254 or 255"),
        (TPDOS, {"max_age_ms": 0}, "joint_1.max_age_ms': found 0, expected a number in ms from 0.1 to 1000"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, tpdos: Any, more: Any, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config_with(tmp_path, tpdos, **more)
    assert said in str(caught.value)
