"""The frames that the commander sends: RPDOs to all drives, and its own heartbeat. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.drivers import nmt
from jtqd.drivers.devices import COMMANDER_NODE, drive_rpdo1, drive_rpdo2
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.sdo import REQUEST_ID, Transfer
from jtqd.sysid.motion.cia402 import ENABLE_OPERATION, QUICK_STOP_WORD
from jtqd.sysid.motion.setpoints import MotionError, Setpoints
from jtqd.sysid.motion.setup import DriveUnits
from jtqd.sysid.motion.turns import turns

_COMMAND, _VELOCITY = drive_rpdo1(1).layout, drive_rpdo2(1).layout


class Commands:
    """RPDOs for drive `turn` (0, 1, ...); set-points are scaled to the drives' units once, beforehand.

    A drive that is not moved is held: velocity zero. Raises MotionError for set-points that 60FFh (32 bits) or 6071h
    (16 bits) cannot hold, and for a joint without a drive.

    Attributes:
        order: drives in the order in which they get set-points, one per cycle: those that are moved in turn, and one of
            those that are held after each round.
        round_cycles: cycles from one set-point of a moved drive to its next.
    """

    def __init__(self, setpoints: Setpoints, drives: Sequence[DriveUnits]) -> None:
        if setpoints.joints[-1] > len(drives):
            raise MotionError(f"plan: joint {setpoints.joints[-1]} is moved, the bus has {len(drives)}")
        self.order, self.round_cycles = turns(setpoints.joints, len(drives))
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
