"""State of the CAN controller, from the error messages of its driver (linux/can/error.h). Pure: bytes in.

The kernel's driver sends them as frames with CAN_ERR_FLAG to those who ask for them: error warning, error passive, bus-off
and restart, lost arbitration, missing acknowledge, protocol errors, overruns, and where it can the two error counters. vcan
and the unix hub make none by themselves, but carry those that somebody sends.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.eds.own_objects import BUS_FIELDS

ACTIVE, WARNING, PASSIVE, BUS_OFF, DOWN = 0, 1, 2, 3, 4
STATE_NAMES = ("error active", "error warning", "error passive", "bus-off", "interface down")

# Classes of the error message, in its identifier
_TX_TIMEOUT, _LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER = 0x01, 0x02, 0x04, 0x08, 0x10
_NO_ACK, _BUS_OFF, _BUS_ERROR, _RESTARTED, _COUNTERS = 0x20, 0x40, 0x80, 0x100, 0x200
# data[1] of _CONTROLLER
_OVERFLOW, _WARNING_BITS, _PASSIVE_BITS, _ACTIVE_BIT = 0x03, 0x0C, 0x30, 0x40


class BusChange(NamedTuple):
    """The state has changed from `before` to `after`."""

    before: int
    after: int


class BusState:
    """Counts of one interface, by the names of `BUS_FIELDS`."""

    def __init__(self) -> None:
        self.counts = dict.fromkeys(BUS_FIELDS, 0)

    @property
    def state(self) -> int:
        """ACTIVE .. DOWN."""
        return self.counts["state"]

    def values(self) -> tuple[int, ...]:
        """In the order of `BUS_FIELDS`."""
        return tuple(self.counts.values())

    def error_frame(self, can_id: int, data: bytes) -> BusChange | None:
        """One message of the driver; the change of state that it tells, if any. A short one is taken as far as it goes."""
        counts = self.counts
        data = data.ljust(8, b"\0")
        for bit, name in (
            (_TX_TIMEOUT, "tx_timeouts"),
            (_LOST_ARBITRATION, "arbitration_lost"),
            (_TRANSCEIVER, "transceiver"),
            (_NO_ACK, "no_acknowledge"),
        ):
            counts[name] += bool(can_id & bit)
        counts["protocol_errors"] += bool(can_id & (_PROTOCOL | _BUS_ERROR))
        if can_id & _COUNTERS:
            counts["tx_errors"], counts["rx_errors"] = data[6], data[7]
        if can_id & _CONTROLLER and data[1] & _OVERFLOW:
            counts["overruns"] += 1
        if can_id & _RESTARTED:
            counts["restarts"] += 1
            return self._become(ACTIVE)
        if can_id & _BUS_OFF:
            return self._become(BUS_OFF)
        if can_id & _CONTROLLER:
            return self._controller(data[1])
        return None

    def down(self) -> BusChange | None:
        """The interface is down (ENETDOWN)."""
        return self._become(DOWN)

    def alive(self) -> BusChange | None:
        """A frame of somebody else has come: the interface is up, and its controller is not bus-off (any more).

        Some drivers tell no restart, and an interface that was set up starts error active without a word.
        """
        return self._become(ACTIVE) if self.state in (BUS_OFF, DOWN) else None

    def _controller(self, bits: int) -> BusChange | None:
        if bits & _PASSIVE_BITS:
            return self._become(PASSIVE)
        if bits & _WARNING_BITS:
            return self._become(WARNING)
        return self._become(ACTIVE) if bits & _ACTIVE_BIT else None

    def _become(self, state: int) -> BusChange | None:
        before = self.state
        if state == before:
            return None
        self.counts["state"] = state
        name = {WARNING: "warnings", PASSIVE: "passives", BUS_OFF: "bus_offs", DOWN: "downs"}.get(state)
        if name is not None:
            self.counts[name] += 1
        return BusChange(before, state)
