"""Live state of the loop in shared memory: counters, histograms and the last estimate.

For status views and for jtqd's own objects. The loop writes, the daemon's user and group read; nothing a
reader does can delay the loop. The counters are single 64-bit words; the block of the last estimate is
guarded by a sequence number that is odd while it is being written, with everything else that is written every 8th cycle.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import MOST_JOINTS
from jtqd.estimator.status import Zeros

STATUS_CODES = 16
MAX_NODE = 128


class JointView(NamedTuple):
    """Last estimate of one joint; NaN where unknown. `sensor_nm` is the sensor in the same cycle."""

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
    """Inputs and faults of that cycle, as in the cycle record (`daemon/shared/cycle_record.py`)."""
    latched: int = 0
    """Bits of the faults that are latched (`daemon/shared/cycle_record.py`)."""
    reference_nm: float = float("nan")
    """The sensor as old as the estimate (`daemon/shared/cycle_record.py`): what the estimate is compared with."""
    age_ms: float = float("nan")
    """Group delay of the estimate."""
    torque_rate_nm_s: float = float("nan")
    contact_nm: float = float("nan")
    """As in the cycle record; whether there is a contact say bits of `input_flags`."""


class Measured(NamedTuple):
    """Inputs of one joint in the same cycle, SI units; NaN where an input is missing."""

    current_a: float
    motor_position_rad: float
    motor_velocity_rad_s: float
    link_position_rad: float
    sensor_nm: float
    temperature_c: float


class InputView(NamedTuple):
    """One input PDO, in the order of `daemon/core/input_pdos.py`; every 8th cycle is looked at."""

    used_ns: int
    """SYNC of the last cycle seen that used it, CLOCK_MONOTONIC; 0 never."""
    delay_ns: int
    """Arrival after that SYNC."""
    low_ns: int
    high_ns: int
    """Usual arrival after SYNC, from and to (a band that forgets within a second); low > high where nothing came yet."""
    late: int
    lost: int
    duplicates: int
    rejected: int
    missed: int
    """Cycles without a valid one."""
    in_a_row: int
    """Those until now since the last valid one."""
    short: int
    long: int
    """Frames of a wrong length (8210h, 8220h); both are among the rejected."""


NOT_MEASURED = Measured(*(float("nan"),) * 6)
NO_ZEROS = Zeros(*(0.0,) * 7, 0, 0)
"""Of an estimator that learns nothing."""


class View(NamedTuple):
    """One consistent reading."""

    pid: int
    cycle: int
    sync_counter: int
    sync_realtime_ns: int
    period_s: float
    worst_load: float
    joints: tuple[JointView, ...]
    counters: dict[str, int]
    rmse_nm: tuple[float, ...]
    """Of each joint in motion, against the sensor as old as the estimate."""
    node_states: bytes
    unconfigured: tuple[int, ...]
    """Node-IDs that restarted and wait for their configuration."""
    sync_monotonic_ns: int = 0
    """CLOCK_MONOTONIC of the last cycle's SYNC; 0 before the first."""
    status_since: tuple[int, ...] = (0, 0)
    """Cycle since which each joint has its status (seen every 8th cycle)."""
    measured: tuple[Measured, ...] = (NOT_MEASURED, NOT_MEASURED)
    status_cycles: tuple[tuple[int, ...], ...] = ((0,) * STATUS_CODES, (0,) * STATUS_CODES)
    """How many cycles each joint has spent in each status code."""
    inputs: tuple[InputView, ...] = ()
    node_heard_ns: tuple[int, ...] = (0,) * MAX_NODE
    """Kernel stamp of the last heartbeat of each node-ID, CLOCK_REALTIME; 0 never."""
    restarts: tuple[int, ...] = (0,) * MAX_NODE
    """Boot-up messages of each node-ID."""
    rmse_now_nm: tuple[float, ...] = ()
    """As `rmse_nm`, against the sensor now: with the estimate's age as an error."""
    zeros: tuple[Zeros, ...] = (NO_ZEROS,) * MOST_JOINTS
    """What the estimator of each joint has learned of its zeros."""
    pasts: tuple[bytes, ...] = ()
    """State of each joint's estimator after this cycle (`FusedEstimator.past`); empty where it learns nothing."""


def quantiles(bins: tuple[int, ...], bin_ns: int, largest_ns: int, shares: tuple[float, ...]) -> list[float]:
    """Quantiles [us] of a histogram with bins of `bin_ns`, upper edge of their bin; see `SnapshotReader.work_us`."""
    total = sum(bins)
    result = []
    for share in shares:
        wanted, seen, edge = share * total, 0, float("nan")
        for n, count in enumerate(bins):
            seen += count
            if total and seen >= wanted and count:
                top_ns = largest_ns if share >= 1.0 or n == len(bins) - 1 else (n + 1) * bin_ns
                edge = min(top_ns, largest_ns or top_ns) / 1000.0
                break
        result.append(edge)
    return result


WORK_BINS, WORK_BIN_NS = 500, 4_000
LATE_BINS, LATE_BIN_NS = 250, 4_000
MAX_INPUTS = 20
"""Four TPDOs of each of four drives and two sensor channels are eighteen."""

_MAGIC = 0x4A54_5144_5354_410A  # "JTQDSTA", layout 10
_HEAD = struct.Struct("<QQddQ")
"""Magic number, process, period [s], worst load, number of joints."""
JOINT = struct.Struct("<6dHBBHH4d")
ESTIMATE = struct.Struct(f"<qQqq{MOST_JOINTS}q")
MEASURED = struct.Struct("<6d")
INPUT = struct.Struct("<12q")
"""An `InputView`."""
PAST_WORDS = 192
"""Room for the state of an estimator."""
LEARNED = struct.Struct(f"<7d3Q{8 * PAST_WORDS}s")
"""`Zeros`, length of the state [byte], the state."""
_ORDERS_OFFSET = _HEAD.size
_COUNTERS_OFFSET = _ORDERS_OFFSET + 5 * 8
_SEQUENCE_OFFSET = _COUNTERS_OFFSET + 8 * len(COUNTERS)
_ESTIMATE_OFFSET = _SEQUENCE_OFFSET + 8
ESTIMATE_SIZE = ESTIMATE.size + MOST_JOINTS * (JOINT.size + MEASURED.size)
_MEASURED_OFFSET = _ESTIMATE_OFFSET + ESTIMATE.size + MOST_JOINTS * JOINT.size
_ERRORS_OFFSET = _MEASURED_OFFSET + MOST_JOINTS * MEASURED.size
_WORK_OFFSET = _ERRORS_OFFSET + MOST_JOINTS * 3 * 8
_LATE_OFFSET = _WORK_OFFSET + 8 * WORK_BINS
_STATUS_OFFSET = _LATE_OFFSET + 8 * LATE_BINS
_INPUTS_OFFSET = _STATUS_OFFSET + 8 * MOST_JOINTS * STATUS_CODES
_HEARD_OFFSET = _INPUTS_OFFSET + INPUT.size * MAX_INPUTS
_NODES_OFFSET = _HEARD_OFFSET + 8 * MAX_NODE
_CONFIGURED_OFFSET = _NODES_OFFSET + MAX_NODE
_UNCONFIGURED_OFFSET = _CONFIGURED_OFFSET + MAX_NODE
_FACTORS_OFFSET = _UNCONFIGURED_OFFSET + MAX_NODE
_FACTORS = struct.Struct("<4d")
_RESTARTS_OFFSET = _FACTORS_OFFSET + _FACTORS.size * MAX_NODE
_CONFIGURED_FOR_OFFSET = _RESTARTS_OFFSET + 8 * MAX_NODE
_DOUBTS_OFFSET = _CONFIGURED_FOR_OFFSET + 8 * MAX_NODE
_LEARNED_OFFSET = _DOUBTS_OFFSET + MAX_NODE
SIZE = _LEARNED_OFFSET + MOST_JOINTS * LEARNED.size
_WORD = struct.Struct("<Q")
_PATIENCE_S = 0.05
"""Of a reader, with a loop in the midst of a write: many times what a preempted loop may take."""
_PAUSE_S = 50e-6


class SnapshotError(Exception):
    """No snapshot of this layout at the path."""


class Snapshot:
    """Writer's side, one per loop: the memory that `daemon/core/snapshot.pyx` writes into.

    It has room for four joints; `joints` says how many there are.

    Attributes:
        orders: requests of the supervisor and what became of them: [resets asked, done, doubts reported, seen,
            turns of the supervisor].
        counters: memory of the counters, one unsigned 64-bit word each, in the order of `COUNTERS`.
        work: histogram of the work per cycle, `WORK_BIN_NS` per bin, the last bin takes the rest.
        late: histogram of the SYNC's lateness, `LATE_BIN_NS` per bin.
        errors: of each joint the sums of squared errors against the sensor of the estimate's age and against the sensor
            now, and the number of samples.
        status_cycles: cycles that joint 1 has spent in each of the 16 status codes, then joint 2, ...
        inputs: one `INPUT` for each input PDO.
        node_states: last heartbeat state of each node-ID.
        node_heard: kernel stamp of that heartbeat [ns].
        configured: number of times each node-ID has been configured; written by the supervisor.
        unconfigured: 1 for each node-ID that restarted and has not been configured since.
        restarts: boot-up messages of each node-ID.
        configured_for: of each node-ID, the `restarts` after which it was last configured; written by the supervisor.
        doubts: number of times each node-ID was found to be configured otherwise; written by the supervisor.
        learned: of each joint a `LEARNED`; as `estimate`, guarded by the sequence.
        sequence: odd while the snapshot is being written.
        estimate: the last estimate: times, status, `JointView` and `Measured` of all joints.
    """

    def __init__(self, path: Path, period_s: float, worst_load: float, joints: int = 2) -> None:
        self.joints = joints
        temporary = path.with_name(path.name + ".new")
        with open(temporary, "w+b") as file:
            os.fchmod(file.fileno(), 0o640)  # the daemon's group may look
            os.posix_fallocate(file.fileno(), 0, SIZE)  # a full tmpfs refuses here, not by SIGBUS
            self._memory = mmap.mmap(file.fileno(), 0)
        _HEAD.pack_into(self._memory, 0, _MAGIC, os.getpid(), period_s, worst_load, joints)
        os.replace(temporary, path)
        view = memoryview(self._memory)
        self.orders = view[_ORDERS_OFFSET:_COUNTERS_OFFSET].cast("Q")
        self.counters = view[_COUNTERS_OFFSET:_SEQUENCE_OFFSET].cast("Q")
        self.errors = view[_ERRORS_OFFSET:_WORK_OFFSET].cast("d")
        self.work = view[_WORK_OFFSET:_LATE_OFFSET].cast("Q")
        self.late = view[_LATE_OFFSET:_STATUS_OFFSET].cast("Q")
        self.status_cycles = view[_STATUS_OFFSET:_INPUTS_OFFSET].cast("Q")
        self.inputs = view[_INPUTS_OFFSET:_HEARD_OFFSET]
        self.node_heard = view[_HEARD_OFFSET:_NODES_OFFSET].cast("q")
        self.node_states = view[_NODES_OFFSET:_CONFIGURED_OFFSET]
        self.configured = view[_CONFIGURED_OFFSET:_UNCONFIGURED_OFFSET]
        self.unconfigured = view[_UNCONFIGURED_OFFSET:_FACTORS_OFFSET]
        self.restarts = view[_RESTARTS_OFFSET:_CONFIGURED_FOR_OFFSET].cast("Q")
        self.configured_for = view[_CONFIGURED_FOR_OFFSET:_DOUBTS_OFFSET].cast("Q")
        self.doubts = view[_DOUBTS_OFFSET:_LEARNED_OFFSET]
        self.learned = view[_LEARNED_OFFSET:SIZE]
        self.sequence = view[_SEQUENCE_OFFSET:_ESTIMATE_OFFSET].cast("Q")
        self.estimate = view[_ESTIMATE_OFFSET:_ERRORS_OFFSET]

    def factors(self, node_id: int) -> tuple[float, ...]:
        """Four scaling factors that the supervisor has noted for a node (`note_factors`); zeros where none."""
        return _FACTORS.unpack_from(self._memory, _FACTORS_OFFSET + node_id * _FACTORS.size)


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
        """Return a consistent view; wait while the loop is writing.

        A loop that was killed in the midst of a write never ends it; after `_PATIENCE_S` the reading is of what it left.
        """
        end = 0.0
        while True:
            before = _WORD.unpack_from(self._memory, _SEQUENCE_OFFSET)[0]
            view = self._view()
            if before % 2 == 0 and before == _WORD.unpack_from(self._memory, _SEQUENCE_OFFSET)[0]:
                return view
            now = time.monotonic()
            end = end or now + _PATIENCE_S
            if now >= end:
                return view
            time.sleep(_PAUSE_S)  # the loop may have been preempted in its write: it needs the processor more

    def _view(self) -> View:
        memory = self._memory
        _, pid, period_s, worst_load, count = _HEAD.unpack_from(memory, 0)
        block = memory[_ESTIMATE_OFFSET:_ERRORS_OFFSET]
        index, sync_counter, realtime_ns, monotonic_ns, *since = ESTIMATE.unpack_from(block, 0)
        numbers = range(count)
        joints = tuple(
            JointView._make(JOINT.unpack_from(block, ESTIMATE.size + n * JOINT.size)) for n in numbers
        )
        first = _MEASURED_OFFSET - _ESTIMATE_OFFSET
        measured = tuple(
            Measured._make(MEASURED.unpack_from(block, first + n * MEASURED.size)) for n in numbers
        )
        words = struct.unpack_from(f"<{len(COUNTERS)}Q", memory, _COUNTERS_OFFSET)
        cycles = struct.unpack_from(f"<{count * STATUS_CODES}Q", memory, _STATUS_OFFSET)
        inputs = (
            InputView._make(INPUT.unpack_from(memory, _INPUTS_OFFSET + n * INPUT.size))
            for n in range(MAX_INPUTS)
        )
        sums = struct.unpack_from(f"<{3 * count}d", memory, _ERRORS_OFFSET)
        learned = [LEARNED.unpack_from(memory, _LEARNED_OFFSET + n * LEARNED.size) for n in numbers]
        aligned, now = (
            tuple(
                (sums[3 * n + k] / sums[3 * n + 2]) ** 0.5 if sums[3 * n + 2] else float("nan")
                for n in numbers
            )
            for k in (0, 1)
        )
        return View(
            pid,
            index,
            sync_counter,
            realtime_ns,
            period_s,
            worst_load,
            joints,
            dict(zip(COUNTERS, words, strict=True)),
            aligned,
            bytes(memory[_NODES_OFFSET:_CONFIGURED_OFFSET]),
            tuple(node for node, flag in enumerate(memory[_UNCONFIGURED_OFFSET:_FACTORS_OFFSET]) if flag),
            monotonic_ns,
            tuple(since[:count]),
            measured,
            tuple(cycles[n * STATUS_CODES : (n + 1) * STATUS_CODES] for n in numbers),
            tuple(each for each in inputs if any(each)),
            struct.unpack_from(f"<{MAX_NODE}q", memory, _HEARD_OFFSET),
            struct.unpack_from(f"<{MAX_NODE}Q", memory, _RESTARTS_OFFSET),
            now,
            tuple(Zeros._make(each[:9]) for each in learned),
            tuple(each[10][: each[9]] for each in learned),
        )

    def work_us(self, *shares: float) -> list[float]:
        """Return quantiles of the work per cycle [us], upper edge of their bin (1.0: the true maximum); NaN without data."""
        largest = self.read().counters["work_max_ns"]
        return quantiles(self.work_bins(), WORK_BIN_NS, largest, shares)

    def late_us(self, *shares: float) -> list[float]:
        """Quantiles of the SYNC's lateness [us], upper edge of their bin (1.0: the true maximum); NaN without data."""
        largest = self.read().counters["late_max_ns"]
        return quantiles(self.late_bins(), LATE_BIN_NS, largest, shares)

    def work_bins(self) -> tuple[int, ...]:
        """Return the histogram of the work per cycle: cycles in each bin of `WORK_BIN_NS`; the last takes the rest."""
        return self._histogram(_WORK_OFFSET, WORK_BINS)

    def late_bins(self) -> tuple[int, ...]:
        """Return the histogram of the SYNC's lateness: cycles in each bin of `LATE_BIN_NS`; the last takes the rest."""
        return self._histogram(_LATE_OFFSET, LATE_BINS)

    def note_configured(self, node_id: int, restarts: int) -> None:
        """Tell the loop that a node has been configured (supervisor only).

        `restarts`: its `View.restarts` when that began; the loop believes nothing of a node that has restarted since.
        """
        _WORD.pack_into(self._memory, _CONFIGURED_FOR_OFFSET + 8 * node_id, restarts)
        offset = _CONFIGURED_OFFSET + node_id
        self._memory[offset] = (self._memory[offset] + 1) % 256

    def note_factors(self, node_id: int, factors: Sequence[float]) -> None:
        """Scaling of a node that was absent at the start, before `note_configured` (supervisor only).

        A drive: rad per count and rad/s per unit of the motor, rad per count of the link, A per unit. A sensor: Nm per unit
        of its channels.
        """
        values = (*factors, 0.0, 0.0, 0.0, 0.0)[:4]
        _FACTORS.pack_into(self._memory, _FACTORS_OFFSET + node_id * _FACTORS.size, *values)

    def note_doubt(self, node_id: int) -> None:
        """Tell the loop that a node has a changed configuration: not to be used until it is again (supervisor only)."""
        offset = _DOUBTS_OFFSET + node_id
        self._memory[offset] = (self._memory[offset] + 1) % 256
        self._ask(2)

    def note_alive(self) -> None:
        """Tell the loop that the supervisor turns (supervisor only)."""
        self._ask(4)

    def ask_reset(self) -> int:
        """Request the release of latched faults (supervisor only); return the number of the request."""
        return self._ask(0)

    def _ask(self, word: int) -> int:
        number = int(_WORD.unpack_from(self._memory, _ORDERS_OFFSET + 8 * word)[0]) + 1
        _WORD.pack_into(self._memory, _ORDERS_OFFSET + 8 * word, number)
        return number

    @property
    def resets_done(self) -> int:
        """Return the number of the last reset request that the loop has executed."""
        return int(_WORD.unpack_from(self._memory, _ORDERS_OFFSET + 8)[0])

    def _histogram(self, offset: int, bins: int) -> tuple[int, ...]:
        return struct.unpack_from(f"<{bins}Q", self._memory, offset)
