"""Bench `mujoco`: six runs of 20 s of two joints in MuJoCo, with effects hidden in the model or in its channels.

Two flexible geared joints stand against one force sensor. Per joint, on the joint side: a rotor (armature, frictionloss,
damping, a motor with a gear and a current that lags), a fixed tendon as the gear's spring (stiffness, damping, springlength:
its dead zone), and a link. An equality constraint couples the links face to face; its force is what the sensor feels. What
MuJoCo has no element for is a generalised force on rotor and link in the same step.

The integrator is `Euler`, on purpose: the implicit ones take the damping of a tendon into the step for each body of its own
and leave out what couples two bodies, as rotor and link are here. Both inertias were then larger than given by time step
times damping, 4 to 8 % for a link.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, exp, sin
from typing import Any, Final, NamedTuple

import numpy as np

from validation.diagnosis.entries import (
    ENTRIES,
    SENSOR,
    Array,
    Bench,
    Columns,
    Hidden,
    Joint,
    Set,
    Truth,
    bench_parameters,
    clip_sensor,
    foreign_truth,
    joint_columns,
    line_place,
    rated_a,
    rated_nm,
    reflected,
    times,
)
from validation.diagnosis.recorder import low_pass

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
    return np.asarray(x / np.max(np.abs(x)))


def _moves(rng: np.random.Generator, t: Array) -> Array:
    """Point to point: trapezoids of velocity with rests between."""
    v = np.zeros_like(t)
    at, side = 0.6, float(rng.choice([-1.0, 1.0]))
    while at < t[-1]:
        top, ramp = rng.uniform(0.15, 1.0), rng.uniform(0.15, 0.5)
        length, rest = rng.uniform(0.3, 1.8), rng.uniform(0.1, 0.6)
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
    return np.convolve(padded, np.hanning(width) / np.hanning(width).sum(), "same")[width:-width]


def _creep(rng: np.random.Generator, t: Array) -> Array:
    period = rng.uniform(2.5, 5.0)
    triangle = 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * t / period))
    return rng.uniform(0.08, 0.25) * triangle


def _sweep(rng: np.random.Generator, t: Array) -> Array:
    """Return a swing whose frequency rises while its size falls: equal acceleration."""
    rate = 0.25 * (2.5 / 0.25) ** (t / t[-1])
    phase = 2.0 * np.pi * np.cumsum(rate) * STEP_S
    return np.asarray(np.sin(phase) * (0.25 / rate) ** 0.5)


def _turns(rng: np.random.Generator, t: Array) -> Array:
    fast = rng.uniform(0.7, 1.0) * float(rng.choice([-1.0, 1.0]))
    v = np.where(t < 0.55 * t[-1], fast, -0.8 * fast)
    return np.convolve(np.pad(v, 300, mode="edge"), np.full(300, 1 / 300), "same")[300:-300]


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
    return np.convolve(np.pad(levels[k], 100, mode="edge"), np.full(100, 0.01), "same")[100:-100]


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
    warm = []
    for _ in range(2):
        first = 24.0 + 2.5 * run + rng.uniform(0.0, 3.0)
        warm.append(first + rng.uniform(3.0, 8.0) * (1.0 - np.exp(-t / rng.uniform(5, 20))))
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
        other = bool(j.saturation or j.waves or j.unbalance_nm or j.cover_nm)
        self.there = self.friction or self.spring or self.warm or other

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


# Joints, motions, days and instruments.

RUNS: Final = 6
SECONDS: Final = 20.0
MOTOR_COUNTS: Final = 2**16
LINK_COUNTS: Final = 2**21
_VELOCITY_LAG_S: Final = 0.002
_JOINTS, _MOTIONS, _DAYS, _NOISE, _HIDDEN = range(5)


@dataclass
class Instruments:
    """Errors of the channels; [2] per joint. frozen: per run spans (begin_s, end_s) of a current that repeats itself."""

    current_offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    current_delay: list[float] = field(default_factory=lambda: [0.0, 0.0])
    link_delay: list[float] = field(default_factory=lambda: [0.0, 0.0])
    eccentricity: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, 0.0), (0.0, 0.0)])
    sensor_offset: float = 0.0
    sensor_gain: float = 1.0
    sensor_per_k: float = 0.0
    sensor_delay: float = 0.0
    crosstalk: tuple[float, float] = (0.0, 0.0)
    clip_share: float = 0.0
    line: tuple[float, float] = (0.0, 0.0)
    frozen: dict[int, tuple[int, list[tuple[float, float]]]] = field(default_factory=dict)
    frozen_of_rated: float = 0.0  # what that is worth as torque, rms over the worst run


@dataclass(frozen=True)
class Day:
    """What one run has of its own: factors on friction [2], zeros of sensor, link encoders [2] and currents [2]."""

    coulomb: Array
    viscous: Array
    sensor_nm: float
    link_rad: Array
    current_a: Array


class Scene(NamedTuple):
    """What an effect or a foreign kind is put into: plants by run and joint."""

    item: Hidden
    joints: Sequence[Joint]
    motions: Sequence[Motion]
    plants: Sequence[Sequence[JointPlant]]
    instruments: Instruments
    rng: np.random.Generator


def _set(**keys: str) -> Callable[[JointPlant, Mapping[str, float]], None]:
    def put(plant: JointPlant, p: Mapping[str, float]) -> None:
        for attribute, parameter in keys.items():
            setattr(plant, attribute, p[parameter])

    return put


def _inertia(plant: JointPlant, p: Mapping[str, float]) -> None:
    plant.inertia = p["rotor_inertia_kgm2"] * plant.ratio**2


def _wave(plant: JointPlant, p: Mapping[str, float]) -> None:
    plant.waves.append(Wave(p["amplitude_nm"], p["order_per_motor_rev"], p["phase_rad"]))


def _kinematic(plant: JointPlant, p: Mapping[str, float]) -> None:
    plant.kinematic = Wave(p["amplitude_rad"], p["order_per_motor_rev"], p["phase_rad"])


_PLANT: Final[dict[str, Callable[[JointPlant, Mapping[str, float]], None]]] = {
    "coulomb_friction": _set(coulomb="coulomb_nm"),
    "viscous_friction": _set(viscous="viscous_nms_per_rad"),
    "stribeck_friction": _set(stribeck="stribeck_nm", stribeck_velocity="stribeck_velocity_rad_s"),
    "load_dependent_friction": _set(load_coefficient="load_coefficient"),
    "friction_asymmetry": _set(asymmetry="asymmetry_nm"),
    "temperature_dependent_friction": _set(viscous_per_k="viscous_per_k"),
    "torque_ripple": _wave,
    "cogging": _wave,
    "kinematic_error": _kinematic,
    "nonlinear_stiffness": _set(cubic="cubic_nm_per_rad3"),
    "hysteresis": _set(hysteresis_nm="torque_nm", hysteresis_rad="travel_rad"),
    "lost_motion": _set(play_rad="width_rad"),
    "gear_damping": _set(damping="damping_nms_per_rad"),
    "torque_constant": _set(kt="torque_constant_nm_per_a"),
    "torque_constant_saturation": _set(saturation="saturation_per_a"),
    "torque_constant_temperature": _set(kt_per_k="per_k"),
    "rotor_inertia": _inertia,
    "link_inertia": _set(link_inertia="link_inertia_kgm2"),
    "unbalance": _set(unbalance_nm="moment_nm", unbalance_phase="phase_rad"),
}


def _delay(c: Instruments, j: int, p: Mapping[str, float]) -> None:
    if p["channel"] == 0.0:
        c.sensor_delay = p["delay_s"]
    elif p["channel"] == 1.0:
        c.current_delay[j] = p["delay_s"]
    else:
        c.link_delay[j] = p["delay_s"]


def _put(attribute: str, parameter: str) -> Callable[[Instruments, int, Mapping[str, float]], None]:
    return lambda c, j, p: setattr(c, attribute, p[parameter])


_INSTRUMENT: Final[dict[str, Callable[[Instruments, int, Mapping[str, float]], None]]] = {
    "current_offset": lambda c, j, p: c.current_offset.__setitem__(j, p["offset_a"]),
    "sensor_offset": _put("sensor_offset", "offset_nm"),
    "sensor_gain": _put("sensor_gain", "gain"),
    "sensor_drift": _put("sensor_per_k", "per_k_nm"),
    "sensor_crosstalk": lambda c, j, p: setattr(c, "crosstalk", (p["amplitude_nm"], p["phase_rad"])),
    "encoder_eccentricity": lambda c, j, p: c.eccentricity.__setitem__(
        j, (p["amplitude_rad"], p["phase_rad"])
    ),
    "channel_delay": _delay,
}


class MujocoBench(Bench):
    """The bench; fewer and shorter runs for tests of the bench itself."""

    name = "mujoco"
    effects: Sequence[str] = tuple(sorted((*_PLANT, *_INSTRUMENT), key=list(ENTRIES).index))
    foreign: Sequence[str] = (
        "slipping_hub",
        "dragging_brake",
        "rubbing_cover",
        "clipping_sensor",
        "vibrating_frame",
        "frozen_current",
    )
    of_sensor = ("clipping_sensor", "vibrating_frame")

    def __init__(self, runs: int = RUNS, seconds: float = SECONDS) -> None:
        self.runs, self.seconds = runs, seconds

    def days(self, seed: int) -> list[Day]:
        """Return what each run of this seed has of its own, unless it is quiet."""
        joints = _draw_joints(np.random.default_rng([seed, _JOINTS]))
        return [_draw_day(np.random.default_rng([seed, _DAYS, k]), joints) for k in range(self.runs)]

    def draw(self, seed: int, hidden: Sequence[Hidden] = (), *, quiet: bool = False) -> Set:
        """Return one set; about half a second per run."""
        runs = self.runs
        joints = _draw_joints(np.random.default_rng([seed, _JOINTS]))
        motions = _draw_motions(np.random.default_rng([seed, _MOTIONS]), joints, runs, self.seconds)
        days = self.days(seed)
        instruments = Instruments()
        plants = [[_plant(j) for j in joints] for _ in range(runs)]
        truth = []
        for k, item in enumerate(hidden):
            rng = np.random.default_rng([seed, _HIDDEN, k])
            scene = Scene(item, joints, motions, plants, instruments, rng)
            truth.append(_hide(scene) if item.name in ENTRIES else _FOREIGN[item.name](scene))
        tables = []
        for k, motion in enumerate(motions):
            for j, plant in enumerate(plants[k]):
                plant.coulomb *= 1.0 if quiet else float(days[k].coulomb[j])
                plant.viscous *= 1.0 if quiet else float(days[k].viscous[j])
            happened = integrate((plants[k][0], plants[k][1]), motion)
            rng = np.random.default_rng([seed, _NOISE, k])
            tables.append(_measured(happened, motion, joints, instruments, days[k], k, rng, quiet))
        if instruments.clip_share:
            most, places = clip_sensor(tables, instruments.clip_share, STEP_S)
            for each in truth:
                if each["name"] == "clipping_sensor":
                    each["places"] += places
                    each["parameters"]["torque_nm"] = most
        for each in truth:
            if each["name"] == "frozen_current":
                each["parameters"]["of_rated"] = instruments.frozen_of_rated
        return Set(tables, {1: joints[0], 2: joints[1]}, truth)


def _rounded(x: float) -> float:
    return float(f"{x:.4g}")


def _draw_joints(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Two joints of one size: rated torques within 30 % of each other, all else drawn apart."""
    size = float(np.exp(rng.uniform(np.log(20.0), np.log(80.0))))
    joints = []
    for number in (1, 2):
        rated = _rounded(size * rng.uniform(0.87, 1.13))
        ratio = float(rng.choice([50, 80, 100, 120, 160]))
        joints.append(
            {
                "name": f"rig{number}",
                "gear_ratio": ratio,
                "torque_constant_nm_per_a": _rounded(rng.uniform(0.05, 0.15)),
                "rotor_inertia_kgm2": _rounded(rated * rng.uniform(0.008, 0.02) / ratio**2),
                "stiffness_nm_per_rad": _rounded(rated * rng.uniform(300.0, 700.0)),
                "damping_nms_per_rad": _rounded(rated * rng.uniform(0.1, 0.25)),
                "link_inertia_kgm2": _rounded(rated * rng.uniform(0.001, 0.003)),
                "rated_torque_nm": rated,
                "friction": {
                    "coulomb_nm": _rounded(rated * rng.uniform(0.05, 0.1)),
                    "viscous_nms_per_rad": _rounded(rated * rng.uniform(0.04, 0.1)),
                },
            }
        )
    return joints


def _draw_motions(
    rng: np.random.Generator, joints: Sequence[Joint], runs: int, seconds: float
) -> list[Motion]:
    kinds = [str(kind) for kind in rng.permutation(list(SHAPES))]
    speed = float(rng.uniform(1.2, 2.2))
    most = 0.55 * min(rated_nm(j) for j in joints)
    load = tuple(
        float(rng.uniform(0.6, 1.0)) * most / rated_nm(j) * rated_a(j)
        + j["friction"]["coulomb_nm"] / rated_nm(j) * rated_a(j)
        for j in joints
    )
    return [
        draw_motion(rng, kinds[k % len(kinds)], k, seconds, speed, (load[0], load[1])) for k in range(runs)
    ]


def _draw_day(rng: np.random.Generator, joints: Sequence[Joint]) -> Day:
    smallest = min(rated_nm(j) for j in joints)
    return Day(
        coulomb=1.0 + 0.03 * rng.uniform(-1.0, 1.0, 2),
        viscous=1.0 + 0.06 * rng.uniform(-1.0, 1.0, 2),
        sensor_nm=0.003 * smallest * float(rng.uniform(-1.0, 1.0)),
        link_rad=5e-6 * rng.uniform(-1.0, 1.0, 2),
        current_a=0.0005 * np.array([rated_a(j) for j in joints]) * rng.uniform(-1.0, 1.0, 2),
    )


def _plant(joint: Joint) -> JointPlant:
    return JointPlant(
        ratio=float(joint["gear_ratio"]),
        kt=float(joint["torque_constant_nm_per_a"]),
        inertia=reflected(joint),
        stiffness=float(joint["stiffness_nm_per_rad"]),
        damping=float(joint["damping_nms_per_rad"]),
        link_inertia=float(joint["link_inertia_kgm2"]),
        coulomb=float(joint["friction"]["coulomb_nm"]),
        viscous=float(joint["friction"]["viscous_nms_per_rad"]),
    )


def _hide(s: Scene) -> Truth:
    """Put an effect of the library into all runs and return its truth."""
    item = s.item
    j = 0 if item.joint == SENSOR else int(item.joint) - 1
    p = bench_parameters(item.name, s.joints[j], item.size, s.rng, item.variant)
    joint = SENSOR if p.get("channel") == 0.0 else item.joint
    if item.name in _INSTRUMENT:
        _INSTRUMENT[item.name](s.instruments, j, p)
    else:
        for run in s.plants:
            _PLANT[item.name](run[j], p)
    return {"name": item.name, "joint": joint, "parameters": p, "size": item.size}


def _measured(  # noqa: PLR0917
    truth: Signals,
    motion: Motion,
    joints: Sequence[Joint],
    c: Instruments,
    day: Day,
    run: int,
    rng: np.random.Generator,
    quiet: bool,
) -> Columns:
    """Return the run table: instruments with noise, quantisation and their errors."""
    n = len(truth.sensor_nm)
    noise = 0.0 if quiet else 1.0
    t = STEP_S * np.arange(n)
    smallest = min(rated_nm(j) for j in joints)
    torque = _late(truth.sensor_nm, c.sensor_delay)
    reading = c.sensor_gain * torque + c.sensor_offset + c.sensor_per_k * (motion.temperature_c[0] - 25.0)
    reading = reading + c.crosstalk[0] * np.cos(truth.link_rad[:, 0] + c.crosstalk[1])
    reading = reading + c.line[1] * np.sin(2.0 * np.pi * c.line[0] * t)
    reading = reading + noise * (
        day.sensor_nm + 5e-4 * smallest * rng.normal(size=n) + 5e-4 * smallest * _slow(rng, n, 0.1)
    )
    if not quiet:
        reading = _quantised(reading, 4.0 * smallest / 2**16)
    columns: Columns = {"time_s": t}
    for j, joint in enumerate(joints):
        amps = rated_a(joint)
        current = _late(truth.current_a[:, j], c.current_delay[j]) + c.current_offset[j]
        current = current + noise * (day.current_a[j] + 2e-3 * amps * rng.normal(size=n))
        motor = float(joint["gear_ratio"]) * truth.motor_rad[:, j]
        size, phase = c.eccentricity[j]
        link = _late(truth.link_rad[:, j], c.link_delay[j])
        link = link + size * np.sin(link + phase) + noise * day.link_rad[j]
        temperature = motion.temperature_c[j]
        if not quiet:
            current = _quantised(current, 4.0 * amps / 2**14)
            motor = _quantised(motor, 2.0 * np.pi / MOTOR_COUNTS)
            link = _quantised(link, 2.0 * np.pi / LINK_COUNTS)
            temperature = np.round(temperature, 1)
        if run in c.frozen and c.frozen[run][0] == j:
            whole, current = current, _repeated(current, c.frozen[run][1])
            wrong = float(np.sqrt(np.mean((current - whole) ** 2))) / amps
            c.frozen_of_rated = max(c.frozen_of_rated, wrong)
        measured = {"current_a": current, "torque_nm": reading, "temperature_c": temperature}
        columns |= joint_columns(j + 1, _velocity, motor_rad=motor, link_rad=link, **measured)
    return columns


def _late(x: Array, delay_s: float) -> Array:
    t = np.arange(len(x)) * STEP_S
    return np.interp(t - delay_s, t, x) if delay_s else x


def _slow(rng: np.random.Generator, n: int, constant_s: float) -> Array:
    noise = low_pass(rng.normal(size=n + 2000), constant_s, STEP_S)[2000:]
    return np.asarray(noise * np.sqrt(2.0 * constant_s / STEP_S))


def _quantised(x: Array, step: float) -> Array:
    return np.asarray(step * np.round(x / step))


def _velocity(position: Array) -> Array:
    return low_pass(np.diff(position, prepend=position[0]) / STEP_S, _VELOCITY_LAG_S, STEP_S)


def _repeated(x: Array, spans: Sequence[tuple[float, float]]) -> Array:
    y = x.copy()
    for low, high in spans:
        k, end = round(low / STEP_S), round(high / STEP_S)
        y[k:end] = y[k]
    return y


# What is in no library. Each puts itself into the set and returns its truth, with the places where it is right to look.


def _spans(rng: np.random.Generator, each_s: tuple[float, float], count: int) -> list[tuple[float, float]]:
    begins = np.sort(rng.uniform(1.0, SECONDS - 3.0, count))
    return [(float(b), float(b + rng.uniform(*each_s))) for b in begins]


def _slipping_hub(s: Scene) -> Truth:
    places = []
    for k, run in enumerate(s.plants):
        spans = _spans(s.rng, (0.08, 0.2), 4)
        run[int(s.item.joint) - 1].slips = spans
        places += times(k, spans)
    return foreign_truth(s.item, places)


def _dragging_brake(s: Scene) -> Truth:
    j, places = int(s.item.joint) - 1, []
    nm = 0.08 * rated_nm(s.joints[j])
    for k in s.rng.permutation(len(s.plants))[: max(len(s.plants) // 2, 1)]:
        spans = _spans(s.rng, (0.5, 2.0), 3)
        s.plants[k][j].drags = [(low, high, nm) for low, high in spans]
        places += times(int(k), spans)
    return foreign_truth(s.item, places, torque_nm=nm)


def _rubbing_cover(s: Scene) -> Truth:
    j = int(s.item.joint) - 1
    side = 1.0 - 2.0 * j
    passed = np.concatenate([side * (m.start_rad + np.cumsum(m.velocity_rad_s) * STEP_S) for m in s.motions])
    centre = float(np.median(passed % (2.0 * np.pi)))
    low, high = centre - 0.2, centre + 0.2
    nm = 0.08 * rated_nm(s.joints[j])
    for run in s.plants:
        run[j].cover_nm, run[j].cover_rad = nm, (low, high)
    return foreign_truth(s.item, [{"axis": "link_angle", "low": low, "high": high}], torque_nm=nm)


def _clipping_sensor(s: Scene) -> Truth:
    s.instruments.clip_share = 0.92
    return foreign_truth(s.item, [])


def _vibrating_frame(s: Scene) -> Truth:
    hz = float(s.rng.uniform(14.0, 40.0))
    s.instruments.line = (hz, 0.02 * min(rated_nm(j) for j in s.joints))
    return foreign_truth(s.item, [line_place(hz)], frequency_hz=hz, amplitude_nm=s.instruments.line[1])


def _frozen_current(s: Scene) -> Truth:
    places: list[dict[str, Any]] = [{"axis": "channel", "channel": "current_a", "stuck": True}]
    for k in range(len(s.plants)):
        spans = _spans(s.rng, (0.06, 0.15), 5)
        s.instruments.frozen[k] = (int(s.item.joint) - 1, spans)
        places += times(k, spans)
    return foreign_truth(s.item, places)


_FOREIGN: Final[dict[str, Callable[[Scene], Truth]]] = {
    "slipping_hub": _slipping_hub,
    "dragging_brake": _dragging_brake,
    "rubbing_cover": _rubbing_cover,
    "clipping_sensor": _clipping_sensor,
    "vibrating_frame": _vibrating_frame,
    "frozen_current": _frozen_current,
}
