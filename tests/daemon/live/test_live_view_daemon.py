"""The live view of a whole daemon: started, reported, killed, refused; the loop goes on."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.live import Address, LiveView
from jtqd.daemon.shared import processes as side_process
from tests.daemon.live.live_view_helpers import ROOT, Kept, Viewer

pytestmark = pytest.mark.native

_LISTENING = re.compile(
    r"jtqd: live view: http://127\.0\.0\.1:\d+  \(Foxglove and Lichtblick: (ws://127\.0\.0\.1:\d+)\)\n"
)


@pytest.fixture
def kept(tmp_path, capfd):
    made = Kept(tmp_path, capfd, lambda child: LiveView(child, Address(port=0)))
    yield made
    made.end()


def test_where_it_listens_is_written_and_one_that_is_killed_is_started_again(kept):
    Viewer(kept.until(_LISTENING)[1]).leave()
    kept.kill()
    kept.until("jtqd: the live view ended with exit status -9; restarted, the loop continues\n")
    Viewer(kept.until(_LISTENING)[1]).leave()


def test_one_that_dies_again_and_again_is_left(kept, monkeypatch):
    monkeypatch.setattr(side_process, "_PAUSE_S", 0.0)
    for _ in range(5):
        kept.until(_LISTENING)
        kept.kill()
        kept.until("restarted, the loop continues\n")
    kept.kill()
    kept.until("exit status -9, too often; the loop continues without it\n")
    assert kept.keeper.pid is None
    started = len(kept.children)
    kept.keeper.watch()
    assert len(kept.children) == started


def test_a_port_in_use_is_reported_once(tmp_path, capfd):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        made = Kept(tmp_path, capfd, lambda child: LiveView(child, Address(port=port)))
        made.until(rf"jtqd: no live view: 127\.0\.0\.1:{port}: Address already in use; the loop continues\n")
        for _ in range(5):
            made.keeper.watch()
        assert capfd.readouterr().err == ""
        assert len(made.children) == 1
        made.end()


def test_an_address_that_others_reach_is_reported(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(LiveView, "_run", lambda self: None)
    LiveView(lambda *_: None, Address("0.0.0.0")).start(load_config(None), tmp_path, "can0")
    assert (
        "accepts connections from every host that can reach 0.0.0.0; it is read-only"
        in capfd.readouterr().err
    )


def test_live_view_of_the_emulated_bench(tmp_path):
    """One daemon: a viewer sees torques, the view is killed and comes back, the loop misses nothing for it."""
    arguments = ["--bus", "sim", "--record", "none", "--live", ":0", "--duration", "4.5", "--json"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    with subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtqd", *arguments],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=(tmp_path / "stderr").open("w"),
        text=True,
    ) as process:
        errors = tmp_path / "stderr"

        def wait_for(pattern, timeout_s=60.0):
            end = time.monotonic() + timeout_s
            while not (found := re.search(pattern, errors.read_text())):
                assert process.poll() is None, errors.read_text()
                assert time.monotonic() < end, errors.read_text()
                time.sleep(0.02)
            return found

        viewer = Viewer(wait_for(_LISTENING)[1], ["/joint/1/state", "/diagnostics"])
        states = viewer.wait_for("/joint/1/state", 20)
        assert all(message["sync_counter"] for _, message in states)
        viewer.wait_for("/diagnostics")
        status = viewer.messages["/diagnostics"][0][1]["status"]
        assert [each["name"] for each in status][:2] == ["jtqd: loop", "jtqd: bus"]
        name = b"jtqd.daemon.live.process"
        (pid,) = [
            int(entry.name)
            for entry in Path("/proc").iterdir()
            if entry.name.isdigit()
            and name in (entry / "cmdline").read_bytes()
            and str(tmp_path).encode() in (entry / "cmdline").read_bytes()
        ]
        os.kill(pid, signal.SIGKILL)
        wait_for("the live view ended with exit status -9; restarted, the loop continues")
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 0, errors.read_text()
        assert len(_LISTENING.findall(errors.read_text())) == 2
        summary = json.loads(output)
        assert summary["cycles"] + summary["missed"] >= 4400
        assert "Traceback" not in errors.read_text()
