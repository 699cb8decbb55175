"""The modelled wire: hand-computed timelines, order, and conservation of time."""

import random

import pytest

from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, FRAME, arbitration_key, pack, stuffed_bits
from jtqd.drivers.wire import WireModel

SEED = 42
SYNC = pack(0x080)  # 51 bits = 51 us at 1 Mbit/s
HEARTBEAT = pack(0x701, b"\x05")  # 58
ZEROS = pack(0x181, bytes(8))  # 126
ONES = pack(0x181, b"\xff" * 8)  # 124
NMT = pack(0x000)  # 53
US = 1000


def test_one_frame_takes_its_bits():
    wire = WireModel(1_000_000)
    assert wire.next_end() is None
    wire.submit("a", SYNC, 5 * US)
    assert wire.next_end() == 56 * US
    assert wire.advance(56 * US - 1) == []
    assert wire.advance(56 * US) == [("a", SYNC, 56 * US)]
    assert wire.next_end() is None
    assert (wire.bits, wire.frames) == (51, 1)


def test_bit_rate_scales_time_and_rounds_up():
    wire = WireModel(500_000)
    wire.submit("a", SYNC, 0)
    assert wire.next_end() == 102 * US
    assert WireModel(3).duration_ns(1) == 333_333_334
    with pytest.raises(ValueError, match="bit rate"):
        WireModel(0)


def test_sync_then_answers_in_order_of_priority():
    """SYNC 0..51; during it three nodes queue; 181h wins, then 701h, then the remote 701h."""
    wire = WireModel(1_000_000)
    remote = pack(0x701 | CAN_RTR_FLAG)
    wire.submit("master", SYNC, 0)
    assert wire.advance(10 * US) == []
    wire.submit("c", remote, 20 * US)
    wire.submit("b", HEARTBEAT, 30 * US)
    wire.submit("a", ZEROS, 51 * US)  # just in time: arbitration is at 51
    ends = wire.advance(10_000 * US)
    remote_end = 51 + 126 + 58 + stuffed_bits(0x701 | CAN_RTR_FLAG)
    assert ends == [
        ("master", SYNC, 51 * US),
        ("a", ZEROS, 177 * US),
        ("b", HEARTBEAT, 235 * US),
        ("c", remote, remote_end * US),
    ]


def test_a_frame_on_the_wire_is_not_pre_empted():
    wire = WireModel(1_000_000)
    wire.submit("low", HEARTBEAT, 0)
    wire.advance(1)
    wire.submit("high", NMT, 1)
    wire.submit("low", ZEROS, 1)
    assert [(sender, end) for sender, _, end in wire.advance(10**9)] == [
        ("low", 58 * US),
        ("high", 111 * US),
        ("low", 237 * US),
    ]


def test_same_moment_arbitrates_even_after_advance_to_it():
    wire = WireModel(1_000_000)
    wire.submit("low", HEARTBEAT, 7 * US)
    wire.advance(7 * US)
    wire.submit("high", NMT, 7 * US)
    assert [sender for sender, _, _ in wire.advance(10**9)] == ["high", "low"]


def test_gap_on_the_wire_and_late_news_of_a_submission():
    """A hub learns late of a send: the frame still starts when it was sent if the wire was free."""
    wire = WireModel(1_000_000)
    wire.submit("a", SYNC, 0)
    assert wire.advance(500 * US) == [("a", SYNC, 51 * US)]
    wire.submit("b", HEARTBEAT, 100 * US)
    assert wire.next_end() == 158 * US
    wire.submit("c", NMT, 20 * US)  # while SYNC was on the wire: starts at its end, before b
    assert wire.advance(500 * US) == [("c", NMT, 104 * US), ("b", HEARTBEAT, 162 * US)]


def test_fifo_within_a_sender_even_against_its_own_priorities():
    wire = WireModel(1_000_000)
    wire.submit("a", HEARTBEAT, 0)
    wire.submit("a", NMT, 0)
    wire.submit("b", ZEROS, 0)
    assert [frame for _, frame, _ in wire.advance(10**9)] == [ZEROS, HEARTBEAT, NMT]


def test_queue_is_bounded():
    wire = WireModel(1_000_000, queue_limit=2)
    assert [wire.submit("a", SYNC, 0) for _ in range(3)] == [True, True, False]
    assert wire.pending("a") == 2
    assert wire.submit("b", SYNC, 0)
    assert len(wire.advance(10**9)) == 3


@pytest.mark.parametrize("seed", range(SEED, SEED + 8))
def test_random_traffic_keeps_time_order_and_frames(seed):
    rng = random.Random(seed)
    print("seed", seed)
    wire = WireModel(1_000_000, queue_limit=10_000)
    submitted = []  # (t, sender, frame)
    t = 0
    ended = []
    for number in range(600):
        t += rng.choice([0, 0, 1, 40 * US, 150 * US])
        can_id = rng.getrandbits(29) | CAN_EFF_FLAG if rng.random() < 0.2 else rng.getrandbits(11)
        data = number.to_bytes(2, "big") + bytes(rng.randrange(7))
        sender = rng.randrange(5)
        frame = pack(can_id, data)
        wire.submit(sender, frame, t)
        submitted.append((t, sender, frame))
        if rng.random() < 0.3:
            ended += wire.advance(t)
            following = wire.next_end()
            assert following is None or following > t
    ended += wire.advance(10**12)
    bits = {frame: stuffed_bits(FRAME.unpack(frame)[0], frame[8 : 8 + frame[4]]) for _, _, frame in submitted}
    assert sorted(frame for _, frame, _ in ended) == sorted(frame for _, _, frame in submitted)
    assert wire.bits == sum(bits.values())
    for sender in range(5):  # first in, first out
        assert [f for s, f, _ in ended if s == sender] == [f for _, s, f in submitted if s == sender]
    # Replay the law by itself: at each start, the winner is the smallest key of the heads already submitted.
    queues = {sender: [(t, f) for t, s, f in submitted if s == sender] for sender in range(5)}
    free = 0
    for sender, frame, end in ended:
        heads = {s: queue[0] for s, queue in queues.items() if queue}
        start = max(free, min(t for t, _ in heads.values()))
        able = {s: f for s, (t, f) in heads.items() if t <= start}
        best = min(arbitration_key(FRAME.unpack(f)[0]) for f in able.values())
        assert arbitration_key(FRAME.unpack(able[sender])[0]) == best
        assert end == start + bits[frame] * US
        queues[sender].pop(0)
        free = end
