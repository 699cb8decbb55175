"""An arm of seven joints on four buses, one jtqd for each, and four joints on one bus; on real SocketCAN."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame_socket import FrameSocket, open_frame_socket
from jtqd.estimator.status import VALID
from tests.paths import ROOT

ARM = ROOT / "examples" / "arm"
BUSES = {"vcan0": "can0", "vcan1": "can1", "vcan2": "can2", "vcan3": "can3"}
JOINTS = {"can0": 2, "can1": 2, "can2": 2, "can3": 1, "four_joints": 4}
DURATION_S = 2.0
_LOOK_S = 0.01
"""Between two looks at the estimates; a receive takes up to 32 frames."""


@pytest.fixture
def interfaces() -> Iterator[None]:
    """Four virtual interfaces; those that were not there are taken away again."""
    made = []
    for name in BUSES:
        if not Path("/sys/class/net", name).exists():
            added = subprocess.run(
                ["ip", "link", "add", "dev", name, "type", "vcan"],
                capture_output=True,
                text=True,
                check=False,
            )
            if added.returncode:
                pytest.skip(f"{name} cannot be made: {added.stderr.strip()}")
            made.append(name)
            subprocess.run(["ip", "link", "set", name, "up", "txqueuelen", "1000"], check=True)
    yield
    for name in made:
        subprocess.run(["ip", "link", "delete", name], check=True)


class Daemon:
    """A bench and a jtqd on one interface, and what its estimate PDOs reported."""

    def __init__(self, stack: ExitStack, directory: Path, interface: str, config: str) -> None:
        self.joints = JOINTS[config]
        self.latest: dict[int, int] = {}
        self.valid = dict.fromkeys(range(1, self.joints + 1), 0)
        self.ids = {0x1A0: 1} | ({0x2A0: 3} if self.joints > 2 else {})
        self.socket: FrameSocket = open_frame_socket(interface, [exact(each) for each in self.ids])
        self.bench = stack.enter_context(
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "jtqd.sim_can", "--bus", interface),
                    *("--drives", str(self.joints), "--seed", interface[-1]),
                ],
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        stack.callback(self.bench.terminate)
        assert self.bench.stderr is not None
        assert "ready" in self.bench.stderr.readline()
        self.jtqd = stack.enter_context(
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", interface, "--json"),
                    *("--config", str(ARM / f"{config}.yaml"), "--duration", str(DURATION_S)),
                    *("--record", str(directory / config)),
                ],
                env={**os.environ, "RUNTIME_DIRECTORY": str(directory / "run")},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        stack.callback(self.jtqd.terminate)

    def read(self) -> None:
        """Take the estimates that have come."""
        for n in range(self.socket.receive()):
            frame = bytes(self.socket.frames[16 * n : 16 * n + 16])
            first = self.ids[int.from_bytes(frame[:4], "little")]
            for joint, status in enumerate(decode(frame[8:16]).status, start=first):
                if joint <= self.joints:
                    self.latest[joint] = status
                    self.valid[joint] += status == VALID
                else:
                    assert status == 0, "a joint that there is not"

    @property
    def all_valid(self) -> bool:
        return len(self.latest) == self.joints and set(self.latest.values()) == {VALID}

    def summary(self) -> dict[str, Any]:
        """What jtqd printed at its end."""
        out, error = self.jtqd.communicate(timeout=60)
        assert self.jtqd.returncode == 0, error
        return dict(json.loads(out))


def run(directory: Path, buses: dict[str, str]) -> tuple[dict[str, dict[str, Any]], int]:
    """Run them all side by side; summaries by configuration, and how often every joint was valid at once."""
    at_once = 0
    with ExitStack() as stack:
        daemons = {config: Daemon(stack, directory, each, config) for each, config in buses.items()}
        end = time.monotonic() + DURATION_S + 20.0
        while time.monotonic() < end and any(each.jtqd.poll() is None for each in daemons.values()):
            time.sleep(_LOOK_S)
            for each in daemons.values():
                each.read()
            at_once += all(each.all_valid for each in daemons.values())
        summaries = {config: each.summary() for config, each in daemons.items()}
        for config, each in daemons.items():
            assert min(each.valid.values()) > 0, (config, each.valid)
        return summaries, at_once


def check(summaries: dict[str, dict[str, Any]]) -> None:
    """In exact time nothing is missed; elsewhere nothing is lost in the logs."""
    for config, summary in summaries.items():
        names = [f"joint_{number}" for number in range(1, JOINTS[config] + 1)]
        assert list(summary["rmse_nm"]) == names
        with_sensor = config == "can0"
        assert [value is not None for value in summary["rmse_nm"].values()] == [with_sensor] * len(names)
        assert summary["recording"]["lost"] == 0
        assert not [each for each in summary["conditions"] if each["name"] in ("sensor_lost", "deviation")]
        if os.environ.get("JTQD_IN_BENCH_KERNEL"):
            assert (summary["missed"], summary["stale_inputs"]) == (0, 0), config


@pytest.mark.socketcan
@pytest.mark.usefixtures("interfaces")
@pytest.mark.parametrize(
    "buses", [("vcan0", "vcan3"), pytest.param(tuple(BUSES), marks=pytest.mark.campaign)], ids=len
)
def test_joints_on_several_buses_are_valid_at_once(tmp_path: Path, buses: tuple[str, ...]) -> None:
    """All seven on four, or three on two: with a sensor and without, two on a bus and one."""
    summaries, at_once = run(tmp_path, {bus: BUSES[bus] for bus in buses})
    check(summaries)
    assert sum(len(summary["rmse_nm"]) for summary in summaries.values()) == (
        7 if buses == tuple(BUSES) else 3
    )
    assert at_once > 0


@pytest.mark.socketcan
@pytest.mark.usefixtures("interfaces")
def test_four_joints_on_one_bus_at_500_hz(tmp_path: Path) -> None:
    summaries, at_once = run(tmp_path, {"vcan0": "four_joints"})
    check(summaries)
    assert summaries["four_joints"]["cycles"] == pytest.approx(500 * DURATION_S, rel=0.02)
    assert at_once > 0
