"""Runs at varying velocity and load: Fourier trajectories to train on, and others to judge by. Pure.

The trajectories come from `sysid.excitation_design`. Those of `excitation_runs` are optimised for what they tell about
the losses; those of `variable_runs` are drawn, because a judge must not be chosen by what it is to judge.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Final

from estimator.checked import ConfigError
from estimator.parameters import Joint
from sysid.campaign.plan import Fourier, Rest, Run, Segment
from sysid.excitation_design import Design, ExcitationLimits, design, draw
from sysid.motion.limits import Limits

Joints = tuple[Joint, Joint] | None
"""Velocity joint and driving joint of the design; None: those that ship. Either order serves, the joints being alike."""
Tried = Callable[[int], None]
"""Told the number of motions that have been tried since the last call."""

FULL_RAD_S: Final = 3.0
MEDIUM_RAD_S: Final = 1.2
SLOW_RAD_S: Final = 0.3
"""Most of a trajectory with this peak lies below 0.2 rad/s, where friction is most of what is to be learned."""
CURRENT_A: Final = 5.0
JOINT_CURRENT_A: Final = 8.0
"""Of the velocity joint, by the model of the design: rated current of the bench's drives, which limit theirs at 9 A."""
_LIMIT_SHARE: Final = 0.9
"""Planned peaks as a part of the plan's limits: a controller overshoots, and a limit that is met ends the run."""

EDGE_S: Final = 1.0
BETWEEN_S: Final = 2.0
"""At rest between two trajectories: section III of the paper."""
SHORTEST_S: Final = 2.0
"""Of one trajectory: below it, acceleration limits leave nothing of the velocity."""
HARMONICS: Final = 5

_SECOND_LEVELS: Final = (SLOW_RAD_S, MEDIUM_RAD_S, FULL_RAD_S)


def excitation_runs(
    limits: Limits,
    count: int,
    run_s: float,
    *,
    seed: int,
    evaluations: int,
    joints: Joints = None,
    on_progress: Tried | None = None,
) -> tuple[Run, ...]:
    """Section III: `count` runs of two trajectories each with 2 s of rest between; run_s [s] is a run's length.

    The first trajectory of a run uses all of the velocity, the second one is slow, medium or fast in turn; the velocity
    joint alternates.

    Raises:
        ConfigError: runs too short for two trajectories.
    """
    duration_s = _trajectory_s(run_s, (2.0 * EDGE_S + BETWEEN_S), 2)
    levels = [FULL_RAD_S] * count + [_second_level(k) for k in range(count)]
    fourier: dict[int, Fourier] = {}
    for level in dict.fromkeys(levels):
        places = [k for k, each in enumerate(levels) if each == level]
        chosen = seed_of("excitation", level, seed)
        made = design(
            _design_limits(limits, level),
            count=len(places),
            duration_s=duration_s,
            harmonics=HARMONICS,
            seed=chosen,
            evaluations=evaluations,
            joints=joints,
            on_progress=on_progress,
        )
        fourier.update(zip(places, map(_segment, made), strict=True))
    return tuple(
        Run(
            f"excitation_{k + 1:02d}",
            1 + k % 2,
            (*_rests(EDGE_S), fourier[k], *_rests(BETWEEN_S), fourier[count + k], *_rests(EDGE_S)),
        )
        for k in range(count)
    )


def variable_runs(
    limits: Limits, count: int, run_s: float, *, seed: int, joints: Joints = None
) -> tuple[Run, ...]:
    """Section IV.B: `count` runs of one trajectory each, never to be trained on; the velocity joint alternates.

    Raises:
        ConfigError: runs too short for a trajectory.
    """
    duration_s = _trajectory_s(run_s, 2.0 * EDGE_S, 1)
    chosen = seed_of("variable", FULL_RAD_S, seed)
    made = draw(
        _design_limits(limits, FULL_RAD_S),
        count=count,
        duration_s=duration_s,
        harmonics=HARMONICS,
        seed=chosen,
        joints=joints,
    )
    return tuple(
        Run(f"variable_{k + 1:02d}", 1 + k % 2, (*_rests(EDGE_S), _segment(one), *_rests(EDGE_S)))
        for k, one in enumerate(made)
    )


def outside_runs(
    limits: Limits, count: int, run_s: float, *, seed: int, joints: Joints = None
) -> tuple[Run, ...]:
    """Runs with half as much load again as any other campaign has: what no model has been trained on.

    Raises:
        ConfigError: runs too short for a trajectory.
    """
    wanted = ExcitationLimits(
        velocity_rad_s=FULL_RAD_S,
        travel_rad=_LIMIT_SHARE * limits.travel_rad,
        current_a=1.5 * CURRENT_A,
        joint_current_a=1.5 * JOINT_CURRENT_A,
        torque_nm=_LIMIT_SHARE * limits.torque_nm,
    )
    chosen = seed_of("outside", FULL_RAD_S, seed)
    made = draw(
        wanted,
        count=count,
        duration_s=_trajectory_s(run_s, 2.0 * EDGE_S, 1),
        harmonics=HARMONICS,
        seed=chosen,
        joints=joints,
    )
    return tuple(
        Run(f"outside_{k + 1:02d}", 1 + k % 2, (*_rests(EDGE_S), _segment(one), *_rests(EDGE_S)))
        for k, one in enumerate(made)
    )


def seed_of(purpose: str, level: float, seed: int) -> int:
    """A seed of 32 bits for each purpose and level: no two of them share their random numbers, whatever `seed` is."""
    digest = hashlib.sha256(f"{purpose}/{level!r}/{seed}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _second_level(run: int) -> float:
    """Changes after each pair of runs, so that either joint is the velocity joint at every level."""
    return _SECOND_LEVELS[run // 2 % len(_SECOND_LEVELS)]


def _trajectory_s(run_s: float, rests_s: float, trajectories: int) -> float:
    duration_s = round((run_s - rests_s) / trajectories, 3)
    if duration_s < SHORTEST_S:
        raise ConfigError(
            f"--seconds: found {run_s:g}, expected at least {rests_s + trajectories * SHORTEST_S:g} "
            f"({trajectories} of {SHORTEST_S:g} s and {rests_s:g} s of rest)"
        )
    return duration_s


def _rests(hold_s: float) -> tuple[Segment, ...]:
    return (Rest(hold_s, 0.0),)  # it begins at rest: nothing to ramp


def _segment(made: Design) -> Fourier:
    return Fourier(made.velocity, made.current)


def _design_limits(limits: Limits, peak_rad_s: float) -> ExcitationLimits:
    """Well within the plan's limits, so that none of them ends a run."""
    return ExcitationLimits(
        velocity_rad_s=min(peak_rad_s, _LIMIT_SHARE * limits.velocity_rad_s),
        travel_rad=_LIMIT_SHARE * limits.travel_rad,
        current_a=min(CURRENT_A, _LIMIT_SHARE * limits.current_a),
        joint_current_a=min(JOINT_CURRENT_A, _LIMIT_SHARE * limits.current_a),
        torque_nm=_LIMIT_SHARE * limits.torque_nm,
    )
