"""jtqd as a process on a hub, or on vcan, with the nodes of the library in another one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import yaml

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.frame import CAN_EFF_FLAG, FRAME
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.models.files import shipped

STALE = 4
_FRESH = 20
_PERIOD_US = 10_000
"""The library's nodes run in one interpreter: slow enough for it, also on a busy machine."""


class LibraryBench:
    """Hub (or a SocketCAN interface), drives 1 and 2, sensor 3. Context manager; `start` starts a jtqd.

    Attributes:
        statuses, torques_nm: of both joints, of the estimate PDOs since the last `forget_frames`.
        heard: every other frame but SYNC and inputs.
    """

    def __init__(self, directory: Path, *manners: str, bus: str | None = None) -> None:
        self.directory = directory
        self._processes: list[subprocess.Popen[str]] = []
        self._hub = bus is None
        self.bus = f"unix:{directory / 'hub'}" if bus is None else bus
        self._manners = manners
        self.statuses: list[tuple[int, int]] = []
        self.torques_nm: list[tuple[float | None, float | None]] = []
        self.heard: list[tuple[int, bytes]] = []
        self.logs: list[Path] = []
        self.runs: list[Path] = []
        self._sync_s = 0.0

    def __enter__(self) -> Self:
        if self._hub:
            self._run("jtqd.drivers.hub", self.bus)
            assert _until(lambda: Path(self.bus.removeprefix("unix:")).exists())
        self.nodes = self._run("tests.library_drives", self.bus, *self._manners)
        assert self.nodes.stdout is not None
        assert self.nodes.stdout.readline() == "ready\n"
        self.socket = open_frame_socket(self.bus, [CanFilter(0, CAN_EFF_FLAG)])
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.terminate()
                process.wait(20)
        self.socket.close()
        for log in self.logs:
            assert "Traceback" not in log.read_text()

    def _run(self, module: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            **options,
        )
        self._processes.append(process)
        return process

    def order(self, text: str) -> Any:
        """Give the nodes an order (see `__main__`) and return the answer."""
        assert self.nodes.stdin is not None
        assert self.nodes.stdout is not None
        self.nodes.stdin.write(text + "\n")
        self.nodes.stdin.flush()
        return json.loads(self.nodes.stdout.readline())

    def start(self, config: Path | None = None, **changes: Any) -> subprocess.Popen[str]:
        """Start a jtqd, with these sections of its configuration changed, or with a configuration of one's own."""
        self.forget_frames()
        log = self.directory / f"stderr{len(self.logs)}"
        self.logs.append(log)
        run = self.directory / f"run{len(self.logs)}"
        run.mkdir()
        self.runs.append(run)
        path = str(config) if config is not None else self.configuration(**changes)
        arguments = ["--bus", self.bus, "--record", "none", "--config", path]
        with open(log, "w") as stream:
            environment = {**os.environ, "RUNTIME_DIRECTORY": str(run)}
            return self._run("jtqd.daemon.jtqd", *arguments, stderr=stream, env=environment)

    @contextmanager
    def served(
        self, config: Path | None = None, longest_s: float = 20.0, **changes: Any
    ) -> Iterator[subprocess.Popen[str]]:
        """Have a jtqd that uses both joints, and end it in order."""
        jtqd = self.start(config, **changes)
        self.expect(self.both_used, longest_s)
        yield jtqd
        assert self.stop(jtqd) == 0

    def expect(self, condition: Callable[[], bool] | str, longest_s: float = 20.0) -> None:
        """Listen until a condition holds, or a text is in the log."""
        wanted = condition if callable(condition) else lambda: condition in self.log_text()
        assert self.until(wanted, longest_s), self.log_text()

    def moves(self) -> bool:
        """A torque of more than 2 Nm was sent."""
        return any(torque and abs(torque) > 2.0 for pair in self.torques_nm for torque in pair)

    def pairs(self) -> list[tuple[float, float]]:
        """Torques of cycles in which both joints had one, but for the first."""
        found = self.torques_nm[100:]
        return [(one, two) for one, two in found if one is not None and two is not None]

    def log_text(self) -> str:
        """Standard error of the last jtqd."""
        return self.logs[-1].read_text()

    def configuration(self, **changes: Any) -> str:
        """Write a configuration for these nodes and return its path."""
        content = yaml.safe_load(shipped("bench.yaml").read_text())
        content["sync"] = {"period_us": _PERIOD_US}
        del content["inputs"]
        content["estimator"] = {"method": "efficiency"}
        content["safety"] = {"latch": []}
        for number in (1, 2):
            joint = content[f"joint_{number}"]
            del joint["temperature"]
            joint["file"] = str(shipped(f"joint{number}.yaml"))
        for key, value in changes.items():
            content[key] = {**content.get(key, {}), **value} if isinstance(value, dict) else value
        path = self.directory / f"c{len(self.logs)}.yaml"
        path.write_text(yaml.safe_dump(content))
        return str(path)

    def listen(self) -> None:
        """Take what has come."""
        while count := self.socket.receive():
            for n in range(count):
                can_id, length, data = FRAME.unpack_from(self.socket.frames, 16 * n)
                if can_id == 0x1A0:
                    estimate = decode(bytes(data))
                    self.statuses.append(estimate.status)
                    self.torques_nm.append(estimate.torque_nm)
                elif can_id == 0x080:
                    self._sync_s = time.monotonic()
                elif not 0x180 <= can_id < 0x580:
                    self.heard.append((can_id, bytes(data[:length])))

    def forget_frames(self) -> None:
        """Forget what was heard."""
        self.listen()
        self.statuses.clear()
        self.torques_nm.clear()
        self.heard.clear()

    def until(self, condition: Callable[[], bool], longest_s: float = 20.0) -> bool:
        """Listen until `condition()`; False: not within the time."""

        def turn() -> bool:
            self.socket.wait(0.02)
            self.listen()
            return condition()

        return _until(turn, longest_s)

    def both_used(self) -> bool:
        """Both joints have had their inputs for a while."""
        last = self.statuses[-_FRESH:]
        return len(last) == _FRESH and sum(STALE in each for each in last) <= 2

    def joint_stale(self, joint: int) -> bool:
        """This joint (0, 1) has had no inputs for a while."""
        last = self.statuses[-_FRESH:]
        return len(last) == _FRESH and all(each[joint] == STALE for each in last)

    def stop(self, jtqd: subprocess.Popen[str], number: int = signal.SIGTERM) -> int:
        """End a jtqd by a signal and return its exit status, when its loop has ended as well."""
        jtqd.send_signal(number)
        status = jtqd.wait(20)
        assert self.until(lambda: time.monotonic() - self._sync_s > 0.1)
        return status

    def emergencies(self, node: int) -> list[int]:
        """Codes of the EMCY messages of a node that were heard, without the resets."""
        codes = [int.from_bytes(data[:2], "little") for can_id, data in self.heard if can_id == 0x080 + node]
        return [code for code in codes if code]


def _until(condition: Callable[[], bool], longest_s: float = 20.0) -> bool:
    deadline = time.monotonic() + longest_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return False
