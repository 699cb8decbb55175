"""What a running daemon leaves for others to see, made by the test's own process."""

import io
import os
import time
from pathlib import Path

from rich.console import Console

from jtqd.daemon.cli.status import StatusView
from jtqd.daemon.config import load_config
from jtqd.daemon.live.reading import Daemon, Watch
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.runtime_dir import About, write_about
from jtqd.daemon.shared.snapshot import INPUT, Snapshot
from jtqd.daemon.supervisor.process import about
from tests.daemon.snapshots import EstimateWriter

NAN = float("nan")
ONE = (-117.94, 0.48, NAN, -117.0, -117.9, -118.48, 0x27, 2, 0, 15, 0, -118.48, 1.25, NAN, NAN)
TWO = (NAN, NAN, NAN, NAN, NAN, NAN, 0, 4, 0, 1, 0, NAN, 1.25, NAN, NAN)
SAMPLE = (3.21, 100.0, -155.25, 1.0, -118.48, 31.5)


def described(bus: str, log: Path | None = None) -> About:
    return about(load_config(None), bus=bus, instance=bus, log_directory=log)


def running(root: Path, bus: str = "vcan0", log: Path | None = None, *, cycling: bool = True) -> Daemon:
    """What a daemon of this very process would leave: its loop has just made a cycle, or one 10 s ago."""
    directory = root / f"jtqd-{os.getuid()}-{bus}"
    directory.mkdir()
    content = described(bus, log)
    write_about(directory, content)
    snapshot = Snapshot(directory / "snapshot", 1e-3, 0.848)
    reported = EstimateWriter(snapshot)
    for index in (0, 8):
        monotonic = time.monotonic_ns() + (60_000_000_000 if cycling else -10_000_000_000)
        reported.write(
            7992 + index,
            17,
            time.time_ns(),
            (ONE, TWO),
            sync_monotonic_ns=monotonic,
            measured=(SAMPLE, (NAN,) * 6),
        )
    for n in range(5):
        used = 0 if n == 2 else monotonic - 2_345_000_000 * (n == 3)
        INPUT.pack_into(
            snapshot.inputs,
            n * INPUT.size,
            used,
            335_000 + n * 1000,
            330_000,
            360_000,
            n,
            0,
            0,
            0,
            0,
            0,
            0,
            0,
        )
    for node in (1, 2):
        snapshot.node_states[node], snapshot.node_heard[node] = 5, time.time_ns() - (node - 1) * 2_000_000_000
    counted = {"cycles": 8000, "missed": 3, "complete": 7990, "stale_inputs": 12, "work_max_ns": 301_000}
    for name, count in counted.items():
        snapshot.counters[COUNTERS.index(name)] = count
    snapshot.work[50] = 7999
    snapshot.work[75] = 1
    snapshot.status_cycles[2] = 8000
    snapshot.status_cycles[16 + 4] = 8000
    return Daemon(directory, content)


def picture(daemon: Daemon, width: int) -> str:
    watch = Watch(daemon)
    watch.read()
    file = io.StringIO()
    Console(file=file, width=width).print(StatusView(watch.read()))
    return file.getvalue()
