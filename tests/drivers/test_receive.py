"""FrameReceiver on bare sockets: lengths, stamps, the end of the stream, control messages of other layouts, lost frames."""

import errno
import os
import socket
import time

import pytest

from jtqd.drivers.frame import FRAME_SIZE, pack
from jtqd.drivers.frame_socket import FrameReceiver, FrameSocket

SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(range(8)))


@pytest.mark.parametrize("stamps", [True, False])
def test_receiver_reports_wrong_lengths_and_empty_messages_are_not_the_end(stamps):
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if stamps:
        b.setsockopt(socket.SOL_SOCKET, 35, 1)
    receiver = FrameReceiver(8)
    for message in [SYNC, b"x" * 15, b"y" * 40, TPDO]:
        a.send(message)
    assert receiver.receive(b.fileno()) == 4
    assert list(receiver.lengths) == [16, 15, 40, 16]
    assert bytes(receiver.frames[:16]) == SYNC
    assert bytes(receiver.frames[16:48]) == b"x" * 15 + bytes(1) + b"y" * 16
    assert bytes(receiver.frames[48:64]) == TPDO
    assert [stamp > 0 for stamp in receiver.stamps_ns] == [stamps] * 4
    if stamps:
        a.send(b"")
        a.send(SYNC)
        assert receiver.receive(b.fileno()) == 2
        assert list(receiver.lengths) == [0, 16]
        assert not receiver.closed
    a.send(TPDO)
    a.close()
    assert receiver.receive(b.fileno()) == 1
    assert receiver.closed
    b.close()


def test_receiver_sees_the_end_behind_an_empty_message_and_then_serves_another_socket():
    receiver = FrameReceiver()
    for full in (1, 3):  # the second one uses slots that the end of the first has written to
        a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        b.setsockopt(socket.SOL_SOCKET, 35, 1)
        a.send(b"")
        for _ in range(full):
            a.send(SYNC)
        a.close()
        assert receiver.receive(b.fileno()) == 1 + full
        assert list(receiver.lengths[: 1 + full]) == [0] + [16] * full
        assert receiver.closed
        assert all(stamp > 0 for stamp in receiver.stamps_ns[: 1 + full])
        b.close()


def test_receiver_walks_control_messages_of_another_layout():
    """SO_PASSCRED adds a message of its own, so the stamp no longer fills the control data alone."""
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    b.setsockopt(socket.SOL_SOCKET, 35, 1)
    b.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    receiver = FrameReceiver()
    before = time.time_ns()
    for _ in range(3):
        a.send(SYNC)
    assert receiver.receive(b.fileno()) == 3
    assert all(before <= stamp <= time.time_ns() for stamp in receiver.stamps_ns)
    assert not receiver.closed
    a.close()
    b.close()


@pytest.fixture
def udp():
    """(sender, receiver with stamps, counter of lost messages and room for few): UDP has the counter, as AF_CAN has."""
    a, b = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    b.bind(("127.0.0.1", 0))
    b.setblocking(False)
    for option, value in ((35, 1), (40, 1), (socket.SO_RCVBUF, 1)):
        b.setsockopt(socket.SOL_SOCKET, option, value)
    a.connect(b.getsockname())
    yield a, b
    a.close()
    b.close()


def overflow(a, take):
    """Send more than there is room for; return how many were lost, which the next message tells."""
    sent = 100
    for _ in range(sent):
        a.send(SYNC)
    got = 0
    while n := take():
        got += n
    assert 0 < got < sent
    a.send(TPDO)
    assert take() == 1
    return sent - got


def test_receiver_reads_the_counter_of_lost_messages_behind_the_stamp(udp):
    a, b = udp
    receiver = FrameReceiver()
    before, lost = time.time_ns(), 0
    for _ in range(2):
        lost += overflow(a, lambda: receiver.receive(b.fileno()))
        assert receiver.overflow == lost
        assert before <= receiver.stamps_ns[0] <= time.time_ns()
        assert bytes(receiver.frames[:FRAME_SIZE]) == TPDO


def test_frame_socket_counts_what_was_lost(udp):
    a, b = udp
    sock = FrameSocket(b, "can9", unix=False, receive_own=False, error_frames=False, capacity=4)
    assert sock.rx_dropped == 0
    lost = overflow(a, sock.receive)
    assert sock.rx_dropped == lost
    assert list(sock.own) == [False]
    assert list(sock.lengths) == [FRAME_SIZE]


def test_errors_come_as_negative_numbers():
    fd = os.open(os.devnull, os.O_RDONLY)
    receiver = FrameReceiver()
    assert receiver.receive(fd) == -errno.ENOTSOCK
    os.close(fd)
    assert receiver.receive(fd) == -errno.EBADF
    assert (receiver.lengths, receiver.flags, receiver.stamps_ns) == ([], [], [])
    assert not receiver.closed


def test_memory_stays_where_the_kernel_writes():
    receiver = FrameReceiver(2)
    assert len(receiver.frames) == 2 * FRAME_SIZE
    with pytest.raises(BufferError):
        receiver.frames.append(0)
    for wrong in (0, -1):
        with pytest.raises(ValueError, match="capacity"):
            FrameReceiver(wrong)
