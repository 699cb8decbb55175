"""The hub: order, echo, garbage, slow and rude clients, life of the socket file, modelled wire."""

import os
import random
import signal
import socket
import stat
import subprocess
import sys
import time

import pytest

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    FRAME,
    arbitration_key,
    pack,
    stuffed_bits,
)
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.hub import MAX_CLIENTS, Hub, WireModel
from tests.paths import ROOT

pytestmark = pytest.mark.native

SEED = 3
SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(8))


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / "bus")


@pytest.fixture
def hub(path):
    with_hub = Hub(path)
    yield with_hub
    with_hub.close()


def connect(path):
    """A client without filters or good manners."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sock.connect(path)
    sock.setblocking(False)
    return sock


def messages(sock):
    result = []
    while True:
        try:
            message = sock.recv(64)
        except BlockingIOError:
            return result
        if not message:
            return result
        result.append(message)


def settle(hub):
    for _ in range(4):
        hub.run_once(0)


def test_relay_echo_and_padding_byte_by_byte(hub, path):
    a, b = connect(path), connect(path)
    seen = []
    port = hub.attach(lambda frame, stamp: seen.append((frame, stamp)))
    hub.run_once(0)
    before = time.time_ns()
    #           can_id      len pad (bit 0: echo)  data
    a.send(bytes.fromhex("80000000 01 01ffff 0100000000000000"))
    a.send(bytes.fromhex("80000000 01 fe0000 0200000000000000"))
    after = time.time_ns()
    time.sleep(0.01)
    hub.run_once(0)
    first = bytes.fromhex("80000000 01 000000 0100000000000000")
    second = bytes.fromhex("80000000 01 000000 0200000000000000")
    assert messages(b) == [first, second]
    assert [frame for frame, _ in seen] == [first, second]
    assert messages(a) == [bytes.fromhex("80000000 01 010000 0100000000000000")]
    # The stamp of a client's frame is the moment of its send, not of the hub's reading.
    assert before <= seen[0][1] <= seen[1][1] <= after
    port.send(bytes.fromhex("81010000 00 010000 0000000000000000"))
    assert seen[-1][0] == bytes.fromhex("81010000 00 010000 0000000000000000")
    assert messages(a) == messages(b) == [bytes.fromhex("81010000 00 000000 0000000000000000")]
    a.close()
    b.close()


def test_answer_from_a_callback_comes_after_its_question_for_everybody(hub, path):
    a, b = connect(path), connect(path)
    order = []

    def node(frame, _stamp):
        order.append(("first", frame))
        if frame == SYNC:
            assert first.send(TPDO)

    first = hub.attach(node)
    hub.attach(lambda frame, _stamp: order.append(("second", frame)))
    hub.run_once(0)
    a.send(SYNC)
    hub.run_once(0)
    assert messages(b) == [SYNC, TPDO]
    assert messages(a) == [TPDO]
    assert order == [("first", SYNC), ("second", SYNC), ("second", TPDO)]
    first.detach()
    a.send(SYNC)
    hub.run_once(0)
    assert order[3:] == [("second", SYNC)]


def test_a_port_hears_the_identifiers_that_it_wants_and_no_others(hub, path):
    sock, heard = connect(path), []
    hub.attach(lambda frame, _stamp: heard.append(frame), [0x080, 0x7FF])
    hub.run_once(0)
    wanted = [pack(0x080), pack(0x7FF, b"\1")]
    others = [
        pack(0x081),
        pack(0x080 | CAN_RTR_FLAG),
        pack(0x080 | CAN_EFF_FLAG),
        pack(0x1FFF_FFFF | CAN_EFF_FLAG),
    ]
    for frame in (wanted[0], *others, wanted[1]):
        sock.send(frame)
    hub.run_once(0)
    assert heard == wanted
    with pytest.raises(IndexError):
        hub.attach(heard.append, [0x800])


def test_garbage_reaches_nobody_and_is_counted(hub, path):
    rng = random.Random(SEED)
    print("seed", SEED)
    a, b = connect(path), connect(path)
    seen = []
    hub.attach(lambda frame, _stamp: seen.append(frame))
    garbage = [b"", b"x", bytes(15), bytes(17), bytes(64), bytes(100_000)]
    garbage += [
        FRAME.pack(0x80, 9, bytes(8)),  # nine bytes of data
        FRAME.pack(0x80, 255, bytes(8)),
        FRAME.pack(0x800, 0, bytes(8)),  # twelve bits without CAN_EFF_FLAG
    ]
    garbage += [rng.randbytes(rng.choice([1, 7, 15, 17, 32])) for _ in range(100)]
    hub.run_once(0)
    for message in garbage:
        a.send(message)
        hub.run_once(0)
    assert hub.counters.malformed == len(garbage)
    a.send(SYNC)
    hub.run_once(0)
    assert messages(b) == [SYNC]
    assert seen == [SYNC]
    assert hub.counters.frames == 1


def test_random_16_bytes_never_stop_the_hub(hub, path):
    rng = random.Random(SEED)
    print("seed", SEED)
    a, b = connect(path), connect(path)
    hub.run_once(0)
    for _ in range(3000):
        a.send(rng.randbytes(16))
        hub.run_once(0)
        for message in messages(b):
            can_id, length, _ = FRAME.unpack(message)
            assert length <= 8
            assert can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG) or can_id & 0x1FFFFFFF < 0x800
            assert message[5:8] == bytes(3)
    assert hub.counters.frames + hub.counters.malformed == 3000


def test_a_slow_client_loses_its_frames_and_nobody_else_notices(hub, path):
    sender, slow, quick = connect(path), connect(path), connect(path)
    hub.run_once(0)
    worst = 0.0
    got = 0
    for _ in range(3000):
        sender.send(TPDO)
        start = time.perf_counter()
        hub.run_once(0)
        worst = max(worst, time.perf_counter() - start)
        got += len(messages(quick))
    assert got == 3000
    kept = len(messages(slow))
    assert 100 < kept < 3000
    assert hub.counters.dropped == 3000 - kept
    assert worst < 0.5  # never waited
    sender.send(SYNC)
    hub.run_once(0)
    lost = (3000 - kept).to_bytes(2, "little")
    assert messages(slow) == [SYNC[:6] + lost + SYNC[8:]]
    assert messages(quick) == [SYNC]


def test_clients_may_vanish_at_any_moment(hub, path):
    stay = connect(path)
    for i in range(200):
        sock = connect(path)
        if i % 3:
            sock.send(SYNC)
        if i % 2:
            hub.run_once(0)
        if i % 5 == 0:
            stay.send(TPDO)  # leaves unread data behind: the close resets the connection
            hub.run_once(0)
        sock.close()
        settle(hub)
    assert messages(stay) == [SYNC] * sum(1 for i in range(200) if i % 3)
    assert len(hub._clients) == 1
    stay.close()
    settle(hub)
    assert hub._clients == {}


def test_a_storm_of_connections_is_refused_beyond_the_limit(hub, path):
    a, b = connect(path), connect(path)
    hub.run_once(0)
    others = []
    for _ in range(MAX_CLIENTS + 10):
        others.append(connect(path))
        hub.run_once(0)
    a.send(SYNC)
    hub.run_once(0)
    assert messages(b) == [SYNC]
    assert hub.counters.refused == 12
    assert others[-1].recv(16) == b""  # closed at once
    for sock in others:
        sock.close()
    settle(hub)
    assert len(hub._clients) == 2


def test_socket_file_is_private_and_removed(path):
    hub = Hub(path)
    mode = os.stat(path).st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600
    hub.close()
    assert not os.path.exists(path)


def test_stale_file_is_replaced_live_hub_and_other_files_are_not(path, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(path)
    hub = Hub(path)
    with pytest.raises(BusError, match="another hub is running there"):
        Hub(path)
    settle(hub)  # the probe of the second one comes and goes
    a, b = connect(path), connect(path)
    hub.run_once(0)
    a.send(SYNC)
    hub.run_once(0)
    assert messages(b) == [SYNC]
    os.unlink(path)
    other = Hub(path)
    hub.close()  # must not take away the file of the other one
    assert os.path.exists(path)
    other.close()
    plain = tmp_path / "plain"
    plain.write_text("keep")
    with pytest.raises(BusError, match="no socket"):
        Hub(str(plain))
    assert plain.read_text() == "keep"
    with pytest.raises(BusError, match="cannot create the bus: AF_UNIX path too long"):
        Hub(str(tmp_path / ("x" * 200)))


# --- the modelled wire ---


def run_for(hub, seconds):
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        hub.run_once(left)


def test_wire_orders_by_priority_and_takes_its_time(path):
    hub = Hub(
        path, bitrate=1000
    )  # 1 ms per bit: 50 ms per frame, so that the host cannot spoil who waits for whom
    a, b, listener = connect(path), connect(path), connect(path)
    arrivals = []
    ends = []

    def watch(frame, stamp):
        arrivals.append((frame, stamp))
        ends.append(hub._answering_ns)  # the model's own time, free of the clocks' jitter

    hub.attach(watch)
    hub.run_once(0)
    first, low, high = pack(0x7FF), pack(0x300), pack(0x001)
    start = time.time_ns()
    a.send(first)
    time.sleep(0.0005)
    a.send(low)
    b.send(high)
    run_for(hub, 0.25)
    assert messages(listener) == [first, high, low]
    assert [frame for frame, _ in arrivals] == [first, high, low]
    for earlier, later, frame in [(0, 1, high), (1, 2, low)]:  # back to back, exact to the bit
        bits = stuffed_bits(FRAME.unpack(frame)[0])
        assert ends[later] - ends[earlier] == bits * 1_000_000
    assert 0 <= arrivals[0][1] - start - stuffed_bits(0x7FF) * 1_000_000 < 20_000_000
    assert hub.wire is not None
    assert hub.wire.frames == 3
    hub.close()


def test_wire_is_exact_although_the_hub_reads_late(path):
    """Frames sent while the hub was away count from their send: their time on the wire is already over."""
    hub = Hub(path, bitrate=1_000_000)
    a, b = connect(path), connect(path)
    ends = []
    hub.attach(lambda frame, stamp: ends.append(stamp))
    hub.run_once(0)
    sent = time.time_ns()
    a.send(SYNC)
    time.sleep(0.02)
    hub.run_once(0)
    assert messages(b) == [SYNC]
    assert 0 <= ends[0] - sent - 59_000 < 15_000_000  # 20 ms if it counted from the reading
    hub.close()


def test_answers_of_local_nodes_are_exact_on_the_wire_although_the_hub_reads_late(path):
    """SYNC ends after 59 us; both nodes answer then and arbitrate: exact, whatever the host does."""
    hub = Hub(path, bitrate=1_000_000)
    a = connect(path)
    seen = []
    low, high = pack(0x281, bytes(8)), pack(0x181, bytes(8))
    first = hub.attach(lambda frame, _stamp: frame == SYNC and first.send(low))
    second = hub.attach(lambda frame, _stamp: frame == SYNC and second.send(high))
    hub.attach(lambda frame, _stamp: seen.append((frame, hub._answering_ns)))
    hub.run_once(0)
    a.send(SYNC)
    time.sleep(0.01)
    run_for(hub, 0.005)
    assert [frame for frame, _ in seen] == [SYNC, high, low]
    sync_end, high_end, low_end = (end for _, end in seen)
    assert high_end - sync_end == stuffed_bits(0x181, bytes(8)) * 1000
    assert low_end - high_end == stuffed_bits(0x281, bytes(8)) * 1000
    a.close()
    hub.close()


def test_wire_echo_comes_at_the_end_of_transmission(path):
    hub = Hub(path, bitrate=10_000)
    sock = open_frame_socket(f"unix:{path}", [exact(0x80)], receive_own=True)
    hub.run_once(0)
    start = time.time_ns()
    sock.send(SYNC)
    run_for(hub, 0.01)
    assert sock.receive() == 1
    assert sock.own[0]
    assert sock.stamps_ns[0] - start >= 59 * 100_000
    sock.close()
    hub.close()


def test_a_flooding_client_is_held_back_and_others_keep_their_share(path):
    hub = Hub(path, bitrate=1_000_000)
    flood = open_frame_socket(f"unix:{path}", [])
    quiet = open_frame_socket(f"unix:{path}", [])
    listener = open_frame_socket(f"unix:{path}", [exact(0x010)])
    hub.run_once(0)
    for _ in range(3000):
        flood.send(TPDO)
    assert flood.tx_dropped > 0
    quiet.send(pack(0x010))
    run_for(hub, 0.01)
    assert listener.receive() == 1  # it won the arbitration against the queue
    assert hub.wire is not None
    assert hub.wire.pending(next(iter(hub._clients.values()))) <= 128
    assert hub.counters.tx_full == 0
    port = hub.attach(lambda _frame, _stamp: None)
    accepted = sum(port.send(SYNC) for _ in range(300))
    assert accepted == 128
    assert hub.counters.tx_full == 172
    for sock in (flood, quiet, listener):
        sock.close()
    hub.close()


def test_error_messages_do_not_use_the_wire(path):
    hub = Hub(path, bitrate=10_000)
    alert = open_frame_socket(f"unix:{path}", [], error_frames=True)
    a = connect(path)
    hub.run_once(0)
    a.send(TPDO)
    a.send(pack(CAN_ERR_FLAG | 0x40, bytes(8)))
    hub.run_once(0)
    assert alert.receive() == 1
    assert hub.wire is not None
    assert hub.wire.frames == 0
    alert.close()
    hub.close()


# --- the command ---


@pytest.mark.parametrize("options", [[], ["--bitrate", "1000000"]])
def test_command_serves_until_sigterm(path, options):
    command = [sys.executable, "-m", "jtqd.drivers.hub", f"unix:{path}", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"hub: unix:{path} is up\n"
        a = open_frame_socket(f"unix:{path}", None)
        b = open_frame_socket(f"unix:{path}", None)
        # A frame of b's own shows that the hub has taken b in.
        b.send(TPDO)
        assert a.wait(5.0)
        a.send(SYNC)
        assert b.wait(5.0)
        assert b.receive() == 1
        second = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert second.returncode == 1
        assert second.stderr == f"hub: unix:{path}: another hub is running there\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(5.0) == 0
    assert not os.path.exists(path)


def test_command_refuses_a_silly_bit_rate(path):
    command = [sys.executable, "-m", "jtqd.drivers.hub", f"unix:{path}", "--bitrate", "0"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "--bitrate must be positive" in result.stderr
    assert "Traceback" not in result.stderr


# The wire


SEED = 42
BARE_SYNC = pack(0x080)  # 51 bits = 51 us at 1 Mbit/s
HEARTBEAT = pack(0x701, b"\x05")  # 58
ZEROS = pack(0x181, bytes(8))  # 126
ONES = pack(0x181, b"\xff" * 8)  # 124
NMT = pack(0x000)  # 53
US = 1000


def test_one_frame_takes_its_bits():
    wire = WireModel(1_000_000)
    assert wire.next_end() is None
    wire.submit("a", BARE_SYNC, 5 * US)
    assert wire.next_end() == 56 * US
    assert wire.advance(56 * US - 1) == []
    assert wire.advance(56 * US) == [("a", BARE_SYNC, 56 * US)]
    assert wire.next_end() is None
    assert (wire.bits, wire.frames) == (51, 1)


def test_bit_rate_scales_time_and_rounds_up():
    wire = WireModel(500_000)
    wire.submit("a", BARE_SYNC, 0)
    assert wire.next_end() == 102 * US
    assert WireModel(3).duration_ns(1) == 333_333_334
    with pytest.raises(ValueError, match="bit rate"):
        WireModel(0)


def test_sync_then_answers_in_order_of_priority():
    """BARE_SYNC 0..51; during it three nodes queue; 181h wins, then 701h, then the remote 701h."""
    wire = WireModel(1_000_000)
    remote = pack(0x701 | CAN_RTR_FLAG)
    wire.submit("master", BARE_SYNC, 0)
    assert wire.advance(10 * US) == []
    wire.submit("c", remote, 20 * US)
    wire.submit("b", HEARTBEAT, 30 * US)
    wire.submit("a", ZEROS, 51 * US)  # just in time: arbitration is at 51
    ends = wire.advance(10_000 * US)
    remote_end = 51 + 126 + 58 + stuffed_bits(0x701 | CAN_RTR_FLAG)
    assert ends == [
        ("master", BARE_SYNC, 51 * US),
        ("a", ZEROS, 177 * US),
        ("b", HEARTBEAT, 235 * US),
        ("c", remote, remote_end * US),
    ]


@pytest.mark.parametrize(
    ("steps", "sent"),
    [
        pytest.param(
            [("low", HEARTBEAT, 0), 1, ("high", NMT, 1), ("low", ZEROS, 1)],
            [("low", HEARTBEAT, 58), ("high", NMT, 111), ("low", ZEROS, 237)],
            id="a frame on the wire is not pre-empted",
        ),
        pytest.param(
            [("low", HEARTBEAT, 7 * US), 7 * US, ("high", NMT, 7 * US)],
            [("high", NMT, 60), ("low", HEARTBEAT, 118)],
            id="the same moment arbitrates even after advance to it",
        ),
        pytest.param(
            # c was sent while BARE_SYNC was on the wire: it starts at its end, before b
            [("a", BARE_SYNC, 0), 500 * US, ("b", HEARTBEAT, 100 * US), ("c", NMT, 20 * US)],
            [("a", BARE_SYNC, 51), ("c", NMT, 104), ("b", HEARTBEAT, 162)],
            id="a hub learns late of a send",
        ),
        pytest.param(
            [("a", HEARTBEAT, 0), ("a", NMT, 0), ("b", ZEROS, 0)],
            [("b", ZEROS, 126), ("a", HEARTBEAT, 184), ("a", NMT, 237)],
            id="first in, first out within a sender even against its own priorities",
        ),
    ],
)
def test_order_on_the_wire(steps, sent):
    """Steps: a submission (sender, frame, time), or a time to which the wire advances; sent: with the end in us."""
    wire = WireModel(1_000_000)
    ended = []
    for step in steps:
        if isinstance(step, int):
            ended += wire.advance(step)
        else:
            wire.submit(*step)
    ended += wire.advance(10**9)
    assert ended == [(sender, frame, end * US) for sender, frame, end in sent]


def test_queue_is_bounded():
    wire = WireModel(1_000_000, queue_limit=2)
    assert [wire.submit("a", BARE_SYNC, 0) for _ in range(3)] == [True, True, False]
    assert wire.pending("a") == 2
    assert wire.submit("b", BARE_SYNC, 0)
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
