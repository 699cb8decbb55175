"""`jtq batch` on this machine and on a dask cluster of two workers: groups, resuming, failures, the page; real processes."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path

import pytest
from distributed import LocalCluster

from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.files import write_whole
from jtqd.sysid.batch import command
from jtqd.sysid.batch.command import (
    DONE,
    FAILED,
    KEPT,
    Group,
    GroupError,
    Outcome,
    Row,
    Task,
    counts,
    figures_of,
    find_groups,
    key_of,
    render,
    run_batch,
    run_task,
    store,
    stored,
    to_mapping,
)
from tests.paths import ROOT
from tests.sysid.diagnosis.diagnose_helpers import JOINT_FILE, write_runs

CHILD = b"jtqd.daemon.jtq"


def fleet(directory, names):
    """One directory with one short run each, no two the same: too little to judge, and quick."""
    for number, name in enumerate(names):
        (directory / name).mkdir(parents=True)
        write_runs(directory / name, count=1, seconds=1.0 + 0.01 * number)
    return directory


def arguments(logs, out, *more):
    return ["diagnose", str(logs), "--joint", str(JOINT_FILE), "--out", str(out), *more]


def summary(out):
    return json.loads((out / "summary.json").read_text())


def states(out):
    return {group["name"]: group["state"] for group in summary(out)["groups"]}


def results(out):
    """Finished results by key."""
    return {path.stem: json.loads(path.read_text()) for path in (out / "results").glob("*.json")}


def tasks_of(pid):
    """Process-IDs of the tasks that process `pid` has started and that run."""
    try:
        lists = [(each / "children").read_text() for each in Path(f"/proc/{pid}/task").iterdir()]
    except OSError:  # it has just gone
        return []
    return [child for child in map(int, " ".join(lists).split()) if _is_task(child)]


def _is_task(pid):
    try:
        return CHILD in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def wait_for(condition, timeout_s=120.0):
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return value


def started(*command, cwd):
    """`jtq batch ...` as a process."""
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "batch", *command],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background has it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - no threads yet
    )


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
    (tmp_path / "b" / "next_experiment.motion.csv").write_text("of an earlier diagnosis")
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
    write_whole(tmp_path / "x", b"1")
    with pytest.raises(TypeError):  # fails in the middle, as on a full disk
        write_whole(tmp_path / "x", "2")
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path / "results", b"3")
    assert (tmp_path / "x").read_text() == "1"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results", "x"]


# ---- the command ----


def test_a_fleet_with_one_broken_log(tmp_path, capsys, monkeypatch):
    """Failed is a row, not the end; the same logs in two places are worked on once, and again only when they change."""
    logs, out = fleet(tmp_path / "logs", ["r1/left", "r1/right"]), tmp_path / "out"
    touch(logs, "r2/bad.csv")
    shutil.copytree(logs / "r1" / "left", logs / "r3")
    assert jtq(["batch", *arguments(logs, out)]) == 3
    printed = capsys.readouterr()
    assert states(out) == {"r1/left": "done", "r1/right": "done", "r2": "failed", "r3": "done"}
    assert "4 groups: 3 done, 0 finished before, 1 failed" in printed.out
    first, second = (g for g in summary(out)["groups"] if g["name"] in ("r1/left", "r3"))
    assert (first["key"], first["seconds"]) == (second["key"], second["seconds"])
    assert len(results(out)) == 2
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
    made = next(iter(before.values()))  # what later tasks return
    again = Outcome(3, made["result"], "", 1.0, made["tool"], {"report.html": b"<p>"})
    monkeypatch.setattr(command, "run_task", lambda task: again)
    write_runs(logs / "r1" / "left", count=1, seconds=1.1)
    (logs / "r1" / "right").rename(logs / "r1" / "moved")
    (logs / "r2" / "bad.csv").unlink()
    assert jtq(["batch", *arguments(logs, out, "--json")]) == 0
    assert states(out) == {"r1/left": "done", "r1/moved": "kept", "r3": "kept"}, "content counts, not place"
    assert json.loads(capsys.readouterr().out) == summary(out)
    assert before.items() <= results(out).items()

    assert jtq(["batch", *arguments(logs / "r1" / "moved", out, "--again")]) == 0
    assert states(out) == {"moved": "done"}
    assert not tasks_of(os.getpid())


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


def test_an_interrupted_batch_ends_in_one_line_and_leaves_nothing_running(tmp_path):
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
        (["diagnose", "logs", "--joint", ""], (2, "N from 1 to 7")),
        (["diagnose", "logs", "--joint", "1="], (2, "N from 1 to 7")),
        (["diagnose", "logs", "--joint", "x=a.yaml"], (2, "N from 1 to 7")),
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
        shown = " ".join(capsys.readouterr().out.replace("\\\n", " ").split())
        assert "--scheduler tcp://10.0.0.5:8786" in shown


def diagnosis(verdict="cause", rmse=1.25, *causes):
    return {
        "verdict": verdict,
        "gap": {"joint": 1, "rmse_nm": rmse, "noise_floor_nm": 0.2},
        "gain": {"rmse_after_nm": 0.3},
        "causes": [
            {"name": names[0], "joint": joint, "class": list(names), "parameters": {}}
            for joint, names in causes
        ],
    }


def run_of(identity, largest=0.5, sensor=(0.4, 0.6)):
    joints = [
        {"max_nm": largest, "sensor_logged_nm": sensor[0], "sensor_replayed_nm": sensor[1]},
        {"max_nm": None, "sensor_logged_nm": None, "sensor_replayed_nm": None},
    ]
    return {"seconds": 5.0, "cycles": 5000, "identity": identity, "joints": joints}


def identity(identical, explained=True):
    return {"identical": identical, "bit_identical": identical == 5000, "explained": explained}


def row(name, result, state=DONE, error=""):
    content = None if result is None else {"exit_status": 3, "result": result, "files": ["report.html"]}
    key = None if result is None else f"key-{name}"
    return Row(Group(name, (Path("/logs") / name,)), state, key, content, error, 2.0)


class Page(HTMLParser):
    """Texts, and whether every element is closed."""

    VOID = frozenset({"meta", "br", "link"})

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.links = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data.strip())


def test_figures_of_a_diagnosis():
    ripple, gain = (2, ("torque_ripple",)), ("sensor", ("sensor_gain", "torque_constant"))
    made = figures_of("diagnose", row("a", diagnosis("ambiguous", 1.25, ripple, gain)))
    assert made.badge == ("warn", "ambiguous")
    assert made.cells[:3] == ("1.25", "0.2", "0.3")
    assert made.causes == ("torque ripple (joint 2)", "sensor gain or torque constant (torque sensor)")
    assert made.gap_nm == 1.25
    assert made.values["causes"][1]["class"] == ["sensor_gain", "torque_constant"]


@pytest.mark.parametrize(
    ("identities", "badge"),
    [
        ([identity(5000), identity(5000)], ("good", "identical")),
        ([identity(5000), identity(4000)], ("good", "identical, differences explained")),
        ([identity(5000), identity(4999, explained=False)], ("warn", "differs")),
        ([None], ("after", "other models")),
    ],
)
def test_figures_of_a_replay(identities, badge):
    made = figures_of("replay", row("a", {"runs": [run_of(each) for each in identities]}))
    assert made.badge == badge
    assert made.gap_nm == 0.5
    assert made.cells[3] == "0.4 → 0.6"
    assert made.values["cycles"] == 5000 * len(identities)


def test_the_largest_difference_of_several_runs_counts():
    made = figures_of(
        "replay", row("a", {"runs": [run_of(None, 0.5, (0.4, 0.9)), run_of(None, 0.7, (0.8, 0.6))]})
    )
    assert made.gap_nm == 0.7
    assert made.cells[3] == "0.8 → 0.9"


def test_the_page_shows_every_group_failed_ones_first_and_then_by_gap():
    rows = [
        row("small", diagnosis("no_gap", 0.5)),
        row("large", diagnosis("cause", 2.0, (1, ("torque_ripple",)))),
        row("old", diagnosis("cause", 1.0, (1, ("torque_ripple",))), KEPT),
        row("<b>&", None, FAILED, "x.csv: <script>"),
    ]
    text = render("diagnose", rows, "this machine", "today")
    page = Page(text)
    assert page.open == []
    assert page.links == [
        "results/key-large/report.html",
        "results/key-old/report.html",
        "results/key-small/report.html",
    ]
    order = [page.texts.index(name) for name in ("<b>&", "large", "old", "small")]
    assert order == sorted(order)
    assert "x.csv: <script>" in page.texts, "escaped"
    assert page.texts[page.texts.index("torque ripple (joint 1)") + 1] == "2", "in two groups"
    assert "2.0 s, earlier" in page.texts
    assert 'style="width:50%"' in text, "of the largest gap"
    assert "@import" not in text
    assert "url(" not in text


def test_a_page_of_failures_only():
    page = Page(render("replay", [row("a", None, FAILED, "no")], "here", "today"))
    assert "no" in page.texts


def test_summary_is_plain():
    rows = [row("a", diagnosis()), row("b", None, FAILED, "why")]
    mapping = json.loads(
        json.dumps(to_mapping("diagnose", {"joint": {"0": "h"}}, "1.2.3", rows, "here"), allow_nan=False)
    )
    assert mapping["counts"] == counts(rows) == {"groups": 2, "done": 1, "kept": 0, "failed": 1}
    assert [group["error"] for group in mapping["groups"]] == [None, "why"]
    assert mapping["groups"][0]["figures"]["verdict"] == "cause"
    assert mapping["groups"][0]["logs"] == ["/logs/a"]


@pytest.fixture
def cluster(tmp_path):
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        local_directory=str(tmp_path / "dask"),
        silence_logs=50,
    ) as made:
        yield made


def test_a_worker_that_is_killed_costs_nothing(tmp_path, cluster, capsys):
    """kill -9 of a worker in the middle of a task: the task is done again, every group has one result, none is lost."""
    names = ["a", "b"]
    logs, out = fleet(tmp_path / "logs", names), tmp_path / "out"
    killed = {}

    def kill():
        first = cluster.workers[0].pid
        (child,) = wait_for(lambda: tasks_of(first))
        killed.update(worker=first, child=child)
        os.kill(first, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    assert jtq(["batch", *arguments(logs, out, "--scheduler", cluster.scheduler_address)]) == 0
    killer.join()
    assert killed, "no worker was killed"
    assert states(out) == dict.fromkeys(names, "done")
    kept = results(out)
    assert len(kept) == len({group["key"] for group in summary(out)["groups"]}) == len(names)
    assert {content["exit_status"] for content in kept.values()} == {3}
    for key in kept:
        assert (out / "results" / key / "report.html").exists()
    assert "2 workers" in summary(out)["where"]
    assert "Traceback" not in capsys.readouterr().err

    # The same on this machine: other executor, same names of results, nothing left to do.
    assert jtq(["batch", *arguments(logs, out)]) == 0
    assert set(states(out).values()) == {"kept"}
    assert results(out) == kept


@pytest.mark.campaign
def test_a_scheduler_that_goes_ends_the_batch_in_one_line(tmp_path, cluster, capsys):
    logs, out = fleet(tmp_path / "logs", ["a", "b", "c"]), tmp_path / "out"

    def leave():
        wait_for(lambda: results(out) if out.exists() else None)
        with contextlib.suppress(Exception):
            cluster.close()

    leaver = threading.Thread(target=leave)
    leaver.start()
    assert jtq(["batch", *arguments(logs, out, "--scheduler", cluster.scheduler_address)]) == 1
    leaver.join()
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("jtq batch")]
    assert "the scheduler has ended" in line
    assert results(out), "what was finished is kept"


def test_no_scheduler_there(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "_CONNECT_S", 1.0)
    logs = fleet(tmp_path / "logs", ["a"])
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        assert jtq(["batch", *arguments(logs, tmp_path / "out", "--scheduler", address)]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("jtq batch")]
    assert line.startswith(f"jtq batch: {address}: no dask scheduler answers")


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    logs = fleet(tmp_path / "logs", ["a"])
    assert jtq(["batch", *arguments(logs, tmp_path / "out", "--scheduler", "tcp://x:1")]) == 1
    assert capsys.readouterr().err == (
        "jtq batch: --scheduler needs dask.distributed: pip install 'jtqd[cluster]'\n"
    )
