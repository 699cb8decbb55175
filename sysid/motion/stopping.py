"""All joints brought to rest and made powerless: at the end of a motion (`Stopping`), or within it (`PowerOff`). Pure.

    ramping      the velocity along a ramp to zero, the current faster than that; then until all joints stand
    braking      quick stop (6040h 2): each drive brakes by itself
    disabling    power off (6040h 0), until all statuswords confirm it

A drive that does not obey the RPDO gets the quick stop by SDO, which a node that is pre-operational still answers. If that
does not help either, our heartbeat ends: the drives then stop by 1016h:2.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

from jtqd.drivers.drive import State, state_of
from jtqd.sysid.motion.drives import (
    DISABLE_VOLTAGE,
    POWERED,
    QUICK_STOP_WORD,
    Commands,
    describe,
    enabling_word,
)
from jtqd.sysid.motion.inputs import Inputs, Supervision
from jtqd.sysid.motion.setpoints import PERIOD_S, Timing, Violation

DECELERATION_RAD_S2: Final = 10.0
"""Joint side. From 3.3 rad/s the joint stands after 0.33 s."""
UNLOAD_S: Final = 0.1
"""Time in which the current goes to zero: long against the joint's torsional period, short against the ramp."""
SETTLE_S: Final = 0.3
"""After the ramp: time for both joints to stand, before they are braked anyway."""
SETTLED_S: Final = 0.02
"""All joints must have stood for so long before the next step."""
OFF_S: Final = 0.01
"""Time for several frames to each drive that switch it off."""
BY_SDO_S: Final = 0.01
"""A drive that has not left operation enabled by then gets the quick stop by SDO."""
SILENT_S: Final = 0.2
"""A drive that has not left operation enabled by then gets no more heartbeat of ours."""


class Phase(Enum):
    """What the commander is doing."""

    WAITING = "waiting"
    ENABLING = "enabling"
    PLAYING = "playing"
    POWERLESS = "powerless"
    RAMPING = "ramping"
    BRAKING = "braking"
    DISABLING = "disabling"
    OVER = "over"


class StopRamp:
    """Set-points from (velocity_rad_s, current_a) to (0, 0); `duration_s` is when both have arrived."""

    __slots__ = ("_current_a", "_velocity_rad_s", "duration_s")

    def __init__(self, velocity_rad_s: float, current_a: float) -> None:
        self._velocity_rad_s = velocity_rad_s
        self._current_a = current_a
        self.duration_s = max(abs(velocity_rad_s) / DECELERATION_RAD_S2, UNLOAD_S if current_a else 0.0)

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Return velocity [rad/s] and current [A], elapsed_s after the beginning of the stop."""
        velocity = self._velocity_rad_s
        left = max(0.0, abs(velocity) - DECELERATION_RAD_S2 * elapsed_s)
        share = max(0.0, 1.0 - elapsed_s / UNLOAD_S)
        return (left if velocity > 0.0 else -left), self._current_a * share


class Stopping:
    """One stop, from the set-point in force; `hard` leaves out the ramp. `silent`: our heartbeat must end."""

    def __init__(
        self,
        supervision: Supervision,
        commands: Commands,
        timing: Timing,
        start: tuple[float, float],
        *,
        hard: bool,
        now_ns: int,
    ) -> None:
        self.silent = False
        self.phase = Phase.BRAKING if hard else Phase.RAMPING
        self._supervision, self._commands, self._timing = supervision, commands, timing
        self._ramp = StopRamp(*start)
        self._ramp_s = 0.0
        self._sdo_sent: set[int] = set()
        self._since_ns = self._moved_ns = now_ns

    def brake(self, now_ns: int) -> None:
        """Go on without the ramp."""
        if self.phase is Phase.RAMPING:
            self._enter(Phase.BRAKING, now_ns)

    def step(self, turn: int, advance: int, now_ns: int, *, synced: bool) -> bytes | None:
        """Do one cycle; return the frame for drive `turn`. Without SYNC nothing is measured, and the time alone counts."""
        if not synced or self._supervision.moving() is not None:
            self._moved_ns = now_ns
        if self.phase is Phase.RAMPING:
            return self._ramping(turn, advance, now_ns)
        if self.phase is Phase.BRAKING:
            return self._braking(turn, now_ns, synced)
        return self._disabling(turn, now_ns, synced)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self.phase = phase
        self._since_ns = self._moved_ns = now_ns

    def _settled(self, now_ns: int) -> bool:
        return (now_ns - self._moved_ns) * 1e-9 >= SETTLED_S

    def _ramping(self, turn: int, advance: int, now_ns: int) -> bytes:
        self._ramp_s += advance * PERIOD_S
        duration_s = self._ramp.duration_s
        if self._ramp_s <= duration_s:
            self._moved_ns = now_ns
        if self._settled(now_ns) or self._ramp_s > duration_s + SETTLE_S:
            self._enter(Phase.BRAKING, now_ns)
            return self._commands.control(turn, QUICK_STOP_WORD)
        return self._commands.target(turn, *self._ramp.at(self._ramp_s))

    def _braking(self, turn: int, now_ns: int, synced: bool) -> bytes:
        elapsed_s = (now_ns - self._since_ns) * 1e-9
        if self._settled(now_ns) or elapsed_s > self._timing.quick_stop_s:
            self._enter(Phase.DISABLING, now_ns)
            return self._commands.control(turn, DISABLE_VOLTAGE)
        obeyed = synced and self._supervision.obeyed(turn)
        if not obeyed and synced and elapsed_s > SILENT_S:
            self.silent = True
        if not obeyed and elapsed_s > BY_SDO_S and turn not in self._sdo_sent:
            self._sdo_sent.add(turn)
            return self._commands.quick_stop_by_sdo(turn)
        return self._commands.control(turn, QUICK_STOP_WORD)

    def _disabling(self, turn: int, now_ns: int, synced: bool) -> bytes | None:
        """Switch off. Where SYNC is gone, the shell asks for the statuswords by SDO afterwards."""
        elapsed_s = (now_ns - self._since_ns) * 1e-9
        off = synced and elapsed_s > OFF_S and self._supervision.all_off()
        if off or elapsed_s > self._timing.disable_s:
            self.phase = Phase.OVER
            return None
        return self._commands.control(turn, DISABLE_VOLTAGE)


ON_S: Final = 0.25
"""Before the end of the window the power comes back, so that the next motion is not late."""
FREE_RAD_S: Final = 0.2
"""Joint side: a gear that springs back as the torque goes is slower, and stands again at once."""
STAND_S: Final = 2.0
"""Longest wait for standstill before the power goes."""


class _Step(Enum):
    STANDING = "standing"
    OFF = "off"
    ON = "on"


class PowerOff:
    """One window of a motion without power, set-points `window` = (first, end): out of operation enabled and back.

        standing     set-points of zero, until both joints have stood for Timing.still_s
        off          6040h 0 to both, until both statuswords confirm it; then nothing but time, at least half of the window
        on           6040h 6, 7, 15 to both as at the start, targets zero, until both are in operation enabled

    Limits and supervision go on meanwhile, but that both drives must be in operation enabled. A joint that turns although
    nothing drives it ends the motion.

    Attributes:
        index: set-point in force; all of them are zero.
        over: both drives are in operation enabled again, and the window has ended.
        violation: why it cannot go on.
    """

    def __init__(  # noqa: PLR0917
        self,
        inputs: Inputs,
        supervision: Supervision,
        commands: Commands,
        timing: Timing,
        window: tuple[int, int],
        now_ns: int,
    ) -> None:
        self.index, self._end = window
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
        """Do one cycle; return the frame for drive `turn`, None where none is due, or with a `violation`."""
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
                self.violation = Violation(
                    moving.replace("before the start", "before the power is switched off"), False
                )
                return None
        elif (now_ns - self._moved_ns) * 1e-9 >= self._timing.still_s:
            self._enter(_Step.OFF, now_ns)
            return self._commands.control(turn, DISABLE_VOLTAGE)
        return self._commands.setpoint(turn, self.index)

    def _off(self, turn: int, now_ns: int) -> bytes | None:
        self.violation = self._turning()
        if not self._supervision.all_off():
            self._powered_ns = now_ns
            if self._elapsed_s(now_ns) > self._timing.disable_s:
                drives = self._inputs.drives
                drive = next((d for d in drives if state_of(d.statusword) in POWERED), drives[-1])
                self.violation = Violation(
                    f"{drive.name}: {describe(drive.statusword)} after {self._timing.disable_s:g} s, expected no power",
                    True,
                )
        elif (self._end - self.index) * PERIOD_S <= ON_S and (
            now_ns - self._powered_ns
        ) * 1e-9 >= self._least_s:
            self._enter(_Step.ON, now_ns)
            return self._on(turn, now_ns)
        return self._commands.control(turn, DISABLE_VOLTAGE)

    def _on(self, turn: int, now_ns: int) -> bytes | None:
        states = [state_of(drive.statusword) for drive in self._inputs.drives]
        if all(state is State.OPERATION_ENABLED for state in states):
            self.over = self.index == self._end - 1
            return self._commands.setpoint(turn, self.index)
        self.violation = self._turning()
        if self._elapsed_s(now_ns) > self._timing.enable_s:
            drive = self._inputs.drives[states[0] is State.OPERATION_ENABLED]
            self.violation = Violation(
                f"{drive.name}: {describe(drive.statusword)} after {self._timing.enable_s:g} s, expected operation enabled",
                True,
            )
        word = enabling_word(states[turn])
        return None if word is None else self._commands.control(turn, word)

    def _turning(self) -> Violation | None:
        """Return a violation for a joint that turns although nothing drives it."""
        for drive in self._inputs.drives:
            if not -FREE_RAD_S <= drive.velocity_rad_s <= FREE_RAD_S:
                text = f"velocity {drive.velocity_rad_s:.3f} rad/s without power, limit {FREE_RAD_S:g} rad/s"
                return Violation(f"{drive.name}: {text}", True)
        return None
