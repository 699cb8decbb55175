"""A drive made ready for the motion, and put back after it, by SDO. Written against `SdoAccess`: no bus, no clock.

jtqd has booted the node: TPDOs, heartbeat and the watch over jtqd (1016h:1) are there. Here come mode of operation,
interpolation time, temperature (TPDO3) and the watch over the commander (1016h:2). What is written is read back. Every
failure is a BootError: one line with node, object, expected and found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers.boot_error import BootError, mismatch
from drivers.boot_procedure import BusSettings, NodeBoot, SdoAccess
from drivers.devices import (
    COMMANDER_NODE,
    JTQD_NODE,
    DriveProfile,
    DriveScaling,
    SensorProfile,
    SensorScaling,
    drive_rpdo1,
    drive_rpdo2,
)
from drivers.pdo import PdoMap, split_word
from drivers.pdo_parameters import CAN_ID, INVALID
from sysid.motion.cia402_client import (
    DISABLE_VOLTAGE,
    FAULT_RESET,
    FAULTED,
    POWERED,
    QUICK_STOP_WORD,
    describe,
    state_of,
)
from sysid.motion.node_sdo import Key, NodeSdo

INTERPOLATION_MS: Final = 2
"""60C2h: each drive gets every second set-point."""
TEMPERATURE_TPDO: Final = 0x380
"""COB-ID of TPDO3, plus the node number: joint temperature, I16, 0.1 °C."""
_POLL_S, _POLLS = 0.005, 200
_STATUSWORD: Final = (0x6041, 0)

Sleep = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class DriveUnits:
    """What the commander must know of a drive: identifiers and factors to SI, as the drive itself told them.

    Attributes:
        node: node number; also the number of the joint.
        mode: 9 (csv) or 10 (cst).
        gear_ratio: 6091h.
        scaling: factors of 6064h, 606Ch, 60E4h:1 and 6078h.
        heartbeat_ms: 1017h.
        temperature: True when TPDO3 (380h+n) brings the temperature in 0.1 °C.
    """

    node: int
    mode: int
    gear_ratio: float
    scaling: DriveScaling
    heartbeat_ms: int
    temperature: bool

    def velocity_units(self, velocity_rad_s: float) -> int:
        """60FFh of a joint side velocity: it counts as 606Ch does, on the motor side."""
        return round(velocity_rad_s * self.gear_ratio / self.scaling.motor_rad_s_per_unit)

    def current_units(self, current_a: float) -> int:
        """6071h of a motor current.

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
    drive = NodeSdo(access, node)
    if not _off(drive.number(_STATUSWORD)):
        drive.write((0x6040, 0), QUICK_STOP_WORD, 2)


def switch_off(access: SdoAccess, node: int, sleep: Sleep) -> None:
    """Bring the drive to a stop if it is powered, and take the power off; returns when it says so.

    Raises BootError when the drive is still powered a second later.
    """
    drive = NodeSdo(access, node)
    if not _off(drive.number(_STATUSWORD)):
        quick_stop(access, node)
        _wait(drive, _STATUSWORD, _off, sleep)  # with the option codes 5 to 8 (605Ah) it stays there
    drive.write((0x6040, 0), DISABLE_VOLTAGE, 2)
    word = _wait(drive, _STATUSWORD, _off, sleep)
    if not _off(word):
        raise BootError(node, "6041h:0", detail=f"6041h:0: expected disabled, found {describe(word)}")


def reset_fault(access: SdoAccess, node: int, sleep: Sleep) -> str | None:
    """Reset a fault by a rising edge of bit 7 (transition 15); says which (603Fh), None when there was none.

    Raises BootError when the fault stays.
    """
    drive = NodeSdo(access, node)
    word = drive.number(_STATUSWORD)
    if state_of(word) not in FAULTED:
        return None
    code = drive.optional((0x603F, 0))
    fault = "fault" if code is None else f"fault {code:04X}h"
    for command in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):
        drive.write((0x6040, 0), command, 2)
    word = _wait(drive, _STATUSWORD, lambda word: state_of(word) not in FAULTED, sleep)
    if state_of(word) in FAULTED:
        raise BootError(node, "6041h:0", detail=f"{fault} cannot be reset: {describe(word)}")
    return fault


def set_up(
    access: SdoAccess, profile: DriveProfile, mode: int, timeout_ms: int, sleep: Sleep, *, temperature: bool
) -> DriveUnits:
    """Mode, targets at zero, 60C2h, TPDO3 if `temperature` is wanted, and last the watch over the commander.

    The drive must be off (`switch_off`, `reset_fault`). Raises BootError.
    """
    node = profile.node_id
    drive = NodeSdo(access, node)
    boot = NodeBoot(access, profile, BusSettings(master_node=JTQD_NODE))
    boot.check_device_type()
    boot.check_identity()
    scaling, gear_ratio = boot.read_scaling()
    assert isinstance(scaling, DriveScaling)
    assert gear_ratio is not None
    if drive.number((0x6076, 0)) < 1:
        raise mismatch(node, (0x6076, 0), "motor rated torque in mNm", expected="1..", found="0")
    heartbeat_ms = _heartbeat(drive)
    for communication, pdo in ((0x1400, drive_rpdo1(node)), (0x1401, drive_rpdo2(node))):
        _require_rpdo(drive, communication, pdo)
    drive.put((0x60FF, 0), 0, 4)
    drive.put((0x6071, 0), 0, 2)
    drive.write((0x6060, 0), mode, 1)
    found = _wait(drive, (0x6061, 0), lambda display: display == mode, sleep)
    if found != mode:
        raise mismatch(node, (0x6061, 0), "mode of operation display", expected=str(mode), found=str(found))
    drive.put((0x60C2, 1), INTERPOLATION_MS, 1)
    drive.put((0x60C2, 2), -3, 1, signed=True)
    if temperature:
        _switch_on_temperature(drive)
    drive.put((0x1016, 2), COMMANDER_NODE << 16 | timeout_ms, 4)
    return DriveUnits(node, mode, gear_ratio, scaling, heartbeat_ms, temperature)


def sensor_units(access: SdoAccess, profile: SensorProfile) -> SensorUnits:
    """Read what the sensor says about itself. Raises BootError."""
    boot = NodeBoot(access, profile, BusSettings(master_node=JTQD_NODE))
    boot.check_device_type()
    boot.check_identity()
    scaling, _ = boot.read_scaling()
    assert isinstance(scaling, SensorScaling)
    factors = tuple(scaling.nm_per_unit[channel] for channel in profile.channels)
    return SensorUnits(profile.node_id, factors, _heartbeat(NodeSdo(access, profile.node_id)))


def release(access: SdoAccess, node: int, sleep: Sleep) -> None:
    """After the motion: the drive is off, its targets are zero, and it watches the commander no longer.

    Raises BootError: it did not answer, or is still powered.
    """
    switch_off(access, node, sleep)
    drive = NodeSdo(access, node)
    drive.put((0x1016, 2), 0, 4)
    drive.put((0x60FF, 0), 0, 4)
    drive.put((0x6071, 0), 0, 2)


def _wait(drive: NodeSdo, key: Key, wanted: Callable[[int], bool], sleep: Sleep) -> int:
    """Read `key` until it is as wanted, for a second at most; what it is then."""
    found = drive.number(key)
    for _ in range(_POLLS):
        if wanted(found):
            break
        sleep(_POLL_S)
        found = drive.number(key)
    return found


def _off(statusword: int) -> bool:
    return state_of(statusword) not in POWERED


def _heartbeat(node: NodeSdo) -> int:
    """1017h: the loss of a node must be noticed."""
    period_ms = node.number((0x1017, 0))
    if not period_ms:
        key = (0x1017, 0)
        raise mismatch(node.node, key, "producer heartbeat time in ms", expected="1..", found="0")
    return period_ms


def _require_rpdo(drive: NodeSdo, communication: int, pdo: PdoMap) -> None:
    """An RPDO must be mapped as the commander sends it: its mapping cannot be changed while the node is operational."""
    cob_id = drive.number((communication, 1))
    if cob_id & (INVALID | CAN_ID) != pdo.cob_id:
        key = (communication, 1)
        raise mismatch(
            drive.node, key, "COB-ID of RPDO", expected=f"{pdo.cob_id:X}h", found=f"0x{cob_id:08X}"
        )
    mapping = communication + 0x200
    count = drive.number((mapping, 0))
    words = tuple(drive.number((mapping, entry)) for entry in range(1, count + 1))
    if words != pdo.words:
        wanted, found = (" ".join(f"{word:08X}" for word in each) for each in (pdo.words, words))
        raise mismatch(drive.node, (mapping, 1), "mapping of RPDO", expected=wanted, found=found or "nothing")


def _switch_on_temperature(drive: NodeSdo) -> None:
    """TPDO3 must carry one 16-bit number first; jtqd's boot may have switched it off."""
    cob_id, count = drive.optional((0x1802, 1)), drive.optional((0x1A02, 0))
    word = drive.optional((0x1A02, 1)) if count else None
    if cob_id is None or word is None or split_word(word)[2] != 16:
        detail = "no TPDO3 with a temperature of 16 bits (1A02h:1): the limit of temperature cannot be kept"
        raise BootError(drive.node, "1A02h:1", detail=detail)
    wanted = TEMPERATURE_TPDO + drive.node
    if cob_id & CAN_ID != wanted:
        raise mismatch(
            drive.node, (0x1802, 1), "COB-ID of TPDO3", expected=f"{wanted:X}h", found=f"0x{cob_id:08X}"
        )
    if cob_id & INVALID:
        drive.put((0x1802, 1), cob_id & ~INVALID, 4)
