"""The campaigns that ship, efficiency, excitation and validate, for the joints of a bus that are moved together or alone.

Two joints that share a channel of the torque sensor are on a towing bench, and so are those that --towing names. Every other
joint is moved alone (`single_joint`). Each unit has its runs one after the other.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.planner import single_joint
from jtqd.sysid.planner.design import ExcitationLimits, design, starts_of
from jtqd.sysid.planner.plan import (
    BETWEEN_S,
    DEFAULT_LIMITS,
    EDGE_S,
    Fourier,
    Off,
    Plan,
    Point,
    Run,
    run_over,
    trajectory_run,
)
from jtqd.sysid.planner.single_joint import HARMONICS, SHORTEST_S, MotionRange, range_of

# Joints that are moved together ---------------------------------------------------------------------------------

Pair = tuple[int, int]


@dataclass(frozen=True)
class Unit:
    """Joints that are moved together, by number, rising; measured: each has a channel of the torque sensor."""

    joints: tuple[int, ...]
    measured: bool

    @property
    def name(self) -> str:
        """Of its runs: "joint_3", "joints_3_4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''}_{'_'.join(map(str, self.joints))}"

    @property
    def title(self) -> str:
        """For people: "joint 3", "joints 3 and 4"."""
        return f"joint{'s' if len(self.joints) > 1 else ''} {' and '.join(map(str, self.joints))}"

    def refusal(self, kind: str) -> str:
        """Return why a campaign of this kind has no runs of these joints; "" where it has."""
        if kind == "efficiency" and len(self.joints) == 1:
            return (
                "no efficiency: a second joint on a towing bench must set the load (--towing A,B for two that are on one); "
                "jtq campaign excitation moves a joint alone"
            )
        if kind != "excitation" and not self.measured:
            what = "efficiency" if kind == "efficiency" else "validation"
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
    """Return the units of a bus in the order of their first joints.

    channels: of the sensor, for joints 1, 2, ...; sensor: there is one. towing: pairs that the operator has coupled.

    Raises:
        ConfigError: a pair of joints that are not there, or of which one is in another pair.
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

    Raises ConfigError naming the run.
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
    """Return one run: from rest over all points (velocity [rad/s], current [A]), each held for hold_s, back to rest.

    Before a point that would take the joint further than travel_rad from where the run began (with room to stop in), it
    turns back there without load.
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

    Slow and fast take turns, so that the joints' warming does not look like an effect of velocity; so do both
    directions and both joints, so that the bench does not wander off.
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
    """Section III: `count` runs of two trajectories each with 2 s of rest between; run_s [s] is a run's length.

    The first trajectory of a run uses all of the velocity, the second one is slow, medium or fast in turn; the velocity
    joint alternates.

    Raises:
        ConfigError: runs too short for two trajectories.
    """
    duration_s = _trajectory_s(run_s, (2.0 * EDGE_S + BETWEEN_S), 2)
    # the second level changes after each pair of runs, so that either joint is the velocity joint at every level
    levels = [FULL_RAD_S] * count + [_SECOND_LEVELS[k // 2 % len(_SECOND_LEVELS)] for k in range(count)]
    fourier: dict[int, Fourier] = {}
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

    Raises:
        ConfigError: runs too short for a trajectory.
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

    Raises:
        ConfigError: runs too short for a trajectory.
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
    """Return a seed of 32 bits for a purpose and level: no two of them share their random numbers, whatever `seed` is."""
    digest = hashlib.sha256(f"{purpose}/{level!r}/{seed}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _trajectory_s(run_s: float, rests_s: float, trajectories: int) -> float:
    duration_s = round((run_s - rests_s) / trajectories, 3)
    if duration_s < SHORTEST_S:
        raise ConfigError(
            f"--seconds: found {run_s:g}, expected at least {rests_s + trajectories * SHORTEST_S:g} "
            f"({trajectories} of {SHORTEST_S:g} s and {rests_s:g} s of rest)"
        )
    return duration_s


def _design_limits(limits: Limits, peak_rad_s: float) -> ExcitationLimits:
    """Well within the plan's limits, so that none of them ends a run."""
    return ExcitationLimits(
        velocity_rad_s=min(peak_rad_s, _LIMIT_SHARE * limits.velocity_rad_s),
        travel_rad=_LIMIT_SHARE * limits.travel_rad,
        current_a=min(CURRENT_A, _LIMIT_SHARE * limits.current_a),
        joint_current_a=min(JOINT_CURRENT_A, _LIMIT_SHARE * limits.current_a),
        torque_nm=_LIMIT_SHARE * limits.torque_nm,
    )


# Campaigns ------------------------------------------------------------------------------------------------------

KINDS: Final = ("efficiency", "excitation", "validate")
RUNS: Final = 24
QUICK_RUNS: Final = 4
ALONE_RUNS: Final = 12
QUICK_ALONE_RUNS: Final = 2
"""Of a joint that is moved alone."""
EVALUATIONS: Final = 1000
QUICK_EVALUATIONS: Final = 160
_QUICK_VELOCITIES: Final = (0.4, 1.4, 2.4)
_QUICK_CURRENTS: Final = (1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Scale:
    """Size of a campaign; None: as in the paper, or small with `quick`.

    Attributes:
        runs: number of Fourier runs. seconds: length of one. hold_s: of a point at constant velocity.
        seed: of the trajectories. evaluations: of each search.
        quick: a small campaign of the same kind: enough points for every fit, too few for a good one.
        limits: of the plan; the Fourier runs stay well within them.
        joints: of the bench, for the torque of a motion; None: those that ship.
    """

    runs: int | None = None
    seconds: float | None = None
    hold_s: float | None = None
    seed: int = 0
    evaluations: int | None = None
    quick: bool = False
    limits: Limits = DEFAULT_LIMITS
    joints: Joints = None

    def or_else(self, name: str, whole: Any, quick: Any) -> Any:
        """Return the value of an option: as given, else by the size of the campaign."""
        given = getattr(self, name)
        return given if given is not None else quick if self.quick else whole

    @property
    def motions_tried(self) -> int:
        """Number of motions that an excitation campaign tries before it begins."""
        evaluations: int = self.or_else("evaluations", EVALUATIONS, QUICK_EVALUATIONS)
        runs: int = self.or_else("runs", RUNS, QUICK_RUNS)
        return 2 * runs * starts_of(evaluations) * evaluations


def make_plan(kind: str, scale: Scale, on_progress: OnTried | None = None) -> Plan:
    """Return the plan of one of KINDS for joints 1 and 2 on a towing bench.

    on_progress: called with the number of motions tried, `scale.motions_tried` in all.

    Raises:
        ConfigError: a scale that leaves nothing to be driven.
    """
    limits, hold_s = scale.limits, scale.or_else("hold_s", HOLD_S, 1.0)
    count = scale.or_else("runs", RUNS, QUICK_RUNS)
    if kind == "efficiency":
        velocities = _QUICK_VELOCITIES if scale.quick else VELOCITIES_RAD_S
        currents = _QUICK_CURRENTS if scale.quick else None
        runs = efficiency_runs(velocities, hold_s, currents, limits.travel_rad)
    elif kind == "excitation":
        runs = excitation_runs(
            limits,
            count,
            scale.or_else("seconds", 24.0, 10.0),
            seed=scale.seed,
            evaluations=scale.or_else("evaluations", EVALUATIONS, QUICK_EVALUATIONS),
            joints=scale.joints,
            on_progress=on_progress,
        )
    else:
        seconds = scale.or_else("seconds", 12.0, 6.0)
        drawn = variable_runs(limits, count, seconds, seed=scale.seed, joints=scale.joints)
        runs = validation_runs(hold_s) + drawn
    return Plan(kind, limits, runs)


def make_plan_of(
    kind: str,
    units: Sequence[Unit],
    joints: Sequence[Joint],
    scale: Scale,
    on_progress: OnTried | None = None,
) -> Plan:
    """Return the plan of one of KINDS for all units of a bus that can be moved so; joints: files of joints 1, 2, ...

    Raises:
        ConfigError: nothing to be driven, or a joint that is moved alone without limits.
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
    count: int = scale.or_else("runs", ALONE_RUNS, QUICK_ALONE_RUNS)
    seed = seed_of(f"alone/{kind}", float(number), scale.seed)
    if kind == "validate":
        seconds = scale.or_else("seconds", 12.0, 6.0)
        return single_joint.variable_runs(number, motion, count, seconds, seed=seed)
    return single_joint.excitation_runs(
        number,
        motion,
        count,
        scale.or_else("seconds", 24.0, 10.0),
        seed=seed,
        evaluations=scale.or_else("evaluations", EVALUATIONS, QUICK_EVALUATIONS),
        ladder=single_joint.QUICK_LADDER if scale.quick else single_joint.LADDER,
    )
