"""What only a real CAN interface does: unknown names, link down and up, removal. Needs root for `ip link`.

The behaviour both transports share is in test_frame_socket.py, run on AF_CAN too.
"""

import os
import socket
import struct
import subprocess

import pytest

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import CAN_EFF_FLAG, pack
from jtqd.drivers.frame_socket import BusDown, BusError, BusGone, open_frame_socket

pytestmark = pytest.mark.socketcan

LINK = "vcanjtq"  # made and removed by these tests; the bus under JTQD_CAN_INTERFACE is left alone
SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(8))


def ip(*arguments):
    subprocess.run(["ip", "link", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def link():
    try:
        ip("add", "dev", LINK, "type", "vcan")
    except subprocess.CalledProcessError as error:
        if "JTQD_CAN_INTERFACE" in os.environ:
            raise
        pytest.skip(f"cannot make a vcan interface: {error.stderr.strip()}")
    ip("set", LINK, "up")
    yield LINK
    subprocess.run(["ip", "link", "del", LINK], check=False, capture_output=True)


def frames_of(sock):
    """Frames of this moment: a vcan delivers in a soft interrupt, perhaps after send has returned."""
    sock.wait(0.2)
    n = sock.receive()
    return [bytes(sock.frames[16 * i : 16 * i + 16]) for i in range(n)]


def test_unknown_interface_is_named():
    with pytest.raises(BusError) as caught:
        open_frame_socket("can7", None)
    assert str(caught.value) == "no such CAN interface: can7"
    with pytest.raises(
        BusError, match=r"^a-name-far-too-long-for-linux: found no bus, expected the name of a CAN interface"
    ):
        open_frame_socket("a-name-far-too-long-for-linux", None)
    with pytest.raises(BusError, match="name of a CAN interface"):
        open_frame_socket("", None)


def test_interface_of_another_kind_is_named():
    with pytest.raises(BusError, match=r"^not a CAN interface: lo$"):
        open_frame_socket("lo", None)


def test_link_down_is_bus_down_and_the_same_socket_works_after_up(link):
    a, b = open_frame_socket(link, [exact(0x80)], receive_own=True), open_frame_socket(link, None)
    ip("set", link, "down")
    for sock in (a, b):
        assert sock.wait(0.0)  # the error makes it readable
        with pytest.raises(BusDown, match=f"{link}: the interface is down"):
            sock.receive()
        assert sock.receive() == 0  # reported once
        with pytest.raises(BusDown):
            sock.send(SYNC)
    ip("set", link, "up")
    assert a.send(SYNC)
    assert frames_of(b) == [SYNC]
    assert frames_of(a) == [SYNC]
    assert list(a.own) == [True]
    b.send(TPDO)
    assert frames_of(a) == []  # the filters have survived
    a.close()
    b.close()


def test_frames_before_link_down_are_not_lost(link):
    a, b = open_frame_socket(link, None), open_frame_socket(link, None)
    a.send(SYNC)
    a.send(TPDO)
    ip("set", link, "down")
    got = []
    for _ in range(3):
        try:
            got += frames_of(b)
        except BusDown:
            got.append("down")
    assert sorted(got, key=str) == sorted([SYNC, TPDO, "down"], key=str)
    a.close()
    b.close()


def test_a_link_that_is_down_is_reported_at_the_first_receive(link):
    ip("set", link, "down")
    sock = open_frame_socket(link, None)
    with pytest.raises(BusDown):
        sock.receive()
    ip("set", link, "up")
    assert sock.send(SYNC)
    sock.close()


def test_removed_interface_is_bus_gone_for_good(link):
    sock = open_frame_socket(link, None)
    ip("del", link)
    assert sock.wait(0.0)
    with pytest.raises(BusGone):
        _receive_past_down(sock)
    for _ in range(2):
        with pytest.raises(BusGone):
            sock.receive()
        with pytest.raises(BusGone):
            sock.send(SYNC)
    ip("add", "dev", link, "type", "vcan")
    ip("set", link, "up")
    with pytest.raises(BusGone):  # the old socket does not come back
        sock.send(SYNC)
    sock.close()
    a, b = open_frame_socket(link, None), open_frame_socket(link, None)
    a.send(SYNC)
    assert frames_of(b) == [SYNC]
    a.close()
    b.close()


def _receive_past_down(sock):
    """An interface goes down before it goes away: the socket may say both, one after the other."""
    for _ in range(3):
        try:
            sock.receive()
        except BusDown:
            pass


def test_stamps_and_filters_hold_for_29_bit_frames_under_load(link):
    wanted = 0x1ABCDEF | CAN_EFF_FLAG
    a, b = open_frame_socket(link, None), open_frame_socket(link, [exact(wanted)])
    last = 0
    for i in range(500):
        a.send(pack(wanted, bytes([i & 0xFF])))
        a.send(pack(0x1ABCDEE | CAN_EFF_FLAG))
        assert frames_of(b) == [pack(wanted, bytes([i & 0xFF]))]
        assert b.stamps_ns[0] >= last
        last = b.stamps_ns[0]
    assert b.rx_dropped == 0
    a.close()
    b.close()


def test_fd_frames_are_given_to_no_classic_socket(link):
    """The identifier is one of ours, the length that of a classic frame: it is neither read nor in the way."""
    ip("set", link, "down")
    ip("set", link, "mtu", "72")
    ip("set", link, "up")
    sock = open_frame_socket(link, [exact(0x181), exact(0x080)])
    fd_frame = struct.pack("<IB3x64s", 0x181, 8, bytes(8))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        sender.bind((link,))
        sender.send(fd_frame)
        sender.send(TPDO)
        sender.send(fd_frame)
        assert frames_of(sock) == [TPDO]
        assert frames_of(sock) == []
    assert sock.rx_dropped == 0
    sock.close()


def test_xl_frames_are_given_to_no_classic_socket(link):
    """struct canxl_frame: prio, flags (XLF and SEC), sdt, len, af, data; the shortest one is as long as a classic frame."""
    ip("set", link, "down")
    try:
        ip("set", link, "mtu", "2060")
    except subprocess.CalledProcessError:
        pytest.skip("this kernel has no CAN XL (Linux 6.2)")
    ip("set", link, "up")
    classic = open_frame_socket(link, None)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.setsockopt(socket.SOL_CAN_RAW, 7, 1)  # CAN_RAW_XL_FRAMES
        sender.bind((link,))
        for length in (1, 4, 2048):
            sender.send(struct.pack(f"<IBBHI{length}s", 0x181, 0x80, 0, length, 0, bytes(length)))
        sender.send(TPDO)
        assert frames_of(classic) == [TPDO]
    assert classic.rx_dropped == 0
    classic.close()
