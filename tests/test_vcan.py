"""The daemon and the bench on real SocketCAN, with exact time in the bench kernel: nothing is missed, nothing differs."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from daemon.estimate_pdo import decode
from sysid.joint_log import read_topic

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
CYCLES = 10_000


def run_once(directory: Path) -> tuple[dict[str, Any], list[tuple[float, int, bytes]]]:
    """10 s of jtqd against `jtq sim`; its summary, and what candump saw of SYNC and estimate."""
    directory.mkdir()
    dump = directory / "dump.log"
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory)}
    bench = subprocess.Popen(
        [sys.executable, "-m", "sim_can", "--bus", INTERFACE, "--seed", "1"],
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
                *(sys.executable, "-m", "daemon.jtqd", "--bus", INTERFACE, "--json"),
                *("--duration", str(CYCLES / 1000), "--record", str(directory / "logs")),
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
def test_ten_thousand_cycles_without_a_miss_and_twice_the_same(tmp_path: Path) -> None:
    summary, frames = run_once(tmp_path / "first")
    exact = bool(os.environ.get("JTQD_IN_BENCH_KERNEL"))
    if exact:
        assert (summary["cycles"], summary["missed"], summary["stale_inputs"]) == (CYCLES, 0, 0)
        assert summary["late_us"]["max"] <= 4.0, "guest time is exact"
        assert summary["rmse_nm"]["joint_1"] < 1.0
        assert summary["rmse_nm"]["joint_2"] < 1.0
    assert summary["recording"]["lost"] == 0
    assert summary["recording"]["cycles"] == summary["cycles"]

    # Each SYNC is followed by its own estimate before the next SYNC.
    frames.pop()  # the daemon's last word, status off
    assert [can_id for _, can_id, _ in frames] == [0x080, 0x1A0] * summary["cycles"]
    for (_, _, sync), (_, _, estimate) in zip(frames[::2], frames[1::2], strict=True):
        assert estimate[7] == sync[0]
    statuses = {decode(data).status for _, can_id, data in frames if can_id == 0x1A0}
    assert (2, 2) in statuses or (3, 3) in statuses

    # What is in the log is what was on the bus.
    with open(summary["recording"]["path"], "rb") as file:
        logged = sum(1 for _ in make_reader(file).iter_messages(topics=["/joint/1/state"]))
    assert logged == summary["cycles"]
    if exact:
        _, again = run_once(tmp_path / "second")
        again.pop()
        estimates = [data for _, can_id, data in frames if can_id == 0x1A0]
        assert estimates == [data for _, can_id, data in again if can_id == 0x1A0], "byte-identical"


@pytest.fixture
def bench() -> Iterator[None]:
    """`jtq sim` on the interface."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sim_can", "--bus", INTERFACE], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "ready" in process.stderr.readline()
    yield
    process.terminate()
    process.wait(10)


def start(tmp_path: Path, duration: str, record: str) -> subprocess.Popen[str]:
    """jtqd on the interface, with a runtime directory of its own."""
    arguments = ["--bus", INTERFACE, "--duration", duration, "--record", record, "--json"]
    return subprocess.Popen(
        [sys.executable, "-m", "daemon.jtqd", *arguments],
        env={**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.socketcan
@pytest.mark.usefixtures("bench")
def test_a_remote_frame_and_29_bit_twins_on_the_real_bus_are_only_counted(tmp_path: Path) -> None:
    daemon = start(tmp_path, "4", "none")
    dump = subprocess.run(
        ["candump", "-n", "200", f"{INTERFACE},1A0:7FF"], capture_output=True, timeout=120, check=True
    )
    assert dump.stdout
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
# In one session of eight the guest hung here, in another it stalled: not a gate until that is understood.
@pytest.mark.campaign
@pytest.mark.parametrize("harm", [signal.SIGKILL, signal.SIGSTOP])
def test_a_recorder_that_dies_or_stalls_costs_the_loop_nothing(tmp_path: Path, harm: signal.Signals) -> None:
    """Killed: another one goes on where it was. Stopped for 6 s: the ring goes round, and what is lost is counted.

    The loop misses nothing. The guest itself has been seen to stall once in a long session (255 slots, cause unknown), so a
    run with misses is repeated once: what the recorder's end costs, it would cost again.
    """
    missed = []
    for attempt in ("first", "second"):
        summary = run_with_a_harmed_recorder(tmp_path / attempt, harm)
        missed.append(summary["missed"])
        if not (os.environ.get("JTQD_IN_BENCH_KERNEL") and summary["missed"]):
            break
    if os.environ.get("JTQD_IN_BENCH_KERNEL"):
        assert missed[-1] == 0, missed
        assert (summary["cycles"], summary["stale_inputs"]) == (9000, 0)


def run_with_a_harmed_recorder(directory: Path, harm: signal.Signals) -> dict[str, Any]:
    """9 s of jtqd whose recorder is harmed in the middle; the summary, with its account checked."""
    directory.mkdir()
    daemon = start(directory, "9", str(directory / "logs"))
    subprocess.run(["candump", "-n", "1500", f"{INTERFACE},1A0:7FF"], stdout=subprocess.DEVNULL, check=True)
    recorder = recorder_of(daemon.pid)
    os.kill(recorder, harm)
    if harm == signal.SIGSTOP:
        time.sleep(6)
        os.kill(recorder, signal.SIGCONT)
    out, err = daemon.communicate(timeout=300)
    summary: dict[str, Any] = json.loads(out)
    recording = summary["recording"]
    assert recording["written"] + recording["lost"] == recording["cycles"] == summary["cycles"]
    if harm == signal.SIGKILL:
        assert daemon.returncode == 0, err
        assert "started again" in err
        assert recording["lost"] == 0
        assert [str(path) for path in (directory / "logs").glob("*.active")] == recording["left"]
        assert len(recording["left"]) == 1
    else:
        assert daemon.returncode == 3, err
        assert recording["lost"] > 0
    return summary


@pytest.mark.socketcan
@pytest.mark.usefixtures("bench")
def test_a_bus_that_goes_down_for_a_second_and_comes_back(tmp_path: Path) -> None:
    """The daemon stays, says stale while the interface is down, and is valid again without a hand."""
    daemon = start(tmp_path, "6", str(tmp_path / "logs"))
    subprocess.run(["candump", "-n", "2000", f"{INTERFACE},1A0:7FF"], stdout=subprocess.DEVNULL, check=True)
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
    down = (time_s > 2.3) & (time_s < 2.8)
    assert set(log["status"][down]) == {4}
    assert 4 not in log["status"][time_s > 4.5]


def recorder_of(pid: int) -> int:
    """Process-ID of the recorder among the daemon's children."""
    for process in Path("/proc").glob("[0-9]*"):
        parent = process.joinpath("stat").read_text().rpartition(")")[2].split()[1]
        if int(parent) == pid and b"daemon.recorder" in process.joinpath("cmdline").read_bytes():
            return int(process.name)
    raise AssertionError("no recorder")
