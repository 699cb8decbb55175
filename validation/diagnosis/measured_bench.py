"""Bench `measured`: the Kinova runs that ship (`models/kinova_gen3`), with effects put into the recordings.

A set is one joint with six recordings of its actuator's size: joints 1 to 4, or 5 to 7, of both runs, each in its own or
mirrored about zero (all signs turned). Motion, torque sensor, spikes, repeated rows and noise are as measured. Current
and sensor are put in step with the motion (this recorder wrote the one early, the other late, by a row or two), and an
ordinary ladder is taken from the current,

    G Kt i - G^2 Jm dv/dt - Fc s - Fv v - tau  =  c . (1, s, v, dv/dt, tau, |tau| s) + rest

fitted to each recording alone, so that the joint file is right about the terms in it and the rest stays where it was. The
rest is real and not noise, and a tool that reports it of a set with nothing hidden need not be wrong: real joints have a
ripple. So every set shares its seed with one that hides nothing, and counts by what is found beyond that one. Each run then
gets its day (zero of the sensor, friction). Effects are functions of the measured channels, put into current or sensor.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from validation.diagnosis.entries import (
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
    line_place,
    rated_nm,
    times,
)

FOLDER: Final = Path(__file__).resolve().parents[2] / "models" / "kinova_gen3"
FILES: Final = ("opti_traj_testing1", "RunTrajectory1")
RUNS: Final = 6
STEP_S: Final = 1e-3
SIZES: Final = {"large": (1, 2, 3, 4), "small": (5, 6, 7)}
JOINTS: Final[dict[str, dict[str, Any]]] = {
    "large": {
        "name": "kinova_large",
        "gear_ratio": 100.0,
        "torque_constant_nm_per_a": 0.0913,
        "rotor_inertia_kgm2": 4.0e-5,
        "stiffness_nm_per_rad": 10000.0,
        "damping_nms_per_rad": 10.0,
        "link_inertia_kgm2": 0.01,
        "rated_torque_nm": 32.0,
        "friction": {"coulomb_nm": 3.5, "viscous_nms_per_rad": 2.0},
    },
    "small": {
        "name": "kinova_small",
        "gear_ratio": 100.0,
        "torque_constant_nm_per_a": 0.05852,
        "rotor_inertia_kgm2": 1.0e-5,
        "stiffness_nm_per_rad": 5000.0,
        "damping_nms_per_rad": 5.0,
        "link_inertia_kgm2": 0.005,
        "rated_torque_nm": 13.0,
        "friction": {"coulomb_nm": 2.0, "viscous_nms_per_rad": 1.5},
    },
}
"""Joint files: gear, motor and rating of models/kinova_gen3; the ladder makes the rest true."""
_SLOW_RAD_S: Final = 0.02
_SECOND_S: Final = 1.0
_SHIFTS_S: Final = tuple(np.arange(-3e-3, 3.01e-3, 0.5e-3).tolist())
_DRAW, _DAYS, _HIDDEN = range(3)


class MeasuredBench(Bench):
    """The bench; unseen: with the ladder of each second of a recording fitted to its other seconds (`unseen`)."""

    name = "measured"

    def __init__(self, *, unseen: bool = False) -> None:
        self._unseen = unseen

    def unseen(self) -> MeasuredBench:
        """Return the bench with what a ladder leaves in seconds that it was not fitted to, steps between them and all. A fit
        leaves nothing that looks like its own terms in the runs it was made of: by that, an offset or a friction would
        be visible at any size, to somebody who knows that the file is fitted to these very runs. RunTrajectory1 moves for
        a second and a half, too short for that: it stays as it is fitted, so sizes that come from it are still small ones.
        """
        return MeasuredBench(unseen=True)

    real = True
    effects: Sequence[str] = (
        "coulomb_friction",
        "viscous_friction",
        "stribeck_friction",
        "load_dependent_friction",
        "friction_asymmetry",
        "torque_ripple",
        "torque_constant",
        "torque_constant_saturation",
        "cogging",
        "current_offset",
        "rotor_inertia",
        "sensor_offset",
        "sensor_gain",
        "sensor_crosstalk",
        "channel_delay",
        "unbalance",
    )
    foreign: Sequence[str] = (
        "dragging_brake",
        "rubbing_cover",
        "clipping_sensor",
        "vibrating_frame",
        "frozen_current",
        "dropping_sensor",
    )
    of_sensor = ("clipping_sensor", "vibrating_frame", "dropping_sensor")
    joints = (1,)
    channels = 2

    def draw(self, seed: int, hidden: Sequence[Hidden] = (), *, quiet: bool = False) -> Set:
        rng = np.random.default_rng([seed, _DRAW])
        size = str(rng.choice(sorted(SIZES)))
        joint = JOINTS[size]
        pool = recordings(size, unseen=self._unseen)
        chosen = rng.permutation(len(pool))[:RUNS]
        drawn = [_mirrored(pool[int(k)], float(rng.choice([-1.0, 1.0]))) for k in chosen]
        days = [_day(np.random.default_rng([seed, _DAYS, k]), joint, quiet) for k in range(len(drawn))]
        tables = [_on_its_day(run, joint, day) for run, day in zip(drawn, days, strict=True)]
        truth = []
        for k, item in enumerate(hidden):
            own = np.random.default_rng([seed, _HIDDEN, k])
            if item.name in _PUT:
                p = bench_parameters(item.name, joint, item.size, own, item.variant)
                late = item.name == "channel_delay" and p["channel"] == 0.0
                for table in tables:
                    _PUT[item.name](table, joint, p)
                place = SENSOR if late else item.joint
                truth.append({"name": item.name, "joint": place, "parameters": p, "size": item.size})
            else:
                truth.append(_FOREIGN[item.name](item, tables, joint, own))
        return Set(tables, {1: joint}, truth)


@cache
def _file(name: str) -> dict[str, Array]:
    with gzip.open(FOLDER / f"{name}.csv.gz", "rt", encoding="utf-8") as lines:
        header = lines.readline().strip().split(",")
        table = np.loadtxt(lines, delimiter=",")
    return {column: table[:, k] for k, column in enumerate(header)}


@cache
def recordings(size: str, *, unseen: bool = False) -> tuple[Columns, ...]:
    """Return the recordings of one actuator's size as run tables of joint 1, the ladder taken from their current; unseen: as
    `MeasuredBench.unseen`.
    """
    found = []
    for name in FILES:
        table = _file(name)
        for number in SIZES[size]:
            torque = table[f"TorqueSm{number}"]
            if not np.any(torque):
                continue  # the dead channel of RunTrajectory1
            joint = JOINTS[size]
            columns = {
                "time_s": 1e-3 * table["Time"],
                "j1.current_a": table[f"Cur{number}"],
                "j1.motor_position_rad": joint["gear_ratio"] * table[f"Position{number}"],
                "j1.motor_velocity_rad_s": joint["gear_ratio"] * table[f"Velocity{number}"],
                "j1.torque_nm": torque,
                "j1.temperature_c": table[f"Temp{number}"],
            }
            found.append(_without_ladder(columns, joint, unseen=unseen))
    return tuple(found)


def _gain(joint: Joint) -> float:
    return float(joint["gear_ratio"] * joint["torque_constant_nm_per_a"])


def _speed(run: Columns, joint: Joint) -> Array:
    return np.asarray(run["j1.motor_velocity_rad_s"] / joint["gear_ratio"])


def _direction(v: Array) -> Array:
    return np.asarray(np.tanh(v / _SLOW_RAD_S))


def acceleration(v: Array) -> Array:
    """Return dv/dt of a measured velocity [n]: slope over 15 ms, repeated rows and all."""
    width = 15
    kernel = np.arange(width) - width // 2
    slope = np.convolve(np.pad(v, width // 2, mode="edge"), -kernel / (kernel @ kernel), "valid")
    return np.asarray(slope / STEP_S)


def _without_ladder(run: Columns, joint: Joint, *, unseen: bool) -> Columns:
    v, t = _speed(run, joint), run["time_s"]
    s, a = _direction(v), acceleration(v)
    own = joint["gear_ratio"] ** 2 * joint["rotor_inertia_kgm2"]
    friction = joint["friction"]
    known = own * a + friction["coulomb_nm"] * s + friction["viscous_nms_per_rad"] * v
    moving = np.abs(v) > 2.5 * _SLOW_RAD_S

    def balance(late_current_s: float, early_sensor_s: float) -> tuple[Array, Array, Array, Array]:
        """Return current, sensor, what is left and the ladder, both channels shifted."""
        current = np.interp(t - late_current_s, t, run["j1.current_a"])
        torque = np.interp(t + early_sensor_s, t, run["j1.torque_nm"])
        ladder = np.column_stack((np.ones_like(v), s, v, a, torque, np.abs(torque) * s))
        ladder /= np.sqrt(np.mean(np.square(ladder[moving]), axis=0))
        return current, torque, _gain(joint) * current - known - torque, ladder

    def rest(late_current_s: float, early_sensor_s: float) -> float:
        _, _, left, ladder = balance(late_current_s, early_sensor_s)
        return float(np.mean(np.square((left - ladder @ _fitted(ladder, left, moving))[moving])))

    late = early = 0.0
    for _ in range(2):  # one channel after the other
        late = min(_SHIFTS_S, key=lambda x: rest(x, early))
        early = min(_SHIFTS_S, key=lambda x: rest(late, x))
    current, torque, left, ladder = balance(late, early)
    explained = ladder @ _fitted(ladder, left, moving)
    second = ((t - t[0]) // _SECOND_S).astype(int)
    for k in np.unique(second) if unseen else ():
        others = moving & (second != k)
        if others.sum() * STEP_S > _SECOND_S:
            here = second == k
            explained[here] = ladder[here] @ _fitted(ladder, left, others)
    return {**run, "j1.current_a": current - explained / _gain(joint), "j1.torque_nm": torque}


def _fitted(ladder: Array, left: Array, where: Array) -> Array:
    return np.asarray(np.linalg.lstsq(ladder[where], left[where], rcond=1e-3)[0])


def _mirrored(run: Columns, sign: float) -> Columns:
    return {name: x if name in ("time_s", "j1.temperature_c") else sign * x for name, x in run.items()}


def _day(rng: np.random.Generator, joint: Joint, quiet: bool) -> tuple[float, float, float]:
    zero, coulomb, viscous = rng.uniform(-1.0, 1.0, 3) * (0.0 if quiet else 1.0)
    friction = joint["friction"]
    return (
        0.003 * rated_nm(joint) * float(zero),
        0.03 * friction["coulomb_nm"] * float(coulomb),
        0.06 * friction["viscous_nms_per_rad"] * float(viscous),
    )


def _on_its_day(run: Columns, joint: Joint, day: tuple[float, float, float]) -> Columns:
    table = dict(run)
    v = _speed(run, joint)
    _lose(table, joint, day[1] * _direction(v) + day[2] * v)
    table["j1.torque_nm"] = run["j1.torque_nm"] + day[0]
    return table


def _lose(table: Columns, joint: Joint, loss_nm: Array) -> None:
    """The motor carries this torque beside what it carries, joint side."""
    table["j1.current_a"] = table["j1.current_a"] + loss_nm / _gain(joint)


Put = Callable[[Columns, Joint, Mapping[str, float]], None]


def _loss(of: Callable[[Columns, Array, Joint, Mapping[str, float]], Array]) -> Put:
    return lambda table, joint, p: _lose(table, joint, of(table, _speed(table, joint), joint, p))


def _wave(table: Columns, v: Array, joint: Joint, p: Mapping[str, float]) -> Array:
    angle = p["order_per_motor_rev"] * table["j1.motor_position_rad"] + p["phase_rad"]
    return np.asarray(p["amplitude_nm"] * np.cos(angle))


def _link(table: Columns, joint: Joint) -> Array:
    return np.asarray(table["j1.motor_position_rad"] / joint["gear_ratio"])


def _other_constant(table: Columns, joint: Joint, p: Mapping[str, float]) -> None:
    own = joint["torque_constant_nm_per_a"]
    table["j1.current_a"] = table["j1.current_a"] * own / p["torque_constant_nm_per_a"]


def _saturating(table: Columns, joint: Joint, p: Mapping[str, float]) -> None:
    """i (1 - k |i|) is the current that a motor without saturation needs."""
    k, i = p["saturation_per_a"], table["j1.current_a"]
    root = np.sqrt(np.maximum(1.0 - 4.0 * k * np.abs(i), 0.0))
    table["j1.current_a"] = 2.0 * i / (1.0 + root)


def _sensor(of: Callable[[Columns, Joint, Mapping[str, float]], Array]) -> Put:
    def put(table: Columns, joint: Joint, p: Mapping[str, float]) -> None:
        table["j1.torque_nm"] = of(table, joint, p)

    return put


def _late(table: Columns, joint: Joint, p: Mapping[str, float]) -> None:
    name = "j1.current_a" if p["channel"] == 1.0 else "j1.torque_nm"
    t = table["time_s"]
    table[name] = np.interp(t - p["delay_s"], t, table[name])


_PUT: Final[dict[str, Put]] = {
    "coulomb_friction": _loss(
        lambda t, v, j, p: (p["coulomb_nm"] - j["friction"]["coulomb_nm"]) * _direction(v)
    ),
    "viscous_friction": _loss(
        lambda t, v, j, p: (p["viscous_nms_per_rad"] - j["friction"]["viscous_nms_per_rad"]) * v
    ),
    "stribeck_friction": _loss(
        lambda t, v, j, p: (
            p["stribeck_nm"] * np.exp(-((v / p["stribeck_velocity_rad_s"]) ** 2)) * _direction(v)
        )
    ),
    "load_dependent_friction": _loss(
        lambda t, v, j, p: p["load_coefficient"] * np.abs(t["j1.torque_nm"]) * _direction(v)
    ),
    "friction_asymmetry": _loss(lambda t, v, j, p: p["asymmetry_nm"] * np.abs(_direction(v))),
    "torque_ripple": _loss(_wave),
    "cogging": _loss(_wave),
    "rotor_inertia": _loss(
        lambda t, v, j, p: (
            j["gear_ratio"] ** 2 * (p["rotor_inertia_kgm2"] - j["rotor_inertia_kgm2"]) * acceleration(v)
        )
    ),
    "unbalance": _loss(lambda t, v, j, p: p["moment_nm"] * np.sin(_link(t, j) + p["phase_rad"])),
    "torque_constant": _other_constant,
    "torque_constant_saturation": _saturating,
    "current_offset": lambda t, j, p: t.__setitem__("j1.current_a", t["j1.current_a"] + p["offset_a"]),
    "sensor_offset": _sensor(lambda t, j, p: t["j1.torque_nm"] + p["offset_nm"]),
    "sensor_gain": _sensor(lambda t, j, p: t["j1.torque_nm"] * p["gain"]),
    "sensor_crosstalk": _sensor(
        lambda t, j, p: t["j1.torque_nm"] + p["amplitude_nm"] * np.cos(_link(t, j) + p["phase_rad"])
    ),
    "channel_delay": _late,
}


# What is in no library.


def _spans(
    rng: np.random.Generator, table: Columns, each_s: tuple[float, float], count: int
) -> list[tuple[float, float]]:
    end = float(table["time_s"][-1])
    begins = np.sort(rng.uniform(0.2, 0.85 * end, count))
    return [(float(b), float(min(b + rng.uniform(*each_s), end))) for b in begins]


def _in(table: Columns, spans: Sequence[tuple[float, float]]) -> Array:
    t = table["time_s"]
    return np.asarray(np.any([(t >= low) & (t < high) for low, high in spans], axis=0))


Tables = Sequence[Columns]
Foreign = Callable[[Hidden, Tables, Joint, np.random.Generator], Truth]


def _dragging_brake(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    places, nm = [], 0.08 * rated_nm(joint)
    for k in rng.permutation(len(tables))[: max(len(tables) // 2, 1)]:
        table = tables[int(k)]
        spans = _spans(rng, table, (0.15, 0.5), 2)
        _lose(table, joint, nm * _in(table, spans) * _direction(_speed(table, joint)))
        places += times(int(k), spans)
    return foreign_truth(item, places, torque_nm=nm)


def _rubbing_cover(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    angles = np.concatenate([_link(t, joint)[np.abs(_speed(t, joint)) > 0.1] for t in tables]) % (2.0 * np.pi)
    counts, edges = np.histogram(angles, 40, (0.0, 2.0 * np.pi))
    low = float(edges[int(np.argmax(counts))])
    high, nm = low + 0.3, 0.08 * rated_nm(joint)
    for table in tables:
        inside = (_link(table, joint) - low) % (2.0 * np.pi) < high - low
        _lose(table, joint, nm * inside * _direction(_speed(table, joint)))
    return foreign_truth(item, [{"axis": "link_angle", "low": low, "high": high}], torque_nm=nm)


def _clipping_sensor(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    most, places = clip_sensor(tables, 0.9, STEP_S)
    return foreign_truth(item, places, torque_nm=most)


def _vibrating_frame(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    hz, nm = float(rng.uniform(14.0, 40.0)), 0.03 * rated_nm(joint)
    for table in tables:
        wave = nm * np.sin(2.0 * np.pi * hz * table["time_s"] + rng.uniform(0.0, 6.0))
        table["j1.torque_nm"] = table["j1.torque_nm"] + wave
    return foreign_truth(item, [line_place(hz)], frequency_hz=hz, amplitude_nm=nm)


def _frozen_current(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    places = []
    for k, table in enumerate(tables):
        spans = _spans(rng, table, (0.06, 0.15), 2)
        current = table["j1.current_a"].copy()
        for low, high in spans:
            first, end = np.searchsorted(table["time_s"], (low, high))
            current[first:end] = current[first]
        table["j1.current_a"] = current
        places += times(k, spans)
    return foreign_truth(item, places)


def _dropping_sensor(item: Hidden, tables: Tables, joint: Joint, rng: np.random.Generator) -> Truth:
    places = []
    for k, table in enumerate(tables):
        spans = _spans(rng, table, (0.02, 0.05), 2)
        table["j1.torque_nm"] = np.where(_in(table, spans), 0.0, table["j1.torque_nm"])
        places += times(k, spans)
    return foreign_truth(item, places)


_FOREIGN: Final[dict[str, Foreign]] = {
    "dragging_brake": _dragging_brake,
    "rubbing_cover": _rubbing_cover,
    "clipping_sensor": _clipping_sensor,
    "vibrating_frame": _vibrating_frame,
    "frozen_current": _frozen_current,
    "dropping_sensor": _dropping_sensor,
}
