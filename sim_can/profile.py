"""Built-in motion of the bench: what runs when nobody else commands the drives. Pure functions of time.

"demo" fills all four quadrants: joint 1 follows a velocity trajectory of two smooth bursts with rests between
them, joint 2 a torque that varies on its own, non-commensurate periods. Everything starts from rest with zero
slope.
"""

import math
from typing import NamedTuple

from sim_can.source import CURRENT, VELOCITY

PERIOD_S = 20.0
# (start, length in s, amplitudes in rad/s of sin(2πk x), k = 1, 2, ..., x = -1/2..1/2 over the burst)
BURSTS = (
    (1.0, 8.4, (0.66, 1.38, -0.90, 0.66)),
    (10.9, 7.6, (-0.42, -1.14, 0.54, 1.26)),
)
# (amplitude in A, period in s)
LOADS = ((2.7, 7.3), (0.7, 2.9), (0.4, 1.7))
LOAD_RISE_S = 2.0


class Targets(NamedTuple):
    """Mode and target of one drive; VELOCITY targets are joint side here, in rad/s."""

    mode: int
    target: float


def demo_velocity(time_s: float) -> float:
    """Velocity of joint 1 in rad/s, joint side.

    Each burst is odd about its middle, so the joint comes back to where it began; the window cos² makes
    velocity and acceleration zero at both ends.
    """
    t = time_s % PERIOD_S
    for start, length, amplitudes in BURSTS:
        x = (t - start) / length - 0.5
        if -0.5 < x < 0.5:
            window = math.cos(math.pi * x) ** 2
            return window * sum(a * math.sin(2.0 * math.pi * k * x) for k, a in enumerate(amplitudes, 1))
    return 0.0


def demo_current(time_s: float) -> float:
    """Motor current of joint 2 in A: a sum of sines that rises smoothly from zero within LOAD_RISE_S."""
    rise = 1.0 if time_s >= LOAD_RISE_S else 0.5 - 0.5 * math.cos(math.pi * time_s / LOAD_RISE_S)
    return rise * sum(a * math.sin(2.0 * math.pi * time_s / period) for a, period in LOADS)


def targets(profile: str, time_s: float) -> tuple[Targets, Targets] | None:
    """Targets of both joints, or None when the profile leaves the drives alone ("rest")."""
    if profile != "demo":
        return None
    return Targets(VELOCITY, demo_velocity(time_s)), Targets(CURRENT, demo_current(time_s))
