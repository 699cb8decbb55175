"""Drives from the commanding side: CiA 402 controlwords, set-up and release by SDO, and the RPDOs of a motion.

jtqd has booted the nodes: TPDOs, heartbeat and the watch over jtqd (1016h:1) are configured. The set-up adds mode of
operation, interpolation time, temperature (TPDO3) and the watch over the commander (1016h:2), and reads back each object.
Every failure is a BootError: one line with node, object, expected and found.

    Drive, sensor_units    one drive, and the sensor, over any `SdoAccess`: no bus, no clock
    BenchSetup             all of them, over a frame socket of its own
    Commands, Heartbeat    the frames that the commander sends

Controlwords: CiA 402-2, table "command coding". A drive is led one state at a time; each step waits until the statusword
(`jtqd.drivers.drive`) has confirmed the last one.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from jtqd.drivers import nmt
from jtqd.drivers.boot_node import BootError, BusSettings, NodeBoot, NodeObjects, mismatch
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.drive import (
    DriveObjects,
    DriveProfile,
    DriveScaling,
    LayoutError,
    State,
    drive_rpdo1,
    drive_rpdo2,
    drive_tpdo3,
    map_of,
    select_tpdos,
    state_of,
)
from jtqd.drivers.frame import FRAME, FRAME_SIZE, pack
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.own_objects import COMMANDER_NODE, JTQD_NODE
from jtqd.drivers.pdo import (
    CAN_ID,
    EVERY_SYNC,
    INVALID,
    SYNC_COB_ID,
    PdoError,
    PdoMap,
    read_tpdos,
    split_word,
    tpdo_parameters,
)
from jtqd.drivers.sdo import REQUEST_ID, RESPONSE_ID, Key, SdoAccess, SdoClient, Transfer
from jtqd.drivers.sensor import SensorProfile, SensorScaling
from jtqd.sysid.motion.setpoints import Limits, MotionError, Setpoints, Timing

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


def sending_order(moved: Sequence[int], drives: int) -> tuple[tuple[int, ...], int]:
    """Return the drives (0, 1, ..) in the order of their set-points, and the cycles from one of a moved drive to its next.

    moved: numbers (1, 2, ..) of the joints that are moved; the others are held. After each round of the moved drives comes
    one of those held:

        two of two 0 1          one of one 0          one of three 0 1, 0 2          two of three 0 1 2
    """
    own = tuple(number - 1 for number in moved)
    held = [drive for drive in range(drives) if drive not in own]
    if not held:
        return own, len(own)
    return tuple(turn for drive in held for turn in (*own, drive)), len(own) + 1


INTERPOLATION_MS: Final = 2
"""60C2h where two drives at 1 kHz take turns: each gets every second set-point."""
_POLL_S, _POLLS = 0.005, 200
_CONTROLWORD, _STATUSWORD, _MODE_DISPLAY = (0x6040, 0), (0x6041, 0), (0x6061, 0)
_TARGET_VELOCITY, _TARGET_TORQUE = (0x60FF, 0), (0x6071, 0)
_COMMANDER_WATCH = (0x1016, 2)

Sleep = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """A drive and its factors to SI units, as read from it.

    mode: 9 (csv) or 10 (cst); gear_ratio: 6091h; scaling: of 6064h, 606Ch, 60E4h:1 and 6078h; heartbeat_ms: 1017h;
    temperature: TPDO3 brings it in 0.1 °C; tpdos: those that carry `objects`.
    """

    node: int
    mode: int
    gear_ratio: float
    scaling: DriveScaling
    heartbeat_ms: int
    temperature: bool
    objects: DriveObjects
    tpdos: tuple[PdoMap, ...]

    def velocity_units(self, velocity_rad_s: float) -> int:
        """Return 60FFh of a joint side velocity: it counts as 606Ch does, on the motor side."""
        return round(velocity_rad_s * self.gear_ratio / self.scaling.motor_rad_s_per_unit)

    def current_units(self, current_a: float) -> int:
        """Return 6071h of a motor current, in 1/1000 of rated torque (6076h).

        The drive's own torque constant is 6076h / 6075h, so 6071h becomes 1000 i / 6075h: the rated torque cancels.
        """
        return round(current_a / self.scaling.ampere_per_unit)


@dataclass(frozen=True, slots=True)
class SensorUnits:
    """Node of the torque sensor, Nm per unit of each channel in use, and its heartbeat (1017h)."""

    node: int
    nm_per_unit: tuple[float, ...]
    heartbeat_ms: int


class Drive:
    """One drive by SDO. sleep: waits for seconds. Every method raises BootError."""

    def __init__(self, access: SdoAccess, profile: DriveProfile, sleep: Sleep) -> None:
        self.node = profile.node_id
        self._access, self._profile, self._sleep = access, profile, sleep
        self._objects = NodeObjects(access, profile.node_id)

    def quick_stop(self) -> None:
        """Let the drive brake by itself if it is powered; does not wait."""
        if not _off(self._objects.number(_STATUSWORD, 2)):
            self._objects.write(_CONTROLWORD, QUICK_STOP_WORD, 2)

    def switch_off(self) -> None:
        """Bring the drive to a stop if it is powered, and take the power off; wait for its statusword, a second at most."""
        if not _off(self._objects.number(_STATUSWORD, 2)):
            self.quick_stop()
            self._wait(_STATUSWORD, 2, _off)  # with the option codes 5 to 8 (605Ah) it stays there
        self._objects.write(_CONTROLWORD, DISABLE_VOLTAGE, 2)
        word = self._wait(_STATUSWORD, 2, _off)
        if not _off(word):
            raise BootError(
                self.node, "6041h:0", detail=f"6041h:0: expected disabled, found {describe(word)}"
            )

    def reset_fault(self) -> str | None:
        """Reset a fault by a rising edge of bit 7 (transition 15); return its code (603Fh) in words, or None."""
        word = self._objects.number(_STATUSWORD, 2)
        if state_of(word) not in FAULTED:
            return None
        code = self._objects.optional_number((0x603F, 0), 2)
        fault = "fault" if code is None else f"fault {code:04X}h"
        for command in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
            self._objects.write(_CONTROLWORD, command, 2)
        word = self._wait(_STATUSWORD, 2, lambda word: state_of(word) not in FAULTED)
        if state_of(word) in FAULTED:
            raise BootError(self.node, "6041h:0", detail=f"{fault} cannot be reset: {describe(word)}")
        return fault

    def set_up(
        self, mode: int, timeout_ms: int, *, temperature: bool, interpolation_ms: int = INTERPOLATION_MS
    ) -> DriveUnits:
        """Set mode, targets of zero, 60C2h [ms], TPDO3 if `temperature` is wanted, and last the watch over the commander.

        The drive must be off (`switch_off`, `reset_fault`).
        """
        objects, profile = self._objects, self._profile
        boot = NodeBoot(self._access, profile, BusSettings(master_node=JTQD_NODE))
        boot.check_device_type()
        boot.check_identity()
        scaling, gear_ratio = boot.read_scaling()
        assert isinstance(scaling, DriveScaling)
        assert gear_ratio is not None
        if objects.number((0x6076, 0), 4) < 1:
            raise mismatch(self.node, (0x6076, 0), "motor rated torque in mNm", expected="1..", found="0")
        heartbeat_ms = _heartbeat(objects)
        for communication, pdo in ((0x1400, drive_rpdo1(self.node)), (0x1401, drive_rpdo2(self.node))):
            _require_rpdo(objects, communication, pdo)
        tpdos = _tpdos(objects, profile)
        self._zero_targets()
        objects.write((0x6060, 0), mode, 1)
        found = self._wait(_MODE_DISPLAY, 1, lambda display: display == mode)
        if found != mode:
            what = "mode of operation display"
            raise mismatch(self.node, _MODE_DISPLAY, what, expected=str(mode), found=str(found))
        objects.put((0x60C2, 1), interpolation_ms, 1, "interpolation time period value")
        objects.put((0x60C2, 2), -3, 1, "interpolation time index")  # ms
        if temperature:
            _switch_on_temperature(objects)
        objects.put(_COMMANDER_WATCH, COMMANDER_NODE << 16 | timeout_ms, 4, "consumer heartbeat time")
        return DriveUnits(
            self.node, mode, gear_ratio, scaling, heartbeat_ms, temperature, profile.objects, tpdos
        )

    def release(self) -> None:
        """Switch the drive off after the motion, set its targets to zero, and end its watch over the commander."""
        self.switch_off()
        self._objects.put(_COMMANDER_WATCH, 0, 4, "consumer heartbeat time")
        self._zero_targets()

    def _zero_targets(self) -> None:
        self._objects.put(_TARGET_VELOCITY, 0, 4, "target velocity")
        self._objects.put(_TARGET_TORQUE, 0, 2, "target torque")

    def _wait(self, key: Key, size: int, wanted: Callable[[int], bool]) -> int:
        """Read `key` until it is as wanted, for a second at most; return its value then."""
        found = self._objects.number(key, size)
        for _ in range(_POLLS):
            if wanted(found):
                break
            self._sleep(_POLL_S)
            found = self._objects.number(key, size)
        return found


def sensor_units(access: SdoAccess, profile: SensorProfile) -> SensorUnits:
    """Read the sensor's units and heartbeat. Raises BootError."""
    boot = NodeBoot(access, profile, BusSettings(master_node=JTQD_NODE))
    boot.check_device_type()
    boot.check_identity()
    scaling, _ = boot.read_scaling()
    assert isinstance(scaling, SensorScaling)
    factors = tuple(scaling.nm_per_unit[channel] for channel in profile.channels)
    return SensorUnits(profile.node_id, factors, _heartbeat(NodeObjects(access, profile.node_id)))


def _off(statusword: int) -> bool:
    return state_of(statusword) not in POWERED


def _heartbeat(node: NodeObjects) -> int:
    """Return 1017h; a node without a heartbeat could be lost without notice."""
    period_ms = node.number((0x1017, 0), 2)
    if not period_ms:
        key = (0x1017, 0)
        raise mismatch(node.node, key, "producer heartbeat time in ms", expected="1..", found="0")
    return period_ms


def _require_rpdo(drive: NodeObjects, communication: int, pdo: PdoMap) -> None:
    """Require an RPDO to be mapped as the commander sends it: an operational node does not let it be changed."""
    cob_id = drive.number((communication, 1), 4)
    if cob_id & (INVALID | CAN_ID) != pdo.cob_id:
        key = (communication, 1)
        raise mismatch(
            drive.node, key, "COB-ID of RPDO", expected=f"{pdo.cob_id:X}h", found=f"0x{cob_id:08X}"
        )
    mapping = communication + 0x200
    count = drive.number((mapping, 0), 1)
    words = tuple(drive.number((mapping, entry), 4) for entry in range(1, count + 1))
    if words != pdo.words:
        wanted, found = (" ".join(f"{word:08X}" for word in each) for each in (pdo.words, words))
        raise mismatch(drive.node, (mapping, 1), "mapping of RPDO", expected=wanted, found=found or "nothing")


def _tpdos(drive: NodeObjects, profile: DriveProfile) -> tuple[PdoMap, ...]:
    """Return the TPDOs that carry the drive's quantities, as they are mapped in it. Raises BootError."""
    maps = []
    for tpdo in read_tpdos(lambda key: drive.optional_number(key, 4)):
        with suppress(PdoError):  # other TPDOs
            if tpdo.on:
                maps.append(map_of(drive.node, tpdo, profile.objects))
    try:
        used = select_tpdos(profile.objects, maps)
    except LayoutError as error:
        raise BootError(drive.node, "1A00h", detail=f"{error}; start jtqd, which configures it") from None
    for pdo in used:
        if pdo.transmission_type != EVERY_SYNC:
            key, found = (tpdo_parameters(pdo.number)[0], 2), str(pdo.transmission_type)
            what = "transmission type (a motion needs every value at each SYNC)"
            raise mismatch(drive.node, key, what, expected=str(EVERY_SYNC), found=found)
    return used


def _switch_on_temperature(drive: NodeObjects) -> None:
    """Switch on TPDO3, which must carry a 16-bit number first; jtqd's boot may have switched it off."""
    cob_id, count = drive.optional_number((0x1802, 1), 4), drive.optional_number((0x1A02, 0), 1)
    word = drive.optional_number((0x1A02, 1), 4) if count else None
    if cob_id is None or word is None or split_word(word)[2] != 16:
        detail = (
            "no TPDO3 with a temperature of 16 bits (1A02h:1): the temperature limit cannot be supervised"
        )
        raise BootError(drive.node, "1A02h:1", detail=detail)
    wanted = drive_tpdo3(drive.node).cob_id
    if cob_id & CAN_ID != wanted:
        raise mismatch(
            drive.node, (0x1802, 1), "COB-ID of TPDO3", expected=f"{wanted:X}h", found=f"0x{cob_id:08X}"
        )
    if cob_id & INVALID:
        drive.put((0x1802, 1), cob_id & ~INVALID, 4, "COB-ID of TPDO3")


_HEARTBEAT = nmt.heartbeat(COMMANDER_NODE, nmt.OPERATIONAL)


class BenchSetup:
    """All devices of the bench, over a frame socket. Raises BusError when the bus cannot be opened."""

    def __init__(
        self, bus: str, drives: Sequence[DriveProfile], sensor: SensorProfile | None, timing: Timing
    ) -> None:
        self._socket = open_frame_socket(
            bus, [exact(SYNC_COB_ID), exact(nmt.HEARTBEAT_BASE + COMMANDER_NODE)]
        )
        self._sensor, self._timing = sensor, timing
        self._beating = False
        self._drives = [
            Drive(SdoClient(self._socket, profile.node_id), profile, self._sleep) for profile in drives
        ]

    def prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, ...], SensorUnits | None]:
        """Bring all drives to: off, free of faults, modes set, targets zero, watching our heartbeat; return all units.

        Raises MotionError, with the drives released; a second commander is found before anything is written.
        """
        try:
            self._require_jtqd_alone()
        except BusError as error:
            raise MotionError(str(error)) from None
        try:
            return self._prepare(setpoints, limits)
        except (BootError, BusError) as error:
            self.release(beating=False)
            raise MotionError(str(error)) from None

    def _require_jtqd_alone(self) -> None:
        """Require jtqd's SYNC, and no other commander: two periods of our own heartbeat without another one."""
        socket, frames = self._socket, self._socket.frames
        heard = set()
        end_s = time.monotonic() + 2.0 * self._timing.own_heartbeat_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(left_s)
            while count := socket.receive():
                heard |= {FRAME.unpack_from(frames, FRAME_SIZE * position)[0] for position in range(count)}
        if nmt.HEARTBEAT_BASE + COMMANDER_NODE in heard:
            raise MotionError(f"another commander is on the bus (node {COMMANDER_NODE:02X}h): stop it first")
        if SYNC_COB_ID not in heard:
            raise MotionError(f"no SYNC on {socket.bus}: jtqd must run on this bus")
        nodes = [drive.node for drive in self._drives]
        nodes += [] if self._sensor is None else [self._sensor.node_id]
        socket.set_filters([exact(RESPONSE_ID + node) for node in nodes])

    def _prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, ...], SensorUnits | None]:
        for drive in self._drives:
            drive.quick_stop()
        for drive in self._drives:
            drive.switch_off()
            fault = drive.reset_fault()
            if fault is not None:
                logging.getLogger(__name__).warning("node %d: %s was reset", drive.node, fault)
        round_cycles = sending_order(setpoints.joints, len(self._drives))[1]
        units = tuple(
            drive.set_up(
                CST if joint == setpoints.current_joint else CSV,
                round(self._timing.drive_timeout_s * 1e3),
                temperature=math.isfinite(limits.temperature_c),
                interpolation_ms=round(round_cycles * self._timing.period_s * 1e3),
            )
            for joint, drive in enumerate(self._drives, 1)
        )
        if self._sensor is None:
            return units, None
        return units, sensor_units(SdoClient(self._socket, self._sensor.node_id), self._sensor)

    def release(self, *, beating: bool) -> str:
        """Release all drives; return "", or the failures in one line. beating: the drives watch our heartbeat."""
        self._beating = beating
        problems = []
        for step in (Drive.quick_stop, Drive.release):
            for drive in self._drives:
                try:
                    self._beat()
                    step(drive)
                except (BootError, BusError) as error:
                    problems.append(str(error))
        return "; ".join(dict.fromkeys(problems))

    def _sleep(self, duration_s: float) -> None:
        self._beat()
        time.sleep(duration_s)

    def _beat(self) -> None:
        if self._beating:
            self._socket.send(_HEARTBEAT)

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


_COMMAND, _VELOCITY = drive_rpdo1(1).layout, drive_rpdo2(1).layout


class Commands:
    """RPDOs for drive `turn` (0, 1, ...); set-points are scaled to the drives' units once; a drive that is not moved is
    held.

    order, round_cycles: see `sending_order`. Raises MotionError for set-points that 60FFh (32 bits) or 6071h (16 bits)
    cannot hold, and for a joint without a drive.
    """

    def __init__(self, setpoints: Setpoints, drives: Sequence[DriveUnits]) -> None:
        if setpoints.joints[-1] > len(drives):
            raise MotionError(f"plan: joint {setpoints.joints[-1]} is moved, the bus has {len(drives)}")
        self.order, self.round_cycles = sending_order(setpoints.joints, len(drives))
        self._leader = setpoints.velocity_joint - 1  # the drive in velocity mode
        self._follower = -1 if setpoints.current_joint is None else setpoints.current_joint - 1
        self._lead, self._follow = drives[self._leader], drives[self._follower]
        self._velocities = [self._lead.velocity_units(v) for v in setpoints.velocity_rad_s.tolist()]
        self._currents = [self._follow.current_units(i) for i in setpoints.current_a.tolist()]
        for what, units, largest in (
            (f"velocity of joint {setpoints.velocity_joint}", self._velocities, 0x7FFF_FFFF),
            (f"current of joint {setpoints.current_joint}", self._currents, 0x7FFF),
        ):
            found = max(units, key=abs)
            if abs(found) > largest:
                raise MotionError(f"plan: {what} is {found} in units of the drive, limit {largest}")
        self._nodes = [drive.node for drive in drives]
        self._rpdo1 = [drive_rpdo1(drive.node).cob_id for drive in drives]
        self._rpdo2 = [drive_rpdo2(drive.node).cob_id for drive in drives]

    def control(self, turn: int, word: int) -> bytes:
        """Return RPDO1 with a controlword and no torque."""
        return FRAME.pack(self._rpdo1[turn], _COMMAND.size, _COMMAND.pack(word, 0))

    def quick_stop_by_sdo(self, turn: int) -> bytes:
        """Return the download of 6040h = 2; its answer is not waited for."""
        download = Transfer(0x6040, 0, QUICK_STOP_WORD.to_bytes(2, "little"))
        return pack(REQUEST_ID + self._nodes[turn], download.request)

    def setpoint(self, turn: int, index: int) -> bytes:
        """Return the RPDO of set-point number `index`."""
        return self._target(turn, self._velocities[index], self._currents[index])

    def target(self, turn: int, velocity_rad_s: float, current_a: float) -> bytes:
        """Return the RPDO of any other set-point."""
        velocity, current = self._lead.velocity_units(velocity_rad_s), self._follow.current_units(current_a)
        return self._target(turn, velocity, current)

    def _target(self, turn: int, velocity: int, current: int) -> bytes:
        """Pack RPDO2 to a drive in velocity mode, RPDO1 to one in torque mode."""
        if turn == self._follower:
            return FRAME.pack(self._rpdo1[turn], _COMMAND.size, _COMMAND.pack(ENABLE_OPERATION, current))
        velocity = velocity if turn == self._leader else 0
        return FRAME.pack(self._rpdo2[turn], _VELOCITY.size, _VELOCITY.pack(velocity))


class Heartbeat:
    """Heartbeat of the commander (node 21h) on its own grid, next at `due_ns`; the first is the boot-up message."""

    def __init__(self, period_s: float, now_ns: int) -> None:
        self.due_ns = now_ns
        self._period_ns = round(period_s * 1e9)
        self._state = nmt.BOOT_UP

    def frames(self, now_ns: int) -> list[bytes]:
        """Return the heartbeat if it is due."""
        if now_ns < self.due_ns:
            return []
        self.due_ns += self._period_ns * (1 + (now_ns - self.due_ns) // self._period_ns)
        state, self._state = self._state, nmt.OPERATIONAL
        return [nmt.heartbeat(COMMANDER_NODE, state)]
