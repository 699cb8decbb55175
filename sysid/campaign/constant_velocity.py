"""Runs at constant velocity and load: section II of the paper (efficiency) and its section IV.A (validation). Pure.

Signs. Each joint has its own frame; the links turn oppositely, and a positive current of either joint gives a positive
torque in the sensor. So with equal signs of the velocity joint's velocity and the other joint's current, the velocity
joint drives forward (its own current and velocity have the same sign) and the other joint is driven back. "forward_1"
means that joint 1 is the velocity joint, "back_1" that joint 2 is: for joint 2 the names read the other way round, and
every run serves both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

from sysid.campaign.plan import Plateau, Rest, Run, Segment

VELOCITIES_RAD_S: Final = (0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0)
"""Section II of the paper."""
CURRENTS_A: Final = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
FAST_RAD_S: Final = 1.8
"""Above it the paper leaves out 5 A, because of the nominal output torque."""
VALIDATION_POINTS: Final = {0.5: (0.5, 1.5, 2.5), 1.5: (1.5, 2.5, 3.5), 2.5: (2.5, 3.5, 4.5)}
"""Section IV.A: velocity [rad/s] -> currents [A]."""
DRIVES: Final = {"forward_1": 1, "back_1": 2}
"""Kind of drive, as seen from joint 1 -> velocity joint."""

RAMP_S: Final = 0.4
HOLD_S: Final = 2.1
_RAMP_PER_RAD_S: Final = 0.35
"""Longer ramps for larger steps: 5.4 rad/s^2 at most, 7.5 Nm for both rotors of the bench, which come on top of the load."""
_EDGE_S: Final = 0.5
_TRAVEL_SHARE: Final = 0.95
"""Part of the travel limit that is used: the joint overshoots a little."""

Point = tuple[float, float]
"""(velocity [rad/s], current [A])"""


def currents_of(velocity_rad_s: float) -> tuple[float, ...]:
    """Magnitudes of the driving joint's currents [A] at a velocity, by section II."""
    return CURRENTS_A if abs(velocity_rad_s) <= FAST_RAD_S else CURRENTS_A[:-1]


def ladder(
    name: str, velocity_joint: int, points: Iterable[Point], hold_s: float, travel_rad: float = math.inf
) -> Run:
    """One run: from rest over all points, each held for hold_s after its ramp, back to rest.

    Before a point that would take the joint further than travel_rad from where the run began (with some room to stop
    in), it turns back there without load; a smooth ramp covers the mean of its two velocities times its length.
    """
    segments: list[Segment] = [Rest(_EDGE_S, 0.0)]
    velocity = position = 0.0
    for target, current in points:
        ramp_s = _ramp_s(target - velocity)
        step = 0.5 * (velocity + target) * ramp_s + target * hold_s
        to_stop = 0.5 * target * _ramp_s(target)
        if position and abs(position + step + to_stop) > _TRAVEL_SHARE * travel_rad:
            back = -math.copysign(abs(target), position)
            ramp_s = _ramp_s(back - velocity)
            position += 0.5 * (velocity + back) * ramp_s
            ramp_out_s = _ramp_s(target - back)
            hold_back_s = max(round(-(position + 0.5 * (back + target) * ramp_out_s) / back, 3), 0.0)
            segments.append(Plateau(back, 0.0, hold_back_s, ramp_s))
            position += back * hold_back_s
            velocity, ramp_s = back, ramp_out_s
            step = 0.5 * (velocity + target) * ramp_s + target * hold_s
        segments.append(Plateau(target, current, hold_s, ramp_s))
        position += step
        velocity = target
    segments.append(Rest(_EDGE_S, _ramp_s(velocity)))
    return Run(name, velocity_joint, tuple(segments))


def efficiency_runs(
    velocities_rad_s: Sequence[float] = VELOCITIES_RAD_S,
    hold_s: float = HOLD_S,
    currents_a: Sequence[float] | None = None,
    travel_rad: float = math.inf,
) -> tuple[Run, ...]:
    """Section II: a run per velocity, direction and kind of drive, each over the currents (default: the paper's).

    Slow and fast take turns, so that the joints' warming does not look like an effect of velocity; so do both
    directions and both joints, so that the bench does not wander off.
    """
    runs = []
    for velocity in slow_and_fast(velocities_rad_s):
        currents = currents_of(velocity) if currents_a is None else currents_a
        for drive, joint in DRIVES.items():
            for letter, sign in (("p", 1.0), ("n", -1.0)):
                points = [(sign * velocity, sign * current + 0.0) for current in currents]  # no "-0.0"
                runs.append(ladder(f"{drive}_{letter}{velocity:g}", joint, points, hold_s, travel_rad))
    return tuple(runs)


def validation_runs(hold_s: float = HOLD_S) -> tuple[Run, ...]:
    """Section IV.A: a run per velocity and kind of drive; every current in both directions, one after the other."""
    return tuple(
        ladder(
            f"constant_{drive}_{velocity:g}",
            joint,
            [(sign * velocity, sign * current) for current in currents for sign in (1.0, -1.0)],
            hold_s,
        )
        for velocity, currents in VALIDATION_POINTS.items()
        for drive, joint in DRIVES.items()
    )


def slow_and_fast(velocities: Sequence[float]) -> list[float]:
    """Smallest, largest, second smallest, second largest, ...: a fixed order without a trend."""
    rising = sorted(velocities)
    return [rising[n // 2] if n % 2 == 0 else rising[-1 - n // 2] for n in range(len(rising))]


def _ramp_s(step_rad_s: float) -> float:
    return max(RAMP_S, round(_RAMP_PER_RAD_S * abs(step_rad_s), 3))
