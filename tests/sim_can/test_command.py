"""`jtq sim` as a process: on a unix bus, and what it says to wrong usage."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.drive import drive_tpdo1, drive_tpdo2
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.hub import Hub
from jtqd.drivers.sensor import sensor_tpdo1
from jtqd.sim_can.bench import map_pdos
from jtqd.sim_can.command import PRIORITY, main

pytestmark = pytest.mark.native


def start(bus, *arguments):
    command = [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr.readline() == f"bench ready on {bus}\n"
    return process


def end(process):
    if process.poll() is None:
        process.kill()
    process.wait()
    process.stderr.close()


@pytest.fixture
def running(tmp_path):
    bus = f"unix:{tmp_path}/bench"
    process = start(bus, "--seed", "3")
    yield bus, process
    end(process)


@pytest.fixture
def running_on_vcan():
    process = start("vcan0", "--seed", "3")
    yield "vcan0", process
    end(process)


def collect(socket, count, timeout_s=2.0):
    """Frames by identifier until `count` have come."""
    found = {}
    end = time.monotonic() + timeout_s
    while len(found) < count and time.monotonic() < end:
        if socket.wait(0.1):
            for i in range(socket.receive()):
                can_id, length, data = FRAME.unpack_from(socket.frames, 16 * i)
                found[can_id] = data[:length]
    return found


class OnBus:
    """`map_pdos` speaks to a bench; here the bench is behind a socket."""

    def __init__(self, socket):
        self.socket = socket

    def on_frame(self, can_id, data, _stamp, _now):
        self.socket.send(pack(can_id, data))
        time.sleep(0.002)


def configured(bus):
    """A socket on the bus, after the nodes got jtqd's mapping and were started."""
    socket = open_frame_socket(bus, [exact(i) for i in (0x581, 0x181, 0x281, 0x182, 0x282, 0x183)])
    socket.send(pack(0x601, bytes.fromhex("4075600000000000")))
    assert collect(socket, 1) == {0x581: bytes.fromhex("43756000401F0000")}  # 8000 mA
    map_pdos(OnBus(socket))
    time.sleep(0.1)
    while socket.wait(0.0):
        socket.receive()
    return socket


def check_syncs(socket, count):
    """Each SYNC is answered by the five TPDOs; returns the payloads of all."""
    seen = []
    for k in range(count):
        socket.send(pack(0x080, bytes([1 + k % 240])))
        found = collect(socket, 5)
        assert set(found) == {0x181, 0x281, 0x182, 0x282, 0x183}
        assert len(found[0x181]) == drive_tpdo1(1).length
        assert len(found[0x282]) == drive_tpdo2(2).length
        assert len(found[0x183]) == sensor_tpdo1(3).length
        seen.append(found)
        time.sleep(0.001)
    assert struct.unpack("<ihH", seen[-1][0x281])[2] & 0x6F == 0x27  # the demo runs
    return seen


def test_bench_answers_sdo_and_sync_on_a_unix_bus_and_leaves_in_order(running):
    bus, process = running
    socket = configured(bus)
    check_syncs(socket, 40)
    socket.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(5.0) == 0
    assert not os.path.exists(bus.removeprefix("unix:"))
    assert process.stderr.read() == ""


def test_the_bench_asks_for_the_priority_of_hardware(running):
    """Whoever starts it: beside a SCHED_FIFO jtqd on a busy machine it would answer late."""
    _, process = running
    granted = os.sched_getscheduler(process.pid), os.sched_getparam(process.pid).sched_priority
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except PermissionError:
        assert granted == (os.SCHED_OTHER, 0)
    else:
        assert granted == (os.SCHED_FIFO, PRIORITY)


def test_second_bench_joins_the_hub_of_another_process(running, tmp_path):
    bus, _ = running
    second = subprocess.run(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus, "--duration", "0.2", "--bitrate", "1000000"],
        stderr=subprocess.PIPE,
        text=True,
        timeout=20,
        check=False,
    )
    assert second.returncode == 0
    assert "already has a hub" in second.stderr


def test_bench_says_that_its_hub_has_gone(tmp_path):
    bus = f"unix:{tmp_path}/bench"
    hub = Hub(str(tmp_path / "bench"))
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 10.0
    while hub.counters.frames < 3 and time.monotonic() < deadline:  # three boot-up messages
        hub.run_once(0.1)
    hub.close()
    assert process.wait(5.0) == 1
    assert process.stderr.read().splitlines()[-1].startswith(f"jtq sim: {bus}: bus lost")
    process.stderr.close()


@pytest.mark.socketcan
def test_bench_answers_on_socketcan_and_leaves_in_order(running_on_vcan):
    bus, process = running_on_vcan
    socket = configured(bus)
    seen = check_syncs(socket, 200)
    assert len({found[0x181] for found in seen} | {found[0x183] for found in seen}) > 50  # it moves
    socket.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(5.0) == 0
    assert process.stderr.read() == ""


@pytest.mark.socketcan
def test_bench_survives_an_interface_that_goes_down_and_up(running_on_vcan):
    bus, process = running_on_vcan
    socket = configured(bus)
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
    time.sleep(0.5)
    subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
    time.sleep(0.5)
    socket.close()
    again = configured(bus)
    check_syncs(again, 3)
    again.close()
    assert process.poll() is None


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ([], 2, "--bus is missing"),
        (
            ["--bus", "unix:/no/such/folder/x"],
            1,
            "jtq sim: unix:/no/such/folder/x: the directory /no/such/folder does not exist",
        ),
        (["--bus", "nosuchcan9"], 1, "nosuchcan9"),
        (["--bus", "unix:x", "--joints", "1,2"], 2, "require --play"),
        (["--bus", "unix:x", "--joints", "1;2"], 2, "two joint numbers"),
        (["--bus", "unix:x", "--plant", "/no/plant.yaml"], 1, "/no/plant.yaml: cannot be read"),
        (["--bus", "unix:x", "--play", "/no/run.csv"], 1, "/no/run.csv: found no such file"),
        (["--bus", "unix:x", "--play", "nothere"], 1, "nothere: found no such file, expected a run file"),
        (["--bus", "unix:x", "--play", "/dev"], 1, "/dev: found a directory"),
        (["--bus", "unix:x", "--play", "/dev/zero"], 1, "/dev/zero: found something that is no file"),
        (["--bus", "unix:x", "--seed", "-1"], 2, "--seed"),
        (["--bus", "unix:x", "--duration", "inf"], 2, "--duration"),
    ],
)
def test_bad_usage_is_one_clear_line(arguments, status, message, tmp_path, monkeypatch, capsys):  # noqa: PLR0917
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == status
    said = capsys.readouterr().err.strip().splitlines()
    assert message in said[-1]
    assert not any("Traceback" in line for line in said)


def test_cost_is_printed(capsys):
    assert main(["--cost", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sync_us"] > 0


def test_child_reads_the_same_entries_as_the_parser_here():
    from jtqd.sim_can import eds_entries

    here = {
        (node, name): list(eds_entries.read_eds(eds_entries.FOLDER / name, node).entries)
        for node, name in eds_entries.files_of(2).items()
    }
    eds_entries._cache.clear()
    child = eds_entries.EdsChild()
    child.take()
    assert {key: eds_entries._cache[key] for key in here} == here


def test_entries_of_a_child_whose_output_is_cut_are_read_here():
    from jtqd.sim_can import eds_entries

    eds_entries._cache.clear()
    child = eds_entries.EdsChild()
    child.stop()
    cut = [sys.executable, "-c", "print('{', end='')"]
    child._process = subprocess.Popen(cut, stdout=subprocess.PIPE)
    child.take()
    assert eds_entries._cache == {}
    assert eds_entries.entries_of(1, eds_entries.DRIVE)


def test_bench_process_does_without_the_eds_parser(running):
    """Resident memory of the whole bench below 45 MB: canopen and python-can are not loaded."""
    _, process = running
    status = dict(line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines())
    assert int(status["VmRSS"].split()[0]) < 45_000
