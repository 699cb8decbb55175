"""The flight recorder: what is written around an occurrence, what is let go, and how much memory it takes."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jtqd.daemon.recording.parts import FaultTrigger
from tests.daemon.recording.recorder_bench import (
    DEFINITIONS,
    ROOT,
    RecorderProcess,
    cycles_of,
    messages_of,
    metadata_of,
    put,
    record_of,
    session_on,
)

EVENT = DEFINITIONS["jtqd_msgs/msg/Event"].constants
STATUS = DEFINITIONS["jtqd_msgs/msg/JointEstimate"].constants
NS = 1_000_000


def feed(session, first, count, statuses=(2, 2)):
    """Cycles as the recorder's loop hands them over: a poll every 50."""
    for n in range(first, first + count):
        session.recording.add(record_of(n, statuses=statuses))
        if n % 50 == 49:
            session.poll()


@pytest.mark.parametrize("status", [pytest.param("DRIVE_FAULT", marks=pytest.mark.campaign), "INVALID"])
def test_fault_writes_the_time_before_and_after_it(tmp_path, status):
    said = []
    session = session_on(tmp_path, warn=said.append, flight_recorder_s=3.0)
    feed(session, 0, 10_000)
    assert not (tmp_path / "logs").exists()
    feed(session, 10_000, 12_000, (2, STATUS[status]))
    summary = session.finish()
    found = cycles_of(*summary["paths"])
    assert found == list(range(found[0], found[-1] + 1))
    assert 6400 <= found[0] <= 7000, "3 s and at most a chunk before"
    assert 15_000 <= found[-1] <= 15_600, "5 s and at most a chunk after"
    assert summary["flight_recordings"] == 1
    assert (summary["written"], summary["lost"]) == (len(found), 0)
    assert summary["written"] + summary["let_go"] == summary["cycles"] == 22_000
    assert metadata_of(summary["path"])["reason"] == f"joint 2: {status}"
    assert said == [f"flight recording: joint 2: {status}"]
    kinds = [event["kind"] for _, event in messages_of(summary["path"])["/events"]]
    assert EVENT["FLIGHT_SAVED"] in kinds
    assert EVENT["STATUS_CHANGED"] in kinds


def test_second_fault_in_the_time_after_prolongs_and_a_later_one_is_another_part(tmp_path):
    session = session_on(tmp_path, flight_recorder_s=2.0)
    feed(session, 0, 3000)
    feed(session, 3000, 100, (5, 2))
    feed(session, 3100, 3900)
    feed(session, 7000, 100, (2, 5))  # 4 s after the first
    feed(session, 7100, 12_900)
    feed(session, 20_000, 100, (15, 2))
    feed(session, 20_100, 2000)
    summary = session.finish()
    assert summary["flight_recordings"] == len(summary["paths"]) == 2
    first, second = (cycles_of(path) for path in summary["paths"])
    assert first[0] <= 1000
    assert 12_000 <= first[-1] <= 12_600
    assert first == list(range(first[0], first[-1] + 1))
    assert 17_400 <= second[0] <= 18_000
    assert second[-1] == 22_099, "the recorder ended while it was saving: the file is whole"


def test_what_was_written_is_not_written_again(tmp_path):
    """A fault right after the end of a recording: memory begins where the file before ended."""
    session = session_on(tmp_path, flight_recorder_s=10.0)
    feed(session, 0, 1000)
    session.save("on request")
    feed(session, 1000, 6000)
    session.save("on request")
    feed(session, 7000, 10)
    summary = session.finish()
    assert len(summary["paths"]) == 2
    assert cycles_of(*summary["paths"]) == list(range(7010))


def test_memory_is_bounded(tmp_path):
    session = session_on(tmp_path, flight_recorder_s=2.0)
    sizes = []
    for n in range(0, 20_000, 500):
        feed(session, n, 500)
        sizes.append(session._flight.memory_bytes)
    assert max(sizes[8:]) < 1.3 * sizes[5]
    assert 1.5 <= session._flight.memory_s <= 2.5
    assert session.account.written == 0
    assert session.recording.progress.let_go == session.recording.progress.cycles


def test_stale_for_longer_than_a_second():
    watch = FaultTrigger()
    stale = STATUS["STALE"]
    assert watch.changed((2, 2), 0) == ""
    assert watch.changed((2, stale), 1000 * NS) == ""
    assert watch.passed(1999 * NS) == ""
    assert watch.changed((2, 2), 1999 * NS) == "", "it was over in time"
    assert watch.passed(5000 * NS) == ""
    assert watch.changed((stale, 2), 6000 * NS) == ""
    assert watch.changed((stale, 3), 6500 * NS) == "", "the other joint's status is none of its business"
    assert watch.passed(7001 * NS) == "joint 1: STALE for more than 1 s"
    assert watch.passed(9000 * NS) == "", "once"
    assert watch.changed((5, 3), 9001 * NS) == "joint 1: DRIVE_FAULT"


def test_disk_without_room_when_it_matters_counts_what_is_lost(tmp_path):
    (tmp_path / "logs").write_text("in the way")
    session = session_on(tmp_path, flight_recorder_s=1.0)
    feed(session, 0, 2000)
    session.save("on request")
    feed(session, 2000, 3000)
    summary = session.finish()
    assert summary["path"] is None
    assert summary["lost"] >= 4000
    assert summary["written"] + summary["lost"] + summary["let_go"] == 5000


# The process -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def recorder(tmp_path):
    process = RecorderProcess(tmp_path, flight_recorder_s=1.0)
    process.wait_until_ready()
    yield process
    process.kill()


@pytest.mark.native
@pytest.mark.parametrize(
    ("number", "reason"), [(signal.SIGUSR1, "on request"), (signal.SIGUSR2, "the loop failed")]
)
def test_signal(recorder, number, reason):
    """SIGUSR1 asks; SIGUSR2 is what the supervisor sends when the loop ended in an error, right before SIGTERM."""
    recorder.paced(0, 2500, 2000)
    time.sleep(0.1)
    recorder.process.send_signal(number)
    status, summary, errors = recorder.end()
    assert (status, errors) == (0, f"recorder: flight recording: {reason}\n")
    found = cycles_of(summary["path"])
    assert 900 <= found[0] <= 1500
    assert found == list(range(found[0], 2500))
    assert metadata_of(summary["path"])["reason"] == reason


@pytest.mark.native
def test_nothing_happened(recorder):
    recorder.paced(0, 1500, 2000)
    status, summary, errors = recorder.end()
    assert (status, errors) == (0, "")
    assert (summary["path"], summary["written"], summary["let_go"], summary["lost"]) == (None, 0, 1500, 0)
    assert not recorder.output.exists()


@pytest.mark.native
def test_parent_that_goes_away_is_a_fault(tmp_path):
    process = RecorderProcess(tmp_path, flight_recorder_s=5.0)  # for its ring and request
    process.wait_until_ready()
    process.kill()
    code = f"import subprocess, time; subprocess.Popen({process.process.args!r}); time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    time.sleep(1.0)
    for n in range(100):
        put(process.ring, record_of(n))
    time.sleep(0.3)
    parent.kill()
    parent.wait()
    process.wait_for(lambda: process.files("*.mcap"))
    path = Path(process.files("*.mcap")[0])
    assert cycles_of(path) == list(range(100))
    assert metadata_of(path)["reason"] == "jtqd has ended"
