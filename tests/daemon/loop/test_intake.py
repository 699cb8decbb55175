"""Inputs of a cycle: what is used is of its own cycle, of a configured node, and of the right length."""

import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from jtqd.daemon.core.cycle import frame_counts
from jtqd.daemon.core.input_pdos import InputPdo
from jtqd.daemon.core.intake import Intake
from tests.daemon.snapshots import IntakeSeen, counted

PAIR = struct.Struct("<ii")
TPDO1 = InputPdo(0x181, 8, PAIR, 1, "181h drive 1 TPDO1")
TPDO2 = InputPdo(0x281, 8, struct.Struct("<ihH"), 1, "281h drive 1 TPDO2")
MS = 1_000_000


def frame(can_id: int, data: bytes = bytes(8), length: int | None = None) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data) if length is None else length, data)


class Bus:
    """Drives an intake cycle by cycle; delays are ns after the SYNC of the current cycle."""

    def __init__(self) -> None:
        self.intake = Intake([TPDO1, TPDO2])
        self.sync_ns = 0
        self.counter = 0

    def cycle(
        self,
        *arrivals: tuple[bytes, int],
        before: tuple[bytes, ...] = (),
        late: tuple[bytes, ...] = (),
        foreign_sync: bool = False,
        sync: bool = True,
    ) -> bool:
        """`before` arrives before the echo of SYNC, `late` after the deadline; without `sync` there is no echo."""
        self.sync_ns += MS
        intake = self.intake
        self.counter = self.counter % 240 + 1
        intake.begin(self.counter)
        echo = [(frame(0x080, bytes((self.counter,))), self.sync_ns, True)] if sync else []
        frames = [(data, self.sync_ns - 5_000, False) for data in before] + echo
        if foreign_sync:
            frames.append((frame(0x080), self.sync_ns + 1000, False))
        frames += [(data, self.sync_ns + delay, False) for data, delay in arrivals]
        intake.take(
            bytearray(b"".join(f[0] for f in frames)),
            [f[1] for f in frames],
            [f[2] for f in frames],
            len(frames),
        )
        complete = intake.close()
        if late:
            intake.drain(
                bytearray(b"".join(late)),
                [self.sync_ns + 950_000] * len(late),
                [False] * len(late),
                len(late),
            )
        return complete

    def settle(self, cycles: int = 50) -> None:
        for n in range(cycles):
            assert self.cycle((one(n), 200_000), (two(n), 300_000))


def one(value: int) -> bytes:
    return frame(0x181, PAIR.pack(value, -value))


def two(value: int) -> bytes:
    return frame(0x281, struct.pack("<ihH", value, 5, 0x27))


@pytest.fixture
def bus() -> Bus:
    result = Bus()
    result.settle()
    return result


def test_inputs_of_the_cycle(bus: Bus) -> None:
    assert bus.cycle((one(7), 200_000), (two(9), 300_000))
    assert bus.intake.values(0) == (7, -7)
    assert bus.intake.values(1) == (9, 5, 0x27)


def test_take_says_when_all_are_there() -> None:
    intake = Intake([TPDO1, TPDO2])
    intake.begin(1)
    assert not intake.take(bytearray(one(1)), [5], [False], 1)
    assert intake.take(bytearray(two(1)), [6], [False], 1)


def test_a_lost_frame_is_written_off_once_the_next_one_has_come_alone_and_as_usual(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000))
    assert not bus.intake.fresh(0)
    assert bus.intake.fresh(1)
    # This one could be the missing frame, late: it is not used, but as nothing else comes it settles the matter.
    assert not bus.cycle((one(2), 210_000), (two(2), 300_000))
    assert bus.cycle((one(3), 200_000), (two(3), 300_000))
    assert bus.intake.values(0) == (3, -3)
    assert frame_counts(bus.intake)["181h drive 1 TPDO1"]["lost"] == 1
    assert counted(bus.intake)["stale_inputs"] == 2
    assert not bus.intake.gap_wanted


def test_where_arrivals_are_irregular_a_slot_without_sync_settles_it() -> None:
    bus = Bus()
    for n in range(50):
        assert bus.cycle((one(n), 100_000 + 13_000 * n), (two(n), 300_000))  # a band of 0.6 ms tells nothing
    assert not bus.cycle((two(1), 300_000))
    assert not bus.cycle((one(2), 300_000), (two(2), 300_000))
    assert bus.intake.gap_wanted
    bus.intake.pass_slot()
    for n in range(5):
        assert not bus.cycle((one(n), 300_000), (two(n), 300_000)), "five regular cycles first"
    assert bus.cycle((one(5), 300_000), (two(5), 300_000))
    assert frame_counts(bus.intake)["181h drive 1 TPDO1"]["lost"] == 1
    assert counted(bus.intake)["sync_gaps"] == 1


def test_a_frame_after_the_deadline_is_late_and_never_used(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000), late=(one(1),))
    assert counted(bus.intake)["late_frames"] == 1
    assert bus.cycle((one(2), 200_000), (two(2), 300_000))
    assert bus.intake.values(0) == (2, -2)
    assert frame_counts(bus.intake)["181h drive 1 TPDO1"]["lost"] == 0


def test_a_frame_that_slips_into_the_next_cycle_spoils_that_one_and_pays(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000))
    # The frame of the cycle before arrives 20 us after SYNC, then this cycle's own: nobody can say which is which.
    assert not bus.cycle((one(1), 20_000), (one(2), 200_000), (two(2), 300_000))
    assert counted(bus.intake)["late_frames"] == 1
    assert bus.cycle((one(3), 200_000), (two(3), 300_000))
    assert bus.intake.values(0) == (3, -3)


@pytest.mark.parametrize("delay_us", [1_300, 1_500, 1_900])
@pytest.mark.parametrize("spread_us", [20, 500])
def test_a_constant_delay_of_more_than_a_cycle_never_becomes_valid(delay_us: int, spread_us: int) -> None:
    """Usually 0.2 ms (plus up to `spread_us`); then each frame of TPDO1 comes `delay_us` after its own SYNC, for good."""
    random_ = random.Random(delay_us + spread_us)
    line = Timeline(lambda n: (200 + random_.randrange(spread_us), 300) if n < 100 else (delay_us, 300))
    fresh = [line.slot() for _ in range(600)]
    assert all(fresh[10:100])
    assert not any(fresh[101:])
    assert line.wrong == 0


def test_a_frame_before_the_echo_of_sync_is_of_an_earlier_cycle(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000), before=(one(0),))
    assert not bus.intake.fresh(0)
    assert counted(bus.intake)["late_frames"] == 1


def test_a_frame_before_the_echo_does_not_spoil_the_one_after_it(bus: Bus) -> None:
    assert bus.cycle((one(1), 200_000), (two(1), 300_000), before=(one(0),))
    assert bus.intake.values(0) == (1, -1)


def test_without_the_echo_of_sync_nothing_is_used(bus: Bus) -> None:
    assert not bus.cycle((one(1), 200_000), (two(1), 300_000), sync=False)
    assert not bus.intake.fresh(0)
    assert not bus.intake.fresh(1)


def test_a_sync_that_waited_in_the_transmit_queue_is_not_this_cycles(bus: Bus) -> None:
    """The echo of SYNC k-1 and its answers come in cycle k: they would pass for those of k."""
    bus.cycle(sync=False)
    for _ in range(30):
        bus.sync_ns += MS
        bus.counter = bus.counter % 240 + 1
        bus.intake.begin(bus.counter % 240 + 1)
        batch = [frame(0x080, bytes((bus.counter,))), one(1), two(1)]
        bus.intake.take(
            bytearray(b"".join(batch)), [bus.sync_ns + n for n in range(3)], [True, False, False], 3
        )
        assert not bus.intake.close()
        assert not bus.intake.fresh(0)
    assert counted(bus.intake)["sync_errors"] == 30


def test_a_plain_sync_is_known_by_the_number_behind_its_end() -> None:
    """Length 0: nothing of it is on the wire; the kernel and the hub give back the very frame that was sent."""
    intake = Intake([TPDO1])
    for counter in range(1, 40):
        intake.begin(counter)
        earlier = frame(0x080, bytes([counter - 1 or 240]) + bytes(7), 0)
        own = frame(0x080, bytes([counter]) + bytes(7), 0)
        stamps = [counter * MS, counter * MS + 1]
        intake.take(bytearray(earlier + own), stamps, [True, True], 2)
        assert intake.sync_stamp_ns == counter * MS + 1
        intake.close()
    assert counted(intake)["sync_errors"] == 39


def test_of_an_echo_without_its_number_the_first_of_a_cycle_counts() -> None:
    """A driver that echoes no more than it has sent."""
    intake = Intake([TPDO1])
    for counter in range(1, 40):
        intake.begin(counter)
        echo = frame(0x080, bytes(8), 0)
        intake.take(bytearray(echo + one(counter)), [counter * MS, counter * MS + 9], [True, False], 2)
        intake.close()
        assert intake.fresh(0)
    assert counted(intake)["sync_errors"] == 0
    intake.begin(40)
    intake.take(bytearray(2 * frame(0x080, bytes(8), 0)), [40 * MS, 40 * MS + 1], [True, True], 2)
    assert counted(intake)["sync_errors"] == 1


def test_a_foreign_sync_just_before_ours_counts_as_well(bus: Bus) -> None:
    foreign = bytearray(frame(0x080))
    bus.intake.drain(foreign, [bus.sync_ns + 970_000], [False], 1)
    assert not bus.cycle((one(1), 200_000), (two(1), 300_000))
    assert bus.cycle((one(2), 200_000), (two(2), 300_000))


def test_equal_duplicates_are_harmless_and_counted(bus: Bus) -> None:
    assert bus.cycle((one(3), 200_000), (one(3), 220_000), (two(3), 300_000))
    assert counted(bus.intake)["duplicate_frames"] == 1
    assert bus.intake.values(0) == (3, -3)


def test_two_senders_of_one_pdo_are_a_conflict(bus: Bus) -> None:
    for _ in range(100):
        assert not bus.cycle((one(3), 200_000), (one(4), 220_000), (two(3), 300_000))
        assert not bus.intake.fresh(0)
        assert bus.intake.fresh(1)


@pytest.mark.parametrize("length", [0, 1, 4, 7])
def test_a_short_frame_is_rejected(bus: Bus, length: int) -> None:
    assert not bus.cycle((frame(0x181, bytes(8), length), 200_000), (two(1), 300_000))
    assert counted(bus.intake)["rejected_frames"] == 1


def test_a_length_beyond_eight_is_rejected(bus: Bus) -> None:
    assert not bus.cycle((frame(0x181, bytes(8), 200), 200_000), (two(1), 300_000))
    assert counted(bus.intake)["rejected_frames"] == 1


@pytest.mark.parametrize("flag", [0x8000_0000, 0x4000_0000, 0xC000_0000])
def test_29_bit_and_remote_frames_are_rejected_and_named(bus: Bus, flag: int) -> None:
    assert bus.cycle((one(5), 200_000), (frame(0x181 | flag), 250_000), (two(5), 300_000))
    assert bus.intake.values(0) == (5, -5)
    assert frame_counts(bus.intake)["181h drive 1 TPDO1"]["rejected"] == 1


def test_a_foreign_sync_makes_every_input_doubtful(bus: Bus) -> None:
    assert not bus.cycle((one(1), 200_000), (two(1), 300_000), foreign_sync=True)
    assert not bus.intake.fresh(0)
    assert not bus.intake.fresh(1)
    assert counted(bus.intake)["foreign_sync"] == 1
    assert bus.cycle((one(2), 200_000), (two(2), 300_000))


def test_a_node_that_booted_again_is_not_believed_until_configured(bus: Bus) -> None:
    assert not bus.cycle((frame(0x701, b"\x00"), 100_000), (one(1), 200_000), (two(1), 300_000))
    assert bus.intake.unconfigured == {1}
    for n in range(20):
        assert not bus.cycle((one(n), 200_000), (two(n), 300_000))
    bus.intake.configured(1)
    assert bus.cycle((one(9), 200_000), (two(9), 300_000))


@pytest.mark.parametrize("spread_us", [20, 500])
@pytest.mark.parametrize(("bad", "enough"), [(0.03, 1000), (0.10, 200)])
@pytest.mark.parametrize("seed", range(10))
def test_whatever_is_lost_or_late_what_is_used_is_of_its_own_cycle(
    seed: int, bad: float, enough: int, spread_us: int
) -> None:
    """Frames carry the number of their SYNC. Lost, late by up to three cycles, in bursts: what is fresh carries this one."""
    random_ = random.Random(seed)

    def delays(n: int) -> tuple[int | None, int | None]:
        result: list[int | None] = []
        for usual in (200, 300):
            kind = random_.random()
            if kind > bad:
                result.append(usual + random_.randrange(spread_us))
            elif kind < 0.4 * bad:
                result.append(None)
            else:
                # Not within the arrival band of a later cycle: that case is the limit stated in docs/safety.md.
                result.append(random_.choice([850, 1600, 2700]) + random_.randrange(100))
        return result[0], result[1]

    line = Timeline(delays)
    used = sum(line.slot() for _ in range(2000))
    assert line.wrong == 0, f"seed {seed}"
    assert used > enough, "and it still works"


@pytest.mark.parametrize("spread_us", [20, 500])
@pytest.mark.parametrize("seed", range(20))
def test_a_node_that_stalls_and_then_answers_every_sync_late(seed: int, spread_us: int) -> None:
    """Stalls of 0.5 to 30 ms; afterwards the queued SYNCs are answered one after the other. Old answers are never used."""
    random_ = random.Random(100 + seed)
    line = Timeline(lambda n: (200 + random_.randrange(spread_us), 300), service_us=120)
    used = 0
    for _ in range(4000):
        if random_.random() < 0.01:
            line.stall(random_.randrange(500, 30_000))
        used += line.slot()
    assert line.wrong == 0, f"seed {seed}"
    assert used > 400, "and it still works"


class Timeline:
    """A bus in time: answers of SYNC n come after `delays(n)` us (None: never); slots of 1 ms, deadline after 0.85 ms."""

    def __init__(self, delays: Callable[[int], tuple[int | None, int | None]], service_us: int = 50) -> None:
        self.service_us = service_us
        self.intake = Intake([TPDO1, TPDO2])
        self.delays = delays
        self.now_us = 1_000_000
        self.syncs = 0
        self.pending: list[tuple[int, bytes]] = []
        self.last = [0, 0]
        self.wrong = 0

    def _arrived(self, until_us: int) -> tuple[bytearray, list[int], list[bool], int]:
        come = sorted((item for item in self.pending if item[0] < until_us), key=lambda item: item[0])
        self.pending = [item for item in self.pending if item[0] >= until_us]
        return (
            bytearray(b"".join(d for _, d in come)),
            [t * 1000 for t, _ in come],
            [False] * len(come),
            len(come),
        )

    def stall(self, duration_us: int) -> None:
        """The node answers nothing for so long, then everything in order."""
        self.last = [max(last, self.now_us + duration_us) for last in self.last]

    def slot(self) -> bool:
        """One slot; True when all inputs of its cycle were used (False in a gap)."""
        intake, start = self.intake, self.now_us
        self.now_us += 1000
        intake.drain(*self._arrived(start))
        if intake.gap_wanted:
            intake.pass_slot()
            return False
        for n, (delay, make) in enumerate(zip(self.delays(self.syncs), (one, two), strict=True)):
            if delay is not None:
                self.last[n] = max(
                    start + delay, self.last[n] + 50
                )  # a controller keeps the order of its queue
                self.pending.append((self.last[n], make(self.syncs)))
        intake.begin(self.syncs % 240 + 1)
        intake.take(bytearray(frame(0x080, bytes((self.syncs % 240 + 1,)))), [start * 1000], [True], 1)
        intake.take(*self._arrived(start + 850))
        complete = intake.close()
        self.wrong += sum(intake.fresh(n) and intake.values(n)[0] != self.syncs for n in (0, 1))
        self.syncs += 1
        return complete


DRIVE_1 = InputPdo(0x181, 8, PAIR, 1, "181h drive 1 TPDO1")
DRIVE_2 = InputPdo(0x182, 8, PAIR, 2, "182h drive 2 TPDO1")
SENSOR = InputPdo(0x183, 5, struct.Struct("<iB"), 3, "183h sensor 3 channel 1")


class Nodes:
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
def nodes(tmp_path: Path) -> Nodes:
    return Nodes(tmp_path)


def test_an_absent_optional_node_is_not_waited_for_and_not_missed(nodes: Nodes) -> None:
    nodes.intake.leave_out(3)
    for _ in range(50):
        assert nodes.cycle(*DRIVES) == (True, True)
    assert counted(nodes.intake)["stale_inputs"] == 0
    assert nodes.intake.unconfigured == {3}
    assert not nodes.intake.fresh(2)
    assert nodes.seen.view().inputs[2].in_a_row == 50, "but known to be missing"


def test_its_frames_before_its_configuration_are_not_used_and_leave_no_debt(nodes: Nodes) -> None:
    nodes.intake.leave_out(3)
    for _ in range(5):
        nodes.cycle(*DRIVES, frame(0x183, length=5))
        assert not nodes.intake.fresh(2)
    nodes.intake.configured(3)
    assert nodes.cycle(*DRIVES) == (False, False), "now it is waited for"
    nodes.intake.configured(3)
    assert nodes.cycle(*DRIVES, frame(0x183, length=5)) == (True, True)
    assert nodes.intake.fresh(2)
    assert counted(nodes.intake)["stale_inputs"] == 1


def test_a_node_that_restarts_is_missed_but_nobody_waits_for_it(nodes: Nodes) -> None:
    everything = (*DRIVES, frame(0x183, length=5))
    assert nodes.cycle(*everything) == (True, True)
    nodes.cycle(*everything, frame(0x701, bytes(1)))  # boot-up message of drive 1
    assert nodes.intake.unconfigured == {1}
    assert nodes.cycle(frame(0x182), frame(0x183, length=5)) == (True, False)
    assert (nodes.intake.fresh(0), nodes.intake.fresh(1)) == (False, True)
    assert nodes.cycle(*everything) == (True, False), "its default mapping may have the same length"
    assert not nodes.intake.fresh(0)
    nodes.intake.configured(1)
    assert nodes.cycle(*everything) == (True, True)


def test_lengths_and_cycles_without_an_input_are_counted_per_pdo(nodes: Nodes) -> None:
    nodes.cycle(*DRIVES, frame(0x183, length=5))
    for length in (0, 1, 7):
        nodes.cycle(frame(0x181, length=length), frame(0x182), frame(0x183, length=8))
    one, two, sensor = nodes.seen.view().inputs
    assert (one.short, one.long, one.missed, one.in_a_row) == (3, 0, 3, 3)
    assert (two.short, two.long, two.missed) == (0, 0, 0)
    assert (sensor.short, sensor.long, sensor.rejected) == (0, 3, 3)
    assert counted(nodes.intake)["rejected_frames"] == 6
    for _ in range(30):
        nodes.cycle(*DRIVES, frame(0x183, length=5))
    one = nodes.seen.view().inputs[0]
    assert one.in_a_row == 0
    assert one.missed >= 3


@pytest.mark.parametrize("state", [1, 2, 3, 6, 0x80, 0x85, 0xFF])
def test_a_heartbeat_with_an_impossible_state_is_none(nodes: Nodes, state: int) -> None:
    nodes.cycle(*DRIVES, frame(0x183, length=5), frame(0x701, b"\x05"))
    nodes.cycle(*DRIVES, frame(0x183, length=5), frame(0x701, bytes([state])))
    assert nodes.seen.view().node_states[1] == 5
    assert counted(nodes.intake)["rejected_frames"] == 1
    assert nodes.intake.unconfigured == frozenset()
