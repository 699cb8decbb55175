"""Frame sockets on a unix bus: what is not there, the end of the hub, the full queue, descriptors."""

import os
import re
import socket
import stat
from pathlib import Path

import pytest

from jtqd.drivers.bus_socket import reachable
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import BusError, BusGone, open_frame_socket
from jtqd.drivers.hub import Hub

SYNC = pack(0x080, b"\x01")
TPDO = pack(0x181, bytes(range(8)))


def test_missing_bus_is_one_line_with_what_to_do(tmp_path):
    bus = f"unix:{tmp_path}/none"
    with pytest.raises(BusError) as caught:
        open_frame_socket(bus, None)
    assert str(caught.value) == f"no bus at {bus}: start one with `jtq sim --bus {bus}`"


@pytest.mark.parametrize("make", [lambda bus: open_frame_socket(f"unix:{bus}", None), Hub])
def test_missing_directory_is_named_by_member_and_hub(tmp_path, make):
    file = tmp_path / "file"
    file.touch()
    for directory, why in ((tmp_path / "none", "does not exist"), (file, "is not a directory")):
        with pytest.raises(BusError) as caught:
            make(f"{directory}/bus")
        assert str(caught.value) == f"unix:{directory}/bus: the directory {directory} {why}"


def test_dead_socket_file_and_wrong_files_are_named(tmp_path):
    dead = tmp_path / "dead"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.bind(str(dead))
    with pytest.raises(BusError, match="no bus at"):
        open_frame_socket(f"unix:{dead}", None)
    stream = tmp_path / "stream"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.bind(str(stream))
        sock.listen()
        with pytest.raises(BusError, match="not a frame hub"):
            open_frame_socket(f"unix:{stream}", None)
    with pytest.raises(BusError, match="not a frame hub"):
        open_frame_socket(f"unix:{tmp_path}/{'x' * 200}", None)
    with pytest.raises(BusError, match="path must follow"):
        open_frame_socket("unix:", None)


def test_end_of_the_hub_is_bus_gone_after_the_last_frame(tmp_path):
    hub = Hub(str(tmp_path / "bus"))
    a = open_frame_socket(f"unix:{tmp_path}/bus", None)
    port = hub.attach(lambda _frame, _stamp: None)
    hub.run_once(0)
    port.send(SYNC)
    hub.close()
    assert a.wait(0.0)
    assert received_until_gone(a) == [SYNC]
    for _ in range(2):
        with pytest.raises(BusGone):
            a.receive()
        with pytest.raises(BusGone):
            a.send(SYNC)
    a.close()
    a.close()


def received_until_gone(sock):
    frames = []
    try:
        while n := sock.receive():
            frames += [bytes(sock.frames[16 * i : 16 * i + 16]) for i in range(n)]
    except BusGone:
        return frames
    raise AssertionError("the end was not seen")


def test_full_transmit_queue_is_counted_not_waited_for(tmp_path):
    hub = Hub(str(tmp_path / "bus"))
    a = open_frame_socket(f"unix:{tmp_path}/bus", None)
    b = open_frame_socket(f"unix:{tmp_path}/bus", None)
    hub.run_once(0)
    sent = sum(a.send(TPDO) for _ in range(5000))  # the hub does not run
    assert 100 < sent < 5000
    assert a.tx_dropped == 5000 - sent
    got = 0
    while True:
        hub.run_once(0)
        n = b.receive()
        if not n:
            break
        got += n
    assert got == sent
    assert a.send(TPDO)
    a.close()
    b.close()
    hub.close()


def test_frames_sent_before_the_hub_ended_are_received_although_ours_were_unread(tmp_path):
    """The unread frame makes the kernel say ECONNRESET first."""
    hub = Hub(str(tmp_path / "bus"))
    a = open_frame_socket(f"unix:{tmp_path}/bus", None)
    hub.run_once(0)
    hub.attach(lambda _frame, _stamp: None).send(SYNC)
    a.send(TPDO)
    hub.close()
    assert a.receive() == 0
    assert received_until_gone(a) == [SYNC]
    a.close()


def test_the_hubs_count_of_lost_frames_wraps(tmp_path):
    """Bytes 6 and 7: modulo 65536; the echo bit beside it is no part of the count, and neither is left in the frame."""
    path = str(tmp_path / "bus")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as hub:
        hub.bind(path)
        hub.listen()
        a = open_frame_socket(f"unix:{path}", None, receive_own=True)
        with hub.accept()[0] as other:
            for lost, echo in ((0, 1), (65530, 0), (65530, 1), (65540, 1), (131072, 0), (131073, 0)):
                other.send(SYNC[:5] + bytes([echo]) + (lost & 0xFFFF).to_bytes(2, "little") + SYNC[8:])
                assert a.receive() == 1
                assert a.rx_dropped == lost
                assert list(a.own) == [bool(echo)]
                assert bytes(a.frames[:16]) == SYNC
            for lost in (131074, 131080):  # two in one call
                other.send(SYNC[:6] + (lost & 0xFFFF).to_bytes(2, "little") + SYNC[8:])
            assert a.receive() == 2
            assert a.rx_dropped == 131080
            a.send(SYNC)
            assert other.recv(64) == SYNC[:5] + b"\x01" + SYNC[6:], "asks for the echo"
        a.close()


def test_repeated_opening_leaks_no_descriptor(tmp_path):
    hub = Hub(str(tmp_path / "bus"))
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(50):
        open_frame_socket(f"unix:{tmp_path}/bus", None).close()
        hub.run_once(0)
        hub.run_once(0)
        with pytest.raises(BusError):
            open_frame_socket(f"unix:{tmp_path}/none", None)
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    hub.close()


def deep(directory: Path) -> Path:
    """A directory whose path alone is longer than what the kernel takes as an address."""
    path = directory / ("d" * 90) / ("e" * 90)
    path.mkdir(parents=True)
    assert len(os.fsencode(path)) > 107, "sun_path (unix(7))"
    return path


def test_a_bus_in_a_deep_directory(tmp_path):
    path = deep(tmp_path) / "bus"
    bus = f"unix:{path}"
    held = len(os.listdir("/proc/self/fd"))
    hub = Hub(str(path))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(BusError, match=re.escape(f"{bus}: another hub is running there")):
        Hub(str(path))
    one, two = open_frame_socket(bus, None), open_frame_socket(bus, None)
    for _ in range(3):
        hub.run_once(0.0)
    one.send(SYNC)
    hub.run_once(0.1)
    assert two.wait(1.0)
    assert two.receive() == 1
    for each in (one, two, hub):
        each.close()
    assert not path.exists()
    assert len(os.listdir("/proc/self/fd")) == held, "no descriptor of the directory stays open"


def test_a_socket_file_of_a_dead_hub_in_a_deep_directory_is_replaced(tmp_path):
    path = deep(tmp_path) / "bus"
    with reachable(path) as address, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.bind(address)
    Hub(str(path)).close()
    assert not path.exists()
    with pytest.raises(BusError, match="no bus at"):
        open_frame_socket(f"unix:{path}", None)
    with pytest.raises(BusError, match="does not exist"):
        open_frame_socket(f"unix:{path.parent}/none/bus", None)
    with pytest.raises(BusError, match="does not exist"):
        Hub(f"{path.parent}/none/bus")
