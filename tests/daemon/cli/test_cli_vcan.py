"""`jtq status`, `check` and `doctor` on real SocketCAN, beside a running daemon and without one."""

import io
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.jtq import main
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.frame_socket import open_frame_socket

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
EXACT = bool(os.environ.get("JTQD_IN_BENCH_KERNEL"))
pytestmark = pytest.mark.socketcan


@pytest.fixture
def bench() -> Iterator[None]:
    """`jtq sim` on the interface."""
    with process("-m", "jtqd.sim_can", "--bus", INTERFACE) as sim:
        assert sim.stderr is not None
        assert "ready" in sim.stderr.readline()
        yield


@contextmanager
def process(*arguments: str, **environment: str) -> Iterator["subprocess.Popen[str]"]:
    started = subprocess.Popen(
        [sys.executable, *arguments],
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield started
    finally:
        started.terminate()
        started.communicate(timeout=30)


@contextmanager
def daemon(runtime: Path) -> Iterator["subprocess.Popen[str]"]:
    """jtqd on the interface, once its estimates are on the bus."""
    record = str(runtime / "logs")
    with process(
        *("-m", "jtqd.daemon.jtqd", "--bus", INTERFACE, "--record", record), RUNTIME_DIRECTORY=str(runtime)
    ) as started:
        until = time.monotonic() + 60
        while cycles(runtime) < 200:
            assert started.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        yield started


def cycles(runtime: Path) -> int:
    for path in runtime.glob("*/snapshot"):
        return SnapshotReader(path).read().counters["cycles"]
    return 0


def jtq(*arguments: str, runtime: Path) -> tuple[int, dict[str, Any], str]:
    """Exit status, JSON (empty where there is none) and standard error of one command."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setenv("RUNTIME_DIRECTORY", str(runtime))
        patch.setenv("COLUMNS", "120")
        status = main(list(arguments))
    printed, reported = out.getvalue(), err.getvalue()
    content = json.loads(printed) if printed.startswith("{") else {}
    return status, content, reported + ("" if content else printed)


def check(*arguments: str, runtime: Path) -> tuple[int, dict[str, Any], str]:
    """`jtq check` where no jtqd runs: in a process of its own, whose SCHED_FIFO all that pytest starts would inherit."""
    done = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "check", *arguments, "--bus", INTERFACE, "--json"],
        env={**os.environ, "RUNTIME_DIRECTORY": str(runtime)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return done.returncode, json.loads(done.stdout or "{}"), done.stderr


def levels(content: dict[str, Any]) -> dict[str, str]:
    return {each["item"]: each["level"] for each in content["items"]}


def test_status_of_a_running_daemon_and_of_one_whose_loop_stands_still(tmp_path: Path, bench: None) -> None:
    with daemon(tmp_path):
        code, seen, _ = jtq("status", "--json", "--bus", INTERFACE, runtime=tmp_path)
        assert code == 0
        assert seen["state"] == "running"
        assert {joint["status"] for joint in seen["joints"]} <= {
            "valid",
            "degraded",
            "standstill",
            "starting",
        }
        assert [node["state"] for node in seen["nodes"]] == ["operational"] * 3
        assert len(seen["inputs"]) == 5
        if EXACT:
            assert seen["counters"]["missed"] == 0
            assert max(each["age_s"] for each in seen["inputs"]) <= 0.008
            assert max(node["heartbeat_age_s"] for node in seen["nodes"]) < 0.15
            assert seen["bus_load"]["now"] == pytest.approx(0.845, abs=0.002)
        assert seen["recorder"]["lost"] == 0
        assert seen["recorder"]["path"].endswith(".mcap.active")

        loop = int(struct.unpack_from("<Q", next(tmp_path.glob("*/snapshot")).read_bytes(), 8)[0])
        os.kill(loop, signal.SIGSTOP)
        time.sleep(0.3)
        code, seen, _ = jtq("status", "--json", runtime=tmp_path)
        assert code == 3
        assert seen["state"] == "still"
        assert f"the loop (process {loop}) is stopped (SIGSTOP): no cycle for " in seen["why"]
        assert [joint["torque_nm"] for joint in seen["joints"]] == [None, None], "an old number is none"
        os.kill(loop, signal.SIGCONT)
        before = cycles(tmp_path)
        time.sleep(0.2)
        assert cycles(tmp_path) > before, "looking has not hurt it"


def test_check_beside_a_daemon_listens_and_finds_what_does_not_belong(tmp_path: Path, bench: None) -> None:
    with daemon(tmp_path):
        code, seen, printed = jtq("check", "0.5", "--bus", INTERFACE, "--json", runtime=tmp_path)
        assert seen, printed
        if EXACT:
            assert (code, seen["result"]) == (0, "GOOD"), seen
            texts = {each["item"]: each["text"] for each in seen["items"]}
            assert texts["SYNC"].startswith("1000.0 per s, expected 1000")
            assert "; 0 of " in texts["jtqd's timing"]
        code, _, printed = jtq("check", "1", "--bus", INTERFACE, "--drive-sync", runtime=tmp_path)
        assert code == 1
        assert printed.startswith(f"jtq check: jtqd runs on {INTERFACE} (process ")

        with process("-c", SPOILER, INTERFACE):
            code, seen, _ = jtq("check", "0.5", "--bus", INTERFACE, "--json", runtime=tmp_path)
        found = levels(seen)
        texts = {each["item"]: each["text"] for each in seen["items"]}
        assert code == 1
        assert found["foreign frames"] == "FAIL"
        assert "355h" in texts["foreign frames"]
        assert "00000181h (29 bit)" in texts["foreign frames"]
        assert found["error frames"] == "FAIL"
        assert "bus-off" in texts["error frames"]


SPOILER = """
import sys, time
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import open_frame_socket
socket = open_frame_socket(sys.argv[1], [])
until = time.monotonic() + 60
while time.monotonic() < until:
    socket.send(pack(0x355, bytes(4)))                   # nobody's
    socket.send(pack(0x181 | 0x80000000, bytes(8)))      # an input's number in 29 bits
    socket.send(bytes.fromhex("40000020 08000000 0000000000000000"))  # the driver's message of a bus-off
    time.sleep(0.01)
"""


def test_check_drives_the_bus_where_nobody_else_does(tmp_path: Path, bench: None) -> None:
    code, seen, _ = check("0.2", runtime=tmp_path)
    assert code == 1, "no SYNC"
    assert levels(seen)["SYNC"] == "FAIL"
    code, seen, printed = check("0.5", "--drive-sync", runtime=tmp_path)
    assert seen, printed
    found = levels(seen)
    assert found["boot"] == "GOOD"
    assert {"SYNC echo", "181h drive 1 TPDO1", "183h sensor 3 channel 1", "success rate"} <= found.keys()
    if EXACT:
        assert set(found.values()) == {"GOOD"}, seen
        assert code == 0
    time.sleep(0.2)
    socket = open_frame_socket(INTERFACE, None)
    time.sleep(0.5)
    heard = [bytes(socket.frames[16 * n : 16 * n + 16]) for n in range(socket.receive())]
    socket.close()
    heartbeats = {(int.from_bytes(each[:4], "little"), each[8]) for each in heard if each[1] == 0x07}
    assert heartbeats == {(0x701, 0x7F), (0x702, 0x7F), (0x703, 0x7F)}, "left pre-operational"
    others = {int.from_bytes(each[:4], "little") for each in heard if each[1] != 0x07}
    assert others <= {0x081, 0x082}, "and silent, but for the drives' word that their master has gone"

    # A foreign SYNC producer: this check does not become the second one.
    with process("-c", FOREIGN_SYNC, INTERFACE):
        time.sleep(0.5)
        code, _, printed = check("1", "--drive-sync", runtime=tmp_path)
    assert code == 1
    assert printed.startswith(f"jtq check: another node sends SYNC on {INTERFACE}")


FOREIGN_SYNC = """
import sys, time
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import open_frame_socket
socket = open_frame_socket(sys.argv[1], [])
until = time.monotonic() + 60
while time.monotonic() < until:
    socket.send(pack(0x080, bytes(1)))
    time.sleep(0.01)
"""


def test_doctor_knows_the_interface(tmp_path: Path) -> None:
    _, seen, _ = jtq("doctor", "--bus", INTERFACE, "--json", runtime=tmp_path)
    found = levels(seen)
    texts = {each["item"]: each["text"] for each in seen["items"]}
    assert found["SocketCAN"] == "GOOD"
    assert (found[INTERFACE], texts[INTERFACE]) == ("GOOD", "up, vcan")
    assert found[f"{INTERFACE} queue"] == "GOOD"
    assert found["joint 1"] == found["joint 2"] == found["packages"] == "GOOD"
    if not EXACT:
        return
    for command in (["down"], ["txqueuelen", "10"]):
        subprocess.run(["ip", "link", "set", INTERFACE, *command], check=True)
    try:
        code, seen, _ = jtq("doctor", "--bus", INTERFACE, "--json", runtime=tmp_path)
    finally:
        subprocess.run(["ip", "link", "set", INTERFACE, "up", "txqueuelen", "1000"], check=True)
    assert code == 1
    assert levels(seen)[INTERFACE] == "FAIL"
    assert levels(seen)[f"{INTERFACE} queue"] == "WARN"
