"""Layer setting services (CiA 305) of one device: node-ID and bit rate, by canopen's master.

    with LssBus("can0") as bus:
        with bus.selected(identity) as device:       # in configuration state, at the end in waiting state
            device.node_id()

A device takes its new node-ID after NMT reset communication, and a stored bit rate after its next power-up. Activating a
bit rate on the bus (CiA 305, activate bit timing) is left out: it takes the bus away from every device that does not follow.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final, Self

import can
from canopen import lss

from jtqd.drivers.devices import SYNC_COB_ID
from jtqd.drivers.network import close, network_on, open_can

BIT_RATES: Final = (1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000)
"""[bit/s] in the order of table 0 of CiA 305."""
UNCONFIGURED: Final = 0xFF
"""Node-ID of a device that has none."""
_LISTEN_S, _ANSWER_S, _SETTLED_S = 0.12, 0.2, 0.03
_LENGTH: Final = 8
_PARTS: Final = (
    lss.CS_INQUIRE_VENDOR_ID,
    lss.CS_INQUIRE_PRODUCT_CODE,
    lss.CS_INQUIRE_REVISION_NUMBER,
    lss.CS_INQUIRE_SERIAL_NUMBER,
)
_REFUSALS: Final = {
    1: "out of range, or not supported",
    2: "it cannot write its memory",
    255: "an error of its maker's",
}
"""Error codes of the configuration services; 1 of store: it has no memory for them."""


class LssFailure(Exception):  # noqa: N818  (a state of the bus or of a device, told in one line)
    """A service that did not go well; the message is one line."""


@dataclass(frozen=True)
class LssAddress:
    """1018h:1 to 4 of a device: what distinguishes it from every other one."""

    vendor: int
    product: int
    revision: int
    serial: int

    def __str__(self) -> str:
        return ":".join(f"{part:08X}" for part in (self.vendor, self.product, self.revision, self.serial))


class LssDevice:
    """The device that is in configuration state. Every method raises LssFailure."""

    def __init__(self, master: lss.LssMaster) -> None:
        self._master = master

    def address(self) -> LssAddress:
        """Inquire its address."""
        parts = (self._one(partial(self._master.inquire_lss_address, part)) for part in _PARTS)
        return LssAddress(*parts)

    def node_id(self) -> int:
        """Inquire its node-ID; UNCONFIGURED: it has none."""
        return self._one(self._master.inquire_node_id)

    def set_node_id(self, node: int) -> None:
        """Set its pending node-ID, 1 to 127."""
        self._done("node-ID", lambda: self._master.configure_node_id(node))

    def set_bit_rate(self, bitrate: int) -> None:
        """Set its pending bit rate, one of BIT_RATES. Raises ValueError."""
        index = BIT_RATES.index(bitrate)
        self._done("bit rate", lambda: self._master.configure_bit_timing(index))

    def store(self) -> None:
        """Let it keep both."""
        self._done("store", self._master.store_configuration)

    def _one(self, service: Callable[[], int]) -> int:
        """Return the answer; two answers are of two devices."""
        try:
            answer = service()
        except lss.LssError as error:
            raise LssFailure(f"LSS: {str(error)[0].lower()}{str(error)[1:]}") from None
        time.sleep(_SETTLED_S)
        if not self._master.responses.empty():
            raise LssFailure("LSS: more than one device answers: choose one by --identity")
        return answer

    def _done(self, what: str, service: Callable[[], None]) -> None:
        try:
            service()
        except lss.LssError as error:
            text = str(error)
            code = text.removeprefix("LSS Error: ")
            if code.isdigit():
                text = f"refused with error {code} ({_REFUSALS.get(int(code), 'reserved')})"
            raise LssFailure(f"LSS: {what}: {text[0].lower()}{text[1:]}") from None


class LssBus:
    """A bus without a master, to which LSS is sent. Raises LssFailure where there is SYNC or no bus, or it has ended."""

    def __init__(self, name: str) -> None:
        self._name = name
        try:
            bus = open_can(name, (lss.LssMaster.LSS_RX_COBID, SYNC_COB_ID))
        except (can.CanError, OSError, ValueError) as error:
            raise self._failure(error) from None
        self._network, self._errors = network_on(bus)
        self._master: lss.LssMaster = self._network.lss
        self._master.RESPONSE_TIMEOUT = _ANSWER_S
        self._network.unsubscribe(self._master.LSS_RX_COBID)
        self._network.subscribe(self._master.LSS_RX_COBID, self._on_answer)
        self._syncs: queue.Queue[int] = queue.Queue(1)
        self._network.subscribe(SYNC_COB_ID, self._on_sync)

    def __enter__(self) -> Self:
        self._network.connect()
        try:
            self._syncs.get(timeout=_LISTEN_S)
        except queue.Empty:
            return self
        self.close()
        raise LssFailure(f"{self._name}: SYNC is on the bus: a master is running; end it first (jtqd, a PLC)")

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_sync(self, *_: object) -> None:
        if self._syncs.empty():
            self._syncs.put(1)

    def _on_answer(self, can_id: int, data: bytes, timestamp: float) -> None:
        """Take what is 8 bytes long, as every message of CiA 305; the library unpacks whatever comes."""
        if len(data) == _LENGTH:
            self._master.on_message_received(can_id, data, timestamp)

    def _failure(self, error: Exception) -> LssFailure:
        return LssFailure(f"bus {self._name}: {error}")

    def close(self) -> None:
        """Close the bus."""
        close(self._network)

    @contextmanager
    def selected(self, address: LssAddress | None = None) -> Iterator[LssDevice]:
        """Put the device with this address into configuration state, or every device (None: there must be one only).

        Raises LssFailure: none has this address.
        """
        with self._until_waiting() as device:
            master = self._master
            if address is None:
                master.send_switch_state_global(master.CONFIGURATION_STATE)
            else:
                parts = address.vendor, address.product, address.revision, address.serial
                try:
                    master.send_switch_state_selective(*parts)
                except lss.LssError:
                    raise LssFailure(f"LSS: no device with the identity {address} answers") from None
            yield device

    @contextmanager
    def unconfigured(self) -> Iterator[LssDevice | None]:
        """Find a device without a node-ID by fast scan, and put it into configuration state; None: there is none."""
        with self._until_waiting() as device:
            found, _ = self._master.fast_scan()
            yield device if found else None

    @contextmanager
    def _until_waiting(self) -> Iterator[LssDevice]:
        """Put all devices into waiting state, before and after. Raises LssFailure where the bus ends."""
        waiting = partial(self._master.send_switch_state_global, self._master.WAITING_STATE)
        try:
            waiting()
            try:
                yield LssDevice(self._master)
            finally:
                waiting()
        except (can.CanError, OSError) as error:
            raise self._failure(self._errors.last or error) from None
