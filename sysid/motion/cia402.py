"""CiA 402 from the commanding side: the state in a statusword, and the controlword that comes next. Pure.

Statusword bits: CiA 402-2, table "statusword bits by state"; commands: its table "command coding". A drive is led one
state at a time, and each step waits until the statusword has confirmed the one before.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

CSV: Final = 9
"""6060h: cyclic synchronous velocity mode; target 60FFh."""
CST: Final = 10
"""6060h: cyclic synchronous torque mode; target 6071h."""

DISABLE_VOLTAGE: Final = 0x0000
QUICK_STOP_WORD: Final = 0x0002
SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
ENABLE_OPERATION: Final = 0x000F
FAULT_RESET: Final = 0x0080


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
_ENABLING: Final = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.OPERATION_ENABLED: ENABLE_OPERATION,
}
POWERED: Final = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP, State.FAULT_REACTION, State.UNKNOWN})
"""States in which the motor is, or must be assumed to be, driven."""
FAULTED: Final = frozenset({State.FAULT, State.FAULT_REACTION})


def state_of(statusword: int) -> State:
    """Decode `statusword` (6041h): bit 5 (quick stop) counts where the coding has it, else mask 4Fh."""
    state = _BY_SIX_BITS.get(statusword & 0x6F)
    return state or _BY_FIVE_BITS.get(statusword & 0x4F, State.UNKNOWN)


_STATES: Final = tuple(state_of(low) for low in range(0x80))


def fast_state(statusword: int) -> State:
    """Decode as `state_of` by table: one index instead of two look-ups, for once per cycle and drive."""
    return _STATES[statusword & 0x7F]


def enabling_word(state: State) -> int | None:
    """Return the next controlword (6040h) towards operation enabled; None where none leads there (fault, quick stop)."""
    return _ENABLING.get(state)


def describe(statusword: int) -> str:
    """Return the state with its word: "fault (statusword 0218h)"."""
    return f"{state_of(statusword).value} (statusword {statusword:04X}h)"
