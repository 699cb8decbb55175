"""Bench `mujoco`: six runs of 20 s of the plant of `mujoco_plant`, with effects hidden in the model or in its channels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from validation.diagnosis.entries import (
    CHANNELS,
    ENTRIES,
    SENSOR,
    Array,
    Columns,
    Hidden,
    Joint,
    Set,
    Truth,
    at_sensor,
    bench_parameters,
    clip_sensor,
    foreign_truth,
    line_place,
    rated_a,
    rated_nm,
    reflected,
    times,
)
from validation.diagnosis.mujoco_plant import (
    SHAPES,
    STEP_S,
    JointPlant,
    Motion,
    Signals,
    Wave,
    draw_motion,
    integrate,
)
from validation.diagnosis.recorder import low_pass

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


class MujocoBench:
    """The bench; fewer and shorter runs for tests of the bench itself."""

    name = "mujoco"
    real = False
    effects: Sequence[str] = tuple(ENTRIES)
    foreign: Sequence[str] = (
        "slipping_hub",
        "dragging_brake",
        "rubbing_cover",
        "clipping_sensor",
        "vibrating_frame",
        "frozen_current",
    )

    def __init__(self, runs: int = RUNS, seconds: float = SECONDS) -> None:
        self.runs, self.seconds = runs, seconds

    def places(self, name: str) -> Sequence[int | str]:
        """Return where an effect or a foreign kind can be."""
        return (SENSOR,) if at_sensor(name) or name in ("clipping_sensor", "vibrating_frame") else (1, 2)

    def variants(self, name: str) -> Sequence[str]:
        """Return the variants of an effect: all channels can be late."""
        return CHANNELS if name == "channel_delay" else ("",)

    def unseen(self) -> MujocoBench:
        """Return the bench itself: nothing is fitted to its runs."""
        return self

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
            measured, current = current, _repeated(current, c.frozen[run][1])
            wrong = float(np.sqrt(np.mean((current - measured) ** 2))) / amps
            c.frozen_of_rated = max(c.frozen_of_rated, wrong)
        name = f"j{j + 1}"
        columns[f"{name}.current_a"] = current
        columns[f"{name}.motor_position_rad"] = motor
        columns[f"{name}.motor_velocity_rad_s"] = _velocity(motor)
        columns[f"{name}.link_position_rad"] = link
        columns[f"{name}.link_velocity_rad_s"] = _velocity(link)
        columns[f"{name}.torque_nm"] = reading
        columns[f"{name}.temperature_c"] = temperature
    return columns


def _late(x: Array, delay_s: float) -> Array:
    t = np.arange(len(x)) * STEP_S
    late: Array = np.interp(t - delay_s, t, x) if delay_s else x
    return late


def _slow(rng: np.random.Generator, n: int, constant_s: float) -> Array:
    x: Array = low_pass(rng.normal(size=n + 2000), constant_s, STEP_S)[2000:] * np.sqrt(
        2.0 * constant_s / STEP_S
    )
    return x


def _quantised(x: Array, step: float) -> Array:
    rounded: Array = step * np.round(x / step)
    return rounded


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
    return foreign_truth(
        s.item,
        [line_place(hz)],
        frequency_hz=hz,
        amplitude_nm=s.instruments.line[1],
    )


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
