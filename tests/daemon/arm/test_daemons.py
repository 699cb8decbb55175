"""`jtqd-arm` beside real jtqd on two buses of different period, one of which is restarted; judged by jtqd's own logs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from jtqd.daemon.arm.command import main
from jtqd.estimator.status import PUBLISHED, STALE
from tests.daemon.arm import small_arm
from tests.daemon.slow_bench import slow_configuration
from tests.paths import ROOT

PERIODS_US = {"a": 5_000, "b": 10_000}
ZEROS = {"shoulder": 0.25, "elbow": -0.5}


class Buses:
    """Benches and daemons; jtqd-arm reads joint 1 of each as shoulder and elbow."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.stack, self.folder = stack, folder
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder / "run")}
        self.environment.pop("RUNTIME_DIRECTORY", None)
        self.names = {name: f"unix:{folder / name}.sock" for name in PERIODS_US}
        self.configs = {}
        for name, period_us in PERIODS_US.items():
            (folder / name).mkdir()
            self.configs[name] = slow_configuration(folder / name, period_us)
            bench = self.start("-m", "jtqd.sim_can", "--bus", self.names[name], "--seed", str(period_us))
            assert bench.stderr is not None
            assert "ready" in bench.stderr.readline()

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start a process that ends with the test."""
        process = self.stack.enter_context(
            subprocess.Popen(
                [sys.executable, *words],
                env=self.environment,
                cwd=ROOT,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        self.stack.callback(process.kill)
        return process

    def jtqd(self, name: str) -> subprocess.Popen[str]:
        """Start a daemon that records."""
        words = (
            "--bus",
            self.names[name],
            "--config",
            str(self.configs[name]),
            "--record",
            str(self.logs(name)),
        )
        return self.start("-m", "jtqd.daemon.jtqd", *words, "--json")

    def logs(self, name: str) -> Path:
        """Where the daemon of a bus records."""
        return self.folder / name / "logs"

    def arm(self, module: str, *options: str) -> subprocess.Popen[str]:
        """Start jtqd-arm, or its stand-in."""
        joints = {
            "shoulder": {"bus": self.names["a"], "joint": 1, "direction": 1, "zero_rad": ZEROS["shoulder"]},
            "elbow": {"bus": self.names["b"], "joint": 1, "direction": -1, "zero_rad": ZEROS["elbow"]},
        }
        path = small_arm.write(self.folder, small_arm.content(joints=joints))
        return self.start("-m", module, str(path), "--json", *options)


def ended(process: subprocess.Popen[str]) -> tuple[dict[str, Any], str]:
    """Summary and standard error of a process that gets SIGTERM."""
    process.send_signal(signal.SIGTERM)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert "Traceback" not in error
    return json.loads(out), error


def messages(folder: Path, topic: str) -> list[Any]:
    """Decoded messages of a topic in all files, in the order of time."""
    found = []
    for path in sorted(folder.glob("*.mcap")):
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            found += [each for *_, each in reader.iter_decoded_messages(topics=[topic])]
    return found


def until(condition: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait for something."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.native
def test_two_daemons_of_which_one_is_restarted(tmp_path: Path) -> None:
    with ExitStack() as stack:
        buses = Buses(stack, tmp_path)
        arm = buses.arm("tests.daemon.arm.stub", "--record", str(tmp_path / "arm"))
        real = buses.arm("jtqd.daemon.arm.command")
        first, second = (buses.jtqd(name) for name in PERIODS_US)
        ring = {name: (lambda n=name: [*(tmp_path / "run").glob(f"*{n}.sock*/ring")]) for name in PERIODS_US}
        until(lambda: ring["a"]() and ring["b"]())
        time.sleep(4.0)
        ended(second)
        time.sleep(1.5)
        third = buses.jtqd("b")
        until(ring["b"])
        time.sleep(4.0)
        summary, error = ended(arm)
        by_estimator, _ = ended(real)
        ended(third)
        ended(first)
    assert summary["recording"]["complete"]
    assert summary["contacts"] > 2
    assert min(by_estimator["estimated"].values()) > 200
    assert error.count("reading jtqd on") == 3
    found = messages(tmp_path / "arm", "/arm/external")
    assert summary["recording"]["written"] == len(found) == summary["cycles"]
    joined = [each for each in found if np.isfinite(each.position_rad).all()]
    assert len(joined) > 300
    assert {*np.diff([each.monotonic_ns for each in found]).tolist()} == {1000 * PERIODS_US["b"]}
    for n, (name, bus, sign) in enumerate((("shoulder", "a", 1.0), ("elbow", "b", -1.0))):
        told = messages(buses.logs(bus), "/joint/1/state")
        sync = np.array([each.sync_monotonic_ns for each in told])
        position = sign * (np.array([each.link_position_rad for each in told]) - ZEROS[name])
        good = [each for each in told if each.status in PUBLISHED]
        as_of = np.array([each.sync_monotonic_ns - round(1e6 * each.age_ms) for each in good])
        there = np.isfinite(position)
        at = np.array([each.monotonic_ns for each in joined])
        expected = np.interp(at, sync[there], position[there])
        assert np.abs(expected - [each.position_rad[n] for each in joined]).max() < 1e-9
        known = [each for each in joined if np.isfinite(each.torque_nm[n])]
        assert len(known) > 200
        at = np.array([each.monotonic_ns for each in known])
        expected = np.interp(at, as_of, [sign * each.torque_nm for each in good])
        assert np.abs(expected - [each.torque_nm[n] for each in known]).max() < 1e-9
        assert np.abs(np.diff(position[there])).max() > 1e-4, "the bench moves"
    gone = [each for each in found if each.status[1] == STALE and np.isnan(each.position_rad[1])]
    assert len(gone) * PERIODS_US["b"] * 1e-6 > 1.0
    assert np.isnan([each.external_nm for each in gone]).all(), "without a position nothing is known"
    assert any(np.isfinite(each.position_rad[0]) for each in gone), "the other bus goes on"
    assert joined[-1].monotonic_ns > gone[-1].monotonic_ns


@pytest.mark.native
def test_a_joint_that_its_jtqd_does_not_have_ends_it_in_one_line(tmp_path: Path) -> None:
    with ExitStack() as stack:
        buses = Buses(stack, tmp_path)
        buses.jtqd("a")
        joints = {"shoulder": {"bus": buses.names["a"], "joint": 3, "direction": 1, "zero_rad": 0.0}}
        path = small_arm.write(tmp_path, small_arm.content(joints=joints))
        arm = buses.start("-m", "jtqd.daemon.arm.command", str(path))
        _, error = arm.communicate(timeout=60)
    assert arm.returncode == 2
    line = error.splitlines()[-1]
    for part in ("arm.yaml", "key 'joints.shoulder.joint'", "found 3", "expected at most 2"):
        assert part in line


def touchable(shape: str) -> str:
    """URDF with a shape of its links."""
    return small_arm.URDF.replace(
        "<inertial>", f"<collision><geometry>{shape}</geometry></collision><inertial>"
    )


@pytest.mark.parametrize(
    ("urdf", "tool", "expected"),
    [
        ("<robot", "flange", "no XML"),
        ("<arm/>", "flange", "expected <robot>"),
        (small_arm.URDF, "hand", "found no link hand that moves"),
        (small_arm.URDF, "base", "found no link base that moves"),
        (small_arm.URDF, "universe", "found no link universe that moves"),
        (small_arm.URDF.replace('"fore"', '"elbow"'), "flange", "found joint and link elbow"),
        (small_arm.URDF.replace('"0 -1 0"', '"0 0 0"'), "flange", "joint shoulder: found axis 0 0 0"),
        (
            small_arm.URDF.replace("2.0", "2,0", 1),
            "flange",
            "link upper: mass value: found '2,0', expected 1",
        ),
        (small_arm.URDF.replace("2.0", "-2", 1), "flange", "link upper: mass value: found '-2', expected 1"),
        (small_arm.URDF.replace("0.001", "nan", 1), "flange", "link upper: inertia ixx: found 'nan'"),
        (touchable('<cylinder radius="0.1"/>'), "flange", "link upper: cylinder length: found ''"),
        (touchable('<cylinder radius="60" length="300"/>'), "flange", "expected 1 number from 0 to 3"),
        (touchable('<box size="1 2"/>'), "flange", "box size: found '1 2', expected 3 numbers"),
        ("<robot>" + 10**5 * "<x>" + 10**5 * "</x>" + "</robot>", "flange", "recursion"),
        (small_arm.URDF.replace('"elbow"', '"elbows"'), "flange", "found no moving joint elbow"),
        (small_arm.URDF.replace('<parent link="base"/>', ""), "flange", "not contain a valid URDF"),
    ],
)
def test_a_urdf_that_does_not_fit_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], urdf: str, tool: str, expected: str
) -> None:
    path = small_arm.write(tmp_path, small_arm.content(tool=tool), urdf)
    assert main([str(path)]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert expected in lines[-1]
    assert sum(line.startswith("jtqd-arm: ") for line in lines) == 1
    assert not [line for line in lines if "Traceback" in line]


def test_a_joint_that_follows_one_of_the_arm_is_not_taken_as_standing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begins = small_arm.URDF.index('name="elbow" type')
    follower = small_arm.URDF[begins:].replace("<axis", '<mimic joint="shoulder"/><axis', 1)
    urdf = small_arm.URDF[:begins] + follower
    joints = {"shoulder": {"bus": "none", "joint": 1, "direction": 1, "zero_rad": 0.0}}
    path = small_arm.write(tmp_path, small_arm.content(joints=joints), urdf)
    assert main([str(path), "--duration", "1"]) == 2
    assert "found joint elbow follows shoulder" in capsys.readouterr().err


def test_without_pinocchio_it_names_the_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib.util

    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    assert main([str(small_arm.write(tmp_path))]) == 2
    assert capsys.readouterr().err == "jtqd-arm: pinocchio is not installed: pip install 'jtqd[arm]'\n"


def test_a_file_in_place_of_the_directory_of_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small_arm.write(tmp_path)
    assert main([str(path), "--record", str(path), "--duration", "1"]) == 2
    assert f"--record {path}: found a file" in capsys.readouterr().err


def test_nobody_is_waited_for_longer_than_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joints = small_arm.content()["joints"]
    for each in joints.values():
        each["bus"] = f"none_{each['bus']}"
    path = small_arm.write(tmp_path, small_arm.content(joints=joints))
    assert main([str(path), "--duration", "0.3", "--json"]) == 0
    said = capsys.readouterr()
    summary = json.loads(said.out)
    assert (summary["cycles"], summary["recording"]) == (0, None)
    assert [each.split(" (")[0] for each in summary["waiting"]] == [
        "no jtqd runs on none_vcan0",
        "no jtqd runs on none_vcan1",
    ]
    assert said.err.count("waiting: no jtqd runs") == 2


def test_it_goes_on_where_nobody_reads_what_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    joints = {"shoulder": {"bus": "none", "joint": 1, "direction": 1, "zero_rad": 0.0}}
    path = small_arm.write(tmp_path, small_arm.content(joints=joints))
    with open("/dev/full", "w", encoding="utf-8", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", full)
        assert main([str(path), "--duration", "0.1", "--json"]) == 0
        monkeypatch.undo()
        with suppress(OSError):
            full.close()
    assert json.loads(capsys.readouterr().out)["cycles"] == 0
