"""The commander: a pure state machine, frames and stamps in, frames out. No socket, no clock.

    waiting ──> enabling ──> playing ──> ramping ──> braking ──> disabling ──> over
       │                      │   └─> powerless ──> playing (where the set-points have no power)
       └── refused: nothing has moved        └── any violation: ramping, or braking at once ──┘

In every cycle one RPDO is sent, to one drive after the other (`Commands.order`), so that the bus never carries more than one
more frame: each of two drives gets a set-point every second SYNC. All times are CLOCK_MONOTONIC in ns, of frames as of
calls.

All joints brought to rest and made powerless: at the end of a motion (`Stopping`), or within it (`PowerOff`). Pure.

    ramping      the velocity along a ramp to zero, the current faster than that; then until all joints stand
    braking      quick stop (6040h 2): each drive brakes by itself
    disabling    power off (6040h 0), until all statuswords confirm it

A drive that does not obey the RPDO gets the quick stop by SDO, which a node that is pre-operational still answers. If that
does not help either, our heartbeat ends: the drives then stop by 1016h:2.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Final

from jtqd.drivers.drive import State, state_of
from jtqd.drivers.own_objects import COMMANDER_NODE
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.sysid.motion.drives import (
    DISABLE_VOLTAGE,
    POWERED,
    QUICK_STOP_WORD,
    Commands,
    DriveUnits,
    Heartbeat,
    SensorUnits,
    describe,
    enabling_word,
)
from jtqd.sysid.motion.inputs import Inputs, Supervision
from jtqd.sysid.motion.setpoints import (
    PERIOD_S,
    Limits,
    Monitor,
    MotionResult,
    Setpoints,
    Surroundings,
    Timing,
    Violation,
    out_of_range,
)

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
    nothing drives it ends the motion. index: set-point in force, zero; over: both drives are enabled again, and the window
    has ended; violation: why it cannot go on.
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


UNPACED: Final = 2
"""Period of our own clock while there is no SYNC, in periods of SYNC."""
LARGEST_ADVANCE: Final = 4
"""Most cycles that are skipped after lost ones: more of them make the motion longer, never a jump."""


class Pace:
    """When a set-point is due: SYNC sets the pace, our own clock once SYNC is lost (`synced`).

    pending: the newest SYNC has not had its set-point.
    """

    def __init__(self, timing: Timing, now_ns: int) -> None:
        self.synced = False
        self.pending = False
        self._timing = timing
        self._newest_ns = now_ns  # SYNC, or our own beat while there is none
        self._slots = 0
        self._steps = timing.steps
        self._period_ns = round(timing.period_s * 1e9)
        self._unpaced_ns = UNPACED * self._period_ns
        self._delay_ns = round(timing.setpoint_delay_s * 1e9)
        self._lost_ns = round(timing.sync_lost_s * 1e9)
        self._late_ns = round(timing.late_s * 1e9)

    @property
    def wake_ns(self) -> int:
        """When all frames of the current cycle, or else of the next one, should have come; 0: unknown."""
        if not self.synced:
            return 0
        return self._newest_ns + self._delay_ns + (0 if self.pending else self._period_ns)

    @property
    def due_ns(self) -> int:
        """When something must be done although no frame comes."""
        if not self.synced:
            return self._newest_ns + self._unpaced_ns
        return self._newest_ns + (self._delay_ns if self.pending else self._lost_ns)

    def on_sync(self, t_ns: int, now_ns: int) -> Violation | None:
        """Take a SYNC received at t_ns; return a violation when it comes too late, or is looked at too late."""
        gap_ns = t_ns - self._newest_ns
        followed = self.synced
        self.synced = self.pending = True
        self._newest_ns = t_ns
        if not followed:
            return None
        self._slots += max(1, round(gap_ns / self._period_ns))
        if gap_ns > self._lost_ns:
            return self._lost(gap_ns)
        if now_ns - t_ns > self._late_ns:
            late, limit = (now_ns - t_ns) * 1e-6, self._timing.late_s * 1e3
            return Violation(f"commander: late by {late:.0f} ms, limit {limit:.0f} ms", False)
        return None

    def watch(self, now_ns: int) -> Violation | None:
        """Return a violation when SYNC is lost, once; from then on our own clock counts."""
        gap_ns = now_ns - self._newest_ns
        if not self.synced or gap_ns <= self._lost_ns:
            return None
        self.synced = self.pending = False
        self._newest_ns = now_ns - self._unpaced_ns
        return self._lost(gap_ns)

    def ready(self, now_ns: int) -> bool:
        """Return whether a set-point is to be sent now: the inputs of the newest SYNC have had their time on the wire."""
        if not self.synced:
            return now_ns >= self._newest_ns + self._unpaced_ns
        return self.pending and now_ns >= self._newest_ns + self._delay_ns

    def served(self, now_ns: int) -> int:
        """Mark the set-point as sent; return by how many set-points the motion has advanced since the last one."""
        advance = self._steps * min(self._slots, LARGEST_ADVANCE)
        self._slots = 0
        self.pending = False
        if not self.synced:
            self._newest_ns = now_ns
        return advance

    def _lost(self, gap_ns: int) -> Violation:
        limit = self._timing.sync_lost_s * 1e3
        return Violation(f"SYNC missing for {gap_ns * 1e-6:.0f} ms, limit {limit:.0f} ms", True)


FULL_QUEUE_FRAMES: Final = 5

Frame = tuple[int, bytes, int]
"""COB-ID, data, time of reception."""


class Commander:
    """One motion of all drives of a bus, joints 1, 2, ..., which are set up already; those that the set-points do not name
    are held.

    Call `on_frames` with what has arrived, at best at `wake_ns`, by `due_ns` at the latest; send what it returns. refusal:
    why nothing has moved, None otherwise, and `result` holds once `over`. out_of_place: position [rad] of a joint that was
    refused for it.
    """

    def __init__(
        self,
        setpoints: Setpoints,
        limits: Limits,
        drives: Sequence[DriveUnits],
        sensor: SensorUnits | None,
        *,
        now_ns: int,
        timing: Timing | None = None,
        around: Surroundings | None = None,
    ) -> None:
        self.timing = timing = timing or Timing()
        self.inputs = Inputs(drives, sensor, COMMANDER_NODE)
        self.phase = Phase.WAITING
        self.refusal: str | None = None
        self.out_of_place: float | None = None
        self._reason = ""
        self._handlers = self.inputs.handlers
        self._pace = Pace(timing, now_ns)
        self._heartbeat = Heartbeat(timing.own_heartbeat_s, now_ns)
        self._limits = limits
        self._monitor = Monitor(limits, setpoints.joints, around)
        self._supervision = Supervision(self.inputs, timing)
        self._setpoints = setpoints
        self._commands = Commands(setpoints, drives)
        self._cycles = 0
        self._index = -1  # of the set-point in force
        self._unpowered = list(setpoints.off)  # without power, still to come
        self._power_off: PowerOff | None = None
        self._stopping: Stopping | None = None
        self._now_ns = self._since_ns = self._still_since_ns = now_ns
        self._full = 0

    # For the shell ------------------------------------------------------------------------------------------

    @property
    def over(self) -> bool:
        """Whether nothing more will be sent."""
        return self.phase is Phase.OVER

    @property
    def played_s(self) -> float:
        """Length of the set-points that have been in force."""
        return (self._index + 1) * PERIOD_S

    @property
    def total_s(self) -> float:
        """Length of all set-points."""
        return self._setpoints.duration_s

    @property
    def result(self) -> MotionResult:
        """How the motion ended."""
        return MotionResult("stopped" if self._reason else "done", self._reason, self.played_s)

    @property
    def wake_ns(self) -> int:
        """Sleep until then, whatever comes: one wake-up takes a whole cycle; 0: wake up with the next frame."""
        return self._pace.wake_ns

    @property
    def due_ns(self) -> int:
        """Call `on_frames` by then even when nothing has come."""
        return self._pace.due_ns if self.silent else min(self._pace.due_ns, self._heartbeat.due_ns)

    @property
    def silent(self) -> bool:
        """Whether our heartbeat has ended on purpose: a drive does not obey, and stops when it misses it."""
        return self._stopping is not None and self._stopping.silent

    def stop(self, reason: str) -> None:
        """Lead all joints to a stop; asked for a second time, they brake at once."""
        self._stop(Violation(reason, self.phase is Phase.RAMPING))

    def frame_refused(self, refused: bool) -> None:
        """Count frames that the full transmit queue refused; several in a row stop the motion."""
        self._full = self._full + 1 if refused else 0
        if self._full == FULL_QUEUE_FRAMES:
            self._stop(Violation(f"bus: transmit queue full for {FULL_QUEUE_FRAMES} frames in a row", True))

    def on_frames(self, frames: Sequence[Frame], now_ns: int) -> list[bytes]:
        """Take what has arrived, in order; return what is to be sent now."""
        self._now_ns = now_ns
        handlers = self._handlers
        for can_id, data, t_ns in frames:
            handler = handlers.get(can_id)
            if handler is not None:
                handler(data, t_ns)
            elif can_id == SYNC_COB_ID:
                if self._pace.pending:
                    self._examine()  # several cycles have come at once: each is checked
                self._stop_late(self._pace.on_sync(t_ns, now_ns))
                self.inputs.cycle += 1
        self._stop_late(self._pace.watch(now_ns))
        if self.phase is Phase.OVER:
            return []
        out = [] if self.silent else self._heartbeat.frames(now_ns)
        if self._pace.ready(now_ns):
            self._examine()
            frame = self._step(self._pace.served(now_ns))
            if frame is not None:
                out.append(frame)
        return out

    # Violations ---------------------------------------------------------------------------------------------

    def _stop_late(self, violation: Violation | None) -> None:
        """Stop because SYNC or this process is late; before the start the wait begins again instead."""
        if violation is None:
            return
        if self.phase is Phase.WAITING:
            self._still_since_ns = self._now_ns
        else:
            self._stop(violation)

    def _examine(self) -> None:
        """Check limits and supervision of the newest values. On the stop ramp only hard violations count."""
        phase = self.phase
        pause = self._power_off
        if phase in (Phase.PLAYING, Phase.ENABLING, Phase.POWERLESS):
            reason = self._monitor.check(self.inputs.sample())
            if reason is not None:
                self._stop(Violation(reason, False))
                return
        elif phase is not Phase.RAMPING:
            return
        enabled = phase is not Phase.ENABLING and (pause is None or pause.powered)
        violation = self._supervision.check(self._now_ns, enabled=enabled)
        if violation is not None and (violation.hard or phase is not Phase.RAMPING):
            self._stop(violation)

    def _stop(self, violation: Violation) -> None:
        """Begin to stop, or go on to the harder way. The first reason is the one that is reported."""
        if self.over:
            return
        self._reason = self._reason or violation.reason
        if self.phase is Phase.WAITING:
            self.phase = Phase.OVER
        elif self._stopping is None:
            self._begin_stop(hard=violation.hard or self.phase in (Phase.ENABLING, Phase.POWERLESS))
        elif violation.hard:
            self._stopping.brake(self._now_ns)
            self.phase = self._stopping.phase

    def _begin_stop(self, *, hard: bool) -> None:
        start = (0.0, 0.0)
        self._power_off = None
        if self._index >= 0:
            setpoints = self._setpoints
            start = float(setpoints.velocity_rad_s[self._index]), float(setpoints.current_a[self._index])
        self._stopping = Stopping(
            self._supervision, self._commands, self.timing, start, hard=hard, now_ns=self._now_ns
        )
        self.phase = self._stopping.phase

    # Phases -------------------------------------------------------------------------------------------------

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._since_ns = self._still_since_ns = self._now_ns

    def _phase_s(self) -> float:
        return (self._now_ns - self._since_ns) * 1e-9

    def _step(self, advance: int) -> bytes | None:
        """Do one cycle of the current phase; return the RPDO for the next drive."""
        self._cycles += 1
        turn = self._cycles % len(self.inputs.drives)
        if self.phase is Phase.POWERLESS:
            return self._powerless(turn, advance)
        if self.phase is Phase.PLAYING or self.phase is Phase.RAMPING:
            turn = self._commands.order[self._cycles % len(self._commands.order)]
        if self.phase is Phase.PLAYING:
            self._index += advance
            if self._unpowered and self._index >= self._unpowered[0][0]:
                return self._without_power(turn)
            if self._index < len(self._setpoints):
                return self._commands.setpoint(turn, self._index)
            self._index = len(self._setpoints) - 1
            self._begin_stop(hard=False)
        if self.phase is Phase.WAITING:
            self._waiting()
            return None
        if self.phase is Phase.ENABLING:
            return self._enabling(turn)
        stopping = self._stopping
        assert stopping is not None
        frame = stopping.step(turn, advance, self._now_ns, synced=self._pace.synced)
        self.phase = stopping.phase
        return frame

    def _without_power(self, turn: int) -> bytes | None:
        """Begin the next window without power with its first set-point, also where cycles were lost just before it."""
        window = self._unpowered.pop(0)
        self._index = window[0]
        self._power_off = PowerOff(
            self.inputs, self._supervision, self._commands, self.timing, window, self._now_ns
        )
        self.phase = Phase.POWERLESS
        return self._power_off.step(turn, 0, self._now_ns)

    def _powerless(self, turn: int, advance: int) -> bytes | None:
        pause = self._power_off
        assert pause is not None
        frame = pause.step(turn, advance, self._now_ns)
        self._index = pause.index
        if pause.violation is not None:
            self._stop(pause.violation)
            return None
        if pause.over:
            self._power_off = None
            self._enter(Phase.PLAYING)
        return frame

    def _waiting(self) -> None:
        """Wait until SYNC, every input and standstill have been there long enough; refuse when they do not come in time."""
        for drive in self.inputs.drives:
            drive.begin_travel()
        missing: str | None = "no SYNC: is jtqd running on this bus?"
        if self._pace.synced:
            missing = self._supervision.missing(self._now_ns)
            missing = missing or self._monitor.check(self.inputs.sample()) or self._supervision.moving()
        if missing is not None:
            self._still_since_ns = self._now_ns
            if self._phase_s() > self.timing.ready_s:
                self.refusal = missing
                self.phase = Phase.OVER
        elif self._now_ns - self._still_since_ns >= self.timing.still_s * 1e9:
            leader = self.inputs.drives[self._setpoints.velocity_joint - 1]
            self.refusal = out_of_range(self._setpoints, self._limits, leader.position_rad)
            if self.refusal is not None:
                self.out_of_place = leader.position_rad
            self._enter(Phase.ENABLING if self.refusal is None else Phase.OVER)

    def _enabling(self, turn: int) -> bytes | None:
        """Send 6040h 6, 7, 15, each after the statusword has confirmed the last one."""
        states = [state_of(drive.statusword) for drive in self.inputs.drives]
        if all(state is State.OPERATION_ENABLED for state in states):
            self._enter(Phase.PLAYING)
        elif self._phase_s() > self.timing.enable_s:
            drive = next(
                drive
                for drive, state in zip(self.inputs.drives, states, strict=True)
                if state is not State.OPERATION_ENABLED
            )
            text = (
                f"{describe(drive.statusword)} after {self.timing.enable_s:g} s, expected operation enabled"
            )
            self._stop(Violation(f"{drive.name}: {text}", True))
            return self._commands.control(turn, QUICK_STOP_WORD)
        word = enabling_word(states[turn])
        return None if word is None else self._commands.control(turn, word)
