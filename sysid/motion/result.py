"""What a motion ended with, how it can be refused, and the times it is supervised with."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal, NamedTuple


class MotionError(Exception):
    """The motion was refused before anything moved; one line for the operator."""


class MotionResult(NamedTuple):
    """How a motion ended. Both joints are disabled in either case, or `reason` says what could not be confirmed.

    Attributes:
        status: "done", or "stopped" before its end.
        reason: one line: joint, quantity, found, limit; "" when done.
        played_s: length of the set-points that were sent.
    """

    status: Literal["done", "stopped"]
    reason: str
    played_s: float


class Violation(NamedTuple):
    """Why the motion must end.

    Attributes:
        reason: one line: joint, quantity, found, limit.
        hard: the joints cannot be led to a stop any more (drive or SYNC lost): each drive brakes by itself, now.
    """

    reason: str
    hard: bool


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the supervision in seconds. ValueError for one that is not positive.

    Attributes:
        sync_lost_s: longest time without SYNC.
        late_s: longest time from SYNC to its set-point.
        stale_cycles: SYNCs that a TPDO may be missing.
        heartbeats_missing: heartbeats of a node (1017h) that may be missing.
        temperature_s: longest time between two temperatures (TPDO3 comes every 500 ms).
        own_heartbeat_s: period of ours.
        drive_timeout_s: 1016h:2 of the drives: without our heartbeat for so long they stop by themselves.
        setpoint_delay_s: from SYNC to the set-point. The TPDOs have crossed the wire by then, so that the RPDO, whose
            identifier is lower than that of TPDO2, does not delay them.
        ready_s: for SYNC, all inputs and standstill to be there at the start.
        still_s: standstill required before the joints are enabled.
        enable_s, quick_stop_s, disable_s: for the drives to change their state.
    """

    sync_lost_s: float = 0.02
    late_s: float = 0.02
    stale_cycles: int = 5
    heartbeats_missing: int = 3
    temperature_s: float = 2.0
    own_heartbeat_s: float = 0.1
    drive_timeout_s: float = 0.3
    setpoint_delay_s: float = 0.7e-3
    ready_s: float = 3.0
    still_s: float = 0.15
    enable_s: float = 1.0
    quick_stop_s: float = 1.0
    disable_s: float = 0.5

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise ValueError(f"timing: {item.name} is {value!r}, expected a positive number")
