"""Trial entries: for every effect of the library, how large trials hide it and which parameters they draw.

One entry serves the generator (sizes as deviations in SI) and the benches (sizes relative to the joint). Names and
parameters are those of the joint file (docs/diagnosis.md, Effects); no law of an effect is here, and nothing of the product
is imported. An effect that replaces a value of the joint file has absolute parameters: file value plus deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

Array = np.ndarray
Columns = dict[str, Array]
"""Columns [n] of one run by the names of a run table, `time_s`, `j1.current_a`, ..."""
Joint = Mapping[str, Any]
"""A joint file as a mapping."""
Truth = dict[str, Any]
"""What is hidden: {name, joint, parameters, size}, with `places` for what is in no library: where it is right to look."""
Size = float | Mapping[str, float] | None
SENSOR: Final = "sensor"
CHANNELS: Final = ("sensor", "current", "link")
"""Variants of `channel_delay`, by the number that the joint file gives them."""


@dataclass(frozen=True)
class Hidden:
    """What is to be hidden: an effect of the library, or a kind that is in none; joint: 1, 2 or "sensor".

    size: for the generator a deviation as `drawn_parameters` takes it, for a bench relative to the joint as `OnBench.unit`
    has it. variant: of an effect that has some on a bench (`Bench.variants`). fixed: further parameters, of the generator.
    """

    name: str
    joint: int | str = 1
    size: Any = None
    variant: str = ""
    fixed: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Set:
    """One set of runs: columns of each, nominal joint files by number, and what is hidden in them."""

    runs: Sequence[Columns]
    joints: Mapping[int, Joint]
    truth: Sequence[Truth]


class Draws(NamedTuple):
    """Random numbers for parameters that carry no size: phase, orders of the motor's turn, a share 0..1; variant of a bench,
    None for the generator.
    """

    phase: float
    low_order: float
    high_order: float
    share: float
    variant: str | None = None

    def spread(self, generator: tuple[float, float], bench: tuple[float, float]) -> float:
        """Return low * factor**share, of (low, factor) for either."""
        low, factor = generator if self.variant is None else bench
        return float(low * factor**self.share)

    @property
    def channel(self) -> float:
        return float(int(3 * self.share) if self.variant is None else CHANNELS.index(self.variant))


def value_of(joint: Joint, key: str) -> float:
    """Return the value of a dotted key of a joint file."""
    value: Any = joint
    for part in key.split("."):
        value = value[part]
    return float(value)


def rated_nm(joint: Joint) -> float:
    """Return the rated torque [Nm]."""
    return float(joint["rated_torque_nm"])


def rated_a(joint: Joint) -> float:
    """Return the current of the rated torque [A]."""
    return rated_nm(joint) / float(joint["gear_ratio"] * joint["torque_constant_nm_per_a"])


def rated_twist(joint: Joint) -> float:
    """Return the twist of the spring at rated torque [rad]."""
    return rated_nm(joint) / float(joint["stiffness_nm_per_rad"])


def reflected(joint: Joint) -> float:
    """Return the rotor's inertia on the joint side [kg m^2]."""
    return float(joint["rotor_inertia_kgm2"] * joint["gear_ratio"] ** 2)


def _one(joint: Joint) -> float:
    return 1.0


class OnBench(NamedTuple):
    """How benches size an effect: relative to the joint.

    unit(joint): what a relative size of 1 is, SI; start: relative size at which the oracle looks; largest: relative size
    beyond which a joint would be broken, not badly modelled; parameter, both: where they differ from the generator's.
    """

    unit: Callable[[Joint], float]
    start: float
    largest: float
    parameter: str = ""
    both: bool | None = None


@dataclass(frozen=True)
class Entry:
    """One effect as trials hide it.

    parameter: carries the size; typical: lowest and highest size that the generator draws, SI; relative: times the file's
    value, or times `scale`; both: either sign occurs; key: value of the joint file that the parameter replaces; neutral:
    value without the effect where it replaces none; second: another parameter that can carry the effect instead; others: the
    parameters that carry no size.
    """

    parameter: str
    typical: tuple[float, float]
    bench: OnBench
    both: bool = False
    relative: bool = False
    key: str = ""
    neutral: float = 0.0
    second: str = ""
    others: Callable[[Draws], dict[str, float]] = lambda d: {}
    scale: Callable[[Joint], float] | None = None

    def base(self, joint: Joint) -> float:
        """Return the value of `parameter` on a bench without the effect."""
        return value_of(joint, self.key) if self.key else self.neutral

    @property
    def bench_parameter(self) -> str:
        return self.bench.parameter or self.parameter


def _of(key: str) -> Callable[[Joint], float]:
    return lambda joint: value_of(joint, key)


def _phase(d: Draws) -> dict[str, float]:
    return {"phase_rad": d.phase}


def _low_order(d: Draws) -> dict[str, float]:
    return {"order_per_motor_rev": d.low_order, "phase_rad": d.phase}


def _at_25_c(d: Draws) -> dict[str, float]:
    return {"reference_c": 25.0}


ENTRIES: Final[dict[str, Entry]] = {
    "coulomb_friction": Entry(
        "coulomb_nm", (0.5, 1.5), OnBench(rated_nm, 0.02, 0.04), both=True, key="friction.coulomb_nm"
    ),
    "viscous_friction": Entry(
        "viscous_nms_per_rad",
        (0.2, 0.5),
        OnBench(rated_nm, 0.02, 0.036),
        both=True,
        relative=True,
        key="friction.viscous_nms_per_rad",
    ),
    "stribeck_friction": Entry(
        "stribeck_nm",
        (0.5, 2.0),
        OnBench(rated_nm, 0.02, 0.05),
        others=lambda d: {"stribeck_velocity_rad_s": d.spread((0.05, 4.0), (0.07, 3.0))},
    ),
    "load_dependent_friction": Entry("load_coefficient", (0.04, 0.15), OnBench(_one, 0.05, 0.3)),
    "friction_asymmetry": Entry("asymmetry_nm", (0.3, 1.0), OnBench(rated_nm, 0.01, 0.04), both=True),
    "temperature_dependent_friction": Entry(
        "viscous_per_k", (0.015, 0.035), OnBench(_one, 0.02, 0.1), second="coulomb_per_k", others=_at_25_c
    ),
    "torque_ripple": Entry("amplitude_nm", (0.2, 1.0), OnBench(rated_nm, 0.01, 0.1), others=_low_order),
    "kinematic_error": Entry(
        "amplitude_rad", (3e-5, 2e-4), OnBench(rated_twist, 0.01, 0.3), others=_low_order
    ),
    "nonlinear_stiffness": Entry(
        "cubic_nm_per_rad3",
        (0.1, 0.4),
        OnBench(lambda joint: float(joint["stiffness_nm_per_rad"]) / rated_twist(joint) ** 2, 0.2, 3.0),
        relative=True,
        second="stiffness_nm_per_rad",
        # share of the linear torque at rated torque: K3 d^2 = K at d = rated/K
        scale=lambda joint: float(joint["stiffness_nm_per_rad"] ** 3 / joint["rated_torque_nm"] ** 2),
    ),
    "hysteresis": Entry(
        "torque_nm",
        (0.5, 2.0),
        OnBench(rated_nm, 0.02, 0.2),
        others=lambda d: {"travel_rad": d.spread((3e-5, 10.0), (4e-5, 6.0))},
    ),
    "lost_motion": Entry("width_rad", (4e-5, 2e-4), OnBench(rated_twist, 0.03, 0.5)),
    "gear_damping": Entry(
        "damping_nms_per_rad",
        (0.5, 2.0),
        OnBench(_of("damping_nms_per_rad"), 1.0, 20.0),
        relative=True,
        key="damping_nms_per_rad",
    ),
    "torque_constant": Entry(
        "torque_constant_nm_per_a",
        (0.02, 0.08),
        OnBench(_of("torque_constant_nm_per_a"), 0.03, 0.3),
        both=True,
        relative=True,
        key="torque_constant_nm_per_a",
    ),
    "torque_constant_saturation": Entry(
        "saturation_per_a", (0.005, 0.02), OnBench(lambda joint: 1.0 / rated_a(joint), 0.1, 0.4)
    ),
    "torque_constant_temperature": Entry(
        "per_k", (-0.004, -0.001), OnBench(_one, -0.002, 0.02), others=_at_25_c
    ),
    "cogging": Entry(
        "amplitude_nm",
        (0.1, 0.5),
        OnBench(rated_nm, 0.01, 0.1),
        others=lambda d: {"order_per_motor_rev": d.high_order, "phase_rad": d.phase},
    ),
    "current_offset": Entry("offset_a", (0.03, 0.1), OnBench(rated_a, 0.01, 0.2), both=True),
    "rotor_inertia": Entry(
        "rotor_inertia_kgm2",
        (0.1, 0.4),
        OnBench(_of("rotor_inertia_kgm2"), 0.2, 4.0, both=False),
        both=True,
        relative=True,
        key="rotor_inertia_kgm2",
    ),
    "sensor_offset": Entry("offset_nm", (0.4, 1.5), OnBench(rated_nm, 0.01, 0.3), both=True),
    "sensor_gain": Entry("gain", (0.02, 0.08), OnBench(_one, 0.02, 0.3), both=True, neutral=1.0),
    "sensor_drift": Entry(
        "rate_nm_per_s",
        (0.02, 0.1),
        OnBench(rated_nm, 0.001, 0.02, parameter="per_k_nm"),
        both=True,
        second="per_k_nm",
        others=_at_25_c,
    ),
    "sensor_crosstalk": Entry(
        "amplitude_nm", (0.1, 0.6), OnBench(rated_nm, 0.01, 0.2), second="share", others=_phase
    ),
    "encoder_eccentricity": Entry(
        "amplitude_rad",
        (2e-5, 1e-4),
        OnBench(rated_twist, 0.01, 0.3),
        others=lambda d: {"phase_rad": d.phase, "motor_side": 0.0},
    ),
    "channel_delay": Entry(
        "delay_s", (0.001, 0.006), OnBench(_one, 0.002, 0.02), others=lambda d: {"channel": d.channel}
    ),
    "link_inertia": Entry(
        "link_inertia_kgm2", (1.0, 5.0), OnBench(reflected, 0.1, 3.0), relative=True, key="link_inertia_kgm2"
    ),
    "unbalance": Entry("moment_nm", (0.2, 1.5), OnBench(rated_nm, 0.01, 0.2), others=_phase),
}


def at_sensor(name: str) -> bool:
    """Return whether an effect is one of the torque sensor."""
    return name.startswith("sensor_")


class Bench:
    """Base of the benches that share nothing with the project's plant.

    foreign: kinds that are in no library; of_sensor: those at the sensor; joints: where others can be; channels: how many of
    CHANNELS can be late. real: with nothing hidden there may still be something in its runs: every set is judged beside the
    set with nothing hidden of the same seed.
    """

    name: str
    real: bool = False
    effects: Sequence[str]
    foreign: Sequence[str]
    of_sensor: Sequence[str]
    joints: Sequence[int | str] = (1, 2)
    channels: int = 3

    def draw(self, seed: int, hidden: Sequence[Hidden] = (), *, quiet: bool = False) -> Set:
        """Return the set of this seed: same joints, motions, noise and changes from run to run whatever is hidden.

        quiet: without noise, quantisation and changes from run to run.
        """
        raise NotImplementedError

    def unseen(self) -> Bench:
        """Return the bench with what its joint files leave in runs that they were not fitted to; itself if to none."""
        return self

    def places(self, name: str) -> Sequence[int | str]:
        """Return where an effect or a foreign kind can be: at joints, or at the sensor."""
        return (SENSOR,) if at_sensor(name) or name in self.of_sensor else self.joints

    def variants(self, name: str) -> Sequence[str]:
        """Return the variants of an effect, one empty text where it has none."""
        return CHANNELS[: self.channels] if name == "channel_delay" else ("",)


def joint_columns(
    number: int, velocity: Callable[[Array], Array], *, motor_rad: Array, link_rad: Array, **others: Array
) -> Columns:
    """Return the columns of a joint; velocity: makes those of both encoders from their positions."""
    columns = {
        "current_a": others["current_a"],
        "motor_position_rad": motor_rad,
        "motor_velocity_rad_s": velocity(motor_rad),
        "link_position_rad": link_rad,
        "link_velocity_rad_s": velocity(link_rad),
        **others,
    }
    return {f"j{number}.{name}": values for name, values in columns.items()}


# Of what is in no library: its truth, with the places where it is right to look.


def foreign_truth(item: Hidden, places: list[dict[str, Any]], **numbers: float) -> Truth:
    """Return the truth of a foreign kind, with its numbers as parameters."""
    return {"name": item.name, "joint": item.joint, "parameters": numbers, "size": 1.0, "places": places}


def times(run: int, spans: Sequence[tuple[float, float]]) -> list[dict[str, Any]]:
    """Return the places of spans [s] of run `run` (from 0)."""
    return [{"axis": "time", "run": f"run{run + 1}", "low": low, "high": high} for low, high in spans]


def line_place(hz: float) -> dict[str, Any]:
    return {"axis": "frequency", "low": 0.93 * hz, "high": 1.07 * hz, "unit": "Hz"}


def clip_sensor(tables: Sequence[Columns], share: float, step_s: float) -> tuple[float, list[dict[str, Any]]]:
    """Clip the sensor at a quantile of what it read; return that torque and the places: those loads, those times."""
    most = float(np.quantile(np.abs(np.concatenate([t["j1.torque_nm"] for t in tables])), share))
    places: list[dict[str, Any]] = [
        {"axis": "load", "low": 0.9 * most, "high": np.inf},
        {"axis": "load", "low": -np.inf, "high": -0.9 * most},
        {"axis": "channel", "channel": "torque_nm", "low": 0.99 * most, "high": 1.01 * most},
    ]
    for k, table in enumerate(tables):
        over = np.abs(table["j1.torque_nm"]) > most
        edges = np.flatnonzero(np.diff(np.concatenate(([False], over, [False])).astype(int)))
        places += times(k, [(a * step_s, b * step_s) for a, b in zip(edges[::2], edges[1::2], strict=True)])
        for name in table:
            if name.endswith(".torque_nm"):
                table[name] = np.clip(table[name], -most, most)
    return most, places


# Of the benches: sizes relative to the joint.


def bench_parameters(
    name: str, joint: Joint, size: float, rng: np.random.Generator, variant: str = ""
) -> dict[str, float]:
    """Return all parameters of an effect of this relative size; sign, phase, order and the like are drawn."""
    entry = ENTRIES[name]
    parameter, bench = entry.bench_parameter, entry.bench
    both = entry.both if bench.both is None else bench.both
    sign = float(rng.choice([-1.0, 1.0])) if both else float(np.sign(bench.start))
    phase, share = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform())
    third = int(3 * share)
    draws = Draws(phase, (1.0, 2.0, 4.0)[third], (6.0, 12.0, 24.0)[third], share, variant)
    idle = {entry.parameter, entry.second} - {parameter, "stiffness_nm_per_rad", ""}
    return {
        parameter: entry.base(joint) + sign * abs(size) * bench.unit(joint),
        **entry.others(draws),
        **dict.fromkeys(idle, 0.0),
    }


# Of the generator: sizes are deviations.


def drawn_parameters(
    name: str, joint: Joint, size: Size, rng: np.random.Generator, fixed: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Return all parameters of one effect.

    size: a magnitude of the leading parameter (sign drawn where both occur), None for a typical one, or a mapping of
    parameters as they are; what it leaves out is drawn. fixed: parameters that are given besides a size.
    """
    entry = ENTRIES[name]
    given = dict(size) if isinstance(size, Mapping) else dict(fixed or {})
    out = _others(name, rng)
    typical = float(rng.uniform(*entry.typical))
    sign = float(rng.choice([-1.0, 1.0]))
    if entry.parameter not in given:
        scale = 1.0
        if entry.relative:
            scale = entry.scale(joint) if entry.scale is not None else entry.base(joint)
        magnitude = typical * scale if size is None or isinstance(size, Mapping) else float(size)
        deviation = magnitude * (sign if entry.both else 1.0)
        base = entry.base(joint)
        if entry.key and base + deviation <= 0.0:
            deviation = abs(deviation)
        carried = isinstance(size, Mapping) and entry.second in given
        out[entry.parameter] = base if carried else base + deviation
    return out | given


def deviation(name: str, joint: Joint, values: Mapping[str, float]) -> float:
    """Return how far the leading parameter is from a bench without the effect."""
    entry = ENTRIES[name]
    base = entry.base(joint)
    return values.get(entry.parameter, base) - base


def base_value(name: str, joint: Joint, parameter: str) -> float:
    """Return the value of a leading or second parameter on a bench without the effect."""
    if parameter == "stiffness_nm_per_rad":
        return float(joint[parameter])
    return ENTRIES[name].base(joint) if parameter == ENTRIES[name].parameter else 0.0


def scaled(
    name: str, joint: Joint, minimum: Mapping[str, float], factor: float, rng: np.random.Generator
) -> dict[str, float]:
    """Return parameters at `factor` times the minimum detectable size.

    minimum: parameters at the minimum, absolute; those that carry the effect are moved away from nothing, with a sign
    where both occur; phases and reference temperatures are drawn or usual; orders, channels and travels are kept.
    """
    entry = ENTRIES[name]
    drawn = _others(name, rng)
    out = {k: x for k, x in drawn.items() if k not in minimum or k in ("phase_rad", "reference_c")}
    sign = float(rng.choice([-1.0, 1.0])) if entry.both else float(np.sign(sum(entry.typical)))
    for parameter, value in minimum.items():
        if parameter in (entry.parameter, entry.second):
            base = base_value(name, joint, parameter)
            away = factor * abs(value - base)
            step = sign * away
            out[parameter] = base + (step if base + step > 0.0 or base == 0.0 else away)
        elif parameter not in out:
            out[parameter] = value
    return out


def _others(name: str, rng: np.random.Generator) -> dict[str, float]:
    phase = float(rng.uniform(-np.pi, np.pi))
    low_order = float(rng.choice([1.0, 2.0, 4.0]))
    high_order = float(rng.choice([6.0, 8.0, 10.0, 12.0, 14.0]))
    return ENTRIES[name].others(Draws(phase, low_order, high_order, float(rng.uniform())))
