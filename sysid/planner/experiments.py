"""Motions that separate effects: of two joints on a towing bench as runs of a plan, of one joint as positions over time.

On a towing bench one joint keeps a velocity, the other one loads it with a current; `PairRange` limits both. A joint that
is not on a bench has no second joint that loads it: its load comes from gravity, and from a payload where the text asks for
one. Its motions are positions over time at RATE_HZ within `JointRange`, for any controller. All moves are from rest to
rest; ramps of the velocity are half waves of a cosine:

    ramp [s] = pi v / (2 a)            way = v (ramp + plateau)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import LossModel
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.planner.campaigns import LADDER, STEEPEST, allowed_torque, seed_of
from jtqd.sysid.planner.design import OVER, STEPS, Bench, ExcitationLimits, current_at, design, rounded_down
from jtqd.sysid.planner.plan import (
    EDGE_S,
    Off,
    Plateau,
    Point,
    Rest,
    Run,
    Segment,
    run_over,
    trajectory_run,
)

# Two joints on a towing bench -----------------------------------------------------------------------------------

VELOCITY_RAD_S: Final = 2.0
"""Default of the fastest motion; joint files have no rated velocity."""
TEMPERATURE_C: Final = 70.0
_TORQUE_SHARE: Final = 0.7
"""Planned torque as a part of the rated one: it rings at a reversal under load (docs/fit.md)."""
_CURRENT_SHARE: Final = 0.85
_INERTIA_SHARE: Final = 0.25
"""Part of the rated torque that accelerates both rotors."""
_RAMP_S: Final = 0.4
_GENTLE: Final = 0.5
"""Part of the acceleration for changes between plateaus, which give no information."""
_ROLES: Final = (1, 2)
_TURN_RAD: Final = 2.0 * math.pi
_FOURIER_S: Final = 20.0
_OFF_S: Final = 2.5
"""Of a rest without power, switching off and on included."""


@dataclass(frozen=True)
class PairRange:
    """What the runs of an experiment may use of two coupled joints.

    The current limit is the current for the rated torque against the joint's own losses. The planned motion stays well
    below both: the file may be wrong in the very value that the experiment identifies.

    limits: of the plan but for travel; velocity_rad_s: fastest plateau; acceleration_rad_s2: steepest change of it;
    own_current_a: largest planned current of joint 1 and of joint 2.
    """

    joints: tuple[Joint, Joint]
    limits: Limits
    velocity_rad_s: float
    acceleration_rad_s2: float
    own_current_a: tuple[float, float]

    def load_of(self, velocity_joint: int, velocity_rad_s: float | None = None) -> float:
        """Return the largest current [A] of the other joint at any velocity up to this one (None: the fastest; 0:
        standing).

        Torque and the velocity joint's own current stay within their bounds in both directions. Standing, its torque is
        at most that of its current.
        """
        speed = self.velocity_rad_s if velocity_rad_s is None else velocity_rad_s
        mover, driver = self.joints[velocity_joint - 1], self.joints[2 - velocity_joint]
        bound = _TORQUE_SHARE * self.limits.torque_nm
        nm_per_a = LossModel(driver).torque_per_ampere
        most = min(self.own_current_a[2 - velocity_joint], OVER * bound / nm_per_a)
        if speed == 0.0:
            return min(most, bound / nm_per_a)
        bench = Bench(mover, driver)
        currents = np.linspace(0.0, most, STEPS)
        good = np.ones(STEPS, bool)
        for share in (-1.0, -0.1, 0.1, 1.0):
            velocity, still = np.full(STEPS, share * speed), np.zeros(STEPS)
            low, high = bench.torque_range(self.own_current_a[velocity_joint - 1], velocity, still)
            torque = bench.torque(currents, velocity, still)
            good &= (np.abs(torque) <= bound) & (low <= torque) & (torque <= high)
        return float(currents[max(int(np.argmin(good)) - 1, 0)] if not good.all() else most)

    def ramp_s(self, step_rad_s: float, shortest_s: float = _RAMP_S) -> float:
        """Return the length of a ramp between two plateaus."""
        needed = STEEPEST * abs(step_rad_s) / (_GENTLE * self.acceleration_rad_s2)
        return round(max(shortest_s, needed), 3)


def pair_range_of(
    joints: Mapping[int, Joint], *, velocity_rad_s: float = VELOCITY_RAD_S, temperature: bool = True
) -> PairRange:
    """Return what two coupled joints can do within the `motion_limits` of their files but for travel; one joint alone
    is taken to face one like itself.

    joints: by number, at least one (ValueError); the first two count. temperature: whether the drives measure theirs.
    """
    if not joints:
        raise ValueError("joints: found none, expected one or two")
    files = [joints[number] for number in sorted(joints)][:2]
    pair = (files[0], files[-1])
    rated = min(map(allowed_torque, pair))
    bounds = [joint.motion_limits for joint in pair if joint.motion_limits is not None]
    velocity_rad_s = min([velocity_rad_s, *(each.velocity_rad_s for each in bounds)])
    currents = [current_at(joint, rated, velocity_rad_s) for joint in pair]
    limits = Limits(
        current_a=rounded_down(max(currents)),
        velocity_rad_s=rounded_down(1.15 * velocity_rad_s),
        torque_nm=rated,
        travel_rad=1.0,
        temperature_c=TEMPERATURE_C if temperature else math.inf,
    )
    rotors = sum(j.gear_ratio**2 * j.rotor_inertia_kgm2 + j.link_inertia_kgm2 for j in pair)
    acceleration = min(20.0, _INERTIA_SHARE * rated / (0.5 * rotors))
    acceleration = min([acceleration, *(each.acceleration_rad_s2 for each in bounds)])
    own = [_CURRENT_SHARE * min(current, limits.current_a) for current in currents]
    return PairRange(pair, limits, velocity_rad_s, acceleration, (own[0], own[1]))


Runs = Mapping[str, tuple[Segment, ...]]
"""Segments of the runs of an experiment by what distinguishes their names."""


def _over(reach: PairRange, points: Iterable[Point], ramp_s: float = _RAMP_S) -> tuple[Segment, ...]:
    """From rest over all points, each held after a ramp that the joints can follow, back to rest."""
    rounded = [(velocity, round(current, 4), round(hold_s, 3)) for velocity, current, hold_s in points]
    return run_over("", 1, rounded, lambda step: reach.ramp_s(step, ramp_s), EDGE_S).segments


def _turned_unloaded(points: Sequence[Point]) -> list[Point]:
    """Remove the load before each reversal and apply it again after it: a reversal under load rings."""
    result: list[Point] = []
    for before, (velocity, current, hold_s) in zip(((0.0, 0.0, 0.0), *points), points, strict=False):
        if velocity * before[0] < 0.0 and (current or before[1]):
            result += [(before[0], 0.0, 0.1), (velocity, 0.0, 0.1)]
        result.append((velocity, current, hold_s))
    return result


def _fourier(reach: PairRange, count: int, purpose: str) -> list[tuple[Segment, ...]]:
    limits = ExcitationLimits(
        velocity_rad_s=reach.velocity_rad_s,
        acceleration_rad_s2=reach.acceleration_rad_s2,
        travel_rad=20.0,
        current_a=min(reach.load_of(role) for role in _ROLES),
        joint_current_a=min(reach.own_current_a),
        torque_nm=0.75 * reach.limits.torque_nm,
    )
    seed = seed_of(purpose, reach.velocity_rad_s, 0)
    drawn = design(limits, count=count, duration_s=_FOURIER_S, seed=seed, evaluations=1, joints=reach.joints)
    return [trajectory_run("", 1, one.segment).segments for one in drawn]


def _pair_excitation(reach: PairRange, role: int) -> Runs:
    first, second = _fourier(reach, 4, "diagnosis excitation")[2 * (role - 1) : 2 * role]
    return {"1": first, "2": second}


def _pair_repeat(reach: PairRange, role: int) -> Runs:
    motion = _fourier(reach, 2, "diagnosis repeat")[role - 1]
    return {"1": motion, "2": motion, "3": motion}


def _both_ways(reach: PairRange, speeds: Sequence[float], load: float) -> Runs:
    """Each speed in both directions, without load and with one of either sign."""
    runs = {}
    for name, current in (("idle", 0.0), ("pull", load), ("push", -load)):
        points = [(s * v, current, 1.5) for v in speeds for s in (1.0, -1.0)]
        runs[name] = _over(reach, points)
    return runs


def _pair_speed_ladder(reach: PairRange, role: int) -> Runs:
    speeds = [share * reach.velocity_rad_s for share in (0.04, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)]
    return _both_ways(reach, speeds, 0.5 * reach.load_of(role))


def _pair_slow_reversals(reach: PairRange, role: int) -> Runs:
    # the last ones show the Coulomb friction by itself
    speeds = (0.04, 0.055, 0.075, 0.1, 0.14, 0.2, 0.35, 0.5 * reach.velocity_rad_s)
    return _both_ways(reach, speeds, 0.6 * reach.load_of(role, speeds[-1]))


def _pair_both_directions(reach: PairRange, role: int) -> Runs:
    """All loads up and down at one velocity, then the same the other way round: the same torques in both directions."""
    shares = (0.0, 0.25, 0.5, 0.75, 1.0, 0.6, 0.2, -0.2, -0.6, -1.0, -0.75, -0.5, -0.25, 0.0)
    runs = {}
    for name, part in (("1", 0.15), ("2", 0.5)):
        speed = part * reach.velocity_rad_s
        highest = reach.load_of(role, speed)
        runs[name] = _over(
            reach, [(s * speed, share * highest, 0.8) for s in (1.0, -1.0) for share in shares]
        )
    return runs


def _pair_load_ramp(reach: PairRange, role: int) -> Runs:
    """Standing, loads up and down: three sizes, three rates. The joint creeps first, so that it stands unloaded."""
    highest = reach.load_of(role, 0.0)
    runs = {}
    for name, ramp_s in (("1", 0.3), ("2", 1.0), ("3", 3.0)):
        points = [(0.2, 0.0, 0.5), (-0.2, 0.0, 0.5), (0.0, 0.0, 0.5)]
        for share in (0.35, 0.7, 1.0, 0.35) if ramp_s < 2.0 else (0.35, 1.0):
            points += [(0.0, sign * share * highest, 0.2) for sign in (1.0, -1.0, 1.0, -1.0)]
            points.append((0.0, 0.0, 0.3))
        runs[name] = _over(reach, points, ramp_s)
    return runs


def _pair_full_turns(reach: PairRange, role: int) -> Runs:
    runs = {}
    for name, part in (("1", 0.4), ("2", 0.65)):
        speed = part * reach.velocity_rad_s
        load = 0.9 * reach.load_of(role, speed)
        points = [(s * speed, i, 1.2 * _TURN_RAD / speed) for i in (0.0, load, -load) for s in (1.0, -1.0)]
        runs[name] = _over(reach, _turned_unloaded(points))
    return runs


def _pair_quick_changes(reach: PairRange, role: int) -> Runs:
    """Velocity back and forth at rising rates without and with load, then load back and forth at constant velocity."""
    load = 0.4 * reach.load_of(role)
    start = Rest(EDGE_S, 0.0)
    runs: dict[str, tuple[Segment, ...]] = {}
    for name, current in (("idle", 0.0), ("loaded", load)):
        changes: list[Segment] = []
        for share in (0.25, 0.5, 1.0):
            speed = 0.3 * reach.velocity_rad_s
            ramp_s = round(STEEPEST * 2.0 * speed / (share * reach.acceleration_rad_s2), 3)
            changes += [Plateau(s * speed, current, 0.05, ramp_s) for s in (1.0, -1.0) * 6]
        runs[name] = (start, *changes, Rest(EDGE_S, _RAMP_S))
    swing: list[Segment] = []
    for s in (1.0, -1.0):
        speed = s * 0.4 * reach.velocity_rad_s
        swing.append(Plateau(speed, 0.0, 0.3, reach.ramp_s(speed)))
        for ramp_s in (0.4, 0.2, 0.1, 0.06):
            swing += [Plateau(speed, round(sign * load, 4), 0.1, ramp_s) for sign in (1.0, -1.0) * 2]
        swing.append(Rest(0.3, _RAMP_S))
    return runs | {"load": (start, *swing)}


def _pair_warm_up(reach: PairRange, role: int) -> Runs:
    """One long run: a check, then fast and loaded back and forth, a check again, and so on while the joints warm."""
    fast, load = reach.velocity_rad_s, reach.load_of(role)
    check: list[Point] = [(0.0, 0.0, 2.0)]
    check += [(s * v * fast, 0.0, 1.0) for v in (0.15, 0.5, 1.0) for s in (1.0, -1.0)]
    check += [(s * 0.25 * fast, i * load, 1.0) for i in (0.8, -0.8) for s in (1.0, -1.0)]
    warm: list[Point] = [(s * fast, s * 0.8 * load, 6.0) for s in (1.0, -1.0)] * 6
    return {"": _over(reach, _turned_unloaded((check + warm) * 5 + check))}


def _pair_zero_reading(reach: PairRange, role: int) -> Runs:
    """Rests with the drives switched off, each reached from the other direction, with slow turning between."""
    speed = 0.2 * reach.velocity_rad_s
    ramp_s = reach.ramp_s(speed)
    segments: list[Segment] = [Rest(EDGE_S, 0.0), Off(_OFF_S)]
    for s in (1.0, -1.0) * 3:
        segments += [Plateau(s * speed, 0.0, 2.0, ramp_s), Rest(0.5, ramp_s), Off(_OFF_S)]
    return {"1": tuple(segments), "2": tuple(segments)}


# One joint ------------------------------------------------------------------------------------------------------

RATE_HZ: Final = 100.0
_REST_S: Final = 1.0
_SHORTEST_PASS_S: Final = 0.5
_SLOW: Final = (0.02, 0.03, 0.05, 0.08, 0.12, 0.5)
_EMPTY: Final = "without payload"
_LOADED: Final = "with a payload"


@dataclass(frozen=True)
class JointRange:
    """What a motion may use, joint side: low..high [rad], velocity [rad/s], acceleration [rad/s2]; torque_nm: allowed;
    needed_nm: most that earlier runs needed between low and high, NaN without runs.
    """

    low_rad: float
    high_rad: float
    velocity_rad_s: float
    acceleration_rad_s2: float
    torque_nm: float
    needed_nm: float

    @property
    def middle_rad(self) -> float:
        """Start and end of every motion."""
        return 0.5 * (self.low_rad + self.high_rad)

    @property
    def span_rad(self) -> float:
        """From low to high."""
        return self.high_rad - self.low_rad


@dataclass(frozen=True)
class Motion:
    """One run: name, condition for people (payload); time_s, position_rad, velocity_rad_s [n], joint side."""

    name: str
    what: str
    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray

    @property
    def duration_s(self) -> float:
        """Length of the run."""
        return float(self.time_s[-1])


Move = tuple[float, float, float, float]
"""Target [rad], speed [rad/s], acceleration [rad/s2], rest after it [s]."""


def _played(name: str, what: str, joint: JointRange, moves: Iterable[Move]) -> Motion:
    """From rest at the middle over all moves to rest."""
    step = 1.0 / RATE_HZ
    velocity = [np.zeros(round(_REST_S * RATE_HZ))]
    at = joint.middle_rad
    for target, speed, acceleration, rest_s in moves:
        way = target - at
        top = min(speed, math.sqrt(2.0 * acceleration * abs(way) / math.pi))
        if top > 0.0:
            # rounded up: neither speed nor acceleration is exceeded
            ramp = max(math.ceil(0.5 * math.pi * top / acceleration * RATE_HZ), 2)
            plateau = max(math.ceil((abs(way) / top) * RATE_HZ) - ramp, 0)
            up = 0.5 * (1.0 - np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp))
            shape = np.concatenate((up, np.ones(plateau), up[::-1]))
            velocity.append(shape * (way / (np.sum(shape) * step)))
        velocity.append(np.zeros(round(rest_s * RATE_HZ)))
        at = target
    velocity.append(np.zeros(round(_REST_S * RATE_HZ)))
    whole = np.concatenate(velocity)
    position = joint.middle_rad + np.concatenate(([0.0], np.cumsum(0.5 * (whole[1:] + whole[:-1])))) * step
    return Motion(name, what, step * np.arange(len(whole), dtype=np.float64), position, whole)


def _ladder(joint: JointRange, shares: Iterable[float]) -> list[Move]:
    """Both ways at each speed, a part of the fastest: over as much of the travel as half a minute takes, or not at all."""
    moves: list[Move] = []
    a = joint.acceleration_rad_s2
    for share in shares:
        speed = share * joint.velocity_rad_s
        half = min(0.5 * joint.span_rad, 0.5 * speed * 12.0)
        if half < 0.5 * speed * _SHORTEST_PASS_S:
            continue
        moves += [(joint.middle_rad + s * half, speed, a, 0.3) for s in (-1.0, 1.0, -1.0, 1.0)]
    moves.append((joint.middle_rad, 0.5 * joint.velocity_rad_s, a, 0.0))
    return moves


Motions = Mapping[str, tuple[str, Sequence[Move]]]
"""Condition for people and moves of the motions of an experiment, by what distinguishes their names."""


def _joint_excitation(joint: JointRange) -> Motions:
    """Random targets, speeds and rests from a fixed seed: every position in both directions at several speeds."""
    made = {}
    for k in (1, 2, 3, 4):
        rng = np.random.default_rng(k)
        moves = [
            (
                float(rng.uniform(joint.low_rad, joint.high_rad)),
                float(rng.uniform(0.2, 1.0)) * joint.velocity_rad_s,
                float(rng.uniform(0.3, 1.0)) * joint.acceleration_rad_s2,
                float(rng.choice([0.0, 0.3])),
            )
            for _ in range(24)
        ]
        made[str(k)] = (_EMPTY if k < 3 else _LOADED, moves)
    return made


def _joint_repeat(joint: JointRange) -> Motions:
    moves = _ladder(joint, (0.2, 0.5, 1.0))
    return {str(k): ("the same motion again", moves) for k in (1, 2, 3, 4)}


def _both_payloads(shares: Sequence[float]) -> Callable[[JointRange], Motions]:
    return lambda joint: {
        f"{k}_{label}": (what, _ladder(joint, shares))
        for k in (1, 2)
        for label, what in (("empty", _EMPTY), ("loaded", _LOADED))
    }


def _joint_load_ramp(joint: JointRange) -> Motions:
    """Standing at five positions, each reached from both sides: gravity is the load that goes up and down."""
    at = np.linspace(joint.low_rad, joint.high_rad, 5)
    speed, a = 0.3 * joint.velocity_rad_s, 0.5 * joint.acceleration_rad_s2
    moves = [(float(q), speed, a, 2.0) for q in (*at, *at[::-1])]
    return {"empty": (_EMPTY, moves), "loaded": (_LOADED, moves)}


def _joint_quick_changes(joint: JointRange) -> Motions:
    made = {}
    for name, share in (("1", 0.3), ("2", 0.6), ("3", 1.0)):
        a = share * joint.acceleration_rad_s2
        half = min(0.25 * joint.span_rad, 0.5 * joint.velocity_rad_s**2 / a)
        moves = [(joint.middle_rad + s * half, joint.velocity_rad_s, a, 0.0) for s in (-1.0, 1.0) * 10]
        made[name] = (_EMPTY, moves)
    return made


def _joint_warm_up(joint: JointRange) -> Motions:
    check = _ladder(joint, (0.1, 0.3, 1.0))
    a = joint.acceleration_rad_s2
    work: list[Move] = [(q, joint.velocity_rad_s, a, 0.0) for q in (joint.low_rad, joint.high_rad)] * 30
    moves = (check + work) * 4 + check
    return dict.fromkeys(("1", "2"), ("from cold, without a break", moves))


def _joint_zero_reading(joint: JointRange) -> Motions:
    """Two stops of 5 s, each reached from both sides; the brake holds."""
    a, speed = 0.5 * joint.acceleration_rad_s2, 0.3 * joint.velocity_rad_s
    moves: list[Move] = [
        (joint.middle_rad + s * 0.25 * joint.span_rad, speed, a, 0.3 if k % 2 else 5.0)
        for k, s in enumerate((1.0, 0.5, -1.0, -0.5) * 2)
    ]
    what = "in each stop of 5 s: brake on, power stage off, recorded as jN.enabled 0"
    return {"1": (what, moves), "2": (what, moves)}


# Kinds of experiment --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Experiment:
    """A kind of experiment, of two joints on a bench and of one: what is done and what that shows, and its runs or
    motions.

    Every kind is done with either joint as the velocity joint; there are always runs to hold out. Signs as in
    `campaigns`.
    """

    pair_text: str
    pair: Callable[[PairRange, int], Runs]
    joint_text: str
    joint: Callable[[JointRange], Motions]


EXPERIMENTS: Final = {
    "excitation": Experiment(
        "Fourier velocity against a Fourier load of another period: all quadrants of velocity and torque",
        _pair_excitation,
        "moves of random length and speed over the travel: all speeds in both directions",
        _joint_excitation,
    ),
    "repeat": Experiment(
        "the same motion three times: the difference between its runs is noise",
        _pair_repeat,
        "the same motion four times: the difference between its runs is noise",
        _joint_repeat,
    ),
    "speed_ladder": Experiment(
        "constant velocities in both directions, without load and with a constant one: friction over velocity",
        _pair_speed_ladder,
        "constant velocities in both directions over the same positions, without and with a payload: friction over velocity",
        _both_payloads(LADDER),
    ),
    "slow_reversals": Experiment(
        "creeping back and forth, without load and with one: friction at low velocity against travel-dependent effects",
        _pair_slow_reversals,
        "creeping back and forth, without and with a payload: friction at low velocity",
        _both_payloads(_SLOW),
    ),
    "load_at_both_directions": Experiment(
        "the same loads, up to 70 % of rated torque, at the same velocity in both directions, both joints recorded: "
        "half the sum of both directions is gain or offset, half the difference is friction; an error of one joint "
        "alone belongs to that joint, an error of both to the sensor",
        _pair_both_directions,
        "the same positions, so the same load, slowly in both directions, without and with a payload: half the sum of both "
        "directions is gain or offset, half the difference is friction",
        _both_payloads((0.1, 0.3)),
    ),
    "load_ramp": Experiment(
        "the joints at standstill, the load oscillating with three amplitudes and three rates: torsion over torque",
        _pair_load_ramp,
        "held still under loads that gravity makes, each reached from both sides: torsion over torque",
        _joint_load_ramp,
    ),
    "full_turns": Experiment(
        "more than a whole turn of the joint in both directions at two velocities and three loads: effects of "
        "each encoder's angle, and their dependence on the load",
        _pair_full_turns,
        "the longest way that the joint may go, at two velocities, without and with a payload: effects of the angle",
        _both_payloads((0.4, 0.7)),
    ),
    "quick_changes": Experiment(
        "velocity back and forth at three accelerations, and load back and forth at constant velocity: inertia "
        "against delay",
        _pair_quick_changes,
        "back and forth at three accelerations: inertia against delay",
        _joint_quick_changes,
    ),
    "warm_up": Experiment(
        "a long run that warms the joints, with the same slow, fast, loaded and standstill check every 90 s",
        _pair_warm_up,
        "a long run that warms the joint, with the same check between: effects of temperature",
        _joint_warm_up,
    ),
    "zero_reading": Experiment(
        "rests with the drives switched off, reached from both directions: the readings of current and torque are then "
        "their zeros, independent of friction",
        _pair_zero_reading,
        "stops without power, reached from both sides: what current and torque then read is their zero",
        _joint_zero_reading,
    ),
}
"""By name; `Effect.experiment` is one of them."""


def pair_runs(kinds: Iterable[str], reach: PairRange) -> tuple[Run, ...]:
    """Return the runs of these kinds of experiment on a towing bench, either joint as the velocity joint."""
    return tuple(
        Run(f"{kind}_v{role}_{name}".removesuffix("_"), role, segments)
        for kind in kinds
        for role in _ROLES
        for name, segments in EXPERIMENTS[kind].pair(reach, role).items()
    )


def joint_motions(kinds: Iterable[str], joint: JointRange) -> list[Motion]:
    """Return the motions of one joint for these kinds of experiment."""
    return [
        _played(f"{kind}_{name}", what, joint, moves)
        for kind in kinds
        for name, (what, moves) in EXPERIMENTS[kind].joint(joint).items()
    ]


def csv_text(made: Sequence[Motion]) -> str:
    """Return all runs as one CSV table at RATE_HZ: run, time_s, position_rad, velocity_rad_s, joint side."""
    lines = ["run,time_s,position_rad,velocity_rad_s"]
    for motion in made:
        rows = zip(motion.time_s, motion.position_rad, motion.velocity_rad_s, strict=True)
        lines += [f"{motion.name},{t:.2f},{q:.6f},{v:.6f}" for t, q, v in rows]
    return "\n".join(lines) + "\n"
