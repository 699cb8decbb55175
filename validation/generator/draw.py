"""Sets of runs of a bench that is not quite what its joint files describe: joints, motions, instruments, hidden effects.

Independent of the project on purpose: nothing of it is imported. Equations, integrator and instruments are written here
again with numpy alone, so that finding a hidden effect is not inverting one's own code. `draw` makes one set of runs,
`draw_many` many at once; what is hidden goes into the plant, all runs are integrated side by side and measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from validation.diagnosis.entries import (
    ENTRIES,
    SENSOR,
    Array,
    Columns,
    Hidden,
    Set,
    Truth,
    at_sensor,
    deviation,
    drawn_parameters,
    joint_columns,
)
from validation.generator.plant import (
    RUN_S,
    STEP_S,
    Fault,
    Motion,
    Plant,
    Reference,
    Signals,
    Strange,
    draw_motion,
    driven_motion,
    integrate,
    kinds,
)

RUNS: Final = 6
_BATCH: Final = 96
"""Benches side by side: more gain little and cost memory (0.9 MB per second of run and bench)."""


@dataclass(frozen=True)
class Order:
    """What to draw: effects (`Hidden`, or (name, joint, size)) and motions; quiet: no drift, noise, quantisation."""

    seed: int
    effects: Sequence[Hidden | tuple[Any, ...]] = ()
    profile: str = "mixed"
    runs: int = RUNS
    duration_s: float = RUN_S
    quiet: bool = False


VISCOUS_DRIFT: Final = 0.15  # half width, share of the viscous friction, each joint and run
SENSOR_ZERO_NM: Final = 0.3  # half width, each run
LINK_ZERO_RAD: Final = 10e-6  # half width, each joint and run


def draw_joint(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Return a joint file as a mapping: friction only, ranges of integrated harmonic-drive joints."""
    ratio = float(rng.integers(80, 161))
    reflected = rng.uniform(0.35, 1.1)  # rotor on the joint side, kg m2
    return {
        "name": f"drawn{number}",
        "gear_ratio": ratio,
        "torque_constant_nm_per_a": _rounded(rng.uniform(0.04, 0.12)),
        "rotor_inertia_kgm2": _rounded(reflected / ratio**2),
        "stiffness_nm_per_rad": _rounded(float(np.exp(rng.uniform(np.log(8e3), np.log(3e4))))),
        "damping_nms_per_rad": _rounded(rng.uniform(6.0, 14.0)),
        "link_inertia_kgm2": _rounded(rng.uniform(0.012, 0.04)),
        "rated_torque_nm": _rounded(rng.uniform(30.0, 90.0)),
        "friction": {
            "coulomb_nm": _rounded(rng.uniform(3.0, 6.0)),
            "viscous_nms_per_rad": _rounded(rng.uniform(2.0, 8.0)),
        },
    }


@dataclass(frozen=True)
class Drift:
    """Of one run: factor on viscous friction [2], zero of the sensor [Nm], zeros of the link encoders [2] [rad]."""

    viscous: np.ndarray
    sensor_nm: float
    link_rad: np.ndarray


def draw_drift(rng: np.random.Generator) -> Drift:
    return Drift(
        viscous=1.0 + VISCOUS_DRIFT * rng.uniform(-1.0, 1.0, 2),
        sensor_nm=SENSOR_ZERO_NM * float(rng.uniform(-1.0, 1.0)),
        link_rad=LINK_ZERO_RAD * rng.uniform(-1.0, 1.0, 2),
    )


def _rounded(x: float) -> float:
    return float(f"{x:.4g}")


MOTOR_COUNTS: Final = 65536
LINK_COUNTS: Final = 524288
SENSOR_WHITE_NM: Final = 0.02
SENSOR_SLOW_NM: Final = 0.05
CURRENT_WHITE_A: Final = 0.010
CURRENT_SLOW_A: Final = 0.003
_VELOCITY_FILTER_S: Final = 1e-3


def measured(  # noqa: PLR0917
    truth: Signals,
    p: Plant,
    b: int,
    motion: Motion,
    drift: Drift,
    rng: np.random.Generator,
    quiet: bool = False,
    faults: Sequence[Fault] = (),
) -> Columns:
    """Return the run table of bench b as columns; quiet: no noise, no quantisation, no zeros."""
    n = len(motion.on)
    t = STEP_S * np.arange(n)
    noise = 0.0 if quiet else 1.0
    columns = {"time_s": t}
    sensor = _sensor(truth, p, b, motion, t) + noise * (drift.sensor_nm + _sensor_noise(rng, n))
    for fault in faults:
        span = slice(fault.start, fault.start + fault.count)
        sensor[span] = 0.0 if fault.dropped else sensor[span] + fault.value_nm
    for j in range(2):
        current = _late(truth.current_a[:, j, b], p.current_delay[j, b]) + p.current_offset[j, b]
        current += noise * (rng.normal(0.0, CURRENT_WHITE_A, n) + _slow(rng, n, 5.0, CURRENT_SLOW_A))
        motor = truth.motor_rad[:, j, b]
        motor = motor + p.motor_eccentricity[j, b] * np.sin(motor + p.motor_eccentricity_phase[j, b])
        link = (1 - 2 * j) * truth.link_rad[:, b]
        link = _late(link, p.link_delay[j, b])
        link = link + p.link_eccentricity[j, b] * np.sin(link + p.link_eccentricity_phase[j, b])
        link += noise * drift.link_rad[j]
        if not quiet:
            motor = _quantised(motor, MOTOR_COUNTS)
            link = _quantised(link, LINK_COUNTS)
        temperature = motion.temperature_c[j]
        others = {
            "current_a": current,
            "torque_nm": sensor,
            "temperature_c": temperature if quiet else np.round(temperature, 1),
        }
        if motion.marked is not None:
            others["enabled"] = np.where(motion.marked, 0.0, 1.0)
        columns |= joint_columns(j + 1, _velocity, motor_rad=motor, link_rad=link, **others)
    return columns


def _sensor(truth: Signals, p: Plant, b: int, motion: Motion, t: Array) -> Array:
    """Return the sensor's reading without its own noise; its temperature is that of joint 1."""
    torque = _late(truth.sensor_nm[:, b], p.sensor_delay[0, b])
    turn = np.cos(truth.link_rad[:, b] + p.crosstalk_phase[0, b])
    reading = p.sensor_gain[0, b] * torque + p.sensor_offset[0, b] + p.sensor_rate[0, b] * t
    reading += p.sensor_per_k[0, b] * (motion.temperature_c[0] - p.sensor_reference[0, b])
    reading += (p.crosstalk[0, b] + p.crosstalk_share[0, b] * torque) * turn
    return np.asarray(reading)


def _late(x: Array, delay_s: float) -> Array:
    """Return x as it was delay_s ago: cubic between samples, the first value before them."""
    if delay_s == 0.0:
        return x
    back = delay_s / STEP_S
    whole = int(np.floor(back))
    f = back - whole
    padded = np.concatenate((np.full(whole + 2, x[0]), x, x[-1:]))
    n = len(x)
    # newest to oldest of the four neighbours of t - delay: 1 sample newer, at, 1 older, 2 older
    a, b, c, d = (padded[2 - k + 1 : 2 - k + 1 + n] for k in range(4))
    return (
        -f * (1 - f) * (2 - f) / 6 * a
        + (1 + f) * (1 - f) * (2 - f) / 2 * b
        + (1 + f) * f * (2 - f) / 2 * c
        - (1 + f) * f * (1 - f) / 6 * d
    )


def _sensor_noise(rng: np.random.Generator, n: int) -> Array:
    corner_hz = float(rng.uniform(1.0, 2.0))
    return np.asarray(rng.normal(0.0, SENSOR_WHITE_NM, n) + _slow(rng, n, corner_hz, SENSOR_SLOW_NM))


def _slow(rng: np.random.Generator, n: int, corner_hz: float, rms: float) -> Array:
    """Return first-order coloured noise of this standard deviation."""
    f = np.fft.rfftfreq(n, STEP_S)
    shape = 1.0 / np.sqrt(1.0 + (f / corner_hz) ** 2)
    shape[0] = 0.0  # a zero of its own is the drift's business
    spectrum = shape * (rng.normal(size=len(f)) + 1j * rng.normal(size=len(f)))
    x: Array = np.fft.irfft(spectrum, n)
    expected = np.sqrt(2.0 * np.sum(2.0 * shape**2)) / n
    x *= rms / expected
    return x


def _quantised(x: Array, counts: int) -> Array:
    step = 2 * np.pi / counts
    return np.asarray(step * np.round(x / step))


def _velocity(position: Array) -> Array:
    """Return backward differences through a low pass of 1 ms, at standstill before the first sample."""
    rate = np.diff(position, prepend=position[0]) / STEP_S
    a = np.exp(-STEP_S / _VELOCITY_FILTER_S)
    # impulse response a^k (1 - a) is below 1e-9 after 24 samples
    kernel = (1 - a) * a ** np.arange(24)
    return np.asarray(np.convolve(rate, kernel)[: len(rate)])


# What no library has. A place is {axis, low, high}; several are alternatives: an event at its time in its run, or where its
# condition is.


@dataclass
class Oddity:
    """numbers: of `plant.NEUTRAL`, the same in all runs. Lists have one entry per run. wave: amplitude, order, phase
    of a torque that turns with the motor. places: where it is right to place it; times are added as they happen.
    """

    numbers: dict[str, float] = field(default_factory=dict)
    waits: list[list[int]] = field(default_factory=list)
    bursts: list[list[tuple[int, int, float]]] = field(default_factory=list)
    faults: list[list[Fault]] = field(default_factory=list)
    phases: list[float] = field(default_factory=list)
    wave: tuple[float, float, float] | None = None
    places: list[dict[str, Any]] = field(default_factory=list)


class Scene(NamedTuple):
    """What an unknown thing is drawn for: joint `row` (0, 1) of one case, its nominal file, motions, size."""

    rng: np.random.Generator
    nominal: Mapping[str, Any]
    motions: Sequence[Motion]
    row: int
    size: float


@dataclass(frozen=True)
class Unknown:
    """low, high: typical sizes in unit; resembling: an effect of the library can take most of it, so that it is no fair test
    of a refusal.
    """

    make: Callable[[Scene], Oddity]
    low: float
    high: float
    unit: str
    resembling: bool = False


def draw_unknown(name: str, case: Scene, size: float | None) -> tuple[Oddity, float]:
    """Return the oddity and its size, a typical one where it is not given; ValueError for a name not in UNKNOWN."""
    if name not in UNKNOWN:
        raise ValueError(f"effect: found {name!r}, expected one of the library's or of {', '.join(UNKNOWN)}")
    entry = UNKNOWN[name]
    chosen = float(case.rng.uniform(entry.low, entry.high)) if size is None else float(size)
    return entry.make(case._replace(size=chosen)), chosen


def _coupling_slip(c: Scene) -> Oddity:
    """Hub between gear and link encoder: it slips by size (torque it lets go, Nm) now and then under load."""
    above = 0.15 * float(c.nominal["rated_torque_nm"])
    waits = []
    for motion in c.motions:
        end = len(motion.on) * STEP_S
        gaps = c.rng.exponential(end / 4.0, 12)
        waits.append([round(x / STEP_S) for x in gaps])
    return Oddity(
        numbers={"slip_rad": c.size / float(c.nominal["stiffness_nm_per_rad"]), "slip_above_nm": above},
        waits=waits,
    )


def _local_damage(c: Scene) -> Oddity:
    """Friction bump around one angle of the link: a tooth or a ball that is damaged."""
    visited = np.concatenate([_reference_angle(m, c.row)[::20] for m in c.motions])
    counts, edges = np.histogram(np.mod(visited, 2 * np.pi), 36, (0.0, 2 * np.pi))
    best = np.argsort(counts)[-18:]
    centre = float(edges[c.rng.choice(best)] + np.pi / 36)
    width = float(c.rng.uniform(0.12, 0.25))
    return Oddity(
        numbers={"bump_nm": c.size, "bump_at_rad": centre, "bump_width_rad": width},
        places=[{"axis": "link_angle", "low": centre - width, "high": centre + width}],
    )


def _reference_angle(motion: Motion, row: int) -> Array:
    """Return theta_l of a joint as its references have it."""
    side = 1.0 if motion.leader == 0 else -1.0
    angle = motion.start_rad + side * np.cumsum(motion.velocity_rad_s) * STEP_S
    return angle if row == 0 else -angle


def _bearing_line(c: Scene) -> Oddity:
    """Torque line of a bearing: an order of the motor that is no whole number."""
    order = float(c.rng.integers(2, 6)) + float(c.rng.uniform(0.3, 0.7))
    return Oddity(
        wave=(c.size, order, float(c.rng.uniform(-np.pi, np.pi))),
        places=[{"axis": "frequency", "low": 0.96 * order, "high": 1.04 * order, "unit": "per motor rev"}],
    )


def _frame_vibration(c: Scene) -> Oddity:
    """Interference of a fixed frequency on the motor's torque: it has nothing to do with any angle."""
    hz = float(c.rng.uniform(3.0, 9.0))
    return Oddity(
        numbers={"vibration_nm": c.size, "vibration_hz": hz},
        phases=[float(c.rng.uniform(-np.pi, np.pi)) for _ in c.motions],
        places=[{"axis": "frequency", "low": 0.93 * hz, "high": 1.07 * hz, "unit": "Hz"}],
    )


def _sensor_faults(c: Scene) -> Oddity:
    """Loose connector of the sensor: bursts of 20 to 150 ms in which it reads far off or nothing."""
    faults = []
    for motion in c.motions:
        n = len(motion.on)
        many = int(c.rng.integers(3, 8))
        dropped = bool(c.rng.uniform() < 0.4)
        faults.append(
            [
                Fault(
                    int(s), int(c.rng.integers(20, 150)), c.size * float(c.rng.choice([-1.0, 1.0])), dropped
                )
                for s in c.rng.integers(1000, n - 1000, many)
            ]
        )
    return Oddity(faults=faults, places=[{"axis": "channel", "channel": "torque_nm", "stuck": True}])


def _current_dead_band(c: Scene) -> Oddity:
    """Amplifier that folds back below a current: a motor torque under size (Nm, joint side) is lost in part.

    Its place is that current. At which load the current is small depends on direction and speed: no bin of the load.
    """
    width = c.size / float(c.nominal["gear_ratio"] * c.nominal["torque_constant_nm_per_a"])
    return Oddity(numbers={"dead_band_a": width}, places=[{"axis": "current", "low": -width, "high": width}])


def _friction_bursts(c: Scene) -> Oddity:
    bursts = []
    for motion in c.motions:
        n = len(motion.on)
        many = int(c.rng.integers(3, 7))
        starts = c.rng.integers(1000, n - 1000, many)
        bursts.append(
            [
                (int(s), int(s + c.rng.integers(150, 500)), c.size * float(c.rng.uniform(0.7, 1.3)))
                for s in starts
            ]
        )
    return Oddity(bursts=bursts)


def _speed_band(c: Scene) -> Oddity:
    """Losses of a resonance that a band of speeds excites."""
    top = float(np.median([np.max(np.abs(m.velocity_rad_s)) for m in c.motions]))
    at = float(c.rng.uniform(0.35, 0.6)) * top
    width = float(c.rng.uniform(0.05, 0.09)) * top
    bands = [{"axis": "velocity", "low": s * at - 1.5 * width, "high": s * at + 1.5 * width} for s in (-1, 1)]
    return Oddity(
        numbers={"band_nm": c.size, "band_at_rad_s": at, "band_width_rad_s": width}, places=[*bands]
    )


def _speed_load(c: Scene) -> Oddity:
    """Friction c |tau| v^2; size: c at the top speed."""
    top = max(float(np.max(np.abs(m.velocity_rad_s))) for m in c.motions)
    return Oddity(
        numbers={"speed_load": c.size / top**2},
        places=[
            {"axis": "velocity", "low": s * 0.8 * top - 0.3 * top, "high": s * 0.8 * top + 0.3 * top}
            for s in (-1, 1)
        ],
    )


def _smooth_friction(c: Scene) -> Oddity:
    """Friction that is a random smooth function of speed, load and link angle; size: about its largest part, Nm."""
    top = max(float(np.max(np.abs(m.velocity_rad_s))) for m in c.motions)
    speed, angle, load = c.size * c.rng.dirichlet((1.0, 1.0, 1.0)) * c.rng.choice([-1.0, 1.0], 3)
    numbers = {
        "band_nm": float(speed),
        "band_at_rad_s": float(c.rng.uniform(0.2, 0.9)) * top,
        "band_width_rad_s": float(c.rng.uniform(0.25, 0.5)) * top,
        "bump_nm": float(angle),
        "bump_at_rad": float(c.rng.uniform(-np.pi, np.pi)),
        "bump_width_rad": float(c.rng.uniform(0.6, 1.5)),
        "speed_load": float(load) / (top**2 * 0.5 * float(c.nominal["rated_torque_nm"])),
    }
    return Oddity(numbers=numbers)


UNKNOWN: Final[dict[str, Unknown]] = {
    "coupling_slip": Unknown(_coupling_slip, 1.5, 4.0, "Nm"),
    "local_damage": Unknown(_local_damage, 1.5, 4.0, "Nm"),
    "bearing_line": Unknown(_bearing_line, 0.4, 1.2, "Nm"),
    "frame_vibration": Unknown(_frame_vibration, 0.4, 1.2, "Nm"),
    "sensor_faults": Unknown(_sensor_faults, 3.0, 12.0, "Nm"),
    "current_dead_band": Unknown(_current_dead_band, 3.0, 6.0, "Nm"),
    "friction_bursts": Unknown(_friction_bursts, 1.5, 4.0, "Nm"),
    "speed_band": Unknown(_speed_band, 1.5, 4.0, "Nm"),
    "speed_load": Unknown(_speed_load, 0.1, 0.3, "", resembling=True),
    "smooth_friction": Unknown(_smooth_friction, 0.2, 1.0, "Nm", resembling=True),
}


# Sets of runs.

_JOINTS, _MOTIONS, _DRIFT, _NOISE, _EFFECTS = range(5)
"""Streams of one seed: each leaves the others alone."""
_LATER: Final = 10**6  # stream of further runs


class Builder:
    """One case while it is made: joints, motions, drift, what is hidden, tables as they come."""

    def __init__(self, order: Order, references: Sequence[Reference] = ()) -> None:
        self.order = order
        rng = self.stream(_JOINTS)
        self.joints = (draw_joint(rng, 1), draw_joint(rng, 2))
        rng = self.stream(_MOTIONS)
        chosen = kinds(rng, order.profile, order.runs)
        self.motions = [
            draw_motion(rng, kind, self.joints, k, order.runs, order.duration_s)
            for k, kind in enumerate(chosen)
        ]
        later = (_LATER,) if references else ()
        rng = self.stream(_DRIFT, *later)
        drifts = max(order.runs, len(references))
        self.drifts = [draw_drift(rng) for _ in range(drifts)]
        if order.quiet:
            self.drifts = [Drift(np.ones(2), 0.0, np.zeros(2)) for _ in range(drifts)]
        self._noise = (_NOISE, *later)
        self.oddities: list[tuple[int, Oddity, dict[str, Any]]] = []
        self.truth = [self._truth(k, item) for k, item in enumerate(order.effects)]
        if references:
            rng = self.stream(_MOTIONS, _LATER)
            longest = max(len(r.velocity_rad_s) for r in references)
            self.motions = [
                driven_motion(rng, r, k, len(references), longest) for k, r in enumerate(references)
            ]
        self.tables: list[Columns | None] = [None] * len(self.motions)

    def noise(self, run: int) -> np.random.Generator:
        return self.stream(*self._noise, run)

    def stream(self, *key: int) -> np.random.Generator:
        """Return a generator of its own for this part of the case."""
        return np.random.default_rng([self.order.seed, *key])

    def _truth(self, k: int, item: Hidden | tuple[Any, ...]) -> Truth:
        hidden = item if isinstance(item, Hidden) else Hidden(*item)
        row = 0 if hidden.joint == SENSOR else int(hidden.joint) - 1
        nominal = self.joints[row]
        if hidden.name not in ENTRIES:
            return self._unknown(k, hidden, row)
        values = drawn_parameters(hidden.name, nominal, hidden.size, self.stream(_EFFECTS, k), hidden.fixed)
        sensor = at_sensor(hidden.name) or values.get("channel") == 0.0
        return {
            "name": hidden.name,
            "joint": SENSOR if sensor else row + 1,
            "parameters": values,
            "size": deviation(hidden.name, nominal, values),
        }

    def _unknown(self, k: int, hidden: Hidden, row: int) -> Truth:
        case = Scene(self.stream(_EFFECTS, k), self.joints[row], self.motions, row, 0.0)
        oddity, chosen = draw_unknown(hidden.name, case, hidden.size)
        entry = {
            "name": hidden.name,
            "joint": SENSOR if oddity.faults else row + 1,
            "parameters": dict(oddity.numbers),
            "size": chosen,
            "places": list(oddity.places),
        }
        self.oddities.append((row, oddity, entry))
        return entry


def integrate_together(flat: list[tuple[Builder, int]]) -> None:
    """Integrate these runs side by side and put each table into its set."""
    pairs = [one.joints for one, _ in flat]
    nominal = Plant(pairs, np.ones((2, len(flat))))
    plant = Plant(pairs, np.stack([one.drifts[k].viscous for one, k in flat], axis=1))
    strange = Strange(len(flat))
    for b, (one, k) in enumerate(flat):
        for item in one.truth:
            if item["name"] in ENTRIES:
                row = 0 if item["joint"] == SENSOR else item["joint"] - 1
                plant.hide(item["name"], row, b, item["parameters"])
        for row, oddity, entry in one.oddities:
            _add(oddity, entry, row, b, k, plant, strange)
    truth = integrate(plant, nominal, [one.motions[k] for one, k in flat], strange)
    _add_slips(flat, strange)
    _add_dead_times(flat, truth)
    for b, (one, k) in enumerate(flat):
        stream = one.noise(k)
        faults = strange.faults.get(b, [])
        one.tables[k] = measured(
            truth, plant, b, one.motions[k], one.drifts[k], stream, one.order.quiet, faults
        )


def _add(  # noqa: PLR0917
    oddity: Oddity, entry: dict[str, Any], row: int, b: int, k: int, plant: Plant, strange: Strange
) -> None:
    """Put what run k of a case has of an oddity into bench b of the batch."""
    for name, value in oddity.numbers.items():
        strange.numbers[name][row, b] = value
    if oddity.wave is not None:
        amplitude, order, phase = oddity.wave
        plant.waves.append((row, b, amplitude, order, phase))
    if oddity.phases:
        strange.numbers["vibration_rad"][row, b] = oddity.phases[k]
    if oddity.waits:
        strange.waits[row, b] = list(oddity.waits[k])
    if oddity.faults:
        strange.faults[b] = oddity.faults[k]
        entry["places"] += [_moment(k, f.start, f.start + f.count) for f in oddity.faults[k]]
    if oddity.bursts:
        strange.bursts += [(row, b, *burst) for burst in oddity.bursts[k]]
        entry["places"] += [_moment(k, first, last) for first, last, _ in oddity.bursts[k]]


def _add_slips(flat: list[tuple[Builder, int]], strange: Strange) -> None:
    """Say where slips show: at their moments, and while the torsion stands far from its mean over the run."""
    for row, b in sorted({(row, b) for row, b, *_ in strange.slips}):
        one, k = flat[b]
        entry = next(e for r, o, e in one.oddities if r == row and o.waits)
        cycles, jumps = zip(
            *[(c, jump) for r, i, c, jump in strange.slips if (r, i) == (row, b)], strict=True
        )
        edges = [0, *cycles, len(one.motions[k].on)]
        level = np.concatenate(([0.0], np.cumsum(jumps)))
        away = np.abs(level - np.average(level, weights=np.diff(edges)))
        entry["places"] += [_moment(k, c, c) for c in cycles]
        entry["places"] += [
            _moment(k, edges[i], edges[i + 1]) for i in range(len(level)) if away[i] > 0.5 * away.max()
        ]


def _add_dead_times(flat: list[tuple[Builder, int]], truth: Signals) -> None:
    """Say when the current of a joint in motion was within its dead band."""
    for b, (one, k) in enumerate(flat):
        for row, oddity, entry in one.oddities:
            if "dead_band_a" not in oddity.numbers:
                continue
            small = np.abs(truth.current_a[:, row, b]) < oddity.numbers["dead_band_a"]
            moving = np.abs(truth.motor_rad_s[:, row, b]) > 0.03 * one.joints[row]["gear_ratio"]
            edges = np.flatnonzero(np.diff((small & moving).astype(int), prepend=0, append=0))
            spans = edges.reshape(-1, 2)
            entry["places"] += [_moment(k, int(a), int(z)) for a, z in spans if z - a > 20]


def _moment(k: int, first: int, last: int) -> dict[str, Any]:
    return {"axis": "time", "run": f"run{k + 1}", "low": first * STEP_S, "high": last * STEP_S}


@dataclass(frozen=True)
class Case(Set):
    """A set of runs, its seed, and the references of its motions (for tests)."""

    seed: int = 0
    motions: list[Motion] = field(repr=False, default_factory=list)


def draw(
    seed: int, effects: Sequence[Hidden | tuple[Any, ...]] = (), profile: str = "mixed", **more: Any
) -> Case:
    """Return one set of runs; more: further fields of `Order`.

    The same seed gives the same joints, motions, drift and noise whatever is hidden.
    """
    return draw_many([Order(seed, effects, profile, **more)])[0]


def draw_many(orders: Sequence[Order]) -> list[Case]:
    """Return one case per order; all benches of equal duration are integrated side by side."""
    if len({order.duration_s for order in orders}) > 1:
        raise ValueError("duration_s: found different durations, expected one per batch")
    builders = [Builder(order) for order in orders]
    flat = [(one, k) for one in builders for k in range(len(one.motions))]
    for first in range(0, len(flat), _BATCH):
        integrate_together(flat[first : first + _BATCH])
    return [_case(one) for one in builders]


def follow_up(order: Order, references: Sequence[Reference]) -> list[Columns]:
    """Return further runs of the bench of this order, driven as somebody asks for: one table per reference.

    The same joints with the same things hidden, on other days; the runs may be of different lengths.
    """
    builder = Builder(order, references)
    integrate_together([(builder, k) for k in range(len(references))])
    counts = [len(r.velocity_rad_s) for r in references]
    return [{k: x[:n] for k, x in t.items()} for t, n in zip(_case(builder).runs, counts, strict=True)]


def _case(builder: Builder) -> Case:
    tables = [t for t in builder.tables if t is not None]
    joints = {1: builder.joints[0], 2: builder.joints[1]}
    return Case(tables, joints, builder.truth, builder.order.seed, builder.motions)
