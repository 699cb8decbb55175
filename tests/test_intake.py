"""Which frame belongs to which cycle: each scenario states what is sent and what must be believed."""

import struct

import pytest

from daemon.intake import InputPdo, Intake

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

    def cycle(
        self, *arrivals: tuple[bytes, int], late: tuple[bytes, ...] = (), foreign_sync: bool = False
    ) -> bool:
        self.sync_ns += MS
        intake = self.intake
        intake.begin()
        frames = [(frame(0x080, b"\x01"), self.sync_ns, True)]
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
    intake.begin()
    assert not intake.take(bytearray(one(1)), [5], [False], 1)
    assert intake.take(bytearray(two(1)), [6], [False], 1)


def test_a_lost_frame_makes_one_cycle_stale_and_is_counted_lost(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000))
    assert not bus.intake.fresh(0)
    assert bus.intake.fresh(1)
    assert bus.cycle((one(2), 210_000), (two(2), 300_000))
    assert bus.intake.counters()["181h drive 1 TPDO1"]["lost"] == 1
    assert bus.intake.stale_inputs == 1


def test_a_frame_after_the_deadline_is_late_and_never_used(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000), late=(one(1),))
    assert bus.intake.late_frames == 1
    assert bus.cycle((one(2), 200_000), (two(2), 300_000))
    assert bus.intake.values(0) == (2, -2)
    assert bus.intake.counters()["181h drive 1 TPDO1"]["lost"] == 0


def test_a_frame_that_slips_into_the_next_cycle_is_not_that_cycles_own(bus: Bus) -> None:
    assert not bus.cycle((two(1), 300_000))
    # The frame of the cycle before arrives 20 us after SYNC, then this cycle's own: the later one counts.
    assert bus.cycle((one(1), 20_000), (one(2), 200_000), (two(2), 300_000))
    assert bus.intake.values(0) == (2, -2)
    assert bus.intake.late_frames == 1


@pytest.mark.parametrize("delay_us", [1_300, 1_500, 1_900])
def test_a_constant_delay_of_more_than_a_cycle_never_becomes_valid(bus: Bus, delay_us: int) -> None:
    # Usual delay 200 us. From now on each frame comes `delay_us` after its own SYNC: one frame per cycle, always old.
    assert not bus.cycle((two(0), 300_000))
    for n in range(1, 200):
        assert not bus.cycle((one(n - 1), (delay_us - 1000) * 1000), (two(n), 300_000))
        assert not bus.intake.fresh(0)


def test_a_frame_stamped_before_the_sync_is_of_an_earlier_cycle(bus: Bus) -> None:
    assert not bus.cycle((one(1), -10_000), (two(1), 300_000))
    assert bus.intake.late_frames == 1


def test_equal_duplicates_are_harmless_and_counted(bus: Bus) -> None:
    assert bus.cycle((one(3), 200_000), (one(3), 220_000), (two(3), 300_000))
    assert bus.intake.duplicate_frames == 1
    assert bus.intake.values(0) == (3, -3)


def test_two_senders_of_one_pdo_are_a_conflict(bus: Bus) -> None:
    assert not bus.cycle((one(3), 200_000), (one(4), 220_000), (two(3), 300_000))
    assert not bus.intake.fresh(0)
    assert bus.intake.fresh(1)


@pytest.mark.parametrize("length", [0, 1, 4, 7])
def test_a_short_frame_is_rejected(bus: Bus, length: int) -> None:
    assert not bus.cycle((frame(0x181, bytes(8), length), 200_000), (two(1), 300_000))
    assert bus.intake.rejected_frames == 1


def test_a_length_beyond_eight_is_rejected(bus: Bus) -> None:
    assert not bus.cycle((frame(0x181, bytes(8), 200), 200_000), (two(1), 300_000))
    assert bus.intake.rejected_frames == 1


@pytest.mark.parametrize("flag", [0x8000_0000, 0x4000_0000, 0xC000_0000])
def test_29_bit_and_remote_frames_are_rejected_and_named(bus: Bus, flag: int) -> None:
    assert bus.cycle((one(5), 200_000), (frame(0x181 | flag), 250_000), (two(5), 300_000))
    assert bus.intake.values(0) == (5, -5)
    assert bus.intake.counters()["181h drive 1 TPDO1"]["rejected"] == 1


def test_a_foreign_sync_makes_every_input_doubtful(bus: Bus) -> None:
    assert not bus.cycle((one(1), 200_000), (two(1), 300_000), foreign_sync=True)
    assert not bus.intake.fresh(0)
    assert not bus.intake.fresh(1)
    assert bus.intake.foreign_sync == 1
    assert bus.cycle((one(2), 200_000), (two(2), 300_000))


def test_a_node_that_booted_again_is_not_believed_until_configured(bus: Bus) -> None:
    assert not bus.cycle((frame(0x701, b"\x00"), 100_000), (one(1), 200_000), (two(1), 300_000))
    assert bus.intake.unconfigured == {1}
    for n in range(20):
        assert not bus.cycle((one(n), 200_000), (two(n), 300_000))
    bus.intake.configured(1)
    assert bus.cycle((one(9), 200_000), (two(9), 300_000))


def test_heartbeats_are_kept_by_node(bus: Bus) -> None:
    bus.cycle((frame(0x701, b"\x05"), 100_000), (one(1), 200_000), (two(1), 300_000))
    assert bus.intake.node_states == {1: 5}


def test_random_faults_never_yield_an_input_of_another_cycle() -> None:
    """Frames carry their cycle number; whatever is lost, late (by less than a cycle), doubled: fresh means this cycle."""
    import random

    for seed in range(20):
        random_ = random.Random(seed)
        bus = Bus()
        bus.settle()
        carried: list[bytes] = []
        for n in range(300):
            arrivals = [(data, random_.randrange(5_000, 100_000)) for data in carried]
            carried, late = [], []
            for make, usual in ((one, 200_000), (two, 300_000)):
                kind = random_.random()
                data = make(n)
                if kind < 0.80:
                    arrivals.append((data, usual + random_.randrange(-20_000, 20_000)))
                    if kind < 0.05:
                        arrivals.append((data, usual + 40_000))
                elif kind < 0.87:
                    late.append(data)
                elif kind < 0.94:
                    carried.append(data)
            arrivals.sort(key=lambda arrival: arrival[1])
            bus.cycle(*arrivals, late=tuple(late))
            for index in (0, 1):
                if bus.intake.fresh(index):
                    assert bus.intake.values(index)[0] == n, f"seed {seed} cycle {n}"
