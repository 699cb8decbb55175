"""Emulated CiA 404 torque sensor with two channels around torque channels of `Source`s. Pure."""

from collections.abc import Callable, Sequence

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import VALUE_RANGE, SdoAbort
from jtqd.sim_can.canopen_node import CanopenNode
from jtqd.sim_can.eds_entries import SENSOR, entries_of
from jtqd.sim_can.source import ChannelSignal
from jtqd.sim_can.transmit import Channel, ChannelValue

AUTOZERO = 0x6F72_657A  # "zero" in 6125h
MAX_DECIMALS = 9


class SensorNode(CanopenNode):
    """Sensor as node `node_id`. Channel 1 is the first of `signals`; channel 2 is valid only where there is a second."""

    def __init__(self, signals: Sequence[ChannelSignal], node_id: int) -> None:
        super().__init__(ObjectStore(entries_of(node_id, SENSOR), node_id))
        self.store.set_number(0x1018, 4, 0x1000 + node_id)
        self.store.keep_as_default(0x1018, 4)
        self._channels: list[Channel] = []
        for number in (1, 2):
            signal = signals[number - 1] if number <= len(signals) else None
            channel = Channel(signal, self.store.number(0x6132, number))
            self._channels.append(channel)
            self.getters[0x9130, number] = ChannelValue(channel, 32)
            self.getters[0x7130, number] = ChannelValue(channel, 16)
            # the second channel is read in 16 bits (two digits), so its status is that of the 16-bit value
            self.getters[0x6150, number] = ChannelValue(channel, 32 if number == 1 else 16, status=True)
            self.handlers[0x6125, number] = _autozero(channel)
            self.handlers[0x6132, number] = _decimals(channel)
        self.connect()

    def on_reset(self) -> None:
        """Return to the power-on state: zero and decimals as delivered."""
        for number, channel in enumerate(self._channels, 1):
            channel.zero_nm = 0.0
            channel.set_decimals(self.store.number(0x6132, number))


def _autozero(channel: Channel) -> Callable[[int], None]:
    def handler(value: int) -> None:
        if value != AUTOZERO:
            raise SdoAbort(VALUE_RANGE)
        channel.autozero()

    return handler


def _decimals(channel: Channel) -> Callable[[int], None]:
    def handler(value: int) -> None:
        if value > MAX_DECIMALS:
            raise SdoAbort(VALUE_RANGE)
        channel.set_decimals(value)

    return handler
