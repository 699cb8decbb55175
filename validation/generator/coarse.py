"""The plant `coarse`: two joints on a towing bench whose laws are unkind to an estimator; numpy alone.

Nothing of the estimator, the effect library or the emulated bench is imported. A file (`coarse.yaml`) has the values with
their sources. Arrays are [2, B]: joint, run. Per joint, joint side, J = Jm G^2, v = w/G, m motor angle, l link angle:

    J dv/dt = G Kt(T) i_r tanh(i/i_r) + cogging(m) - tau (1 + G E'(m)) - F      saturation: i_r far above the rated current
    (J1 + J2) dw/dt = tau_1 - tau_2                                             sensor = tau_1 - J1 dw/dt

Joint 1 may carry a load in place of joint 2: its inertia for J2, its weight for tau_2.

Friction: a bristle of deflection z (Canudas de Wit et al. 1995), fading bristle damping, shear-thinning grease (Eyring):

    dz/dt = v - |v| s0 z / g         F = s0 z + s1 exp(-(v/vd)^2) dz/dt + V asinh(v/v0)
    g = (C + (S - C) exp(-|v/vs|) + L |tau/tau_r|^1.12) (1 +- d) (1 + sum a cos(k m)) (1 + sum b cos(k l))

d is another one while the joint is driven back (tau v < 0). Gear: x is the torsion with its transmission errors,

    x = m/G + sum e cos(k m) + sum f cos(k l) - l       tau = K a tan(x/a) + D dx/dt + sum H y      dy = dx/travel in -1..1

the spring hardens as flexible splines do (Zhang et al. 2015), and four stop operators y make its hysteresis (Tjahjowidodo et
al. 2013). One thermal mass of grease above a housing; Coulomb friction falls linearly, viscous exponentially.

Velocities first, then angles (semi-implicit Euler), all runs of a list side by side; the bristle exactly within a step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

Array = np.ndarray
KEY: Final = "coarse"
"""Key of the file that tells it from others."""
FILE: Final = Path(__file__).with_suffix(".yaml")
NOMINAL: Final = ("gear_ratio", "torque_constant_nm_per_a", "rotor_inertia_kgm2", "rated_torque_nm")
"""What its drives believe of a joint: keys of a joint file."""
CYCLE_S: Final = 1e-3
SUBSTEPS: Final = 5
SIDE: Final = np.array([[1.0], [-1.0]])
"""Joint 2 faces joint 1: its link turns the other way."""
SECTIONS: Final = ("motor", "friction", "gear", "warmth", "measurement", "drive")


class Command(NamedTuple):
    """Set-points of a run, [n] at 1 kHz: velocity [rad/s, joint side] of joint `leader` (0, 1), current [A] of the other."""

    leader: int
    velocity_rad_s: Array
    current_a: Array


class Load(NamedTuple):
    """What joint 1 carries in place of joint 2: inertia [kgm2], its weight a sin q + b cos q [Nm] at the link's angle q."""

    inertia_kgm2: float
    sine_nm: float
    cosine_nm: float


class Recorded(NamedTuple):
    """What was read in a run, columns [n, 2] and sensor [n], and the true torque of the gears [n, 2]."""

    current_a: Array
    motor_rad: Array
    motor_rad_s: Array
    link_rad: Array
    temperature_c: Array
    sensor_nm: Array
    true_nm: Array


class Waves(NamedTuple):
    """Sum of amplitude cos(order angle + phase), arrays [H, 2, 1]."""

    order: Array
    amplitude: Array
    phase: Array

    def at(self, angle: Array) -> Array:
        """Return the sum at angles [2, B]."""
        found: Array = np.einsum("hjk,hjb->jb", self.amplitude, np.cos(self.order * angle + self.phase))
        return found


class _Harmonics:
    """Several sums of waves of one angle, at once: their coefficients of cos and sin of all orders."""

    def __init__(self, sums: Sequence[Waves], slopes: Sequence[Waves]) -> None:
        orders = sorted({float(order) for each in (*sums, *slopes) for order in each.order.ravel()})
        self.orders = np.array(orders)[:, None]
        self.weights = np.zeros((2, len(sums) + len(slopes), 2 * len(orders)))
        for out, waves in enumerate((*sums, *slopes)):
            for order, amplitude, phase in zip(*(each[:, :, 0] for each in waves), strict=True):
                for side in range(2):
                    at = orders.index(float(order[side]))
                    c, s = amplitude[side] * np.cos(phase[side]), -amplitude[side] * np.sin(phase[side])
                    if out >= len(sums):
                        c, s = order[side] * s, -order[side] * c
                    self.weights[side, out, at] += c
                    self.weights[side, out, len(orders) + at] += s

    def at(self, angle: Array) -> Array:
        """Return sums, then derivatives of `slopes` by the angle, at angles [2, B]: [outputs, 2, B]."""
        turned = self.orders * angle[:, None, :]
        found: Array = self.weights @ np.concatenate((np.cos(turned), np.sin(turned)), axis=1)
        return found.transpose(1, 0, 2)


@dataclass(frozen=True)
class Days:
    """Half widths of what another day brings, drawn uniformly; `start_rad`: angle of the links at the start of a run."""

    viscous: float
    coulomb: float
    temperature_k: float
    motor_zero_rad: float
    link_zero_rad: float
    current_zero_a: float
    current_gain: float
    sensor_zero_nm: float
    start_rad: float

    def drawn(self, seed: int, number: int) -> dict[str, Array]:
        """Return by name the values [2] of day `number` of this seed; one value for sensor and start."""
        rng = np.random.default_rng([seed, number, 20])
        return {each.name: getattr(self, each.name) * rng.uniform(-1.0, 1.0, 2) for each in fields(self)}


class Bench:
    """Plant of a file's mapping; nominal: NOMINAL of joints 1 and 2. Raises ValueError for missing or unknown keys."""

    def __init__(self, mapping: Mapping[str, Any], nominal: Sequence[Mapping[str, float]]) -> None:
        sides = [mapping["joint_1"], mapping["joint_2"]]
        for side in sides:
            if set(side) != {"joint", "link_inertia_kgm2", *SECTIONS}:
                raise ValueError(
                    f"coarse: found {sorted(side)}, expected joint, link_inertia_kgm2, {SECTIONS}"
                )
        self.nominal = {key: _column([each[key] for each in nominal]) for key in nominal[0]}
        self.link_inertia = [float(side["link_inertia_kgm2"]) for side in sides]
        self.sections = {name: _merged([side[name] for side in sides]) for name in SECTIONS}
        self.sensor_noise_nm = float(mapping["sensor"]["noise_nm"])
        self.days = Days(**mapping["run_to_run"])

    def record(
        self, commands: Sequence[Command], seed: int, first_day: int = 0, loads: Sequence[Load] = ()
    ) -> list[Recorded]:
        """Return the runs, run k on day first_day + k of this seed; loads: one per run, in place of joint 2."""
        days = [self.days.drawn(seed, first_day + k) for k in range(len(commands))]
        day = {name: np.stack([each[name] for each in days], axis=1) for name in days[0]}
        true = _integrated(self, commands, day, loads)
        return [
            _read(
                self, true, k, len(command.current_a), day, np.random.default_rng([seed, first_day + k, 21])
            )
            for k, command in enumerate(commands)
        ]


def _column(values: Sequence[float]) -> Array:
    return np.array(values, np.float64)[:, None]


def _merged(pair: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a section of both joints: numbers [2, 1], lists of numbers [k, 2, 1], waves and slips by their kind."""
    one, two = pair
    if set(one) != set(two):
        raise ValueError(f"coarse: found keys {sorted(set(one) ^ set(two))} of one joint only")
    merged: dict[str, Any] = {}
    for key, value in one.items():
        other = two[key]
        if not isinstance(value, list):
            merged[key] = _column([value, other])
        elif value and isinstance(value[0], Mapping):
            merged[key] = _listed(value, other)
        else:
            merged[key] = np.array([value, other], np.float64).T[:, :, None]
    return merged


def _listed(one: Sequence[Mapping[str, float]], two: Sequence[Mapping[str, float]]) -> Any:
    """Return waves, or slips as (torque, travel), each [k, 2, 1]; a shorter list is filled with entries of no size."""
    count = max(len(one), len(two))
    keys = list(one[0])
    out = np.zeros((len(keys), count, 2, 1))
    out[-1] = 1.0 if len(keys) == 2 else 0.0
    for row, entries in enumerate((one, two)):
        for k, entry in enumerate(entries):
            out[:, k, row, 0] = [entry[key] for key in keys]
    return Waves(*out) if len(keys) == 3 else tuple(out)


class _Drives:
    """Loops of both drives: velocity (PI with feedforward, motor side) of the leader, current of the other one."""

    def __init__(self, bench: Bench, commands: Sequence[Command]) -> None:
        p, nominal = bench.sections["drive"], bench.nominal
        self.ratio = nominal["gear_ratio"]
        length = max(len(each.current_a) for each in commands)
        self.leads = np.arange(2)[:, None] == np.array([each.leader for each in commands])
        pad = [(0, length - len(each.current_a)) for each in commands]
        self.velocity = np.stack(
            [np.pad(each.velocity_rad_s, n) for each, n in zip(commands, pad, strict=True)], axis=1
        )
        self.current = np.stack(
            [np.pad(each.current_a, n) for each, n in zip(commands, pad, strict=True)], axis=1
        )
        self.gain = (
            p["velocity_bandwidth_rad_s"]
            * nominal["rotor_inertia_kgm2"]
            / nominal["torque_constant_nm_per_a"]
        )
        self.reset = self.gain / p["velocity_integral_time_s"]
        self.inertia = (
            p["acceleration_feedforward"]
            * nominal["rotor_inertia_kgm2"]
            / nominal["torque_constant_nm_per_a"]
        )
        self.friction, self.limit = p["friction_feedforward_a"], p["current_limit_a"]
        self.steepest = p["acceleration_limit_rad_s2"] * self.ratio
        self.share = 1.0 - np.exp(-2.0 * np.pi * p["current_bandwidth_hz"] * CYCLE_S / SUBSTEPS)
        self.reference = np.zeros((2, len(commands)))
        self.integral, self.flowing = np.zeros_like(self.reference), np.zeros_like(self.reference)

    def plan(self, cycle: int) -> None:
        """Take over the set-points of a cycle."""
        wanted = self.leads * self.velocity[cycle] * self.ratio
        self.slope = np.clip((wanted - self.reference) / CYCLE_S, -self.steepest, self.steepest)
        middle = (self.reference + 0.5 * CYCLE_S * self.slope) / self.ratio
        self.forward = self.inertia * self.slope + self.friction * middle / (np.abs(middle) + 0.01)
        self.asked = np.clip(self.current[cycle], -self.limit, self.limit)

    def step(self, h: float, motor_rad_s: Array) -> Array:
        """Advance by h seconds and return the currents [2, B]."""
        self.reference += h * self.slope
        error = self.reference - motor_rad_s
        wanted = self.gain * error + self.integral + self.forward
        self.integral += (h * self.reset) * error * (np.abs(wanted) <= self.limit)
        wanted = np.where(self.leads, np.clip(wanted, -self.limit, self.limit), self.asked)
        self.flowing += self.share * (wanted - self.flowing)
        return self.flowing


class _Friction:
    """Bristles of both joints, joint side; `coulomb`, `viscous`: factors of day and temperature [2, B]."""

    def __init__(self, bench: Bench, day: Mapping[str, Array]) -> None:
        self.p = p = bench.sections["friction"]
        self.rated = bench.nominal["rated_torque_nm"]
        self.stiffness = p["coulomb_nm"] / p["bristle_rad"]
        inertia = bench.sections["motor"]["rotor_inertia_kgm2"] * bench.nominal["gear_ratio"] ** 2
        self.damping = 2.0 * p["bristle_damping_ratio"] * np.sqrt(self.stiffness * inertia)
        self.bent = np.zeros_like(day["coulomb"])
        self.coulomb, self.viscous = 1.0 + day["coulomb"], 1.0 + day["viscous"]
        self.peak = (p["static_ratio"] - 1.0) * p["coulomb_nm"]

    def sliding(self, v: Array, tau: Array, waves: Array) -> Array:
        """Return g [2, B], what the bristles bear while they slide; waves [2, B]: product of both angles' factors."""
        p = self.p
        speed, forward = np.abs(v), np.tanh(v * (1.0 / 0.01))
        level = self.coulomb * (p["coulomb_nm"] + self.peak * np.exp(-speed / p["stribeck_velocity_rad_s"]))
        level += p["load_nm"] * (np.abs(tau) / self.rated) ** p["load_exponent"]
        level *= 1.0 + forward * np.where(tau * v < 0.0, p["direction_share_back"], p["direction_share"])
        return np.asarray(np.maximum(level * waves, 0.05))

    def step(self, h: float, v: Array, tau: Array, waves: Array) -> Array:
        """Advance by h seconds at constant v; return the friction torque [2, B]."""
        p = self.p
        level = self.sliding(v, tau, waves)
        speed = np.abs(v)
        decay = np.exp(speed * self.stiffness * (-h) / level)
        before = self.bent
        # v h for v -> 0: what is bent at constant v, solved exactly
        settled = np.where(speed > 1e-9, np.sign(v) * level / self.stiffness * (1.0 - decay), v * h)
        self.bent = before * decay + settled
        fading = np.exp(-((v / p["damping_velocity_rad_s"]) ** 2))
        total = 0.5 * self.stiffness * (self.bent + before)
        total += self.damping * fading * (self.bent - before) / h
        return np.asarray(total + self.viscous * p["viscous_nm"] * np.arcsinh(v / p["eyring_rad_s"]))


class _Gear:
    """Torsion, spring and stop operators of both joints."""

    def __init__(self, bench: Bench) -> None:
        self.p = p = bench.sections["gear"]
        self.ratio = bench.nominal["gear_ratio"]
        self.slip_nm, self.travel = p["slips"]
        self.stops: Array | float = 0.0
        self.torsion: Array | float = 0.0

    def turn(self, motor: Array, link: Array, error: Array) -> None:
        """Go to these angles with this transmission error [2, B]."""
        torsion = motor / self.ratio + error - link
        self.stops = np.clip(self.stops + (torsion - self.torsion) / self.travel, -1.0, 1.0)
        self.torsion = torsion

    def relax(self) -> None:
        self.stops = np.zeros(np.shape(self.stops))

    def torque(self, rate: Array) -> Array:
        """Return tau [2, B] at this rate of the torsion."""
        harden = self.p["hardening_rad"]
        spring = self.p["stiffness_nm_per_rad"] * harden * np.tan(self.torsion / harden)
        total = spring + self.p["damping_nms_per_rad"] * rate
        return np.asarray(total + (self.slip_nm * self.stops).sum(axis=0))


class _Warmth:
    """Temperatures of both joints: grease and housing; updated once in UPDATE cycles."""

    UPDATE = 100

    def __init__(self, bench: Bench, day: Mapping[str, Array]) -> None:
        self.p = p = bench.sections["warmth"]
        self.room = p["ambient_c"] + day["temperature_k"]
        self.grease, self.housing = self.room.copy(), self.room.copy()

    def add(self, power_w: Array) -> None:
        """Add losses [2, B] over UPDATE cycles."""
        p, dt = self.p, self.UPDATE * CYCLE_S
        self.grease += (
            dt
            / p["grease_time_constant_s"]
            * (self.housing + p["grease_kelvin_per_w"] * power_w - self.grease)
        )
        self.housing += (
            dt
            / p["housing_time_constant_s"]
            * (self.room + p["housing_kelvin_per_w"] * power_w - self.housing)
        )

    def factors(self) -> tuple[Array, Array]:
        """Return the factors of Coulomb and of viscous friction [2, B]."""
        above = self.grease - self.p["reference_c"]
        return np.maximum(1.0 - self.p["coulomb_per_k"] * above, 0.2), np.exp(
            -self.p["viscous_per_k"] * above
        )


def _other_side(bench: Bench, loads: Sequence[Load]) -> tuple[Array | float, Callable[[Array, Array], Array]]:
    """Return the inertia of all that the links are, and what is against joint 1 at a position, where joint 2 pulls [Nm]."""
    if not loads:
        return sum(bench.link_inertia), lambda position, pull: pull
    inertia, sine, cosine = np.array(loads).T
    return bench.link_inertia[
        0
    ] + inertia, lambda position, pull: sine * np.sin(position) + cosine * np.cos(position)


def _integrated(
    bench: Bench, commands: Sequence[Command], day: Mapping[str, Array], loads: Sequence[Load] = ()
) -> dict[str, Array]:
    """Return the true signals at 1 kHz, arrays [n, 2, B], by name; sensor [n, B]."""
    drives, friction, gear, warmth = (
        _Drives(bench, commands),
        _Friction(bench, day),
        _Gear(bench),
        _Warmth(bench, day),
    )
    motor_law, ratio = bench.sections["motor"], bench.nominal["gear_ratio"]
    inertia = motor_law["rotor_inertia_kgm2"] * ratio**2
    own, (both, weight) = bench.link_inertia[0], _other_side(bench, loads)
    n, count, h = drives.velocity.shape[0], len(commands), CYCLE_S / SUBSTEPS
    out = {name: np.empty((n, 2, count)) for name in ("current", "motor", "link", "celsius", "tau")}
    out["sensor"] = np.empty((n, count))
    position, w = np.zeros(count) + day["start_rad"][0], np.zeros(count)
    link = SIDE * position
    motor, v = ratio * link, np.zeros((2, count))
    gear_law, friction_law = bench.sections["gear"], bench.sections["friction"]
    of_motor = _Harmonics(
        [gear_law["errors"], friction_law["motor_angle"], motor_law["cogging"]], [gear_law["errors"]]
    )
    of_link = _Harmonics([gear_law["link_errors"], friction_law["link_angle"]], [gear_law["link_errors"]])
    error, rubbed, cogging, slope = of_motor.at(motor)
    link_error, link_rubbed, link_slope = of_link.at(link)
    gear.turn(motor, link, error + link_error)
    gear.relax()
    tau = gear.torque(np.zeros_like(v))
    heat = np.zeros((2, count))
    friction_day, knee = (friction.coulomb, friction.viscous), motor_law["saturation_a"]
    for k in range(n):
        out["current"][k], out["motor"][k], out["link"][k] = drives.flowing, motor, link
        out["celsius"][k], out["tau"][k] = warmth.housing, tau
        out["sensor"][k] = tau[0] - own / both * (tau[0] - weight(position, tau[1]))
        if k % warmth.UPDATE == 0:
            if k:
                warmth.add(heat / (warmth.UPDATE * SUBSTEPS))
            heat[:] = 0.0
            factors = warmth.factors()
            friction.coulomb, friction.viscous = friction_day[0] * factors[0], friction_day[1] * factors[1]
            warm_k = warmth.housing - bench.sections["warmth"]["reference_c"]
            full = (
                ratio
                * motor_law["torque_constant_nm_per_a"]
                * (1.0 - motor_law["torque_constant_per_k"] * warm_k)
            )
        drives.plan(k)
        for _ in range(SUBSTEPS):
            current = drives.step(h, ratio * v)
            rubbing = friction.step(h, v, tau, (1.0 + rubbed) * (1.0 + link_rubbed))
            driving = full * knee * np.tanh(current / knee) + ratio * cogging
            v = v + (h / inertia) * (driving - tau * (1.0 + ratio * slope) - rubbing)
            pull = tau * (1.0 - link_slope)
            w = w + (h / both) * (pull[0] - weight(position, pull[1]))
            position = position + h * w
            link = SIDE * position
            motor = motor + h * ratio * v
            error, rubbed, cogging, slope = of_motor.at(motor)
            link_error, link_rubbed, link_slope = of_link.at(link)
            gear.turn(motor, link, error + link_error)
            tau = gear.torque(v * (1.0 + ratio * slope) - SIDE * w * (1.0 - link_slope))
            heat += np.abs(rubbing * v)
    return out


def _counted(x: Array, unit: float) -> Array:
    return np.asarray(np.round(x / unit) * unit)


def _read(  # noqa: PLR0917
    bench: Bench,
    true: Mapping[str, Array],
    k: int,
    n: int,
    day: Mapping[str, Array],
    rng: np.random.Generator,
) -> Recorded:
    """Return what the instruments read of run k, its first n samples."""
    p, drive = bench.sections["measurement"], bench.sections["drive"]
    motor, link, current = (true[name][:n, :, k].T for name in ("motor", "link", "current"))
    read_motor = motor + day["motor_zero_rad"][:, k, None] + p["motor_errors"].at(motor)
    read_link = link + day["link_zero_rad"][:, k, None] + p["link_errors"].at(link)
    read_link = read_link + p["link_noise_rad"] * rng.normal(size=link.shape)
    amps = (1.0 + day["current_gain"][:, k, None]) * (current + p["current_ripple"].at(motor))
    amps = amps + day["current_zero_a"][:, k, None] + p["current_noise_a"] * rng.normal(size=current.shape)
    counts = [2.0 * math.pi / p[name] for name in ("motor_counts_per_rev", "link_counts_per_rev")]
    positions = _counted(read_motor, counts[0])
    share = 1.0 - np.exp(-CYCLE_S / p["velocity_filter_s"])
    rates = np.diff(positions, axis=1, prepend=positions[:, :1]) / CYCLE_S
    speeds = np.empty_like(rates)
    before = np.zeros(2)
    for j in range(n):
        speeds[:, j] = before = before + share[:, 0] * (rates[:, j] - before)
    sensor = true["sensor"][:n, k] + day["sensor_zero_nm"][0, k] + bench.sensor_noise_nm * rng.normal(size=n)
    return Recorded(
        _counted(amps, drive["rated_current_a"] / 1000.0).T,
        positions.T,
        speeds.T,
        _counted(read_link, counts[1]).T,
        _counted(true["celsius"][:n, :, k], 0.1),
        _counted(sensor, 0.001),
        true["tau"][:n, :, k].copy(),
    )
