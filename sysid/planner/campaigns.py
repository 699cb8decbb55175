"""The campaigns that ship (efficiency, excitation, quick, validate), for joints of a bus that are moved together or alone.

Two joints that share a channel of the torque sensor are on a towing bench, and so are those that --towing names. Every other
joint is moved alone. Each unit has its runs one after the other.

Runs at constant velocity and load are those of section II of the paper (efficiency) and of its section IV.A (validation).
Runs at varying velocity and load are Fourier trajectories (`design`). Those of `excitation_runs` are optimised for the
information about the losses. Those of `variable_runs` are drawn: a validation must not depend on what it validates.

Signs. Each joint has its own frame. The links turn oppositely, and a positive current of either joint gives a positive
torque in the sensor. With equal signs of the velocity joint's velocity and the other joint's current, the velocity joint
drives forward (its own current and velocity have the same sign) and the other joint is driven back. "forward_1" means that
joint 1 is the velocity joint, "back_1" that joint 2 is. For joint 2 the names read the other way round.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.sysid.motion.setpoints import (
    PERIOD_S,
    STEEPEST_CURRENT_A_S,
    STEEPEST_VELOCITY_RAD_S2,
    Limits,
    MotionError,
    Setpoints,
)
from jtqd.sysid.planner.design import (
    HARMONICS,
    SHORTEST_TRAJECTORY_S,
    ExcitationLimits,
    MotionRange,
    current_at,
    design,
    rounded_down,
    starts_of,
    trajectories,
)
from jtqd.sysid.planner.plan import (
    BETWEEN_S,
    DEFAULT_LIMITS,
    EDGE_S,
    Fourier,
    Off,
    Plan,
    Plateau,
    Point,
    Rest,
    Run,
    Segment,
    run_over,
    trajectory_run,
)

# Joints that are moved together ---------------------------------------------------------------------------------

Pair = tuple[int, int]


@dataclass(frozen=True)
class Unit:
    """Joints that are moved together, by number, rising; measured: each has a channel of the torque sensor."""

    joints: tuple[int, ...]
    measured: bool

    @property
    def title(self) -> str:
        """For people: "joint 3", "joints 3 and 4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''} {' and '.join(map(str, self.joints))}"

    @property
    def name(self) -> str:
        """Of its runs: "joint_3", "joints_3_4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''}_{'_'.join(map(str, self.joints))}"

    def refusal(self, kind: str) -> str:
        """Return why a campaign of this kind has no runs of these joints; "" where it has."""
        if kind == "efficiency" and len(self.joints) == 1:
            return (
                "no efficiency: a second joint on a towing bench must set the load (--towing A,B for two that are on one); "
                "jtq campaign excitation moves a joint alone"
            )
        if kind == "quick" and len(self.joints) == 1:
            return "no quick motions: a second joint on a towing bench must set the load (--towing A,B)"
        if kind != "excitation" and not self.measured:
            what = {"efficiency": "efficiency", "quick": "quick motions"}.get(kind, "validation")
            reference = "without a channel of the torque sensor, which is the reference"
            return f"no {what} {reference}; jtq campaign excitation needs none"
        return ""

    @property
    def purpose(self) -> str:
        """What its runs can identify."""
        if not self.measured:
            return (
                "no torque sensor: current, motion and temperature are recorded; jtq fit and jtq diagnose need a known load "
                "(jN.load of a column map)"
            )
        if len(self.joints) == 1:
            return (
                "moved alone: losses and torsion under the loads of gravity and inertia (jtq fit losses, jtq diagnose); no "
                "efficiency under other loads"
            )
        return "on a towing bench: efficiency, losses, torsion"


def unit_lines(units: Iterable[Unit], text_of: Callable[[Unit], str]) -> list[str]:
    """Return a line for all units with the same text; nothing for an empty text."""
    of: dict[str, list[str]] = {}
    for unit in units:
        of.setdefault(text_of(unit), []).append(unit.title)
    return [f"{'; '.join(titles)}: {text}" for text, titles in of.items() if text]


def units_of(channels: Sequence[int | None], sensor: bool, towing: Iterable[Pair] = ()) -> tuple[Unit, ...]:
    """Return the units of a bus by their first joints; channels: of the sensor, for joints 1, 2, ...; towing: coupled
    by the operator. Raises ConfigError for a pair of joints that are not there, or of which one is in another pair.
    """
    shared: dict[int, list[int]] = {}
    for number, channel in enumerate(channels, 1):
        if sensor and channel is not None:
            shared.setdefault(channel, []).append(number)
    pairs: dict[int, Pair] = {}
    for pair in dict.fromkeys([*((min(each), max(each)) for each in towing), *_pairs(shared.values())]):
        for number in pair:
            if not 1 <= number <= len(channels):
                raise ConfigError(
                    f"--towing: found joint {number}, expected joints of the bus, 1 to {len(channels)}"
                )
            if number in pairs:
                one, two = (sum(each) - number for each in (pairs[number], pair))
                raise ConfigError(
                    f"found joint {number} coupled with joints {one} and {two}, expected one (sensor_channel, --towing)"
                )
        pairs |= dict.fromkeys(pair, pair)
    return tuple(
        Unit(joints, sensor and all(channels[each - 1] is not None for each in joints))
        for number in range(1, len(channels) + 1)
        if (joints := pairs.get(number, (number,)))[0] == number
    )


def _pairs(groups: Iterable[list[int]]) -> Iterator[Pair]:
    for group in groups:
        if len(group) > 2:
            raise ConfigError(
                f"found one sensor_channel for joints {', '.join(map(str, group))}, expected two joints at most"
            )
        if len(group) == 2:
            yield group[0], group[1]


def check_joints(plan: Plan, units: Sequence[Unit]) -> None:
    """Refuse a plan that moves joints as they are not coupled, or takes the power from a bus with others to hold.
    Raises ConfigError.
    """
    of = {number: unit for unit in units for number in unit.joints}
    for run in plan.runs:
        for number in run.joints:
            if number not in of:
                raise ConfigError(
                    f"run '{run.name}': found joint {number}, expected joints of the bus, 1 to {len(of)}"
                )
        unit = of[run.velocity_joint]
        if run.joints == unit.joints:
            if len(unit.joints) < len(of) and any(isinstance(each, Off) for each in run.segments):
                raise ConfigError(
                    f"run '{run.name}': found power_off, expected none where other joints must be held"
                )
        elif run.current_joint is None:
            raise ConfigError(
                f"run '{run.name}': found joint {run.velocity_joint} moved alone, expected a run of {unit.title}: they are "
                "coupled"
            )
        else:
            one, two = run.joints
            raise ConfigError(
                f"run '{run.name}': found joints {one} and {two} driven against each other, expected joints that share a "
                f"channel of the torque sensor; --towing {one},{two} for two that are coupled on a bench"
            )


# Constant velocity and load -------------------------------------------------------------------------------------

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
"""Longer ramps for larger steps: 5.4 rad/s^2 at most, 7.5 Nm for both rotors of the bench on top of the load."""
_PLATEAU_EDGE_S: Final = 0.5
_TRAVEL_SHARE: Final = 0.95
"""Part of the travel limit that is used: the joint overshoots a little."""


def plateau_run(
    name: str,
    velocity_joint: int,
    points: Iterable[tuple[float, float]],
    hold_s: float,
    travel_rad: float = math.inf,
) -> Run:
    """Return one run over all points (velocity [rad/s], current [A]), each held for hold_s.

    Before a point that would take the joint further than travel_rad from the start (with room to stop in), it turns
    back there without load.
    """
    return run_over(name, velocity_joint, _turned_back(points, hold_s, travel_rad), _ramp_s, _PLATEAU_EDGE_S)


def _turned_back(points: Iterable[tuple[float, float]], hold_s: float, travel_rad: float) -> Iterator[Point]:
    """Yield the points and those that turn back; a smooth ramp covers the mean of its velocities times its length."""
    velocity = position = 0.0
    for target, current in points:
        step = 0.5 * (velocity + target) * _ramp_s(target - velocity) + target * hold_s
        to_stop = 0.5 * target * _ramp_s(target)
        if position and abs(position + step + to_stop) > _TRAVEL_SHARE * travel_rad:
            back = -math.copysign(abs(target), position)
            position += 0.5 * (velocity + back) * _ramp_s(back - velocity)
            ramp_out = 0.5 * (back + target) * _ramp_s(target - back)
            hold_back_s = max(round(-(position + ramp_out) / back, 3), 0.0)
            yield back, 0.0, hold_back_s
            position += back * hold_back_s
            step = ramp_out + target * hold_s
        yield target, current, hold_s
        position += step
        velocity = target


def _ramp_s(step_rad_s: float) -> float:
    return max(RAMP_S, round(_RAMP_PER_RAD_S * abs(step_rad_s), 3))


def currents_of(velocity_rad_s: float) -> tuple[float, ...]:
    """Return magnitudes of the driving joint's currents [A] at a velocity, by section II."""
    return CURRENTS_A if abs(velocity_rad_s) <= FAST_RAD_S else CURRENTS_A[:-1]


def efficiency_runs(
    velocities_rad_s: Sequence[float] = VELOCITIES_RAD_S,
    hold_s: float = HOLD_S,
    currents_a: Sequence[float] | None = None,
    travel_rad: float = math.inf,
) -> tuple[Run, ...]:
    """Section II: a run per velocity, direction and kind of drive, each over the currents (default: the paper's).

    Slow and fast, both directions and both joints take turns, so that warming does not look like an effect of velocity.
    """
    runs = []
    for velocity in slow_and_fast(velocities_rad_s):
        currents = currents_of(velocity) if currents_a is None else currents_a
        for drive, joint in DRIVES.items():
            for letter, sign in (("p", 1.0), ("n", -1.0)):
                points = [(sign * velocity, sign * current + 0.0) for current in currents]  # no "-0.0"
                runs.append(plateau_run(f"{drive}_{letter}{velocity:g}", joint, points, hold_s, travel_rad))
    return tuple(runs)


def validation_runs(hold_s: float = HOLD_S) -> tuple[Run, ...]:
    """Section IV.A: a run per velocity and kind of drive; every current in both directions, one after the other."""
    return tuple(
        plateau_run(
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


# Varying velocity and load --------------------------------------------------------------------------------------

Joints = tuple[Joint, Joint] | None
"""Velocity joint and driving joint of the design; None: those that ship. Either order serves, the joints being alike."""
OnTried = Callable[[int], None]
"""Called with the number of motions that have been tried since the last call."""

FULL_RAD_S: Final = 3.0
MEDIUM_RAD_S: Final = 1.2
SLOW_RAD_S: Final = 0.3
"""Most of a trajectory with this peak lies below 0.2 rad/s, where friction dominates."""
CURRENT_A: Final = 5.0
_QUICK_A: Final = 4.0
JOINT_CURRENT_A: Final = 8.0
"""Of the velocity joint, by the model of the design: rated current of the bench's drives, which limit theirs at 9 A."""
_LIMIT_SHARE: Final = 0.9
"""Planned peaks as a part of the plan's limits: a controller overshoots, and a limit that is met ends the run."""
_SECOND_LEVELS: Final = (SLOW_RAD_S, MEDIUM_RAD_S, FULL_RAD_S)


def excitation_runs(
    limits: Limits,
    count: int,
    run_s: float,
    *,
    seed: int,
    evaluations: int,
    joints: Joints = None,
    on_progress: OnTried | None = None,
) -> tuple[Run, ...]:
    """Section III: `count` runs of run_s [s] with two trajectories each.

    The first one uses all of the velocity, the second one is slow, medium or fast in turn; the velocity joint
    alternates. Raises ConfigError for runs that are too short.
    """
    duration_s = _trajectory_s(run_s, (2.0 * EDGE_S + BETWEEN_S), 2)
    # the second level changes after each pair of runs, so that either joint is the velocity joint at every level
    levels = [FULL_RAD_S] * count + [_SECOND_LEVELS[k // 2 % len(_SECOND_LEVELS)] for k in range(count)]
    fourier: dict[int, Fourier] = {}  # by place in `levels`
    for level in dict.fromkeys(levels):
        places = [k for k, each in enumerate(levels) if each == level]
        made = design(
            _design_limits(limits, level),
            count=len(places),
            duration_s=duration_s,
            harmonics=HARMONICS,
            seed=seed_of("excitation", level, seed),
            evaluations=evaluations,
            joints=joints,
            on_progress=on_progress,
        )
        fourier.update(zip(places, (one.segment for one in made), strict=True))
    return tuple(
        trajectory_run(f"excitation_{k + 1:02d}", 1 + k % 2, fourier[k], fourier[count + k])
        for k in range(count)
    )


def variable_runs(
    limits: Limits, count: int, run_s: float, *, seed: int, joints: Joints = None
) -> tuple[Run, ...]:
    """Section IV.B: `count` runs of one drawn trajectory each, for validation only; the velocity joint alternates.
    Raises ConfigError for runs that are too short.
    """
    drawn = seed_of("variable", FULL_RAD_S, seed)
    wanted = _design_limits(limits, FULL_RAD_S)
    return _drawn_runs("variable", wanted, count, run_s, seed=drawn, joints=joints)


def outside_runs(
    limits: Limits,
    count: int,
    run_s: float,
    *,
    seed: int,
    joints: Joints = None,
    load: float = 1.5,
    velocity_rad_s: float = FULL_RAD_S,
) -> tuple[Run, ...]:
    """Return runs outside of every training range: `load` times the currents of other campaigns, or a higher velocity.
    Raises ConfigError for runs that are too short.
    """
    wanted = ExcitationLimits(
        velocity_rad_s=velocity_rad_s,
        acceleration_rad_s2=velocity_rad_s / FULL_RAD_S * ExcitationLimits().acceleration_rad_s2,
        travel_rad=_LIMIT_SHARE * limits.travel_rad,
        current_a=load * CURRENT_A,
        joint_current_a=load * JOINT_CURRENT_A,
        torque_nm=_LIMIT_SHARE * limits.torque_nm,
    )
    drawn = seed_of("outside", velocity_rad_s, seed)
    return _drawn_runs("outside", wanted, count, run_s, seed=drawn, joints=joints)


def quick_runs(limits: Limits, count: int, run_s: float, *, seed: int) -> tuple[Run, ...]:
    """Return `count` runs that are quicker than a trajectory, in turn: squares of velocity, steps of current at rest, steps
    of current in motion. A network of the current path that has not seen such motions errs by newton metres in them.
    """
    most, load = _LIMIT_SHARE * limits.velocity_rad_s, min(_QUICK_A, _LIMIT_SHARE * limits.current_a)

    def run(k: int) -> Run:
        rng = np.random.default_rng(seed_of("quick", float(k), seed))
        speed = (1.0, 0.0, 0.5)[k % 3] * float(rng.uniform(0.3, 1.0)) * min(FULL_RAD_S, most)
        way = limits.travel_rad / max(4.0 * speed, 1e-9)
        hold_s = round(min((float(rng.uniform(0.2, 0.8)), 0.5, 0.6)[k % 3], way), 3)
        number = max(int(run_s / (hold_s + 0.1)), 4)
        held: list[Segment] = []
        velocity = current = position = 0.0
        for n in range(number + 6):
            turns = k % 3 == 0 or n == number + 3 or (rng.random() < 0.3 and n < number)
            turns = turns or abs(position) > 0.25 * limits.travel_rad
            sign = -math.copysign(1.0, position or velocity) if turns else math.copysign(1.0, velocity)
            before = velocity, current
            velocity = sign * (speed if speed or n < number else min(0.2 * most, 0.1 * limits.travel_rad))
            current = float(rng.uniform(-load, load))
            ramps = (
                abs(velocity - before[0]) / STEEPEST_VELOCITY_RAD_S2,
                abs(current - before[1]) / STEEPEST_CURRENT_A_S,
            )
            held.append(Plateau(velocity, current, hold_s, math.ceil(2e3 * max(ramps)) * 1e-3))
            position += velocity * hold_s
        return Run(f"quick_{k + 1:02d}", 1 + k % 2, (Rest(EDGE_S, 0.0), *held, Rest(EDGE_S, 0.3)))

    return tuple(map(run, range(count)))


def _drawn_runs(
    name: str, limits: ExcitationLimits, count: int, run_s: float, *, seed: int, joints: Joints
) -> tuple[Run, ...]:
    made = design(
        limits,
        count=count,
        duration_s=_trajectory_s(run_s, 2.0 * EDGE_S, 1),
        harmonics=HARMONICS,
        seed=seed,
        evaluations=1,
        joints=joints,
    )
    return tuple(trajectory_run(f"{name}_{k + 1:02d}", 1 + k % 2, one.segment) for k, one in enumerate(made))


def seed_of(purpose: str, level: float, seed: int) -> int:
    """Return a seed of 32 bits: no two purposes or levels share their random numbers, whatever `seed` is."""
    digest = hashlib.sha256(f"{purpose}/{level!r}/{seed}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _trajectory_s(run_s: float, rests_s: float, trajectories: int) -> float:
    duration_s = round((run_s - rests_s) / trajectories, 3)
    if duration_s < SHORTEST_TRAJECTORY_S:
        raise ConfigError(
            f"--seconds: found {run_s:g}, expected at least {rests_s + trajectories * SHORTEST_TRAJECTORY_S:g} "
            f"({trajectories} of {SHORTEST_TRAJECTORY_S:g} s and {rests_s:g} s of rest)"
        )
    return duration_s


def _design_limits(limits: Limits, peak_rad_s: float) -> ExcitationLimits:
    return ExcitationLimits(
        velocity_rad_s=min(peak_rad_s, _LIMIT_SHARE * limits.velocity_rad_s),
        travel_rad=_LIMIT_SHARE * limits.travel_rad,
        current_a=min(CURRENT_A, _LIMIT_SHARE * limits.current_a),
        joint_current_a=min(JOINT_CURRENT_A, _LIMIT_SHARE * limits.current_a),
        torque_nm=_LIMIT_SHARE * limits.torque_nm,
    )


# One joint ------------------------------------------------------------------------------------------------------

NO_LIMIT: Final = 1e6
"""Default values of `MotionLimits`: unlimited."""
FULL_SPEED_S: Final = 0.5
"""Time to the fastest velocity where nothing limits the acceleration."""
INERTIA_SHARE: Final = 0.25
"""Part of the allowed torque that accelerates rotor and link, as the joint file has them."""


def range_of(number: int, joint: Joint, plan: Limits) -> MotionRange:
    """Return what joint `number` may do alone; plan: limits of the campaign, for temperature and current.

    The current is what the joint needs for the allowed torque against its own losses. Raises ConfigError where travel
    or velocity are not limited.
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
    """Return the tighter one of a plan's limits of a joint and those of its joint file, limit by limit. Raises
    ConfigError where their travels have nothing in common.
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


LADDER: Final = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Plateaus, as parts of the fastest velocity."""
QUICK_LADDER: Final = (0.2, 0.5, 1.0)
LONGEST_PASS_S: Final = 6.0
SHORTEST_PASS_S: Final = 0.6
"""A shorter plateau cannot be used by `jtq fit`; such a velocity is left out."""
SECOND_LEVELS: Final = (0.1, 0.4, 1.0)
"""Peak of a run's second trajectory, as a part of the fastest: slow ones give most of the information."""
STEEPEST: Final = 1.875
"""Peak slope of the smooth step of a ramp, in steps per ramp."""
_TURN_WAY: Final = 0.344
"""Way in the first half of a smooth step from one direction to the other, in velocities times its time."""
_SHORTEST_RAMP_S: Final = 0.3


def joint_plateau_run(number: int, motion: MotionRange, name: str, shares: Sequence[float] = LADDER) -> Run:
    """Return constant velocities (parts of the fastest) both ways: left, right, left and back, over as much of the
    travel as a pass may take.

    The ramps between two directions move the joint nowhere, those at the ends half of their time.
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


APPROACH_SHARE: Final = 0.3
"""Largest velocity of an approach, as a part of its limit."""
APPROACH_S: Final = 1.0
"""Shortest ramp of an approach."""


def approach(joint: int, start_rad: float, target_rad: float, limits: Limits) -> Setpoints:
    """Return the slow motion of one joint from where it stands to another place; positions by its own encoder. Raises
    MotionError for start or target outside of its travel.
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


# Campaigns ------------------------------------------------------------------------------------------------------

KINDS: Final = ("efficiency", "excitation", "quick", "validate")
_SIZES: Final = {
    "runs": (24, 4),
    "alone runs": (12, 2),
    "hold_s": (HOLD_S, 1.0),
    "excitation seconds": (24.0, 10.0),
    "validate seconds": (12.0, 6.0),
    "quick runs": (6, 3),
    "quick seconds": (12.0, 6.0),
    "evaluations": (1000, 160),
}
"""Of a campaign as in the paper, and of a quick one: every kind of run, few of each."""
_QUICK_VELOCITIES: Final = (0.4, 1.4, 2.4)
_QUICK_CURRENTS: Final = (1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Scale:
    """Size of a campaign; None: by _SIZES.

    runs, seconds: number and length of Fourier runs; hold_s: of a point at constant velocity; evaluations: of each search;
    limits: of the plan, the Fourier runs stay well within them; joints: of the bench, None: those that ship.
    """

    runs: int | None = None
    seconds: float | None = None
    hold_s: float | None = None
    seed: int = 0
    evaluations: int | None = None
    quick: bool = False
    limits: Limits = DEFAULT_LIMITS
    joints: Joints = None

    def value(self, name: str, of: str = "") -> Any:
        """Return an option as given, else by the size of the campaign; of: what it belongs to in _SIZES."""
        given = getattr(self, name)
        return _SIZES[f"{of} {name}".strip()][self.quick] if given is None else given

    @property
    def motions_tried(self) -> int:
        """Number of motions that an excitation campaign tries before it begins."""
        evaluations: int = self.value("evaluations")
        runs: int = self.value("runs")
        return 2 * runs * starts_of(evaluations) * evaluations


def make_plan(kind: str, scale: Scale, on_progress: OnTried | None = None) -> Plan:
    """Return the plan of one of KINDS for joints 1 and 2 on a towing bench; on_progress: `scale.motions_tried` in all.

    Raises ConfigError for a scale that leaves nothing to be driven.
    """
    limits, hold_s = scale.limits, scale.value("hold_s")
    if kind == "efficiency":
        velocities = _QUICK_VELOCITIES if scale.quick else VELOCITIES_RAD_S
        currents = _QUICK_CURRENTS if scale.quick else None
        return Plan(kind, limits, efficiency_runs(velocities, hold_s, currents, limits.travel_rad))
    if kind == "quick":
        made = quick_runs(limits, scale.value("runs", kind), scale.value("seconds", kind), seed=scale.seed)
        return Plan(kind, limits, made)
    count, seconds = scale.value("runs"), scale.value("seconds", kind)
    if kind == "validate":
        drawn = variable_runs(limits, count, seconds, seed=scale.seed, joints=scale.joints)
        return Plan(kind, limits, validation_runs(hold_s) + drawn)
    runs = excitation_runs(
        limits,
        count,
        seconds,
        seed=scale.seed,
        evaluations=scale.value("evaluations"),
        joints=scale.joints,
        on_progress=on_progress,
    )
    return Plan(kind, limits, runs)


def make_plan_of(
    kind: str,
    units: Sequence[Unit],
    joints: Sequence[Joint],
    scale: Scale,
    on_progress: OnTried | None = None,
) -> Plan:
    """Return the plan of one of KINDS for all units of a bus that can be moved so; joints: files of joints 1, 2, ...
    Raises ConfigError where there is nothing to be driven, or for a joint that is moved alone without limits.
    """
    able = [unit for unit in units if not unit.refusal(kind)]
    if not able:
        raise ConfigError("; ".join(unit_lines(units, lambda unit: unit.refusal(kind))))
    if [unit.joints for unit in units] == [(1, 2)]:
        return make_plan(kind, replace(scale, joints=(joints[0], joints[1])), on_progress)
    runs: list[Run] = []
    limits: dict[int, Limits] = {}
    for unit in able:
        if len(unit.joints) == 2:
            one, two = unit.joints
            of_pair = replace(scale, joints=(joints[one - 1], joints[two - 1]))
            runs += [_driven_by(run, unit) for run in make_plan(kind, of_pair, on_progress).runs]
            continue
        [number] = unit.joints
        motion = range_of(number, joints[number - 1], scale.limits)
        limits[number] = motion.limits
        runs += [replace(run, name=f"{unit.name}_{run.name}") for run in _alone(kind, number, motion, scale)]
    return Plan(kind, scale.limits, tuple(runs), limits)


def _driven_by(run: Run, unit: Unit) -> Run:
    """Return a run of joints 1 and 2 as one of another pair; forward and back drive are seen from its first joint."""
    one, two = unit.joints
    name = run.name.replace("forward_1", f"forward_{one}").replace("back_1", f"back_{one}")
    mover, driver = (one, two) if run.velocity_joint == 1 else (two, one)
    return Run(f"{unit.name}_{name}", mover, run.segments, driver)


def _alone(kind: str, number: int, motion: MotionRange, scale: Scale) -> tuple[Run, ...]:
    """Return the runs of a joint that is moved alone; two trajectories in each one of an excitation, one for validation."""
    count: int = scale.value("runs", "alone")
    run_s: float = scale.value("seconds", kind)
    seed = seed_of(f"alone/{kind}", float(number), scale.seed)
    if kind == "validate":
        duration_s = round(run_s - 2.0 * EDGE_S, 3)
        drawn = trajectories(motion, [1.0] * count, duration_s, seed=seed, evaluations=1)
        return tuple(
            trajectory_run(f"variable_{k:02d}", number, each, current_joint=None)
            for k, each in enumerate(drawn, 1)
        )
    duration_s = round(0.5 * (run_s - 2.0 * EDGE_S - BETWEEN_S), 3)
    levels = [1.0] * count + [SECOND_LEVELS[k % len(SECOND_LEVELS)] for k in range(count)]
    evaluations = scale.value("evaluations")
    made = trajectories(motion, levels, duration_s, seed=seed, evaluations=evaluations)
    plateaus = joint_plateau_run(number, motion, "plateaus", QUICK_LADDER if scale.quick else LADDER)
    runs = [
        trajectory_run(f"excitation_{k + 1:02d}", number, made[k], made[count + k], current_joint=None)
        for k in range(count)
    ]
    return plateaus, *runs
