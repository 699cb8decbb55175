"""The generator's plant: constants, parts that no library has, equations, integrator; B benches side by side.

Arrays are [2, B]: joint, run. Joint side:

    tau_j = K d + K3 d^3 + H z + D dd/dt          d = theta_m/G + E sin(k theta_m + psi) - theta_l (- play)
    J dv/dt = drive(i) - tau (1 + G E k cos(k theta_m + psi)) - friction - waves(theta_m)      J = Jm G^2, v = omega_m/G
    (Jl1 + Jl2) dw/dt = (tau_1 - load_1) - (tau_2 - load_2)      w = omega_l1 = -omega_l2
    sensor = tau_1 - load_1 - Jl1 dw/dt

Friction is a bristle: s in -1..1 is its bending over a travel of 40 urad, so that a joint sticks without creeping and
turns round over a travel that no speed of 0.03 rad/s ever resolves. z is the bending of the gear's own Maxwell element.

Control at 1 kHz, explicit midpoint rule at 4 kHz; the bristle is integrated exactly within each half step. The current runs
in straight lines from set-point to set-point, one cycle late, so that its samples are fair to what is between them. The link
resonance of the stiffest bench (1900 rad/s) has omega h = 0.48 and is damped well beyond the rule's own growth.

References of a run, arrays [n] at 1 kHz, are drawn at random: velocity of one joint, current of the other. Every run has
rests: standstill, both drives off, so zero current and zero set load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

STEP_S: Final = 1e-3
RUN_S: Final = 20.0
KINDS: Final = ("fourier", "ladder", "slow", "turns")
PROFILES: Final = ("mixed", *KINDS, "constant")
"""mixed: every kind of KINDS in turn; constant: one speed and one load per run, which tells little (for refusals)."""

Array = np.ndarray


@dataclass(frozen=True)
class Motion:
    """velocity_rad_s, load_a, on: [n]; leader: index (0, 1) of the joint in velocity mode, the other takes load_a; marked:
    where the run table has the drives without power [n], None: it has no such column.
    """

    kind: str
    leader: int
    velocity_rad_s: Array
    load_a: Array
    on: Array
    start_rad: float
    temperature_c: Array  # [2, n]
    marked: Array | None = None


@dataclass(frozen=True)
class Reference:
    """Set-points that somebody asks for, [n] at 1 kHz: velocity of joint `leader` (0, 1), current of the other; off: (first,
    end) of samples for which the drives are to be switched off.
    """

    leader: int
    velocity_rad_s: Array
    load_a: Array
    off: tuple[tuple[int, int], ...] = ()


def driven_motion(
    rng: np.random.Generator, reference: Reference, run: int, count: int, samples: int
) -> Motion:
    """Return the motion of a reference, at rest after its end up to `samples`; drives are off where nothing is asked."""
    spare = samples - len(reference.velocity_rad_s)
    velocity = np.pad(reference.velocity_rad_s, (0, spare))
    load = np.pad(reference.load_a, (0, spare))
    idle = (velocity == 0.0) & (load == 0.0)
    settled = np.convolve(idle, np.ones(200), "full")[:samples] > 199.5
    marked = np.zeros(samples, bool)
    for first, end in reference.off:
        marked[first:end] = True
    t = STEP_S * np.arange(samples)
    start = float(rng.uniform(-3.0, 3.0))
    return Motion(
        "asked",
        reference.leader,
        velocity,
        load,
        ~(settled | marked),
        start,
        _temperature(rng, t, run, count),
        marked if reference.off else None,
    )


def draw_motion(  # noqa: PLR0917
    rng: np.random.Generator,
    kind: str,
    joints: tuple[dict[str, Any], dict[str, Any]],
    run: int,
    count: int,
    duration_s: float = RUN_S,
) -> Motion:
    """Return the references of run number `run` of `count`."""
    n = round(duration_s / STEP_S)
    t = STEP_S * np.arange(n)
    leader = int(rng.integers(2))
    follower = joints[1 - leader]
    speed = _speed_limit(rng, joints)
    rated = min(j["rated_torque_nm"] for j in joints)
    load = rng.uniform(0.5, 0.75) * rated / (follower["gear_ratio"] * follower["torque_constant_nm_per_a"])
    velocity, current = _SHAPES[kind](rng, t)
    moving, on = _rests(rng, t)
    return Motion(
        kind=kind,
        leader=leader,
        velocity_rad_s=speed * velocity * moving,
        load_a=load * current * moving,
        on=on,
        start_rad=float(rng.uniform(-3.0, 3.0)),
        temperature_c=_temperature(rng, t, run, count),
    )


def kinds(rng: np.random.Generator, profile: str, count: int) -> list[str]:
    """Return the kind of each of `count` runs; ValueError for an unknown profile."""
    if profile not in PROFILES:
        raise ValueError(f"profile: found {profile!r}, expected one of {', '.join(PROFILES)}")
    if profile != "mixed":
        return [profile] * count
    order = [KINDS[k % len(KINDS)] for k in range(count)]
    return [order[k] for k in rng.permutation(count)]


def _speed_limit(rng: np.random.Generator, joints: tuple[dict[str, Any], dict[str, Any]]) -> float:
    """Return a top speed [rad/s] at which friction alone takes at most 55 % of rated torque of either joint."""
    limits = [
        (0.55 * j["rated_torque_nm"] - j["friction"]["coulomb_nm"]) / j["friction"]["viscous_nms_per_rad"]
        for j in joints
    ]
    return float(min(rng.uniform(1.2, 2.2), *limits))


def _waves(rng: np.random.Generator, t: Array, low_hz: float, high_hz: float, count: int = 6) -> Array:
    """Return a sum of sines with non-commensurate periods, largest magnitude 1."""
    f = np.exp(rng.uniform(np.log(low_hz), np.log(high_hz), count))
    a = rng.uniform(0.4, 1.0, count) * (low_hz / f) ** 0.3
    x = np.sin(2 * np.pi * np.outer(f, t) + rng.uniform(0, 2 * np.pi, (count, 1)))
    y: Array = a @ x
    y /= np.max(np.abs(y))
    return y


def _levels(rng: np.random.Generator, t: Array, values: Array, ramp_s: float) -> Array:
    """Return plateaus of `values` of nearly equal length, joined by ramps."""
    edges = np.linspace(0.0, t[-1] + STEP_S, len(values) + 1)
    edges[1:-1] += rng.uniform(-0.1, 0.1, len(values) - 1) * edges[1]
    x = values[np.clip(np.searchsorted(edges, t, "right") - 1, 0, len(values) - 1)]
    wide = max(1, round(ramp_s / STEP_S))
    smooth: Array = np.convolve(np.pad(x, wide, mode="edge"), np.full(wide, 1.0 / wide), "same")[wide:-wide]
    return smooth


def _fourier(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    return _waves(rng, t, 0.08, 1.0), _waves(rng, t, 0.06, 0.9)


def _ladder(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    steps = np.geomspace(0.05, 1.0, 5)
    values = rng.permutation(np.concatenate((steps, -steps)))
    loads = rng.uniform(0.15, 1.0, 22) * rng.choice([-1.0, 1.0], 22)
    return _levels(rng, t, values, 0.25), _levels(rng, t, loads, 0.03)


def _slow(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    period = rng.uniform(2.0, 4.5)
    slow = rng.uniform(0.06, 0.25) * np.sin(2 * np.pi * t / period)
    fade = _smooth_step((t - rng.uniform(0.5, 0.65) * t[-1]) / 1.0)
    velocity = slow * (1 - fade) + fade * _waves(rng, t, 0.15, 0.7)
    return velocity, _waves(rng, t, 0.1, 0.7)


def _turns(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    values = np.array([1.0, -rng.uniform(0.5, 0.9)]) * rng.choice([-1.0, 1.0])
    velocity = _levels(rng, t, values, 0.5) * (0.85 + 0.15 * _waves(rng, t, 0.1, 0.6))
    return velocity, _waves(rng, t, 0.05, 0.5)


def _constant(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    one = np.ones_like(t)
    return rng.uniform(0.3, 0.9) * one, rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0]) * one


_SHAPES: Final[dict[str, Callable[[np.random.Generator, Array], tuple[Array, Array]]]] = {
    "fourier": _fourier,
    "ladder": _ladder,
    "slow": _slow,
    "turns": _turns,
    "constant": _constant,
}


def _rests(rng: np.random.Generator, t: Array) -> tuple[Array, Array]:
    """Return a factor 0..1 on both references, and where the drives are on: a rest first, one within, one last."""
    end = float(t[-1])
    middle = rng.uniform(0.35, 0.65) * end
    spans = ((-9.0, 0.7), (middle, middle + rng.uniform(0.9, 1.3)), (end - 0.5, end + 9.0))
    moving = np.ones_like(t)
    on = np.ones(len(t), bool)
    ramp = 0.4
    for low, high in spans:
        moving *= 1.0 - _smooth_step((t - (low - ramp)) / ramp) * _smooth_step((high + ramp - t) / ramp)
        on &= ~((t > low + 0.1) & (t < high))
    return moving, on


def _smooth_step(x: Array) -> Array:
    y = np.clip(x, 0.0, 1.0)
    result: Array = y * y * (3.0 - 2.0 * y)
    return result


def _temperature(rng: np.random.Generator, t: Array, run: int, count: int) -> Array:
    """Return temperatures [2, n] that rise within a run and, on the whole, from 25 to 45 C over all runs."""
    out = np.empty((2, len(t)))
    for j in range(2):
        begin = 25.0 + 15.0 * run / max(count - 1, 1) + rng.uniform(-2.0, 2.0)
        out[j] = begin + rng.uniform(2.5, 7.0) * (1.0 - np.exp(-t / rng.uniform(6.0, 15.0)))
    return out


# The plant.

MOTOR_FAMILY: Final = ("torque_ripple", "cogging")

_ZERO: Final = (
    *("stribeck", "load_coefficient", "asymmetry", "viscous_per_k", "coulomb_per_k", "kinematic"),
    *("kinematic_phase", "cubic", "hysteresis", "play", "saturation", "constant_per_k", "unbalance"),
    "unbalance_phase",
    # measurement
    *("current_offset", "link_eccentricity", "link_eccentricity_phase", "motor_eccentricity"),
    *("motor_eccentricity_phase", "current_delay", "link_delay"),
    # sensor: row 0 counts
    *("sensor_offset", "sensor_rate", "sensor_per_k", "crosstalk", "crosstalk_share", "crosstalk_phase"),
    "sensor_delay",
)
_NEUTRAL: Final = {
    **dict.fromkeys(_ZERO, 0.0),
    "stribeck_velocity": 0.05,
    "friction_reference": 25.0,
    "kinematic_order": 2.0,
    "travel": 1e-4,
    "constant_reference": 25.0,
    "sensor_gain": 1.0,
    "sensor_reference": 25.0,
}
"""Array -> value of a bench without hidden effects."""


class Plant:
    """Arrays [2, B] by attribute; waves: motor-side torque waves (joint, run, amplitude, order, phase)."""

    def __init__(self, joints: list[tuple[dict[str, Any], dict[str, Any]]], viscous_factor: Array) -> None:
        def of(key: str, inner: str = "") -> Array:
            rows = [[(j[inner] if inner else j)[key] for j in pair] for pair in joints]
            return np.array(rows, np.float64).T.copy()

        self.count = len(joints)
        self.ratio = of("gear_ratio")
        self.torque_constant = of("torque_constant_nm_per_a")
        self.rotor = of("rotor_inertia_kgm2")
        self.stiffness = of("stiffness_nm_per_rad")
        self.damping = of("damping_nms_per_rad")
        self.link_inertia = of("link_inertia_kgm2")
        self.rated = of("rated_torque_nm")
        self.coulomb = of("coulomb_nm", "friction")
        self.viscous = of("viscous_nms_per_rad", "friction")
        self.viscous_factor = viscous_factor
        self.waves: list[tuple[int, int, float, float, float]] = []
        for name, value in _NEUTRAL.items():
            setattr(self, name, np.full((2, self.count), value))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)

    def hide(self, name: str, row: int, run: int, p: Mapping[str, float]) -> None:
        """Give joint `row` (sensor: 0) of run `run` the effect; parameters as in the joint file."""
        if name in MOTOR_FAMILY:
            wave = (p["amplitude_nm"], p["order_per_motor_rev"], p["phase_rad"])
            self.waves.append((row, run, *wave))
            return
        if name == "encoder_eccentricity":
            side = "motor" if p.get("motor_side", 0.0) else "link"
            getattr(self, f"{side}_eccentricity")[row, run] = p["amplitude_rad"]
            getattr(self, f"{side}_eccentricity_phase")[row, run] = p["phase_rad"]
            return
        if name == "channel_delay":
            channel = ("sensor", "current", "link")[int(p["channel"])]
            getattr(self, f"{channel}_delay")[0 if channel == "sensor" else row, run] = p["delay_s"]
            return
        for key, array in _ARRAYS[name].items():
            if key in p:
                getattr(self, array)[row, run] = p[key]


_ARRAYS: Final[dict[str, dict[str, str]]] = {
    "coulomb_friction": {"coulomb_nm": "coulomb"},
    "viscous_friction": {"viscous_nms_per_rad": "viscous"},
    "stribeck_friction": {"stribeck_nm": "stribeck", "stribeck_velocity_rad_s": "stribeck_velocity"},
    "load_dependent_friction": {"load_coefficient": "load_coefficient"},
    "friction_asymmetry": {"asymmetry_nm": "asymmetry"},
    "temperature_dependent_friction": {
        "viscous_per_k": "viscous_per_k",
        "coulomb_per_k": "coulomb_per_k",
        "reference_c": "friction_reference",
    },
    "kinematic_error": {
        "amplitude_rad": "kinematic",
        "order_per_motor_rev": "kinematic_order",
        "phase_rad": "kinematic_phase",
    },
    "nonlinear_stiffness": {"stiffness_nm_per_rad": "stiffness", "cubic_nm_per_rad3": "cubic"},
    "hysteresis": {"torque_nm": "hysteresis", "travel_rad": "travel"},
    "lost_motion": {"width_rad": "play"},
    "gear_damping": {"damping_nms_per_rad": "damping"},
    "torque_constant": {"torque_constant_nm_per_a": "torque_constant"},
    "torque_constant_saturation": {"saturation_per_a": "saturation"},
    "torque_constant_temperature": {"per_k": "constant_per_k", "reference_c": "constant_reference"},
    "current_offset": {"offset_a": "current_offset"},
    "rotor_inertia": {"rotor_inertia_kgm2": "rotor"},
    "sensor_offset": {"offset_nm": "sensor_offset"},
    "sensor_gain": {"gain": "sensor_gain"},
    "sensor_drift": {
        "rate_nm_per_s": "sensor_rate",
        "per_k_nm": "sensor_per_k",
        "reference_c": "sensor_reference",
    },
    "sensor_crosstalk": {
        "amplitude_nm": "crosstalk",
        "share": "crosstalk_share",
        "phase_rad": "crosstalk_phase",
    },
    "link_inertia": {"link_inertia_kgm2": "link_inertia"},
    "unbalance": {"moment_nm": "unbalance", "phase_rad": "unbalance_phase"},
}
"""Effect -> parameter -> array that it is written to."""


NEUTRAL: Final = {
    "slip_rad": 0.0,
    "slip_above_nm": np.inf,
    "bump_nm": 0.0,
    "bump_at_rad": 0.0,
    "bump_width_rad": 1.0,
    "band_nm": 0.0,
    "band_at_rad_s": 0.0,
    "band_width_rad_s": 1.0,
    "speed_load": 0.0,
    "dead_band_a": 0.0,
    "vibration_nm": 0.0,
    "vibration_hz": 1.0,
    "vibration_rad": 0.0,
}
"""Numbers of each part that is in no library (`unknown`): finite neutral values, so that one formula serves the batch."""


@dataclass(frozen=True)
class Fault:
    """The sensor reads `value_nm` above the truth, or nothing at all (`dropped`), for `count` samples."""

    start: int
    count: int
    value_nm: float = 0.0
    dropped: bool = False


class Strange:
    """State of what no effect of the library describes."""

    def __init__(self, count: int) -> None:
        self.numbers = {name: np.full((2, count), value) for name, value in NEUTRAL.items()}
        self.waits: dict[
            tuple[int, int], list[int]
        ] = {}  # (joint, run): cycles between slips, the last for ever
        self.bursts: list[tuple[int, int, int, int, float]] = []  # joint, run, first and last cycle, Nm
        self.faults: dict[int, list[Fault]] = {}  # run: faults of the sensor
        self.slips: list[tuple[int, int, int, float]] = []  # joint, run, cycle, rad: what has happened
        self.slipped_rad = np.zeros((2, count))
        self._next = np.full((2, count), np.iinfo(np.int64).max)
        self._burst_nm = np.zeros((2, count))
        self._changes: dict[int, list[tuple[int, int, float]]] = {}
        self.extra_nm: Array | None = None

    def begin(self) -> None:
        """Look at what is there; call it once, before the first cycle."""
        self.has = {name for name, x in self.numbers.items() if bool(np.any(x != NEUTRAL[name]))}
        self.has_friction = bool(self.has & {"bump_nm", "band_nm", "speed_load"}) or bool(self.bursts)
        for (row, run), waits in self.waits.items():
            self._next[row, run] = waits.pop(0)
        for row, run, first, last, size in self.bursts:
            self._changes.setdefault(first, []).append((row, run, size))
            self._changes.setdefault(last, []).append((row, run, -size))

    def at(self, cycle: int, tau: Array) -> None:
        """Take over what happens at this control cycle; tau [2, B]: torque of the gears."""
        if "slip_rad" in self.has:
            ready = (self._next <= cycle) & (np.abs(tau) > self.numbers["slip_above_nm"])
            for row, run in np.argwhere(ready):
                jump = float(np.sign(tau[row, run]) * self.numbers["slip_rad"][row, run])
                self.slipped_rad[row, run] += jump
                waits = self.waits[row, run]
                self._next[row, run] = cycle + (waits.pop(0) if waits else 10**9)
                self.slips.append((int(row), int(run), cycle, jump))
        for row, run, change in self._changes.get(cycle, ()):
            self._burst_nm[row, run] += change
        if "vibration_nm" in self.has:
            n = self.numbers
            phase = 2.0 * np.pi * n["vibration_hz"] * (cycle * STEP_S) + n["vibration_rad"]
            self.extra_nm = n["vibration_nm"] * np.sin(phase)

    def dead_band(self, current: Array) -> Array:
        """Return the current that makes torque: below the width it folds back to nothing, above it is whole."""
        x = np.clip(np.abs(current) / np.maximum(self.numbers["dead_band_a"], 1e-9), 0.0, 1.0)
        left: Array = current * (x * x * (3.0 - 2.0 * x))
        return left

    def friction(self, v: Array, link: Array, tau: Array) -> Array:
        """Return friction in addition [Nm], without its direction."""
        n = self.numbers
        total = self._burst_nm
        if "bump_nm" in self.has:
            away = np.mod(link - n["bump_at_rad"] + np.pi, 2.0 * np.pi) - np.pi
            total = total + n["bump_nm"] * np.exp(-((away / n["bump_width_rad"]) ** 2))
        if "band_nm" in self.has:
            away = (np.abs(v) - n["band_at_rad_s"]) / n["band_width_rad_s"]
            total = total + n["band_nm"] * np.exp(-away * away)
        if "speed_load" in self.has:
            total = total + n["speed_load"] * v * v * np.abs(tau)
        return total


BRISTLE_RAD: Final = 4e-5
_BRISTLE_DAMPING: Final = 0.15  # share of critical, while it sticks
_BRISTLE_FADE_RAD_S: Final = 4e-3  # speed at which that damping has fallen to a half
SIDE: Final = np.array([[1.0], [-1.0]])  # joint 2 faces joint 1: theta_l2 = -theta_l1


class Forces:
    """Accelerations of one batch; only what at least one bench of it has is computed."""

    def __init__(self, p: Plant, strange: Strange) -> None:
        self.p = p
        self.strange = strange
        strange.begin()
        self.inverse_inertia = 1.0 / (p.rotor * p.ratio**2)
        self.inverse_links = 1.0 / p.link_inertia.sum(axis=0)
        stiffness = np.maximum(p.coulomb, 1.0) / BRISTLE_RAD
        self.bristle = 2.0 * _BRISTLE_DAMPING * np.sqrt(stiffness / self.inverse_inertia)
        self.coulomb = p.coulomb.copy()
        self.viscous = p.viscous * p.viscous_factor
        self.per_amp = p.ratio * p.torque_constant
        self.temperature_k = np.zeros_like(p.ratio)
        self.half_play = 0.5 * p.play
        self.kinematic_slope = p.kinematic * p.kinematic_order * p.ratio
        self.wave_order, self.wave_size, self.wave_phase = _stacked_waves(p)
        self.has = {
            name for name, array in vars(p).items() if isinstance(array, Array) and bool(np.any(array))
        }
        self.warms = bool(self.has & {"viscous_per_k", "coulomb_per_k", "constant_per_k"})

    def warm(self, temperature_c: Array) -> None:
        """Take over the temperatures [2, B]; they change slowly, once per control cycle is enough."""
        if not self.warms:
            return
        p = self.p
        above = temperature_c - p.friction_reference
        self.viscous = p.viscous * p.viscous_factor * np.exp(-p.viscous_per_k * above)
        self.coulomb = p.coulomb * np.exp(-p.coulomb_per_k * above)
        factor = 1.0 + p.constant_per_k * (temperature_c - p.constant_reference)
        self.per_amp = p.ratio * p.torque_constant * factor

    def torsion(self, q: Array, link: Array) -> tuple[Array, Array | None]:
        """Return the torsion d without play [2, B] and G E k cos(k theta_m + psi); q = theta_m/G."""
        p = self.p
        d = q - link
        slope = None
        if "kinematic" in self.has:
            angle = p.kinematic_order * p.ratio * q + p.kinematic_phase
            d += p.kinematic * np.sin(angle)
            slope = self.kinematic_slope * np.cos(angle)
        if "slip_rad" in self.strange.has:
            d -= self.strange.slipped_rad
        return d, slope

    def drive(self, current: Array) -> Array:
        """Return the motor's torque on the joint side [Nm] at the true current."""
        if "dead_band_a" in self.strange.has:
            current = self.strange.dead_band(current)
        if "saturation" in self.has:
            current = current * (1.0 - self.p.saturation * np.abs(current))
        torque: Array = self.per_amp * current
        return torque

    def accelerations(  # noqa: PLR0917
        self,
        v: Array,
        q: Array,
        w: Array,
        link: Array,
        s: Array,
        z: Array,
        d: Array,
        slope: Array | None,
        drive: Array,
    ) -> tuple[Array, Array, Array]:
        """Return dv/dt [2, B], dw/dt [B] and the torques left for links and sensor, tau - load [2, B].

        v = omega_m/G, w = omega_l1 [B], link = theta_l [2, B] in each joint's frame, d and slope of `torsion`.
        """
        p = self.p
        rate = v - SIDE * w
        if slope is not None:
            rate += slope * v
        if "play" in self.has:
            free = np.clip(d, -self.half_play, self.half_play)
            d = d - free
            rate *= (d != 0.0) | (self.half_play == 0.0)
        tau = p.stiffness * d
        tau += p.damping * rate
        if "cubic" in self.has:
            tau += p.cubic * d * d * d
        if "hysteresis" in self.has:
            tau += p.hysteresis * z
        net = drive - tau
        if slope is not None:
            net -= slope * tau
        net -= self.friction(v, link, s, tau)
        if self.strange.extra_nm is not None:
            net -= self.strange.extra_nm
        if self.wave_size is not None:
            waves = self.wave_size * np.cos(self.wave_order * (p.ratio * q) + self.wave_phase)
            net -= waves.sum(axis=0)
        net *= self.inverse_inertia
        if "unbalance" in self.has:
            tau = tau - p.unbalance * np.sin(link + p.unbalance_phase)
        return net, (tau[0] - tau[1]) * self.inverse_links, tau

    def friction(self, v: Array, link: Array, s: Array, tau: Array) -> Array:
        """Return the friction torque [Nm] at bristle state s."""
        p = self.p
        magnitude = self.coulomb
        if "stribeck" in self.has:
            x = v / p.stribeck_velocity
            magnitude = magnitude + p.stribeck * np.exp(-x * x)
        if "load_coefficient" in self.has:
            magnitude = magnitude + p.load_coefficient * np.abs(tau)
        if self.strange.has_friction:
            magnitude = magnitude + self.strange.friction(v, link, tau)
        x = v / _BRISTLE_FADE_RAD_S
        total: Array = magnitude * s + self.viscous * v
        total += self.bristle * (v - np.abs(v) * s) / (1.0 + x * x)
        if "asymmetry" in self.has:
            total += p.asymmetry * np.abs(s)
        return total


def _stacked_waves(p: Plant) -> tuple[Array | None, Array | None, Array | None]:
    """Return order, amplitude, phase [H, 2, B] of the torques that turn with the motor, None where there are none."""
    if not p.waves:
        return None, None, None
    depth: dict[tuple[int, int], int] = {}
    places = []
    for row, run, *wave in p.waves:
        level = depth.get((row, run), 0)
        depth[row, run] = level + 1
        places.append((level, row, run, wave))
    out = np.zeros((3, max(depth.values()), 2, p.count))
    for level, row, run, (size, order, phase) in places:
        out[:, level, row, run] = order, size, phase
    return out[0], out[1], out[2]


SUBSTEPS: Final = 4
_VELOCITY_LOOP_RAD_S: Final = 50.0
_RESET_RAD_S: Final = 12.0
_CURRENT_LIMIT: Final = 2.2  # times rated torque over G Kt


@dataclass(frozen=True)
class Signals:
    """True signals at 1 kHz: [n, 2, B], theta_l1 and the sensor's torque [n, B]."""

    current_a: Array
    motor_rad: Array
    motor_rad_s: Array
    link_rad: Array
    sensor_nm: Array


def integrate(p: Plant, nominal: Plant, motions: list[Motion], strange: Strange) -> Signals:
    """Return the true signals of B benches; `nominal` is what the drives believe (feedforward)."""
    forces = Forces(p, strange)
    n, count = len(motions[0].on), p.count
    out = Signals(*(np.empty((n, 2, count)) for _ in range(3)), *(np.empty((n, count)) for _ in range(2)))
    loop = _Drives(nominal, motions)
    temperature = np.stack([m.temperature_c for m in motions], axis=2)  # [2, n, B]
    ql = np.array([m.start_rad for m in motions])
    q = SIDE * ql
    w = np.zeros(count)
    v, s, z, current = (np.zeros((2, count)) for _ in range(4))
    h = STEP_S / SUBSTEPS
    link = SIDE * ql
    d, slope = forces.torsion(q, link)
    for k in range(n):
        forces.warm(temperature[:, k])
        rise = (loop.command(k, v) - current) * (0.5 / SUBSTEPS)
        for sub in range(SUBSTEPS):
            dv, dw, net = forces.accelerations(v, q, w, link, s, z, d, slope, forces.drive(current))
            if sub == 0:
                strange.at(k, net)
                out.current_a[k] = current
                out.motor_rad[k] = q
                out.motor_rad_s[k] = v
                out.link_rad[k] = ql
                out.sensor_nm[k] = net[0] - p.link_inertia[0] * dw
            current = current + rise
            vm = v + (0.5 * h) * dv
            wm = w + (0.5 * h) * dw
            qm = q + (0.5 * h) * v
            lm = SIDE * (ql + (0.5 * h) * w)
            dm, slope = forces.torsion(qm, lm)
            zm = np.clip(z + (dm - d) / p.travel, -1.0, 1.0) if "hysteresis" in forces.has else z
            sm = _bristle(s, v, 0.5 * h)
            dv, dw, _ = forces.accelerations(vm, qm, wm, lm, sm, zm, dm, slope, forces.drive(current))
            current = current + rise
            s = _bristle(s, vm, h)
            v = v + h * dv
            w = w + h * dw
            q = q + h * vm
            ql = ql + h * wm
            link = SIDE * ql
            before = d
            d, slope = forces.torsion(q, link)
            if "hysteresis" in forces.has:
                z = np.clip(z + (d - before) / p.travel, -1.0, 1.0)
    out.motor_rad[:] *= p.ratio
    out.motor_rad_s[:] *= p.ratio
    return out


def _bristle(s: Array, v: Array, h: float) -> Array:
    """Return the solution of ds/dt = (v - |v| s)/travel after h at constant v."""
    side = np.sign(v)
    bent: Array = side + (s - side) * np.exp(np.abs(v) * (-h / BRISTLE_RAD))
    return bent


class _Drives:
    """Velocity loop of one joint (PI with feedforward), current of the other; zero current while switched off."""

    def __init__(self, nominal: Plant, motions: list[Motion]) -> None:
        self.per_amp = nominal.ratio * nominal.torque_constant
        leads = np.array([m.leader for m in motions])
        self.leads = np.arange(2)[:, None] == leads  # [2, B]
        self.velocity = np.stack([m.velocity_rad_s for m in motions], axis=1)
        self.load = np.stack([m.load_a for m in motions], axis=1)
        self.on = np.stack([m.on for m in motions], axis=1)
        self.acceleration = np.gradient(self.velocity, STEP_S, axis=0)
        pick = np.where(leads == 0, 0, 1)
        runs = np.arange(len(motions))

        def leader(x: Array) -> Array:
            picked: Array = x[pick, runs]
            return picked

        self.leader = leader
        self.inertia = (nominal.rotor * nominal.ratio**2).sum(axis=0)
        self.coulomb = leader(nominal.coulomb)
        self.viscous = leader(nominal.viscous)
        self.gain = leader(nominal.rotor * nominal.ratio**2) * _VELOCITY_LOOP_RAD_S
        self.scale = leader(self.per_amp)
        self.limit = _CURRENT_LIMIT * leader(nominal.rated) / self.scale
        self.integral = np.zeros(len(motions))

    def command(self, k: int, v: Array) -> Array:
        """Return the current set-points [2, B] of cycle k."""
        reference = self.velocity[k]
        error = reference - self.leader(v)
        on = self.on[k]
        self.integral = on * (self.integral + self.gain * _RESET_RAD_S * STEP_S * error)
        torque = self.gain * error + self.integral + self.viscous * reference
        torque += self.inertia * self.acceleration[k] + self.coulomb * np.tanh(reference / 0.02)
        current = on * np.clip(torque / self.scale, -self.limit, self.limit)
        both: Array = np.where(self.leads, current, on * self.load[k])
        return both
