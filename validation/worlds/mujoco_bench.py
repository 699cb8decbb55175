"""Bench `mujoco`: six runs of 20 s of the plant of `mujoco_plant`, with effects hidden in the model or in its channels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from validation.worlds.motions import SHAPES, STEP_S, Motion, draw_motion
from validation.worlds.mujoco_plant import JointPlant, Truth, Wave, integrate
from validation.worlds.recorder import low_pass
from validation.worlds.sets import SENSOR, Array, Columns, Hidden, Set
from validation.worlds.units import CHANNELS, UNITS, parameters, rated_a, rated_nm, reflected

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


class MujocoBench:
    """The bench; fewer and shorter runs for tests of the bench itself."""

    name = "mujoco"
    real = False
    effects: Sequence[str] = tuple(UNITS)
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
        return (
            (SENSOR,)
            if name.startswith("sensor_") or name in ("clipping_sensor", "vibrating_frame")
            else (1, 2)
        )

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
            if item.name in UNITS:
                truth.append(_hide(item, joints, plants, instruments, rng))
            else:
                truth.append(_FOREIGN[item.name](item, joints, motions, plants, instruments, rng))
        tables = []
        for k, motion in enumerate(motions):
            for j, plant in enumerate(plants[k]):
                plant.coulomb *= 1.0 if quiet else float(days[k].coulomb[j])
                plant.viscous *= 1.0 if quiet else float(days[k].viscous[j])
            happened = integrate((plants[k][0], plants[k][1]), motion)
            rng = np.random.default_rng([seed, _NOISE, k])
            tables.append(_measured(happened, motion, joints, instruments, days[k], k, rng, quiet))
        if instruments.clip_share:
            _clip(tables, instruments.clip_share, truth)
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
    rng: np.random.Generator, joints: Sequence[Mapping[str, Any]], runs: int, seconds: float
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


def _draw_day(rng: np.random.Generator, joints: Sequence[Mapping[str, Any]]) -> Day:
    smallest = min(rated_nm(j) for j in joints)
    return Day(
        coulomb=1.0 + 0.03 * rng.uniform(-1.0, 1.0, 2),
        viscous=1.0 + 0.06 * rng.uniform(-1.0, 1.0, 2),
        sensor_nm=0.003 * smallest * float(rng.uniform(-1.0, 1.0)),
        link_rad=5e-6 * rng.uniform(-1.0, 1.0, 2),
        current_a=0.0005 * np.array([rated_a(j) for j in joints]) * rng.uniform(-1.0, 1.0, 2),
    )


def _plant(joint: Mapping[str, Any]) -> JointPlant:
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


def _hide(
    item: Hidden,
    joints: Sequence[Mapping[str, Any]],
    plants: Sequence[Sequence[JointPlant]],
    instruments: Instruments,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Put an effect of the library into all runs and return its truth."""
    j = 0 if item.joint == SENSOR else int(item.joint) - 1
    p = parameters(item.name, joints[j], item.size, rng, item.variant)
    joint: int | str = item.joint
    if item.name == "channel_delay" and p["channel"] == 0.0:
        joint = SENSOR
    if item.name in _INSTRUMENT:
        _INSTRUMENT[item.name](instruments, j, p)
    else:
        for run in plants:
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
    truth: Truth,
    motion: Motion,
    joints: Sequence[Mapping[str, Any]],
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


def _times(run: int, spans: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    return [{"axis": "time", "run": f"run{run + 1}", "low": low, "high": high} for low, high in spans]


def _told(item: Hidden, places: list[dict[str, Any]], **numbers: float) -> dict[str, Any]:
    return {"name": item.name, "joint": item.joint, "parameters": numbers, "size": 1.0, "places": places}


def _slipping_hub(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    places = []
    for k, run in enumerate(plants):
        spans = _spans(rng, (0.08, 0.2), 4)
        run[int(item.joint) - 1].slips = spans
        places += _times(k, spans)
    return _told(item, places)


def _dragging_brake(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    j, places = int(item.joint) - 1, []
    nm = 0.08 * rated_nm(joints[j])
    for k in rng.permutation(len(plants))[: max(len(plants) // 2, 1)]:
        spans = _spans(rng, (0.5, 2.0), 3)
        plants[k][j].drags = [(low, high, nm) for low, high in spans]
        places += _times(int(k), spans)
    return _told(item, places, torque_nm=nm)


def _rubbing_cover(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    j = int(item.joint) - 1
    side = 1.0 - 2.0 * j
    passed = np.concatenate([side * (m.start_rad + np.cumsum(m.velocity_rad_s) * STEP_S) for m in motions])
    centre = float(np.median(passed % (2.0 * np.pi)))
    low, high = centre - 0.2, centre + 0.2
    nm = 0.08 * rated_nm(joints[j])
    for run in plants:
        run[j].cover_nm, run[j].cover_rad = nm, (low, high)
    return _told(item, [{"axis": "link_angle", "low": low, "high": high}], torque_nm=nm)


def _clipping_sensor(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    c.clip_share = 0.92
    return _told(item, [])


def _clip(tables: Sequence[Columns], share: float, truth: Sequence[dict[str, Any]]) -> None:
    """Clip the sensor at a quantile of what it read; its places are those loads and those times."""
    most = float(np.quantile(np.abs(np.concatenate([t["j1.torque_nm"] for t in tables])), share))
    places: list[dict[str, Any]] = [
        {"axis": "load", "low": 0.9 * most, "high": np.inf},
        {"axis": "load", "low": -np.inf, "high": -0.9 * most},
        {"axis": "channel", "channel": "torque_nm", "low": 0.99 * most, "high": 1.01 * most},
    ]
    for k, table in enumerate(tables):
        over = np.abs(table["j1.torque_nm"]) > most
        edges = np.flatnonzero(np.diff(np.concatenate(([False], over, [False])).astype(int)))
        places += _times(k, [(a * STEP_S, b * STEP_S) for a, b in zip(edges[::2], edges[1::2], strict=True)])
        for number in (1, 2):
            table[f"j{number}.torque_nm"] = np.clip(table[f"j{number}.torque_nm"], -most, most)
    for item in truth:
        if item["name"] == "clipping_sensor":
            item["places"] += places
            item["parameters"]["torque_nm"] = most


def _vibrating_frame(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    hz = float(rng.uniform(14.0, 40.0))
    c.line = (hz, 0.02 * min(rated_nm(j) for j in joints))
    return _told(
        item,
        [{"axis": "frequency", "low": 0.93 * hz, "high": 1.07 * hz, "unit": "Hz"}],
        frequency_hz=hz,
        amplitude_nm=c.line[1],
    )


def _frozen_current(  # noqa: PLR0917
    item: Hidden, joints: Any, motions: Any, plants: Any, c: Instruments, rng: np.random.Generator
) -> dict[str, Any]:
    places: list[dict[str, Any]] = [{"axis": "channel", "channel": "current_a", "stuck": True}]
    for k in range(len(plants)):
        spans = _spans(rng, (0.06, 0.15), 5)
        c.frozen[k] = (int(item.joint) - 1, spans)
        places += _times(k, spans)
    return _told(item, places)


_FOREIGN: Final[dict[str, Callable[..., dict[str, Any]]]] = {
    "slipping_hub": _slipping_hub,
    "dragging_brake": _dragging_brake,
    "rubbing_cover": _rubbing_cover,
    "clipping_sensor": _clipping_sensor,
    "vibrating_frame": _vibrating_frame,
    "frozen_current": _frozen_current,
}
