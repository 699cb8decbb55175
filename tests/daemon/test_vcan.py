"""The daemon and the bench on real SocketCAN, with exact time in the bench kernel: nothing is missed, nothing differs."""

import itertools
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.logs import read_topic
from jtqd.models.files import shipped

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
RING = 1024
"""Cycles in shared memory of a recorder that is stopped for longer."""


def run_once(directory: Path, cycles: int) -> tuple[dict[str, Any], list[tuple[float, int, bytes]]]:
    """jtqd against `jtq sim`; its summary, and what candump saw of SYNC and estimate."""
    directory.mkdir()
    dump = directory / "dump.log"
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory)}
    bench = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", INTERFACE, "--seed", "1"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert bench.stderr is not None
    assert "ready" in bench.stderr.readline()
    with open(dump, "w") as file:
        candump = subprocess.Popen(["candump", "-L", f"{INTERFACE},1A0:7FF,080:7FF"], stdout=file)
        time.sleep(0.2)
        result = subprocess.run(
            [
                *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", INTERFACE, "--json"),
                *("--duration", str(cycles / 1000), "--record", str(directory / "logs")),
            ],
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        time.sleep(0.2)
        candump.terminate()
        candump.wait()
    bench.terminate()
    assert bench.wait(10) == 0
    assert result.returncode == 0, result.stderr
    frames = []
    for line in dump.read_text().splitlines():
        stamp, _, frame = line.split()
        can_id, _, data = frame.partition("#")
        frames.append((float(stamp.strip("()")), int(can_id, 16), bytes.fromhex(data)))
    return json.loads(result.stdout), frames


@pytest.mark.socketcan
@pytest.mark.parametrize("cycles", [1500, pytest.param(10_000, marks=pytest.mark.campaign)])
def test_cycles_without_a_miss_and_twice_the_same(tmp_path: Path, cycles: int) -> None:
    summary, frames = run_once(tmp_path / "first", cycles)
    exact = bool(os.environ.get("JTQD_IN_BENCH_KERNEL"))
    if exact:
        assert (summary["cycles"], summary["missed"], summary["stale_inputs"]) == (cycles, 0, 0)
        found = {name: n for name, n in summary["counters"].items() if name.startswith("fault_") and n}
        assert found == {}, "nothing is wrong with the bench"
        assert summary["late_us"]["max"] <= 4.0, "guest time is exact"
        assert summary["rmse_nm"]["joint_1"] < 1.0
        assert summary["rmse_nm"]["joint_2"] < 1.0
    assert summary["recording"]["lost"] == 0
    assert summary["recording"]["cycles"] == summary["cycles"]

    # Each SYNC is followed by its own estimate before the next SYNC.
    frames.pop()  # the daemon's last word, status off
    assert [can_id for _, can_id, _ in frames] == [0x080, 0x1A0] * summary["cycles"]
    assert {data for _, _, data in frames[::2]} == {b""}, (
        "SYNC without a counter, as a drive expects it at power-up"
    )
    for before, after in itertools.pairwise(data[7] for _, _, data in frames[1::2]):
        assert after == before % 240 + 1
    statuses = {decode(data).status for _, can_id, data in frames if can_id == 0x1A0}
    assert (2, 2) in statuses or (3, 3) in statuses

    # What is in the log is what was on the bus.
    with open(summary["recording"]["path"], "rb") as file:
        logged = sum(1 for _ in make_reader(file).iter_messages(topics=["/joint/1/state"]))
    assert logged == summary["cycles"]
    if exact:
        _, again = run_once(tmp_path / "second", cycles)
        again.pop()
        estimates = [data for _, can_id, data in frames if can_id == 0x1A0]
        assert estimates == [data for _, can_id, data in again if can_id == 0x1A0], "byte-identical"


@pytest.fixture
def bench() -> Iterator[None]:
    """`jtq sim` on the interface."""
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", INTERFACE], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "ready" in process.stderr.readline()
    yield
    process.terminate()
    process.wait(10)


Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """`start(duration, record, *more arguments)`: jtqd on the interface, with a runtime directory of its own.

    One that a failed test leaves behind is ended: its SYNC would keep the next test's jtqd from starting.
    """
    daemons = []

    def start_one(duration: str, record: str, *more: str) -> subprocess.Popen[str]:
        arguments = ["--bus", INTERFACE, "--duration", duration, "--record", record, "--json", *more]
        daemon = subprocess.Popen(
            [sys.executable, "-m", "jtqd.daemon.jtqd", *arguments],
            env={**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        daemons.append(daemon)
        return daemon

    yield start_one
    for daemon in daemons:
        if daemon.poll() is None:
            daemon.terminate()
            daemon.communicate(timeout=30)


def wait_for_estimates(daemon: subprocess.Popen[str], count: int) -> None:
    """Until there were `count` estimates on the bus, or the daemon has ended, which fails the test.

    candump alone would wait for them for ever; in exact time the bench's heartbeats would then go on for days within
    minutes, and it would look as if the guest hung.
    """
    candump = subprocess.Popen(
        ["candump", "-n", str(count), f"{INTERFACE},1A0:7FF"], stdout=subprocess.DEVNULL
    )
    while candump.poll() is None:
        if daemon.poll() is not None:
            candump.kill()
            candump.wait()
            pytest.fail(f"jtqd ended with exit status {daemon.returncode}: {daemon.communicate()[1]}")
        time.sleep(0.01)
    assert candump.returncode == 0


@pytest.mark.socketcan
@pytest.mark.usefixtures("bench")
def test_a_remote_frame_and_29_bit_twins_on_the_real_bus_are_only_counted(start: Start) -> None:
    daemon = start("1", "none")
    wait_for_estimates(daemon, 200)
    for frame in ("00000181#0011223344556677", "181#R", "181#00112233", "182#", "00000080#00"):
        subprocess.run(["cansend", INTERFACE, frame], check=True)
    out, err = daemon.communicate(timeout=120)
    assert daemon.returncode == 0, err
    summary = json.loads(out)
    assert summary["counters"]["rejected_frames"] == 5
    assert summary["counters"]["foreign_sync"] == 0
    assert summary["counters"]["published"] == summary["cycles"]


def test_layout_of_can_frame() -> None:
    """candump, the hub and AF_CAN agree on one struct; this is the host's byte order that all of it relies on."""
    assert struct.pack("<I", 0x181) == (0x181).to_bytes(4, sys.byteorder)


@pytest.mark.socketcan
@pytest.mark.usefixtures("bench")
@pytest.mark.parametrize(
    "harm",
    [
        pytest.param(signal.SIGKILL, marks=pytest.mark.campaign, id="killed"),
        pytest.param(signal.SIGSTOP, id="stopped"),
    ],
)
def test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing(
    tmp_path: Path, start: Start, harm: signal.Signals
) -> None:
    """Killed: another one goes on where it was. Stopped for 1.5 s: the ring goes round, and what is lost is counted."""
    logs = tmp_path / "logs"
    text = (
        shipped("bench.yaml")
        .read_text()
        .replace("file: trained/", f"file: {shipped('bench.yaml').parent}/trained/")
    )
    lines = [line for line in text.splitlines() if not line.startswith("recording:")]
    config = tmp_path / "config.yaml"
    config.write_text("\n".join([*lines, f"recording: {{ring_cycles: {RING}}}", ""]))
    daemon = start("3", str(logs), "--config", str(config))
    wait_for_estimates(daemon, 500)
    recorder = recorder_of(daemon.pid)
    os.kill(recorder, harm)
    if harm == signal.SIGSTOP:
        time.sleep(1.5)
        os.kill(recorder, signal.SIGCONT)
    out, err = daemon.communicate(timeout=300)
    summary = json.loads(out)
    if os.environ.get("JTQD_IN_BENCH_KERNEL"):
        assert (summary["cycles"], summary["missed"], summary["stale_inputs"]) == (3000, 0, 0)
    recording = summary["recording"]
    assert recording["written"] + recording["lost"] == recording["cycles"] == summary["cycles"]
    if harm == signal.SIGKILL:
        assert daemon.returncode == 0, err
        assert "restarted, the loop continues" in err
        assert recording["lost"] == 0
        assert recording["left"] == [], "what the first one left was repaired"
        assert "repaired" in err
        cycles = [read_topic(Path(path), "/joint/1/state")["cycle"] for path in recording["paths"]]
        assert len(cycles) == 2
        assert set(range(3000)) == {int(cycle) for part in cycles for cycle in part}
    else:
        assert daemon.returncode == 3, err
        assert 0 < recording["lost"] <= 1500


@pytest.mark.socketcan
@pytest.mark.usefixtures("bench")
def test_a_bus_that_goes_down_for_a_second_and_comes_back(tmp_path: Path, start: Start) -> None:
    """The daemon stays, says stale while the interface is down, and is valid again without a hand."""
    daemon = start("4", str(tmp_path / "logs"))
    wait_for_estimates(daemon, 300)
    subprocess.run(["ip", "link", "set", INTERFACE, "down"], check=True)
    time.sleep(1)
    subprocess.run(["ip", "link", "set", INTERFACE, "up"], check=True)
    out, err = daemon.communicate(timeout=300)
    assert daemon.returncode == 0, err
    summary = json.loads(out)
    assert summary["error"] is None
    assert summary["counters"]["bus_errors"] > 0
    log = read_topic(Path(summary["recording"]["path"]), "/joint/1/state")
    time_s = (log["sync_monotonic_ns"] - log["sync_monotonic_ns"][0]) * 1e-9
    down = (time_s > 0.6) & (time_s < 1.1)
    assert set(log["status"][down]) == {4}
    assert 4 not in log["status"][time_s > 2.8]


@pytest.mark.socketcan
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_a_fifo_loop_that_runs_at_every_tick_is_not_throttled() -> None:
    """The bench kernel's scheduler counts in ticks of 10 ms, and would take this loop for one that takes all of the time."""
    period_ns, tick_ns = 1_000_000, 10_000_000
    late_ns = []
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80))
    try:
        next_tick_ns = (time.monotonic_ns() // tick_ns + 2) * tick_ns
        slot_ns = next_tick_ns - 2_000  # at work from 2 us before each tick ...
        for _ in range(3000):
            time.sleep(max(slot_ns - time.monotonic_ns(), 0) * 1e-9)
            late_ns.append(time.monotonic_ns() - slot_ns)
            while time.monotonic_ns() < slot_ns + 4_000:  # ... to 2 us after it
                pass
            slot_ns += period_ns
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    assert max(late_ns) < 2_000


def recorder_of(pid: int) -> int:
    """Process-ID of the recorder among the daemon's children."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            parent = process.joinpath("stat").read_text().rpartition(")")[2].split()[1]
            if (
                int(parent) == pid
                and b"jtqd.daemon.recording.recorder" in process.joinpath("cmdline").read_bytes()
            ):
                return int(process.name)
    raise AssertionError("no recorder")
