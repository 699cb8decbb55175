"""Lines for the operator: their priorities in the journal, and that none of them comes without end."""

import io
import os
from pathlib import Path

from jtqd.daemon.shared.log_lines import BURST, ERROR, NOTICE, WARNING, WINDOW_S, OperatorLog, in_journal


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_on_a_terminal_a_line_names_the_program() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=False)
    assert log("not granted: memory lock", WARNING)
    assert stream.getvalue() == "jtqd: not granted: memory lock\n"


def test_in_the_journal_each_line_has_its_priority() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=True)
    log("one\ntwo", ERROR)
    log("three", NOTICE)
    assert stream.getvalue() == "<3>one\n<3>two\n<5>three\n"


def test_each_kind_is_limited_by_itself_and_what_was_held_back_is_counted() -> None:
    stream, clock = io.StringIO(), Clock()
    log = OperatorLog(stream, journal=False, clock=clock)
    said = [log(f"lost {n}", WARNING, "joint 1") for n in range(100)]
    assert said == [True] * BURST + [False] * (100 - BURST)
    assert log("lost", WARNING, "joint 2"), "another kind is not held back for it"
    clock.now += WINDOW_S
    assert log("back", WARNING, "joint 1")
    last = stream.getvalue().splitlines()[-1]
    assert last == f"jtqd: back ({100 - BURST} similar lines were suppressed)"


def test_errors_and_lines_without_a_kind_always_come() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=False, clock=Clock())
    for _ in range(50):
        assert log("failed", ERROR, "reload")
        assert log("summary")
    assert len(stream.getvalue().splitlines()) == 100


def test_a_reader_that_has_gone_is_no_reason_to_end() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as stream:
        OperatorLog(stream, journal=False)("anybody there?")
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def test_the_journal_is_known_by_device_and_inode(tmp_path: Path) -> None:
    path = tmp_path / "stream"
    with open(path, "w") as stream:
        found = path.stat()
        assert in_journal(stream, {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"})
        assert not in_journal(stream, {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino + 1}"})
        assert not in_journal(stream, {})
    assert not in_journal(io.StringIO(), {"JOURNAL_STREAM": "1:2"})
