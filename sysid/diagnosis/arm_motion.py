"""Motions of one joint of an arm for the next experiment: positions over time that any controller can play.

A joint that is not on a towing bench has no second joint that loads it, so nothing here commands a load: it comes from
gravity, and from a payload where the text asks for one. Every motion stays where the joint may be (`motion_limits` of the
joint file, or --limits) and where these runs have been: their travel, speed and acceleration, and positions at which they
needed no more than the torque allowed. All moves are from rest to rest; ramps of the velocity are half waves of a cosine.

    ramp [s] = pi v / (2 a)            way = v (ramp + plateau)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.diagnosis.smoothing import smooth

RATE_HZ: Final = 100.0
NO_LIMIT: Final = 1e6
"""Values of `MotionLimits` that were left out."""
INSIDE: Final = 0.05
"""Part of the travel that is left free at either end."""
_TORQUE_SHARE: Final = 0.9
"""Of the torque allowed: positions that needed more in the runs are not visited."""
_BINS: Final = 24
_LEAST_TRAVEL_RAD: Final = 0.02
_LEAST_SPEED_RAD_S: Final = 0.005
_ACCELERATION_QUANTILE: Final = 0.99
_ACCELERATION_S: Final = 0.1
_REST_S: Final = 1.0
_SHORTEST_PASS_S: Final = 0.5


@dataclass(frozen=True)
class Room:
    """What a motion may use, joint side: low..high [rad], velocity [rad/s], acceleration [rad/s2]; torque_nm: allowed;
    needed_nm: most that the runs needed between low and high, NaN without runs.
    """

    low_rad: float
    high_rad: float
    velocity_rad_s: float
    acceleration_rad_s2: float
    torque_nm: float
    needed_nm: float


def room_of(joint: Joint, signals: Sequence[JointSignals]) -> Room | None:
    """Return what the joint file allows and these runs have already done; None where nothing moved.

    Without a usable run it is what the joint file allows, where that says everything.
    """
    if not signals:
        return _of_limits(joint)
    position = np.concatenate([s.state.link_position_rad for s in signals])
    torque = np.abs(np.concatenate([s.sensor_nm for s in signals]))
    speed = max(float(np.max(np.abs(s.state.velocity_rad_s))) for s in signals)
    quick = max(_acceleration(s) for s in signals)
    low, high = float(np.min(position)), float(np.max(position))
    allowed = joint.rated_torque_nm
    limits = joint.motion_limits
    if limits is not None:
        low, high = max(low, limits.travel_rad[0]), min(high, limits.travel_rad[1])
        speed = min(speed, limits.velocity_rad_s)
        quick = min(quick, limits.acceleration_rad_s2)
        allowed = min(allowed, limits.torque_nm)
    if high - low < _LEAST_TRAVEL_RAD or speed < _LEAST_SPEED_RAD_S or not quick > 0.0:
        return None
    stretch = _calm_stretch(position, torque, low, high, _TORQUE_SHARE * allowed)
    if stretch is None:
        return None
    low, high = stretch
    margin = INSIDE * (high - low)
    there = (position >= low) & (position <= high)
    return Room(low + margin, high - margin, speed, quick, allowed, float(np.max(torque[there])))


def _acceleration(s: JointSignals) -> float:
    """Return the acceleration of a run [rad/s2], mean over _ACCELERATION_S: single samples are noise of the encoder."""
    v = s.state.velocity_rad_s
    step = float(np.median(np.diff(s.time_s)))
    wide = min(max(1, round(_ACCELERATION_S / step)), len(v) - 1)
    calm = smooth(v, max(1, wide // 4))
    return float(np.quantile(np.abs(calm[wide:] - calm[:-wide]), _ACCELERATION_QUANTILE)) / (wide * step)


def no_room(joint: Joint, signals: Sequence[JointSignals]) -> str:
    """Return why `room_of` gives none."""
    if signals:
        return (
            "within motion_limits of the joint file (or --limits) the joint stood in these runs, or it needed more than "
            f"{_TORQUE_SHARE:.0%} of the torque allowed"
        )
    return (
        "no run that can be used shows where the joint may go, and motion_limits of the joint file (or --limits) lacks "
        + ", ".join(_left_out(joint))
    )


def _left_out(joint: Joint) -> list[str]:
    """Names of the limits that a motion without runs needs and the file does not give."""
    limits = joint.motion_limits or MotionLimits()
    sizes = {
        "travel_rad": max(map(abs, limits.travel_rad)),
        "velocity_rad_s": limits.velocity_rad_s,
        "acceleration_rad_s2": limits.acceleration_rad_s2,
    }
    return [name for name, size in sizes.items() if size >= NO_LIMIT]


def _of_limits(joint: Joint) -> Room | None:
    limits = joint.motion_limits
    if limits is None or _left_out(joint):
        return None
    torque = min(joint.rated_torque_nm, limits.torque_nm)
    return Room(*limits.travel_rad, limits.velocity_rad_s, limits.acceleration_rad_s2, torque, math.nan)


def _calm_stretch(
    position: FloatArray, torque: FloatArray, low: float, high: float, bound: float
) -> tuple[float, float] | None:
    """Return the longest stretch of low..high in which the runs needed at most `bound`; None: nowhere."""
    edges = np.linspace(low, high, _BINS + 1)
    where = np.clip(np.searchsorted(edges, position, side="right") - 1, -1, _BINS - 1)
    inside = (position >= low) & (position <= high)
    peak = np.full(_BINS, np.inf)  # a bin that no run has been in is not known to be calm
    for k in range(_BINS):
        here = inside & (where == k)
        if here.any():
            peak[k] = float(np.max(torque[here]))
    calm = np.concatenate(([0], (peak <= bound).astype(int), [0]))
    starts, ends = np.flatnonzero(np.diff(calm) > 0), np.flatnonzero(np.diff(calm) < 0)
    if not len(starts):
        return None
    k = int(np.argmax(ends - starts))
    if edges[ends[k]] - edges[starts[k]] < _LEAST_TRAVEL_RAD:
        return None
    return float(edges[starts[k]]), float(edges[ends[k]])


@dataclass(frozen=True)
class Motion:
    """One run: what is done beside it, for people; time_s, position_rad, velocity_rad_s [n], joint side."""

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


def _played(name: str, what: str, start: float, moves: Iterable[Move]) -> Motion:
    """From rest at `start` over all moves to rest."""
    step = 1.0 / RATE_HZ
    velocity = [np.zeros(round(_REST_S * RATE_HZ))]
    at = start
    for target, speed, acceleration, rest_s in moves:
        way = target - at
        top = min(speed, math.sqrt(2.0 * acceleration * abs(way) / math.pi))
        if top > 0.0:
            # rounded up: neither speed nor acceleration is passed
            ramp = max(math.ceil(0.5 * math.pi * top / acceleration * RATE_HZ), 2)
            plateau = max(math.ceil((abs(way) / top) * RATE_HZ) - ramp, 0)
            up = 0.5 * (1.0 - np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp))
            shape = np.concatenate((up, np.ones(plateau), up[::-1]))
            velocity.append(shape * (way / (np.sum(shape) * step)))
        velocity.append(np.zeros(round(rest_s * RATE_HZ)))
        at = target
    velocity.append(np.zeros(round(_REST_S * RATE_HZ)))
    whole = np.concatenate(velocity)
    position = start + np.concatenate(([0.0], np.cumsum(0.5 * (whole[1:] + whole[:-1])))) * step
    return Motion(name, what, step * np.arange(len(whole), dtype=np.float64), position, whole)


def _there_and_back(room: Room, speeds: Iterable[float], rest_s: float = 0.3) -> list[Move]:
    """Both ways at each speed: over as much of the travel as half a minute takes, and no less than a pass can be."""
    moves: list[Move] = []
    a = room.acceleration_rad_s2
    middle = 0.5 * (room.low_rad + room.high_rad)
    for speed in speeds:
        half = min(0.5 * (room.high_rad - room.low_rad), 0.5 * speed * 12.0)
        if half < 0.5 * speed * _SHORTEST_PASS_S:
            continue
        moves += [(middle + s * half, speed, a, rest_s) for s in (-1.0, 1.0, -1.0, 1.0)]
    moves.append((middle, 0.5 * room.velocity_rad_s, a, 0.0))
    return moves


def _ladder(room: Room, shares: Iterable[float]) -> list[Move]:
    return _there_and_back(room, [share * room.velocity_rad_s for share in shares])


_LADDER: Final = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
_SLOW: Final = (0.02, 0.03, 0.05, 0.08, 0.12, 0.5)
_EMPTY: Final = "without payload"
_LOADED: Final = "with a payload"


def _middle(room: Room) -> float:
    return 0.5 * (room.low_rad + room.high_rad)


def _excitation(room: Room, name: str) -> list[Motion]:
    """Random targets, speeds and rests from a fixed seed: every position in both directions at several speeds."""
    made = []
    for k in (1, 2, 3, 4):
        rng = np.random.default_rng(k)
        moves = [
            (
                float(rng.uniform(room.low_rad, room.high_rad)),
                float(rng.uniform(0.2, 1.0)) * room.velocity_rad_s,
                float(rng.uniform(0.3, 1.0)) * room.acceleration_rad_s2,
                float(rng.choice([0.0, 0.3])),
            )
            for _ in range(24)
        ]
        made.append(_played(f"{name}_{k}", _EMPTY if k < 3 else _LOADED, _middle(room), moves))
    return made


def _repeat(room: Room, name: str) -> list[Motion]:
    moves = _ladder(room, (0.2, 0.5, 1.0))
    return [_played(f"{name}_{k}", "the same motion again", _middle(room), moves) for k in (1, 2, 3, 4)]


def _both_payloads(shares: Sequence[float]) -> Callable[[Room, str], list[Motion]]:
    def made(room: Room, name: str) -> list[Motion]:
        moves = _ladder(room, shares)
        return [
            _played(f"{name}_{k}_{label}", what, _middle(room), moves)
            for k in (1, 2)
            for label, what in (("empty", _EMPTY), ("loaded", _LOADED))
        ]

    return made


def _holds(room: Room, name: str) -> list[Motion]:
    """Held still at five positions, each reached from both sides: gravity is the load that goes up and down."""
    at = np.linspace(room.low_rad, room.high_rad, 5)
    speed, a = 0.3 * room.velocity_rad_s, 0.5 * room.acceleration_rad_s2
    moves = [(float(q), speed, a, 2.0) for q in (*at, *at[::-1])]
    return [
        _played(f"{name}_{label}", what, _middle(room), moves)
        for label, what in (("empty", _EMPTY), ("loaded", _LOADED))
    ]


def _quick(room: Room, name: str) -> list[Motion]:
    made = []
    for k, share in enumerate((0.3, 0.6, 1.0), 1):
        a = share * room.acceleration_rad_s2
        half = min(0.25 * (room.high_rad - room.low_rad), 0.5 * room.velocity_rad_s**2 / a)
        moves: list[Move] = [
            (_middle(room) + s * half, room.velocity_rad_s, a, 0.0) for s in (-1.0, 1.0) * 10
        ]
        made.append(_played(f"{name}_{k}", _EMPTY, _middle(room), moves))
    return made


def _warm(room: Room, name: str) -> list[Motion]:
    check = _ladder(room, (0.1, 0.3, 1.0))
    a = room.acceleration_rad_s2
    work: list[Move] = [(q, room.velocity_rad_s, a, 0.0) for q in (room.low_rad, room.high_rad)] * 30
    return [
        _played(f"{name}_{k}", "from cold, without a break", _middle(room), (check + work) * 4 + check)
        for k in (1, 2)
    ]


def _zero(room: Room, name: str) -> list[Motion]:
    """Two stops of 5 s, each reached from both sides; the brake holds."""
    a = 0.5 * room.acceleration_rad_s2
    speed = 0.3 * room.velocity_rad_s
    moves: list[Move] = [
        (_middle(room) + s * 0.25 * (room.high_rad - room.low_rad), speed, a, 0.3 if k % 2 else 5.0)
        for k, s in enumerate((1.0, 0.5, -1.0, -0.5) * 2)
    ]
    what = "in each stop of 5 s: brake on, power stage off, recorded as jN.enabled 0"
    return [_played(f"{name}_{k}", what, _middle(room), moves) for k in (1, 2)]


KINDS: Final[dict[str, tuple[str, Callable[[Room, str], list[Motion]]]]] = {
    "excitation": (
        "moves of random length and speed over the travel: all speeds in both directions",
        _excitation,
    ),
    "repeat": ("the same motion four times: the difference between its runs is noise", _repeat),
    "speed_ladder": (
        "constant velocities in both directions over the same positions, without and with a payload: friction over velocity",
        _both_payloads(_LADDER),
    ),
    "slow_reversals": (
        "creeping back and forth, without and with a payload: friction at low velocity",
        _both_payloads(_SLOW),
    ),
    "load_at_both_directions": (
        "the same positions, so the same load, slowly in both directions, without and with a payload: half the sum of both "
        "directions is gain or offset, half the difference is friction",
        _both_payloads((0.1, 0.3)),
    ),
    "load_ramp": (
        "held still under loads that gravity makes, each reached from both sides: torsion over torque",
        _holds,
    ),
    "full_turns": (
        "the longest way that the joint may go, at two velocities, without and with a payload: effects of the angle",
        _both_payloads((0.4, 0.7)),
    ),
    "quick_changes": ("back and forth at three accelerations: inertia against delay", _quick),
    "warm_up": (
        "a long run that warms the joint, with the same check between: effects of temperature",
        _warm,
    ),
    "zero_reading": (
        "stops without power, reached from both sides: what current and torque then read is their zero",
        _zero,
    ),
}
"""Kind of experiment (`towing_motion.EXPERIMENTS`) -> what it is for one joint, and its runs."""


def motions(kinds: Iterable[str], room: Room) -> list[Motion]:
    """Return the runs of these kinds within a room."""
    return [motion for kind in kinds for motion in KINDS[kind][1](room, kind)]


MOTION_FILE: Final = "next_experiment.motion.csv"


def joint_motion_file(number: int) -> str:
    """Return the name of the motion of a joint where several have one."""
    return f"next_experiment.joint{number}.motion.csv"


def csv_text(made: Sequence[Motion]) -> str:
    """Return all runs as one CSV table at RATE_HZ: run, time_s, position_rad, velocity_rad_s, joint side."""
    lines = ["run,time_s,position_rad,velocity_rad_s"]
    for motion in made:
        rows = zip(motion.time_s, motion.position_rad, motion.velocity_rad_s, strict=True)
        lines += [f"{motion.name},{t:.2f},{q:.6f},{v:.6f}" for t, q, v in rows]
    return "\n".join(lines) + "\n"


def described(joint: int, made: Sequence[Motion], room: Room) -> dict[str, Any]:
    """Return what findings.json says of the motion."""
    return {
        "joint": joint,
        "travel_rad": [room.low_rad, room.high_rad],
        "velocity_rad_s": room.velocity_rad_s,
        "acceleration_rad_s2": room.acceleration_rad_s2,
        "torque_nm": room.torque_nm,
        "runs": [{"name": m.name, "what": m.what, "duration_s": m.duration_s} for m in made],
    }
