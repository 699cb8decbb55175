"""Rotation, budget and reserve: what is in the files of a run, which files go, and what a full disk does."""

import os
import shutil
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

from jtqd.daemon.recording import mcap_file as appender
from jtqd.daemon.recording import parts
from jtqd.daemon.recording.run_files import free_run, parse_part, part_files, part_name, to_remove
from tests.daemon.recording.recorder_bench import (
    DEFINITIONS,
    RecorderProcess,
    cycles_of,
    messages_of,
    metadata_of,
    put,
    record_of,
    session_on,
)

EVENT = DEFINITIONS["jtqd_msgs/msg/Event"].constants
START = 1_700_000_000


@pytest.fixture(autouse=True)
def unsynced(monkeypatch):
    """Nothing here pulls a plug: waiting for the disk is most of the time."""
    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, lambda _: None)


def kinds_in(*paths):
    return [event["kind"] for _, event in messages_of(*paths)["/events"]]


# Rotation --------------------------------------------------------------------------------------------------------------


def test_no_cycle_is_lost_at_a_seam(tmp_path):
    """6 s of recorded time in parts of 1 s, by the process: all parts together hold every cycle once, in order."""
    attachments = [{"name": "a.txt", "text": "content"}]
    process = RecorderProcess(tmp_path, rotate_s=1.0, attachments=attachments, run="20260102T030405Z")
    process.wait_for_file()
    process.paced(0, 6000, 3000)
    status, summary, errors = process.end()
    assert (status, errors, summary["written"]) == (0, "", 6000)
    paths = [Path(path) for path in summary["paths"]]
    assert [path.name for path in paths] == [f"test-20260102T030405Z-{n:04d}.mcap" for n in range(1, 6 + 1)]
    assert process.files() == paths
    assert cycles_of(*paths) == list(range(6000))
    previous = ""
    for number, path in enumerate(paths, start=1):
        told = metadata_of(path)
        assert (told["run"], told["part"], told["previous"]) == ("20260102T030405Z", str(number), previous)
        previous = path.name
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            assert [(item.name, item.data) for item in reader.iter_attachments()] == [("a.txt", b"content")]
        assert (len(summary.schemas), len(summary.channels)) == (7, 9)


def test_rotation_by_size(tmp_path):
    session = session_on(tmp_path, rotate_mb=0.05)
    for n in range(4000):
        session.recording.add(record_of(n))
    summary = session.finish()
    sizes = [Path(path).stat().st_size for path in summary["paths"]]
    assert len(sizes) >= 3
    # A part ends with the span that reaches the size; behind it stands its summary.
    assert all(50_000 <= size <= 110_000 for size in sizes[:-1])
    assert cycles_of(*summary["paths"]) == list(range(4000))


def test_rotation_goes_by_monotonic_time(tmp_path):
    """The clock is set back by an hour and forward by two in the middle: the parts are as long as ever."""
    session = session_on(tmp_path, rotate_s=1.0)
    hour = 3600 * 10**9
    for n in range(4000):
        step = 0 if n < 1500 else -hour if n < 2500 else hour
        session.recording.add(record_of(n, start_ns=START * 10**9 + step))
    summary = session.finish()
    # Parts begin with the first chunk of 0.5 s and end at the first that is 1 s later.
    lengths = [len(cycles_of(path)) for path in summary["paths"]]
    assert cycles_of(*summary["paths"]) == list(range(4000))
    assert all(1000 <= length <= 1510 for length in lengths[:-1])


def test_request_ends_the_part(tmp_path):
    session = session_on(tmp_path)
    for n in range(100):
        session.recording.add(record_of(n))
    session.save("on request")
    first = tmp_path / "logs" / part_name("test", session.run, 1)
    assert cycles_of(first) == list(range(100)), "finished and readable while recording goes on"
    session.save("on request")  # nothing new: no empty part
    for n in range(100, 150):
        session.recording.add(record_of(n))
    summary = session.finish()
    assert len(summary["paths"]) == 2
    assert cycles_of(*summary["paths"]) == list(range(150))
    assert metadata_of(summary["paths"][1])["reason"] == "on request"


# Names -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("20260101T000000Z-0001.mcap", ("20260101T000000Z", 1, 1, False)),
        ("20260101T000000Z_12-12345.mcap.active", ("20260101T000000Z_12", 12, 12345, True)),
        *(
            (name, None)
            for name in (
                "20260101T000000Z_0-0001.mcap",
                "20260101T000000Z-1.mcap",
                "20260101T000000Z-001.mcap",
                "20260101T000000Z-0001.mcap.bak",
                "20260101T000000Z-0001.MCAP",
                "20260101T000000Z.mcap",
                "20260101T000000Z-0001_x.mcap",
                "x-20260101T000000Z-0001.mcap",
                "20260101T000000Z-0001-20260101T000000Z-0001.mcap",
                "\uff120260101T000000Z-0001.mcap",
                "20260101T000000Z-\u0661\u0661\u0661\u0661.mcap",
                "notes.txt",
            )
        ),
    ],
)
def test_only_names_of_exactly_our_form_are_ours(name, found):
    each = parse_part("test", Path(f"test-{name}"))
    assert (each and (each.run, each.again, each.part, each.active)) == found
    assert parse_part("test", Path(f"xtest-{name}")) is None


def test_own_names_sort_by_run_and_part(tmp_path):
    names = [
        "test-20260102T030405Z-0001.mcap",
        "test-20260102T030405Z-0002.mcap.active",
        "test-20260102T030405Z-10000.mcap",
        "test-20260102T030405Z_2-0001.mcap",
        "test-20260102T030405Z_10-0001.mcap",
        "test-20260102T030406Z-0001.mcap",
    ]
    for name in reversed(names):
        (tmp_path / name).touch()
    (tmp_path / "test-20270102T030406Z-0001.mcap").mkdir()
    (tmp_path / "test-20270102T030406Z-0002.mcap").symlink_to(tmp_path / names[0])
    assert [each.path.name for each in part_files(tmp_path, "test")] == names
    assert part_files(tmp_path / "none", "test") == []


def test_run_of_the_same_second_gets_another_name(tmp_path):
    assert free_run(tmp_path, "test", START * 10**9) == "20231114T221320Z"
    (tmp_path / "test-20231114T221320Z-0003.mcap").touch()
    assert free_run(tmp_path, "test", START * 10**9) == "20231114T221320Z_2"
    (tmp_path / "test-20231114T221320Z_2-0001.mcap.active").touch()
    assert free_run(tmp_path, "test", START * 10**9) == "20231114T221320Z_3"
    assert free_run(tmp_path, "other", START * 10**9) == "20231114T221320Z"


# Budget ----------------------------------------------------------------------------------------------------------------


def sized_file(name, size):
    return parse_part("p", Path(name))._replace(size=size)


def test_budget_takes_the_oldest_first_and_no_more_than_needed():
    files = [
        sized_file("p-20260101T000000Z-0001.mcap", 40),
        sized_file("p-20260101T000000Z-0002.mcap", 40),
        sized_file("p-20260102T000000Z-0001.mcap.active", 40),
        sized_file("p-20260103T000000Z-0001.mcap", 40),
        sized_file("p-20260103T000000Z-0002.mcap", 40),
    ]
    run = "20260103T000000Z"

    def removed(budget, growing, keep_run):
        return [files.index(each) for each in to_remove(files, budget, growing, run, keep_run=keep_run)]

    assert removed(220, 20, True) == []
    assert removed(200, 20, True) == [0]
    assert removed(180, 20, True) == [0]
    assert removed(150, 20, True) == [0, 1]
    assert removed(1, 20, True) == [0, 1], "neither a file being written nor the run's own"
    assert removed(1, 20, False) == [0, 1, 3], "the newest finished part of the run stays"


@pytest.mark.parametrize("keep_run", [True, False])
def test_budget_removes_own_finished_files_only(tmp_path, keep_run):
    """Old runs go. Foreign files, directories, links and unfinished files of the same prefix stay, whatever their age."""
    logs = tmp_path / "logs"
    logs.mkdir()
    old = [logs / f"test-2020010{day}T000000Z-0001.mcap" for day in (1, 2, 3)]
    kept = [
        logs / "test-20200101T000000Z-0002.mcap.active",
        logs / "test-20200101T000000Z.mcap",
        logs / "other-20200101T000000Z-0001.mcap",
        logs / "test-b-20200101T000000Z-0001.mcap",
        logs / "notes.txt",
    ]
    for path in [*old, *kept]:
        path.write_bytes(bytes(30_000))
    link = logs / "test-20200101T000000Z-0009.mcap"
    link.symlink_to(kept[-1])
    session = session_on(tmp_path, budget_mb=0.12, rotate_mb=0.03, keep_run=keep_run)
    for n in range(3000):
        session.recording.add(record_of(n))
    summary = session.finish()
    assert all(path.exists() for path in [*kept, link])
    assert not any(path.exists() for path in old)
    parts_left = [metadata_of(path)["part"] for path in summary["paths"]]
    found = kinds_in(*summary["paths"])
    if keep_run:
        assert cycles_of(*summary["paths"]) == list(range(3000))
        assert found.count(EVENT["FILE_RETIRED"]) == 4, "three files, and once that the budget is exceeded"
    else:
        assert parts_left[0] != "1"
        assert cycles_of(*summary["paths"]) == list(range(3000))[-len(cycles_of(*summary["paths"])) :]
        own = sum(Path(path).stat().st_size for path in summary["paths"])
        assert own < 120_000 + 30_000
    assert summary["lost"] == 0


# Reserve and failing disks ----------------------------------------------------------------------------------------------


@pytest.fixture
def free(monkeypatch):
    """A knob: what the file system says is free [byte]."""
    knob = {"free": 10**9}

    class Found:
        f_frsize = 1

        @property
        def f_bavail(self):
            return knob["free"]

    monkeypatch.setattr(os, "fstatvfs", lambda _: Found())
    monkeypatch.setattr(os, "statvfs", lambda _: Found())
    return knob


def test_recording_ends_at_the_reserve_and_goes_on_when_there_is_room(tmp_path, free):
    said = []
    session = session_on(tmp_path, warn=said.append, reserve_mb=100.0, chunk_s=0.1)
    for n in range(6000):
        free["free"] = 10**9 if n < 1000 else 99 * 10**6 if n < 3000 else 110 * 10**6 if n < 4000 else 10**9
        session.recording.add(record_of(n))
        if n == 2000:
            first = tmp_path / "logs" / part_name("test", session.run, 1)
            held = cycles_of(first)
            assert 1000 <= len(held) <= 1102, "the part was ended, and can be read now"
            assert kinds_in(first)[-1] == EVENT["SPACE_LOW"]
            assert session.parts.obstacle
    summary = session.finish()
    assert len(summary["paths"]) == 2
    found = cycles_of(*summary["paths"])
    missing = 6000 - len(found)
    assert found == [*held, *range(len(held) + missing, 6000)]
    assert found[len(held)] >= 4000 - 101, "110 MB are not enough to begin again: 125 are"
    assert summary["lost"] == summary["lost_unwritten"] == missing
    assert [line.split(":")[0].split(" in part")[0] for line in said] == [
        "recording pauses",
        "recording continues",
    ]
    event = next(
        event
        for _, event in messages_of(summary["paths"][1])["/events"]
        if event["kind"] == EVENT["WRITE_FAILED"]
    )
    assert event["count"] == missing
    assert (metadata_of(summary["paths"][1])["reason"]) == "recording continues"


def test_start_without_room(tmp_path, free):
    free["free"] = 0
    said = []
    session = session_on(tmp_path, warn=said.append, reserve_mb=1.0)
    for n in range(3000):
        session.recording.add(record_of(n))
    assert (session.account.written, session.account.lost) == (0, session.recording.progress.cycles)
    assert session.account.lost >= 2499
    assert len(said) == 1
    assert not (tmp_path / "logs").exists()
    free["free"] = 10**9
    for n in range(3000, 5000):
        session.recording.add(record_of(n))
    summary = session.finish()
    assert summary["written"] == len(cycles_of(*summary["paths"])) > 1900
    assert summary["written"] + summary["lost"] == 5000


def test_disk_without_blocks_for_a_while(tmp_path, monkeypatch):
    """No blocks for 0.7 s: the part is ended with what was taken before, the next is begun when a retry finds some."""
    knob, real = {"full": False}, appender._fallocate

    def take(*arguments):
        if knob["full"]:
            raise OSError(28, "No space left on device")
        real(*arguments)

    monkeypatch.setattr(appender, "_fallocate", take)
    monkeypatch.setattr(appender, "_STEP", 4096)
    said = []
    session = session_on(tmp_path, warn=said.append, chunk_s=0.1)
    for n in range(3000):
        knob["full"] = 1000 <= n < 1700
        session.recording.add(record_of(n))
    summary = session.finish()
    assert [path[-10:] for path in summary["paths"]] == ["-0001.mcap", "-0002.mcap"], (
        "both have their summary"
    )
    found = cycles_of(*summary["paths"])
    assert summary["written"] == len(found)
    assert summary["lost"] == 3000 - len(found)
    assert 100 <= summary["lost"] <= 1700
    assert found == sorted(set(found))
    assert len(said) == 2


def test_disk_that_never_recovers_is_tried_once_a_second_and_said_once(tmp_path, monkeypatch):
    attempts, said = [], []
    session = session_on(tmp_path, warn=said.append)

    def refuse(*_):
        raise OSError(5, "I/O error")

    def attempt(*_):
        attempts.append(1)
        refuse()

    monkeypatch.setattr(parts, "McapFile", attempt)
    monkeypatch.setattr(os, "pwrite", refuse)
    for n in range(0, 60_000, 10):
        session.recording.add(record_of(n))
    assert 58 <= len(attempts) <= 67
    assert sum("recording fails" in line for line in said) == 1
    assert len(said) == 1
    assert session.account.written == 0
    assert list((tmp_path / "logs").iterdir()) == [], "a part without a chunk is taken away"


def test_file_that_is_removed_costs_what_was_in_it(tmp_path):
    said = []
    session = session_on(tmp_path, warn=said.append)
    for n in range(2000):
        session.recording.add(record_of(n))
        if n == 1100:
            before = session.account.written
            shutil.rmtree(tmp_path / "logs")
    summary = session.finish()
    assert cycles_of(*summary["paths"]) == list(range(before, 2000))
    assert (summary["written"], summary["lost"]) == (2000 - before, before)
    assert said == [f"part 1 was removed while it was being written: cycles lost with it: {before}"]
    assert metadata_of(summary["paths"][0])["part"] == "2"
    events = [event for _, event in messages_of(*summary["paths"])["/events"]]
    assert [event["count"] for event in events if event["kind"] == EVENT["FILE_REMOVED"]] == [before]


def test_recorder_of_the_same_run_goes_on_with_the_numbers(tmp_path):
    first = session_on(tmp_path, run="20260102T030405Z")
    first.recording.add(record_of(0))
    first.finish()
    second = session_on(tmp_path, run="20260102T030405Z")
    second.recording.add(record_of(1))
    summary = second.finish()
    assert [Path(path).name[-9:] for path in summary["paths"]] == ["0001.mcap", "0002.mcap"]
    told = metadata_of(summary["paths"][1])
    assert (told["previous"], told["reason"]) == (
        "test-20260102T030405Z-0001.mcap",
        "recorder restarted",
    )


def test_rotation_delays_little(tmp_path):
    """Ending a part and beginning the next takes a small share of what the ring holds (4 s)."""
    session = session_on(tmp_path, attachments=[{"name": "x", "text": "y" * 500_000}])
    for n in range(20_000):
        session.recording.add(record_of(n))
    start = time.monotonic()
    session.save("on request")
    assert time.monotonic() - start < 1.0
    session.finish()


def test_put_is_what_the_loop_does(tmp_path):
    """The helper's ring is read by the recorder as the loop's is: guards the tests themselves."""
    process = RecorderProcess(tmp_path, rotate_s=0.5)
    process.wait_for_file()
    for n in range(1200):
        put(process.ring, record_of(n))
    _, summary, _ = process.end()
    assert cycles_of(*summary["paths"]) == list(range(1200))
