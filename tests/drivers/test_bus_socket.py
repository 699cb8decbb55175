"""Filter programs of the unix bus."""

import socket
import struct

import pytest

from jtqd.drivers import bus_socket
from jtqd.drivers.bus_socket import checked_filters, exact
from jtqd.drivers.frame import CAN_ERR_FLAG, pack

SYNC = pack(0x080, b"\x01")


def test_lengths_other_than_16_are_stopped_by_the_filter_program():
    a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus_socket.attach_filters(b, checked_filters(None), False)
    for message in [b"x" * 15, SYNC, b"y" * 17, b""]:
        a.send(message)
    b.setblocking(False)
    assert b.recv(64) == SYNC
    with pytest.raises(BlockingIOError):
        b.recv(64)
    a.close()
    b.close()


def test_program_of_one_filter_by_hand():
    """080h data frame: constants are byte-swapped on a little-endian host, jumps never exceed one."""
    code = bus_socket.bpf_program([exact(0x80)], False)
    swapped = struct.unpack(">I", struct.pack("=I", 0xC00007FF))[0]
    assert code == [
        (0x80, 0, 0, 0),  # A = length
        (0x15, 1, 0, 16),
        (0x06, 0, 0, 0),
        (0x20, 0, 0, 0),  # A = can_id as the kernel loads it
        (0x45, 0, 1, struct.unpack(">I", struct.pack("=I", CAN_ERR_FLAG))[0]),
        (0x06, 0, 0, 0),
        (0x07, 0, 0, 0),  # X = A
        (0x87, 0, 0, 0),
        (0x54, 0, 0, swapped),
        (0x15, 0, 1, struct.unpack(">I", struct.pack("=I", 0x80))[0]),
        (0x06, 0, 0, 16),
        (0x06, 0, 0, 0),
    ]
