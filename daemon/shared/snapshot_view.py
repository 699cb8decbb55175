"""What a reading of the loop's snapshot holds (`daemon/shared/snapshot.py` says where it lies in memory)."""

from __future__ import annotations

from typing import NamedTuple

STATUS_CODES = 16
MAX_NODE = 128

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
    "network_not_finite",
    "network_far",
    "network_outside",
    "network_no_time",
    "overruns",
    "fault_not_finite",
    "fault_out_of_range",
    "fault_motor_jump",
    "fault_link_jump",
    "fault_velocity_mismatch",
    "fault_torsion",
    "fault_current_frozen",
    "fault_deviation",
    "latches",
    "latch_resets",
)
"""In the order of their words; docs/bus.md says what each one means."""

BUS_COUNTERS = (
    "late_frames",
    "duplicate_frames",
    "rejected_frames",
    "unknown_frames",
    "foreign_sync",
    "sync_errors",
    "sync_gaps",
    "boot_ups",
    "tx_dropped",
    "rx_dropped",
    "bus_errors",
)
"""Those of them that count what is wrong on the bus."""


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
    """Inputs and faults of that cycle, as in the cycle record (`daemon/shared/cycle_record.py`)."""
    latched: int = 0
    """Bits of the faults that are latched (`daemon/shared/faults.py`)."""


class Measured(NamedTuple):
    """What one joint's inputs said in the same cycle, SI units; NaN where an input is missing."""

    current_a: float
    motor_position_rad: float
    motor_velocity_rad_s: float
    link_position_rad: float
    sensor_nm: float
    temperature_c: float


class InputView(NamedTuple):
    """One input PDO, in the order of `daemon/loop/input_pdos.py`; every 8th cycle is looked at."""

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
    sync_monotonic_ns: int = 0
    """CLOCK_MONOTONIC of the last cycle's SYNC; 0 before the first."""
    status_since: tuple[int, int] = (0, 0)
    """Cycle since which each joint has its status (seen every 8th cycle)."""
    measured: tuple[Measured, Measured] = (NOT_MEASURED, NOT_MEASURED)
    status_cycles: tuple[tuple[int, ...], tuple[int, ...]] = ((0,) * STATUS_CODES, (0,) * STATUS_CODES)
    """How many cycles each joint has spent in each status code."""
    inputs: tuple[InputView, ...] = ()
    node_heard_ns: tuple[int, ...] = (0,) * MAX_NODE
    """Kernel stamp of the last heartbeat of each node-ID, CLOCK_REALTIME; 0 never."""
    restarts: tuple[int, ...] = (0,) * MAX_NODE
    """Boot-up messages of each node-ID."""


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
