"""Live state of the loop in shared memory: counters, histograms and the last estimate.

For status views and for jtqd's own objects. The loop writes, anybody with access to the file reads; nothing a
reader does can delay the loop. The counters are single 64-bit words; the block of the last estimate is
guarded by a sequence number that is odd while it is being written.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import NamedTuple

COUNTERS = (
    "cycles",
    "missed",
    "complete",
    "published",
    "published_late",
    "stale_inputs",
    "late_frames",
    "duplicate_frames",
    "rejected_frames",
    "unknown_frames",
    "foreign_sync",
    "sync_errors",
    "sync_gaps",
    "boot_ups",
    "temperatures_lost",
    "tx_dropped",
    "rx_dropped",
    "bus_errors",
    "network_fallbacks",
    "bits_worst_case",
    "work_max_ns",
    "late_max_ns",
)
"""In the order of their words; docs/bus.md says what each one means."""

WORK_BINS, WORK_BIN_NS = 500, 4_000
LATE_BINS, LATE_BIN_NS = 250, 4_000
_MAX_NODE = 128

_MAGIC = 0x4A54_5144_5354_4103  # "JTQDSTA", layout 3
_HEAD = struct.Struct("<QQdd")
_JOINT = struct.Struct("<6dHBBB3x")
_ESTIMATE = struct.Struct("<qQq")
_COUNTERS_OFFSET = 64
_SEQUENCE_OFFSET = _COUNTERS_OFFSET + 8 * len(COUNTERS)
_ESTIMATE_OFFSET = _SEQUENCE_OFFSET + 8
_ERRORS_OFFSET = _ESTIMATE_OFFSET + _ESTIMATE.size + 2 * _JOINT.size
_WORK_OFFSET = _ERRORS_OFFSET + 4 * 8
_LATE_OFFSET = _WORK_OFFSET + 8 * WORK_BINS
_NODES_OFFSET = _LATE_OFFSET + 8 * LATE_BINS
_CONFIGURED_OFFSET = _NODES_OFFSET + _MAX_NODE
_UNCONFIGURED_OFFSET = _CONFIGURED_OFFSET + _MAX_NODE
SIZE = _UNCONFIGURED_OFFSET + _MAX_NODE
_WORD = struct.Struct("<Q")


class SnapshotError(Exception):
    """No snapshot of this layout at the path."""


class JointView(NamedTuple):
    """Last estimate of one joint; NaN where unknown. `sensor_nm` is the reference in the same cycle."""

    torque_nm: float
    sigma_nm: float
    tob_nm: float
    physics_nm: float
    network_nm: float
    sensor_nm: float
    statusword: int
    status: int
    sensor_status: int
    input_flags: int
    """Inputs of that cycle, as in the cycle record (`daemon/joint_cycle.py`)."""


class View(NamedTuple):
    """One consistent reading."""

    pid: int
    cycle: int
    sync_counter: int
    sync_realtime_ns: int
    period_s: float
    worst_load: float
    joints: tuple[JointView, JointView]
    counters: dict[str, int]
    rmse_nm: tuple[float, float]
    node_states: bytes
    unconfigured: tuple[int, ...]
    """Node-IDs that restarted and wait for their configuration."""


class Snapshot:
    """Writer's side, one per loop.

    Attributes:
        counters: memory of the counters, one unsigned 64-bit word each, in the order of `COUNTERS`.
        work: histogram of the work per cycle, `WORK_BIN_NS` per bin, the last bin takes the rest.
        late: histogram of the SYNC's lateness, `LATE_BIN_NS` per bin.
        errors: sum of squared errors and number of samples of each joint: [sum 1, n 1, sum 2, n 2].
        node_states: last heartbeat state of each node-ID.
        configured: number of times each node-ID has been configured; written by the supervisor.
        unconfigured: 1 for each node-ID that restarted and has not been configured since.
    """

    def __init__(self, path: Path, period_s: float, worst_load: float) -> None:
        temporary = path.with_name(path.name + ".new")
        with open(temporary, "w+b") as file:
            os.fchmod(file.fileno(), 0o600)
            os.posix_fallocate(file.fileno(), 0, SIZE)  # a full tmpfs refuses here, not by SIGBUS
            self._memory = mmap.mmap(file.fileno(), 0)
        _HEAD.pack_into(self._memory, 0, _MAGIC, os.getpid(), period_s, worst_load)
        os.replace(temporary, path)
        view = memoryview(self._memory)
        self.counters = view[_COUNTERS_OFFSET:_SEQUENCE_OFFSET].cast("Q")
        self.errors = view[_ERRORS_OFFSET:_WORK_OFFSET].cast("d")
        self.work = view[_WORK_OFFSET:_LATE_OFFSET].cast("Q")
        self.late = view[_LATE_OFFSET:_NODES_OFFSET].cast("Q")
        self.node_states = view[_NODES_OFFSET:_CONFIGURED_OFFSET]
        self.configured = view[_CONFIGURED_OFFSET:_UNCONFIGURED_OFFSET]
        self.unconfigured = view[_UNCONFIGURED_OFFSET:SIZE]
        self._sequence = view[_SEQUENCE_OFFSET:_ESTIMATE_OFFSET].cast("Q")

    def write(
        self,
        index: int,
        sync_counter: int,
        sync_realtime_ns: int,
        joints: tuple[tuple[float, ...], tuple[float, ...]],
    ) -> None:
        """Publish the last estimate; `joints` are `JointView` tuples."""
        self._sequence[0] += 1
        memory = self._memory
        _ESTIMATE.pack_into(memory, _ESTIMATE_OFFSET, index, sync_counter, sync_realtime_ns)
        offset = _ESTIMATE_OFFSET + _ESTIMATE.size
        _JOINT.pack_into(memory, offset, *joints[0])
        _JOINT.pack_into(memory, offset + _JOINT.size, *joints[1])
        self._sequence[0] += 1


class SnapshotReader:
    """Reader's side.

    Raises:
        SnapshotError: nothing to read at the path, or of another layout.
    """

    def __init__(self, path: Path, *, supervisor: bool = False) -> None:
        access = mmap.ACCESS_WRITE if supervisor else mmap.ACCESS_READ
        try:
            with open(path, "r+b" if supervisor else "rb") as file:
                self._memory = mmap.mmap(file.fileno(), 0, access=access)
        except (OSError, ValueError) as error:
            raise SnapshotError(f"{path}: no running loop: {error}") from None
        if len(self._memory) != SIZE or _WORD.unpack_from(self._memory, 0)[0] != _MAGIC:
            raise SnapshotError(f"{path}: not a status snapshot of this version")

    def read(self) -> View:
        """A consistent view; retries while the loop is writing and takes the last attempt if it never rests."""
        memory = self._memory
        _, pid, period_s, worst_load = _HEAD.unpack_from(memory, 0)
        for _ in range(100):
            before = _WORD.unpack_from(memory, _SEQUENCE_OFFSET)[0]
            block = memory[_ESTIMATE_OFFSET:_ERRORS_OFFSET]
            if before % 2 == 0 and before == _WORD.unpack_from(memory, _SEQUENCE_OFFSET)[0]:
                break
        index, sync_counter, realtime_ns = _ESTIMATE.unpack_from(block, 0)
        joints = tuple(
            JointView._make(_JOINT.unpack_from(block, _ESTIMATE.size + n * _JOINT.size)) for n in range(2)
        )
        words = struct.unpack_from(f"<{len(COUNTERS)}Q", memory, _COUNTERS_OFFSET)
        sums = struct.unpack_from("<4d", memory, _ERRORS_OFFSET)
        rmse = tuple(
            (sums[2 * n] / sums[2 * n + 1]) ** 0.5 if sums[2 * n + 1] else float("nan") for n in range(2)
        )
        return View(
            pid,
            index,
            sync_counter,
            realtime_ns,
            period_s,
            worst_load,
            (joints[0], joints[1]),
            dict(zip(COUNTERS, words, strict=True)),
            (rmse[0], rmse[1]),
            bytes(memory[_NODES_OFFSET:_CONFIGURED_OFFSET]),
            tuple(node for node, flag in enumerate(memory[_UNCONFIGURED_OFFSET:SIZE]) if flag),
        )

    def work_us(self, *shares: float) -> list[float]:
        """Quantiles of the work per cycle [us], upper edge of their bin (1.0: the true maximum); NaN without data."""
        largest = self.read().counters["work_max_ns"]
        return _quantiles(self._histogram(_WORK_OFFSET, WORK_BINS), WORK_BIN_NS, largest, shares)

    def late_us(self, *shares: float) -> list[float]:
        """Quantiles of the SYNC's lateness [us], upper edge of their bin (1.0: the true maximum); NaN without data."""
        largest = self.read().counters["late_max_ns"]
        return _quantiles(self._histogram(_LATE_OFFSET, LATE_BINS), LATE_BIN_NS, largest, shares)

    def note_configured(self, node_id: int) -> None:
        """Tell the loop that a node which had restarted has been configured again (supervisor only)."""
        offset = _CONFIGURED_OFFSET + node_id
        self._memory[offset] = (self._memory[offset] + 1) % 256

    def _histogram(self, offset: int, bins: int) -> tuple[int, ...]:
        return struct.unpack_from(f"<{bins}Q", self._memory, offset)


def _quantiles(bins: tuple[int, ...], bin_ns: int, largest_ns: int, shares: tuple[float, ...]) -> list[float]:
    total = sum(bins)
    result = []
    for share in shares:
        wanted, seen, edge = share * total, 0, float("nan")
        for n, count in enumerate(bins):
            seen += count
            if total and seen >= wanted and count:
                edge = (largest_ns if share >= 1.0 or n == len(bins) - 1 else (n + 1) * bin_ns) / 1000.0
                break
        result.append(edge)
    return result
