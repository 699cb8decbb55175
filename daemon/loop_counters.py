"""What the loop counts: once per cycle what only it knows, every n-th cycle what its parts have counted themselves."""

from __future__ import annotations

from daemon import cycle_record as cr
from daemon.intake import Intake
from daemon.snapshot import COUNTERS, LATE_BIN_NS, LATE_BINS, WORK_BIN_NS, WORK_BINS, Snapshot
from drivers.frame import worst_case_bits
from drivers.frame_socket import FrameSocket

_INDEX = {name: n for n, name in enumerate(COUNTERS)}
_WORK_MAX, _LATE_MAX = _INDEX["work_max_ns"], _INDEX["late_max_ns"]
_CYCLES, _MISSED, _COMPLETE = _INDEX["cycles"], _INDEX["missed"], _INDEX["complete"]
_PUBLISHED, _PUBLISHED_LATE = _INDEX["published"], _INDEX["published_late"]
_BITS = _INDEX["bits_worst_case"]


class LoopCounters:
    """Counters and histograms of the snapshot, fed by the loop.

    Args:
        snapshot: whose memory they are.
        intake, socket: count frames and inputs themselves.

    Attributes:
        bus_errors: calls that a bus which is down refused.
    """

    def __init__(self, snapshot: Snapshot, intake: Intake, socket: FrameSocket) -> None:
        self.bus_errors = 0
        self._snapshot, self._intake, self._socket = snapshot, intake, socket
        self._counters, self._work, self._late = snapshot.counters, snapshot.work, snapshot.late
        self._states = intake.views()
        self._bits_of = [worst_case_bits(pdo.length) for pdo in intake.pdos]
        self._bits_complete = worst_case_bits(1) + worst_case_bits(8) + sum(self._bits_of)

    def cycle(self, flags: int, work_ns: int, late_ns: int, missed: int) -> None:
        """One more cycle, with the flags of its record; times in ns, `missed` slots so far."""
        counters = self._counters
        counters[_CYCLES] += 1
        counters[_MISSED] = missed
        bits = self._bits_complete
        if flags & cr.FLAG_COMPLETE:
            counters[_COMPLETE] += 1
        else:
            bits -= sum(b for b, state in zip(self._bits_of, self._states, strict=True) if not state.fresh)
        if flags & cr.FLAG_PUBLISHED:
            counters[_PUBLISHED] += 1
            if not flags & cr.FLAG_BEFORE_NEXT_SYNC:
                counters[_PUBLISHED_LATE] += 1
        counters[_BITS] += bits
        counters[_WORK_MAX] = max(counters[_WORK_MAX], work_ns)
        counters[_LATE_MAX] = max(counters[_LATE_MAX], late_ns, 0)
        self._work[min(work_ns // WORK_BIN_NS, WORK_BINS - 1)] += 1
        self._late[min(max(late_ns, 0) // LATE_BIN_NS, LATE_BINS - 1)] += 1

    def flush(self, missed: int) -> None:
        """Copy what is counted elsewhere to where readers see it."""
        counters, intake, socket = self._counters, self._intake, self._socket
        counters[_MISSED] = missed
        counters[_INDEX["stale_inputs"]] = intake.stale_inputs
        counters[_INDEX["late_frames"]] = intake.late_frames
        counters[_INDEX["duplicate_frames"]] = intake.duplicate_frames
        counters[_INDEX["rejected_frames"]] = intake.rejected_frames
        counters[_INDEX["unknown_frames"]] = intake.unknown_frames
        counters[_INDEX["foreign_sync"]] = intake.foreign_sync
        counters[_INDEX["sync_errors"]] = intake.sync_errors
        counters[_INDEX["sync_gaps"]] = intake.gaps
        counters[_INDEX["boot_ups"]] = intake.boot_ups
        counters[_INDEX["temperatures_lost"]] = sum(each.lost for each in intake.temperatures)
        counters[_INDEX["tx_dropped"]] = socket.tx_dropped
        counters[_INDEX["rx_dropped"]] = socket.rx_dropped
        counters[_INDEX["bus_errors"]] = self.bus_errors
        for node, state in intake.node_states.items():
            self._snapshot.node_states[node] = state
        for node in intake.unconfigured:
            self._snapshot.unconfigured[node] = 1
