"""jtqd as guest and as listener on real SocketCAN, beside a master of the canopen library."""

from __future__ import annotations

import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.frame import CAN_EFF_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from tests.paths import EDS
from tests.shipped_bench import shipped_bench

pytestmark = [pytest.mark.socketcan]
INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
OWN = (0x1A0, 0x720, 0x0A0, 0x5A0)
GIVEN = {
    "608Fh:1": 65536,
    "608Fh:2": 1,
    "6090h:1": 65536,
    "6090h:2": 1,
    "60E6h:1": 524288,
    "60EBh:1": 1,
    "6075h:0": 8000,
}
TPDOS = {1: [0x60640020, 0x60E40120], 2: [0x606C0020, 0x60780010, 0x60410010]}


def dcf_of_the_drive(path: Path) -> None:
    """The bench's drive as a master's tool writes it: the EDS with ParameterValue where the device is configured."""
    values = {
        f"{key[:4]}sub{key[6:]}" if key[:4] != "6075" else "6075": value for key, value in GIVEN.items()
    }
    values |= {"6091sub1": 100, "6091sub2": 1}
    for number, words in TPDOS.items():
        index = f"1A0{number - 1}"
        values |= {f"{index}sub0": len(words), f"180{number - 1}sub2": 1}
        values |= {f"{index}sub{n}": word for n, word in enumerate(words, 1)}
    text, missing = (EDS / "drive.eds").read_text(), []
    for section, value in values.items():
        text, count = re.subn(rf"(?im)^\[{section}\]$", f"[{section}]\nParameterValue={value}", text)
        missing += [] if count else [section]
    assert missing == []
    path.write_text(text)


def configuration(directory: Path, *, dcf: bool, **changes: Any) -> Path:
    content = shipped_bench()
    content["estimator"]["shadow"] = []
    for n in (1, 2):
        joint = content[f"joint_{n}"]
        joint.pop("shadow_networks")
        if dcf:
            joint["eds"] = "drive.dcf"
        else:
            joint["given"] = GIVEN | {"6091h:1": 100, "6091h:2": 1}
            joint["tpdos"] = [
                {"number": k, "cob_id": 0x80 + 0x100 * k + n, "objects": words} for k, words in TPDOS.items()
            ]
    content["sensor"]["given"] = {"6131h:1": 0x00230000, "6132h:1": 3}
    content["role"] = "guest"
    dcf_of_the_drive(directory / "drive.dcf")
    path = directory / "guest.yaml"
    path.write_text(yaml.safe_dump({**content, **changes}))
    return path


class Robot:
    """Bench, master of the library and jtqd on one bus; every frame is heard."""

    def __init__(self, directory: Path, *options: str, dcf: bool = True, **changes: Any) -> None:
        self.directory = directory
        (directory / "run").mkdir()
        self.socket = open_frame_socket(INTERFACE, [CanFilter(0, CAN_EFF_FLAG)])
        self.bench = self._run("jtqd.sim_can", "--bus", INTERFACE, "--seed", "1", "--profile", "demo")
        self.master = self._run("tests.daemon.bus.library_master", "socketcan", INTERFACE)
        assert self.master.stdout is not None
        assert self.master.stdout.readline() == "ready\n"
        self.frames: list[tuple[float, int, bytes]] = []
        self.log = directory / "stderr"
        path = configuration(directory, dcf=dcf, **changes)
        with open(self.log, "w") as log:
            self.jtqd = subprocess.Popen(
                [
                    *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", INTERFACE, "--config", str(path)),
                    *("--record", "none", *options),
                ],
                env={**os.environ, "RUNTIME_DIRECTORY": str(directory / "run")},
                stdout=subprocess.PIPE,
                stderr=log,
            )

    def _run(self, module: str, *arguments: str) -> subprocess.Popen[str]:
        with open(self.directory / "errors", "a") as errors:
            return subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )

    def order(self, line: str) -> None:
        assert self.master.stdin is not None
        print(line, file=self.master.stdin, flush=True)

    def hear(self, seconds: float) -> list[tuple[float, int, bytes]]:
        """Frames of the next seconds."""
        begun, end = len(self.frames), time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.socket.wait(left)
            count = self.socket.receive()
            for n, stamp_ns in zip(range(count), self.socket.stamps_ns, strict=False):
                can_id, length, data = FRAME.unpack_from(self.socket.frames, 16 * n)
                self.frames.append((stamp_ns * 1e-9, can_id, bytes(data[:length])))
        return self.frames[begun:]

    def until(self, condition: Callable[[], bool], longest_s: float = 10.0) -> None:
        end = time.monotonic() + longest_s
        while not condition():
            assert time.monotonic() < end, self.state()
            assert self.jtqd.poll() is None, self.state()
            self.hear(0.02)

    def state(self) -> str:
        """What a failure needs: the log, the last statuses, what was heard of late."""
        late = Counter(can_id for _, can_id, _ in self.frames[-3000:])
        heard = ", ".join(f"{can_id:03X}h {n}" for can_id, n in sorted(late.items()))
        errors = (self.directory / "errors").read_text()
        return f"{self.log.read_text()}\n{self.statuses()[-50:]}\n{heard}\n{errors}"

    def logged(self, words: str) -> bool:
        return words in self.log.read_text()

    def statuses(self) -> list[int]:
        """Of joint 1, of the last estimates."""
        return [decode(data).status[0] for _, can_id, data in self.frames[-3000:] if can_id == 0x1A0]

    def wrong(self) -> list[tuple[float, float]]:
        """Torques of joint 1 with status 2 or 6 that the sensor of the cycle before does not bear out: (torque, sensor)."""
        found, sensor_nm = [], None
        for _, can_id, data in self.frames:
            if can_id == 0x183:
                sensor_nm = struct.unpack_from("<i", data)[0] * 1e-3
            elif can_id == 0x1A0 and sensor_nm is not None:
                pdo = decode(data)
                torque, sigma = pdo.torque_nm[0], pdo.sigma_nm[0]
                allowed = max(2.0, 4.0 * (99.0 if sigma is None else sigma))
                if pdo.status[0] in (2, 6) and torque is not None and abs(torque - sensor_nm) > allowed:
                    found.append((torque, sensor_nm))
        return found

    def emcys(self, code: int, since_s: float) -> list[float]:
        """Times of jtqd's EMCY messages with this code."""
        start = code.to_bytes(2, "little")
        return [
            at for at, can_id, data in self.frames if can_id == 0x0A0 and at > since_s and data[:2] == start
        ]

    def has_sent(self, code: int, since_s: float) -> bool:
        return code == 0 or self.emcys(code, since_s) != []

    def answers(self) -> int:
        """How many answers come to one SDO request to jtqd's node."""
        self.socket.send(pack(0x620, bytes.fromhex("4000100000000000")))
        return sum(can_id == 0x5A0 for _, can_id, _ in self.hear(0.2))

    def end(self) -> None:
        for process in (self.jtqd, self.master, self.bench):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait(20)
        self.socket.close()
        assert "Traceback" not in self.log.read_text()


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Callable[..., Robot]]:
    made: list[Robot] = []

    def make(*options: str, **changes: Any) -> Robot:
        made.append(Robot(tmp_path, *options, **changes))
        return made[-1]

    yield make
    for robot in made:
        robot.end()


def test_beside_a_master_of_the_library(robots: Callable[..., Robot]) -> None:
    """From a bus without SYNC to valid torques; then all that its master may do to it."""
    robot = robots()
    robot.until(lambda: robot.logged("no SYNC of the master since the start"), 30.0)
    assert {can_id for _, can_id, _ in robot.hear(0.5) if can_id in range(0x100, 0x700)} == set()
    robot.order("boot")
    robot.until(lambda: robot.statuses()[-200:] == [3] * 200)  # nobody has checked the identity
    robot.order("identify")
    robot.until(lambda: robot.statuses()[-200:] == [2] * 200)
    heard = robot.hear(1.0)
    ids = [can_id for _, can_id, _ in heard]
    assert abs(ids.count(0x080) - ids.count(0x1A0)) <= 2
    assert set(ids) <= {0x080, 0x181, 0x281, 0x182, 0x282, 0x183, 0x381, 0x382, 0x701, 0x702, 0x703, *OWN}
    assert 9 <= ids.count(0x720) <= 11
    syncs = [at for at, can_id, _ in heard if can_id == 0x080]
    assert len(syncs) == pytest.approx(1000, abs=3)
    assert robot.answers() == 1
    for order, words, code in (
        ("remap", "node 1: its configuration was changed (1", 0xFF03),
        ("period 0.002", "SYNC does not come every 1000 us", 0x8150),
        ("pause 0.5", "no SYNC of the master for 0.1 s", 0x8100),
        ("stop", "jtqd is stopped", 0),
    ):
        begun_s, lines = robot.frames[-1][0], len(robot.log.read_text())
        robot.order(order)
        robot.until(partial(robot.has_sent, code, begun_s), 0.5)
        emcys = robot.emcys(code, begun_s)
        assert not code or emcys[0] < begun_s + 0.25, robot.state()
        stopped_s = (emcys[0] if code else begun_s) + 0.05
        robot.hear(0.3)
        torques = [
            at
            for at, can_id, data in robot.frames
            if can_id == 0x1A0 and at > stopped_s and decode(data).torque_nm[0] is not None
        ]
        assert order.startswith("pause") or torques == [], order
        robot.until(lambda words=words, lines=lines: words in robot.log.read_text()[lines:], 6.0)
        assert robot.answers() == (order != "stop")
        robot.order({"remap": "restore", "period 0.002": "period 0.001", "stop": "boot"}.get(order, "start"))
        robot.until(lambda: robot.statuses()[-200:] in ([2] * 200, [3] * 200))
        robot.order("identify")
        robot.until(lambda: robot.statuses()[-200:] == [2] * 200)
    assert robot.wrong() == []
    assert not robot.logged("latched")


def test_a_listener_sends_nothing(robots: Callable[..., Robot]) -> None:
    robot = robots("--listener", "--duration", "2", dcf=False)
    robot.order("boot")
    heard = robot.hear(1.5)
    assert {can_id for _, can_id, _ in heard}.isdisjoint(OWN)
    assert robot.answers() == 0
    assert robot.jtqd.poll() is None
    heard = robot.hear(1.0)
    assert {can_id for _, can_id, _ in heard}.isdisjoint(OWN)
    assert robot.jtqd.wait(20) == 0
    assert robot.jtqd.stdout is not None
    assert b"RMSE joint 1" in robot.jtqd.stdout.read()


@pytest.mark.campaign
def test_a_long_time_beside_the_library(robots: Callable[..., Robot]) -> None:
    """Estimates before the next SYNC in 99.9 % of 200 000 cycles, every frame accounted for."""
    robot = robots(dcf=False)
    robot.until(lambda: robot.logged("no SYNC of the master since the start"), 30.0)
    robot.order("boot")
    robot.until(lambda: robot.statuses()[-200:] == [2] * 200)
    robot.frames.clear()
    heard = robot.hear(200.0)
    order = "".join({0x080: "s", 0x1A0: "e"}.get(can_id, "") for _, can_id, _ in heard)
    print(f"{order.count('s')} SYNCs, {order.count('se')} with an estimate before the next one")
    assert order.count("se") >= 0.999 * order.count("s") > 190_000
    assert {can_id for _, can_id, _ in heard if can_id & 0x7F in {0x00, 0x20}} <= {0x080, *OWN}
    assert robot.wrong() == []
