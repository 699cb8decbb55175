"""A loop in exact time on a bus where another master sends SYNC and NMT commands."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, Self

import pytest

from jtqd.daemon.core.estimate_pdo import EstimatePdo, decode
from jtqd.daemon.core.input_pdos import JointInputs, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid, SyncGrid
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.own_objects import loop_cob_ids
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import PDOS, SCALE, ExactTime, build, frame, moving

PERIOD_NS = 1_000_000
OWN = 0x20
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82
FIRST_NS, BETWEEN_NS = 20_000, 10_000
"""Delay of a cycle's first input after SYNC, and between two of them."""


def nmt(command: int, node: int = 0) -> bytes:
    return frame(0x000, bytes((command, node)))


class Wire:
    """A bus with scripted nodes; `follow` takes another master's SYNCs as (time, frame, number of the inputs)."""

    def __init__(self, clock: ExactTime, script: Callable[[int], list[bytes]] = moving) -> None:
        self.clock, self.script = clock, script
        self.frames = bytearray(16 * 64)
        self.stamps_ns: list[int] = []
        self.own: list[bool] = []
        self.tx_dropped = self.rx_dropped = 0
        self.sent: list[tuple[int, bytes]] = []
        self.queue: list[tuple[int, int, bytes, bool]] = []
        self.order = count()
        self.syncs: Iterator[tuple[int, bytes, int]] = iter(())
        self.own_syncs = 0
        self.stalls: tuple[int, int] | None = None

    def fileno(self) -> int:
        return -1

    def put(self, at_ns: int, data: bytes, *, own: bool = False) -> None:
        heapq.heappush(self.queue, (at_ns, next(self.order), bytes(data), own))

    def answer(self, at_ns: int, number: int) -> None:
        """What the drives and the sensor send after SYNC `number`."""
        for n, data in enumerate(self.script(number)):
            self.put(at_ns + FIRST_NS + n * BETWEEN_NS, data)

    def follow(self, syncs: Iterator[tuple[int, bytes, int]]) -> Self:
        self.syncs = syncs
        self._next_sync()
        return self

    def _next_sync(self) -> None:
        for at_ns, data, number in self.syncs:
            self.put(at_ns, data)
            self.answer(at_ns, number)
            return

    def send(self, data: bytes) -> bool:
        now_ns = self.clock.now_ns
        self.sent.append((now_ns, bytes(data)))
        self.put(now_ns, data, own=True)
        if struct.unpack_from("<I", data)[0] == 0x080:
            self.own_syncs += 1
            self.answer(now_ns, self.own_syncs)
        return True

    def receive(self) -> int:
        stamps, own = [], []
        while self.queue and self.queue[0][0] <= self.clock.now_ns and len(stamps) < 32:
            at_ns, _, data, mine = heapq.heappop(self.queue)
            if data[:4] == b"\x80\0\0\0" and not mine:
                self._next_sync()
            self.frames[16 * len(stamps) : 16 * len(stamps) + 16] = data
            stamps.append(at_ns)
            own.append(mine)
        self.stamps_ns, self.own = stamps, own
        return len(stamps)

    def stall(self, at_ns: int, for_ns: int) -> None:
        """The process gets no processor for so long."""
        self.stalls = at_ns, for_ns

    def wait(self, timeout_s: float) -> bool:
        if self.stalls and self.clock.now_ns >= self.stalls[0]:
            self.clock.now_ns, self.stalls = self.clock.now_ns + self.stalls[1], None
        end_ns = self.clock.now_ns + max(round(timeout_s * 1e9), 0)
        if self.queue and self.queue[0][0] <= end_ns:
            self.clock.now_ns = max(self.clock.now_ns, self.queue[0][0])
            return True
        self.clock.now_ns = end_ns
        return False

    def own_frames(self, base: int) -> list[tuple[int, bytes]]:
        """(time, data) of the frames that were sent with this COB-ID of the own node."""
        return [
            (at_ns, data[8 : 8 + data[4]])
            for at_ns, data in self.sent
            if struct.unpack_from("<I", data)[0] == base + OWN
        ]

    def estimates(self) -> list[tuple[int, EstimatePdo]]:
        return [(at_ns, decode(data)) for at_ns, data in self.own_frames(0x180)]


def regular(
    start_ns: int, *, period_ns: int = PERIOD_NS, counter: int = 0, first: int = 1, last: int = 1 << 60
) -> Iterator[tuple[int, bytes, int]]:
    """SYNCs of a master that keeps its period; with a counter byte 1..counter."""
    for number in range(first, last + 1):
        data = bytes([(number - 1) % counter + 1]) if counter else b""
        yield start_ns + (number - first) * period_ns, frame(0x080, data), number


class Loop:
    """A cycle as guest, listener or master, and what it wrote."""

    def __init__(
        self, directory: Path, clock: ExactTime, wire: Wire, role: str = "guest", **options: Any
    ) -> None:
        directory.mkdir(exist_ok=True)
        settings = EstimatorSettings(method="efficiency")
        joints = [
            (
                JointInputs(drive_places(2 * n), 4, **SCALE),
                JointEstimator(load_joint(shipped(f"joint{n + 1}.yaml")), settings),
            )
            for n in range(2)
        ]
        grid = Grid(0, PERIOD_NS) if role == "master" else SyncGrid(PERIOD_NS)
        own = () if role == "listener" else loop_cob_ids(OWN)
        options.setdefault("counter_overflow", 0)
        options["heartbeat_cycles"] = 0 if role == "listener" else 100
        self.cycle, self.ring = build(
            directory, wire, Intake(PDOS, (), own), joints, grid, slots=1 << 15, **options
        )  # type: ignore[arg-type]
        self.reader = SnapshotReader(directory / "snapshot", supervisor=True)
        self.wire, self.clock, self.role = wire, clock, role
        self.cycle.intake.claims = True
        self.records: list[Any] = []
        if role == "guest":
            self.cycle.reset_communication()

    def run(self, until_ns: int) -> Self:
        """Go on until a time, as `jtqd.daemon.loop.process.run` does."""
        while self.cycle.go_on(8, until_ns) != 2:
            if self.role == "master":
                self.cycle.skip(self.cycle.grid.advance(self.clock.now_ns))
        return self

    def read(self) -> list[Any]:
        """Records that were written since the last call."""
        return self.ring.read(1 << 15).records


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    """Return the clock of the cycles of a test."""
    return ExactTime().install(monkeypatch)
