"""Runs of a joint that is moved alone, all others held.

No other joint commands its load: gravity and inertia do. Position, velocity and acceleration are limited by `motion_limits`
of its joint file or by --limits, the torque by its rating. A run begins and ends where the joint stands and goes as far to
either side. Where that does not fit into its travel, the joint is brought to the middle first.

    plateaus       constant velocities in both directions over the same positions: friction over velocity
    trajectories   Eq. (10), chosen for the information about friction, inertia and gravity:
                   tau = Fc tanh(w / w0) + Fv w + J dw/dt + A sin q + B cos q + offset
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.planner.design import (
    FINAL_RATE_HZ,
    SEARCH_RATE_HZ,
    current_at,
    fundamentals,
    minimise,
    rounded_down,
)
from jtqd.sysid.planner.fourier import FourierTrajectory
from jtqd.sysid.planner.plan import Fourier, Plateau, Rest, Run, Segment, no_current

NO_LIMIT: Final = 1e6
"""Values of `MotionLimits` that were left out."""
SHARE: Final = 0.9
"""Planned peaks as a part of the limits: a controller overshoots, and a limit that is met ends the run."""
FULL_SPEED_S: Final = 0.5
"""Time to the fastest velocity where nothing limits the acceleration."""
INERTIA_SHARE: Final = 0.25
"""Part of the torque allowed that accelerates rotor and link, as the joint file has them."""
LADDER: Final = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Plateaus, as parts of the fastest velocity."""
QUICK_LADDER: Final = (0.2, 0.5, 1.0)
LONGEST_PASS_S: Final = 6.0
SHORTEST_PASS_S: Final = 0.6
"""A plateau that is shorter is none for `jtq fit`; such a velocity is left out."""
SECOND_LEVELS: Final = (0.1, 0.4, 1.0)
"""Peak of a run's second trajectory, as a part of the fastest: slow ones are most of what is to be learned."""
HARMONICS: Final = 5
EDGE_S: Final = 1.0
BETWEEN_S: Final = 2.0
SHORTEST_S: Final = 2.0
_DIRECTION_SHARE: Final = 0.02
"""w0 of the regressor, as a part of the fastest velocity."""
_STEEPEST: Final = 1.875
"""Peak slope of the smooth step of a ramp, in steps per ramp."""
_TURN_WAY: Final = 0.344
"""Way in the first half of a smooth step from one direction to the other, in velocities times its time."""
_SHORTEST_RAMP_S: Final = 0.3


@dataclass(frozen=True)
class Room:
    """What a joint that is moved alone may use: `limits` of the commander, and the steepest velocity [rad/s2]."""

    limits: Limits
    acceleration_rad_s2: float

    @property
    def reach_rad(self) -> float:
        """How far a planned motion goes to either side of its start."""
        low, high = self.limits.position_rad
        return 0.5 * SHARE * (high - low)

    @property
    def velocity_rad_s(self) -> float:
        """Fastest planned."""
        return SHARE * self.limits.velocity_rad_s


def tightest(given: Limits, room: Limits) -> Limits:
    """Return the tighter one of a plan's own limits of a joint and those of its joint file, limit by limit.

    Raises:
        ConfigError: their travels have nothing in common.
    """
    low = max(given.position_rad[0], room.position_rad[0])
    high = min(given.position_rad[1], room.position_rad[1])
    if not low < high:
        raise ConfigError(
            f"alone.travel_rad: found {list(given.position_rad)}, expected a part of {list(room.position_rad)}, "
            "which motion_limits are"
        )
    return Limits(
        current_a=min(given.current_a, room.current_a),
        velocity_rad_s=min(given.velocity_rad_s, room.velocity_rad_s),
        torque_nm=min(given.torque_nm, room.torque_nm),
        travel_rad=high - low,
        temperature_c=min(given.temperature_c, room.temperature_c),
        position_rad=(low, high),
    )


def allowed_torque(joint: Joint) -> float:
    """Return the largest torque [Nm] of a joint: its rating, or less where its `motion_limits` say so."""
    limits = joint.motion_limits
    return joint.rated_torque_nm if limits is None else min(joint.rated_torque_nm, limits.torque_nm)


def with_limits(joint: Joint, given: Mapping[str, Any] | None) -> Joint:
    """Return the joint with these values (--limits) in the place of its file's `motion_limits`. Raises ConfigError."""
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


def room_of(number: int, joint: Joint, plan: Limits) -> Room:
    """Return what joint `number` may do alone; plan: limits of the campaign, of which temperature and current hold here too.

    The current is what the joint needs for the torque allowed, against its own losses.

    Raises:
        ConfigError: travel or velocity are not limited.
    """
    limits = joint.motion_limits or MotionLimits()
    low, high = limits.travel_rad
    missing = [
        name
        for name, unlimited in (
            ("travel_rad", max(abs(low), abs(high)) >= NO_LIMIT),
            ("velocity_rad_s", limits.velocity_rad_s >= NO_LIMIT),
        )
        if unlimited
    ]
    if missing:
        raise ConfigError(
            f"joint {number} ({joint.name}): found no {' and no '.join(missing)} in motion_limits of its joint file, "
            f"expected it there or as --limits {number}:travel_rad=LOW:HIGH,velocity_rad_s=V, because it is moved alone"
        )
    torque = allowed_torque(joint)
    inertia = joint.gear_ratio**2 * joint.rotor_inertia_kgm2 + joint.link_inertia_kgm2
    acceleration = min(
        limits.acceleration_rad_s2, limits.velocity_rad_s / FULL_SPEED_S, INERTIA_SHARE * torque / inertia
    )
    return Room(
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


def ladder_run(number: int, room: Room, name: str, shares: Sequence[float] = LADDER) -> Run:
    """Return constant velocities (parts of the fastest) both ways: left, right, left and back.

    Each goes over as much of the travel as a pass may take. The ramps between two directions move the joint nowhere, and
    those at the ends half of their time.
    """
    segments: list[Segment] = [Rest(EDGE_S, 0.0)]
    for share in shares:
        speed = share * room.velocity_rad_s
        ramp_s = max(round(_STEEPEST * speed / room.acceleration_rad_s2, 3), _SHORTEST_RAMP_S)
        turn_s = 2.0 * ramp_s
        reach = min(room.reach_rad - _TURN_WAY * speed * turn_s, 0.5 * speed * LONGEST_PASS_S)
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
    """Trajectories of one length and peak velocity, scaled into the room; a genome is their amplitudes [2 H]."""

    def __init__(self, room: Room, level: float, duration_s: float) -> None:
        self._room, self._level, self._duration_s = room, level, duration_s
        self._omega = fundamentals(duration_s)[0]
        self._coarse, self._fine = self._grid(SEARCH_RATE_HZ), self._grid(FINAL_RATE_HZ)

    def _grid(self, rate_hz: float) -> tuple[FloatArray, ...]:
        time_s = np.linspace(0.0, self._duration_s, round(self._duration_s * rate_hz) + 1)
        units = np.eye(2 * HARMONICS).tolist()
        each = [self._trajectory(tuple(unit)).motion(time_s) for unit in units]
        return tuple(np.array([one[order] for one in each]) for order in range(3))

    def _trajectory(self, amplitudes: tuple[float, ...]) -> FourierTrajectory:
        return FourierTrajectory(
            self._omega, amplitudes[:HARMONICS], amplitudes[HARMONICS:], self._duration_s
        )

    def _scaled(self, genomes: FloatArray, grid: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
        """Return scales [m] and motions [3, m, n]."""
        room = self._room
        motion = np.array([genomes @ each for each in grid])
        largest = np.abs(motion).max(axis=2)
        bounds = (room.reach_rad, self._level * room.velocity_rad_s, SHARE * room.acceleration_rad_s2)
        scale = np.min([bound / peak for bound, peak in zip(bounds, largest, strict=True)], axis=0)
        return scale, motion * scale[:, None]

    def criterion(self, before: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return -log det of the information so far [6, 6] and that of each genome."""

        def value(genomes: FloatArray) -> FloatArray:
            return -_log_det(before + self._information(self._scaled(genomes, self._coarse)[1]))

        return value

    def _information(self, motion: FloatArray) -> FloatArray:
        """Return the information [m, 6, 6] of motions [3, m, n], per sample."""
        q, w, a = motion
        fastest = self._room.velocity_rad_s
        terms = (
            np.tanh(w / (_DIRECTION_SHARE * fastest)),
            w / fastest,
            a / self._room.acceleration_rad_s2,
            np.sin(q),
            np.cos(q),
            np.ones_like(q),
        )
        x = np.stack(terms, axis=2)
        found: FloatArray = np.swapaxes(x, 1, 2) @ x / q.shape[1]
        return found

    def made(self, genome: FloatArray) -> tuple[Fourier, FloatArray]:
        """Return the segment of a genome, scaled on the grid of the set-points, and its information [6, 6]."""
        scale, motion = self._scaled(genome[None, :], self._fine)
        velocity = self._trajectory(tuple((float(scale[0]) * genome).tolist()))
        return Fourier(velocity, no_current(velocity)), self._information(motion)[0]


def _log_det(information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.slogdet(information + 1e-9 * np.eye(information.shape[-1]))[1])


def trajectories(
    room: Room, levels: list[float], duration_s: float, *, seed: int, evaluations: int
) -> Iterator[Fourier]:
    """Yield a trajectory for each level (peak as a part of the fastest velocity), each the best beside those before it.

    evaluations: of each search; 1: drawn, chosen by nothing. Raises ConfigError for runs that are too short.
    """
    if duration_s < SHORTEST_S:
        raise ConfigError(
            f"--seconds: found trajectories of {duration_s:g} s, expected at least {SHORTEST_S:g} s"
        )
    information: FloatArray = np.zeros((6, 6))
    for k, level in enumerate(levels):
        task = _Trajectories(room, level, duration_s)
        found = minimise(
            task.criterion(information),
            2 * HARMONICS,
            evaluations=evaluations,
            rng=np.random.default_rng([seed, k]),
        )
        segment, own = task.made(found.genome)
        information = information + own
        yield segment


def excitation_runs(
    number: int,
    room: Room,
    count: int,
    run_s: float,
    *,
    seed: int,
    evaluations: int,
    ladder: Sequence[float] = LADDER,
) -> tuple[Run, ...]:
    """Return the plateaus (`ladder_run`) and `count` runs of run_s [s] with two trajectories each.

    The first one uses all of the velocity, the second one a part of it (SECOND_LEVELS).
    """
    duration_s = round(0.5 * (run_s - 2.0 * EDGE_S - BETWEEN_S), 3)
    levels = [1.0] * count + [SECOND_LEVELS[k % len(SECOND_LEVELS)] for k in range(count)]
    made = list(trajectories(room, levels, duration_s, seed=seed, evaluations=evaluations))
    runs = [
        Run(
            f"excitation_{k + 1:02d}",
            number,
            (Rest(EDGE_S, 0.0), made[k], Rest(BETWEEN_S, 0.0), made[count + k], Rest(EDGE_S, 0.0)),
            None,
        )
        for k in range(count)
    ]
    return ladder_run(number, room, "plateaus", ladder), *runs


def variable_runs(number: int, room: Room, count: int, run_s: float, *, seed: int) -> tuple[Run, ...]:
    """Return `count` runs of one drawn trajectory each, never to be trained on."""
    duration_s = round(run_s - 2.0 * EDGE_S, 3)
    made = trajectories(room, [1.0] * count, duration_s, seed=seed, evaluations=1)
    return tuple(
        Run(f"variable_{k:02d}", number, (Rest(EDGE_S, 0.0), each, Rest(EDGE_S, 0.0)), None)
        for k, each in enumerate(made, 1)
    )
