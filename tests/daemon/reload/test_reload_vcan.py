"""A reload on real SocketCAN in exact time: the bus shows no trace of it but the new estimates."""

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.logs import read_topic
from jtqd.models.files import shipped

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
SECONDS = 3

Frames = list[tuple[float, int, bytes]]


class Run:
    """One jtqd against `jtq sim`; SYNC and estimates as candump saw them."""

    def __init__(self, directory: Path) -> None:
        directory.mkdir()
        self.directory = directory
        self.config = directory / "config"
        self.config.mkdir()
        shutil.copytree(shipped("bench.yaml").parent / "trained", self.config / "trained")
        shutil.copy(shipped("bench.yaml"), self.config / "bench.yaml")
        self.environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory), "XDG_RUNTIME_DIR": ""}
        self.frames: Frames = []
        self.summary: dict[str, Any] = {}
        self.said = ""

    def edit(self, name: str, pattern: str, factor: float) -> None:
        path = self.config / name
        text, count = re.subn(
            pattern,
            lambda found: f"{found[1]}{factor * float(found[2])!r}",
            path.read_text(),
            flags=re.MULTILINE,
        )
        assert count == 1
        path.write_text(text)

    def run(self, *actions: Any) -> None:
        """Start; after 1 s, and every 0.3 s from then on, one of the actions; until the end."""
        python, dump = sys.executable, self.directory / "dump"
        bench = subprocess.Popen(
            [python, "-m", "jtqd.sim_can", "--bus", INTERFACE, "--seed", "1"],
            stderr=subprocess.PIPE,
            text=True,
        )
        assert bench.stderr is not None
        assert "ready" in bench.stderr.readline()
        with open(dump, "w") as file:
            candump = subprocess.Popen(["candump", "-L", f"{INTERFACE},1A0:7FF,080:7FF"], stdout=file)
            time.sleep(0.2)
            command = [
                python,
                "-m",
                "jtqd.daemon.jtqd",
                "--bus",
                INTERFACE,
                "--json",
                "--duration",
                str(SECONDS),
            ]
            command += ["--config", str(self.config / "bench.yaml"), "--record", str(self.directory / "logs")]
            daemon = subprocess.Popen(
                command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            while not list(self.directory.glob("jtqd-*/control")):
                assert daemon.poll() is None, daemon.communicate()[1]
                time.sleep(0.02)
            time.sleep(1.0)
            for action in actions:
                action()
                time.sleep(0.3)
            out, self.said = daemon.communicate(timeout=300)
            time.sleep(0.2)
            candump.terminate()
            candump.wait()
        bench.terminate()
        assert bench.wait(10) == 0
        assert daemon.returncode == 0, self.said
        self.summary = json.loads(out)
        for line in dump.read_text().splitlines():
            stamp, _, frame = line.split()
            can_id, _, data = frame.partition("#")
            self.frames.append((float(stamp.strip("()")), int(can_id, 16), bytes.fromhex(data)))

    def reload(self) -> tuple[int, dict[str, Any]]:
        done = subprocess.run(
            [sys.executable, "-m", "jtqd.daemon.jtq", "control", "reload", "--json"],
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, json.loads(done.stdout)

    def estimates(self) -> list[bytes]:
        return [data for _, can_id, data in self.frames if can_id == 0x1A0]

    def check_bus(self) -> None:
        """One SYNC each millisecond, its counter without a gap, each with its estimate."""
        syncs = [(stamp, data[0]) for stamp, can_id, data in self.frames if can_id == 0x080]
        cycles = 1000 * SECONDS
        assert [counter for _, counter in syncs] == [n % 240 + 1 for n in range(cycles)]
        periods = [after - before for (before, _), (after, _) in itertools.pairwise(syncs)]
        if os.environ.get("JTQD_BENCH_TIME_TRAVEL"):
            assert max(abs(period - 1e-3) for period in periods) < 5e-6
            assert (self.summary["cycles"], self.summary["missed"], self.summary["stale_inputs"]) == (
                cycles,
                0,
                0,
            )
        assert len(self.estimates()) == cycles + 1  # and the last word
        assert self.summary["recording"]["lost"] == 0


@pytest.mark.socketcan
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_a_reload_of_the_same_files_leaves_no_trace_on_the_bus(tmp_path: Path) -> None:
    """Two swaps in one run; the estimates are those of a run without any, to the byte."""
    plain, reloaded = Run(tmp_path / "plain"), Run(tmp_path / "reloaded")
    plain.run()
    replies: list[tuple[int, dict[str, Any]]] = []
    reloaded.run(lambda: replies.append(reloaded.reload()), lambda: replies.append(reloaded.reload()))
    for status, reply in replies:
        assert (status, reply["ok"], reply["missed"]) == (0, True, 0)
        assert reply["changes"]["joint_1"]["max_change_nm"] == 0.0
    assert replies[1][1]["cycle"] > replies[0][1]["cycle"] + 300
    for run in (plain, reloaded):
        run.check_bus()
    assert reloaded.estimates() == plain.estimates()
    for run in (plain, reloaded):  # these tell of nanoseconds, and a swap has its own
        del run.summary["counters"]["work_max_ns"], run.summary["counters"]["late_max_ns"]
    assert reloaded.summary["counters"] == plain.summary["counters"]
    # A part of the log for each set of files.
    assert len(reloaded.summary["recording"]["paths"]) == 3
    indices = [
        index
        for path in reloaded.summary["recording"]["paths"]
        for index in read_topic(Path(path), "/joint/1/state")["cycle"].tolist()
    ]
    assert indices == list(range(1000 * SECONDS))


@pytest.mark.socketcan
@pytest.mark.skipif(not os.environ.get("JTQD_BENCH_TIME_TRAVEL"), reason="needs exact time")
def test_new_files_come_into_force_between_two_cycles_and_bad_ones_never(tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    replies: list[tuple[int, dict[str, Any]]] = []
    good = (run.config / "trained" / "joint1.yaml").read_text()

    def bad() -> None:
        run.edit("trained/joint1.yaml", r"^(rated_torque_nm: *)([0-9.]+)", -1.0)
        replies.append(run.reload())
        (run.config / "trained" / "joint1.yaml").write_text(good)

    def gear_of_another_joint() -> None:
        run.edit("trained/joint1.yaml", r"^(gear_ratio: *)([0-9.]+)", 1.2)
        replies.append(run.reload())
        (run.config / "trained" / "joint1.yaml").write_text(good)

    def new() -> None:
        run.edit("trained/joint1.yaml", r"^(torque_constant_nm_per_a: *)([0-9.e-]+)", 1.1)
        replies.append(run.reload())

    run.run(bad, gear_of_another_joint, new)
    run.check_bus()
    assert [status for status, _ in replies] == [1, 1, 0]
    assert "rated_torque_nm" in replies[0][1]["error"]
    assert "gear ratio" in replies[1][1]["error"]
    assert run.said.count("not reloaded, the old files remain in force") == 2
    change = replies[2][1]["changes"]
    assert change["joint_1"]["rms_change_nm"] > 0.05
    assert change["joint_2"]["rms_change_nm"] == 0.0
    # The bus goes on with it: joint 1 jumps by what was announced, joint 2 does not.
    log = [read_topic(Path(path), "/joint/1/state") for path in run.summary["recording"]["paths"]]
    assert len(log) == 2
