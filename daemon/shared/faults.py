"""Faults that make an estimate invalid or that may be latched: their bits, names, meanings and statuses."""

from __future__ import annotations

from typing import Final

from jtqd.estimator.status import CURRENT_FROZEN, LINK_JUMP, MOTOR_JUMP, REPEATED, TORSION, VELOCITY_MISMATCH

NOT_FINITE: Final = 0x01
"""The estimator gave a number that is none, or a sigma that is none, as if it were good."""
OUT_OF_RANGE: Final = 0x02
"""The torque, or what it is made of, is beyond everything that the joint can do; or sigma is."""
DEVIATION: Final = 0x80
"""Too far from the torque sensor for too long; looked for only where it is latched."""
DRIVE_FAULT: Final = 0x100
STALE: Final = 0x200
"""So many cycles in a row without a number, without inputs or time, as many as `safety.stale_latch_cycles`."""

NAMES: Final = {
    NOT_FINITE: "not_finite",
    OUT_OF_RANGE: "out_of_range",
    MOTOR_JUMP: "motor_jump",
    LINK_JUMP: "link_jump",
    VELOCITY_MISMATCH: "velocity_mismatch",
    TORSION: "torsion",
    CURRENT_FROZEN: "current_frozen",
    DEVIATION: "deviation",
    DRIVE_FAULT: "drive_fault",
    STALE: "stale",
    REPEATED: "repeated",
}
"""Name by bit: in the configuration, in the counters (`fault_NAME`) and in lines for the operator."""
BITS: Final = {name: bit for bit, name in NAMES.items()}

COUNTED: Final = tuple(bit for bit in NAMES if bit <= DEVIATION)
"""Faults that a cycle can have besides its status: the low byte."""

MEANINGS: Final = {
    NOT_FINITE: "the estimate is not finite",
    OUT_OF_RANGE: "the torque or its sigma is out of range",
    MOTOR_JUMP: "the motor position jumped",
    LINK_JUMP: "the link position jumped",
    VELOCITY_MISMATCH: "motor position and motor velocity disagree",
    TORSION: "the torsion exceeds the limit of the gear",
    CURRENT_FROZEN: "the current is frozen while the motor turns",
    DEVIATION: "the deviation from the torque sensor exceeded its limit",
    DRIVE_FAULT: "the drive was in fault",
    STALE: "too many consecutive cycles without a torque",
    REPEATED: "the inputs had come before, so that those since then are old",
}


def names_of(bits: int) -> tuple[str, ...]:
    """Return the names of the faults in `bits`, in the order of their bits."""
    return tuple(name for bit, name in NAMES.items() if bits & bit)
