"""Motions of two joints on a towing bench for the next experiment: a plan's runs that `jtq campaign` drives.

One joint keeps a velocity, the other one loads it with a current. What they may do is in `Reach`, what is done and what that
shows in EXPERIMENTS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import LossModel
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.planner.campaigns import seed_of
from jtqd.sysid.planner.design import Bench as StaticBench
from jtqd.sysid.planner.design import ExcitationLimits, current_at, draw, rounded_down
from jtqd.sysid.planner.plan import Fourier, Off, Plateau, Rest, Run, Segment

VELOCITY_RAD_S: Final = 2.0
"""Fastest motion where nothing else is given; joint files have no rated velocity."""
TEMPERATURE_C: Final = 70.0
_TORQUE_SHARE: Final = 0.7
"""Planned torque as a part of the rated one: it rings at a reversal under load (docs/fit.md)."""
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
"""Peak slope of the smooth step of `jtqd.sysid.planner.plan`, in steps per ramp."""
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

    Signs as in `jtqd.sysid.planner.campaigns`: with equal signs of the velocity joint's velocity and the other joint's
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
