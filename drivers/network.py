"""canopen's Network on a bus: what it receives, what becomes of errors of its receiving thread, and its end."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable

import can
import canopen

from jtqd.drivers.bus_socket import PREFIX
from jtqd.drivers.can_unix import UnixBus
from jtqd.drivers.frame import CAN_RTR_FLAG, CAN_SFF_MASK

NOTIFIER_S = 0.01
"""canopen's default of 1 s is what closing the network would wait for."""


def open_can(name: str, identifiers: Iterable[int]) -> can.BusABC:
    """Open `can0` or `unix:PATH`; it receives data frames with these 11-bit identifiers. Raises can.CanError, OSError."""
    for library in ("canopen", "can"):  # what they log as an error is told by the line about it
        logging.getLogger(library).setLevel(logging.CRITICAL)
    # "extended": False puts CAN_EFF_FLAG into the mask: canopen takes 29-bit frames for 11-bit ones
    mask = CAN_SFF_MASK | CAN_RTR_FLAG
    filters = [{"can_id": cob_id, "can_mask": mask, "extended": False} for cob_id in identifiers]
    if name.startswith(PREFIX):
        return UnixBus(channel=name.removeprefix(PREFIX), can_filters=filters)
    return can.Bus(interface="socketcan", channel=name, can_filters=filters)


def network_on(bus: can.BusABC) -> tuple[canopen.Network, BusErrors]:
    """Return a network on an open bus, which `connect` starts, and the errors of its receiving thread."""
    network, errors = canopen.Network(), BusErrors()
    network.bus = bus
    network.NOTIFIER_CYCLE = NOTIFIER_S
    network.listeners.append(errors)
    return network, errors


def close(network: canopen.Network) -> None:
    """End a network."""
    try:
        network.disconnect()
    except Exception as error:
        # disconnect() re-raises what the receiving thread met; that has been reported already
        logging.getLogger(__name__).debug("closing the network: %s", error)


class BusErrors(can.Listener):  # type: ignore[misc]
    """Keep canopen's receiving thread from dying with a traceback, and the reason in `last`."""

    def __init__(self) -> None:
        self.last: Exception | None = None

    def on_message_received(self, msg: can.Message) -> None:
        """Do nothing: canopen's own listener takes the message."""

    def on_error(self, exc: Exception) -> None:
        """Keep the reason; a failing recv returns at once, so wait a little."""
        self.last = exc
        time.sleep(NOTIFIER_S)
