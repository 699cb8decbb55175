"""CiA 402 from the commanding side: the controlword that comes next. Pure.

Commands: CiA 402-2, table "command coding". A drive is led one state at a time, and each step waits until the statusword
(`jtqd.drivers.cia402`) has confirmed the one before.
"""

from __future__ import annotations

from typing import Final

from jtqd.drivers.cia402 import State, state_of

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

_ENABLING: Final = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE_OPERATION,
    State.OPERATION_ENABLED: ENABLE_OPERATION,
}
POWERED: Final = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP, State.FAULT_REACTION, State.UNKNOWN})
"""States in which the motor is, or must be assumed to be, driven."""
FAULTED: Final = frozenset({State.FAULT, State.FAULT_REACTION})


def enabling_word(state: State) -> int | None:
    """Return the next controlword (6040h) towards operation enabled; None where none leads there (fault, quick stop)."""
    return _ENABLING.get(state)


def describe(statusword: int) -> str:
    """Return the state with its word: "fault (statusword 0218h)"."""
    return f"{state_of(statusword).value} (statusword {statusword:04X}h)"
