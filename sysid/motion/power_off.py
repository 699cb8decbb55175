"""A stretch of a motion in which both drives have no power: out of operation enabled and back, without a jump. Pure.

    standing     set-points of zero, until both joints have stood for Timing.still_s
    off          6040h 0 to both, until both statuswords say so; then nothing but time, at least half of the stretch
    on           6040h 6, 7, 15 to both as at the start, targets zero, until both are in operation enabled

Limits and supervision go on meanwhile, but that both drives are in operation enabled. A joint that turns although nothing
drives it ends the motion.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from sysid.motion.cia402_client import DISABLE_VOLTAGE, POWERED, State, describe, enabling_word, fast_state
from sysid.motion.commands import Commands
from sysid.motion.inputs import Inputs
from sysid.motion.result import Timing, Violation
from sysid.motion.setpoints import PERIOD_S
from sysid.motion.supervision import Supervision

ON_S: Final = 0.25
"""Before the end of the stretch the power comes back, so that the motion after it is not late."""
FREE_RAD_S: Final = 0.2
"""Joint side: a gear that springs back as the torque goes is slower, and stands again at once."""
STAND_S: Final = 2.0
"""Longest wait for standstill before the power goes."""


class _Step(Enum):
    STANDING = "standing"
    OFF = "off"
    ON = "on"


class PowerOff:
    """One stretch, from set-point `first` to `end` (not included). `index`: set-point in force, all of them zero;
    `over`: both drives are in operation enabled again and the stretch has ended; `violation`: why it cannot go on.
    """

    def __init__(  # noqa: PLR0917
        self,
        inputs: Inputs,
        supervision: Supervision,
        commands: Commands,
        timing: Timing,
        stretch: tuple[int, int],
        now_ns: int,
    ) -> None:
        self.index, self._end = stretch
        self._least_s = 0.5 * (self._end - self.index) * PERIOD_S
        self.violation: Violation | None = None
        self.over = False
        self._inputs, self._supervision = inputs, supervision
        self._commands, self._timing = commands, timing
        self._step = _Step.STANDING
        self._since_ns = self._moved_ns = self._powered_ns = now_ns

    @property
    def powered(self) -> bool:
        """Whether both drives must be in operation enabled."""
        return self._step is _Step.STANDING

    def step(self, turn: int, advance: int, now_ns: int) -> bytes | None:
        """One cycle: the frame for drive `turn`; None where there is nothing to say, or with a `violation`."""
        self.index = min(self.index + advance, self._end - 1)
        if self._step is _Step.STANDING:
            return self._standing(turn, now_ns)
        if self._step is _Step.OFF:
            return self._off(turn, now_ns)
        return self._on(turn, now_ns)

    def _enter(self, step: _Step, now_ns: int) -> None:
        self._step = step
        self._since_ns = now_ns

    def _elapsed_s(self, now_ns: int) -> float:
        return (now_ns - self._since_ns) * 1e-9

    def _standing(self, turn: int, now_ns: int) -> bytes | None:
        moving = self._supervision.moving()
        if moving is not None:
            self._moved_ns = now_ns
            if self._elapsed_s(now_ns) > STAND_S:
                self.violation = Violation(moving.replace("before the start", "before its power goes"), False)
                return None
        elif (now_ns - self._moved_ns) * 1e-9 >= self._timing.still_s:
            self._enter(_Step.OFF, now_ns)
            return self._commands.control(turn, DISABLE_VOLTAGE)
        return self._commands.setpoint(turn, self.index)

    def _off(self, turn: int, now_ns: int) -> bytes | None:
        self.violation = self._turning()
        if not self._supervision.both_off():
            self._powered_ns = now_ns
            if self._elapsed_s(now_ns) > self._timing.disable_s:
                one, two = self._inputs.drives
                drive = one if fast_state(one.statusword) in POWERED else two
                self.violation = Violation(
                    f"{drive.who}: {describe(drive.statusword)} after {self._timing.disable_s:g} s, expected no power",
                    True,
                )
        elif (self._end - self.index) * PERIOD_S <= ON_S and (
            now_ns - self._powered_ns
        ) * 1e-9 >= self._least_s:
            self._enter(_Step.ON, now_ns)
            return self._on(turn, now_ns)
        return self._commands.control(turn, DISABLE_VOLTAGE)

    def _on(self, turn: int, now_ns: int) -> bytes | None:
        states = [fast_state(drive.statusword) for drive in self._inputs.drives]
        if all(state is State.OPERATION_ENABLED for state in states):
            self.over = self.index == self._end - 1
            return self._commands.setpoint(turn, self.index)
        self.violation = self._turning()
        if self._elapsed_s(now_ns) > self._timing.enable_s:
            drive = self._inputs.drives[states[0] is State.OPERATION_ENABLED]
            self.violation = Violation(
                f"{drive.who}: {describe(drive.statusword)} after {self._timing.enable_s:g} s, expected operation enabled",
                True,
            )
        word = enabling_word(states[turn])
        return None if word is None else self._commands.control(turn, word)

    def _turning(self) -> Violation | None:
        """A joint that turns although nothing drives it."""
        for drive in self._inputs.drives:
            if not -FREE_RAD_S <= drive.velocity_rad_s <= FREE_RAD_S:
                text = f"velocity {drive.velocity_rad_s:.3f} rad/s without power, limit {FREE_RAD_S:g} rad/s"
                return Violation(f"{drive.who}: {text}", True)
        return None
