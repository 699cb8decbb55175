"""Corners of a replay: one lost cycle, frames without room, cycles told differently, two files for a joint."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import LogError
from jtqd.daemon.replay.command import main
from jtqd.daemon.replay.replayer import decode
from jtqd.daemon.replay.runs import (
    LOST,
    lost_cycles,
    read_part,
    read_pieces,
    steps_of,
)
from jtqd.daemon.replay.session import ReplayOptions, replay
from jtqd.models.files import shipped
from tests.daemon.replay.replay_helpers import cut, cycles
from tests.daemon.replay.test_replay_parts import CONFIG, MS, records
from tests.paths import GOLDEN

LOG = GOLDEN / "network.mcap"


def test_one_lost_cycle_is_seen() -> None:
    log = records([*range(40), *range(41, 100)])
    assert steps_of(log, CONFIG).breaks == ((40, LOST),)
    assert steps_of(log, CONFIG).dt_ns[40] == 2 * MS
    assert lost_cycles(log, CONFIG) == 1


def test_holes_longer_than_a_round_of_the_sync_counter_are_counted_in_full() -> None:
    log = records([*range(40), *range(25_998, 26_100)])
    assert lost_cycles(log, CONFIG) == 25_958
    slots = records([*range(40), *range(1000, 1100)])  # 300 of them passed without SYNC: the loop stood still
    slots["dt_s"][40] = 0.301
    slots["sync_counter"][40:] = (slots["sync_counter"][40:].astype(int) - 1 - 300) % 240 + 1
    assert lost_cycles(slots, CONFIG) == 660
    stood = records([*range(40), *range(1000, 1100)])
    stood["dt_s"][40], stood["sync_counter"] = 0.961, np.arange(140) % 240 + 1
    assert lost_cycles(stood, CONFIG) == 0


def test_of_a_record_without_room_for_all_frames_the_si_values_count(tmp_path: Path) -> None:
    """The last frame in the record may be an older one: what the log says beside it is what was used."""
    part = read_part(LOG, tmp_path)
    frames = part.frames()
    before = decode(part.setup, frames, part.joints)
    assert before.from_si == 0
    rows = [300, 301, 700]
    frames["frames_left_out"][rows] = 1
    frames["frames"]["data"][rows] ^= 0x55
    after = decode(part.setup, frames, part.joints)
    assert after.from_si == sum(int(pdo.fresh[rows].sum()) for pdo in before.pdos) > 0
    for one, two in zip(before.pdos, after.pdos, strict=True):
        for old, new in zip(one.values, two.values, strict=True):
            assert (old == new)[one.fresh].all()
    frames["frames_left_out"][rows] = 0
    spoilt = decode(part.setup, frames, part.joints)
    assert spoilt.from_si == 0
    assert any(
        (old != new)[rows].any()
        for one, two in zip(before.pdos, spoilt.pdos, strict=True)
        for old, new in zip(one.values, two.values, strict=True)
    )


def test_logs_that_tell_a_cycle_differently_are_refused(tmp_path: Path) -> None:
    """Cycles that two parts have, after a crash of the recorder, are the same in both; else it is not one run."""
    numbers = cycles(LOG)
    first = cut(LOG, tmp_path / "1.mcap", lambda cycle: cycle < numbers[700])
    second = cut(LOG, tmp_path / "2.mcap", lambda cycle: cycle >= numbers[650])
    (result,) = replay([first, second], ReplayOptions())
    assert result.run.cycles == len(numbers)
    assert result.identity is not None
    assert result.identity.explained

    def payload(topic: str, cycle: int, data: bytes) -> bytes:
        spoilt = topic == "/joint/2/state" and cycle == numbers[660]
        return data[:92] + bytes((data[92] ^ 1,)) + data[93:] if spoilt else data

    other = cut(LOG, tmp_path / "3.mcap", lambda cycle: cycle >= numbers[650], payload=payload)
    with pytest.raises(LogError, match=f"found cycle {numbers[650]}, which .*1.mcap has too"):
        replay([first, other], ReplayOptions())


def test_a_place_that_cannot_be_written_is_said_before_the_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["absent.mcap", "--out", str(tmp_path / "none" / "a.mcap")]) == 1
    assert "none: found no such directory" in capsys.readouterr().err


def test_two_files_for_one_joint_are_one_too_many(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("joint1.yaml", "extended.joint1.yaml"):
        shutil.copy(shipped("joint1.yaml"), tmp_path / name)
    assert main([str(LOG), "--model", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert (
        said == f"jtq replay: {tmp_path}: found joint1.yaml and extended.joint1.yaml, expected one of them\n"
    )


def test_a_log_without_joints_is_refused_however_long_it_is(tmp_path: Path) -> None:

    bare = cut(LOG, tmp_path / "a.mcap", lambda cycle: False)
    (tmp_path / "x").mkdir()
    with pytest.raises(LogError, match="found no message on /joint/1/state"):
        list(read_pieces(bare, tmp_path / "x", limit=-1))
