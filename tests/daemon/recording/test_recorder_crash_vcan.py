"""What happens to the recorder costs the loop nothing: jtqd on real SocketCAN, in exact time, with missed slots counted."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from jtqd.daemon.recording.run_files import part_files
from jtqd.daemon.shared.cycle_record import RingReader, layout_of
from jtqd.models.files import shipped
from tests.daemon.recording.recorder_bench import cycles_of, messages_of
from tests.daemon.test_vcan import INTERFACE, recorder_of, wait_for_estimates

PREFIX = f"jtqd-{INTERFACE}"
EXACT = bool(os.environ.get("JTQD_IN_BENCH_KERNEL"))
HOUR_NS = 3600 * 10**9


@pytest.fixture(autouse=True)
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


class Daemon:
    """jtqd on the interface with a runtime directory and a `recording` section of its own."""

    def __init__(self, directory: Path, duration_s: float, logs: Path, recording: str) -> None:
        self.directory = directory
        text = shipped("bench.yaml").read_text()
        text = text.replace("file: trained/", f"file: {shipped('bench.yaml').parent}/trained/")
        lines = [line for line in text.splitlines() if not line.startswith("recording:")]
        config = directory / "config.yaml"
        config.write_text("\n".join([*lines, f"recording: {{{recording}}}", ""]))
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", INTERFACE, "--config", str(config)),
                *("--duration", str(duration_s), "--record", str(logs), "--json"),
            ],
            env={**os.environ, "RUNTIME_DIRECTORY": str(directory)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self):
        """(exit status, summary, stderr)."""
        out, err = self.process.communicate(timeout=300)
        return self.process.returncode, json.loads(out), err

    def cycles(self) -> int:
        """Cycles that the loop has run."""
        (ring,) = self.directory.glob("*/ring")
        reader = RingReader(ring, layout_of(2, True).size)
        return reader.position + reader.backlog


@pytest.fixture
def start(tmp_path):
    """`start(duration, logs, recording)`; what a failed test leaves behind is ended."""
    started = []

    def start_one(duration_s: float, logs: Path, recording: str) -> Daemon:
        started.append(Daemon(tmp_path, duration_s, logs, recording))
        return started[-1]

    yield start_one
    for daemon in started:
        if daemon.process.poll() is None:
            daemon.process.terminate()
            daemon.process.communicate(timeout=30)


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 12 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    if os.geteuid():
        pytest.skip("needs root to mount a file system")
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "none", str(place)], check=True)
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def check_loop(summary) -> None:
    recording = summary["recording"]
    assert recording["written"] + recording["lost"] == recording["cycles"] == summary["cycles"]
    if EXACT:
        assert (summary["missed"], summary["stale_inputs"]) == (0, 0)


@pytest.mark.socketcan
@pytest.mark.campaign  # natively in test_recorder_crash and test_recorder_flight
def test_full_disk(start, small_disk) -> None:
    """Full for 2 s in the middle: two whole parts, what is between them is counted, the loop does not notice."""
    daemon = start(9, small_disk / "logs", "reserve_mb: 4, chunk_s: 0.2")
    wait_for_estimates(daemon.process, 2000)
    filler = small_disk / "filler"
    filler.write_bytes(bytes(8_500_000))
    time.sleep(2)
    filler.unlink()
    status, summary, err = daemon.end()
    check_loop(summary)
    recording = summary["recording"]
    assert status == 3
    assert 1000 <= recording["lost"] <= 2000 + 1000
    assert "recording pauses: " in err
    assert "recording continues in part 2" in err
    assert len(recording["paths"]) == 2
    assert recording["left"] == []
    assert len(set(cycles_of(*recording["paths"]))) == recording["written"]


@pytest.mark.socketcan
@pytest.mark.campaign  # natively in test_recorder_crash and test_recorder_flight
def test_everything_is_killed_and_the_next_start_repairs(start, tmp_path) -> None:
    """kill -9 of supervisor, loop and recorder at once: of the first run at most 1 s is missing, and it opens."""
    logs = tmp_path / "logs"
    daemon = start(60, logs, "rotate_s: 2")
    wait_for_estimates(daemon.process, 3300)
    family = [daemon.process.pid, *children_of(daemon.process.pid)]
    assert recorder_of(daemon.process.pid) in family
    ran = daemon.cycles()
    for pid in family:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    daemon.process.communicate()
    left = [each for each in part_files(logs, PREFIX) if each.active]
    assert len(left) == 1
    time.sleep(1)
    second = start(4, logs, "rotate_s: 2")
    status, summary, err = second.end()
    assert status == 0, err
    check_loop(summary)
    assert f"{left[0].path.with_suffix('').name} repaired" in err
    files = part_files(logs, PREFIX)
    assert not any(each.active for each in files)
    first = [each.path for each in files if each.run == left[0].run]
    assert len(first) >= 2
    found = cycles_of(*first)
    assert len(found) == len(set(found))
    assert ran - 1000 <= len(found) <= ran + 100


def children_of(pid: int) -> list[int]:
    """Process-IDs of the children."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            if int(process.joinpath("stat").read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(process.name))
    return found


@pytest.mark.socketcan
@pytest.mark.skipif(not EXACT, reason="sets the clock")
def test_clock_is_set_back_and_forward_by_an_hour(start, tmp_path) -> None:
    """CLOCK_REALTIME itself is set while it runs: no slot is missed, no cycle is lost, parts are as long as ever."""
    daemon = start(3, tmp_path / "logs", "rotate_s: 1")
    wait_for_estimates(daemon.process, 600)
    for step in (-HOUR_NS, 2 * HOUR_NS, -HOUR_NS):
        time.clock_settime_ns(time.CLOCK_REALTIME, time.clock_gettime_ns(time.CLOCK_REALTIME) + step)
        time.sleep(0.7)
    status, summary, err = daemon.end()
    assert status == 0, err
    check_loop(summary)
    paths = summary["recording"]["paths"]
    assert summary["recording"]["lost"] == 0
    found = messages_of(*paths)
    assert [message["cycle"] for _, message in found["/joint/1/state"]] == list(range(summary["cycles"]))
    assert len(paths) == 3
    stamps = [stamp for stamp, _ in found["/joint/1/state"]]
    steps = [round((b - a) / HOUR_NS) for a, b in pairwise(stamps) if abs(b - a) > 10**9]
    assert steps == [-1, 2, -1]
    # Nothing is said of the estimates: the emulated plant lives by the stamps of SYNC, and jumps with the clock.


@pytest.mark.socketcan
@pytest.mark.campaign  # natively in test_recorder_crash and test_recorder_flight
def test_flight_recording_of_a_lost_drive(start, tmp_path) -> None:
    """Flight recorder: the interface goes down for 2 s; what was before is in a file, and nothing else."""
    daemon = start(14, tmp_path / "logs", "flight_recorder_s: 2")
    wait_for_estimates(daemon.process, 3000)
    assert not list((tmp_path / "logs").iterdir())
    subprocess.run(["ip", "link", "set", INTERFACE, "down"], check=True)
    time.sleep(2)
    subprocess.run(["ip", "link", "set", INTERFACE, "up"], check=True)
    _, summary, err = daemon.end()
    recording = summary["recording"]
    assert recording["written"] + recording["let_go"] == recording["cycles"] == summary["cycles"]
    assert recording["flight_recordings"] == len(recording["paths"]) == 1
    assert "flight recording: joint 1: STALE for more than 1 s" in err
    found = cycles_of(*recording["paths"])
    assert found == list(range(found[0], found[-1] + 1))
    assert found[0] > 500
    assert 5000 <= len(found) <= 2100 + 600 + 5600
