"""Events: priorities and limits of the lines for the operator; order and losses of the notices in shared memory."""

import io
import os
from pathlib import Path

import pytest

from jtqd.daemon.shared import events
from jtqd.daemon.shared.events import (
    BURST,
    WINDOW_S,
    Notices,
    NoticesReader,
    OperatorLog,
    Priority,
    in_journal,
)
from jtqd.daemon.shared.runtime_dir import SharedMemoryError


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_on_a_terminal_a_line_names_the_program() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=False)
    assert log("not granted: memory lock", Priority.WARNING)
    assert stream.getvalue() == "jtqd: not granted: memory lock\n"


def test_in_the_journal_each_line_has_its_priority() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=True)
    log("one\ntwo", Priority.ERROR)
    log("three", Priority.NOTICE)
    assert stream.getvalue() == "<3>one\n<3>two\n<5>three\n"


def test_each_kind_is_limited_by_itself_and_suppressed_lines_are_counted() -> None:
    stream, clock = io.StringIO(), Clock()
    log = OperatorLog(stream, journal=False, clock=clock)
    written = [log(f"lost {n}", Priority.WARNING, "joint 1") for n in range(100)]
    assert written == [True] * BURST + [False] * (100 - BURST)
    assert log("lost", Priority.WARNING, "joint 2"), "another kind is not limited with it"
    clock.now += WINDOW_S
    assert log("back", Priority.WARNING, "joint 1")
    last = stream.getvalue().splitlines()[-1]
    assert last == f"jtqd: back ({100 - BURST} similar lines were suppressed)"


def test_errors_and_lines_without_a_kind_always_come() -> None:
    stream = io.StringIO()
    log = OperatorLog(stream, journal=False, clock=Clock())
    for _ in range(50):
        assert log("failed", Priority.ERROR, "recorder")
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


def test_notices_reach_a_reader_in_order_and_the_overwritten_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "notices"
    notices = Notices(path, capacity=8)
    reader = NoticesReader(path)
    assert reader.read() == ([], 0)
    notices.add(events.WARNING, "emcy", 3, "node 3: EMCY 8130h")
    (notice,), lost = reader.read()
    assert notice == (1, notice.realtime_ns, events.WARNING, 3, "emcy", "node 3: EMCY 8130h")
    assert (lost, reader.read()) == (0, ([], 0))
    for n in range(20):
        notices.add(events.WARNING, "t" * 40, 0, f"{n} " + "é" * 300)
    news, lost = reader.read()
    assert [each.number for each in news] == list(range(14, 22))
    assert lost == 12
    assert news[-1].text.startswith("19 é")
    assert len(news[-1].text.encode()) <= 212
    assert len(news[-1].topic) == 20
    assert path.stat().st_mode & 0o007 == 0, "not for everybody"


@pytest.mark.parametrize("content", [None, b"", b"x" * 10, bytes(32), bytes(1000)])
def test_another_file_is_refused(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "n").write_bytes(content)
    with pytest.raises(SharedMemoryError):
        NoticesReader(tmp_path / "n")
