"""Nodes that are absent or not configured cost the others nothing; deadlines and lengths are counted per PDO."""

import struct
from pathlib import Path

import pytest

from jtqd.daemon.core.input_pdos import InputPdo
from jtqd.daemon.core.intake import Intake
from tests.daemon.snapshots import IntakeSeen, counted

PAIR = struct.Struct("<ii")
DRIVE_1 = InputPdo(0x181, 8, PAIR, 1, "181h drive 1 TPDO1")
DRIVE_2 = InputPdo(0x182, 8, PAIR, 2, "182h drive 2 TPDO1")
SENSOR = InputPdo(0x183, 5, struct.Struct("<iB"), 3, "183h sensor 3 channel 1")


def frame(can_id: int, length: int = 8, data: bytes = bytes(8)) -> bytes:
    return struct.pack("<IB3x8s", can_id, length, data)


class Bus:
    """One cycle after the other, each with the frames that answer its SYNC."""

    def __init__(self, directory: Path) -> None:
        self.intake = Intake([DRIVE_1, DRIVE_2, SENSOR])
        self.seen = IntakeSeen(directory, self.intake)
        self.sync_ns, self.counter = 0, 0

    def cycle(self, *frames: bytes) -> tuple[bool, bool]:
        """(nobody is waited for any more, every input is valid)."""
        self.sync_ns += 1_000_000
        self.counter = self.counter % 240 + 1
        batch = [struct.pack("<IB3xB7x", 0x080, 1, self.counter), *frames]
        stamps = [self.sync_ns + 100_000 * n for n in range(len(batch))]
        self.intake.begin(self.counter)
        done = self.intake.take(
            bytearray(b"".join(batch)), stamps, [True] + [False] * len(frames), len(batch)
        )
        return done, self.intake.close()


DRIVES = (frame(0x181), frame(0x182))


@pytest.fixture
def bus(tmp_path: Path) -> Bus:
    return Bus(tmp_path)


def test_an_absent_optional_node_is_not_waited_for_and_not_missed(bus: Bus) -> None:
    bus.intake.leave_out(3)
    for _ in range(50):
        assert bus.cycle(*DRIVES) == (True, True)
    assert counted(bus.intake)["stale_inputs"] == 0
    assert bus.intake.unconfigured == {3}
    assert not bus.intake.fresh(2)
    assert bus.seen.view().inputs[2].in_a_row == 50, "but known to be missing"


def test_its_frames_before_its_configuration_are_not_used_and_leave_no_debt(bus: Bus) -> None:
    bus.intake.leave_out(3)
    for _ in range(5):
        bus.cycle(*DRIVES, frame(0x183, 5))
        assert not bus.intake.fresh(2)
    bus.intake.configured(3)
    assert bus.cycle(*DRIVES) == (False, False), "now it is waited for"
    bus.intake.configured(3)
    assert bus.cycle(*DRIVES, frame(0x183, 5)) == (True, True)
    assert bus.intake.fresh(2)
    assert counted(bus.intake)["stale_inputs"] == 1


def test_a_node_that_restarts_is_missed_but_nobody_waits_for_it(bus: Bus) -> None:
    everything = (*DRIVES, frame(0x183, 5))
    assert bus.cycle(*everything) == (True, True)
    bus.cycle(*everything, frame(0x701, 1))  # boot-up message of drive 1
    assert bus.intake.unconfigured == {1}
    assert bus.cycle(frame(0x182), frame(0x183, 5)) == (True, False)
    assert (bus.intake.fresh(0), bus.intake.fresh(1)) == (False, True)
    assert bus.cycle(*everything) == (True, False), "its default mapping may have the same length"
    assert not bus.intake.fresh(0)
    bus.intake.configured(1)
    assert bus.cycle(*everything) == (True, True)


def test_lengths_and_cycles_without_an_input_are_counted_per_pdo(bus: Bus) -> None:
    bus.cycle(*DRIVES, frame(0x183, 5))
    for length in (0, 1, 7):
        bus.cycle(frame(0x181, length), frame(0x182), frame(0x183, 8))
    one, two, sensor = bus.seen.view().inputs
    assert (one.short, one.long, one.missed, one.in_a_row) == (3, 0, 3, 3)
    assert (two.short, two.long, two.missed) == (0, 0, 0)
    assert (sensor.short, sensor.long, sensor.rejected) == (0, 3, 3)
    assert counted(bus.intake)["rejected_frames"] == 6
    for _ in range(30):
        bus.cycle(*DRIVES, frame(0x183, 5))
    one = bus.seen.view().inputs[0]
    assert one.in_a_row == 0
    assert one.missed >= 3


@pytest.mark.parametrize("state", [1, 2, 3, 6, 0x80, 0x85, 0xFF])
def test_a_heartbeat_with_an_impossible_state_is_none(bus: Bus, state: int) -> None:
    bus.cycle(*DRIVES, frame(0x183, 5), frame(0x701, 1, b"\x05"))
    bus.cycle(*DRIVES, frame(0x183, 5), frame(0x701, 1, bytes([state])))
    assert bus.seen.view().node_states[1] == 5
    assert counted(bus.intake)["rejected_frames"] == 1
    assert bus.intake.unconfigured == frozenset()
