"""The state of a drive in its statusword (6041h): CiA 402-2, table "statusword bits by state". Pure.

What a state means is said where it matters: for an estimate in `jtqd.daemon.shared.faults`, for a motion in
`jtqd.sysid.motion.drives`, for a run in `jtqd.sysid.runs.logs`.

>>> state_of(0x1637).value, state_of(0x0218).value
('operation enabled', 'fault')
"""

from __future__ import annotations

from enum import Enum
from typing import Final


class State(Enum):
    """State of the drive; the value is its name in CiA 402."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"


_BY_SIX_BITS: Final = {
    0x21: State.READY,
    0x23: State.SWITCHED_ON,
    0x27: State.OPERATION_ENABLED,
    0x07: State.QUICK_STOP,
}
_BY_FIVE_BITS: Final = {
    0x00: State.NOT_READY,
    0x40: State.SWITCH_ON_DISABLED,
    0x0F: State.FAULT_REACTION,
    0x08: State.FAULT,
}
TOLD: Final = 0x7F
"""Bits of a statusword that tell the state, and bit 4, which does not."""


def state_of(statusword: int) -> State:
    """Decode `statusword` (6041h): bit 5 (quick stop) counts where the coding has it, else mask 4Fh."""
    state = _BY_SIX_BITS.get(statusword & 0x6F)
    return state or _BY_FIVE_BITS.get(statusword & 0x4F, State.UNKNOWN)


STATES: Final = tuple(state_of(low) for low in range(TOLD + 1))
"""By `statusword & TOLD`, for tables."""


def fast_state(statusword: int) -> State:
    """Decode as `state_of` by table: one index instead of two look-ups, for once per cycle and drive."""
    return STATES[statusword & TOLD]
