"""What the foreign arm does: drawn motions within limits, days, payloads, pushes and clamps, and what its joints publish.

Three sets per arm, each run on a day of its own: identification (free motion, two weighed payloads), contact (pushes
and clamps after LEARN_S of free motion with a payload that nobody knows), quiet (the same without any contact). Everything
is drawn from the trial's seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from validation.arm.arm import (
    CYCLE_S,
    FALL_S,
    JOINTS,
    VALID,
    Arm,
    Array,
    Contact,
    Payload,
    Readings,
    Run,
    Silence,
    Truth,
    limits,
    rigid,
)

LEARN_S: Final = 10.0
"""A day begins with free motion of this length, in which the payload may be learned; figures count from here."""
IDENTIFY_RUNS, IDENTIFY_S = 8, 30.0
CONTACT_S: Final = 80.0
QUIET_S: Final = 120.0
SILENCE_S: Final = 3.0
KNOWN: Final = Payload(2.0, (0.01, -0.02, 0.06))
"""Second payload of the identification; the first one is nothing."""
WEIGHED_KG, WEIGHED_M = 0.010, 0.001
"""Half widths by which the weighed mass and centre are wrong."""
HEAVIEST_KG: Final = 3.0
RANGE_SHARE, SPEED_SHARE, TORQUE_SHARE = 0.8, 0.6, 0.65
"""Motions stay within these shares of the URDF's limits, torques with the heaviest payload."""
ACCELERATION_RAD_S2: Final = np.array([3.0, 3.0, 3.0, 3.0, 5.0, 5.0, 5.0])
TOOL_LOW_M: Final = 0.15
"""Poses keep the tool above this height."""
LEVER_M: Final = 0.4
"""Lever that a judged push or clamp has to some joint, at least."""
FORCE_N: Final = 20.0
FORCES_N: Final = (5.0, 60.0)
TILT: Final = 0.46
"""A push comes from within this angle [rad] of the surface's normal: a coefficient of friction of 0.5."""
EVENTS: Final = {"push": 6, "curve": 6, "any": 4, "clamp": 5}
"""Contacts of a day. push, clamp: FORCE_N with LEVER_M; curve: FORCES_N with LEVER_M; any: FORCES_N at any link."""
RISE_S: Final = {"push": 0.01, "curve": 0.01, "any": 0.01, "clamp": 1.0}
HOLD_S: Final = {"push": 0.5, "curve": 0.5, "any": 0.5, "clamp": 1.0}
ERRORS: Final = {
    "typical": (0.0056, (0.20, 0.03, 0.14, 0.15, 0.48)),
    "bad_day": (0.0147, (0.28, 0.05, 0.07, 0.19, 0.41)),
}
"""Error of a joint's torque: rms as a share of rated (docs/results.md), parts of its square: constant in a day, over the
motor's turn, over the link's turn, slow, the rest (`python -m validation sources --plant PLANT`)."""
SLOW_S, REST_S = 0.5, 0.01


class Weighed(NamedTuple):
    """A run of the identification with the payload that the user believes."""

    run: Run
    payload: Payload


class User(NamedTuple):
    """What who uses the arm has: its URDF, data-sheet values [7], and the identification with payloads as weighed.

    rotor_kgm2: at the joint.
    """

    urdf: Path
    rated_nm: Array
    gear_ratio: Array
    torque_constant_nm_per_a: Array
    rotor_kgm2: Array
    identification: Sequence[tuple[Readings, Payload]]


class Drawer:
    """Poses, motions and contacts of the arm of the URDF."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.model = rigid(payload=Payload(HEAVIEST_KG, (0.0, 0.0, 0.1)))
        self.data = mujoco.MjData(self.model)
        bound = limits()
        middle, half = (
            0.5 * (bound["low_rad"] + bound["high_rad"]),
            0.5 * (bound["high_rad"] - bound["low_rad"]),
        )
        self.low, self.high = middle - RANGE_SHARE * half, middle + RANGE_SHARE * half
        self.speed, self.torque = SPEED_SHARE * bound["rad_s"], TORQUE_SHARE * bound["rated_nm"]

    def possible(self, path: Array, step_s: float) -> bool:
        """Return whether positions [n, 7] are within all limits."""
        if (path < self.low).any() or (path > self.high).any():
            return False
        rate = np.gradient(path, step_s, axis=0) if len(path) > 2 else np.zeros_like(path)
        slope = np.gradient(rate, step_s, axis=0) if len(path) > 2 else np.zeros_like(path)
        if (np.abs(rate) > self.speed).any():
            return False
        data, tool = self.data, self.model.site("tool").id
        for q, w, a in zip(path, rate, slope, strict=True):
            data.qpos[:], data.qvel[:], data.qacc[:] = q, w, a
            mujoco.mj_inverse(self.model, data)
            if (np.abs(data.qfrc_inverse) > self.torque).any() or data.site_xpos[tool][2] < TOOL_LOW_M:
                return False
        return True

    def pose(self) -> Array:
        while True:
            q = self.rng.uniform(self.low, self.high)
            if self.possible(q[None], 1.0):
                return np.asarray(q)

    def motion(self, seconds: float) -> Array:
        """Return positions [n, 7] at 1 kHz: waves of all joints, or moves from pose to pose with rests."""
        n = round(seconds / CYCLE_S)
        if self.rng.uniform() < 0.5:
            return self._moves(n)
        return self._waves(CYCLE_S * np.arange(n))

    def _waves(self, t: Array) -> Array:
        rng = self.rng
        while True:
            centre = self.pose()
            periods = np.exp(rng.uniform(np.log(3.0), np.log(12.0), (3, JOINTS)))
            phases = rng.uniform(0.0, 2.0 * np.pi, (3, JOINTS))
            sizes = rng.uniform(0.3, 1.0, (3, JOINTS)) * rng.uniform(0.2, 0.7, JOINTS)
            begin = np.clip(t / 3.0, 0.0, 1.0)
            begin = begin**3 * (10.0 - 15.0 * begin + 6.0 * begin * begin)
            waves = np.sin(2.0 * np.pi * t[:, None, None] / periods + phases) * sizes
            path = waves.sum(axis=1) * begin[:, None]
            for shrunk in (1.0, 0.8, 0.6, 0.45):
                if self.possible((centre + shrunk * path)[::50], 50 * CYCLE_S):
                    return np.asarray(centre + shrunk * path)

    def _moves(self, n: int) -> Array:
        parts, at, length = [], self.pose(), 0
        while length < n:
            goal = self.pose()
            way = np.abs(goal - at)
            slowness = self.rng.uniform(1.1, 2.5)
            seconds = slowness * max(
                (1.875 * way / self.speed).max(), np.sqrt(5.78 * way / ACCELERATION_RAD_S2).max()
            )
            u = np.arange(round(seconds / CYCLE_S)) * CYCLE_S / seconds
            part = at + (goal - at) * (u**3 * (10.0 - 15.0 * u + 6.0 * u * u))[:, None]
            if not self.possible(part[::50], 50 * CYCLE_S):
                continue
            rest = np.repeat(goal[None], round(self.rng.uniform(0.1, 1.5) / CYCLE_S), axis=0)
            parts += [part, rest]
            length += len(part) + len(rest)
            at = goal
        return np.concatenate(parts)[:n]

    def contacts(self, path: Array) -> tuple[Contact, ...]:
        """Return the contacts of a day that follows positions [n, 7]."""
        kinds = self.rng.permutation([kind for kind, count in EVENTS.items() for _ in range(count)])
        lasting = sum(RISE_S[kind] + HOLD_S[kind] + FALL_S for kind in kinds)
        gap = (len(path) * CYCLE_S - LEARN_S - 2.0 - lasting) / len(kinds)
        at, found = LEARN_S + 0.5, []
        for kind in kinds:
            start = at + self.rng.uniform(0.2, 0.5) * gap
            full = start + RISE_S[kind]
            end = full + HOLD_S[kind]
            found.append(self._contact(str(kind), start, full, end, path[round(full / CYCLE_S)]))
            at += RISE_S[kind] + HOLD_S[kind] + FALL_S + gap
        return tuple(found)

    def _contact(self, kind: str, start: float, full: float, end: float, pose: Array) -> Contact:
        rng = self.rng
        log = rng.uniform(*np.log(FORCES_N))
        size = float(np.exp(log)) if kind in ("curve", "any") else FORCE_N
        surface = Surface(self.model, self.data, pose)
        while True:
            link = int(rng.integers(1, JOINTS + 1))
            point, normal = surface.drawn(rng, link)
            if point is None:
                continue
            tilted = _tilted(rng, -normal)
            if kind == "any" or surface.lever(link, point, tilted) >= LEVER_M:
                local, way = surface.local(link, point, tilted)
                return Contact(kind, start, full, end, link, _three(local), _three(size * way))


def _three(x: Array) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


def _tilted(rng: np.random.Generator, way: Array) -> Array:
    angle, side = rng.uniform(0.0, TILT), rng.normal(size=3)
    side -= way * (side @ way)
    return np.asarray(np.cos(angle) * way + np.sin(angle) * side / np.linalg.norm(side))


class Surface:
    """The URDF's cylinders and spheres in a pose; vectors in base axes."""

    def __init__(self, model: Any, data: Any, pose: Array) -> None:
        self.model, self.data = model, data
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)

    def drawn(self, rng: np.random.Generator, link: int) -> tuple[Any, Array]:
        """Return a point on a cylinder of a link that no other body covers, and its normal; (None, ...) for a miss."""
        model, data = self.model, self.data
        geoms = np.flatnonzero(
            (model.geom_bodyid == link) & (model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
        )
        lengths = model.geom_size[geoms, 1]
        geom = int(rng.choice(geoms, p=lengths / lengths.sum()))
        turn = data.geom_xmat[geom].reshape(3, 3)
        phi, along = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0) * model.geom_size[geom, 1]
        normal = turn @ np.array([np.cos(phi), np.sin(phi), 0.0])
        point = data.geom_xpos[geom] + model.geom_size[geom, 0] * normal + along * turn[:, 2]
        covered = any(self._inside(other, point) for other in range(model.ngeom) if other != geom)
        return (None if covered else point), normal

    def _inside(self, geom: int, point: Array) -> bool:
        turn = self.data.geom_xmat[geom].reshape(3, 3)
        x, y, z = turn.T @ (point - self.data.geom_xpos[geom])
        radius, half = self.model.geom_size[geom, :2]
        if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            return bool(x * x + y * y + z * z < radius * radius)
        return bool(x * x + y * y < radius * radius and abs(z) < half)

    def lever(self, link: int, point: Array, way: Array) -> float:
        """Return the largest torque on a joint per force [m]."""
        jacobian = np.zeros((3, JOINTS))
        mujoco.mj_jac(self.model, self.data, jacobian, None, point, link)
        return float(np.abs(jacobian.T @ way).max())

    def local(self, link: int, point: Array, way: Array) -> tuple[Array, Array]:
        turn = self.data.xmat[link].reshape(3, 3)
        return turn.T @ (point - self.data.xpos[link]), turn.T @ way


class Trial:
    """All runs of one arm of a trial; days of the three sets have numbers of their own."""

    def __init__(self, plant: str, seed: int, arm: int) -> None:
        self.plant, self.key = plant, [seed, arm]
        self.arm = Arm(plant, 1000 * seed + arm)

    def _rng(self, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([*self.key, 41, *numbers])

    def identification(self, runs: int = IDENTIFY_RUNS, seconds: float = IDENTIFY_S) -> list[Weighed]:
        """Return free motion, every other run with KNOWN at the tool, which was weighed with an error."""
        off = self._rng(0).uniform(-1.0, 1.0, 4)
        weighed = Payload(
            KNOWN.mass_kg + WEIGHED_KG * off[0], _three(np.array(KNOWN.centre_m) + WEIGHED_M * off[1:])
        )
        found = []
        for k in range(runs):
            path = Drawer(self._rng(1, k)).motion(seconds)
            found.append(
                Weighed(Run(k, path, KNOWN if k % 2 else Payload()), weighed if k % 2 else Payload())
            )
        return found

    def contact(self, day: int, seconds: float = CONTACT_S) -> Run:
        """Return a day with contacts."""
        drawer = Drawer(self._rng(2, day))
        payload, path = _payload(drawer.rng), drawer.motion(seconds)
        return Run(1000 + day, path, payload, drawer.contacts(path))

    def quiet(self, day: int, seconds: float = QUIET_S) -> Run:
        """Return a day without contact, on which the jtqd of one joint has no torque for a while."""
        drawer = Drawer(self._rng(3, day))
        path, payload = drawer.motion(seconds), _payload(drawer.rng)
        start = drawer.rng.uniform(LEARN_S + 1.0, seconds - SILENCE_S - 2.0)
        silence = Silence(int(drawer.rng.integers(JOINTS)), float(start), float(start) + SILENCE_S)
        return Run(100000 + day, path, payload, silences=(silence,))


def _payload(rng: np.random.Generator) -> Payload:
    """Return a payload of 0 to 3 kg, one in six days none."""
    mass = rng.uniform(0.0, HEAVIEST_KG) * float(rng.uniform() > 1.0 / 6.0)
    return Payload(float(mass), _three(rng.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 0.1])))


def error_process(
    arm: Arm, run: Run, truth: Truth, rng: np.random.Generator, plant: str
) -> tuple[Array, Array, Array]:
    """Return torque, sigma and status [n, 7] of joints that are as wrong as ERRORS says.

    Waves belong to the arm, what is constant to the day. Real estimates of a jtqd per joint come in this function's place.
    """
    size, parts = ERRORS[plant]
    n = len(truth.drive_nm)
    turns = np.random.default_rng([arm.seed, 42]).uniform(0.0, 2.0 * np.pi, (4, JOINTS))
    motor, link = truth.motor_rad, truth.link_rad
    errors = (
        np.broadcast_to(rng.normal(size=JOINTS), (n, JOINTS)),
        np.cos(motor + turns[0]) + np.cos(2.0 * motor + turns[1]),
        np.cos(link + turns[2]) + np.cos(2.0 * link + turns[3]),
        coloured(rng, n, SLOW_S),
        coloured(rng, n, REST_S),
    )
    sigma = size * arm.rated_nm
    error = sigma * sum(np.sqrt(part) * each for part, each in zip(parts, errors, strict=True))
    shape = (n, JOINTS)
    return truth.drive_nm + error, np.broadcast_to(sigma, shape), np.full(shape, VALID, np.int8)


def coloured(rng: np.random.Generator, n: int, lasting_s: float) -> Array:
    """Return noise [n, 7] of variance 1 that forgets within lasting_s (Ornstein-Uhlenbeck)."""
    from scipy.signal import lfilter

    keep = np.exp(-CYCLE_S / lasting_s)
    drive = np.sqrt(1.0 - keep * keep) * rng.normal(size=(n, JOINTS))
    first = rng.normal(size=(1, JOINTS))
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0, zi=keep * first)[0])


def batches(runs: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [runs[k : k + size] for k in range(0, len(runs), size)]
