"""A cycle of the loop on a scripted bus: what comes after each SYNC is a function of its number."""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core import cycle as cycle_module
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, TemperaturePdo, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid, PythonClock
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared.cycle_record import Ring, RingReader, layout_of
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.drivers.frame_socket import BusDown
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped

I32 = struct.Struct("<ii")
MOTION = struct.Struct("<ihH")
SENSOR = struct.Struct("<iB")
PDOS = [
    InputPdo(0x181, 8, I32, 1, "181h"),
    InputPdo(0x281, 8, MOTION, 1, "281h"),
    InputPdo(0x182, 8, I32, 2, "182h"),
    InputPdo(0x282, 8, MOTION, 2, "282h"),
    InputPdo(0x183, 5, SENSOR, 3, "183h"),
]
SCALE = {
    "motor_rad_per_count": 1e-4,
    "motor_rad_s_per_unit": 1e-3,
    "link_rad_per_count": 1e-5,
    "ampere_per_unit": 0.01,
    "sensor_nm_per_unit": 0.001,
}
ENABLED = 0x27


def frame(can_id: int, data: bytes) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data), data)


class ExactTime:
    """Clock of a cycle and of its scripted bus: it goes on only by its methods, whatever the machine does meanwhile."""

    def __init__(self) -> None:
        self.now_ns = time.time_ns()

    def monotonic_ns(self) -> int:
        """Both clocks are one."""
        return self.now_ns

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        """Passes at once."""
        self.now_ns += round(seconds * 1e9)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> ExactTime:
        """Take the place of the clocks of cycles that are made from now on, and of module `time` in this file."""
        monkeypatch.setattr(cycle_module, "clock", PythonClock(self))
        monkeypatch.setattr(sys.modules[__name__], "time", self)
        return self

    def turn(self, cycle: Cycle, count: int = 1, before: dict[str, Callable[[], None]] | None = None) -> None:
        """Whole cycles, each begun exactly in its slot; `before` names what happens just before a stage."""
        grid = cycle.grid
        for _ in range(count):
            grid.slot_ns = self.now_ns = max(grid.slot_ns, self.now_ns) + grid.period_ns
            for stage in ("begin", "gather", "observe", "publish", "record"):
                if before and stage in before:
                    before[stage]()
                getattr(cycle, stage)()
            self.now_ns = grid.slot_ns


class ScriptedSocket:
    """Answers each SYNC with what the script gives; stands in for the bus where exact timing does not matter."""

    def __init__(self, script: Callable[[int], list[bytes]]) -> None:
        self.script = script
        self.frames = bytearray(16 * 32)
        self.stamps_ns: list[int] = []
        self.own: list[bool] = []
        self.sent: list[bytes] = []
        self.tx_dropped = self.rx_dropped = 0
        self.pending: list[tuple[bytes, bool]] = []
        self.syncs = 0
        self.down = False

    def fileno(self) -> int:
        return -1

    def send(self, data: bytes) -> bool:
        if self.down:
            raise BusDown("down")
        self.sent.append(bytes(data))
        if struct.unpack_from("<I", data)[0] == 0x080:
            self.syncs += 1
            self.pending = [(bytes(data), True)] + [(f, False) for f in self.script(self.syncs)]
        return True

    def receive(self) -> int:
        if self.down:
            raise BusDown("down")
        batch, self.pending = self.pending, []
        for n, (data, _) in enumerate(batch):
            self.frames[16 * n : 16 * n + 16] = data
        now = time.time_ns()
        self.stamps_ns = [now + n for n in range(len(batch))]
        self.own = [own for _, own in batch]
        return len(batch)

    def wait(self, timeout_s: float) -> bool:
        return False


def inputs(
    velocity: int = 5000, current: int = 200, status: int = ENABLED, torque: int = 9000
) -> list[bytes]:
    return [
        frame(0x181, I32.pack(1000, 2000)),
        frame(0x281, MOTION.pack(velocity, current, status)),
        frame(0x182, I32.pack(-1000, -2000)),
        frame(0x282, MOTION.pack(-velocity, current, ENABLED)),
        frame(0x183, SENSOR.pack(torque, 0)),
    ]


def _turned(sync: int, more: int, cycles: int) -> int:
    """Return the sum up to `sync` of a tenth of 4000 + more (n % cycles)."""
    saws, rest = divmod(sync, cycles)
    return 400 * sync + more * (saws * cycles * (cycles - 1) + rest * (rest + 1)) // 20


def moving(sync: int) -> list[bytes]:
    """Both joints turn at about 4 rad/s of the motor, every cycle is different; inputs are missing now and then."""
    one, two = _turned(sync, 7, 300), _turned(sync, 5, 200)
    frames = [
        frame(0x181, I32.pack(one, one // 10)),
        frame(0x281, MOTION.pack(4000 + 7 * (sync % 300), 100 + sync % 97, ENABLED)),
        frame(0x182, I32.pack(-two, -two // 10)),
        frame(0x282, MOTION.pack(-4000 - 5 * (sync % 200), 90 - sync % 61, ENABLED)),
        frame(0x183, SENSOR.pack(9000 + sync, 0)),
    ]
    if sync % 41 == 0:
        del frames[1]
    return frames


def build(
    directory: Path,
    socket: ScriptedSocket,
    intake: Intake,
    joints: Sequence[tuple[JointInputs, Any]],
    grid: Grid,
    *,
    slots: int = 64,
    counter_overflow: int = 240,
    heartbeat_cycles: int = 100,
    **options: Any,
) -> tuple[Cycle, RingReader]:
    """A cycle on memory in this directory."""
    size = layout_of(len(joints), any(options.get("shadows") or ())).size
    cycle = Cycle(
        socket,  # type: ignore[arg-type]
        intake,
        joints,
        Ring(directory / "ring", slots, size),
        Snapshot(directory / "snapshot", 1e-3, 0.8, len(joints)),
        node_id=0x20,
        counter_overflow=counter_overflow,
        wait_ns=0,
        deadline_ns=100_000,
        heartbeat_cycles=heartbeat_cycles,
        grid=grid,
        **options,
    )
    return cycle, RingReader(directory / "ring", size)


def make(
    tmp_path: Path,
    script: Callable[[int], list[bytes]],
    *,
    temperatures: Sequence[TemperaturePdo] = (),
    estimators: Sequence[Any] | None = None,
    safety: Sequence[JointSafety] | None = None,
    slots: int = 64,
    counter_overflow: int = 240,
    shadows: Sequence[Sequence[Any]] = (),
) -> tuple[Cycle, ScriptedSocket, RingReader]:
    """A cycle with both joints by method efficiency; `temperatures` and `shadows` are of joint 1 and 2, in this order."""
    socket = ScriptedSocket(script)
    settings = EstimatorSettings(method="efficiency")
    if estimators is None:
        estimators = [JointEstimator(load_joint(shipped(f"joint{n}.yaml")), settings) for n in (1, 2)]
    joints = [
        (
            JointInputs(drive_places(2 * n), 4, temperature=n if n < len(temperatures) else None, **SCALE),
            estimators[n],
        )
        for n in range(2)
    ]
    grid, intake = Grid(time.monotonic_ns(), 10_000_000), Intake(PDOS, temperatures)
    options = {"safety": safety, "shadows": shadows}
    cycle, reader = build(
        tmp_path, socket, intake, joints, grid, slots=slots, counter_overflow=counter_overflow, **options
    )
    return cycle, socket, reader


def turn(cycle: Cycle, count: int = 1, **before: Callable[[], None]) -> None:
    """Whole cycles; `before` names what happens just before a stage."""
    for _ in range(count):
        for stage in ("begin", "gather", "observe", "publish", "record"):
            before.get(stage, lambda: None)()
            getattr(cycle, stage)()
        if isinstance(time, ExactTime):
            time.now_ns += cycle.grid.period_ns
        cycle.grid.slot_ns = time.monotonic_ns()


def estimates(socket: ScriptedSocket) -> list[bytes]:
    return [data[8:16] for data in socket.sent if struct.unpack_from("<I", data)[0] == 0x1A0]
