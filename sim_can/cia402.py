"""State machine of a CiA 402 drive: controlword in, state and statusword out. Pure.

States and statuswords after CiA 402-2, table "statusword bits by state"; numbers in comments below are its
transitions.
"""

from typing import Final

NOT_READY: Final = 0
SWITCH_ON_DISABLED: Final = 1
READY: Final = 2
SWITCHED_ON: Final = 3
OPERATION_ENABLED: Final = 4
QUICK_STOP: Final = 5
FAULT_REACTION: Final = 6
FAULT: Final = 7

NAMES: Final = (
    "not ready to switch on",
    "switch on disabled",
    "ready to switch on",
    "switched on",
    "operation enabled",
    "quick stop active",
    "fault reaction active",
    "fault",
)

VOLTAGE: Final = 0x0010  # bit 4, voltage enabled
REMOTE: Final = 0x0200  # bit 9, the controlword is obeyed
FOLLOWS: Final = 0x1000  # bit 12 in csv and cst: the drive follows the target
_BITS: Final = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)
STATUSWORDS: Final = tuple(
    bits | VOLTAGE | REMOTE | (FOLLOWS if state == OPERATION_ENABLED else 0)
    for state, bits in enumerate(_BITS)
)

FAULT_RESET: Final = 0x80

# (mask, value) of the commands, bit 7 = 0 in all of them
_DISABLE_VOLTAGE: Final = (0x82, 0x00)
_QUICK_STOP: Final = (0x86, 0x02)
_SHUTDOWN: Final = (0x87, 0x06)
_SWITCH_ON: Final = (0x8F, 0x07)
_ENABLE: Final = (0x8F, 0x0F)

# what each command does in which state
_TRANSITIONS: Final = (
    (
        _DISABLE_VOLTAGE,
        dict.fromkeys((READY, SWITCHED_ON, OPERATION_ENABLED, QUICK_STOP), SWITCH_ON_DISABLED),
    ),  # 7 10 9 12
    (
        _QUICK_STOP,
        {
            READY: SWITCH_ON_DISABLED,
            SWITCHED_ON: SWITCH_ON_DISABLED,
            OPERATION_ENABLED: QUICK_STOP,
        },  # 7 10 11
    ),
    (_SHUTDOWN, {SWITCH_ON_DISABLED: READY, SWITCHED_ON: READY, OPERATION_ENABLED: READY}),  # 2 6 8
    (_SWITCH_ON, {READY: SWITCHED_ON, OPERATION_ENABLED: SWITCHED_ON}),  # 3 5
    # 3 and 4 in one: CiA 402 lets a drive go on by itself when "enable operation" comes in "ready to switch
    # on"
    (_ENABLE, {READY: OPERATION_ENABLED, SWITCHED_ON: OPERATION_ENABLED}),
)


class StateMachine:
    """State of one drive. It starts in "switch on disabled": transitions 0 and 1 are automatic."""

    __slots__ = ("_last", "state")

    def __init__(self) -> None:
        self.state = SWITCH_ON_DISABLED
        self._last = 0

    @property
    def statusword(self) -> int:
        """6041h."""
        return STATUSWORDS[self.state]

    @property
    def powered(self) -> bool:
        """The power stage drives the motor."""
        return self.state in (OPERATION_ENABLED, QUICK_STOP, FAULT_REACTION)

    def controlword(self, word: int) -> bool:
        """Obey 6040h. True when a fault was reset by this word (rising edge of bit 7, transition 15)."""
        rising = word & FAULT_RESET and not self._last & FAULT_RESET
        self._last = word
        if self.state == FAULT:
            if rising:
                self.state = SWITCH_ON_DISABLED
                return True
            return False
        for (mask, value), moves in _TRANSITIONS:
            if word & mask == value:
                self.state = moves.get(self.state, self.state)
                break
        return False

    def fault(self) -> None:
        """Transition 13: a fault was detected. A powered drive reacts first; the others are in "fault" at
        once.
        """
        if self.state != FAULT:
            self.state = FAULT_REACTION if self.powered else FAULT

    def stopped(self) -> None:
        """The quick stop or the fault reaction has come to its end: transition 12 or 14."""
        if self.state == QUICK_STOP:
            self.state = SWITCH_ON_DISABLED
        elif self.state == FAULT_REACTION:
            self.state = FAULT

    def enable_by_itself(self) -> None:
        """Operation enabled without a controlword: demo motion and play-back, where no controller is on the
        bus.
        """
        self.state = OPERATION_ENABLED

    def release(self) -> None:
        """Power stage off without a fault, as after power-on."""
        self.state = SWITCH_ON_DISABLED
        self._last = 0
