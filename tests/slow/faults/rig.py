"""The emulated bench on a SocketCAN interface with a hook between its nodes and the bus, jtqd beside it, and its watcher.

One thread does all of it: so a fault knows the cycle it works in, and the watcher sees the bus in its order. Times are
CLOCK_MONOTONIC in ns; in the bench kernel with time travel they are exact.
"""

from __future__ import annotations

import heapq
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jtqd.daemon.core.estimate_pdo import LAYOUT, NO_TORQUE, PUBLISHED_STATUSES
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import BusDown, open_frame_socket
from jtqd.drivers.nmt import NOT_OPERATIONAL
from jtqd.models.files import shipped
from jtqd.sim_can.bench import Bench, bench_filters
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource
from tests.library_drives.in_step import LibraryNodes
from tests.processes import of_module
from tests.slow.faults.injections import Fault
from tests.slow.faults.listener import Ears

MS = 1_000_000
DEADLINE_NS = 800_000
"""Inputs that are sent later than this after SYNC count as withheld (`inputs.deadline_us` is 850)."""
SYNC, OWN_EMCY, ESTIMATE = 0x080, 0x0A0, 0x1A0
_NEEDED = ({0x181, 0x281}, {0x182, 0x282})
_RESTED_NS = 350 * MS
"""Longer than a node is let be after its boot (`jtqd.daemon.bus.boot`)."""


GOOD = frozenset({2, 3, 6})
RECOVERED_FROM_BUS_OFF = 0x8140
ALL_IN_TIME = (True, True)
_FLOWING = frozenset({"cycles", "complete", "published", "bits_worst_case", "work_max_ns", "late_max_ns"})
"""Counters that rise in good health too."""


class Estimate(NamedTuple):
    """One estimate PDO: when it came [ns, monotonic] and both statuses."""

    at_ns: int
    status: tuple[int, int]


class Emergency(NamedTuple):
    """One EMCY of jtqd: when [ns, monotonic], the code, and the code that has gone where the code is 0."""

    at_ns: int
    code: int
    gone: int


class Watcher:
    """Call `sync`, `delivered`, `estimate` and `emcy` in the order of the bus.

    Attributes:
        seen, told: estimates and EMCY since `begin`.
        present: errors of jtqd that have come and not gone: (code, detail).
        broken: invariants that did not hold, one line each (the first ten).
    """

    def __init__(self) -> None:
        self.seen: list[Estimate] = []
        self.told: list[Emergency] = []
        self.present: set[tuple[int, int]] = set()
        self.broken: list[str] = []
        self.counter = 0
        self._complete = ALL_IN_TIME
        self._answered = True

    def begin(self) -> None:
        """A new case: forget what was seen; errors that are present stay."""
        self.seen, self.told, self.broken = [], [], []

    def sync(self, counter: int) -> None:
        """A SYNC of jtqd; until `delivered` says otherwise its cycle has no inputs."""
        self.counter, self._complete, self._answered = counter, (False, False), False

    def delivered(self, joints: tuple[bool, bool]) -> None:
        """Which joints' inputs were sent in this cycle: whole, unchanged in length, before the deadline."""
        self._complete = joints

    def spoil(self) -> None:
        """Something makes every input of this cycle doubtful (a foreign SYNC)."""
        self._complete = (False, False)

    def estimate(self, data: bytes, at_ns: int) -> None:
        if len(data) != LAYOUT.size:
            self._break(f"an estimate of {len(data)} bytes")
            return
        torque_1, torque_2, _, _, both, sequence = LAYOUT.unpack(data)
        status = (both & 0x0F, both >> 4)
        self.seen.append(Estimate(at_ns, status))
        for n, (torque, code) in enumerate(zip((torque_1, torque_2), status, strict=True)):
            if code not in PUBLISHED_STATUSES:
                if torque != NO_TORQUE:
                    self._break(f"joint {n + 1}: torque {torque} with status {code}")
                continue
            if sequence != self.counter:
                self._break(f"joint {n + 1}: status {code} with sequence {sequence}, SYNC was {self.counter}")
            elif not self._complete[n]:
                self._break(f"joint {n + 1}: status {code} in cycle {sequence}, whose input was withheld")
        if self._answered and any(code in PUBLISHED_STATUSES for code in status):
            self._break(f"two estimates for SYNC {self.counter}")
        self._answered = True

    def emcy(self, data: bytes, at_ns: int) -> None:
        code, ended = int.from_bytes(data[0:2], "little"), int.from_bytes(data[3:5], "little")
        detail = int.from_bytes(data[5:7], "little")
        self.told.append(Emergency(at_ns, code, ended))
        if code == RECOVERED_FROM_BUS_OFF:
            return  # tells an end itself, and is not taken back
        if code:
            self.present.add((code, detail))
        else:
            self.present.discard((ended, detail))

    def well(self, count: int) -> bool:
        """Both joints had a torque in the last `count` estimates."""
        last = self.seen[-count:]
        return len(last) == count and all(each in GOOD for one in last for each in one.status)

    def bad(self) -> tuple[frozenset[int], frozenset[int]]:
        one, two = (frozenset(each.status[n] for each in self.seen) - GOOD for n in (0, 1))
        return one, two

    def first_bad_ns(self) -> int | None:
        return next((each.at_ns for each in self.seen if not GOOD.issuperset(each.status)), None)

    def well_again_ns(self) -> int | None:
        """When the first estimate came after which both joints had a torque in each."""
        bad = [n for n, each in enumerate(self.seen) if not GOOD.issuperset(each.status)]
        if not bad or bad[-1] + 1 == len(self.seen):
            return None
        return self.seen[bad[-1] + 1].at_ns

    def _break(self, text: str) -> None:
        if len(self.broken) < 10:
            self.broken.append(text)


def rises(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    return {name: after[name] - n for name, n in before.items() if after[name] > n and name not in _FLOWING}


class DaemonEndedError(Exception):
    """jtqd has ended; the text is what it said."""


class Rig:
    """Bench, jtqd and watcher. Context manager.

    Attributes:
        bench: the nodes (`jtqd.sim_can.bench.Bench`, or those of the library); a fault may reach into them.
        fault: what is between them and the bus now.
        cycle: SYNCs of jtqd heard so far.
        watcher: what jtqd publishes and says.
        ears: an independent listener.
    """

    def __init__(self, bus: str, directory: Path, seed: int = 1, *, library: bool = False) -> None:
        self.bus, self._directory, self._library = bus, directory, library
        self.bench: Any = (
            LibraryNodes()
            if library
            else Bench(PlantSource(load_plant(shipped("campaign_plant.yaml")), seed), "demo")
        )
        self.fault = self.healthy = Fault()
        self.watcher = Watcher()
        self.cycle = 0
        self._delayed: list[tuple[int, int, bytes]] = []
        self._number = 0
        self._down = False
        self._sync_at_ns = 0
        self._booting_ns = 0
        self._open()
        self.ears = Ears(bus, sync_length=0 if library else 1)

    def __enter__(self) -> Rig:
        (self._directory / "run").mkdir()
        self.emit(self.bench.tick(time.monotonic_ns()))
        with open(self._directory / "stderr", "w") as log:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", self.bus, "--record", "none"),
                    *("--config", self._configuration()),
                ],
                env={**os.environ, "RUNTIME_DIRECTORY": str(self._directory / "run")},
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        try:
            if not self.until(lambda: self.watcher.well(100), 60.0):
                raise DaemonEndedError(f"no estimate within 60 s: {self.said()}")
            (snapshot,) = (self._directory / "run").glob("*/snapshot")
            self.reader = SnapshotReader(snapshot)
            loop = of_module(self.process.pid, "jtqd.daemon.loop.process")
            if loop is None:
                raise DaemonEndedError(f"no loop process: {self.said()}")
            self.loop_pid = loop
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            end_ns = time.monotonic_ns() + 20_000 * MS
            while self.process.poll() is None and time.monotonic_ns() < end_ns:
                self._turn(5 * MS)
            if self.process.poll() is None:
                self.process.kill()
            self.process.wait()
        if self._library:
            self.bench.close()
        self.ears.end()
        self.socket.close()

    def _configuration(self) -> str:
        content: dict[str, Any] = yaml.safe_load(shipped("bench.yaml").read_text())
        # so that each frame on the bus shows its cycle; a strict node loses 1019h when it restarts
        content["sync"]["counter_overflow"] = 0 if self._library else 240
        content["estimator"] = {"method": "efficiency"}  # the start is short
        for number in (1, 2):
            joint = content[f"joint_{number}"]
            joint["file"] = str(shipped(f"joint{number}.yaml"))
            identity = self.bench.drives[0].store
            joint["identity"] = {"vendor": identity.number(0x1018, 1), "product": identity.number(0x1018, 2)}
            if self._library:  # no 3001h; its sensor tells another torque than its current
                del joint["temperature"], joint["sensor_channel"]
        path = self._directory / "configuration.yaml"
        path.write_text(yaml.safe_dump(content))
        return str(path)

    def _open(self) -> None:
        own = (exact(ESTIMATE), exact(OWN_EMCY), exact(0x5A0))
        self.socket = open_frame_socket(self.bus, [*bench_filters(), *own])

    # For faults ---------------------------------------------------------------------------------------------

    def send(self, can_id: int, data: bytes = b"") -> None:
        """A frame of somebody who is not on the bench; its nodes do not hear it. Lost while the interface is down."""
        self._transmit(pack(can_id, data))

    def inject(self, can_id: int, data: bytes = b"") -> None:
        """A frame of somebody else that the nodes hear too, and answer."""
        self.send(can_id, data)
        now_ns = time.monotonic_ns()
        self.emit(self.bench.on_frame(can_id, data, time.time_ns(), now_ns))

    def counters(self) -> dict[str, int]:
        return self.reader.read().counters

    def configured(self) -> bool:
        """No node waits for its configuration, or for the heartbeat with which a boot in service ends."""
        view = self.reader.read()
        states = (view.node_states[number] for number in (1, 2, 3))
        if view.unconfigured or any(state in NOT_OPERATIONAL for state in states):
            self._booting_ns = time.monotonic_ns()
            return False
        return True

    def rested(self) -> bool:
        """The same for a while: jtqd does not boot a node again at once."""
        return self.configured() and time.monotonic_ns() - self._booting_ns > _RESTED_NS

    def report(self) -> Any:
        return json.loads(next((self._directory / "run").glob("*/bus.json")).read_text())

    def said(self) -> str:
        return (self._directory / "stderr").read_text()

    def until(self, condition: Callable[[], bool], longest_s: float) -> bool:
        """Go on until the condition holds; False: not within the time."""
        end_ns = time.monotonic_ns() + round(longest_s * 1e9)
        while not condition():
            left_ns = end_ns - time.monotonic_ns()
            if left_ns <= 0:
                return False
            if self.process.poll() is not None:
                raise DaemonEndedError(f"jtqd ended with {self.process.returncode}: {self.said()[-2000:]}")
            self._turn(min(left_ns, 10 * MS))
        return True

    # The loop -----------------------------------------------------------------------------------------------

    def _turn(self, longest_ns: int) -> None:
        now_ns = time.monotonic_ns()
        if now_ns >= self.bench.due_ns:
            self.emit(self.bench.tick(now_ns))
        while self._delayed and self._delayed[0][0] <= time.monotonic_ns():
            self._transmit(heapq.heappop(self._delayed)[2])
        wake_ns = min(self.bench.due_ns, now_ns + longest_ns)
        if self._delayed:
            wake_ns = min(wake_ns, self._delayed[0][0])
        try:
            if self.socket.wait(max(wake_ns - time.monotonic_ns(), 0) * 1e-9):
                self._receive()
        except BusDown:
            time.sleep(0.001)

    def _receive(self) -> None:
        count = self.socket.receive()
        frames, stamps = bytes(self.socket.frames[: 16 * count]), list(self.socket.stamps_ns[:count])
        now_ns = time.monotonic_ns()
        for n in range(count):
            can_id, length, data = FRAME.unpack_from(frames, 16 * n)
            if can_id & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG):
                continue
            number, data = data[0], data[:length]
            if can_id == ESTIMATE:
                self.watcher.estimate(data, now_ns)
            elif can_id == OWN_EMCY:
                self.watcher.emcy(data, now_ns)
            elif can_id == SYNC:
                self._on_sync(number, data, stamps[n], now_ns)
            elif self.fault.hears(can_id):
                self.emit(self.bench.on_frame(can_id, data, stamps[n], now_ns))

    def _on_sync(self, number: int, data: bytes, stamp_ns: int, now_ns: int) -> None:
        """Take jtqd's SYNC; its number lies behind the end of the data where it has no counter."""
        self.cycle += 1
        self._sync_at_ns = now_ns
        self.watcher.sync(number)
        if self.fault.hears(SYNC):
            sent = self.emit(self.bench.on_frame(SYNC, data, stamp_ns, now_ns))
            one, two = (needed <= sent for needed in _NEEDED)
            self.watcher.delivered((one, two))
        self.fault.each_cycle(self)

    def emit(self, frames: list[bytes]) -> set[int]:
        """Send what nodes say, through the fault. Returns the identifiers that went out in time, whole."""
        sent = set()
        for frame in frames:
            can_id, length, data = FRAME.unpack(frame)
            for delay_ns, other_id, other in self.fault.passes(can_id, data[:length]):
                if delay_ns <= 0:
                    self._transmit(pack(other_id, other))
                else:
                    self._number += 1
                    due_ns = time.monotonic_ns() + delay_ns
                    heapq.heappush(self._delayed, (due_ns, self._number, pack(other_id, other)))
                if delay_ns < DEADLINE_NS and len(other) == length:
                    sent.add(other_id)
        return sent

    def _transmit(self, frame: bytes) -> None:
        with suppress(BusDown):
            self.socket.send(frame)
