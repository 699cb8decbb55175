"""Emulated devices around a `Source`: drives (CiA 402) and a torque sensor (CiA 404) with two channels. Pure.

`StateMachine` follows CiA 402-2, table "statusword bits by state": controlword in, state and statusword out; numbers in its
comments are the transitions. `DriveNode` and `SensorNode` are the devices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from typing import Final

from jtqd.drivers.drive import TEMPERATURE_C_PER_UNIT
from jtqd.drivers.emcy import HEARTBEAT_LOST
from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import VALUE_RANGE, SdoAbort
from jtqd.sim_can.canopen_node import CURRENT as CURRENT_ERROR
from jtqd.sim_can.canopen_node import CanopenNode
from jtqd.sim_can.eds_entries import DRIVE, SENSOR, entries_of
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY, ChannelSignal, DriveRatings, DriveSignals, Source
from jtqd.sim_can.transmit import Channel, ChannelValue, DriveValue

NOT_READY: Final = 0
SWITCH_ON_DISABLED: Final = 1
READY: Final = 2
SWITCHED_ON: Final = 3
OPERATION_ENABLED: Final = 4
QUICK_STOP: Final = 5
FAULT_REACTION: Final = 6
FAULT: Final = 7

VOLTAGE: Final = 0x0010  # bit 4, voltage enabled
REMOTE: Final = 0x0200  # bit 9, the controlword is followed
FOLLOWS: Final = 0x1000  # bit 12 in csv and cst: the drive follows the target
_BITS: Final = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)
STATUSWORDS: Final = tuple(
    bits | VOLTAGE | REMOTE | (FOLLOWS if state == OPERATION_ENABLED else 0)
    for state, bits in enumerate(_BITS)
)

FAULT_RESET: Final = 0x80

_ON: Final = (READY, SWITCHED_ON, OPERATION_ENABLED)
_TRANSITIONS: Final = (
    (0x82, 0x00, dict.fromkeys((*_ON, QUICK_STOP), SWITCH_ON_DISABLED)),  # disable voltage: 7 10 9 12
    # quick stop: 7 10 11
    (0x86, 0x02, dict.fromkeys(_ON, SWITCH_ON_DISABLED) | {OPERATION_ENABLED: QUICK_STOP}),
    (
        0x87,
        0x06,
        dict.fromkeys((SWITCH_ON_DISABLED, SWITCHED_ON, OPERATION_ENABLED), READY),
    ),  # shutdown: 2 6 8
    (0x8F, 0x07, dict.fromkeys((READY, OPERATION_ENABLED), SWITCHED_ON)),  # switch on: 3 5
    # enable operation: 4, and 3 and 4 in one: CiA 402 lets a drive go on by itself from "ready to switch on"
    (0x8F, 0x0F, dict.fromkeys((READY, SWITCHED_ON), OPERATION_ENABLED)),
)
"""Command by mask and value of 6040h, bit 7 = 0 in all of them; state before -> state after."""


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
        """Whether the power stage drives the motor."""
        return self.state in (OPERATION_ENABLED, QUICK_STOP, FAULT_REACTION)

    def controlword(self, word: int) -> bool:
        """Follow 6040h. Return True when this word reset a fault (rising edge of bit 7, transition 15)."""
        rising = word & FAULT_RESET and not self._last & FAULT_RESET
        self._last = word
        if self.state == FAULT:
            if rising:
                self.state = SWITCH_ON_DISABLED
                return True
            return False
        for mask, value, moves in _TRANSITIONS:
            if word & mask == value:
                self.state = moves.get(self.state, self.state)
                break
        return False

    def fault(self) -> None:
        """Detect a fault, transition 13. A powered drive reacts first; the others are in "fault" at once."""
        if self.state != FAULT:
            self.state = FAULT_REACTION if self.powered else FAULT

    def stopped(self) -> None:
        """End the quick stop or the fault reaction: transition 12 or 14."""
        if self.state == QUICK_STOP:
            self.state = SWITCH_ON_DISABLED
        elif self.state == FAULT_REACTION:
            self.state = FAULT

    def enable_by_itself(self) -> None:
        """Enable operation without a controlword: demo motion and play-back, where no controller is on the bus."""
        self.state = OPERATION_ENABLED

    def release(self) -> None:
        """Switch the power stage off without a fault, as after power-on."""
        self.state = SWITCH_ON_DISABLED
        self._last = 0


OVERCURRENT = 0x2310
STANDSTILL_RAD_S = 0.01  # joint side: a quick stop has ended below this
HALT = 0x0100
DEFAULT_INTERPOLATION_S = 0.001  # 60C2h after power-on
_INTERPOLATION_UNITS = (-6, 0)  # 60C2h:2: microseconds to seconds


class DriveNode(CanopenNode):
    """Drive `number` (0, 1) of the source as CANopen node `node_id`.

    While no master has written 6040h or 6060h (`commanded` False) the bench may run the drive itself:
    `run_by_itself`.
    """

    def __init__(self, source: Source, number: int, on_master: Callable[[], None], node_id: int) -> None:
        super().__init__(ObjectStore(entries_of(node_id, DRIVE), node_id))
        self.machine = StateMachine()
        self.commanded = False
        self._source, self._number, self._on_master = source, number, on_master
        self._signals: DriveSignals = source.drives[number]
        self._ratings: DriveRatings = source.ratings[number]
        self._mode = 0
        self._ran = False  # since it was set up: 6060h written, or power-on
        self._own_target = 0.0
        self._sent = (OFF, 0.0)
        self._interpolation_s = DEFAULT_INTERPOLATION_S
        ratings = self._ratings
        self._motor_units = ratings.motor_counts_per_rev / (2.0 * math.pi)
        self._link_units = ratings.link_counts_per_rev / (2.0 * math.pi)
        self._still_rad_s = STANDSTILL_RAD_S * ratings.gear_ratio
        self._current_units = 0.0
        self._store_ratings()
        signals = self._signals
        current = DriveValue(signals, "current_a", self._current_units)
        self.getters = {
            (0x3001, 0): DriveValue(signals, "temperature_c", 1.0 / TEMPERATURE_C_PER_UNIT),
            (0x603F, 0): lambda: self._error_code,
            (0x6041, 0): lambda: self.machine.statusword,
            (0x6061, 0): lambda: self._mode,
            (0x6064, 0): DriveValue(signals, "motor_position_rad", self._motor_units),
            (0x606C, 0): DriveValue(signals, "motor_velocity_rad_s", self._motor_units),
            # torque in 1/1000 of rated torque = current in 1/1000 of rated current
            (0x6077, 0): current,
            (0x6078, 0): current,
            (0x60E4, 1): DriveValue(signals, "link_position_rad", self._link_units),
        }
        self.quiet = frozenset({(0x3001, 0)})  # sent every 500 ms
        self.handlers = {
            (0x6040, 0): self._controlword,
            (0x6060, 0): self._mode_of_operation,
            (0x60C2, 1): self._interpolation_value,
            (0x60C2, 2): self._interpolation_index,
        }
        self._error_code = 0
        self._messages: list[bytes] = []
        self.connect()

    def _store_ratings(self) -> None:
        """Put the source's ratings into the object dictionary, as power-on values."""
        ratings = self._ratings
        numerator, denominator = _ratio(ratings.gear_ratio)
        values = {
            (0x1018, 4): 0x1000 + self.node_id,
            (0x6075, 0): max(1, round(1000.0 * ratings.rated_current_a)),
            (0x6076, 0): max(1, round(1000.0 * ratings.rated_torque_nm)),
            (0x608F, 1): ratings.motor_counts_per_rev,
            (0x6090, 1): ratings.motor_counts_per_rev,
            (0x60E6, 1): ratings.link_counts_per_rev,
            (0x6091, 1): numerator,
            (0x6091, 2): denominator,
        }
        for key, value in values.items():
            self.store.set_number(*key, value)
            self.store.keep_as_default(*key)
        # 6078h is scaled by 6075h as it reads, to the mA
        self._current_units = 1000.0 / (self.store.number(0x6075) * 1e-3)

    # Commands -----------------------------------------------------------------------------------------------

    def _controlword(self, word: int) -> None:
        self._take_over()
        if self.machine.controlword(word):
            self._error_code = 0
            self._messages += self.clear_error(OVERCURRENT, HEARTBEAT_LOST)

    def _mode_of_operation(self, mode: int) -> None:
        if mode not in (0, VELOCITY, CURRENT):
            raise SdoAbort(VALUE_RANGE)
        self._take_over()
        self._mode = mode
        self._ran = False

    def _interpolation_value(self, value: int) -> None:
        self._interpolate(value=value)

    def _interpolation_index(self, index: int) -> None:
        low, high = _INTERPOLATION_UNITS
        if not low <= index <= high:
            raise SdoAbort(VALUE_RANGE)
        self._interpolate(index=index)

    def _interpolate(self, value: int | None = None, index: int | None = None) -> None:
        """Apply 60C2h: value * 10^index seconds from one target velocity to the next; None: as it is stored."""
        value = self.store.number(0x60C2, 1) if value is None else value
        index = self.store.number(0x60C2, 2) if index is None else index
        self._targets_come_every(value / 10**-index)

    def _targets_come_every(self, period_s: float) -> None:
        if period_s != self._interpolation_s:
            self._interpolation_s = period_s
            self._source.interpolate(self._number, period_s)

    def _take_over(self) -> None:
        """Give the command to the master for good, of all drives: the demo motion needs both of a pair."""
        if not self.commanded:
            self._on_master()

    def hand_over(self) -> None:
        """End the built-in motion of this drive."""
        if not self.commanded:
            self.commanded = True
            self._interpolate()
            self.machine.release()
            self._mode = 0

    def run_by_itself(
        self, mode: int, target: float, period_s: float = DEFAULT_INTERPOLATION_S
    ) -> list[bytes]:
        """Enable operation for built-in motion or play-back, with a target in the units of `Source.command`.

        period_s: until the next target, in place of 60C2h.
        """
        machine = self.machine
        if self.commanded or machine.state in (FAULT, FAULT_REACTION):
            return []
        self._mode = mode
        self._own_target = target
        self._targets_come_every(period_s)
        if machine.state == OPERATION_ENABLED:
            self._send_command()
            return []
        machine.enable_by_itself()
        self._send_command()
        return self.event()

    def after_command(self) -> list[bytes]:
        """Return the EMCY of a fault reset, and the statusword as an event-driven TPDO."""
        self._send_command()
        frames = self._messages + self.event()
        self._messages = []
        return frames

    def _send_command(self) -> None:
        """Command the source if the power stage's mode or target has changed."""
        command = self.source_command()
        if command != self._sent:
            if command[0] != OFF:
                if self._ran and self._sent[0] == OFF:
                    self._source.resume()
                self._ran = True
            self._sent = command
            self._source.command(self._number, *command)

    def source_command(self) -> tuple[int, float]:
        """Return mode and target of this drive's power stage, as `Source.command` takes them."""
        state = self.machine.state
        if state in (QUICK_STOP, FAULT_REACTION):
            return VELOCITY, 0.0
        if state != OPERATION_ENABLED:
            return OFF, 0.0
        if not self.commanded:
            return self._mode, self._own_target
        halted = bool(self.store.number(0x6040) & HALT)
        if self._mode == VELOCITY:
            return VELOCITY, 0.0 if halted else self.store.number(0x60FF) / self._motor_units
        if self._mode == CURRENT and not halted:
            return CURRENT, self.store.number(0x6071) * self._ratings.rated_current_a / 1000.0
        return CURRENT, 0.0

    # Once per SYNC ------------------------------------------------------------------------------------------

    def watch(self) -> list[bytes]:
        """Check for overcurrent and the end of a quick stop or fault reaction, after the source has advanced."""
        current = self._signals.current_a
        trip = self._ratings.trip_current_a
        machine = self.machine
        if machine.powered and not -trip <= current <= trip:
            machine.fault()
            machine.stopped()  # no ramp: the power stage is off at once
            self._error_code = OVERCURRENT
            self._send_command()
            return self.raise_error(OVERCURRENT, CURRENT_ERROR) + self.event()
        stopping = machine.state in (QUICK_STOP, FAULT_REACTION)
        if stopping and abs(self._signals.motor_velocity_rad_s) < self._still_rad_s:
            machine.stopped()
            self._send_command()
            return self.event()
        return []

    def on_heartbeat_lost(self) -> list[bytes]:
        """Stop a commanded drive with a fault until reset; release one that runs by itself."""
        if self.commanded:
            self.machine.fault()
            self._error_code = HEARTBEAT_LOST
        else:
            self.machine.release()
            self._mode = 0
        self._send_command()
        return self.event()

    def on_reset(self) -> None:
        """Return to the power-on state: power stage off, no mode, no fault."""
        self.machine.release()
        self._ran = False
        self._mode = 0
        self._error_code = 0
        self._interpolate()
        self._send_command()


def _ratio(gear_ratio: float) -> tuple[int, int]:
    """Return numerator and denominator of 6091h."""
    ratio = Fraction(gear_ratio).limit_denominator(10_000)
    return ratio.numerator, ratio.denominator


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
            self.handlers[0x6125, number] = partial(self._autozero, channel)
            self.handlers[0x6132, number] = partial(self._decimals, channel)
        self.connect()

    def on_reset(self) -> None:
        """Return to the power-on state: zero and decimals as delivered."""
        for number, channel in enumerate(self._channels, 1):
            channel.zero_nm = 0.0
            channel.set_decimals(self.store.number(0x6132, number))

    @staticmethod
    def _autozero(channel: Channel, value: int) -> None:
        if value != AUTOZERO:
            raise SdoAbort(VALUE_RANGE)
        channel.autozero()

    @staticmethod
    def _decimals(channel: Channel, value: int) -> None:
        if value > MAX_DECIMALS:
            raise SdoAbort(VALUE_RANGE)
        channel.set_decimals(value)
