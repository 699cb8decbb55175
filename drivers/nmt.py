"""Network management (CiA 301, 7.2.8): commands of the master, and the states in a heartbeat.

>>> command(START, 2)[:4].hex(), STATES[PRE_OPERATIONAL]
('00000000', 'pre-operational')
"""

from __future__ import annotations

from typing import Final

from jtqd.drivers.frame import pack

HEARTBEAT_BASE: Final = 0x700
"""COB-ID of a node's heartbeat and boot-up message: this plus its node-ID."""

BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
STATES: Final = {
    BOOT_UP: "boot-up",
    STOPPED: "stopped",
    OPERATIONAL: "operational",
    PRE_OPERATIONAL: "pre-operational",
}
"""By the byte of a heartbeat."""
NOT_OPERATIONAL: Final = (STOPPED, PRE_OPERATIONAL)
"""States in which a node sends no PDO."""

START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82
COMMANDS: Final = {
    START: "start",
    STOP: "stop",
    ENTER_PRE_OPERATIONAL: "enter pre-operational",
    RESET_NODE: "reset node",
    RESET_COMMUNICATION: "reset communication",
}
STATE_AFTER: Final = {START: OPERATIONAL, STOP: STOPPED, ENTER_PRE_OPERATIONAL: PRE_OPERATIONAL}
"""Of a node that obeys; after a reset it sends its boot-up message and is pre-operational."""


def command(number: int, node: int) -> bytes:
    """Return the frame that gives a node, or all of them (0), an NMT command."""
    return pack(0x000, bytes((number, node)))


def heartbeat(node: int, state: int) -> bytes:
    """Return the heartbeat of a node in this state; BOOT_UP makes it the boot-up message."""
    return pack(HEARTBEAT_BASE + node, bytes((state,)))
