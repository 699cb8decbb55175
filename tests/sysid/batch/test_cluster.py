"""`jtq batch --scheduler` on a real dask cluster of two workers, one of which is killed at work."""

import contextlib
import os
import signal
import socket
import sys
import threading

import pytest
from distributed import LocalCluster

from jtqd.daemon.jtq import main as jtq
from jtqd.sysid.batch import command
from tests.sysid.batch.batch_helpers import arguments, fleet, results, states, summary, tasks_of, wait_for


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
    names = ["a", "b", "c"]
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


def test_without_dask_it_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    logs = fleet(tmp_path / "logs", ["a"])
    assert jtq(["batch", *arguments(logs, tmp_path / "out", "--scheduler", "tcp://x:1")]) == 1
    assert capsys.readouterr().err == (
        "jtq batch: --scheduler needs dask.distributed: pip install 'jtqd[cluster]'\n"
    )
