"""Cases 17, 30, 34 and 35 of the list: what drives and sensor say is wrong, though it comes in time."""

from __future__ import annotations

import struct

from tests.slow.faults import acts, proofs
from tests.slow.faults.case import DRIVE_FAULT, INVALID, OFF, STARTING, Case, codes
from tests.slow.faults.injections import Added, AndThen, Changed, Frozen


def _negated_velocity(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
    velocity, current, word = struct.unpack("<ihH", data)
    return [(can_id, struct.pack("<ihH", -velocity, current, word))]


def _says(word: int) -> Changed:
    return Changed(lambda can_id, data: [(can_id, data[:6] + struct.pack("<H", word))], 0x281)


def _jumped(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
    motor, link = struct.unpack("<ii", data)
    return [(can_id, struct.pack("<ii", (motor + 65536 + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000, link))]


def _link_only() -> Changed:
    kept: list[bytes] = []

    def stuck(can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        kept.append(data[4:]) if not kept else None
        return [(can_id, data[:4] + kept[0])]

    return Changed(stuck, 0x181)


CASES = (
    Case(
        *("30a", "drive in fault", "node 1: fault for 0.2 s, then reset"),
        lambda: Added(first=lambda rig: acts.drive_fault(rig, 1), last=lambda rig: acts.release(rig, 1)),
        200,
        one=DRIVE_FAULT,
        counters=(),
        notice_ms=3.0,
        recover_ms=300.0,
        settle=1100,
        proof=proofs.all_of(proofs.statuswords(190, 1, 0x4F, 0x08), proofs.frames(1, 0x081, b"\x10\x23")),
    ),
    Case(
        *("30b", "quick stop", "6041h of node 1 says quick stop active, 0.1 s"),
        lambda: _says(0x0237 & ~0x20 | 0x07),
        100,
        note="the motor still carries current: the estimate goes on",
        proof=proofs.statuswords(95, 1, 0x6F, 0x07),
    ),
    Case(
        *("30c", "fault reaction", "6041h of node 1 says fault reaction active, 0.1 s"),
        lambda: _says(0x021F),
        100,
        one=DRIVE_FAULT,
        notice_ms=3.0,
        recover_ms=500.0,
        long=True,
        settle=1100,
        proof=proofs.statuswords(95, 1, 0x4F, 0x0F),
    ),
    Case(
        *("30d", "power stage off", "6041h of node 1 says switch on disabled, 0.1 s"),
        lambda: _says(0x0250),
        100,
        one=OFF,
        notice_ms=3.0,
        recover_ms=200.0,
        settle=500,
        proof=proofs.statuswords(95, 1, 0x4F, 0x40),
    ),
    Case(
        *("35", "sensor not valid, overload", "6150h of the sensor's PDO with bits 0 and 1, 0.2 s"),
        lambda: Changed(lambda can_id, data: [(can_id, data[:4] + b"\x03")], 0x183),
        200,
        note="the reference is unknown meanwhile; the estimate does not use it",
        proof=proofs.sensor_status(190, 3),
    ),
    Case(
        *("34a", "velocity with the wrong sign", "606Ch of node 1 negated while it moves, 0.3 s"),
        lambda: AndThen(Changed(_negated_velocity, 0x281), last=acts.reset),
        300,
        one=INVALID,
        emcy=codes("FF01"),
        counters=("fault_velocity_mismatch",),
        notice_ms=350.0,
        recover_ms=2500.0,
        wait=acts.moving,
        long=True,
        settle=600,
        proof=proofs.velocity_against_position(250),
    ),
    Case(
        *("34b", "encoder jump", "motor position of node 1 one turn further for 50 ms"),
        lambda: AndThen(Changed(_jumped, 0x181), last=acts.reset),
        50,
        one=INVALID | STARTING,
        emcy=codes("FF02"),
        may=codes("FF01"),
        counters=("fault_motor_jump", "latches", "latch_resets"),
        notice_ms=3.0,
        recover_ms=1500.0,
        settle=600,
        note="latched; 1 written to 2110h",
        proof=proofs.position_jump(60_000),
    ),
    Case(
        *("34c", "link encoder stuck", "link position of node 1 keeps its value while it moves, 0.5 s"),
        lambda: AndThen(_link_only(), last=acts.reset),
        500,
        one=INVALID | STARTING,
        emcy=codes("FF01"),
        may=codes("FF02"),
        counters=("fault_torsion",),
        notice_ms=500.0,
        recover_ms=2500.0,
        wait=acts.moving,
        long=True,
        settle=600,
        proof=proofs.stuck(450, 1),
    ),
    Case(
        *(
            "17",
            "frozen encoder: positions repeat, stamps move",
            "181h keeps its data while the joint moves, 1 s",
        ),
        lambda: AndThen(Frozen(0x181), last=acts.reset),
        1000,
        one=INVALID | STARTING,
        emcy=codes("FF01"),
        may=codes("FF02"),
        counters=("fault_velocity_mismatch",),
        notice_ms=1000.0,
        recover_ms=2500.0,
        wait=acts.moving,
        long=True,
        settle=1100,
        proof=proofs.stuck(900, 0),
    ),
)
