"""Sets of runs as a person has them, from four generators: several values of the joint file wrong at once, few digits.

A plan (`plan`) is drawn from (seed, bench, index) within what a generator can draw (`Can`); the generator makes it with the
true plant, and `wrong_files` are what the user has. Generators: `ours` (validation/generator/plant.py), `mujoco`, `belt`
(validation/generator/belt.py), and `practice`, a bench of another hand that is not shipped.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import sys
import tempfile
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.effects import EFFECTS
from validation.diagnosis.balance import spectral
from validation.diagnosis.entries import (
    ENTRIES,
    SENSOR,
    Array,
    Columns,
    Hidden,
    at_sensor,
    bench_parameters,
    rated_a,
    rated_nm,
)
from validation.diagnosis.mujoco_bench import MujocoBench
from validation.generator.draw import UNKNOWN, Builder, Order, draw_many
from validation.study import UsageError

HELD: Final = 2
_SHORTEST_S, _LONGEST_S = 10.0, 60.0
Key = tuple[str, int | str]
"""Name of an effect and its joint, or "sensor"."""


class Sheet(NamedTuple):
    """What a data sheet is off by. sigma: of the value, or of unit(joint) where the file has none (0, or gain 1); lognormal:
    of its logarithm, at least `least` away; both: either sign. key: of the joint file.
    """

    sigma: float
    key: str = ""
    lognormal: bool = False
    least: float = 0.0
    both: bool = True


SHEETS: Final[dict[str, Sheet]] = {
    "torque_constant": Sheet(0.10, "torque_constant_nm_per_a"),
    "coulomb_friction": Sheet(math.log(2.0), "friction.coulomb_nm", True, 0.25),
    "viscous_friction": Sheet(math.log(2.0), "friction.viscous_nms_per_rad", True, 0.25),
    "load_dependent_friction": Sheet(0.20, both=False),
    "rotor_inertia": Sheet(0.20, "rotor_inertia_kgm2"),
    "link_inertia": Sheet(0.20, "link_inertia_kgm2"),
    "nonlinear_stiffness": Sheet(0.15, "stiffness_nm_per_rad"),
    "sensor_gain": Sheet(0.01),
    "sensor_offset": Sheet(0.01),
    "current_offset": Sheet(0.01),
}
"""By the effect that reports it: one standard deviation; 100 % of a friction is a factor of two."""
_LARGEST: Final = 2.5
"""Standard deviations, at most."""
_MOST_LOAD: Final = 0.3
TORSION_ONLY: Final = frozenset(
    {
        "nonlinear_stiffness",
        "hysteresis",
        "lost_motion",
        "encoder_eccentricity",
        "gear_damping",
        "kinematic_error",
    }
)
STRUCTURE: Final = tuple(
    name
    for name, entry in ENTRIES.items()
    if name == "nonlinear_stiffness" or (name not in SHEETS and not entry.key)
)


@dataclass(frozen=True)
class Can:
    """What a generator can draw: (joints, reference) pairs, numbers of encoders, structural effects, values, foreign kinds,
    whether friction can have a smooth rest. seconds: of all its runs, None: drawn.
    """

    setups: Sequence[tuple[int, str]]
    effects: Sequence[str]
    foreign: Sequence[str]
    smooth: bool
    values: Sequence[str] = tuple(SHEETS)
    encoders: Sequence[int] = (1, 2)
    longest_s: float = _LONGEST_S


@dataclass(frozen=True)
class Plan:
    """What a set is to be: before a generator makes it. values: (name, joint, standard deviations)."""

    index: int
    seed: int
    joints: int
    reference: str
    encoders: int
    runs: int
    seconds: float
    rate_hz: float
    digits: int
    values: tuple[tuple[str, int | str, float], ...]
    effects: tuple[Key, ...]
    rest: tuple[str, int] | None
    rest_share: float
    held: int = HELD

    @property
    def known_load(self) -> bool:
        """Whether the torque is a known load or a model's: no sensor."""
        return not self.reference.startswith("sensor")

    @property
    def nothing(self) -> bool:
        return not (self.values or self.effects or self.rest)


@dataclass
class Entry:
    """Something that is there: parameters as in a joint file; base: the parameter that carries it -> the file's value."""

    name: str
    joint: int | str
    parameters: dict[str, float]
    base: dict[str, float]
    wrong_value: bool

    @property
    def key(self) -> Key:
        return self.name, self.joint


@dataclass
class Drawn:
    """A set: true files by joint (values only), entries, runs (the tool's and then the held-out ones), column map; without:
    the first runs with the same noise and no rest.
    """

    true: dict[int, dict[str, Any]]
    entries: list[Entry]
    runs: list[Columns]
    columns: dict[str, Any] | None = None
    without: list[Columns] = field(default_factory=list)


# What is drawn.


def plan(  # noqa: PLR0917
    can: Can, bench: str, seed: int, index: int, none_share: float = 0.2, held: int = HELD
) -> Plan:
    """Return the plan of a set; the same for (seed, bench, index)."""
    rng = np.random.default_rng([seed, *bench.encode(), index])
    own = int(rng.integers(2**31))
    nothing = bool(rng.uniform() < none_share)
    joints, reference = can.setups[int(rng.integers(len(can.setups)))]
    encoders = int(rng.choice(can.encoders))
    runs = int(rng.choice([3, 4, 5, 6, 7, 8], p=[0.2, 0.25, 0.2, 0.15, 0.1, 0.1]))
    seconds = _SHORTEST_S * (_LONGEST_S / _SHORTEST_S) ** float(rng.uniform() ** 2)
    rate = float(rng.choice([100.0, 125.0, 200.0, 250.0, 500.0, 1000.0]))
    digits = int(rng.choice([5, 6, 7, 12], p=[0.25, 0.3, 0.35, 0.1]))
    known = not reference.startswith("sensor")
    places = range(1, joints + 1)

    def possible(names: Sequence[str]) -> list[Key]:
        return [
            (name, place)
            for name in names
            if not (encoders == 1 and name in TORSION_ONLY) and not (known and at_sensor(name))
            for place in ((SENSOR,) if at_sensor(name) else places)
        ]

    pool = possible(can.values)
    chosen = [pool[k] for k in rng.permutation(len(pool))[: int(rng.integers(3, 7))]]
    z = [float(np.clip(rng.normal(), -_LARGEST, _LARGEST)) for _ in chosen]
    structure = possible(can.effects)
    effects: list[Key] = []
    for k in rng.permutation(len(structure))[: int(rng.integers(0, 3))]:
        if structure[k][0] not in {name for name, _ in (*chosen, *effects)}:
            effects.append(structure[k])
    rest: tuple[str, int] | None = None
    kinds = [*(["smooth"] * 2 if can.smooth else []), *(["foreign"] if can.foreign else [])]
    amount, which = float(rng.uniform(0.0, 0.3)), float(rng.uniform())
    if rng.uniform() < 0.6 and kinds:
        kind = kinds[int(which * len(kinds))]
        kind = str(rng.choice(list(can.foreign))) if kind == "foreign" else kind
        rest = (kind, int(rng.integers(1, joints + 1)))
    return Plan(
        index,
        own,
        joints,
        reference,
        encoders,
        runs,
        round(min(seconds, can.longest_s), 1),
        rate,
        digits,
        () if nothing else tuple((*key, x) for key, x in zip(chosen, z, strict=True)),
        () if nothing else tuple(effects),
        None if nothing else rest,
        amount,
        held,
    )


def hidden_values(plan: Plan, true: Mapping[int, Mapping[str, Any]]) -> dict[Key, dict[str, float]]:
    """Return the parameters of the values that no joint file has a key for: they are effects of the runs."""
    units: dict[str, tuple[str, Callable[[Mapping[str, Any]], float], float]] = {
        "load_dependent_friction": ("load_coefficient", lambda joint: 1.0, 0.0),
        "sensor_gain": ("gain", lambda joint: 1.0, 1.0),
        "sensor_offset": ("offset_nm", rated_nm, 0.0),
        "current_offset": ("offset_a", rated_a, 0.0),
    }
    out: dict[Key, dict[str, float]] = {}
    for name, place, z in plan.values:
        if name in units:
            parameter, unit, neutral = units[name]
            sheet, joint = SHEETS[name], true[place if isinstance(place, int) else 1]
            size = sheet.sigma * unit(joint) * (z if sheet.both else min(abs(z), _MOST_LOAD / sheet.sigma))
            out[name, place] = {parameter: neutral + size}
    return out


def wrong_files(plan: Plan, true: Mapping[int, Mapping[str, Any]]) -> dict[int, dict[str, Any]]:
    """Return the files that the tool gets: the true ones with the planned values off."""
    out = {number: json.loads(json.dumps(dict(joint))) for number, joint in true.items()}
    for name, place, z in plan.values:
        sheet = SHEETS[name]
        if sheet.key and isinstance(place, int):
            factor = 1.0 + sheet.sigma * z
            if sheet.lognormal:
                factor = math.exp(sheet.sigma * z)
                if abs(factor - 1.0) < sheet.least:
                    factor = 1.0 + sheet.least if z > 0.0 else 1.0 / (1.0 + sheet.least)
            head, _, tail = sheet.key.partition(".")
            target = out[place][head] if tail else out[place]
            target[tail or head] = float(f"{target[tail or head] * factor:.4g}")
    return out


def entries_of(
    plan: Plan, true: Mapping[int, Mapping[str, Any]], effects: Mapping[Key, Mapping[str, float]]
) -> list[Entry]:
    """Return all that is there; effects: parameters of the hidden effects by name and joint."""
    files, out = wrong_files(plan, true), []
    for name, place, _ in plan.values:
        sheet = SHEETS[name]
        if sheet.key and isinstance(place, int):
            key = sheet.key.rpartition(".")[2]
            value, file = (value_of(f[place], sheet.key) for f in (true, files))
            out.append(Entry(name, place, {key: value}, {key: file}, True))
    wrong = {(name, place) for name, place, _ in plan.values}
    for (name, place), p in effects.items():
        joint = files[place if isinstance(place, int) else 1]
        out.append(Entry(name, place, dict(p), _carrier(name, p, joint), (name, place) in wrong))
    return out


def value_of(joint: Mapping[str, Any], key: str) -> float:
    head, _, tail = key.partition(".")
    return float(joint[head][tail] if tail else joint[head])


def _carrier(name: str, p: Mapping[str, float], joint: Mapping[str, Any]) -> dict[str, float]:
    """Return the parameter that carries an effect and its value without it: the file's where it has a key."""
    entry = ENTRIES[name]
    parameter = entry.parameter
    if p.get(parameter, entry.neutral) == entry.neutral and entry.second:
        parameter = entry.second
    key = next(q.key for q in EFFECTS[name].parameters if q.name == parameter)
    head, _, tail = key.partition(".")
    own = joint[head].get(tail) if tail else joint.get(head)
    neutral = entry.neutral if parameter == entry.parameter else 0.0
    return {parameter: neutral if own is None else float(own)}


def _smooth_nm(plan: Plan, true: Mapping[int, Mapping[str, Any]]) -> float:
    """Return the size of the smooth rest: its share of what the wrong values are worth in the motor balance, roughly."""
    joint, files = true[plan.rest[1] if plan.rest else 1], wrong_files(plan, true)
    number = plan.rest[1] if plan.rest else 1
    rated = rated_nm(joint)
    off = {
        "torque_constant_nm_per_a": 0.35 * rated / joint["torque_constant_nm_per_a"],
        "friction.coulomb_nm": 1.0,
        "friction.viscous_nms_per_rad": 0.06 * rated / joint["friction"]["viscous_nms_per_rad"],
    }
    squares = [
        (scale * (value_of(files[number], key) - value_of(joint, key))) ** 2 for key, scale in off.items()
    ]
    load = hidden_values(plan, true).get(("load_dependent_friction", number), {}).get("load_coefficient", 0.0)
    squares += [(0.01 * rated) ** 2, (0.35 * rated * load) ** 2]
    return plan.rest_share * 3.0 * math.sqrt(sum(squares))  # its largest part is about three times its rms


# Generators: each turns a plan into a set.


def _ours(p: Plan) -> Drawn:
    count = p.runs + p.held
    true = dict(enumerate(Builder(Order(p.seed, runs=2)).joints, 1))
    values = hidden_values(p, true)
    hidden = [Hidden(name, place, x) for (name, place), x in values.items()]
    hidden += [Hidden(name, place) for name, place in p.effects]
    orders = [Order(p.seed, hidden, "mixed", count, p.seconds)]
    if p.rest is not None:
        kind, joint = p.rest
        size = _smooth_nm(p, true) if kind == "smooth" else None
        strange = Hidden("smooth_friction" if kind == "smooth" else kind, joint, size)
        orders.insert(0, Order(p.seed, [*hidden, strange], "mixed", count, p.seconds))
    cases = draw_many(orders)
    effects = {(t["name"], t["joint"]): t["parameters"] for t in cases[0].truth if t["name"] in ENTRIES}
    runs = cases[0].runs
    order = np.random.default_rng([p.seed, 9]).permutation(count)
    model = p.reference != "sensor"
    tables = [_only(runs[k], p.joints, p.encoders, model) for k in order]
    without = (
        [_only(cases[1].runs[k], p.joints, p.encoders, model) for k in order[: p.runs]] if p.rest else []
    )
    true = {n: dict(true[n]) for n in range(1, p.joints + 1)}
    columns = _model_columns(tables[0]) if model else None
    return Drawn(true, entries_of(p, true, effects), tables, columns, without)


def _only(run: Columns, joints: int, encoders: int, model: bool = False) -> Columns:
    """Return the columns of a run that this user has; model: the torque is that of an arm's rigid-body model, which has no
    noise: the reading through a zero-phase low-pass of 20 Hz.
    """
    kept = {
        name: x
        for name, x in run.items()
        if name == "time_s"
        or (int(name[1]) <= joints and not (encoders == 1 and name.partition(".")[2].startswith("link_")))
    }
    if model:
        t = run["time_s"]
        torque = kept.pop("j1.torque_nm")
        kept["model_nm"] = spectral(torque, float(t[1] - t[0]), 20.0)
    return kept


def _model_columns(run: Columns) -> dict[str, Any]:
    names = [name for name in run if name != "model_nm"]
    return {**{name: name for name in names}, "j1.load": {"torque_nm": "model_nm"}}


def _mujoco(p: Plan) -> Drawn:
    foreign = p.rest is not None
    bench = MujocoBench(p.runs + p.held, max(p.seconds, 20.0) if foreign else p.seconds)
    plain = MujocoBench(1, 2.0).draw(p.seed, quiet=True)
    true = {n: dict(joint) for n, joint in plain.joints.items()}
    rng = np.random.default_rng([p.seed, 8])
    z = {(name, place): abs(x) for name, place, x in p.values}
    hidden = []
    for name, place in hidden_values(p, true):
        size = SHEETS[name].sigma * z[name, place]
        hidden.append(Hidden(name, place, min(size, _MOST_LOAD)))
    for name, place in p.effects:
        own = ENTRIES[name].bench
        most = min(3.0, own.largest / abs(own.start))
        size = abs(own.start) * float(np.exp(rng.uniform(0.0, np.log(max(most, 1.0)))))
        variants = [v for v in bench.variants(name) if not (p.encoders == 1 and v == "link")]
        hidden.append(Hidden(name, place, size, str(rng.choice(variants))))
    strange = [Hidden(p.rest[0], _place(bench, *p.rest), 0.0)] if p.rest is not None else []
    drawn = bench.draw(p.seed, [*hidden, *strange])
    without = bench.draw(p.seed, hidden).runs if strange else []
    effects = {(t["name"], t["joint"]): t["parameters"] for t in drawn.truth if t["name"] in ENTRIES}
    true = {n: true[n] for n in range(1, p.joints + 1)}
    order = np.random.default_rng([p.seed, 9]).permutation(p.runs + p.held)
    tables = [_only(drawn.runs[k], p.joints, p.encoders) for k in order]
    bare = [_only(without[k], p.joints, p.encoders) for k in order[: p.runs]] if without else []
    return Drawn(true, entries_of(p, true, effects), tables, None, bare)


def _place(bench: MujocoBench, name: str, joint: int) -> int | str:
    places = bench.places(name)
    return joint if joint in places else places[0]


def _belt(p: Plan) -> Drawn:
    belt: Any = importlib.import_module("validation.generator.belt")
    rng = np.random.default_rng([p.seed, 8])
    reference, _, transmission = p.reference.partition(" ")
    plant = belt.draw_plant(rng, load=reference, encoders=p.encoders, transmission=transmission)

    def file_of(made: Any) -> dict[str, Any]:
        return {k: x for k, x in belt.joint_file(made).items() if k not in ("effects", "provenance")}

    true = {1: file_of(plant)}
    known: dict[str, Any] = {name: x for (name, _), x in hidden_values(p, true).items()}
    plant = replace(plant, effects={**plant.effects, **known})
    for name, _ in p.effects:
        plant = belt.with_effect(plant, name, rng=rng)
    parameters: dict[str, Mapping[str, float]] = {
        # of an effect that replaces values of the file, else as the plant has it
        name: {q.name: plant.values[q.key] for q in EFFECTS[name].parameters if q.key in plant.values}
        for name, _ in p.effects
        if name not in plant.effects
    }
    effects: dict[Key, Mapping[str, float]] = {
        (name, SENSOR if at_sensor(name) or x.get("channel") == 0.0 else 1): x
        for name, x in {**plant.effects, **parameters}.items()
    }
    kinds = [str(rng.choice(list(belt.MOTIONS))) for _ in range(p.runs + p.held)]
    runs = [belt.Recording(kind, int(rng.integers(2**31)), p.seconds, p.rate_hz, 12) for kind in kinds]
    bare = belt.record(plant, runs, p.seed) if p.rest is not None else []
    if p.rest is not None:
        can = [name for name in belt.showable(plant) if name in belt.FOREIGN]  # else another one of these
        plant = belt.with_effect(plant, p.rest[0] if p.rest[0] in can else can[p.seed % len(can)], rng=rng)
    tables = belt.record(plant, runs, p.seed)
    return Drawn(true, entries_of(p, true, effects), tables, belt.columns_file(plant), bare[: p.runs])


# The practice bench is somebody else's and not shipped. It wants numba and pandas: where they are missing, its equations run
# as plain Python with stand-ins for the few names that it uses.


def _practice_setters(ix: Mapping[str, int]) -> dict[str, Callable[[Any, Any, Mapping[str, float]], None]]:
    """Return effect -> what it sets in the bench's vector of a joint (by index) and in its measurement."""

    def vector(**keys: str) -> Callable[[Any, Any, Mapping[str, float]], None]:
        def put(p: Any, m: Any, values: Mapping[str, float]) -> None:
            for name, key in keys.items():
                p[ix[name]] = values[key]

        return put

    def wave(size: str, phase: str, order: str, key: str) -> Callable[[Any, Any, Mapping[str, float]], None]:
        def put(p: Any, m: Any, values: Mapping[str, float]) -> None:
            p[ix[size]], p[ix[phase]] = (
                values[key],
                values["phase_rad"] + np.pi,
            )  # it adds to the motor's torque
            if order:
                p[ix[order]] = values["order_per_motor_rev"]

        return put

    def reading(**keys: str) -> Callable[[Any, Any, Mapping[str, float]], None]:
        return lambda p, m, values: m.update({name: values[key] for name, key in keys.items()})

    return {
        "stribeck_friction": vector(Fs="stribeck_nm", vs="stribeck_velocity_rad_s"),
        "load_dependent_friction": vector(mu="load_coefficient"),
        "friction_asymmetry": vector(asym="asymmetry_nm"),
        "temperature_dependent_friction": vector(beta="viscous_per_k"),
        "torque_ripple": wave("Ar", "phr", "", "amplitude_nm"),
        "kinematic_error": wave("Ak", "phk", "", "amplitude_rad"),
        "nonlinear_stiffness": vector(K3="cubic_nm_per_rad3"),
        "hysteresis": vector(Zh="torque_nm", dh="travel_rad"),
        "lost_motion": lambda p, m, x: p.__setitem__(ix["play"], 0.5 * x["width_rad"]),
        "torque_constant_saturation": vector(sat="saturation_per_a"),
        "torque_constant_temperature": vector(ktT="per_k"),
        "cogging": wave("Ac", "phc", "nc", "amplitude_nm"),
        "current_offset": lambda p, m, x: p.__setitem__(ix["i0"], -x["offset_a"]),
        "sensor_offset": reading(offset="offset_nm"),
        "sensor_gain": reading(gain="gain"),
        "sensor_drift": reading(drift="per_k_nm"),
        "sensor_crosstalk": reading(xt="share", xtph="phase_rad"),
        "encoder_eccentricity": reading(ecc="amplitude_rad", eccph="phase_rad"),
    }


PRACTICE_EFFECTS: Final = tuple(
    name
    for name in STRUCTURE
    if name not in ("channel_delay", "unbalance")  # in whole samples; of one joint only
)
PRACTICE_FOREIGN: Final = (
    *("x_loose_coupling", "x_sensor_saturates", "x_reversal_ringing", "x_wandering_gain", "x_bearing_defect"),
)


def _practice_module(folder: Path) -> tuple[Any, list[dict[str, Array]]]:
    """Return the bench's module and the list that its tables go to instead of files. Its package imports run unchanged where
    they are installed.
    """
    tables: list[dict[str, Array]] = []

    class Frame:
        def __init__(self, columns: dict[str, Array]) -> None:
            self.columns = columns

        def to_csv(self, *_: Any, **__: Any) -> None:
            tables.append({k: np.asarray(x, float) for k, x in self.columns.items()})

    class Series:
        def __init__(self, x: Any) -> None:
            self.x = np.asarray(x, float)

        def rolling(self, wide: int, **_: Any) -> Series:
            total = np.cumsum(np.concatenate(([0.0], self.x)))
            k = np.arange(1, len(self.x) + 1)
            low = np.maximum(k - wide, 0)
            return Series((total[k] - total[low]) / (k - low))

        def mean(self) -> Series:
            return self

        def to_numpy(self) -> Array:
            return self.x

    fast = importlib.util.find_spec("numba") is not None
    spec = importlib.util.spec_from_file_location("practice_bench", folder / "bench.py")
    if spec is None or spec.loader is None or not (folder / "bench.py").exists():
        raise UsageError(f"--practice {folder}: found no bench.py")
    module: Any = importlib.util.module_from_spec(spec)
    stand_ins = {"pandas": types.ModuleType("pandas")}
    if not fast:
        stand_ins["numba"] = types.ModuleType("numba")
        stand_ins["numba"].njit = lambda **_: lambda f: f  # type: ignore[attr-defined]
    stand_ins["pandas"].Series, stand_ins["pandas"].DataFrame = Series, Frame  # type: ignore[attr-defined]
    before = {name: sys.modules.get(name) for name in stand_ins}
    sys.modules.update(stand_ins)
    try:
        spec.loader.exec_module(module)
    finally:
        for name, old in before.items():
            if old is None:
                del sys.modules[name]
            else:
                sys.modules[name] = old
    if not fast:
        _as_plain_python(module)
    return module, tables


class _Samples(list[float]):
    @property
    def size(self) -> int:
        return len(self)


def _as_plain_python(module: Any) -> None:
    """Let the equations run on floats: lists for arrays, `math` for numpy; five times faster than with numpy's numbers."""
    plain = types.SimpleNamespace(
        sin=math.sin,
        cos=math.cos,
        exp=lambda x: math.exp(min(x, 700.0)),
        tanh=math.tanh,
        zeros=np.zeros,
        pi=math.pi,
        random=np.random,
    )
    space = {**vars(module), "np": plain}
    for name in ("loss", "motor", "spring", "simulate"):
        space[name] = types.FunctionType(getattr(module, name).__code__, space, name)
    module.equations = space

    def simulate(*given: Any) -> Any:
        return space["simulate"](*(_Samples(x.tolist()) if isinstance(x, np.ndarray) else x for x in given))

    module.simulate = simulate


def _practice(p: Plan, folder: Path) -> Drawn:
    module, tables = _practice_module(folder)
    rng = np.random.default_rng([p.seed, 8])
    nominal = json.loads(json.dumps(module.NOM))
    for key in (
        "torque_constant_nm_per_a",
        "rotor_inertia_kgm2",
        "stiffness_nm_per_rad",
        "link_inertia_kgm2",
    ):
        nominal[key] = float(f"{nominal[key] * rng.uniform(0.75, 1.3):.4g}")
    for key in ("coulomb_nm", "viscous_nms_per_rad"):
        nominal["friction"][key] = float(f"{nominal['friction'][key] * rng.uniform(0.7, 1.3):.4g}")
    module.NOM = nominal
    true = {n: json.loads(json.dumps(nominal)) for n in range(1, p.joints + 1)}
    effects: dict[Key, dict[str, float]] = dict(hidden_values(p, true))
    for name, place in p.effects:
        effects[name, place] = _practice_parameters(name, nominal, rng)
    setters = _practice_setters(module.IX)

    def of_joint(number: int) -> Callable[..., dict[str, Any]]:
        def made(own: np.random.Generator) -> dict[str, Any]:
            strange = original(own)  # draws what it draws, whatever is hidden

            def hide(q: Any, m: Any, size: float) -> None:
                for (name, place), values in effects.items():
                    if place in (number, SENSOR):
                        setters[name](q, m, values)

            return {**strange, "all": hide}

        return made

    original, count = module.effects, p.runs + p.held
    vectors = module.simulate

    def simulate(p1: Any, p2: Any, *more: Any) -> Any:
        """Give joint 2 what it has: the bench itself hides in one joint alone."""
        other = np.array(p2)
        for (name, place), values in effects.items():
            if place == 2:
                setters[name](other, {}, values)
        return vectors(p1, other, *more)

    module.simulate = simulate
    module.effects = of_joint(1)
    has_eccentric = any(name == "encoder_eccentricity" and place == 2 for name, place in effects)
    names = ["all"]

    def make(chosen: list[str], rest: bool, runs: int) -> list[Columns]:
        tables.clear()
        if not rest or p.rest is None or p.rest[0] != "smooth":
            smooth = None
        else:
            size, top = _smooth_nm(p, true), 3.0
            at, load = rng_rest.uniform(0.2, 0.9) * top, rng_rest.uniform(0.3, 0.8)
            smooth = (size, at, 0.35 * top, load, rated_nm(nominal))
        _with_smooth(module, smooth)
        with tempfile.TemporaryDirectory() as out:
            module.make(out, p.seed % 2**31, chosen, 1.0, runs, p.seconds, 1)
        return [_eccentric_of_2(t, effects) if has_eccentric else t for t in map(dict, tables)]

    rng_rest = np.random.default_rng([p.seed, 7])
    foreign = [p.rest[0]] if p.rest is not None and p.rest[0] != "smooth" else []
    runs = make([*names, *foreign], True, count)
    without = make(names, False, p.runs) if p.rest is not None else []
    order = [*range(p.runs + p.held)]
    tables_of = [_only(runs[k], p.joints, p.encoders) for k in order]
    bare = [_only(t, p.joints, p.encoders) for t in without]
    return Drawn(true, entries_of(p, true, effects), tables_of, None, bare)


def _eccentric_of_2(t: Columns, effects: Mapping[Key, Mapping[str, float]]) -> Columns:
    own = effects["encoder_eccentricity", 2]
    link = t["j2.link_position_rad"]
    return {**t, "j2.link_position_rad": link + own["amplitude_rad"] * np.sin(link + own["phase_rad"])}


def _with_smooth(module: Any, smooth: tuple[float, float, float, float, float] | None) -> None:
    """Add a smooth friction to the loss of the bench's equations, both joints; None: as it is. Plain Python only."""
    space = module.equations
    plain = types.FunctionType(module.loss.__code__, space, "loss")
    if smooth is None:
        space["loss"] = plain
        return
    size, at, wide, share_of_load, rated = smooth

    def loss(q: Any, w: float, torque: float, temperature: float) -> Any:
        band = math.exp(-(((abs(w) - at) / wide) ** 2))
        more = size * (
            (1.0 - share_of_load) * band + share_of_load * math.tanh(abs(torque) / (0.3 * rated)) * band
        )
        return plain(q, w, torque, temperature) + math.tanh(w / 0.004) * more

    space["loss"] = loss


def _practice_parameters(name: str, joint: Mapping[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """Return the parameters of an effect of typical size, in the form that this bench has it."""
    own = ENTRIES[name].bench
    most = min(3.0, own.largest / abs(own.start))
    size = abs(own.start) * float(np.exp(rng.uniform(0.0, np.log(max(most, 1.0)))))
    p = bench_parameters(name, joint, size, rng)
    if name == "torque_ripple":
        p["order_per_motor_rev"] = 2.0
    elif name == "kinematic_error":
        p["order_per_motor_rev"] = 1.0
    elif name == "sensor_crosstalk":
        p["amplitude_nm"], p["share"] = 0.0, 0.02 + 0.04 * float(rng.uniform())
    return p


class Bench(NamedTuple):
    """A generator: what it can draw and how."""

    can: Can
    draw: Callable[..., Drawn]


_TOWED: Final = ((1, "sensor"), (2, "sensor"))
BENCHES: Final[dict[str, Bench]] = {
    "ours": Bench(
        Can(
            (*_TOWED, (1, "model")),
            STRUCTURE,
            tuple(name for name, entry in UNKNOWN.items() if not entry.resembling),
            smooth=True,
        ),
        _ours,
    ),
    "mujoco": Bench(
        Can(
            _TOWED,
            tuple(name for name in STRUCTURE if name in MujocoBench.effects),
            MujocoBench.foreign,
            smooth=False,
        ),
        _mujoco,
    ),
    "belt": Bench(
        Can(
            tuple(
                (1, f"{load} {kind}") for load in ("pendulum", "arm", "sensor") for kind in ("belt", "gear")
            ),
            STRUCTURE,
            (),
            smooth=False,
        ),
        _belt,
    ),
    "practice": Bench(
        Can(_TOWED, PRACTICE_EFFECTS, PRACTICE_FOREIGN, smooth=True, longest_s=20.0), _practice
    ),
}


def made(name: str) -> Bench:
    """Return a generator with the lists that it states itself."""
    bench = BENCHES[name]
    if name == "belt":
        belt: Any = importlib.import_module("validation.generator.belt")
        can = replace(
            bench.can,
            effects=tuple(n for n in belt.EFFECTS if n in STRUCTURE and n != "nonlinear_stiffness"),
            values=tuple(n for n in SHEETS if n in belt.EFFECTS or SHEETS[n].key),
            foreign=tuple(belt.FOREIGN),
        )
        return Bench(can, bench.draw)
    return bench
