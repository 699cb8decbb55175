"""A foreign arm: seven joints in MuJoCo, each behind a flexible gear with the laws of a bench file; numpy and MuJoCo alone.

Nothing of the estimator, the daemon or the emulated bench is imported. Rigid bodies are those of `panda.urdf`, contact off;
true masses and centres are off the file's, a payload hangs at the tool. Arrays are [B, 7]: run, joint; joint side,
J = Jm G^2 and v = w/G; m motor angle, q link angle; units and sources of the values: `models/plants/typical.yaml`:

    J dv/dt = G (Kt(T) i (1 - s (i/I_r)^2) + cogging(m)) - tau (1 + G E'(m)) - F
    M(q) dw/dt + h(q, w) = tau + sum of J(q)' f of all that pushes                  M, h: MuJoCo
    x = m/G + E(m) - q          tau = spring(x) + D dx/dt + sum H y           dy = dx/travel in -1..1
    dz/dt = v - |v| s0 z / g    F = s0 z + s1 dz/dt + c |v|^n sign(v)         z: bristles, exact within a step
    g = (C (1 + (S - 1) exp(-(|v|/vs)^p)) + L |tau/tau_r|^k) (1 +- d) (1 + sum a cos(k m))

Grease above a housing warms by F v and changes C linearly, c by Vogel's law. A joint of rated torque r is the joint of the
bench file in another size, r over that joint's rated torque: torques, currents, stiffness, damping, inertia and heat flow
are as many times as large, angles and temperatures are the same. Joints 1, 3, ... are of `joint_1`, the others of `joint_2`;
phases of all waves are drawn for each joint.

Velocities first, then angles (semi-implicit Euler) for rotors and links alike, 4 kHz, all runs of a list side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
import yaml

Array = np.ndarray
URDF: Final = Path(__file__).with_name("panda.urdf")
PLANTS: Final = Path(__file__).parents[2] / "models" / "plants"
JOINTS: Final = 7
TOOL: Final = "panda_hand_tcp"
"""Frame of the URDF at which wrench and payload are reported."""
CYCLE_S: Final = 1e-3
SUBSTEPS: Final = 4
STEP_S: Final = CYCLE_S / SUBSTEPS
MASS_OFF, CENTRE_OFF_M = 0.10, 0.005
"""True links are so far off the URDF: mass as a share, sign drawn; centre, direction drawn."""
PAYLOAD_SIDE_M: Final = 0.1
"""A payload is a cube of this side."""
POSITION_GAIN, VELOCITY_GAIN, RESET_S = 20.0, 150.0, 0.03
"""Of the drives: 1/s, rad/s on the rotor alone, s."""
UPDATE: Final = 100
"""Cycles between changes of temperatures."""
VOGEL_C: Final = -95.0


class Payload(NamedTuple):
    """Mass and centre in the tool's frame [3]."""

    mass_kg: float = 0.0
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Contact(NamedTuple):
    """What pushes: a force in the frame of a link (1..7) at a point of it, rising from start to full, falling after end."""

    kind: str
    start_s: float
    full_s: float
    end_s: float
    link: int
    point_m: tuple[float, float, float]
    force_n: tuple[float, float, float]

    def share(self, time_s: float) -> float:
        """Return how much of the full force there is."""
        up = (time_s - self.start_s) / (self.full_s - self.start_s)
        return float(max(0.0, min(up, 1.0, 1.0 + (self.end_s - time_s) / FALL_S)))


FALL_S: Final = 0.05


class Silence(NamedTuple):
    """A joint (0..6) whose jtqd has no torque for a while."""

    joint: int
    start_s: float
    end_s: float


class Run(NamedTuple):
    """What happens on a day: positions to follow [n, 7] at 1 kHz, who pushes, what hangs at the tool, who is silent."""

    day: int
    reference_rad: Array
    payload: Payload = Payload()
    contacts: tuple[Contact, ...] = ()
    silences: tuple[Silence, ...] = ()

    def silent(self, n: int, after_s: float = 0.0) -> Array:
        """Return which joints have no torque, or had none up to after_s ago [n, 7]."""
        t, found = CYCLE_S * np.arange(n), np.zeros((n, JOINTS), bool)
        for each in self.silences:
            found[:, each.joint] |= (t >= each.start_s) & (t < each.end_s + after_s)
        return found


class Truth(NamedTuple):
    """What only the plant knows, [n, 7], wrench [n, 6]: force and torque about the tool's origin, base axes."""

    link_rad: Array
    link_rad_s: Array
    drive_nm: Array
    external_nm: Array
    wrench: Array
    motor_rad: Array
    current_a: Array
    celsius: Array


class Readings(NamedTuple):
    """What the instruments of an arm give every cycle, [n, 7], and what a jtqd of each joint publishes of it.

    torque_nm: drive-side torque, NaN where there is none; sigma_nm, half the width of an interval at STANDSTILL; status.
    """

    time_s: Array
    current_a: Array
    motor_rad: Array
    motor_rad_s: Array
    link_rad: Array
    temperature_c: Array
    torque_nm: Array
    sigma_nm: Array
    status: Array


NO_TORQUE, VALID, DEGRADED, STANDSTILL = range(4)


def rigid(factors: Array | None = None, shifts_m: Array | None = None, payload: Payload | None = None) -> Any:
    """Return MuJoCo's model of the URDF, masses [links] times factors, centres [links, 3] shifted; site `tool`."""
    spec = mujoco.MjSpec.from_string(_urdf())
    tool = spec.body(TOOL)
    tool.add_site(name="tool")
    for k, name in enumerate(links()):
        body = spec.body(name)
        if factors is not None:
            body.mass *= factors[k]
            body.fullinertia = np.asarray(body.fullinertia) * factors[k]
        if shifts_m is not None:
            body.ipos = np.asarray(body.ipos) + shifts_m[k]
    if payload is not None and payload.mass_kg > 0.0:
        inertia = np.full(3, payload.mass_kg * PAYLOAD_SIDE_M**2 / 6.0)
        tool.add_body(
            name="payload",
            mass=payload.mass_kg,
            ipos=payload.centre_m,
            inertia=inertia,
            explicitinertial=True,
        )
    model = spec.compile()
    model.opt.timestep = STEP_S
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT
    return model


@cache
def _urdf() -> str:
    return URDF.read_text(encoding="utf-8")


@cache
def links() -> tuple[str, ...]:
    """Return the names of the moving links that have a mass."""
    spec = mujoco.MjSpec.from_string(_urdf())
    return tuple(b.name for b in spec.bodies if b.name not in ("world", "panda_link0") and b.mass > 0.0)


@cache
def limits() -> dict[str, Array]:
    """Return of the URDF [7]: rated_nm, low_rad, high_rad, rad_s."""
    import xml.etree.ElementTree as ET

    found = [j.find("limit") for j in ET.fromstring(_urdf()).iter("joint") if j.get("type") == "revolute"]
    keys = {"rated_nm": "effort", "low_rad": "lower", "high_rad": "upper", "rad_s": "velocity"}
    return {
        name: np.array([float(each.attrib[key]) for each in found if each is not None])
        for name, key in keys.items()
    }


class Waves:
    """Sums of amplitude cos(order angle + phase) [7] of one angle: coefficients [sums, orders, 7], derivatives on demand."""

    def __init__(self, sums: Sequence[Sequence[Mapping[int, complex]]]) -> None:
        self.orders = np.array(sorted({order for each in sums for joint in each for order in joint}))
        self.weights = np.zeros((len(sums), len(self.orders), JOINTS), complex)
        for s, each in enumerate(sums):
            for j, joint in enumerate(each):
                for order, value in joint.items():
                    self.weights[s, np.searchsorted(self.orders, order), j] += value

    def with_slope(self, of: int) -> None:
        """Add the derivative of a sum by the angle."""
        slope = 1j * self.orders[:, None] * self.weights[of]
        self.weights = np.concatenate((self.weights, slope[None]))

    def at(self, angle: Array) -> Array:
        """Return the sums at angles [..., 7]: [sums, ..., 7]."""
        turned = np.exp(1j * self.orders.reshape(-1, *[1] * angle.ndim) * angle)
        found: Array = np.einsum("ok...j,k...j->o...j", self._shaped(angle.ndim), turned).real
        return found

    def _shaped(self, ndim: int) -> Array:
        return self.weights.reshape(*self.weights.shape[:2], *[1] * (ndim - 1), JOINTS)


class Arm:
    """One arm of a plant (`typical`, `bad_day`): its parts, drawn from a seed; laws hold arrays [7]."""

    def __init__(self, plant: str, seed: int) -> None:
        rng = np.random.default_rng([seed, 38])
        self.seed = seed
        file = yaml.safe_load((PLANTS / f"{plant}.yaml").read_text(encoding="utf-8"))
        sides = [file[f"joint_{1 + j % 2}"] for j in range(JOINTS)]
        nominal = [yaml.safe_load((PLANTS / side["joint"]).read_text(encoding="utf-8")) for side in sides]
        self.rated_nm = limits()["rated_nm"]
        self.size = self.rated_nm / np.array([each["rated_torque_nm"] for each in nominal])
        self.ratio = np.array([float(each["gear_ratio"]) for each in nominal])
        self.nominal = {
            "torque_constant_nm_per_a": np.array([each["torque_constant_nm_per_a"] for each in nominal]),
            "rotor_kgm2": self.size
            * np.array([each["rotor_inertia_kgm2"] for each in nominal])
            * self.ratio**2,
        }
        """What a user believes [7]; rotor at the joint."""
        self.law = {
            section: {key: _column([side[section][key] for side in sides]) for key in sides[0][section]}
            for section in ("motor", "friction", "gear", "warmth", "measurement", "drive")
        }
        self.link_kgm2 = np.full(
            JOINTS, sum(file[side]["link_inertia_kgm2"] for side in ("joint_1", "joint_2"))
        )
        self.days = {key: float(value) for key, value in file["run_to_run"].items()}
        turn = rng.uniform(0.0, 2.0 * np.pi, (6, JOINTS))

        def drawn(section: str, key: str, size: str, k: int) -> list[dict[int, complex]]:
            return [
                {
                    int(w["order"]): w[size] * np.exp(1j * (w["phase_rad"] + turn[k, j]))
                    for w in side[section][key]
                }
                for j, side in enumerate(sides)
            ]

        self.of_motor = Waves(
            [
                drawn("gear", "errors", "amplitude_rad", 0),
                drawn("friction", "angle", "share", 1),
                drawn("motor", "cogging", "amplitude_nm", 2),
            ]
        )
        self.of_motor.with_slope(0)
        self.read_of_motor = Waves(
            [
                drawn("measurement", "motor_errors", "amplitude_rad", 3),
                drawn("measurement", "current_ripple", "amplitude_a", 4),
            ]
        )
        self.read_of_link = Waves([drawn("measurement", "link_errors", "amplitude_rad", 5)])
        self.factors = 1.0 + MASS_OFF * rng.choice([-1.0, 1.0], len(links()))
        way = rng.normal(size=(len(links()), 3))
        self.shifts_m = CENTRE_OFF_M * way / np.linalg.norm(way, axis=1, keepdims=True)

    def model(self, payload: Payload) -> Any:
        """Return the true rigid bodies with a payload."""
        return rigid(self.factors, self.shifts_m, payload)

    def day(self, number: int) -> dict[str, Array]:
        """Return by name what a day brings [7], uniform within the half widths of the bench file."""
        rng = np.random.default_rng([self.seed, number, 39])
        return {key: width * rng.uniform(-1.0, 1.0, JOINTS) for key, width in self.days.items()}

    def record(self, runs: Sequence[Run]) -> list[Truth]:
        """Return what happens in runs of one length."""
        return _integrated(self, runs, _Bodies(self, runs))

    def tow(self, runs: Sequence[Run], load_nm: Array) -> list[Truth]:
        """Return the same with every joint alone on a towing bench against load_nm [B, n, 7]; no weight, no contacts."""
        return _integrated(self, runs, _Benches(self, runs, load_nm))


def _column(values: Sequence[Any]) -> Any:
    """Return numbers as [7], lists of numbers as [k, 7], slips as (torque [k, 7], travel [k, 7]); waves are left out."""
    if not isinstance(values[0], list):
        return np.array(values, np.float64)
    if values[0] and isinstance(values[0][0], Mapping):
        keys = list(values[0][0])
        return (
            tuple(np.array([[w[key] for w in each] for each in values]).T for key in keys)
            if len(keys) == 2
            else None
        )
    return np.array(values, np.float64).T


class Trains:
    """Rotors, gears and friction of all joints of all runs [B, 7]; `day`: by name [B, 7]."""

    def __init__(self, arm: Arm, day: Mapping[str, Array]) -> None:
        motor, friction, gear = (arm.law[name] for name in ("motor", "friction", "gear"))
        self.arm, self.ratio, self.size, self.rated = arm, arm.ratio, arm.size, arm.rated_nm
        self.inertia = arm.size * motor["rotor_inertia_kgm2"] * arm.ratio**2
        self.constant, self.constant_per_k = motor["torque_constant_nm_per_a"], motor["torque_constant_per_k"]
        self.saturation = motor["saturation_share"] / (arm.size * arm.law["drive"]["rated_current_a"]) ** 2
        self.friction = friction
        self.coulomb_nm = arm.size * friction["coulomb_nm"]
        self.bristle = self.coulomb_nm / friction["bristle_rad"]
        self.bristle_damping = 2.0 * friction["bristle_damping_ratio"] * np.sqrt(self.bristle * self.inertia)
        self.stiffness = arm.size * gear["stiffness_nm_per_rad"]
        level = arm.size * gear["corners_nm"]
        first = level[0] / self.stiffness[0]
        self.corners = np.array([first, first + (level[1] - level[0]) / self.stiffness[1]])
        self.bends = np.diff(self.stiffness, axis=0)
        self.damping = arm.size * gear["damping_nms_per_rad"]
        self.slip_nm, self.travel = arm.size * gear["slips"][0][:, None], gear["slips"][1][:, None]
        self.day = day
        self.bent = np.zeros_like(day["coulomb"])
        self.rubbing = np.zeros_like(self.bent)
        self.grease = self.housing = arm.law["warmth"]["ambient_c"] + day["temperature_k"]
        self.room = self.housing
        self.heat_j = np.zeros_like(self.bent)
        self._warmed()

    def start(self, link: Array, torque: Array) -> Array:
        """Stand with these torques [B, 7] in the springs, slips relaxed; return the motors' angles."""
        self.torsion = torque / self.stiffness[0]
        for _ in range(50):
            self.torsion += (torque - self._spring(self.torsion)) / self.stiffness[-1]
        self.stops = np.zeros((len(self.slip_nm), *link.shape))
        self.velocity = np.zeros_like(link)
        self.motor = self.ratio * (link + self.torsion)
        for _ in range(5):
            self.motor = self.ratio * (link + self.torsion - self.arm.of_motor.at(self.motor)[0])
        self._waves()
        return np.asarray(self.motor)

    def _waves(self) -> None:
        self.error, self.rub, self.cogging, self.slope = self.arm.of_motor.at(self.motor)

    def _spring(self, x: Array) -> Array:
        size = np.abs(x)
        total = self.stiffness[0] * size
        for corner, bend in zip(self.corners, self.bends, strict=True):
            total = total + bend * np.maximum(size - corner, 0.0)
        return np.asarray(np.copysign(total, x))

    def torque(self, link_rad_s: Array) -> Array:
        """Return tau [B, 7] now."""
        rate = self.velocity * (1.0 + self.ratio * self.slope) - link_rad_s
        held: Array = (self.slip_nm * self.stops).sum(axis=0)
        return np.asarray(self._spring(self.torsion) + self.damping * rate + held)

    def push(self, h: float, current: Array, tau: Array) -> None:
        """Advance the rotors' velocities by h seconds."""
        p, v = self.friction, self.velocity
        speed = np.abs(v)
        level = self.coulomb * (
            1.0
            + (p["static_ratio"] - 1.0)
            * np.exp(-((speed / p["stribeck_velocity_rad_s"]) ** p["stribeck_exponent"]))
        )
        level += self.size * p["load_nm"] * (np.abs(tau) / self.rated) ** p["load_exponent"]
        level *= (1.0 + np.where(v < 0.0, -1.0, 1.0) * p["direction_share"]) * (1.0 + self.rub)
        level = np.maximum(level, 1e-3 * self.coulomb_nm)
        decay = np.exp(self.bristle * speed * (-h) / level)
        # at rest the level has no part: dz = v dt
        slid = np.where(speed > 1e-9, np.sign(v) * level / self.bristle * (1.0 - decay), v * h)
        after = self.bent * decay + slid
        self.rubbing = (
            0.5 * self.bristle * (self.bent + after) + self.bristle_damping * (after - self.bent) / h
        )
        self.rubbing += np.sign(v) * self.viscous * speed ** p["viscous_exponent"]
        self.bent = after
        driving = self.full * current * (1.0 - self.saturation * current * current)
        driving = self.ratio * (driving + self.size * self.cogging)
        self.velocity = v + h / self.inertia * (
            driving - tau * (1.0 + self.ratio * self.slope) - self.rubbing
        )
        self.heat_j += np.abs(self.rubbing * self.velocity) * h

    def turn(self, h: float, link: Array) -> None:
        """Advance the motors' angles by h seconds, to these link angles."""
        self.motor = self.motor + h * self.ratio * self.velocity
        self._waves()
        torsion = self.motor / self.ratio + self.error - link
        self.stops = np.clip(self.stops + (torsion - self.torsion) / self.travel, -1.0, 1.0)
        self.torsion = torsion

    def warm(self, dt_s: float) -> None:
        """Take up the heat of dt_s seconds."""
        p = self.arm.law["warmth"]
        power = self.heat_j / (dt_s * self.size)
        self.heat_j = np.zeros_like(power)
        grease = self.housing + p["grease_kelvin_per_w"] * power
        housing = self.room + p["housing_kelvin_per_w"] * power
        self.grease = grease + (self.grease - grease) * np.exp(-dt_s / p["grease_time_constant_s"])
        self.housing = housing + (self.housing - housing) * np.exp(-dt_s / p["housing_time_constant_s"])
        self._warmed()

    def _warmed(self) -> None:
        p, reference = self.arm.law["warmth"], self.arm.law["warmth"]["reference_c"]
        vogel = p["viscous_per_k"] * (reference - VOGEL_C) ** 2
        thin = np.exp(vogel / (self.grease - VOGEL_C) - vogel / (reference - VOGEL_C))
        self.viscous = self.size * self.friction["viscous_nm"] * (1.0 + self.day["viscous"]) * thin
        cold = np.maximum(1.0 - p["coulomb_per_k"] * (self.grease - reference), 0.2)
        self.coulomb = self.coulomb_nm * (1.0 + self.day["coulomb"]) * cold
        self.full = self.constant * (1.0 - self.constant_per_k * (self.housing - reference))


class _Controllers:
    """Position loops of all joints at 1 kHz, velocity and current loops at every step; motor side feedback."""

    def __init__(self, arm: Arm, reference: Array, torque: Array) -> None:
        p = arm.law["drive"]
        self.per_nm = 1.0 / (arm.ratio * arm.nominal["torque_constant_nm_per_a"])
        self.inertia, self.limit = arm.nominal["rotor_kgm2"], arm.size * p["current_limit_a"]
        self.share = 1.0 - np.exp(-2.0 * np.pi * p["current_bandwidth_hz"] * STEP_S)
        self.ratio, self.reference = arm.ratio, reference
        self.integral = torque
        self.current = torque * self.per_nm

    def plan(self, cycle: int, motor: Array) -> None:
        now = self.reference[:, cycle]
        after = self.reference[:, min(cycle + 1, self.reference.shape[1] - 1)]
        self.wanted = (after - now) / CYCLE_S + POSITION_GAIN * (now - motor / self.ratio)

    def step(self, h: float, velocity: Array) -> Array:
        error = self.wanted - velocity
        asked = VELOCITY_GAIN * self.inertia * error + self.integral
        amps = np.clip(asked * self.per_nm, -self.limit, self.limit)
        self.integral = self.integral + (h / RESET_S * VELOCITY_GAIN) * self.inertia * error * (
            np.abs(asked * self.per_nm) < self.limit
        )
        self.current = self.current + self.share * (amps - self.current)
        return np.asarray(self.current)


class _Links:
    """Links of runs side by side, [B, 7]: link, rate, external torque; weight at the start; wrench [B, 6]."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self.link = np.stack([run.reference_rad[0] for run in runs])
        self.rate, self.external, self.weight = (np.zeros_like(self.link) for _ in range(3))
        self.wrench = np.zeros((len(runs), 6))

    def feel(self, time_s: float) -> None:
        """Set what pushes from outside now."""
        raise NotImplementedError

    def advance(self, tau: Array) -> None:
        """Go on by a step with these torques of the gears."""
        raise NotImplementedError


class _Bodies(_Links):
    """The arm's links in MuJoCo."""

    def __init__(self, arm: Arm, runs: Sequence[Run]) -> None:
        super().__init__(runs)
        self.models = [arm.model(run.payload) for run in runs]
        self.data = [mujoco.MjData(model) for model in self.models]
        for b, (model, data) in enumerate(zip(self.models, self.data, strict=True)):
            data.qpos[:] = self.link[b]
            mujoco.mj_forward(model, data)
            self.weight[b] = data.qfrc_bias
        self.pushers = [_Pusher(*each) for each in zip(self.models, self.data, runs, strict=True)]
        self.handles = [(d.qpos, d.qvel, d.qfrc_applied) for d in self.data]

    def feel(self, time_s: float) -> None:
        for b, pusher in enumerate(self.pushers):
            if pusher.active(time_s):
                self.external[b], self.wrench[b] = pusher.joints(time_s), pusher.wrench()
            elif pusher.left:
                self.external[b], self.wrench[b], pusher.left = 0.0, 0.0, False

    def advance(self, tau: Array) -> None:
        total, step = tau + self.external, mujoco.mj_step
        for b, (q, w, f) in enumerate(self.handles):
            f[:] = total[b]
            step(self.models[b], self.data[b])
            self.link[b], self.rate[b] = q, w


class _Benches(_Links):
    """Every joint alone on a towing bench, against load_nm [B, n, 7], with the inertia of the bench file's two links."""

    def __init__(self, arm: Arm, runs: Sequence[Run], load_nm: Array) -> None:
        super().__init__(runs)
        self.load, self.mobility = load_nm, STEP_S / (arm.size * arm.link_kgm2)

    def feel(self, time_s: float) -> None:
        self.external = -self.load[:, int(time_s / CYCLE_S + 1e-6)]

    def advance(self, tau: Array) -> None:
        self.rate = self.rate + self.mobility * (tau + self.external)
        self.link = self.link + STEP_S * self.rate


def _integrated(arm: Arm, runs: Sequence[Run], links: _Links) -> list[Truth]:
    reference = np.stack([run.reference_rad for run in runs])
    count, n = reference.shape[:2]
    drawn = [arm.day(run.day) for run in runs]
    trains = Trains(arm, {key: np.stack([day[key] for day in drawn]) for key in drawn[0]})
    trains.start(links.link, links.weight)
    loops = _Controllers(arm, reference, links.weight)
    kept = Truth(*(np.empty((count, n, 6 if key == "wrench" else JOINTS)) for key in Truth._fields))
    for k in range(n):
        if k and k % UPDATE == 0:
            trains.warm(UPDATE * CYCLE_S)
        loops.plan(k, trains.motor)
        for s in range(SUBSTEPS):
            tau = trains.torque(links.rate)
            links.feel(k * CYCLE_S + s * STEP_S)
            if s == 0:
                now = (links.link, links.rate, tau, links.external, links.wrench)
                for to, value in zip(kept, (*now, trains.motor, loops.current, trains.housing), strict=True):
                    to[:, k] = value
            trains.push(STEP_S, loops.step(STEP_S, trains.velocity), tau)
            links.advance(tau)
            trains.turn(STEP_S, links.link)
    return [Truth(*(each[b] for each in kept)) for b in range(count)]


class _Pusher:
    """What pushes one arm now."""

    def __init__(self, model: Any, data: Any, run: Run) -> None:
        self.model, self.data, self.waiting = model, data, sorted(run.contacts, key=lambda c: c.start_s)
        self.jacobian = np.zeros((3, JOINTS))
        self.left = False
        self.tool = model.site("tool").id

    def active(self, time_s: float) -> bool:
        while self.waiting and time_s >= self.waiting[0].end_s + FALL_S:
            self.waiting.pop(0)
        return bool(self.waiting) and time_s > self.waiting[0].start_s

    def joints(self, time_s: float) -> Array:
        """Return the torque on the joints [7]."""
        contact, data = self.waiting[0], self.data
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        body = contact.link
        turn = data.xmat[body].reshape(3, 3)
        self.point = data.xpos[body] + turn @ np.array(contact.point_m)
        self.force = contact.share(time_s) * (turn @ np.array(contact.force_n))
        mujoco.mj_jac(self.model, data, self.jacobian, None, self.point, body)
        self.left, self.link = True, contact.link
        return np.asarray(self.jacobian.T @ self.force)

    def wrench(self) -> Array:
        """Return what the tool bears [6]; zero where another link is pushed."""
        if self.link != JOINTS:
            return np.zeros(6)
        return np.concatenate((self.force, np.cross(self.point - self.data.site_xpos[self.tool], self.force)))


Joints = Callable[[Arm, Run, Truth, np.random.Generator], tuple[Array, Array, Array]]
"""What a jtqd of each joint would publish of a run: torque, sigma, status, each [n, 7]."""


def no_joints(arm: Arm, run: Run, truth: Truth, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return the joints of an arm without any jtqd."""
    nothing = np.full(truth.drive_nm.shape, np.nan)
    return nothing, nothing, np.full(nothing.shape, NO_TORQUE, np.int8)


def read(arm: Arm, run: Run, truth: Truth, joints: Joints) -> Readings:
    """Return what the instruments read of a run."""
    rng = np.random.default_rng([arm.seed, run.day, 40])
    p, day, size = arm.law["measurement"], arm.day(run.day), arm.size
    n = len(truth.link_rad)
    motor_error, ripple = arm.read_of_motor.at(truth.motor_rad)
    motor = truth.motor_rad + motor_error + day["motor_zero_rad"]
    link = truth.link_rad + arm.read_of_link.at(truth.link_rad)[0] + day["link_zero_rad"]
    link += p["link_noise_rad"] * rng.normal(size=(n, JOINTS))
    amps = (1.0 + day["current_gain"]) * (truth.current_a + size * ripple)
    amps += size * (day["current_zero_a"] + p["current_noise_a"] * rng.normal(size=(n, JOINTS)))
    motor = _counted(motor, 2.0 * np.pi / p["motor_counts_per_rev"])
    share = 1.0 - np.exp(-CYCLE_S / p["velocity_filter_s"][0])
    speed = np.diff(motor, axis=0, prepend=motor[:1]) / CYCLE_S
    for k in range(1, n):
        speed[k] = speed[k - 1] + share * (speed[k] - speed[k - 1])
    torque, sigma, status = joints(arm, run, truth, rng)
    silent = run.silent(n)
    return Readings(
        CYCLE_S * np.arange(n),
        _counted(amps, size * arm.law["drive"]["rated_current_a"] / 1000.0),
        motor,
        speed,
        _counted(link, 2.0 * np.pi / p["link_counts_per_rev"]),
        _counted(truth.celsius, 0.1),
        np.where(silent, np.nan, torque),
        np.where(silent, np.nan, sigma),
        np.where(silent, NO_TORQUE, status),
    )


def _counted(x: Array, unit: Any) -> Array:
    return np.asarray(np.round(x / unit) * unit)
