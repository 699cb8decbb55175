"""The next experiment: which kind of motion separates what these runs cannot: for two joints on a towing bench a plan that
`jtq campaign` drives, for one joint a table of positions (`arm_motion`).

What an effect needs to be seen at all is its `Effect.experiment`. For two effects that look alike the kind that separates
them is in PAIRS where it is another one. Of all kinds that a diagnosis would like, at most MOST_KINDS are planned, those
that serve most pairs first.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import LossModel
from jtqd.sysid.campaign.plan import Fourier, Off, Plan, Plateau, Rest, Run, Segment, check_plan, travel_rad
from jtqd.sysid.campaign.plans import seed_of
from jtqd.sysid.diagnosis.arm_motion import KINDS, Room, csv_text, described, motions, room_of
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.excitation.design import draw
from jtqd.sysid.excitation.model import Bench as StaticBench
from jtqd.sysid.excitation.model import ExcitationLimits, current_at, rounded_down
from jtqd.sysid.motion.setpoints import Limits

VELOCITY_RAD_S: Final = 2.0
"""Fastest motion where nothing else is given; joint files have no rated velocity."""
TEMPERATURE_C: Final = 70.0
_TORQUE_SHARE: Final = 0.7
"""Planned torque as a part of the rated one: it rings at a reversal under load (docs/excitation.md)."""
_CURRENT_SHARE: Final = 0.85
_INERTIA_SHARE: Final = 0.25
"""Part of the rated torque that goes into accelerating both rotors."""
_STEPS: Final = 200
_OVER: Final = 3.0
"""Largest current tried, in rated torques over G Kt."""


@dataclass(frozen=True)
class Reach:
    """What the runs of an experiment may use of two coupled joints.

    A joint file gives the rated torque and no rated current. The current limit is what the joint needs to give its rated
    torque against its own losses; the planned motion stays well below both, because the file may be wrong in the very
    thing that the experiment is to settle.

    joints: of the bench; limits: of the plan but for travel, which each plan adds; velocity_rad_s: fastest plateau;
    acceleration_rad_s2: steepest change of it; own_current_a: largest planned current of joint 1 and of joint 2.
    """

    joints: tuple[Joint, Joint]
    limits: Limits
    velocity_rad_s: float
    acceleration_rad_s2: float
    own_current_a: tuple[float, float]

    def load_of(self, velocity_joint: int, velocity_rad_s: float | None = None) -> float:
        """Largest current [A] of the other joint, for any velocity up to this one (None: the fastest; 0: held still).

        Torque and the velocity joint's own current stay within their bounds in both directions: driven back, the driving
        joint's losses add to its torque. Held still, its torque is at most what its current gives.
        """
        speed = self.velocity_rad_s if velocity_rad_s is None else velocity_rad_s
        mover, driver = self.joints[velocity_joint - 1], self.joints[2 - velocity_joint]
        bound = _TORQUE_SHARE * self.limits.torque_nm
        nm_per_a = LossModel(driver).torque_per_ampere
        most = min(self.own_current_a[2 - velocity_joint], _OVER * bound / nm_per_a)
        if speed == 0.0:
            return min(most, bound / nm_per_a)
        bench = StaticBench(mover, driver)
        currents = np.linspace(0.0, most, _STEPS)
        good = np.ones(_STEPS, bool)
        for share in (-1.0, -0.1, 0.1, 1.0):
            velocity, still = np.full(_STEPS, share * speed), np.zeros(_STEPS)
            low, high = bench.torque_range(self.own_current_a[velocity_joint - 1], velocity, still)
            torque = bench.torque(currents, velocity, still)
            good &= (np.abs(torque) <= bound) & (low <= torque) & (torque <= high)
        return float(currents[max(int(np.argmin(good)) - 1, 0)] if not good.all() else most)


def reach_of(
    joints: Mapping[int, Joint],
    *,
    velocity_rad_s: float = VELOCITY_RAD_S,
    temperature: bool = True,
) -> Reach:
    """Return what two coupled joints can do within the `motion_limits` of their files but for travel, which a coupling has
    not; one joint alone is taken to face one like itself.

    joints: by number, at least one; the first two count. temperature: whether the drives measure theirs (a plan with a
    limit for it is refused otherwise).

    Raises ValueError without a joint.
    """
    if not joints:
        raise ValueError("joints: found none, expected one or two")
    files = [joints[number] for number in sorted(joints)][:2]
    pair = (files[0], files[-1])
    rated = min(j.rated_torque_nm for j in pair)
    for allowed in (j.motion_limits for j in pair):
        if allowed is not None:
            rated, velocity_rad_s = min(rated, allowed.torque_nm), min(velocity_rad_s, allowed.velocity_rad_s)
    currents = [current_at(j, rated, velocity_rad_s) for j in pair]
    limits = Limits(
        current_a=rounded_down(max(currents)),
        velocity_rad_s=rounded_down(1.15 * velocity_rad_s),
        torque_nm=rated,
        travel_rad=1.0,
        temperature_c=TEMPERATURE_C if temperature else math.inf,
    )
    rotors = sum(j.gear_ratio**2 * j.rotor_inertia_kgm2 + j.link_inertia_kgm2 for j in pair)
    acceleration = min(20.0, _INERTIA_SHARE * rated / (0.5 * rotors))
    acceleration = min(
        [acceleration, *(j.motion_limits.acceleration_rad_s2 for j in pair if j.motion_limits)]
    )
    own = [_CURRENT_SHARE * min(current, limits.current_a) for current in currents]
    return Reach(pair, limits, velocity_rad_s, acceleration, (own[0], own[1]))


_RAMP_S: Final = 0.4
_STEEPEST: Final = 1.875
"""Peak slope of the smooth step of `jtqd.sysid.campaign.plan`, in steps per ramp."""
_GENTLE: Final = 0.5
"""Part of the acceleration that changes between plateaus use: nothing is to be learned there."""
_EDGE_S: Final = 1.0
_ROLES: Final = (1, 2)
_TURN_RAD: Final = 2.0 * math.pi
_FOURIER_S: Final = 20.0
_OFF_S: Final = 2.5
"""Of a rest without power; the way there and back included."""

Point = tuple[float, float, float]
"""Velocity [rad/s], current [A], hold [s]."""
Make = Callable[[Reach, int, str], Sequence[Run]]


@dataclass(frozen=True)
class Kind:
    """One kind of experiment. what: what is done and what that shows, for people; make: runs of one velocity joint,
    named after the prefix given.

    Signs as in `jtqd.sysid.campaign.plans`: with equal signs of the velocity joint's velocity and the other joint's
    current, the velocity joint drives and the other one is driven back. Every kind is done with either joint as the
    velocity joint, so that both joints drive and are driven, and there are always runs to leave out.
    """

    name: str
    what: str
    make: Make

    def runs(self, reach: Reach) -> tuple[Run, ...]:
        """Return all runs, either joint as the velocity joint."""
        return tuple(run for role in _ROLES for run in self.make(reach, role, f"{self.name}_v{role}"))


def _points(reach: Reach, name: str, role: int, points: Iterable[Point], ramp_s: float = _RAMP_S) -> Run:
    """From rest over all points, each held after a ramp that the joints can follow, back to rest."""
    segments: list[Segment] = [Rest(_EDGE_S, 0.0)]
    velocity = 0.0
    for target, current, hold_s in points:
        segments.append(
            Plateau(target, round(current, 4), round(hold_s, 3), _ramp(reach, target - velocity, ramp_s))
        )
        velocity = target
    segments.append(Rest(_EDGE_S, _ramp(reach, velocity, ramp_s)))
    return Run(name, role, tuple(segments))


def _turned_unloaded(points: Sequence[Point]) -> list[Point]:
    """The points with the load taken off before each reversal and put on after it: a reversal under load rings."""
    result: list[Point] = []
    for before, (velocity, current, hold_s) in zip(((0.0, 0.0, 0.0), *points), points, strict=False):
        if velocity * before[0] < 0.0 and (current or before[1]):
            result += [(before[0], 0.0, 0.1), (velocity, 0.0, 0.1)]
        result.append((velocity, current, hold_s))
    return result


def _ramp(reach: Reach, step_rad_s: float, shortest_s: float) -> float:
    return round(max(shortest_s, _STEEPEST * abs(step_rad_s) / (_GENTLE * reach.acceleration_rad_s2)), 3)


def _fourier(reach: Reach, count: int, purpose: str) -> list[Fourier]:
    limits = ExcitationLimits(
        velocity_rad_s=reach.velocity_rad_s,
        acceleration_rad_s2=reach.acceleration_rad_s2,
        travel_rad=20.0,
        current_a=min(reach.load_of(role) for role in _ROLES),
        joint_current_a=min(reach.own_current_a),
        torque_nm=0.75 * reach.limits.torque_nm,
    )
    seed = seed_of(purpose, reach.velocity_rad_s, 0)
    made = draw(limits, count=count, duration_s=_FOURIER_S, seed=seed, joints=reach.joints)
    return [Fourier(one.velocity, one.current) for one in made]


def _fourier_run(name: str, role: int, segment: Fourier) -> Run:
    return Run(name, role, (Rest(_EDGE_S, 0.0), segment, Rest(_EDGE_S, 0.0)))


def _excitation(reach: Reach, role: int, prefix: str) -> list[Run]:
    motions = _fourier(reach, 4, "diagnosis excitation")[2 * (role - 1) : 2 * role]
    return [_fourier_run(f"{prefix}_{k}", role, each) for k, each in enumerate(motions, 1)]


def _repeat(reach: Reach, role: int, prefix: str) -> list[Run]:
    motion = _fourier(reach, 2, "diagnosis repeat")[role - 1]
    return [_fourier_run(f"{prefix}_{k}", role, motion) for k in (1, 2, 3)]


def _speed_ladder(reach: Reach, role: int, prefix: str) -> list[Run]:
    speeds = [share * reach.velocity_rad_s for share in (0.04, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)]
    middle = 0.5 * reach.load_of(role)
    return [
        _points(reach, f"{prefix}_{name}", role, [(s * v, load, 1.5) for v in speeds for s in (1.0, -1.0)])
        for name, load in (("idle", 0.0), ("pull", middle), ("push", -middle))
    ]


def _slow_reversals(reach: Reach, role: int, prefix: str) -> list[Run]:
    # the last ones show what Coulomb friction is by itself
    speeds = (0.04, 0.055, 0.075, 0.1, 0.14, 0.2, 0.35, 0.5 * reach.velocity_rad_s)
    middle = 0.6 * reach.load_of(role, speeds[-1])
    return [
        _points(reach, f"{prefix}_{name}", role, [(s * v, load, 1.5) for v in speeds for s in (1.0, -1.0)])
        for name, load in (("idle", 0.0), ("pull", middle), ("push", -middle))
    ]


def _both_directions(reach: Reach, role: int, prefix: str) -> list[Run]:
    """All loads up and down at one velocity, then the same the other way round: the same torques in both directions."""
    shares = (0.0, 0.25, 0.5, 0.75, 1.0, 0.6, 0.2, -0.2, -0.6, -1.0, -0.75, -0.5, -0.25, 0.0)
    runs = []
    for k, part in enumerate((0.15, 0.5), 1):
        speed = part * reach.velocity_rad_s
        highest = reach.load_of(role, speed)
        points = [(s * speed, share * highest, 0.8) for s in (1.0, -1.0) for share in shares]
        runs.append(_points(reach, f"{prefix}_{k}", role, points))
    return runs


def _load_ramp(reach: Reach, role: int, prefix: str) -> list[Run]:
    """Held still, loads up and down: three sizes, three rates. The joint creeps on first, so that it stands unloaded."""
    highest = reach.load_of(role, 0.0)
    runs = []
    for k, ramp_s in enumerate((0.3, 1.0, 3.0), 1):
        points = [(0.2, 0.0, 0.5), (-0.2, 0.0, 0.5), (0.0, 0.0, 0.5)]
        for share in (0.35, 0.7, 1.0, 0.35) if ramp_s < 2.0 else (0.35, 1.0):
            points += [(0.0, sign * share * highest, 0.2) for sign in (1.0, -1.0, 1.0, -1.0)]
            points.append((0.0, 0.0, 0.3))
        runs.append(_points(reach, f"{prefix}_{k}", role, points, ramp_s))
    return runs


def _full_turns(reach: Reach, role: int, prefix: str) -> list[Run]:
    runs = []
    for k, part in enumerate((0.4, 0.65), 1):
        speed = part * reach.velocity_rad_s
        load = 0.9 * reach.load_of(role, speed)
        points = [(s * speed, i, 1.2 * _TURN_RAD / speed) for i in (0.0, load, -load) for s in (1.0, -1.0)]
        runs.append(_points(reach, f"{prefix}_{k}", role, _turned_unloaded(points)))
    return runs


def _quick_changes(reach: Reach, role: int, prefix: str) -> list[Run]:
    """Velocity back and forth at rising rates without and with load, then load back and forth at constant velocity."""
    runs = []
    load = 0.4 * reach.load_of(role)
    for name, current in (("idle", 0.0), ("loaded", load)):
        segments: list[Segment] = [Rest(_EDGE_S, 0.0)]
        for share in (0.25, 0.5, 1.0):
            speed = 0.3 * reach.velocity_rad_s
            ramp_s = round(_STEEPEST * 2.0 * speed / (share * reach.acceleration_rad_s2), 3)
            segments += [Plateau(s * speed, current, 0.05, ramp_s) for s in (1.0, -1.0) * 6]
        segments.append(Rest(_EDGE_S, _RAMP_S))
        runs.append(Run(f"{prefix}_{name}", role, tuple(segments)))
    swing: list[Segment] = [Rest(_EDGE_S, 0.0)]
    for s in (1.0, -1.0):
        speed = s * 0.4 * reach.velocity_rad_s
        swing.append(Plateau(speed, 0.0, 0.3, _ramp(reach, speed, _RAMP_S)))
        for ramp_s in (0.4, 0.2, 0.1, 0.06):
            swing += [Plateau(speed, round(sign * load, 4), 0.1, ramp_s) for sign in (1.0, -1.0) * 2]
        swing.append(Rest(0.3, _RAMP_S))
    runs.append(Run(f"{prefix}_load", role, tuple(swing)))
    return runs


def _warm_up(reach: Reach, role: int, prefix: str) -> list[Run]:
    """One long run: a check, then fast and loaded back and forth, a check again, and so on while the joints warm."""
    fast, load = reach.velocity_rad_s, reach.load_of(role)
    check: list[Point] = [(0.0, 0.0, 2.0)]
    check += [(s * v * fast, 0.0, 1.0) for v in (0.15, 0.5, 1.0) for s in (1.0, -1.0)]
    check += [(s * 0.25 * fast, i * load, 1.0) for i in (0.8, -0.8) for s in (1.0, -1.0)]
    warm: list[Point] = [(s * fast, s * 0.8 * load, 6.0) for s in (1.0, -1.0)] * 6
    return [_points(reach, prefix, role, _turned_unloaded((check + warm) * 5 + check))]


def _zero_reading(reach: Reach, role: int, prefix: str) -> list[Run]:
    """Rests with the drives switched off, each reached from the other direction, with slow turning between."""
    speed = 0.2 * reach.velocity_rad_s
    ramp_s = _ramp(reach, speed, _RAMP_S)
    segments: list[Segment] = [Rest(_EDGE_S, 0.0), Off(_OFF_S)]
    for _ in range(3):
        for s in (1.0, -1.0):
            segments += [Plateau(s * speed, 0.0, 2.0, ramp_s), Rest(0.5, ramp_s), Off(_OFF_S)]
    return [Run(f"{prefix}_{k}", role, tuple(segments)) for k in (1, 2)]


EXPERIMENTS: Final = {
    kind.name: kind
    for kind in (
        Kind(
            "excitation",
            "Fourier velocity against a Fourier load of another period: all quadrants of velocity and torque",
            _excitation,
        ),
        Kind("repeat", "the same motion three times: the difference between its runs is noise", _repeat),
        Kind(
            "speed_ladder",
            "constant velocities in both directions, without load and with a constant one: friction over velocity",
            _speed_ladder,
        ),
        Kind(
            "slow_reversals",
            "creeping back and forth, without load and with one: friction at low velocity against travel-dependent effects",
            _slow_reversals,
        ),
        Kind(
            "load_at_both_directions",
            "the same loads, up to 70 % of rated torque, at the same velocity in both directions, both joints recorded: "
            "half the sum of both directions is gain or offset, half the difference is friction; an error of one joint "
            "alone belongs to that joint, an error of both to the sensor",
            _both_directions,
        ),
        Kind(
            "load_ramp",
            "the joints at standstill, the load oscillating with three amplitudes and three rates: torsion over torque",
            _load_ramp,
        ),
        Kind(
            "full_turns",
            "more than a whole turn of the joint in both directions at two velocities and three loads: effects of "
            "each encoder's angle, and their dependence on the load",
            _full_turns,
        ),
        Kind(
            "quick_changes",
            "velocity back and forth at three accelerations, and load back and forth at constant velocity: inertia "
            "against delay",
            _quick_changes,
        ),
        Kind(
            "warm_up",
            "a long run that warms the joints, with the same slow, fast, loaded and standstill check every 90 s",
            _warm_up,
        ),
        Kind(
            "zero_reading",
            "rests with the drives switched off, reached from both directions: the readings of current and torque are then "
            "their zeros, independent of friction",
            _zero_reading,
        ),
    )
}
"""Kinds of experiment by name; `Effect.experiment` names one of them."""


MOST_KINDS: Final = 3
_DEFAULT: Final = "excitation"

_PAIR_TABLE: Final = {
    "load_at_both_directions": (
        # even or odd in the direction of motion; in one joint or in both
        "torque_constant load_dependent_friction",
        "torque_constant torque_constant_saturation",
        "torque_constant sensor_gain",
        "torque_constant viscous_friction",
        "sensor_gain load_dependent_friction",
        "sensor_gain torque_constant_saturation",
        "sensor_gain nonlinear_stiffness",
        "load_dependent_friction coulomb_friction",
        "load_dependent_friction viscous_friction",
        "load_dependent_friction torque_constant_saturation",
        "load_dependent_friction friction_asymmetry",
        "lost_motion friction_asymmetry",
        "sensor_offset friction_asymmetry",
        "sensor_offset current_offset",
    ),
    "speed_ladder": (
        "coulomb_friction viscous_friction",
        "coulomb_friction current_offset",
        "coulomb_friction friction_asymmetry",
        "coulomb_friction sensor_offset",
        "viscous_friction rotor_inertia",
        "viscous_friction channel_delay",
    ),
    "slow_reversals": (
        "coulomb_friction stribeck_friction",
        "viscous_friction stribeck_friction",
        "stribeck_friction hysteresis",
        "stribeck_friction lost_motion",
        "stribeck_friction friction_asymmetry",
    ),
    "load_ramp": (
        "hysteresis lost_motion",
        "hysteresis nonlinear_stiffness",
        "lost_motion nonlinear_stiffness",
        "hysteresis channel_delay",
        "nonlinear_stiffness encoder_eccentricity",
    ),
    "full_turns": (
        # order, encoder, growth with load, one joint or both
        "torque_ripple cogging",
        "torque_ripple kinematic_error",
        "cogging kinematic_error",
        "kinematic_error encoder_eccentricity",
        "torque_ripple encoder_eccentricity",
        "sensor_crosstalk unbalance",
        "sensor_crosstalk encoder_eccentricity",
        "sensor_crosstalk sensor_offset",
        "unbalance encoder_eccentricity",
        "unbalance sensor_offset",
    ),
    "quick_changes": (
        "rotor_inertia link_inertia",
        "rotor_inertia channel_delay",
        "link_inertia channel_delay",
        "torque_ripple channel_delay",
    ),
    "warm_up": (
        "temperature_dependent_friction viscous_friction",
        "temperature_dependent_friction coulomb_friction",
        "temperature_dependent_friction sensor_drift",
        "temperature_dependent_friction torque_constant_temperature",
        "torque_constant torque_constant_temperature",
        "sensor_gain torque_constant_temperature",
        "sensor_drift torque_constant_temperature",
        "sensor_drift sensor_offset",
        "sensor_drift current_offset",
    ),
    "zero_reading": ("current_offset friction_asymmetry",),
}
PAIRS: Final = {frozenset(pair.split()): kind for kind, pairs in _PAIR_TABLE.items() for pair in pairs}
"""Two names -> the kind that separates them."""

_VISIBLE: Final = {
    "excitation": "torque_constant_saturation",
    "speed_ladder": "coulomb_friction viscous_friction friction_asymmetry",
    "slow_reversals": "stribeck_friction",
    "load_at_both_directions": "load_dependent_friction torque_constant sensor_gain torque_constant_saturation",
    "load_ramp": "nonlinear_stiffness hysteresis lost_motion",
    "full_turns": "torque_ripple kinematic_error cogging sensor_crosstalk encoder_eccentricity unbalance",
    "quick_changes": "rotor_inertia link_inertia channel_delay",
    "warm_up": "temperature_dependent_friction torque_constant_temperature sensor_drift",
    "zero_reading": "current_offset sensor_offset",
}
_OWN: Final = {name: kind for kind, names in _VISIBLE.items() for name in names.split()}

_BY_HAND: Final = {
    frozenset(("sensor_crosstalk", "unbalance")): (
        "If the class remains, turn the coupling by a quarter and repeat the campaign: crosstalk turns with the sensor, "
        "unbalance does not."
    ),
}


def kind_of(name: str) -> str:
    """Return the kind of experiment that shows an effect (a name that the library does not have: the general one)."""
    if name in _OWN:
        return _OWN[name]
    effect = EFFECTS.get(name)
    kind = effect.experiment if effect is not None else _DEFAULT
    return kind if kind in EXPERIMENTS else _DEFAULT


def kinds_for(classes: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the kinds that separate the members of every class, and show the effect of a class of one; at most MOST_KINDS.

    Kinds that serve more pairs come first; no class at all: the general excitation and its repetition, which give the
    noise floor.
    """
    votes: Counter[str] = Counter()
    for names in classes:
        if len(names) == 1:
            votes[kind_of(names[0])] += 1
        for a, b in combinations(dict.fromkeys(names), 2):
            separating = PAIRS.get(frozenset((a, b)))
            votes.update({separating} if separating else {kind_of(a), kind_of(b)})
    if not votes:
        return (_DEFAULT, "repeat")
    order = list(EXPERIMENTS)
    return tuple(sorted(votes, key=lambda kind: (-votes[kind], order.index(kind)))[:MOST_KINDS])


def next_experiment(
    classes: Iterable[Sequence[str]],
    joints: Mapping[int, Joint],
    why: str = "",
    *,
    velocity_rad_s: float = VELOCITY_RAD_S,
    temperature: bool = True,
    signals: Sequence[JointSignals] = (),
) -> dict[str, Any]:
    """Return what would settle it: {"why": text, "plan": mapping of jtq.plan/1} for two joints on a towing bench, and
    {"why": text, "plan": None, "motion": ..} for one joint, which is moved by itself (`arm_motion`). Three and more are an
    arm: each gets a motion of its own (`each_joint`).

    classes: names of effects that the runs cannot distinguish, one sequence per class; a sequence of one name asks to make
    that effect visible. joints: files of the joints in the runs, whose ratings the plan keeps. why: what the
    diagnosis says before it. velocity_rad_s: the fastest motion allowed. temperature: whether the runs have one; without
    it the plan does not supervise it. signals: of one joint, its runs so far: where it may go. Raises ValueError without
    a joint.
    """
    classes = [tuple(names) for names in classes]
    kinds = kinds_for(classes)
    if len(joints) == 1:
        [(number, joint)] = joints.items()
        return _of_one_joint(classes, kinds, number, why, room_of(joint, signals))
    if len(joints) > 2:
        return each_joint(
            {
                number: _of_one_joint(classes, kinds, number, why, room_of(joint, ()))
                for number, joint in joints.items()
            }
        )
    reach = reach_of(joints, velocity_rad_s=velocity_rad_s, temperature=temperature)
    runs = tuple(run for kind in kinds for run in EXPERIMENTS[kind].runs(reach))
    plan = Plan("next_" + "_".join(kinds), replace(reach.limits, travel_rad=1e3), runs)
    setpoints = check_plan(plan)
    travel = 1.1 * max(travel_rad(one) for one in setpoints.values()) + 1.0
    plan = replace(plan, limits=replace(plan.limits, travel_rad=float(np.ceil(travel))))
    return {"why": _text(classes, kinds, why, plan), "plan": plan.to_mapping()}


_TOWING: Final = (
    "On a towing bench diagnose both joints together: the plan is then a campaign, and a sensor fault is in the "
    "balances of both joints, a joint fault in one."
)


def each_joint(experiments: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the experiments of joints that are moved one by one, by their numbers, as one.

    A single one is returned as it is; several are {"why": all of them, "plan": None, "motion": None, "joints": [{"joint",
    "why", "motion"}, ..], "tables": {number: CSV}}, tables for those with a motion. Raises ValueError without any.
    """
    if not experiments:
        raise ValueError("found no experiment, expected at least one")
    if len(experiments) == 1:
        [only] = experiments.values()
        return dict(only)
    numbers = sorted(experiments)
    said = [f"Joint {n}: {experiments[n]['why'].replace(f' {_TOWING}', '')}" for n in numbers]
    return {
        "why": " ".join(said),
        "plan": None,
        "motion": None,
        "joints": [
            {"joint": n, "why": experiments[n]["why"], "motion": experiments[n].get("motion")}
            for n in numbers
        ],
        "tables": {n: experiments[n]["table"] for n in numbers if experiments[n].get("table")},
    }


def _of_one_joint(
    classes: Sequence[Sequence[str]], kinds: Sequence[str], number: int, why: str, room: Room | None
) -> dict[str, Any]:
    """Return the experiment of a joint that nothing tows."""
    parts = _begun(classes, why)
    parts += [f"{kind}: {KINDS[kind][0]}." for kind in kinds]
    parts += [note for pair, note in _BY_HAND.items() if any(pair <= set(names) for names in classes)]
    parts.append(_TOWING)
    if room is None:
        parts.append(
            "No motion is planned: neither these runs nor motion_limits of the joint file (or --limits) say where it may go."
        )
        return {"why": " ".join(parts), "plan": None, "motion": None}
    made = motions(kinds, room)
    minutes = sum(motion.duration_s for motion in made) / 60.0
    parts.append(
        f"Joint {number} alone, {counted(len(made), 'run')}, {minutes:.0f} min, {room.low_rad:.3g} to {room.high_rad:.3g} "
        f"rad, at most {room.velocity_rad_s:.3g} rad/s and {room.acceleration_rad_s2:.3g} rad/s2, "
    )
    if math.isfinite(room.needed_nm):
        parts[-1] += (
            "as in these runs and within the joint's limits; there they needed up to "
            f"{room.needed_nm:.3g} Nm of {room.torque_nm:.3g} Nm, a payload may add no more than the rest."
        )
    else:
        parts[-1] += (
            f"within the joint's limits; no run shows what torque that needs, so go slowly first and watch "
            f"{room.torque_nm:.3g} Nm."
        )
    parts.append("All other joints stand as they did in these runs.")
    return {
        "why": " ".join(parts),
        "plan": None,
        "motion": described(number, made, room),
        "table": csv_text(made),
    }


def _begun(classes: Sequence[Sequence[str]], why: str) -> list[str]:
    """Reason, and what is to be separated."""
    parts = [why.strip().rstrip(".") + "."] if why.strip() else []
    aims = [f"to distinguish {', '.join(names[:-1])} from {names[-1]}" for names in classes if len(names) > 1]
    aims += [f"to detect {names[0]}" for names in classes if len(names) == 1]
    return [*parts, f"Proposed{' ' if aims else ''}{' and '.join(aims)}:"]


def _text(classes: Sequence[Sequence[str]], kinds: Sequence[str], why: str, plan: Plan) -> str:
    """Reason, what is to be separated, what is done, what it takes, what is left to do by hand."""
    parts = _begun(classes, why)
    parts += [f"{kind}: {EXPERIMENTS[kind].what}." for kind in kinds]
    parts += [note for pair, note in _BY_HAND.items() if any(pair <= set(names) for names in classes)]
    parts.append(
        f"{counted(len(plan.runs), 'run')}, {plan.duration_s / 60.0:.0f} min, at most {plan.limits.torque_nm:g} Nm and "
        f"{plan.limits.current_a:g} A."
    )
    return " ".join(parts)
