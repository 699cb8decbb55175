"""`jtq batch` on this machine: groups, resuming, failures; real commands in processes of their own."""

import json
import os
import re
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.sysid.batch import command
from jtqd.sysid.batch.command import (
    GroupError,
    Outcome,
    Task,
    find_groups,
    key_of,
    run_batch,
    run_task,
    store,
    stored,
    write_whole,
)
from tests.sysid.batch.batch_helpers import (
    arguments,
    fleet,
    results,
    started,
    states,
    summary,
    tasks_of,
    wait_for,
)
from tests.sysid.diagnosis.diagnose_helpers import JOINT_FILE, write_runs

_KINDS = ((".csv", ".csv.gz", ".parquet"), (".mcap",))


def touch(directory, *names):
    for name in names:
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(name)
    return directory


def names_of(found):
    return {group.name: [path.name for path in group.files] for group in found[0]}


# ---- groups ----


def test_groups_by_directory_run_and_file(tmp_path):
    run = "jtqd-can0-20261121T173515Z"
    touch(
        tmp_path,
        f"a/{run}-0001.mcap",
        f"a/{run}-0002.mcap",
        "a/other-0001.mcap",
        f"b/{run}-0001.mcap",
        "b/x.txt",
    )
    assert names_of(find_groups([tmp_path], "directory", _KINDS)) == {
        "a": [f"{run}-0001.mcap", f"{run}-0002.mcap", "other-0001.mcap"],
        "b": [f"{run}-0001.mcap"],
    }
    assert names_of(find_groups([tmp_path], "run", _KINDS)) == {
        f"a/{run}.mcap": [f"{run}-0001.mcap", f"{run}-0002.mcap"],
        "a/other.mcap": ["other-0001.mcap"],
        f"b/{run}.mcap": [f"{run}-0001.mcap"],
    }
    assert len(names_of(find_groups([tmp_path], "file", _KINDS))) == 4


def test_a_directory_with_tables_and_logs_gives_its_tables(tmp_path):
    touch(tmp_path, "a/run.csv", "a/run.mcap", "b/run.mcap", "b/.hidden.csv")
    assert names_of(find_groups([tmp_path], "directory", _KINDS)) == {"a": ["run.csv"], "b": ["run.mcap"]}


def test_what_is_named_twice_counts_once_and_what_is_not_ended_is_left_out(tmp_path):
    touch(tmp_path, "run.mcap", "now.mcap.active")
    found = find_groups([tmp_path, tmp_path / "run.mcap"], "directory", _KINDS)
    assert names_of(found) == {tmp_path.name: ["run.mcap"]}
    assert [path.name for path in found[1]] == ["now.mcap.active"]


@pytest.mark.parametrize(
    ("named", "part"),
    [
        ("nothing", "found no such file or directory"),
        ("empty", "found no log in it"),
        ("x.txt", "found a file ending in '.txt'"),
        ("active", "still being written"),
    ],
)
def test_nothing_to_work_on(tmp_path, named, part):
    (tmp_path / "empty").mkdir()
    touch(tmp_path, "x.txt", "active/a.mcap.active")
    with pytest.raises(GroupError, match=part):
        print(find_groups([tmp_path / named], "file", _KINDS))


# ---- results on the disk ----


def test_a_result_is_named_by_everything_it_was_made_from():
    base = ("diagnose", "1.0", {"joint": "a"}, ["h1", "h2"])
    changed = [
        ("replay", *base[1:]),
        (base[0], "1.1", *base[2:]),
        (*base[:2], {"joint": "b"}, base[3]),
        (*base[:3], ["h1"]),
        (*base[:3], ["h2", "h1"]),
    ]
    assert key_of(*base) == key_of(*base)
    assert len({key_of(*each) for each in (base, *changed)}) == 6


def test_an_edit_of_the_code_makes_another_tool(tmp_path, monkeypatch):
    package = tmp_path / "extra"
    package.mkdir()
    (package / "a.py").write_text("x = 1\n")
    monkeypatch.setattr(command.jtqd, "__path__", [str(tmp_path)])

    first = command.tool_version()
    assert re.fullmatch(r"0\.[\w.]+\+code\.[0-9a-f]{12}", first)
    (package / "notes.txt").write_text("no code")
    assert command.tool_version() == first
    (package / "a.py").write_text("x = 2\n")
    second = command.tool_version()
    (package / "a.py").rename(package / "b.py")
    assert len({first, second, command.tool_version()}) == 3


def test_the_code_hash_covers_every_package(monkeypatch):
    seen = []
    monkeypatch.setattr(Path, "rglob", lambda self, pattern: seen.append(self.name) or [])
    command.tool_version()
    assert {"daemon", "drivers", "estimator", "models", "sim_can", "sysid"} <= set(seen)


def test_a_worker_with_other_code_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(
        command, "run_task", lambda task: Outcome(0, {"runs": []}, "", 1.0, "0.1.0+code.other")
    )
    touch(tmp_path, "a.mcap")
    groups, _ = find_groups([tmp_path], "file", _KINDS)
    with ThreadPoolExecutor(1) as executor:
        (row,) = run_batch(Task("replay"), {}, groups, tmp_path / "out", executor)
    assert (row.state, row.content) == ("failed", None)
    assert row.error == f"the worker has jtqd 0.1.0+code.other, expected {command.tool_version()} as here"
    assert not (tmp_path / "out").exists()


def test_a_result_is_there_whole_or_not_at_all(tmp_path):
    assert stored(tmp_path, "k") is None
    kept = store(tmp_path, "k", {"result": {"x": 1}, "seconds": 2.0}, {"report.html": b"<p>"})
    assert stored(tmp_path, "k") == kept
    assert (tmp_path / "results" / "k" / "report.html").read_bytes() == b"<p>"
    path = tmp_path / "results" / "k.json"
    path.write_bytes(path.read_bytes()[:-20])
    assert stored(tmp_path, "k") is None, "half a file is none"
    path.write_text(json.dumps({"schema": "another", "key": "k"}))
    assert stored(tmp_path, "k") is None
    path.write_text(json.dumps(kept | {"key": "another"}))
    assert stored(tmp_path, "k") is None
    write_whole(tmp_path / "x", "1")
    with pytest.raises(UnicodeEncodeError):  # fails in the middle, as on a full disk
        write_whole(tmp_path / "x", "2\udc80")
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path / "results", "3")
    assert (tmp_path / "x").read_text() == "1"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results", "x"]


# ---- the command ----


def test_a_fleet_with_one_broken_log(tmp_path, capsys):
    """Failed is a row, not the end; the same command again does only what is missing or has changed."""
    logs, out = fleet(tmp_path / "logs", ["r1/left", "r1/right"]), tmp_path / "out"
    touch(logs, "r2/bad.csv")
    assert jtq(["batch", *arguments(logs, out)]) == 3
    printed = capsys.readouterr()
    assert states(out) == {"r1/left": "done", "r1/right": "done", "r2": "failed"}
    assert "3 groups: 2 done, 0 finished before, 1 failed" in printed.out
    assert "jtq batch: r2: bad.csv: line 1: found no column" in printed.err
    broken = next(group for group in summary(out)["groups"] if group["name"] == "r2")
    assert broken["key"] not in results(out), "what failed is tried again"
    assert broken["figures"] is None
    page = (out / "index.html").read_text()
    for key, content in results(out).items():
        assert content["result"]["verdict"] == "insufficient_data"
        assert content["exit_status"] == 3
        assert (out / "results" / key / "report.html").stat().st_size > 10_000
        assert f'href="results/{key}/report.html"' in page
    assert "bad.csv" in page
    assert "http" not in page.replace("http-equiv", "")

    before = results(out)
    write_runs(logs / "r1" / "left", count=1, seconds=1.1)
    (logs / "r1" / "right").rename(logs / "r1" / "moved")
    (logs / "r2" / "bad.csv").unlink()
    assert jtq(["batch", *arguments(logs, out, "--json")]) == 0
    assert states(out) == {"left": "done", "moved": "kept"}, "content counts, not place"
    assert json.loads(capsys.readouterr().out) == summary(out)
    assert before.items() <= results(out).items()

    assert jtq(["batch", *arguments(logs / "r1" / "moved", out, "--again")]) == 0
    assert states(out) == {"moved": "done"}
    assert not tasks_of(os.getpid())


def test_the_same_logs_in_two_places_are_worked_on_once(tmp_path):
    logs, out = fleet(tmp_path / "logs", ["a"]), tmp_path / "out"
    (logs / "b").mkdir()
    for path in (logs / "a").iterdir():
        (logs / "b" / path.name).write_bytes(path.read_bytes())
    assert jtq(["batch", *arguments(logs, out, "--again")]) == 0
    first, second = summary(out)["groups"]
    assert (first["key"], first["seconds"]) == (second["key"], second["seconds"])
    assert len(results(out)) == 1


@pytest.mark.campaign
def test_a_batch_that_is_killed_goes_on_where_it_was(tmp_path):
    """kill -9 after the first result: what was finished is kept."""
    logs, out = fleet(tmp_path / "logs", ["a", "b", "c"]), tmp_path / "out"
    with started(*arguments(logs, out, "--jobs", "1"), cwd=tmp_path) as process:
        wait_for(lambda: results(out) if out.exists() else None)
        wait_for(lambda: tasks_of(process.pid))
        running = tasks_of(process.pid)
        process.kill()
    for pid in running:  # a task of a batch that was killed goes on alone
        os.kill(pid, signal.SIGKILL)
    kept = results(out)
    assert 1 <= len(kept) < 3
    assert jtq(["batch", *arguments(logs, out)]) == 0
    assert sorted(states(out).values()) == ["done"] * (3 - len(kept)) + ["kept"] * len(kept)
    assert kept.items() <= results(out).items()


def test_an_interrupted_batch_says_so_and_leaves_nothing_running(tmp_path):
    logs, out = fleet(tmp_path / "logs", ["a", "b"]), tmp_path / "out"
    with started(*arguments(logs, out, "--jobs", "1"), cwd=tmp_path) as process:
        wait_for(lambda: tasks_of(process.pid))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert errors.splitlines()[-1] == "jtq batch: interrupted; the same command continues from here"
    assert "Traceback" not in errors


# ---- one task ----


def test_a_task_that_is_killed_is_a_failed_one(tmp_path):
    fleet(tmp_path, ["a"])
    (log,) = (tmp_path / "a").iterdir()
    task = Task("diagnose", (str(log),), ("--joint", str(JOINT_FILE)), writes=True)

    def kill():
        os.kill(wait_for(lambda: tasks_of(os.getpid()))[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    outcome = run_task(task)
    killer.join()
    assert (outcome.exit_status, outcome.error) == (-9, "ended by SIGKILL (out of memory?)")


def test_a_task_that_takes_too_long_is_a_failed_one(tmp_path):
    outcome = run_task(Task("diagnose", (str(tmp_path),), (), writes=True, timeout_s=0.02))
    assert (outcome.exit_status, outcome.error) == (None, "took longer than 0.02 s")
    assert not tasks_of(os.getpid())


# ---- usage ----


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["diagnose", "nowhere", "--joint", str(JOINT_FILE)], (1, "nowhere: found no such file or directory")),
        (["diagnose", "logs"], (2, "--joint")),
        (["diagnose", "logs", "--joint", "x=a.yaml"], (2, "found joint 'x', expected a number from 1 to 7")),
        (["replay", "nothere.mcap"], (1, "nothere.mcap: found no such file or directory")),
        (["diagnose", "logs", "--joint", "none.yaml"], (1, "none.yaml: cannot be read: No such file")),
        (["replay", "logs", "--out", "logs/a.mcap"], (1, "--out logs/a.mcap: cannot be created: it is a file")),
        (["replay", "logs", "--model", "none"], (1, "--model none: found no such directory")),
    ],
)  # fmt: skip
def test_wrong_usage_is_one_line(tmp_path, monkeypatch, capsys, command, expected):
    monkeypatch.chdir(tmp_path)
    touch(tmp_path, "logs/a.mcap")
    status, part = expected
    assert jtq(["batch", *command[:2], "--out", "out", *command[2:]]) == status
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("jtq batch: ")
    assert part in line
    assert not (tmp_path / "out").exists()


def test_a_broken_log_is_named_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    touch(tmp_path, "a.mcap")
    assert jtq(["batch", "replay", "a.mcap", "--out", "out"]) == 3
    line = capsys.readouterr().err.splitlines()[0]
    assert line.startswith("jtq batch: a.mcap: not a readable MCAP file")
    assert line.count("a.mcap") == 1


@pytest.mark.parametrize(
    ("option", "value"), [("--method", "bogus"), ("--scheduler", "bogus"), ("--jobs", "0")]
)
def test_a_value_that_cannot_be_meant_is_wrong_use(tmp_path, capsys, option, value):
    with pytest.raises(SystemExit) as left:
        jtq(["batch", "replay", "logs", "--out", str(tmp_path / "out"), option, value])
    assert left.value.code == 2
    assert f"'{value}'" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_help_has_examples(capsys):
    for argv in (["--help"], ["diagnose", "--help"], ["replay", "--help"]):
        with pytest.raises(SystemExit) as left:
            jtq(["batch", *argv])
        assert left.value.code == 0
        assert "--scheduler tcp://10.0.0.5:8786" in capsys.readouterr().out
