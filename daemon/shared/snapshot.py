"""The snapshot: live state of the loop in shared memory (counters, histograms, last estimate), for all that show it.

The loop writes, the daemon's user and group read, and no reader can delay the loop. The counters are single 64-bit words.
The last estimate, and all else that is written every 8th cycle, is guarded by a sequence number that is odd during a write.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Sequence
from itertools import accumulate
from math import isnan, nan
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.shared.counters import COUNTERS, word_of
from jtqd.daemon.shared.cycle_record import MOST_JOINTS, SHADOW, SHADOW_METHODS, SHADOW_QUANTITIES
from jtqd.daemon.shared.runtime_dir import SharedMemoryError, mapped, new_memory
from jtqd.estimator.status import NAMES, Zeros
from jtqd.estimator.text import finite

STATUS_CODES = 16
MAX_NODE = 128


class JointView(NamedTuple):
    """Last estimate of one joint, as in the cycle record (`JointRecord`); `sensor_nm` is the sensor in the same cycle."""

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
    latched: int = 0
    """Bits of the faults that are latched (`faults.py`)."""
    reference_nm: float = nan
    """The sensor as old as the estimate: what the estimate is compared with."""
    age_ms: float = nan
    torque_rate_nm_s: float = nan
    contact_nm: float = nan
    latches: int = 0  # how often a fault was latched
    released: int = 0  # bits of the faults that a reset released last


class ShadowView(NamedTuple):
    """Last estimate of one shadow method of a joint, as in the cycle record (`SHADOW_QUANTITIES`), and its errors.

    rmse_nm, rmse_now_nm: in motion, where the joint published a torque, against the sensor as old as the estimate, and now.
    """

    torque_nm: float
    sigma_nm: float
    reference_nm: float
    age_ms: float
    status: int
    rmse_nm: float
    rmse_now_nm: float

    def content(self) -> dict[str, Any]:
        """Return it as plain data for JSON."""
        values = {key: finite(value) for key, value in self._asdict().items()}
        return values | {"status": NAMES.get(self.status, str(self.status))}


class Measured(NamedTuple):
    """Inputs of one joint in the same cycle, SI units; NaN where an input is missing."""

    current_a: float
    motor_position_rad: float
    motor_velocity_rad_s: float
    link_position_rad: float
    sensor_nm: float
    temperature_c: float


class InputView(NamedTuple):
    """One input PDO, in the order of `daemon/core/input_pdos.py`, as of every 8th cycle."""

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


NOT_MEASURED = Measured(nan, nan, nan, nan, nan, nan)
NO_ZEROS = Zeros(*(0.0,) * 7, 0, 0)
"""Of an estimator that learns nothing."""


class View(NamedTuple):
    """What the snapshot held at one moment."""

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
    shadows: tuple[dict[str, ShadowView], ...] = ({},) * MOST_JOINTS
    """Shadow methods of each joint by name."""
    conflict_cob_id: int = 0
    """Of the last frame that `cob_id_conflicts` counted."""


def bus_load(previous: View, now: View, bitrate: int) -> float:
    """Return the bus load between two views with worst-case stuffing; NaN without time in between."""
    seconds = (now.sync_realtime_ns - previous.sync_realtime_ns) * 1e-9
    bits = now.counters["bits_worst_case"] - previous.counters["bits_worst_case"]
    return bits / seconds / bitrate if previous.sync_realtime_ns and seconds > 0 else nan


def quantiles(bins: Sequence[int], bin_ns: int, largest_ns: int, shares: tuple[float, ...]) -> list[float]:
    """Quantiles [us] of a histogram with bins of `bin_ns`, upper edge of their bin; see `SnapshotReader.work_us`."""
    total = sum(bins)
    edges = []
    for share in shares:
        found = (n for n, seen in enumerate(accumulate(bins)) if bins[n] and seen >= share * total)
        n = next(found, None)
        if n is None:
            edges.append(nan)
            continue
        top_ns = largest_ns if share >= 1.0 or n == len(bins) - 1 else (n + 1) * bin_ns
        edges.append(min(top_ns, largest_ns or top_ns) / 1000.0)
    return edges


WORK_BINS, WORK_BIN_NS = 500, 4_000
LATE_BINS, LATE_BIN_NS = 250, 4_000
MAX_INPUTS = 20
"""Four TPDOs of each of four drives and two sensor channels are eighteen."""

_MAGIC = 0x4A54_5144_5354_410F  # "JTQDSTA", layout 15
_HEAD = struct.Struct("<QQddQ")
"""Magic number, process, period [s], worst load, number of joints."""
JOINT = struct.Struct("<6dHBBHH4dII")
ESTIMATE = struct.Struct(f"<qQqq{MOST_JOINTS}q")
MEASURED = struct.Struct("<6d")
INPUT = struct.Struct("<12q")  # an `InputView`
PAST_WORDS = 320  # room for the state of an estimator
LEARNED = struct.Struct(f"<7d3Q{8 * PAST_WORDS}s")
"""`Zeros`, length of the state [byte], the state."""
ESTIMATE_SIZE = ESTIMATE.size + MOST_JOINTS * (JOINT.size + MEASURED.size)
_PATIENCE_S, _FIRST_S = 0.05, 1.0
"""Of a reader, while the loop is in a write: many times what a preempted loop may take; of one that has read nothing yet."""
_PAUSE_S = 50e-6


class _Views:
    """Views of the snapshot's memory, in their order in it; `learned` is guarded by the sequence as `estimate` is."""

    def __init__(self, memory: memoryview) -> None:
        self._memory: Any = memory
        self.size = _HEAD.size
        # resets requested by the supervisor, executed; changed nodes reported, taken; signs of life of the supervisor
        self.orders = self._next("Q", 5)
        self.counters = self._next("Q", len(COUNTERS))
        self.conflict = self._next("Q", 1)  # COB-ID of the last of `cob_id_conflicts`
        self.sequence = self._next("Q", 1)  # odd during a write
        self.estimate = self._next("B", ESTIMATE_SIZE)
        # per joint: sums of squared errors against the sensor of the estimate's age and the sensor now, number of samples
        self.errors = self._next("d", 3 * MOST_JOINTS)
        self.work = self._next("Q", WORK_BINS)  # histograms: the last bin takes the rest
        self.late = self._next("Q", LATE_BINS)
        self.status_cycles = self._next("Q", MOST_JOINTS * STATUS_CODES)
        self.inputs = self._next("B", MAX_INPUTS * INPUT.size)
        # by node-ID; those marked s are written by the supervisor
        self.node_heard = self._next("q", MAX_NODE)  # kernel stamp of the last heartbeat [ns], and its state
        self.node_states = self._next("B", MAX_NODE)
        self.configured = self._next("B", MAX_NODE)  # s: how often
        self.unconfigured = self._next("B", MAX_NODE)  # 1: restarted and not configured since
        self.node_factors = self._next("d", 4 * MAX_NODE)  # s: scaling of one that was absent at the start
        self.restarts = self._next("Q", MAX_NODE)
        self.configured_for = self._next("Q", MAX_NODE)  # s: its `restarts` when it was last configured
        self.doubts = self._next("B", MAX_NODE)  # s: how often it was found with a changed configuration
        self.unchecked = self._next("B", MAX_NODE)  # s: 1: nobody has checked its identity or layout
        self.learned = self._next("B", MOST_JOINTS * LEARNED.size)
        # guarded as `estimate` is, and per joint and method errors as in `errors`
        self.shadows = self._next("B", MOST_JOINTS * SHADOW.size)
        self.shadow_errors = self._next("d", 3 * MOST_JOINTS * len(SHADOW_METHODS))

    def _next(self, code: str, count: int) -> Any:
        """Return the view of the next `count` items of a code of `struct`."""
        start, self.size = self.size, self.size + struct.calcsize("<" + code) * count
        return self._memory[start : self.size].cast(code)


SIZE = _Views(memoryview(b"")).size


class Snapshot(_Views):
    """Writer's side, one per loop: the memory that `daemon/core/cycle.pyx` writes into, with room for four joints."""

    def __init__(self, path: Path, period_s: float, worst_load: float, joints: int = 2) -> None:
        self.joints = joints
        head = _HEAD.pack(_MAGIC, os.getpid(), period_s, worst_load, joints)
        memory = new_memory(path, SIZE, head)
        super().__init__(memoryview(memory))
        self.shadows[:] = b"\xff" * len(self.shadows)  # NaN: no method has an age

    def factors(self, node_id: int) -> tuple[float, ...]:
        """Return the four scaling factors of a node that the supervisor has noted (`note_factors`); zeros where none."""
        return tuple(self.node_factors[4 * node_id : 4 * node_id + 4])


def _shadows(views: _Views, joint: int) -> dict[str, ShadowView]:
    """Return the shadow methods of a joint, from 0 on, that are computed."""
    values = SHADOW.unpack_from(views.shadows, joint * SHADOW.size)
    step, count, found = len(SHADOW_QUANTITIES), len(SHADOW_METHODS), {}
    for n, method in enumerate(SHADOW_METHODS):
        torque, sigma, reference, age = values[step * n : step * n + step]
        at = 3 * (count * joint + n)
        *errors, samples = views.shadow_errors[at : at + 3]
        rmse, now = ((each / samples) ** 0.5 if samples else nan for each in errors)
        if not isnan(age):
            found[method] = ShadowView(torque, sigma, reference, age, values[n - count], rmse, now)
    return found


class SnapshotReader:
    """Reader's side. Raises SharedMemoryError where there is nothing to read at the path, or of another layout."""

    def __init__(self, path: Path, *, supervisor: bool = False) -> None:
        self._last: View | None = None
        self._memory = mapped(path, "no running loop", writable=supervisor)
        if len(self._memory) != SIZE or _HEAD.unpack_from(self._memory, 0)[0] != _MAGIC:
            raise SharedMemoryError(f"{path}: not a status snapshot of this version")
        self._views = _Views(memoryview(self._memory))

    def read(self) -> View:
        """Return a view of one moment; wait while the loop is writing.

        Of a loop that stays in its write, preempted or killed, the last view that was read, as old as its stamps.
        Raises SharedMemoryError where none was.
        """
        sequence, end_s = self._views.sequence, time.monotonic() + (_PATIENCE_S if self._last else _FIRST_S)
        while True:
            before, content = sequence[0], self._memory[:]
            if before % 2 == 0 and before == sequence[0]:
                self._last = self._view(content)
            elif time.monotonic() < end_s:
                time.sleep(_PAUSE_S)  # a preempted loop needs the processor more
                continue
            elif self._last is None:
                raise SharedMemoryError(f"the loop has been in one write for {_FIRST_S:g} s")
            return self._last

    def _view(self, content: bytes) -> View:
        views = _Views(memoryview(content))
        _, pid, period_s, worst_load, count = _HEAD.unpack_from(content, 0)
        block, errors = bytes(views.estimate), views.errors
        index, sync_counter, realtime_ns, monotonic_ns, *since = ESTIMATE.unpack_from(block, 0)
        joints, at, first = range(count), ESTIMATE.size, ESTIMATE.size + MOST_JOINTS * JOINT.size
        inputs = (InputView._make(each) for each in INPUT.iter_unpack(views.inputs))
        learned = [LEARNED.unpack_from(views.learned, n * LEARNED.size) for n in joints]
        aligned, now = (
            tuple(
                (errors[3 * n + k] / errors[3 * n + 2]) ** 0.5 if errors[3 * n + 2] else nan for n in joints
            )
            for k in (0, 1)
        )
        cycles = views.status_cycles.tolist()
        return View(
            pid=pid,
            cycle=index,
            sync_counter=sync_counter,
            sync_realtime_ns=realtime_ns,
            sync_monotonic_ns=monotonic_ns,
            period_s=period_s,
            worst_load=worst_load,
            joints=tuple(JointView(*JOINT.unpack_from(block, at + n * JOINT.size)) for n in joints),
            measured=tuple(Measured(*MEASURED.unpack_from(block, first + n * MEASURED.size)) for n in joints),
            counters=dict(zip(COUNTERS, views.counters, strict=True)),
            rmse_nm=aligned,
            rmse_now_nm=now,
            node_states=bytes(views.node_states),
            node_heard_ns=tuple(views.node_heard),
            restarts=tuple(views.restarts),
            unconfigured=tuple(node for node, flag in enumerate(views.unconfigured) if flag),
            status_since=tuple(since[:count]),
            status_cycles=tuple(tuple(cycles[n * STATUS_CODES : (n + 1) * STATUS_CODES]) for n in joints),
            inputs=tuple(each for each in inputs if any(each)),
            zeros=tuple(Zeros(*each[:9]) for each in learned),
            pasts=tuple(each[10][: each[9]] for each in learned),
            shadows=tuple(_shadows(views, n) for n in joints),
            conflict_cob_id=views.conflict[0],
        )

    def work_us(self, *shares: float) -> list[float]:
        """Return quantiles of the work per cycle [us], upper edge of their bin (1.0: the true maximum); NaN without data."""
        return quantiles(self.work_bins(), WORK_BIN_NS, self._views.counters[word_of("work_max_ns")], shares)

    def late_us(self, *shares: float) -> list[float]:
        """Return quantiles of the SYNC's lateness [us], as `work_us`."""
        return quantiles(self.late_bins(), LATE_BIN_NS, self._views.counters[word_of("late_max_ns")], shares)

    def work_bins(self) -> tuple[int, ...]:
        """Return the histogram of the work per cycle: cycles in each bin of `WORK_BIN_NS`."""
        return tuple(self._views.work)

    def late_bins(self) -> tuple[int, ...]:
        """Return the histogram of the SYNC's lateness: cycles in each bin of `LATE_BIN_NS`."""
        return tuple(self._views.late)

    def count(self, name: str) -> int:
        """Return a counter as it stands: one word, whatever the loop is writing."""
        return int(self._views.counters[word_of(name)])

    @property
    def resets_done(self) -> int:
        """Return the number of the last reset request that the loop has executed."""
        return int(self._views.orders[1])

    # Of the supervisor only -------------------------------------------------------------------------------------------

    def note_configured(self, node_id: int, restarts: int) -> None:
        """Report that a node is configured; `restarts`: when that began. The loop does not use one that restarted since."""
        views = self._views
        views.configured_for[node_id] = restarts
        views.configured[node_id] = (views.configured[node_id] + 1) % 256

    def note_factors(self, node_id: int, factors: Sequence[float]) -> None:
        """Report the scaling of a node that was absent at the start, before `note_configured`.

        A drive: `input_pdos.DRIVE_FACTORS`. A sensor: Nm per unit of its channels.
        """
        for n, factor in enumerate((*factors, 0.0, 0.0, 0.0, 0.0)[:4]):
            self._views.node_factors[4 * node_id + n] = factor

    def note_doubt(self, node_id: int) -> None:
        """Report that a node has a changed configuration: the loop does not use it until it is configured again."""
        doubts = self._views.doubts
        doubts[node_id] = (doubts[node_id] + 1) % 256
        self._request(2)

    def note_checked(self, node_id: int, checked: bool) -> None:
        """Report whether the identity of a node has been checked: else its status is at most degraded."""
        self._views.unchecked[node_id] = not checked
        self._request(2)

    def note_alive(self) -> None:
        """Give the loop a sign of life of the supervisor."""
        self._request(4)

    def ask_reset(self) -> int:
        """Request the release of latched faults; return the number of the request."""
        return self._request(0)

    def _request(self, word: int) -> int:
        self._views.orders[word] += 1
        return int(self._views.orders[word])
