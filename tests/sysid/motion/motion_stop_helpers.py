"""What the tests of the commander's stops share: a motion at full speed and load, and the check that it was stopped well."""

from __future__ import annotations

import re
from collections.abc import Callable

from jtqd.sim_can import drive_node as cia402
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.motion.stopping import Phase
from tests.sysid.motion.motion_helpers import MS, WIDE, LockStep, plateau

Frames = list[tuple[int, bytes, int]]
SPEED = 1.5
CURRENT = 3.0
RAMP_MS = round(SPEED / 10.0 * 1e3)
STOP_MS = RAMP_MS + 60
"""Both joints stand: the ramp at 10 rad/s2, and the drives' lag."""
BRAKE_MS = 120
"""Both joints stand after a quick stop."""


def started(lock: LockStep, limits: Limits = WIDE, joint: int = 1, at_ms: int = 500) -> None:
    """At full speed and load."""
    lock.commander(plateau(SPEED, CURRENT, hold_ms=3000, joint=joint), limits)
    lock.play_until(at_ms)


def still_after(lock: LockStep, limit_ms: int) -> int:
    """Cycles until both true velocities are, and stay, below 0.02 rad/s."""
    moved = 0
    for ms in range(1, limit_ms + 101):
        lock.cycle()
        if max(abs(v) for v in lock.velocities) > 0.02:
            moved = ms
    return moved


def stopped_with(lock: LockStep, pattern: str, limit_ms: int = STOP_MS) -> None:
    """Led to a stop in time and disabled, for the reason that matches; only smaller set-points followed, then none."""
    begin = lock.now // MS
    assert lock.motion.phase in (Phase.RAMPING, Phase.BRAKING), lock.motion.phase
    assert still_after(lock, limit_ms) <= limit_ms
    lock.run()
    result = lock.motion.result
    assert result.status == "stopped"
    assert re.fullmatch(pattern, result.reason), result.reason
    assert "\n" not in result.reason
    for state in lock.states:
        assert state in (cia402.SWITCH_ON_DISABLED, cia402.FAULT), cia402.NAMES[state]
    for can_id in (0x201, 0x202, 0x301, 0x302):
        targets = [target for _, found, target in lock.setpoints_sent(begin) if found == can_id]
        assert targets == sorted(targets, key=abs, reverse=True), f"{can_id:X}h grew again: {targets}"
    before = len(lock.sent)
    lock.run_for(30)
    assert len(lock.sent) == before


def until_stop(lock: LockStep, limit_ms: int) -> int:
    """Cycles until the commander begins to stop."""
    return lock.run(lambda: lock.motion.phase in (Phase.RAMPING, Phase.BRAKING), limit_ms)


def changed(can_id: int, change: Callable[[bytes], bytes]) -> Callable[[Frames], Frames]:
    """A filter that changes the data of one COB-ID."""
    return lambda frames: [(i, change(d) if i == can_id else d, t) for i, d, t in frames]
