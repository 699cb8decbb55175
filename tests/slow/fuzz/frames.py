"""Frames through the loop's own path: `jtqd.daemon.loop.process.run` on a `BusInTime`; an oracle knows each frame's SYNC.

What is on the bus after each SYNC: answers that carry its number, and everything that should not be there. Traffic comes in
episodes of one kind. In the strict ones the frames of a PDO keep their order, nobody else sends under its identifier, and no
frame is late by whole periods to within its usual arrival: there a valid estimate from a stale input is an error. In the
others (`LOOSE`) a frame cannot be distinguished from the right one; they are followed by calm cycles, and what was used in
them is counted apart.
"""

from __future__ import annotations

import heapq
import random
import struct
import time
import zlib
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from jtqd.daemon.core import cycle as cycle_module
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, TemperaturePdo, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid, PythonClock
from jtqd.daemon.loop import process as loop_module
from jtqd.daemon.loop.process import run
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from jtqd.drivers.frame_socket import CAPACITY, BusDown
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon import ring_records as rr
from tests.daemon.snapshots import counted
from tests.slow.soak.rig import rss_kb

_SYNC = 0x080
_ESTIMATE = 0x1A0
QUEUE = 4096
"""Frames that wait for the reader; what comes on top is lost and counted, as in a socket."""

Arrival = tuple[int, bytes, bool]
"""Time [ns], frame, whether it is the echo of one of ours."""
Script = Callable[[int, int, int], Iterable[Arrival]]
"""Number of the SYNC, when it was sent [ns], its counter: what arrives because of it, or after it."""


class BusInTime:
    """What comes after SYNC n is `script(n, time of the SYNC, its counter)`.

    Attributes:
        now_ns: the time, CLOCK_MONOTONIC and CLOCK_REALTIME alike.
        syncs: SYNCs sent.
        estimate: data of the last estimate PDO.
        given: frames handed to the reader, without echoes.
        slow_ns: so much longer takes each call of `receive`.
        oversleep_ns: so much later ends the next sleep.
        down: the interface is down.
    """

    def __init__(self, script: Script) -> None:
        self.script = script
        self.now_ns = 1_700_000_000_000_000_000
        self.syncs = self.given = 0
        self.estimate = b""
        self.slow_ns = self.oversleep_ns = 0
        self.down = False
        self.frames = bytearray(16 * CAPACITY)
        self.stamps_ns: list[int] = []
        self.own: list[bool] = []
        self.tx_dropped = self.rx_dropped = 0
        self._coming: list[tuple[int, int, bytes, bool]] = []
        self._order = 0

    def fileno(self) -> int:
        return -1

    def installed(self) -> AbstractContextManager[object]:
        """The clock is that of the cycles that are made meanwhile."""
        return patch.multiple(cycle_module, clock=PythonClock(self))

    def installed_in_loop(self) -> AbstractContextManager[object]:
        return patch.multiple(loop_module, time=self)

    # Module `time` -------------------------------------------------------------------------------------------------------

    def monotonic_ns(self) -> int:
        return self.now_ns

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9) + self.oversleep_ns
        self.oversleep_ns = 0

    # Frame socket --------------------------------------------------------------------------------------------------------

    def put(self, arrivals: Iterable[Arrival]) -> None:
        for at_ns, frame, own in arrivals:
            if len(self._coming) >= QUEUE:
                self.rx_dropped += 1
                continue
            self._order += 1  # equal times keep their order
            heapq.heappush(self._coming, (at_ns, self._order, frame, own))

    def send(self, frame: bytes) -> bool:
        self.now_ns += 2_000
        if self.down:
            raise BusDown("down")
        (can_id,) = struct.unpack_from("<I", frame)
        if can_id == _SYNC:
            self.syncs += 1
            self.put(self.script(self.syncs, self.now_ns, frame[8]))
        elif can_id == _ESTIMATE:
            self.estimate = bytes(frame[8:16])
        return True

    def receive(self) -> int:
        self.now_ns += 7_000 + self.slow_ns
        if self.down:
            raise BusDown("down")
        coming, now = self._coming, self.now_ns
        self.stamps_ns, self.own = [], []
        count = 0
        while coming and coming[0][0] <= now and count < CAPACITY:
            at_ns, _, frame, own = heapq.heappop(coming)
            self.frames[16 * count : 16 * count + 16] = frame
            self.stamps_ns.append(at_ns)
            self.own.append(own)
            self.given += not own
            count += 1
        return count

    def wait(self, timeout_s: float) -> bool:
        end = self.now_ns + round(timeout_s * 1e9)
        if self._coming and self._coming[0][0] <= end:
            self.now_ns = max(self.now_ns, self._coming[0][0])
            return True
        self.now_ns = end
        return False


US = 1000
I32 = struct.Struct("<ii")
MOTION = struct.Struct("<ihH")
SENSOR = struct.Struct("<iB")
_FRAME = struct.Struct("<IB3x8s")
ENABLED = 0x27
NUMBERS = 1024
"""Range of the SYNC's number within TPDO2, where its velocity must stay plausible."""
LINK, SPEED, CURRENT = 20_000, 5_000, 200
INPUT_IDS = (0x181, 0x281, 0x182, 0x282, 0x183)
_USUAL_US = (150, 260, 205, 315, 370)
_LATE_US = ((850, 950), (1000, 1090), (1600, 1900), (2600, 2900))
"""After the deadline, or in a later cycle outside of the arrival band."""
CALM_CYCLES = 40

STRICT = ("calm", "lossy", "stall", "copies", "junk", "storm", "shapes", "syncs", "nodes", "load", "down")
LOOSE = ("impostor", "replay", "shuffle")


def frame(can_id: int, data: bytes, length: int | None = None) -> bytes:
    return _FRAME.pack(can_id, len(data) if length is None else length, data)


def genuine(number: int) -> tuple[bytes, ...]:
    speed = SPEED + number % NUMBERS
    return (
        frame(0x181, I32.pack(number, LINK + number)),
        frame(0x281, MOTION.pack(speed, CURRENT, ENABLED)),
        frame(0x182, I32.pack(number, LINK + number)),
        frame(0x282, MOTION.pack(speed, CURRENT, ENABLED)),
        frame(0x183, SENSOR.pack(number, 0)),
    )


def is_of(number: int, index: int, values: tuple[int, ...]) -> bool:
    """The values of input `index` are those of SYNC `number`."""
    if index in (0, 2):
        return values == (number, LINK + number)
    return values == (SPEED + number % NUMBERS, CURRENT, ENABLED)


class Traffic:
    """Script of a `BusInTime`, drawn from `seed`.

    Args:
        seed: of all that is random.
        kinds: episodes to draw from.

    Attributes:
        kind: of the episode.
        strict: a stale input that is used is an error in this cycle.
        counts: cycles of each kind.
        slow_ns, oversleep_ns, down: what the bus and the machine do in this cycle.
    """

    def __init__(self, seed: int, kinds: tuple[str, ...] = STRICT + LOOSE) -> None:
        self.random = random.Random(seed)
        self._kinds = kinds
        self.kind = "calm"
        self.strict = True
        self.counts = dict.fromkeys(("calm", *kinds), 0)
        self.slow_ns = self.oversleep_ns = 0
        self.down = False
        self._left = CALM_CYCLES
        self._last_ns = [0] * len(INPUT_IDS)
        self._old: list[bytes] = []
        self._noise: dict[str, Callable[[int], list[Arrival]]] = {
            "junk": lambda t: self._junk(t, self.random.randrange(12)),
            "storm": lambda t: self._junk(t, self.random.randrange(50, 400)),
            "shapes": self._shapes,
            "nodes": self._nodes,
            "impostor": self._impostor,
            "replay": self._replay,
        }

    def __call__(self, number: int, now_ns: int, counter: int) -> list[Arrival]:
        """All that arrives because of, or after, SYNC `number` sent at `now_ns` with `counter`."""
        self._turn()
        kind, draw = self.kind, self.random.random
        self.counts[kind] += 1
        out = self._echo(counter, now_ns)
        if kind == "stall" and draw() < 0.05:
            end = now_ns + self.random.randrange(500, 20_000) * US
            self._last_ns = [max(last, end) for last in self._last_ns]
        for n, data in enumerate(genuine(number)):
            delay_us = _USUAL_US[n] + self.random.randrange(25)
            chance = draw()
            if kind == "lossy":
                if chance < 0.03:
                    continue
                if chance < 0.06:
                    delay_us = self.random.randrange(*self.random.choice(_LATE_US))
            elif kind == "shuffle" and chance < 0.3:
                delay_us = self.random.randrange(5, 3000)
            at = now_ns + delay_us * US
            if kind != "shuffle":
                at = max(at, self._last_ns[n] + 50 * US)
            self._last_ns[n] = at
            out.append((at, data, False))
            if kind == "copies" and chance < 0.1:
                self._last_ns[n] = at + self.random.randrange(120) * US
                out.append((self._last_ns[n], data, False))
            if n < 4 and chance > 0.95:
                self._old = [*self._old[-20:], data]
        noise = self._noise.get(kind)
        if noise is not None:
            out += noise(now_ns)
        return out

    def _turn(self) -> None:
        """The next cycle; perhaps the next episode."""
        draw = self.random
        self._left -= 1
        if self._left < 0:
            after_loose = self.kind in LOOSE
            self.kind = "calm" if after_loose else draw.choice(self._kinds)
            self._left = CALM_CYCLES if after_loose else draw.randrange(5, 120)
        if self.kind in LOOSE:
            self.strict = False
        elif self.kind == "calm" and self._left < CALM_CYCLES // 2:
            self.strict = True
        self.down = self.kind == "down" and draw.random() < 0.1
        load = self.kind == "load"
        self.slow_ns = draw.choice((0, 20, 200, 400)) * US if load else 0
        self.oversleep_ns = draw.choice((0, 50, 300, 2500)) * US if load and draw.random() < 0.1 else 0

    def _echo(self, sent: int, now_ns: int) -> list[Arrival]:
        data = frame(0x080, bytes((sent,)))
        out = [(now_ns + 4 * US, data, True)]
        if self.kind == "syncs":
            chance = self.random.random()
            if chance < 0.05:
                return []
            if chance < 0.1:
                out = [(now_ns + self.random.randrange(900, 2500) * US, data, True)]
            if chance > 0.9:
                counter = bytes((self.random.randrange(256),) * self.random.choice((0, 1, 8)))
                out.append((now_ns + self.random.randrange(-20, 990) * US, frame(0x080, counter), False))
        return out

    def _time(self, now_ns: int) -> int:
        return now_ns + self.random.randrange(-10, 2000) * US

    def _junk(self, now_ns: int, count: int) -> list[Arrival]:
        """Frames of any identifier, length and flag, but none that is one of the inputs."""
        draw, out = self.random, []
        for _ in range(count):
            flags = draw.choice(
                (0, 0, 0, CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG)
            )
            can_id = draw.getrandbits(29 if flags & CAN_EFF_FLAG else 11) | flags
            if can_id in INPUT_IDS or can_id == 0x080:
                continue
            data = draw.randbytes(8)
            out.append(
                (self._time(now_ns), frame(can_id, data, draw.choice((0, 1, 2, 5, 7, 8, 8, 8, 15))), False)
            )
        return out

    def _shapes(self, now_ns: int) -> list[Arrival]:
        """The inputs' own identifiers with a wrong length or in another format; heartbeats and temperatures likewise."""
        draw, out = self.random, []
        for _ in range(draw.randrange(4)):
            can_id = draw.choice((*INPUT_IDS, 0x080, 0x701, 0x702, 0x703, 0x381, 0x382))
            flags = draw.choice((0, CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG))
            right = {0x183: 5, 0x080: 1, 0x381: 2, 0x382: 2}.get(can_id, 8)
            length = draw.choice([n for n in (0, 1, 2, 3, 4, 6, 7, 9, 64, 255) if n != right])
            if can_id > 0x700 and not flags and length == 1:
                length = 0
            if not flags and can_id == 0x080:
                flags = CAN_RTR_FLAG
            out.append((self._time(now_ns), frame(can_id | flags, draw.randbytes(8), length), False))
        return out

    def _nodes(self, now_ns: int) -> list[Arrival]:
        """Heartbeats of all nodes, now and then a boot-up message, temperatures of any value."""
        draw = self.random
        if draw.random() < 0.5:
            return []
        if draw.random() < 0.3:
            data = draw.randbytes(2)
            return [(self._time(now_ns), frame(0x380 + draw.randrange(1, 3), data), False)]
        state = draw.choice((5,) * 20 + (4, 127, 127, 0, 1, 255))
        return [
            (
                self._time(now_ns),
                frame(0x700 + draw.choice((1, 2, 3, draw.randrange(128))), bytes((state,))),
                False,
            )
        ]

    def _impostor(self, now_ns: int) -> list[Arrival]:
        """Somebody else sends under an input's identifier, with its length."""
        draw = self.random
        if draw.random() < 0.5:
            return []
        can_id = draw.choice(INPUT_IDS)
        return [(self._time(now_ns), frame(can_id, draw.randbytes(5 if can_id == 0x183 else 8)), False)]

    def _replay(self, now_ns: int) -> list[Arrival]:
        if not self._old or self.random.random() < 0.5:
            return []
        return [(self._time(now_ns), self.random.choice(self._old), False)]


MS = 1_000_000
_PDOS = (
    InputPdo(0x181, 8, I32, 1, "181h"),
    InputPdo(0x281, 8, MOTION, 1, "281h"),
    InputPdo(0x182, 8, I32, 2, "182h"),
    InputPdo(0x282, 8, MOTION, 2, "282h"),
    InputPdo(0x183, 5, SENSOR, 3, "183h"),
)
_SCALE = (1e-4, 1e-3, 1e-5, 0.01, 0.001)
_NO_FIELD = (estimate_pdo.NO_TORQUE, estimate_pdo.SIGMA_UNKNOWN)
_COUNTED = (
    *("stale_inputs", "late_frames", "duplicate_frames", "rejected_frames", "unknown_frames", "foreign_sync"),
    *("sync_errors", "sync_gaps", "boot_ups"),
)
_CONFIGURE_AFTER = 60
"""Cycles after a boot-up message until the supervisor has configured the node again."""


@dataclass
class Oracle:
    """What must be true of each estimate PDO, and how often it was not."""

    valid: int = 0
    stale: int = 0
    stale_loose: int = 0
    believed: int = 0
    believed_loose: int = 0
    leaked: int = 0
    wrong_sequence: int = 0
    published: int = 0
    first_wrong: str = ""

    @property
    def findings(self) -> int:
        return self.stale + self.believed + self.leaked + self.wrong_sequence

    def judge(self, cycle: Cycle, bus: BusInTime, kind: str, *, strict: bool) -> None:
        self.published += 1
        intake = cycle.intake
        right = [not intake.fresh(n) or is_of(bus.syncs, n, intake.values(n)) for n in range(4)]
        if not all(right):  # the status may still be held back: this is judged before it
            self._wrong("believed" if strict else "believed_loose", bus, kind)
        layout = estimate_pdo.LAYOUT.unpack(bus.estimate)
        if layout[5] != cycle.counter:
            self._wrong("wrong_sequence", bus, kind)
        for joint, status in enumerate((layout[4] & 0x0F, layout[4] >> 4)):
            if status not in estimate_pdo.PUBLISHED_STATUSES:
                if (layout[joint], layout[2 + joint]) != _NO_FIELD:
                    self._wrong("leaked", bus, kind)
                continue
            self.valid += 1
            used = (2 * joint, 2 * joint + 1)
            if not all(intake.fresh(n) and right[n] for n in used):
                self._wrong("stale" if strict else "stale_loose", bus, kind)

    def _wrong(self, what: str, bus: BusInTime, kind: str) -> None:
        setattr(self, what, getattr(self, what) + 1)
        if not what.endswith("loose") and not self.first_wrong:
            self.first_wrong = f"{what} at SYNC {bus.syncs}, episode {kind}"


@dataclass
class FrameReport:
    """Result of one campaign; `as_json` is what is printed."""

    seed: int
    frames: int = 0
    cycles: int = 0
    oracle: Oracle = field(default_factory=Oracle)
    exceptions: int = 0
    exception: str = ""
    counters: dict[str, int] = field(default_factory=dict)
    episodes: dict[str, int] = field(default_factory=dict)
    growth_kb: int = 0
    digest: int = 0
    seconds: float = 0.0

    @property
    def ok(self) -> bool:
        """No finding, and the path was not merely closed: estimates were valid in between."""
        return not self.exceptions and not self.oracle.findings and self.oracle.valid > self.cycles // 10

    def as_json(self) -> dict[str, Any]:
        rest = {k: v for k, v in vars(self).items() if k not in ("oracle", "counters")}
        return {**rest, **vars(self.oracle), **self.counters}


def make_cycle(directory: Path, script: Script) -> tuple[Cycle, BusInTime]:
    """A cycle as the daemon makes it, method efficiency, on a bus with this script."""
    bus = BusInTime(script)
    settings = EstimatorSettings(method="efficiency")
    temperatures = [TemperaturePdo(0x380 + n, n, f"{380 + n}h", 2000) for n in (1, 2)]
    joints = [
        (
            JointInputs(drive_places(2 * n), 4, *_SCALE, temperature=n),
            JointEstimator(load_joint(shipped(f"joint{n + 1}.yaml")), settings),
        )
        for n in range(2)
    ]
    with bus.installed():
        cycle = Cycle(
            bus,  # type: ignore[arg-type]
            Intake(_PDOS, temperatures),
            joints,
            Ring(directory / "ring", 64, rr.RECORD_SIZE),
            Snapshot(directory / "snapshot", 1e-3, 0.8),
            node_id=0x20,
            counter_overflow=240,
            wait_ns=400_000,
            deadline_ns=850_000,
            heartbeat_cycles=100,
            grid=Grid(bus.now_ns + 2 * MS, MS),
        )
    return cycle, bus


def fuzz_frames(
    directory: Path, seed: int, count: int, *, kinds: tuple[str, ...] | None = None
) -> FrameReport:
    """At least `count` frames; every cycle is judged."""
    traffic = Traffic(seed) if kinds is None else Traffic(seed, kinds)
    report = FrameReport(seed)
    oracle, begun, base_kb, end = report.oracle, time.perf_counter(), 0, count
    cycle, bus = make_cycle(directory, traffic)
    supervisor = SnapshotReader(directory / "snapshot", supervisor=True)
    waiting: dict[int, int] = {}

    def after() -> None:
        nonlocal base_kb
        report.cycles += 1
        if not bus.down:
            oracle.judge(cycle, bus, traffic.kind, strict=traffic.strict)
            report.digest = zlib.crc32(bus.estimate, report.digest)
        bus.slow_ns, bus.oversleep_ns, bus.down = traffic.slow_ns, traffic.oversleep_ns, traffic.down
        if bus.down:  # no SYNC leaves, so the script is not asked: it is up again after this cycle
            traffic.down = False
        for node in cycle.intake.unconfigured:
            if report.cycles > waiting.setdefault(node, report.cycles + _CONFIGURE_AFTER):
                supervisor.note_configured(node, cycle.intake.restarts(node))
                del waiting[node]
        if not base_kb and bus.given > end // 5:
            base_kb = rss_kb()

    with bus.installed_in_loop():
        while bus.given < end:
            try:
                run(cycle, cycle.grid, lambda: bus.given >= end, duties=after, slots=1)
            except Exception as error:
                import traceback

                report.exceptions += 1
                report.exception = report.exception or f"SYNC {bus.syncs}, {traffic.kind}: {error!r}"
                traceback.print_exc()
                if report.exceptions > 10:
                    break
                cycle.grid.slot_ns = bus.now_ns + 2 * MS
    report.frames = bus.given
    report.episodes = traffic.counts
    report.growth_kb = rss_kb() - (base_kb or rss_kb())
    report.seconds = time.perf_counter() - begun
    counts = counted(cycle.intake)
    report.counters = {
        **{name: counts[name] for name in _COUNTED},
        "missed_slots": cycle.grid.missed,
        "lost_in_queue": bus.rx_dropped,
    }
    return report
