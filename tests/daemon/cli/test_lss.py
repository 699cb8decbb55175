"""`jtq lss` against an LSS slave on a hub, and `jtq control store` against a strict node of the canopen library."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from jtqd.daemon.cli import control, lss
from jtqd.drivers.filters import exact
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.hub import Hub
from tests.library_drives.lss_slave import NONE, WAITING, LssSlave
from tests.library_drives.nodes import Manners, StrictDrive

EPOS4 = (0xFB, 0x65520000, 0x01700000, 0x29001321)
OTHER = (0xFB, 0x65520000, 0x01700000, 0x29001322)
NAME = "000000FB:65520000:01700000:29001321"


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[str]:
    name = f"unix:{tmp_path / 'h'}"
    hub = Hub(str(tmp_path / "h"), None)
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            hub.run_once(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    yield name
    ended.set()
    thread.join()
    hub.close()


def open_bus(name: str) -> can.BusABC:
    return can.Bus(interface="jtq_unix", channel=name.removeprefix("unix:"))


def test_the_only_device_is_inquired_and_waits_again(bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    with LssSlave(open_bus(bus), EPOS4, node=7) as slave:
        assert lss.main(["inquire", "--bus", bus, "--single"]) == 0
        assert capsys.readouterr().out == f"{NAME}, node-ID 7\n"
        assert lss.main(["inquire", "--bus", bus, "--identity", NAME, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["node_id"] == 7
        time.sleep(0.05)
        assert slave.state == WAITING


def test_two_devices_are_told_apart_by_their_identity(bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    with LssSlave(open_bus(bus), EPOS4, node=7) as one, LssSlave(open_bus(bus), OTHER, node=8) as two:
        assert lss.main(["set-node-id", "9", "--bus", bus, "--single", "--yes"]) == 1
        assert "more than one device answers" in capsys.readouterr().err
        assert lss.main(["set-node-id", "9", "--bus", bus, "--identity", NAME, "--yes", "--store"]) == 0
        assert (one.node, one.stored) == (9, (9, 0))
        assert (two.node, two.stored) == (8, None)
        assert lss.main(["inquire", "--bus", bus, "--identity", "FB:1:2:3"]) == 1
        assert "no device with the identity" in capsys.readouterr().err


def test_a_device_without_a_node_id_is_found_by_fast_scan(
    bus: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with LssSlave(open_bus(bus), (1, 0x80000000, 0, 3)) as slave, LssSlave(open_bus(bus), EPOS4, 5):
        assert lss.main(["scan", "--bus", bus]) == 0
        assert capsys.readouterr().out == "00000001:80000000:00000000:00000003, node-ID none\n"
        assert slave.node == NONE
        assert lss.main(["set-node-id", "6", "--bus", bus, "--unconfigured", "--yes"]) == 0
        assert "node-ID 6 after NMT reset communication or a power-up (not stored)" in capsys.readouterr().out
        assert (slave.node, slave.stored) == (6, None)
        assert lss.main(["scan", "--bus", bus]) == 1
        assert "no device without a node-ID" in capsys.readouterr().err


def test_bit_rate_is_an_index_of_the_table(bus: str) -> None:
    with LssSlave(open_bus(bus), EPOS4, 7) as slave:
        assert lss.main(["set-bit-rate", "125000", "--bus", bus, "--single", "--store", "--yes"]) == 0
        assert slave.stored == (7, 4)
        assert lss.main(["store", "--bus", bus, "--single", "--yes"]) == 0


@pytest.mark.parametrize(
    ("service", "code", "line"),
    [
        (0x11, 1, "node-ID: refused with error 1 (out of range, or not supported)"),
        (0x17, 2, "store: refused with error 2 (it cannot write its memory)"),
        (0x17, 255, "store: refused with error 255 (an error of its maker's)"),
    ],
)
def test_a_refusal_is_one_line(
    bus: str, capsys: pytest.CaptureFixture[str], service: int, code: int, line: str
) -> None:
    with LssSlave(open_bus(bus), EPOS4, 7) as slave:
        slave.refuses[service] = code
        assert lss.main(["set-node-id", "9", "--bus", bus, "--single", "--store", "--yes"]) == 1
        assert capsys.readouterr().err == f"jtq lss: LSS: {line}\n"


def test_an_answer_that_is_too_short_is_none(bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    with LssSlave(open_bus(bus), EPOS4, 7) as slave:
        slave.length = 1
        assert lss.main(["inquire", "--bus", bus, "--single"]) == 1
        assert capsys.readouterr().err == "jtq lss: LSS: no LSS response received\n"


@pytest.mark.parametrize("verb", [["scan"], ["set-node-id", "9", "--single", "--yes"]])
def test_a_bus_that_ends_is_one_line(verb: list[str], tmp_path: Path) -> None:
    """Of a process of its own, as the library logs to stderr by itself."""
    hub = Hub(str(tmp_path / "h"), None)
    command = [sys.executable, "-m", "jtqd.daemon.jtq", "lss", *verb, "--bus", f"unix:{tmp_path / 'h'}"]
    done = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    heard = open_frame_socket(f"unix:{tmp_path / 'h'}", [exact(0x7E5)])
    while not heard.receive():
        hub.run_once(0.02)
    heard.close()
    hub.close()
    out, err = done.communicate(timeout=20)
    assert (done.returncode, out, err.count("\n")) == (1, "", 1), err
    assert "bus lost" in err


def test_without_yes_and_terminal_nothing_is_written(
    bus: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with LssSlave(open_bus(bus), EPOS4, 7) as slave:
        order = ["set-node-id", "9", "--bus", bus, "--single", "--store"]
        assert lss.main(order) == 2
        assert "--yes agrees" in capsys.readouterr().err
        monkeypatch.setattr("sys.stdin", Terminal("n\n"))
        assert lss.main(order) == 2
        assert capsys.readouterr().err.endswith("jtq lss: nothing was written\n")
        assert (slave.node, slave.stored) == (7, None)
        monkeypatch.setattr("sys.stdin", Terminal("y\n"))
        assert lss.main(order) == 0
        assert slave.stored == (9, 0)


class Terminal:
    def __init__(self, line: str) -> None:
        self._line = line

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        return self._line


def test_nobody_there_and_a_master_are_one_line(bus: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert lss.main(["inquire", "--bus", bus, "--single"]) == 1
    assert capsys.readouterr().err == "jtq lss: LSS: no LSS response received\n"
    assert lss.main(["inquire", "--bus", "unix:/nowhere/hub", "--single"]) == 1
    assert "Traceback" not in capsys.readouterr().err
    for command in (
        lambda: lss.main(["inquire", "--bus", bus, "--single"]),
        lambda: control.main(["store", "--bus", bus, "--node", "1", "--yes"]),
    ):
        with a_sync(bus):
            assert command() == 1
        assert "SYNC is on the bus" in capsys.readouterr().err


class a_sync:
    def __init__(self, name: str) -> None:
        self._socket = open_frame_socket(name, [])
        self._ended = threading.Event()

    def __enter__(self) -> None:
        threading.Thread(target=self._run).start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def _run(self) -> None:
        while not self._ended.wait(0.01):
            self._socket.send(pack(0x080))
        self._socket.close()


@pytest.mark.parametrize("wrong", ["1:2:3", "1:2:3:x", "1:2:3:100000000"])
def test_wrong_identity_is_usage(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        lss.main(["inquire", "--bus", "can0", "--identity", wrong])
    assert caught.value.code == 2
    assert "four hexadecimal numbers" in capsys.readouterr().err


# jtq control store --------------------------------------------------------------------------------------------------


@pytest.fixture
def drive(bus: str) -> Iterator[StrictDrive]:
    node = StrictDrive(5, lambda: open_bus(bus), Manners())
    node.power_on()
    yield node
    node.power_off()


def order(bus: str, *more: str) -> int:
    return control.main(["store", "--bus", bus, *more])


def test_what_is_stored_is_there_after_a_reset(
    bus: str, drive: StrictDrive, capsys: pytest.CaptureFixture[str]
) -> None:
    drive.node.set_data(0x1017, 0, struct.pack("<H", 100))
    assert order(bus, "--node", "5") == 2
    assert "--yes agrees" in capsys.readouterr().err
    assert reset(drive) == 0, "nothing was stored"
    drive.node.set_data(0x1017, 0, struct.pack("<H", 100))
    assert order(bus, "--node", "5", "--yes") == 0
    assert capsys.readouterr().out == f"node 5 on {bus} has stored its parameters\n"
    assert reset(drive) == 100


def reset(drive: StrictDrive) -> int:
    drive._start()
    return drive.number_of(0x1017)


def test_who_cannot_store_is_told(bus: str, drive: StrictDrive, capsys: pytest.CaptureFixture[str]) -> None:
    drive.node.object_dictionary[0x1010][1].default = 2  # by itself only
    assert order(bus, "--node", "5", "--yes") == 1
    assert "does not save on command" in capsys.readouterr().err
    assert order(bus, "--node", "6", "--yes", "--json") == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"ok": False, "error": f"node 6 does not answer on {bus}"}


@pytest.mark.parametrize("arguments", [["store"], ["store", "--bus", "can0"], ["ping", "--node", "3"]])
def test_options_of_store_belong_together(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        control.main(arguments)
    assert caught.value.code == 2
