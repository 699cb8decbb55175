"""The supervisor's side of recording: a recorder that dies again and again, and what is said of its cycles at the end."""

import os
import re
import signal
import time
from contextlib import suppress

import pytest

from jtqd.daemon.recording import launch
from jtqd.daemon.recording.launch import RecorderProcess
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import Snapshot
from tests.daemon import ring_records as rr
from tests.daemon.recording.recorder_bench import put, record_of

_SLOTS = 256


class Kept:
    """A RecorderProcess with real recorders on a ring without a loop."""

    def __init__(self, directory, capfd):
        self.ring = Ring(directory / "ring", _SLOTS, rr.RECORD_SIZE)
        self.snapshot = Snapshot(directory / "snapshot", 0.001, 0.5)
        self.children, self.capfd, self.said, self.cycles = [], capfd, "", 0
        self.logs = directory / "logs"
        self.keeper = RecorderProcess(self._child, directory)
        self.keeper.start({"ring": str(directory / "ring"), "directory": str(self.logs), "prefix": "test"})

    def _child(self, module, arguments, name):
        self.children.append(Child(module, arguments, name=name))
        return self.children[-1]

    def feed(self, count):
        for _ in range(count):
            put(self.ring, record_of(self.cycles))
            self.cycles += 1
        self.snapshot.counters[COUNTERS.index("cycles")] = self.cycles

    def until(self, pattern, timeout_s=20.0):
        """Watch as the supervisor does, until something was said."""
        end = time.monotonic() + timeout_s
        while not (found := re.search(pattern, self.said)):
            assert time.monotonic() < end, self.said
            self.keeper.watch()
            self.said += self.capfd.readouterr().err
            time.sleep(0.02)
        self.said = self.said[found.end() :]

    def wait(self):
        """Until the recorder has opened a file of its own; its process-ID."""
        pid, end = self.keeper.pid, time.monotonic() + 20.0
        while not any(f"/{name}" in _open_files(pid) for name in os.listdir(self.logs) if "active" in name):
            assert time.monotonic() < end
            time.sleep(0.01)
        return pid

    def kill(self):
        os.kill(self.wait(), signal.SIGKILL)


def _open_files(pid):
    found = ""
    for fd in os.listdir(f"/proc/{pid}/fd"):
        with suppress(FileNotFoundError):  # closed meanwhile
            found += os.readlink(f"/proc/{pid}/fd/{fd}") + "\n"
    return found


@pytest.fixture
def kept(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(launch, "_PAUSE_S", 0.0)
    monkeypatch.setattr(launch, "_STARTS", 2)
    (tmp_path / "logs").mkdir()
    made = Kept(tmp_path, capfd)
    yield made
    for child in made.children:
        child.end()


def test_one_that_dies_again_and_again_is_tried_again_after_a_long_pause_and_all_is_counted(
    kept, monkeypatch
):
    for _ in range(2):
        kept.kill()
        kept.until("jtqd: the recorder ended with exit status -9; restarted, the loop continues\n")
    kept.kill()
    kept.until("jtqd: the recorder ended with exit status -9; 3 times in a minute; the next try in 60 s\n")
    kept.feed(_SLOTS + 100)
    started = len(kept.children)
    for _ in range(3):
        kept.keeper.watch()
    assert kept.capfd.readouterr().err == "", "said once"
    assert len(kept.children) == started
    monkeypatch.setattr(launch, "_LONG_PAUSE_S", 0.0)
    kept.until("restarted, the loop")
    kept.wait()
    result = kept.keeper.end()
    assert result["cycles"] == kept.cycles == _SLOTS + 100
    assert result["written"] + result["lost"] == result["cycles"]
    assert result["lost"] in (100, 101), (
        "the ring has gone round by so many; the oldest slot is the next to be written"
    )


def test_what_came_while_no_recorder_was_there_is_lost_in_the_account(kept):
    for _ in range(2):
        kept.kill()
        kept.until("restarted, the loop")
    kept.kill()
    kept.until("the next try in 60 s")
    kept.feed(4000)
    result = kept.keeper.end()
    assert (result["cycles"], result["written"], result["lost"]) == (4000, 0, 4000)
    assert result["left"], "the file of the one that was killed is named"
