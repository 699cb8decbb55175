"""Frame sockets: one suite over both transports.

On AF_CAN the suite runs where JTQD_CAN_INTERFACE (default vcan0) exists; named in the environment it must.
"""

import errno
import json
import math
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from jtqd.drivers.bus_socket import CanFilter, any_format, exact
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import BusError, BusGone, open_frame_socket
from jtqd.drivers.hub import Hub

pytestmark = pytest.mark.native

SEED = 7
SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(range(8)))


class Bench:
    """A bus of one of the two kinds, driven from the test's own thread."""

    def __init__(self, name, hub=None):
        self.name = name
        self.hub = hub
        self.sockets = []

    def open(self, filters=None, **options):
        sock = open_frame_socket(self.name, filters, **options)
        self.sockets.append(sock)
        self.settle()
        return sock

    def settle(self):
        if self.hub is not None:
            for _ in range(4):
                self.hub.run_once(0)
        else:
            time.sleep(0.002)  # a vcan delivers in a soft interrupt, perhaps after send has returned


def received(sock):
    """All frames that have arrived, as (frame, own)."""
    result = []
    while n := sock.receive():
        result += [(bytes(sock.frames[16 * i : 16 * i + 16]), bool(sock.own[i])) for i in range(n)]
        assert list(sock.lengths) == [16] * n
    return result


@pytest.fixture(params=["unix", pytest.param("can", marks=pytest.mark.socketcan)])
def bench(request, tmp_path):
    if request.param == "unix":
        hub = Hub(str(tmp_path / "bus"))
        bench = Bench(f"unix:{tmp_path}/bus", hub)
    else:
        name = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
        bench = Bench(name)
        try:
            open_frame_socket(name, None).close()
        except BusError as error:
            if "JTQD_CAN_INTERFACE" in os.environ:
                raise
            pytest.skip(str(error))
    yield bench
    for sock in bench.sockets:
        sock.close()
    if bench.hub is not None:
        bench.hub.close()


def test_frames_arrive_in_order_whole_and_not_at_the_sender(bench):
    a, b = bench.open(), bench.open()
    sent = [pack(0x100 + i, bytes([i]) * (i % 9)) for i in range(20)]
    for frame in sent:
        assert a.send(frame)
    bench.settle()
    assert b.wait(0.0)
    assert received(b) == [(frame, False) for frame in sent]
    assert received(a) == []
    assert not b.wait(0.0)


def test_more_frames_than_one_call_takes(bench):
    a, b = bench.open(), bench.open(capacity=8)
    for i in range(30):
        a.send(pack(i))
    bench.settle()
    counts = []
    while n := b.receive():
        counts.append(n)
    assert counts == [8, 8, 8, 6]


def test_exact_filters_refuse_remote_and_29_bit_frames_of_the_same_number(bench):
    a, b = bench.open(), bench.open([exact(0x181), exact(0x123456 | CAN_EFF_FLAG)])
    wanted = [TPDO, pack(0x123456 | CAN_EFF_FLAG, b"\x01")]
    other = [
        pack(0x181 | CAN_EFF_FLAG, bytes(8)),
        pack(0x181 | CAN_RTR_FLAG, bytes(8)),
        pack(0x182, bytes(8)),
        pack(0x081),
        pack(0x123456 | CAN_EFF_FLAG | CAN_RTR_FLAG),
        pack(0x123457 | CAN_EFF_FLAG),
        pack(0x456),
    ]
    for frame in [*other, *wanted, *other]:
        a.send(frame)
    bench.settle()
    assert [frame for frame, _ in received(b)] == wanted


def test_look_alikes_filter_lets_the_wrong_formats_through(bench):
    a, b = bench.open(), bench.open([any_format(0x181)])
    alike = [TPDO, pack(0x181 | CAN_EFF_FLAG), pack(0x181 | CAN_RTR_FLAG)]
    for frame in [*alike, pack(0x981 | CAN_EFF_FLAG), pack(0x180)]:
        a.send(frame)
    bench.settle()
    assert [frame for frame, _ in received(b)] == alike


def test_no_filter_at_all_receives_nothing_and_filters_can_be_replaced(bench):
    a, b = bench.open(), bench.open([])
    a.send(SYNC)
    bench.settle()
    assert received(b) == []
    b.set_filters([exact(0x80)])
    a.send(TPDO)
    a.send(SYNC)
    bench.settle()
    assert received(b) == [(SYNC, False)]
    b.set_filters(None)
    a.send(TPDO)
    bench.settle()
    assert received(b) == [(TPDO, False)]


def test_random_filters_follow_the_rule_of_can_raw(bench):
    rng = random.Random(SEED)
    print("seed", SEED)
    a, b = bench.open(), bench.open([])
    ids = [rng.getrandbits(11) | rng.choice([0, CAN_RTR_FLAG]) for _ in range(40)]
    ids += [rng.getrandbits(29) | CAN_EFF_FLAG | rng.choice([0, CAN_RTR_FLAG]) for _ in range(40)]
    for _ in range(20):
        flags = [0, CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG]
        filters = [
            CanFilter(rng.choice(ids), 1 << rng.randrange(29) | 1 << rng.randrange(11) | rng.choice(flags))
            for _ in range(rng.randrange(4))
        ]
        b.set_filters(filters)
        expected = [i for i in ids if any(i & mask == can_id & mask for can_id, mask in filters)]
        for can_id in ids:
            a.send(pack(can_id))
        bench.settle()
        assert [FRAME.unpack(frame)[0] for frame, _ in received(b)] == expected, filters


def test_512_filters_work(bench):
    a, b = bench.open(), bench.open([exact(i) for i in range(512)])
    a.send(pack(511))
    a.send(pack(512))
    bench.settle()
    assert [frame for frame, _ in received(b)] == [pack(511)]


def test_own_echo_is_flagged_and_filtered_like_any_frame(bench):
    a, b = bench.open([exact(0x80)], receive_own=True), bench.open()
    a.send(SYNC)
    a.send(TPDO)  # no filter of a's own matches: no echo
    b.send(SYNC)
    bench.settle()
    assert received(a) == [(SYNC, True), (SYNC, False)]
    assert received(b) == [(SYNC, False), (TPDO, False)]


def test_kernel_stamps_are_wall_clock_and_monotonic(bench):
    a, b = bench.open(receive_own=True), bench.open()
    before = time.time_ns()
    for i in range(5):
        a.send(pack(i))
    bench.settle()
    after = time.time_ns()
    for sock in (a, b):
        assert sock.receive() == 5
        stamps = list(sock.stamps_ns)
        assert before <= stamps[0]
        assert stamps[-1] <= after
        assert stamps == sorted(stamps)


@pytest.mark.measures
def test_stamp_is_taken_at_arrival_not_at_reading(bench):
    a, b = bench.open(), bench.open()
    a.send(SYNC)
    bench.settle()
    arrived = time.time_ns()
    time.sleep(0.02)
    assert b.receive() == 1
    assert arrived - 10_000_000 < b.stamps_ns[0] <= arrived


def test_error_frames_only_where_asked_for(bench):
    bus_off = pack(CAN_ERR_FLAG | 0x40, bytes(8))
    a, plain, alert = bench.open(), bench.open(), bench.open([], error_frames=True)
    a.send(bus_off)
    bench.settle()
    assert received(plain) == []
    assert [frame for frame, _ in received(alert)] == [bus_off]


def test_nothing_to_receive_is_no_error_and_wait_returns_in_time(bench):
    a = bench.open()
    assert a.receive() == 0
    start = time.monotonic()
    assert not a.wait(0.003)
    assert 0.0029 < time.monotonic() - start < 0.5
    assert not a.wait(-1.0)


def test_receive_overflow_is_counted(bench):
    """A socket that is not read loses frames; the next frame has their number."""
    a, b = bench.open(), bench.open()
    bench.open()  # a third one keeps the hub's other paths busy
    if bench.hub is None:
        with socket.socket(fileno=os.dup(b.fd)) as same:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # the kernel's minimum, a few frames
    sent = 0
    for _ in range(200):
        for _ in range(32):
            sent += a.send(TPDO)
        bench.settle()
    got = len(received(b))
    assert got < sent
    a.send(SYNC)
    bench.settle()
    assert received(b) == [(SYNC, False)]
    assert b.rx_dropped == sent - got
    a.send(SYNC)
    bench.settle()
    assert received(b) == [(SYNC, False)]
    assert b.rx_dropped == sent - got


def test_filters_that_no_transport_knows_are_refused(bench):
    for wrong in [CanFilter(0x20000080, 0x7FF), CanFilter(-1, 0), CanFilter(0, 1 << 32)]:
        with pytest.raises(ValueError, match="filter"):
            bench.open([wrong])
    with pytest.raises(ValueError, match="512"):
        bench.open([exact(i) for i in range(513)])


# --- failures a test cannot bring about on every kernel ---


@pytest.mark.parametrize(
    "bus", ["foo:bar", "udp:1", "UNIX:/run/bus", "/run/bus", "can 0", "can0123456789abc"]
)
def test_a_name_that_no_interface_can_have_is_no_question_of_the_kernel(bus):
    with pytest.raises(BusError) as caught:
        open_frame_socket(bus, None)
    assert str(caught.value) == f"{bus}: found no bus, expected the name of a CAN interface, or unix:PATH"


@pytest.mark.parametrize("number", [errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT])
def test_kernel_without_can_is_one_line(monkeypatch, number):
    def refuse(*_arguments):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(socket, "socket", refuse)
    with pytest.raises(BusError) as caught:
        open_frame_socket("can0", None)
    assert (
        str(caught.value) == f"can0: this kernel has no CAN (AF_CAN, errno {number}); use unix:PATH instead"
    )


@pytest.fixture(scope="module")
def failing_calls(tmp_path_factory):
    """Library to preload into a process whose system calls are to fail."""
    library = tmp_path_factory.mktemp("calls") / "failing_calls.so"
    source = Path(__file__).with_name("failing_calls.c")
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    return library


FAILING = """
import json, os, sys
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import BusError, open_frame_socket

def outcome(call):
    try:
        return call()
    except BusError as error:
        return [type(error).__name__, str(error)]

bus, call, number = sys.argv[1:]
sock = open_frame_socket(bus, None)
os.environ[call] = number
found = [outcome(lambda: sock.send(pack(0x080)) if call == "send" else sock.receive()) for _ in range(3)]
del os.environ[call]
print(json.dumps([found, [outcome(sock.receive) for _ in range(2)], sock.tx_dropped]))
"""


def outcomes(bench, library, call, number):
    """Three calls that fail, two of `receive` afterwards, dropped frames: as lists, errors as [class, text]."""
    preload = os.pathsep.join(filter(None, [os.environ.get("LD_PRELOAD"), str(library)]))
    result = subprocess.run(
        [sys.executable, "-c", FAILING, bench.name, call, str(number)],
        env={**os.environ, "LD_PRELOAD": preload},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


ERRORS = [
    (errno.ENETDOWN, "BusDown"),
    (errno.ENODEV, "BusGone"),
    (errno.ENXIO, "BusGone"),
    (errno.EPIPE, "BusGone"),
    (errno.EINVAL, "BusError"),
]


@pytest.mark.parametrize("call", ["send", "recvmmsg"])
@pytest.mark.parametrize(("number", "kind"), ERRORS)
def test_errors_by_number(bench, failing_calls, call, number, kind):
    """A bus that has gone is reported at each call, also when the kernel reports it once."""
    failed, later, _ = outcomes(bench, failing_calls, call, number)
    for found, text in failed:
        assert found == kind
        assert text.startswith(bench.name)
    if kind == "BusGone":
        assert [found for found, _ in later] == ["BusGone"] * 2
    else:
        assert later == [0, 0]


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EINTR, errno.ECONNRESET])
def test_errors_after_which_more_comes_are_nothing_yet(bench, failing_calls, number):
    assert outcomes(bench, failing_calls, "recvmmsg", number) == [[0, 0, 0], [0, 0], 0]


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN, errno.ENOMEM])
def test_enobufs_is_a_dropped_frame_not_an_error(bench, failing_calls, number):
    assert outcomes(bench, failing_calls, "send", number) == [[False] * 3, [0, 0], 3]


def test_a_message_that_is_no_frame_is_refused(bench):
    sock = bench.open()
    for wrong in (b"", SYNC[:15], SYNC + b"x"):
        with pytest.raises(BusError, match="Invalid argument"):
            sock.send(wrong)
    assert sock.receive() == 0
    assert sock.tx_dropped == 0


def test_wait_lets_other_threads_run(bench):
    a, b = bench.open(), bench.open()

    def send():
        time.sleep(0.02)
        a.send(SYNC)
        bench.settle()

    thread = threading.Thread(target=send)
    start = time.monotonic()
    thread.start()
    assert b.wait(None)
    assert time.monotonic() - start < 5.0
    thread.join()
    assert received(b) == [(SYNC, False)]


def test_wait_goes_on_after_a_signal_unless_its_handler_raises(bench):
    sock = bench.open()
    calls = []
    before = signal.signal(signal.SIGALRM, lambda *_: calls.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
        start = time.monotonic()
        assert not sock.wait(0.05)
        assert 0.049 < time.monotonic() - start < 5.0
        assert calls
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            sock.wait(None)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_times_to_wait_that_are_no_times(bench):
    a, b = bench.open(receive_own=True), bench.open()
    with pytest.raises(ValueError, match="NaN"):
        a.wait(math.nan)
    assert not b.wait(-math.inf)
    a.send(SYNC)
    bench.settle()
    assert a.wait(math.inf)
    assert a.wait(1e300)


def test_a_closed_socket_has_gone(bench):
    sock = bench.open()
    sock.close()
    assert sock.fd == -1
    assert sock.wait(None)
    for call in (sock.receive, lambda: sock.send(SYNC), lambda: sock.set_filters([exact(0x80)])):
        with pytest.raises(BusGone):
            call()
