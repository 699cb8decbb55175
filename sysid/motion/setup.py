"""Make all drives and the sensor ready for a motion, and put them back after it, by SDO.

jtqd has booted the nodes: TPDOs, heartbeat and the watch over jtqd (1016h:1) are there. Here come mode of operation,
interpolation time, temperature (TPDO3) and the watch over the commander (1016h:2). What is written is read back. Every
failure is a BootError: one line with node, object, expected and found.

    quick_stop, switch_off, reset_fault, set_up, release    one drive, over any `SdoAccess`: no bus, no clock
    sensor_units                                            the sensor
    BenchSetup                                              all of them, over a frame socket of its own
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
from jtqd.drivers.boot_error import BootError, mismatch
from jtqd.drivers.boot_procedure import BusSettings, NodeBoot
from jtqd.drivers.cia402 import state_of
from jtqd.drivers.devices import (
    COMMANDER_NODE,
    JTQD_NODE,
    SYNC_COB_ID,
    DriveObjects,
    DriveProfile,
    DriveScaling,
    SensorProfile,
    SensorScaling,
    drive_rpdo1,
    drive_rpdo2,
    drive_tpdo3,
)
from jtqd.drivers.filters import exact
from jtqd.drivers.frame import FRAME, FRAME_SIZE
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.layout import EVERY_SYNC, LayoutError, chosen, pdo_of_words
from jtqd.drivers.pdo import CAN_ID, INVALID, PdoError, PdoMap, split_word
from jtqd.drivers.sdo import RESPONSE_ID, Key
from jtqd.drivers.sdo_client import NodeObjects, SdoAccess, SdoClient
from jtqd.sysid.motion.cia402 import (
    CST,
    CSV,
    DISABLE_VOLTAGE,
    FAULT_RESET,
    FAULTED,
    POWERED,
    QUICK_STOP_WORD,
    describe,
)
from jtqd.sysid.motion.setpoints import Limits, MotionError, Setpoints, Timing
from jtqd.sysid.motion.turns import turns

INTERPOLATION_MS: Final = 2
"""60C2h where two drives at 1 kHz take turns: each gets every second set-point."""
_POLL_S, _POLLS = 0.005, 200
_CONTROLWORD, _STATUSWORD, _MODE_DISPLAY = (0x6040, 0), (0x6041, 0), (0x6061, 0)
_TARGET_VELOCITY, _TARGET_TORQUE = (0x60FF, 0), (0x6071, 0)
_COMMANDER_WATCH = (0x1016, 2)

Sleep = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """What the commander must know of a drive: identifiers and factors to SI, as read from it.

    Attributes:
        node: node number.
        mode: 9 (csv) or 10 (cst).
        gear_ratio: 6091h.
        scaling: factors of 6064h, 606Ch, 60E4h:1 and 6078h.
        heartbeat_ms: 1017h.
        temperature: True when TPDO3 (380h+n) brings the temperature in 0.1 °C.
        objects: which of its objects hold the quantities. tpdos: those that carry them, as they are mapped in it.
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
        """Return 6071h of a motor current.

        6071h is in 1/1000 of rated torque (6076h). The drive's own torque constant is 6076h / 6075h, so the torque of the
        current i is i * 6076h / 6075h, and 6071h becomes 1000 i / 6075h: the rated torque cancels.
        """
        return round(current_a / self.scaling.ampere_per_unit)


@dataclass(frozen=True, slots=True)
class SensorUnits:
    """Node of the torque sensor, Nm per unit of each channel in use, and its heartbeat (1017h)."""

    node: int
    nm_per_unit: tuple[float, ...]
    heartbeat_ms: int


def quick_stop(access: SdoAccess, node: int) -> None:
    """Let the drive brake by itself if it is powered; does not wait. Raises BootError."""
    drive = NodeObjects(access, node)
    if not _off(drive.number(_STATUSWORD, 2)):
        drive.write(_CONTROLWORD, QUICK_STOP_WORD, 2)


def switch_off(access: SdoAccess, node: int, sleep: Sleep) -> None:
    """Bring the drive to a stop if it is powered, and take the power off; wait for its statusword.

    Raises BootError when the drive is still powered a second later.
    """
    drive = NodeObjects(access, node)
    if not _off(drive.number(_STATUSWORD, 2)):
        quick_stop(access, node)
        _wait(drive, _STATUSWORD, 2, _off, sleep)  # with the option codes 5 to 8 (605Ah) it stays there
    drive.write(_CONTROLWORD, DISABLE_VOLTAGE, 2)
    word = _wait(drive, _STATUSWORD, 2, _off, sleep)
    if not _off(word):
        raise BootError(node, "6041h:0", detail=f"6041h:0: expected disabled, found {describe(word)}")


def reset_fault(access: SdoAccess, node: int, sleep: Sleep) -> str | None:
    """Reset a fault by a rising edge of bit 7 (transition 15); return which it was (603Fh), None when there was none.

    Raises BootError when the fault stays.
    """
    drive = NodeObjects(access, node)
    word = drive.number(_STATUSWORD, 2)
    if state_of(word) not in FAULTED:
        return None
    code = drive.optional_number((0x603F, 0), 2)
    fault = "fault" if code is None else f"fault {code:04X}h"
    for command in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
        drive.write(_CONTROLWORD, command, 2)
    word = _wait(drive, _STATUSWORD, 2, lambda word: state_of(word) not in FAULTED, sleep)
    if state_of(word) in FAULTED:
        raise BootError(node, "6041h:0", detail=f"{fault} cannot be reset: {describe(word)}")
    return fault


def set_up(
    access: SdoAccess,
    profile: DriveProfile,
    mode: int,
    timeout_ms: int,
    sleep: Sleep,
    *,
    temperature: bool,
    interpolation_ms: int = INTERPOLATION_MS,
) -> DriveUnits:
    """Set mode, targets of zero, 60C2h [ms], TPDO3 if `temperature` is wanted, and last the watch over the commander.

    The drive must be off (`switch_off`, `reset_fault`). Raises BootError.
    """
    node = profile.node_id
    drive = NodeObjects(access, node)
    boot = NodeBoot(access, profile, BusSettings(master_node=JTQD_NODE))
    boot.check_device_type()
    boot.check_identity()
    scaling, gear_ratio = boot.read_scaling()
    assert isinstance(scaling, DriveScaling)
    assert gear_ratio is not None
    if drive.number((0x6076, 0), 4) < 1:
        raise mismatch(node, (0x6076, 0), "motor rated torque in mNm", expected="1..", found="0")
    heartbeat_ms = _heartbeat(drive)
    for communication, pdo in ((0x1400, drive_rpdo1(node)), (0x1401, drive_rpdo2(node))):
        _require_rpdo(drive, communication, pdo)
    tpdos = _tpdos(drive, profile)
    _zero_targets(drive)
    drive.write((0x6060, 0), mode, 1)
    found = _wait(drive, _MODE_DISPLAY, 1, lambda display: display == mode, sleep)
    if found != mode:
        raise mismatch(node, _MODE_DISPLAY, "mode of operation display", expected=str(mode), found=str(found))
    drive.put((0x60C2, 1), interpolation_ms, 1, "interpolation time period value")
    drive.put((0x60C2, 2), -3, 1, "interpolation time index")  # ms
    if temperature:
        _switch_on_temperature(drive)
    drive.put(_COMMANDER_WATCH, COMMANDER_NODE << 16 | timeout_ms, 4, "consumer heartbeat time")
    return DriveUnits(node, mode, gear_ratio, scaling, heartbeat_ms, temperature, profile.objects, tpdos)


def sensor_units(access: SdoAccess, profile: SensorProfile) -> SensorUnits:
    """Read the sensor's units and heartbeat. Raises BootError."""
    boot = NodeBoot(access, profile, BusSettings(master_node=JTQD_NODE))
    boot.check_device_type()
    boot.check_identity()
    scaling, _ = boot.read_scaling()
    assert isinstance(scaling, SensorScaling)
    factors = tuple(scaling.nm_per_unit[channel] for channel in profile.channels)
    return SensorUnits(profile.node_id, factors, _heartbeat(NodeObjects(access, profile.node_id)))


def release(access: SdoAccess, node: int, sleep: Sleep) -> None:
    """Switch the drive off after the motion, set its targets to zero, and end its watch over the commander.

    Raises BootError: it did not answer, or is still powered.
    """
    switch_off(access, node, sleep)
    drive = NodeObjects(access, node)
    drive.put(_COMMANDER_WATCH, 0, 4, "consumer heartbeat time")
    _zero_targets(drive)


def _zero_targets(drive: NodeObjects) -> None:
    drive.put(_TARGET_VELOCITY, 0, 4, "target velocity")
    drive.put(_TARGET_TORQUE, 0, 2, "target torque")


def _wait(drive: NodeObjects, key: Key, size: int, wanted: Callable[[int], bool], sleep: Sleep) -> int:
    """Read `key` until it is as wanted, for a second at most; return its value then."""
    found = drive.number(key, size)
    for _ in range(_POLLS):
        if wanted(found):
            break
        sleep(_POLL_S)
        found = drive.number(key, size)
    return found


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
    """Return the TPDOs that carry the drive's quantities, as they are mapped now, by jtqd or for good. Raises BootError."""
    maps = []
    for number in range(1, 5):
        communication = 0x1800 + number - 1
        cob_id = drive.optional_number((communication, 1), 4)
        if cob_id is None or cob_id & INVALID:
            continue
        count = drive.number((communication + 0x200, 0), 1)
        words = [drive.number((communication + 0x200, entry), 4) for entry in range(1, min(count, 8) + 1)]
        kind = drive.number((communication, 2), 1)
        with suppress(PdoError):  # whatever else it sends
            maps.append(pdo_of_words(drive.node, number, cob_id & CAN_ID, words, kind, profile.objects))
    try:
        used = chosen(profile.objects, maps)
    except LayoutError as error:
        raise BootError(drive.node, "1A00h", detail=f"{error}; start jtqd, which configures it") from None
    for pdo in used:
        if pdo.transmission_type != EVERY_SYNC:
            key, found = (0x1800 + pdo.number - 1, 2), str(pdo.transmission_type)
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
        self,
        bus: str,
        drives: Sequence[DriveProfile],
        sensor: SensorProfile | None,
        timing: Timing,
    ) -> None:
        nodes = [profile.node_id for profile in (*drives, sensor) if profile is not None]
        self._socket = open_frame_socket(
            bus, [exact(SYNC_COB_ID), exact(nmt.HEARTBEAT_BASE + COMMANDER_NODE)]
        )
        self._drives, self._sensor, self._timing = tuple(drives), sensor, timing
        self._beating = False
        self._access = {node: SdoClient(self._socket, node) for node in nodes}

    def prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, ...], SensorUnits | None]:
        """Bring all drives to: off, free of faults, modes set, targets zero, watching our heartbeat; return all units.

        Raises MotionError; what was set is put back then. A second commander is noticed before anything is touched.
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
        """Require jtqd's SYNC, and no other commander: for two periods of our own heartbeat nobody else sends it."""
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
        socket.set_filters([exact(RESPONSE_ID + node) for node in self._access])

    def _prepare(
        self, setpoints: Setpoints, limits: Limits
    ) -> tuple[tuple[DriveUnits, ...], SensorUnits | None]:
        access = self._access
        for profile in self._drives:
            quick_stop(access[profile.node_id], profile.node_id)
        for profile in self._drives:
            switch_off(access[profile.node_id], profile.node_id, time.sleep)
            fault = reset_fault(access[profile.node_id], profile.node_id, time.sleep)
            if fault is not None:
                logging.getLogger(__name__).warning("node %d: %s was reset", profile.node_id, fault)
        round_cycles = turns(setpoints.joints, len(self._drives))[1]
        units = tuple(
            set_up(
                access[profile.node_id],
                profile,
                CST if joint == setpoints.current_joint else CSV,
                round(self._timing.drive_timeout_s * 1e3),
                time.sleep,
                temperature=math.isfinite(limits.temperature_c),
                interpolation_ms=round(round_cycles * self._timing.period_s * 1e3),
            )
            for joint, profile in enumerate(self._drives, 1)
        )
        sensor = self._sensor
        found = None if sensor is None else sensor_units(access[sensor.node_id], sensor)
        return units, found

    def release(self, *, beating: bool) -> str:
        """Release all drives for certain; return "", or what could not be done, in one line.

        `beating`: our heartbeat has been heard, so it goes on until nobody watches it any more.
        """
        self._beating = beating
        problems = []
        for step in (self._quick_stop, self._release):
            for profile in self._drives:
                try:
                    self._beat()
                    step(profile.node_id)
                except (BootError, BusError) as error:
                    problems.append(str(error))
        return "; ".join(dict.fromkeys(problems))

    def _quick_stop(self, node: int) -> None:
        quick_stop(self._access[node], node)

    def _release(self, node: int) -> None:
        release(self._access[node], node, self._sleep)

    def _sleep(self, duration_s: float) -> None:
        self._beat()
        time.sleep(duration_s)

    def _beat(self) -> None:
        if self._beating:
            self._socket.send(_HEARTBEAT)

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()
