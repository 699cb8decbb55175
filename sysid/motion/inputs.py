"""Measured values of all joints with their age, from frames and stamps, and their supervision. Pure.

    Inputs         decodes TPDOs, heartbeats, EMCY and SDO confirmations
    Supervision    conditions of a motion: nodes alive, inputs fresh, drives enabled, sensor valid

All times are CLOCK_MONOTONIC in ns and come as arguments. A frame of another length than its PDO is ignored, so that the PDO
becomes stale.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from jtqd.drivers.drive import NOT_MEASURED, TEMPERATURE_C_PER_UNIT, State, drive_tpdo3, places, state_of
from jtqd.drivers.emcy import NO_ERROR, Emergency, parse
from jtqd.drivers.nmt import BOOT_UP, HEARTBEAT_BASE, OPERATIONAL, STATES
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.drivers.sdo import RESPONSE_ID
from jtqd.drivers.sensor import sensor_tpdo1, sensor_tpdo2
from jtqd.sysid.motion.drives import FAULTED, POWERED, DriveUnits, SensorUnits, describe
from jtqd.sysid.motion.setpoints import JointSample, Sample, Timing, Violation

_SENSOR: Final = (sensor_tpdo1(3).layout, sensor_tpdo2(3).layout)
_TEMPERATURE: Final = drive_tpdo3(1).layout
_NEVER_NS: Final = -(1 << 62)
_NO_STATUSWORD: Final = 0x7FFF  # decodes to no state

Handler = Callable[[bytes, int], None]
"""Takes the data of a frame and its stamp."""


class NodeInput:
    """Heartbeat and EMCY of one node. `name` is "joint 1", "joint 2", ... or "sensor"; `emergency` is the EMCY in force."""

    def __init__(self, name: str, node: int, heartbeat_ms: int) -> None:
        self.name, self.node = name, node
        self.heartbeat_ns = heartbeat_ms * 1_000_000
        self.beat_ns = _NEVER_NS
        self.nmt_state = -1
        self.emergency: Emergency | None = None

    def on_heartbeat(self, data: bytes, t_ns: int) -> None:
        """Take 700h+n: NMT state; 0 is the boot-up message."""
        if len(data) == 1:
            self.nmt_state = data[0] & 0x7F
            self.beat_ns = t_ns

    def on_emergency(self, data: bytes, t_ns: int) -> None:
        """Take 080h+n: an error code, or 0000h when all errors are over."""
        if len(data) == 8:
            emergency = parse(data)
            self.emergency = None if emergency.code == NO_ERROR else emergency


class DriveInput(NodeInput):
    """Values of one drive in SI units, joint side.

    cycles: SYNCs seen when each of `units.tpdos` came last; sdo_confirmed: it has confirmed a download of its controlword.
    """

    def __init__(self, number: int, units: DriveUnits, inputs: Inputs) -> None:
        super().__init__(f"joint {number}", units.node, units.heartbeat_ms)
        self.units = units
        self.statusword = _NO_STATUSWORD
        self.current_a = self.velocity_rad_s = self.travel_rad = 0.0
        self.temperature_c = math.nan
        self.temperature_ns = _NEVER_NS
        self.cycles = [0] * len(units.tpdos)
        self.sdo_confirmed = False
        self._inputs = inputs
        scaling = units.scaling
        self._velocity = scaling.motor_rad_s_per_unit / units.gear_ratio
        self._ampere = scaling.ampere_per_unit
        self._rad = {
            "motor": scaling.motor_rad_per_count / units.gear_ratio,
            "link": scaling.link_rad_per_count,
        }
        self._last: dict[str, int] = {}  # counts of the encoders
        self._began: dict[str, int] = {}  # the same at `begin_travel`
        self._counts = dict.fromkeys(self._rad, 0)  # since `begin_travel`
        taken: dict[str, Callable[[int], None]] = {
            "motor_position": partial(self._on_encoder, "motor"),
            "link_position": partial(self._on_encoder, "link"),
            "motor_velocity": self._on_velocity,
            "current": self._on_current,
            "statusword": self._on_statusword,
        }
        where = places(units.objects, units.tpdos)
        self._takers = [
            [(place.entry, taken[name]) for name, place in where.items() if place.pdo == at]
            for at in range(len(units.tpdos))
        ]
        self._moving_pdos = tuple({where[name].pdo for name in ("motor_velocity", "statusword")})

    def begin_travel(self) -> None:
        """Count travel from here."""
        self._counts = dict.fromkeys(self._rad, 0)
        self._began = dict(self._last)
        self.travel_rad = 0.0

    @property
    def position_rad(self) -> float:
        """Position by the link's encoder, else the motor's, from its zero; a roll-over within the motion does not show."""
        which = "link" if "link" in self._last else "motor"
        return (self._began.get(which, 0) + self._counts[which]) * self._rad[which]

    @property
    def handlers(self) -> dict[int, Handler]:
        """Takers of its TPDOs, by COB-ID."""
        return {pdo.cob_id: partial(self._on_tpdo, at) for at, pdo in enumerate(self.units.tpdos)}

    @property
    def moved_cycle(self) -> int:
        """SYNCs seen when velocity and statusword came last."""
        return min(self.cycles[at] for at in self._moving_pdos)

    def _on_tpdo(self, at: int, data: bytes, t_ns: int) -> None:
        layout = self.units.tpdos[at].layout
        if len(data) == layout.size:
            values = layout.unpack(data)
            for entry, take in self._takers[at]:
                take(values[entry])
            self.cycles[at] = self._inputs.cycle

    def _on_encoder(self, which: str, counts: int) -> None:
        """Count modulo 2^32, as the counters roll over; the larger travel of both encoders counts."""
        self._counts[which] += _difference(counts - self._last.get(which, counts))
        self._last[which] = counts
        one, other = (self._counts[each] * rad for each, rad in self._rad.items())
        self.travel_rad = one if abs(one) > abs(other) else other

    def _on_velocity(self, units: int) -> None:
        self.velocity_rad_s = units * self._velocity

    def _on_current(self, units: int) -> None:
        self.current_a = units * self._ampere

    def _on_statusword(self, word: int) -> None:
        self.statusword = word

    def on_temperature(self, data: bytes, t_ns: int) -> None:
        """Take TPDO3, 0.1 °C, 8000h: not measured; more may follow behind it."""
        if len(data) >= _TEMPERATURE.size:
            units = _TEMPERATURE.unpack_from(data)[0]
            if units != NOT_MEASURED:
                self.temperature_c = units * TEMPERATURE_C_PER_UNIT
                self.temperature_ns = t_ns

    def on_sdo(self, data: bytes, t_ns: int) -> None:
        """Take 580h+n: the answer to a download of 6040h."""
        if data[:4] == b"\x60\x40\x60\x00":
            self.sdo_confirmed = True

    def sample(self) -> JointSample:
        """Return the newest values."""
        return JointSample(
            self.current_a, self.velocity_rad_s, self.travel_rad, self.temperature_c, self.position_rad
        )


class ChannelInput:
    """One channel of the torque sensor."""

    def __init__(self, channel: int, nm_per_unit: float, inputs: Inputs) -> None:
        self.channel = channel
        self.torque_nm = 0.0
        self.status = 0
        self.cycle = 0
        self._layout, self._nm, self._inputs = _SENSOR[channel - 1], nm_per_unit, inputs

    def on_torque(self, data: bytes, t_ns: int) -> None:
        """Take TPDO1 or TPDO2 of the sensor."""
        if len(data) == self._layout.size:
            units, self.status = self._layout.unpack(data)
            self.torque_nm = units * self._nm
            self.cycle = self._inputs.cycle


class Inputs:
    """All frames that the commander receives but SYNC.

    cycle: number of SYNCs so far, kept by the commander; foreign: another node has sent our heartbeat; handlers: by COB-ID.
    """

    def __init__(self, drives: Sequence[DriveUnits], sensor: SensorUnits | None, own_node: int) -> None:
        self.cycle = 0
        self.foreign = False
        self.drives = tuple(DriveInput(number, units, self) for number, units in enumerate(drives, 1))
        self.sensor = None if sensor is None else NodeInput("sensor", sensor.node, sensor.heartbeat_ms)
        factors = () if sensor is None else sensor.nm_per_unit
        self.channels = tuple(ChannelInput(n, nm, self) for n, nm in enumerate(factors, 1))
        self.nodes: tuple[NodeInput, ...] = (
            self.drives if self.sensor is None else (*self.drives, self.sensor)
        )
        self.handlers = self._handlers(own_node)

    def _handlers(self, own_node: int) -> dict[int, Handler]:
        handlers: dict[int, Handler] = {HEARTBEAT_BASE + own_node: self._on_own_node}
        for node in self.nodes:
            handlers[HEARTBEAT_BASE + node.node] = node.on_heartbeat
            handlers[0x080 + node.node] = node.on_emergency
        for drive in self.drives:
            handlers |= drive.handlers
            handlers[RESPONSE_ID + drive.node] = drive.on_sdo
            if drive.units.temperature:
                handlers[drive_tpdo3(drive.node).cob_id] = drive.on_temperature
        if self.sensor is not None:
            for channel in self.channels:
                handlers[0x080 + 0x100 * channel.channel + self.sensor.node] = channel.on_torque
        return handlers

    @property
    def identifiers(self) -> tuple[int, ...]:
        """COB-IDs to be received: SYNC, and those with a handler."""
        return (SYNC_COB_ID, *self.handlers)

    def sample(self) -> Sample:
        """Return the newest values of all joints and channels."""
        return Sample(
            tuple([drive.sample() for drive in self.drives]),
            tuple([channel.torque_nm for channel in self.channels]),
        )

    def _on_own_node(self, data: bytes, t_ns: int) -> None:
        self.foreign = True


def _difference(counts: int) -> int:
    """Return the difference of two counters of 32 bits, the shorter way round."""
    return (counts + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000


STILL_RAD_S: Final = 0.02
"""Joint side: below this a joint stands."""
_NMT_NAMES: Final = STATES | {BOOT_UP: "restarted (boot-up message)"}
_MS: Final = 1e-6


class Supervision:
    """Checks of `inputs`, once per cycle, without a state. A hard violation: each drive brakes by itself."""

    def __init__(self, inputs: Inputs, timing: Timing) -> None:
        self._inputs = inputs
        self._stale = timing.stale_cycles
        self._beats = timing.heartbeats_missing
        self._temperature_ns = round(timing.temperature_s * 1e9)

    def check(self, now_ns: int, *, enabled: bool) -> Violation | None:
        """Return the first violation; `enabled`: all drives must be in operation enabled, else only without fault."""
        inputs = self._inputs
        oldest = inputs.cycle - self._stale
        for drive in inputs.drives:
            found = (
                self._node(drive, now_ns, hard=True)
                or _state(drive, enabled)
                or self._fresh(drive, oldest)
                or self._temperature(drive, now_ns)
            )
            if found is not None:
                return found
        if inputs.sensor is not None:
            found = self._node(inputs.sensor, now_ns, hard=False)
            if found is not None:
                return found
        for channel in inputs.channels:
            if channel.status:
                return Violation(
                    f"sensor: status of channel {channel.channel} is {channel.status:02X}h, expected 00h",
                    False,
                )
            if channel.cycle < oldest:
                missing = inputs.cycle - channel.cycle
                text = (
                    f"torque of channel {channel.channel} missing for {missing} cycles, limit {self._stale}"
                )
                return Violation(f"sensor: {text}", False)
        if inputs.foreign:
            return Violation(
                "another commander is on the bus (a heartbeat with this node-ID was received)", True
            )
        return None

    def missing(self, now_ns: int) -> str | None:
        """Return the first fault before the start; None when all inputs are there and in order."""
        inputs = self._inputs
        for node in inputs.nodes:
            if node.nmt_state < 0:
                return f"{node.name}: no heartbeat {HEARTBEAT_BASE + node.node:03X}h"
        for drive in inputs.drives:
            if not all(drive.cycles):
                names = " or ".join(f"TPDO{pdo.number}" for pdo in drive.units.tpdos)
                return f"{drive.name}: no {names}; start jtqd, which configures them"
            if drive.units.temperature and drive.temperature_c != drive.temperature_c:
                return f"{drive.name}: no temperature ({0x380 + drive.node:03X}h), which is required by its limit"
        for channel in inputs.channels:
            if not channel.cycle:
                return f"sensor: no torque of channel {channel.channel}"
        found = self.check(now_ns, enabled=False)
        return None if found is None else found.reason

    def moving(self) -> str | None:
        """Return the first joint that does not stand, or whose velocity is stale; None when all stand."""
        oldest = self._inputs.cycle - self._stale
        for drive in self._inputs.drives:
            if not -STILL_RAD_S <= drive.velocity_rad_s <= STILL_RAD_S or drive.moved_cycle < oldest:
                velocity = f"velocity {drive.velocity_rad_s:.3f} rad/s before the start"
                return f"{drive.name}: {velocity}, limit {STILL_RAD_S:g} rad/s"
        return None

    def obeyed(self, turn: int) -> bool:
        """Return whether drive `turn` follows no set-point any more, by a fresh statusword or a confirmed SDO."""
        drive = self._inputs.drives[turn]
        fresh = drive.moved_cycle >= self._inputs.cycle - self._stale
        return drive.sdo_confirmed or (fresh and state_of(drive.statusword) is not State.OPERATION_ENABLED)

    def all_off(self) -> bool:
        """Return whether fresh statuswords of all drives show that their motors are not driven."""
        oldest = self._inputs.cycle - self._stale
        return all(
            state_of(drive.statusword) not in POWERED and drive.moved_cycle >= oldest
            for drive in self._inputs.drives
        )

    def _node(self, node: NodeInput, now_ns: int, *, hard: bool) -> Violation | None:
        if node.emergency is not None:
            code, register = node.emergency.code, node.emergency.register
            return Violation(f"{node.name}: EMCY {code:04X}h (error register {register:02X}h)", hard)
        if node.nmt_state != OPERATIONAL:
            name = _NMT_NAMES.get(node.nmt_state, f"state {node.nmt_state}")
            return Violation(f"{node.name}: NMT {name}, expected operational", hard)
        age_ns = now_ns - node.beat_ns
        if age_ns > node.heartbeat_ns * self._beats:
            limit = node.heartbeat_ns * self._beats * _MS
            return Violation(
                f"{node.name}: no heartbeat for {age_ns * _MS:.0f} ms, limit {limit:.0f} ms", hard
            )
        return None

    def _fresh(self, drive: DriveInput, oldest: int) -> Violation | None:
        if min(drive.cycles) >= oldest:
            return None
        late = [at for at, cycle in enumerate(drive.cycles) if cycle < oldest]
        pdo, missing = drive.units.tpdos[late[-1]], self._inputs.cycle - drive.cycles[late[-1]]
        text = f"TPDO{pdo.number} ({pdo.cob_id:03X}h) missing for {missing} cycles, limit {self._stale}"
        return Violation(f"{drive.name}: {text}", max(drive.cycles) < oldest)

    def _temperature(self, drive: DriveInput, now_ns: int) -> Violation | None:
        age_ns = now_ns - drive.temperature_ns
        if not drive.units.temperature or age_ns <= self._temperature_ns:
            return None
        limit = self._temperature_ns * 1e-9
        return Violation(f"{drive.name}: no temperature for {age_ns * 1e-9:.1f} s, limit {limit:g} s", False)


def _state(drive: DriveInput, enabled: bool) -> Violation | None:
    state = state_of(drive.statusword)
    if enabled and state is not State.OPERATION_ENABLED:
        return Violation(f"{drive.name}: {describe(drive.statusword)}, expected operation enabled", True)
    if state in FAULTED:
        return Violation(f"{drive.name}: {describe(drive.statusword)}", True)
    return None
