"""Frames through the loop's own path: `jtqd.daemon.loop.process.run` on a `BusInTime`; an oracle knows each frame's SYNC."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, TemperaturePdo, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.loop.process import run
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon import ring_records as rr
from tests.daemon.snapshots import counted
from tests.slow.fuzz.traffic import I32, MOTION, SENSOR, BusInTime, Script, Traffic, is_of
from tests.slow.soak.rig import rss_kb

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
