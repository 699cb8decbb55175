"""Runs of a joint that is moved alone, all others held.

No other joint commands its load: gravity and inertia do. Position, velocity and acceleration are limited by `motion_limits`
of its joint file or by --limits, the torque by its rating. A run begins and ends where the joint stands and goes as far to
either side. Where that does not fit into its travel, the joint is brought to the middle first (`approach`).

    plateaus       constant velocities in both directions over the same positions: friction over velocity
    trajectories   Eq. (10), chosen for the information about friction, inertia and gravity:
                   tau = Fc tanh(w / w0) + Fv w + J dw/dt + A sin q + B cos q + offset
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.sysid.motion.setpoints import PERIOD_S, Limits, MotionError, Setpoints
from jtqd.sysid.planner.design import (
    FINAL_RATE_HZ,
    SEARCH_RATE_HZ,
    Criterion,
    current_at,
    fundamentals,
    log_det,
    minimise,
    rounded_down,
    sequence,
    unit_motions,
)
from jtqd.sysid.planner.fourier import FourierTrajectory
from jtqd.sysid.planner.plan import BETWEEN_S, EDGE_S, Fourier, Plateau, Rest, Run, Segment, trajectory_run

NO_LIMIT: Final = 1e6
"""Default values of `MotionLimits`: unlimited."""
SHARE: Final = 0.9
"""Planned peaks as a part of the limits: a controller overshoots, and a limit that is met ends the run."""
FULL_SPEED_S: Final = 0.5
"""Time to the fastest velocity where nothing limits the acceleration."""
INERTIA_SHARE: Final = 0.25
"""Part of the allowed torque that accelerates rotor and link, as the joint file has them."""


# Limits ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MotionRange:
    """What a joint that is moved alone may do: `limits` of the commander, and the peak acceleration [rad/s2]."""

    limits: Limits
    acceleration_rad_s2: float

    @property
    def reach_rad(self) -> float:
        """Largest distance of a planned motion from its start."""
        low, high = self.limits.position_rad
        return 0.5 * SHARE * (high - low)

    @property
    def velocity_rad_s(self) -> float:
        """Fastest planned."""
        return SHARE * self.limits.velocity_rad_s


def range_of(number: int, joint: Joint, plan: Limits) -> MotionRange:
    """Return what joint `number` may do alone; plan: limits of the campaign, of which temperature and current hold here too.

    The current is what the joint needs for the allowed torque, against its own losses.

    Raises:
        ConfigError: travel or velocity are not limited.
    """
    missing = missing_limits(joint, "travel_rad", "velocity_rad_s")
    if missing:
        raise ConfigError(
            f"joint {number} ({joint.name}): found no {' and no '.join(missing)} in motion_limits of its joint file, "
            f"expected it there or as --limits {number}:travel_rad=LOW:HIGH,velocity_rad_s=V, because it is moved alone"
        )
    limits = joint.motion_limits or MotionLimits()
    low, high = limits.travel_rad
    torque = allowed_torque(joint)
    inertia = joint.gear_ratio**2 * joint.rotor_inertia_kgm2 + joint.link_inertia_kgm2
    acceleration = min(
        limits.acceleration_rad_s2, limits.velocity_rad_s / FULL_SPEED_S, INERTIA_SHARE * torque / inertia
    )
    return MotionRange(
        Limits(
            current_a=min(rounded_down(current_at(joint, torque, limits.velocity_rad_s)), plan.current_a),
            velocity_rad_s=limits.velocity_rad_s,
            torque_nm=torque,
            travel_rad=high - low,
            temperature_c=plan.temperature_c,
            position_rad=(low, high),
        ),
        acceleration,
    )


def missing_limits(joint: Joint, *names: str) -> list[str]:
    """Return which of these fields of its `motion_limits` do not limit a joint."""
    limits = joint.motion_limits or MotionLimits()
    return [name for name in names if float(np.max(np.abs(getattr(limits, name)))) >= NO_LIMIT]


def allowed_torque(joint: Joint) -> float:
    """Return the largest torque [Nm] of a joint: its rating, or less by its `motion_limits`."""
    limits = joint.motion_limits
    return joint.rated_torque_nm if limits is None else min(joint.rated_torque_nm, limits.torque_nm)


def tightest(given: Limits, own: Limits) -> Limits:
    """Return the tighter one of a plan's limits of a joint and those of its joint file, limit by limit.

    Raises:
        ConfigError: their travels have nothing in common.
    """
    low = max(given.position_rad[0], own.position_rad[0])
    high = min(given.position_rad[1], own.position_rad[1])
    if not low < high:
        raise ConfigError(
            f"alone.travel_rad: found {list(given.position_rad)}, expected a part of {list(own.position_rad)}, "
            "which motion_limits are"
        )
    smaller = {
        name: min(getattr(given, name), getattr(own, name))
        for name in ("current_a", "velocity_rad_s", "torque_nm", "temperature_c")
    }
    return Limits(**smaller, travel_rad=high - low, position_rad=(low, high))


def with_limits(joint: Joint, given: Mapping[str, Any] | None) -> Joint:
    """Return the joint with these values (--limits) in place of its file's `motion_limits`. Raises ConfigError."""
    if not given:
        return joint
    return replace(joint, motion_limits=replace(joint.motion_limits or MotionLimits(), **given))


def beyond_file(joint: Joint, given: Mapping[str, Any] | None) -> str:
    """Return which of these values (--limits) allow more than its file's `motion_limits`; "" for none."""
    wider = []
    for name, value in (given or {}).items():
        file = getattr(joint.motion_limits or MotionLimits(), name)
        if name == "travel_rad":
            if (value[0] < file[0] or value[1] > file[1]) and max(map(abs, file)) < NO_LIMIT:
                wider.append(f"{name} {value[0]:g}:{value[1]:g}, the file {file[0]:g}:{file[1]:g}")
        elif file < value:
            wider.append(f"{name} {value:g}, the file {file:g}")
    return "; ".join(wider)


def parsed_limits(text: str) -> dict[str, Any]:
    """Return the limits of a text such as "travel_rad=-0.5:0.5,velocity_rad_s=1". Raises ConfigError."""
    names = [item.name for item in fields(MotionLimits)]
    found: dict[str, Any] = {}
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        try:
            values = tuple(float(number) for number in value.split(":"))
        except ValueError:
            values = ()
        if name not in names or len(values) != (2 if name == "travel_rad" else 1):
            raise ConfigError(
                f"found {part.strip()!r}, expected travel_rad=LOW:HIGH or NAME=VALUE with one of {', '.join(names[1:])}"
            )
        found[name] = values if name == "travel_rad" else values[0]
    MotionLimits(**found)
    return found


# Runs -----------------------------------------------------------------------------------------------------------

LADDER: Final = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Plateaus, as parts of the fastest velocity."""
QUICK_LADDER: Final = (0.2, 0.5, 1.0)
LONGEST_PASS_S: Final = 6.0
SHORTEST_PASS_S: Final = 0.6
"""A shorter plateau cannot be used by `jtq fit`; such a velocity is left out."""
SECOND_LEVELS: Final = (0.1, 0.4, 1.0)
"""Peak of a run's second trajectory, as a part of the fastest: slow ones give most of the information."""
HARMONICS: Final = 5
SHORTEST_S: Final = 2.0
_DIRECTION_SHARE: Final = 0.02
"""w0 of the regressor, as a part of the fastest velocity."""
STEEPEST: Final = 1.875
"""Peak slope of the smooth step of a ramp, in steps per ramp."""
_TURN_WAY: Final = 0.344
"""Way in the first half of a smooth step from one direction to the other, in velocities times its time."""
_SHORTEST_RAMP_S: Final = 0.3


def plateau_run(number: int, motion: MotionRange, name: str, shares: Sequence[float] = LADDER) -> Run:
    """Return constant velocities (parts of the fastest) both ways: left, right, left and back.

    Each goes over as much of the travel as a pass may take. The ramps between two directions move the joint nowhere, and
    those at the ends half of their time.
    """
    segments: list[Segment] = [Rest(EDGE_S, 0.0)]
    for share in shares:
        speed = share * motion.velocity_rad_s
        ramp_s = max(round(STEEPEST * speed / motion.acceleration_rad_s2, 3), _SHORTEST_RAMP_S)
        turn_s = 2.0 * ramp_s
        reach = min(motion.reach_rad - _TURN_WAY * speed * turn_s, 0.5 * speed * LONGEST_PASS_S)
        edge_s = round(reach / speed - 0.5 * ramp_s, 3)
        if edge_s <= 0.0 or 2.0 * reach / speed < SHORTEST_PASS_S:
            continue
        pass_s = 2.0 * edge_s + ramp_s
        segments += [
            Plateau(-speed, 0.0, edge_s, ramp_s),
            Plateau(speed, 0.0, pass_s, turn_s),
            Plateau(-speed, 0.0, pass_s, turn_s),
            Plateau(speed, 0.0, edge_s, turn_s),
            Rest(0.3, ramp_s),
        ]
    segments.append(Rest(EDGE_S, 0.0))
    return Run(name, number, tuple(segments), None)


class _Trajectories:
    """Problem of a trajectory of one length and peak velocity; a genome is its amplitudes [2 H], scaled into the range."""

    dimension: Final = 2 * HARMONICS

    def __init__(self, motion: MotionRange, level: float, duration_s: float) -> None:
        self._motion, self._level, self._duration_s = motion, level, duration_s
        self._omega = fundamentals(duration_s)[0]
        self._coarse, self._fine = (
            unit_motions(
                self._omega,
                HARMONICS,
                duration_s,
                np.linspace(0.0, duration_s, round(duration_s * rate_hz) + 1),
            )
            for rate_hz in (SEARCH_RATE_HZ, FINAL_RATE_HZ)
        )

    def _scaled(self, genomes: FloatArray, grid: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
        """Return scales [m] and motions [3, m, n]."""
        own = self._motion
        motion = np.array([genomes @ each for each in grid])
        bounds = (own.reach_rad, self._level * own.velocity_rad_s, SHARE * own.acceleration_rad_s2)
        scale = np.min(
            [bound / peak for bound, peak in zip(bounds, np.abs(motion).max(axis=2), strict=True)], axis=0
        )
        return scale, motion * scale[:, None]

    def _information(self, motion: FloatArray) -> FloatArray:
        """Return the information [m, 6, 6] of motions [3, m, n], per sample."""
        q, w, a = motion
        fastest = self._motion.velocity_rad_s
        terms = (
            np.tanh(w / (_DIRECTION_SHARE * fastest)),
            w / fastest,
            a / self._motion.acceleration_rad_s2,
            np.sin(q),
            np.cos(q),
            np.ones_like(q),
        )
        x = np.stack(terms, axis=2)
        found: FloatArray = np.swapaxes(x, 1, 2) @ x / q.shape[1]
        return found

    def criterion(self, before: FloatArray) -> Criterion:
        """Return -log det of the information so far [6, 6] and that of each genome."""
        return lambda genomes: -log_det(before + self._information(self._scaled(genomes, self._coarse)[1]))

    def finish(self, genome: FloatArray, before: FloatArray) -> tuple[Fourier, FloatArray]:
        """Return the segment of a genome, scaled on the grid of the set-points, and the information so far with it."""
        scale, motion = self._scaled(genome[None, :], self._fine)
        amplitudes = tuple((float(scale[0]) * genome).tolist())
        trajectory = FourierTrajectory(
            self._omega, amplitudes[:HARMONICS], amplitudes[HARMONICS:], self._duration_s
        )
        return Fourier.alone(trajectory), before + self._information(motion)[0]


def trajectories(
    motion: MotionRange, levels: Sequence[float], duration_s: float, *, seed: int, evaluations: int
) -> list[Fourier]:
    """Return a trajectory for each level (peak as a part of the fastest velocity), the best one given those before it.

    evaluations: of each search; 1: drawn, not optimised. Raises ConfigError for runs that are too short.
    """
    if duration_s < SHORTEST_S:
        raise ConfigError(
            f"--seconds: found trajectories of {duration_s:g} s, expected at least {SHORTEST_S:g} s"
        )
    problems = (_Trajectories(motion, level, duration_s) for level in levels)
    designed = sequence(
        problems,
        lambda criterion, size, rng: minimise(criterion, size, evaluations=evaluations, rng=rng),
        seed=seed,
    )
    return [segment for segment, _ in designed]


def excitation_runs(
    number: int,
    motion: MotionRange,
    count: int,
    run_s: float,
    *,
    seed: int,
    evaluations: int,
    ladder: Sequence[float] = LADDER,
) -> tuple[Run, ...]:
    """Return the plateaus (`plateau_run`) and `count` runs of run_s [s] with two trajectories each.

    The first one uses all of the velocity, the second one a part of it (SECOND_LEVELS).
    """
    duration_s = round(0.5 * (run_s - 2.0 * EDGE_S - BETWEEN_S), 3)
    levels = [1.0] * count + [SECOND_LEVELS[k % len(SECOND_LEVELS)] for k in range(count)]
    made = trajectories(motion, levels, duration_s, seed=seed, evaluations=evaluations)
    runs = [
        trajectory_run(f"excitation_{k + 1:02d}", number, made[k], made[count + k], current_joint=None)
        for k in range(count)
    ]
    return plateau_run(number, motion, "plateaus", ladder), *runs


def variable_runs(
    number: int, motion: MotionRange, count: int, run_s: float, *, seed: int
) -> tuple[Run, ...]:
    """Return `count` runs of one drawn trajectory each, for validation only."""
    duration_s = round(run_s - 2.0 * EDGE_S, 3)
    made = trajectories(motion, [1.0] * count, duration_s, seed=seed, evaluations=1)
    return tuple(
        trajectory_run(f"variable_{k:02d}", number, each, current_joint=None)
        for k, each in enumerate(made, 1)
    )


APPROACH_SHARE: Final = 0.3
"""Largest velocity of an approach, as a part of its limit."""
APPROACH_S: Final = 1.0
"""Shortest ramp of an approach."""


def approach(joint: int, start_rad: float, target_rad: float, limits: Limits) -> Setpoints:
    """Return the motion of one joint, alone, from where it stands to another place, slowly; positions by its own encoder.

    Raises:
        MotionError: start or target are outside of its travel.
    """
    low, high = limits.position_rad
    for what, position in (("stands at", start_rad), ("shall go to", target_rad)):
        if not low <= position <= high:
            raise MotionError(
                f"joint {joint}: {what} {position:.3f} rad, travel_rad is {low:g} to {high:g}: move it by hand"
            )
    distance = target_rad - start_rad
    speed = min(APPROACH_SHARE * limits.velocity_rad_s, max(abs(distance) / APPROACH_S, 1e-6))
    ramp, hold = round(APPROACH_S / PERIOD_S), round((abs(distance) / speed - APPROACH_S) / PERIOD_S)
    rising = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, ramp + 1) / ramp)
    shape = np.concatenate((rising, np.ones(max(hold, 0)), rising[::-1], np.zeros(1)))
    velocity = shape * (distance / (float(shape.sum()) * PERIOD_S))
    return Setpoints(joint, velocity, np.zeros(len(velocity)), current_joint=None)
