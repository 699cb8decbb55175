"""Emulated CiA 404 torque sensor with two channels around the torque channels of a `Source`. Pure."""

from collections.abc import Callable

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import VALUE_RANGE, SdoAbort
from jtqd.sim_can.canopen_node import CanopenNode
from jtqd.sim_can.eds_entries import entries_of
from jtqd.sim_can.source import ChannelSignal, Source

AUTOZERO = 0x6F72_657A  # "zero" in 6125h
MAX_DECIMALS = 9
NOT_VALID, POSITIVE_OVERLOAD, NEGATIVE_OVERLOAD = 1, 2, 4  # bits of 6150h
SENSOR_NODE = 3
_I32 = 0x7FFF_FFFF
_I16 = 0x7FFF


class _Channel:
    """One measuring channel: value = round((torque - zero) 10^decimals)."""

    def __init__(self, signal: ChannelSignal | None, decimals: int) -> None:
        self.signal = signal
        self.zero_nm = 0.0
        self.set_decimals(decimals)

    def set_decimals(self, decimals: int) -> None:
        """Set the decimal digits: 6132h."""
        self.scale = 10.0**decimals

    def autozero(self) -> None:
        """Make the present torque zero: 6125h."""
        if self.signal is not None:
            self.zero_nm = self.signal.torque_nm

    def value(self, limit: int = _I32) -> int:
        """Return 9130h, or 7130h with limit 7FFFh; a value that does not fit saturates."""
        if self.signal is None:
            return 0
        value = round((self.signal.torque_nm - self.zero_nm) * self.scale)
        return -limit - 1 if value < -limit - 1 else limit if value > limit else value

    def value_16(self) -> int:
        """Return 7130h."""
        return self.value(_I16)

    def status(self) -> int:
        """Return 6150h: not valid without a signal; overload where even 32 bits do not hold the value."""
        if self.signal is None or not self.signal.valid:
            return NOT_VALID
        value = self.value()
        return POSITIVE_OVERLOAD if value == _I32 else NEGATIVE_OVERLOAD if value == -_I32 - 1 else 0

    def status_16(self) -> int:
        """Return 6150h for a channel that is read in 16 bits: overload at that range."""
        value = self.value_16()
        overload = POSITIVE_OVERLOAD if value == _I16 else NEGATIVE_OVERLOAD if value == -_I16 - 1 else 0
        return self.status() | overload


class SensorNode(CanopenNode):
    """Sensor as node 3. Channel 1 is the source's first torque channel; channel 2 is valid only where there is a second."""

    def __init__(self, source: Source) -> None:
        super().__init__(ObjectStore(entries_of(SENSOR_NODE), SENSOR_NODE))
        self.store.set_number(0x1018, 4, 0x1000 + SENSOR_NODE)
        self.store.keep_as_default(0x1018, 4)
        self._channels: list[_Channel] = []
        for number in (1, 2):
            signal = source.channels[number - 1] if number <= len(source.channels) else None
            channel = _Channel(signal, self.store.number(0x6132, number))
            self._channels.append(channel)
            self.getters[0x9130, number] = channel.value
            self.getters[0x7130, number] = channel.value_16
            # the second channel is read in 16 bits (two digits), so its status is that of the 16-bit value
            self.getters[0x6150, number] = channel.status if number == 1 else channel.status_16
            self.handlers[0x6125, number] = _autozero(channel)
            self.handlers[0x6132, number] = _decimals(channel)
        self.connect()

    def on_reset(self) -> None:
        """Return to the power-on state: zero and decimals as delivered."""
        for number, channel in enumerate(self._channels, 1):
            channel.zero_nm = 0.0
            channel.set_decimals(self.store.number(0x6132, number))


def _autozero(channel: _Channel) -> Callable[[int], None]:
    def handler(value: int) -> None:
        if value != AUTOZERO:
            raise SdoAbort(VALUE_RANGE)
        channel.autozero()

    return handler


def _decimals(channel: _Channel) -> Callable[[int], None]:
    def handler(value: int) -> None:
        if value > MAX_DECIMALS:
            raise SdoAbort(VALUE_RANGE)
        channel.set_decimals(value)

    return handler
