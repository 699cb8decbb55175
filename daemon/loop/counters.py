"""What the loop counts: once per cycle what only it knows, every n-th cycle what its parts have counted themselves."""

from __future__ import annotations

from jtqd.daemon.loop.intake import Intake
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.snapshot import (
    COUNTERS,
    INPUT,
    LATE_BIN_NS,
    LATE_BINS,
    STATUS_CODES,
    WORK_BIN_NS,
    WORK_BINS,
    Snapshot,
)
from jtqd.drivers.frame import worst_case_bits
from jtqd.drivers.frame_socket import FrameSocket

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
        overruns: cycles whose estimate was not ready before the next SYNC was due.
        latch_resets: joints whose latched faults were released by a reset.
    """

    def __init__(self, snapshot: Snapshot, intake: Intake, socket: FrameSocket) -> None:
        self.bus_errors = self.overruns = self.latch_resets = 0
        self._snapshot, self._intake, self._socket = snapshot, intake, socket
        self._counters, self._work, self._late = snapshot.counters, snapshot.work, snapshot.late
        self._states = intake.views()
        self._bits = 0
        self._used = [0] * len(self._states)
        self._delays = [0] * len(self._states)
        self._bits_of = [worst_case_bits(pdo.length) for pdo in intake.pdos]
        self._bits_complete = worst_case_bits(1) + worst_case_bits(8) + sum(self._bits_of)

    def cycle(self, flags: int, work_ns: int, late_ns: int, missed: int) -> None:
        """Count one cycle, with the flags of its record; times in ns, `missed` slots so far."""
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
        self._bits += bits
        counters[_WORK_MAX] = max(counters[_WORK_MAX], work_ns)
        counters[_LATE_MAX] = max(counters[_LATE_MAX], late_ns, 0)
        self._work[min(work_ns // WORK_BIN_NS, WORK_BINS - 1)] += 1
        self._late[min(max(late_ns, 0) // LATE_BIN_NS, LATE_BINS - 1)] += 1

    def statuses(self, one: int, two: int) -> None:
        """Count the published statuses of joints 1 and 2 in one cycle."""
        cycles = self._snapshot.status_cycles
        cycles[one] += 1
        cycles[STATUS_CODES + two] += 1

    def flush(self, missed: int, sync_ns: int) -> None:
        """Copy the counts of other objects to the snapshot; `sync_ns` is the cycle's SYNC (CLOCK_MONOTONIC)."""
        self._flush_inputs(sync_ns)
        counters, intake, socket = self._counters, self._intake, self._socket
        counters[_MISSED] = missed
        counters[_BITS] = (
            self._bits
        )  # not in every cycle: readers divide it by the time between two snapshots
        counters[_INDEX["stale_inputs"]] = intake.stale_inputs
        counters[_INDEX["late_frames"]] = intake.late_frames
        counters[_INDEX["duplicate_frames"]] = intake.duplicate_frames
        counters[_INDEX["rejected_frames"]] = intake.rejected_frames
        counters[_INDEX["unknown_frames"]] = intake.unknown_frames
        counters[_INDEX["foreign_sync"]] = intake.foreign_sync
        counters[_INDEX["sync_errors"]] = intake.sync_errors
        counters[_INDEX["sync_gaps"]] = intake.gaps.count
        counters[_INDEX["boot_ups"]] = intake.nodes.boot_ups
        counters[_INDEX["temperatures_lost"]] = sum(each.lost for each in intake.temperatures)
        counters[_INDEX["tx_dropped"]] = socket.tx_dropped
        counters[_INDEX["rx_dropped"]] = socket.rx_dropped
        counters[_INDEX["bus_errors"]] = self.bus_errors
        counters[_INDEX["overruns"]] = self.overruns
        counters[_INDEX["latch_resets"]] = self.latch_resets
        self._flush_nodes()

    def _flush_nodes(self) -> None:
        nodes, snapshot = self._intake.nodes, self._snapshot
        for node, state in nodes.states.items():
            snapshot.node_states[node] = state
        for node in nodes.unconfigured:
            snapshot.unconfigured[node] = 1
        for node, count in nodes.restarts.items():
            snapshot.restarts[node] = count
        for node, stamp_ns in nodes.heard_ns.items():
            snapshot.node_heard[node] = stamp_ns

    def _flush_inputs(self, sync_ns: int) -> None:
        sync_stamp_ns = self._intake.sync_stamp_ns
        inputs, used, delays = self._snapshot.inputs, self._used, self._delays
        for n, state in enumerate(self._states):
            if state.fresh:
                used[n] = sync_ns
                delays[n] = state.stamp_ns - sync_stamp_ns
            INPUT.pack_into(
                inputs,
                n * INPUT.size,
                used[n],
                delays[n],
                state.band_low_ns,
                state.band_high_ns,
                state.late,
                state.lost,
                state.duplicates,
                state.rejected,
                state.missed,
                state.in_a_row,
                state.short,
                state.long,
            )


def frame_counts(intake: Intake) -> dict[str, dict[str, int]]:
    """Return late, lost, duplicate and rejected frames by PDO name; for a temperature, how often it became unknown."""
    counts = {
        state.pdo.name: {
            "late": state.late,
            "lost": state.lost,
            "duplicate": state.duplicates,
            "rejected": state.rejected,
        }
        for state in intake.views()
    }
    for each in intake.temperatures:
        counts[each.name] = {"late": 0, "lost": each.lost, "duplicate": 0, "rejected": each.rejected}
    return counts
