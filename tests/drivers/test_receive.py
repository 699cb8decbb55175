"""FrameReceiver on bare sockets: lengths, stamps, the end of the stream, control messages of other layouts."""

import socket
import time

import pytest

from jtqd.drivers.frame import pack
from jtqd.drivers.receive import FrameReceiver

SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(range(8)))


@pytest.mark.parametrize("stamps", [True, False])
def test_receiver_reports_wrong_lengths_and_tells_empty_messages_from_the_end(stamps):
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if stamps:
        b.setsockopt(socket.SOL_SOCKET, 35, 1)
    receiver = FrameReceiver(8)
    for message in [SYNC, b"x" * 15, b"y" * 40, TPDO]:
        a.send(message)
    assert receiver.receive(b.fileno()) == 4
    assert list(receiver.lengths) == [16, 15, 40, 16]
    assert bytes(receiver.frames[:16]) == SYNC
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
        receiver.closed = False
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
