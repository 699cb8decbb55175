"""Two flexible geared joints against one force sensor, integrated by MuJoCo, and the motions that they are asked to do.

Per joint, on the joint side: a rotor (armature, frictionloss, damping, a motor with a gear and a current that lags), a fixed
tendon as the gear's spring (stiffness, damping, springlength: its dead zone), and a link. An equality constraint couples
the links face to face; its force is what the sensor feels. What MuJoCo has no element for is a generalised force on
rotor and link in the same step.

The integrator is `Euler`, on purpose: the implicit ones take the damping of a tendon into the step for each body of its own
and leave out what couples two bodies, as rotor and link are here. Both inertias were then larger than given by time step
times damping, 4 to 8 % for a link.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import cos, exp, sin
from typing import Any, Final

import numpy as np

from validation.diagnosis.entries import Array

STEP_S: Final = 1e-3


@dataclass(frozen=True)
class Motion:
    """leader: index (0, 1) of the joint in velocity mode; the other follows load_a. temperature_c: [2, n]."""

    leader: int
    velocity_rad_s: Array
    load_a: Array
    start_rad: float
    temperature_c: Array


def _waves(rng: np.random.Generator, t: Array, slowest_s: float, fastest_s: float) -> Array:
    periods = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), 4))
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    x = sum(np.sin(2.0 * np.pi * t / p + f) * p**0.4 for p, f in zip(periods, phases, strict=True))
    y: Array = x / np.max(np.abs(x))
    return y


def _moves(rng: np.random.Generator, t: Array) -> Array:
    """Point to point: trapezoids of velocity with rests between."""
    v = np.zeros_like(t)
    at, side = 0.6, float(rng.choice([-1.0, 1.0]))
    while at < t[-1]:
        top, ramp, length, rest = (
            rng.uniform(0.15, 1.0),
            rng.uniform(0.15, 0.5),
            rng.uniform(0.3, 1.8),
            rng.uniform(0.1, 0.6),
        )
        trapezoid = np.clip(np.minimum((t - at) / ramp, (at + 2 * ramp + length - t) / ramp), 0.0, 1.0)
        v += side * top * trapezoid
        at += 2 * ramp + length + rest
        side = -side
    return v


def _stairs(rng: np.random.Generator, t: Array) -> Array:
    """Return constant velocities up and down both directions."""
    levels = rng.permutation(np.concatenate((x := np.array([0.06, 0.2, 0.45, 0.75, 1.0]), -x)))
    k = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    width = 400
    padded = np.pad(levels[k], width, mode="edge")
    smooth: Array = np.convolve(padded, np.hanning(width) / np.hanning(width).sum(), "same")[width:-width]
    return smooth


def _creep(rng: np.random.Generator, t: Array) -> Array:
    period = rng.uniform(2.5, 5.0)
    triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * t / period))
    return rng.uniform(0.08, 0.25) * triangle


def _sweep(rng: np.random.Generator, t: Array) -> Array:
    """Return a swing whose frequency rises while its size falls: equal acceleration."""
    rate = 0.25 * (2.5 / 0.25) ** (t / t[-1])
    phase = 2.0 * np.pi * np.cumsum(rate) * STEP_S
    x: Array = np.sin(phase) * (0.25 / rate) ** 0.5
    return x


def _turns(rng: np.random.Generator, t: Array) -> Array:
    fast = rng.uniform(0.7, 1.0) * float(rng.choice([-1.0, 1.0]))
    v = np.where(t < 0.55 * t[-1], fast, -0.8 * fast)
    smooth: Array = np.convolve(np.pad(v, 300, mode="edge"), np.full(300, 1 / 300), "same")[300:-300]
    return smooth


SHAPES: Final[dict[str, Callable[[np.random.Generator, Array], Array]]] = {
    "waves": lambda rng, t: _waves(rng, t, 9.0, 1.5),
    "moves": _moves,
    "stairs": _stairs,
    "creep": _creep,
    "sweep": _sweep,
    "turns": _turns,
}


def _load(rng: np.random.Generator, t: Array) -> Array:
    if rng.uniform() < 0.5:
        return _waves(rng, t, 8.0, 1.2)
    count = int(rng.integers(8, 16))
    levels = rng.uniform(-1.0, 1.0, count)
    k = np.minimum((t / t[-1] * count).astype(int), count - 1)
    smooth: Array = np.convolve(np.pad(levels[k], 100, mode="edge"), np.full(100, 0.01), "same")[100:-100]
    return smooth


def draw_motion(  # noqa: PLR0917
    rng: np.random.Generator,
    kind: str,
    run: int,
    seconds: float,
    speed_rad_s: float,
    load_a: tuple[float, float],
) -> Motion:
    """Return run number `run`; load_a: largest current of joints 1 and 2 while they are the load."""
    t = STEP_S * np.arange(round(seconds / STEP_S))
    leader = int(rng.integers(2))
    begin = np.clip(t / 0.5, 0.0, 1.0)
    warm = [
        24.0
        + 2.5 * run
        + rng.uniform(0.0, 3.0)
        + rng.uniform(3.0, 8.0) * (1.0 - np.exp(-t / rng.uniform(5, 20)))
        for _ in range(2)
    ]
    return Motion(
        leader,
        speed_rad_s * SHAPES[kind](rng, t) * begin,
        load_a[1 - leader] * _load(rng, t) * begin,
        float(rng.uniform(-3.0, 3.0)),
        np.array(warm),
    )


SUBSTEPS: Final = 2
DT_S: Final = STEP_S / SUBSTEPS
CURRENT_LAG_S: Final = 0.001
_WARM_EVERY: Final = 50  # steps between changes of what depends on temperature


@dataclass
class Wave:
    """amplitude, order per motor revolution, phase."""

    amplitude: float
    order: float
    phase: float


@dataclass
class JointPlant:
    """True values of one joint, SI, joint side but for `kt` (motor side); what is 0 or empty is not there.

    drags: (begin_s, end_s, nm) of a brake that is not open; slips: (begin_s, end_s) with a softer spring; cover: friction of
    `cover_nm` on the link within `cover_rad` (low, high), modulo a turn.
    """

    ratio: float
    kt: float
    inertia: float
    stiffness: float
    damping: float
    link_inertia: float
    coulomb: float
    viscous: float
    stribeck: float = 0.0
    stribeck_velocity: float = 0.1
    load_coefficient: float = 0.0
    asymmetry: float = 0.0
    viscous_per_k: float = 0.0
    kt_per_k: float = 0.0
    saturation: float = 0.0
    cubic: float = 0.0
    hysteresis_nm: float = 0.0
    hysteresis_rad: float = 1e-4
    play_rad: float = 0.0
    unbalance_nm: float = 0.0
    unbalance_phase: float = 0.0
    waves: list[Wave] = field(default_factory=list)
    kinematic: Wave | None = None
    drags: list[tuple[float, float, float]] = field(default_factory=list)
    slips: list[tuple[float, float]] = field(default_factory=list)
    cover_nm: float = 0.0
    cover_rad: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Signals:
    """What happened, [n] or [n, 2] at 1 kHz; angles on the joint side, each joint in its own frame."""

    current_a: Array
    motor_rad: Array
    link_rad: Array
    sensor_nm: Array


def model_xml(joints: tuple[JointPlant, JointPlant]) -> str:
    """Return the bench in MuJoCo's format."""
    bodies, tendons, motors = [], [], []
    for k, j in enumerate(joints, 1):
        bodies.append(
            f"""
    <body name="rotor{k}"><inertial pos="0 0 0" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
      <joint name="motor{k}" axis="0 0 1" armature="{j.inertia!r}" frictionloss="{j.coulomb!r}" damping="{j.viscous!r}"
        solreffriction="{2 * DT_S} 1" solimpfriction="0.99 0.999 0.001"/></body>
    <body name="body{k}"><inertial pos="0 0 0" mass="1" diaginertia="1 1 {j.link_inertia!r}"/>
      <joint name="link{k}" axis="0 0 1"/></body>"""
        )
        half = 0.5 * j.play_rad
        tendons.append(
            f"""
    <fixed name="gear{k}" stiffness="{j.stiffness!r}" damping="{j.damping!r}" springlength="{-half!r} {half!r}">
      <joint joint="motor{k}" coef="1"/><joint joint="link{k}" coef="-1"/></fixed>"""
        )
        motors.append(
            f"""
    <general joint="motor{k}" gear="{j.ratio!r}" gainprm="{j.kt!r}" biastype="none" dyntype="filterexact"
      dynprm="{CURRENT_LAG_S}"/>"""
        )
    return f"""<mujoco><option timestep="{DT_S}" gravity="0 0 0" integrator="Euler" solver="Newton"/>
  <worldbody>{"".join(bodies)}
  </worldbody>
  <tendon>{"".join(tendons)}
  </tendon>
  <equality><joint joint1="link2" joint2="link1" polycoef="0 -1 0 0 0" solref="{2 * DT_S} 1" solimp="0.999 0.9999 0.001"/>
  </equality>
  <actuator>{"".join(motors)}
  </actuator></mujoco>"""


def integrate(joints: tuple[JointPlant, JointPlant], motion: Motion) -> Signals:
    """Return what happens: the leader's drive holds the velocity with a PI controller, the other follows a current."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(model_xml(joints))
    data = mujoco.MjData(model)
    data.qpos[:] = np.array([1.0, 1.0, -1.0, -1.0]) * motion.start_rad  # rotor 1, link 1, rotor 2, link 2
    lead, follow = motion.leader, 1 - motion.leader
    own = joints[lead]
    kp = 40.0 * own.inertia / (own.ratio * own.kt)
    ki = 10.0 * kp
    n = len(motion.velocity_rad_s)
    out = np.empty((n, 7))
    extra = [_Extra(j, model, k, motion.temperature_c[k]) for k, j in enumerate(joints)]
    extra = [e for e in extra if e.there]
    qpos, qvel, ctrl, act, applied = data.qpos, data.qvel, data.ctrl, data.act, data.qfrc_applied
    constraint, step = data.qfrc_constraint, mujoco.mj_step
    wanted, load = motion.velocity_rad_s.tolist(), motion.load_a.tolist()
    total = 0.0
    for k in range(n):
        ctrl[follow] = load[k]
        for s in range(SUBSTEPS):
            error = wanted[k] - qvel[2 * lead]
            total += ki * error * DT_S
            ctrl[lead] = kp * error + total
            for e in extra:
                e.apply(k, k * STEP_S + s * DT_S, qpos, qvel, act, applied)
            if s == 0:
                out[k, :4] = qpos
                out[k, 4:6] = act
            step(model, data)
            if s == 0:
                out[k, 6] = -constraint[1]  # of the moment before the step, as qpos above
    return Signals(out[:, 4:6], out[:, [0, 2]], out[:, [1, 3]], out[:, 6])


class _Extra:
    """Forces and changes of one joint that MuJoCo has no element for."""

    def __init__(self, joint: JointPlant, model: Any, k: int, temperature_c: Array) -> None:
        self.j, self.model, self.k = joint, model, k
        self.temperature = temperature_c.tolist()
        self.state = 0.0
        self.last: float | None = None
        j = joint
        self.friction = bool(j.stribeck or j.load_coefficient or j.asymmetry or j.drags)
        self.spring = bool(j.cubic or j.hysteresis_nm or j.kinematic or j.slips)
        self.warm = bool(j.viscous_per_k or j.kt_per_k)
        self.there = bool(
            self.friction
            or self.spring
            or self.warm
            or j.saturation
            or j.waves
            or j.unbalance_nm
            or j.cover_nm
        )

    def apply(  # noqa: PLR0917
        self, row: int, t: float, qpos: Any, qvel: Any, act: Any, applied: Any
    ) -> None:
        j, rotor = self.j, 2 * self.k
        link = rotor + 1
        q, w = float(qpos[rotor]), float(qvel[rotor])
        d, rate = q - float(qpos[link]), w - float(qvel[link])
        tau = j.stiffness * d + j.damping * rate  # without play: good enough for friction under load
        on_rotor = on_link = 0.0
        if self.warm and row % _WARM_EVERY == 0:
            above = self.temperature[row] - 25.0
            self.model.dof_damping[rotor] = j.viscous * exp(-j.viscous_per_k * above)
            self.model.actuator_gainprm[self.k, 0] = j.kt * (1.0 + j.kt_per_k * above)
        if self.spring:
            slope = twist = twist_rate = 0.0
            if j.kinematic is not None:
                wave = j.kinematic
                angle = wave.order * j.ratio * q + wave.phase
                twist = wave.amplitude * sin(angle)
                slope = wave.amplitude * wave.order * j.ratio * cos(angle)
                twist_rate = slope * w
            soft = 0.4 if any(low <= t < high for low, high in j.slips) else 1.0
            true = soft * j.stiffness * (d + twist) + j.damping * (rate + twist_rate) + j.cubic * d**3
            if j.hysteresis_nm:
                moved = 0.0 if self.last is None else d - self.last
                self.last = d
                self.state = min(max(self.state + moved / j.hysteresis_rad, -1.0), 1.0)
                true += j.hysteresis_nm * self.state
            on_rotor -= true * (1.0 + slope) - tau
            on_link += true - tau
            tau = true
        if self.friction:
            bound = j.coulomb + j.load_coefficient * abs(tau)
            bound += j.stribeck * exp(-((w / j.stribeck_velocity) ** 2))
            bound += j.asymmetry if w > 0.0 else -j.asymmetry
            bound += sum(nm for low, high, nm in j.drags if low <= t < high)
            self.model.dof_frictionloss[rotor] = max(bound, 0.0)
        if j.saturation:
            i = float(act[self.k])
            on_rotor -= j.ratio * j.kt * j.saturation * i * abs(i)
        for wave in j.waves:
            on_rotor -= wave.amplitude * cos(wave.order * j.ratio * q + wave.phase)
        if j.unbalance_nm:
            on_link -= j.unbalance_nm * sin(float(qpos[link]) + j.unbalance_phase)
        if j.cover_nm:
            low, high = j.cover_rad
            if (float(qpos[link]) - low) % 6.283185307179586 < high - low:
                on_link -= j.cover_nm * np.tanh(float(qvel[link]) / 0.01)
        applied[rotor], applied[link] = on_rotor, on_link
