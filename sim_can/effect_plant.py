"""Plant of joints whose files have effects: the equations of `jtqd.sim_can.plant` with the effects in them.

Per joint, with the sums of the hooks of `jtqd.estimator.effects.effect` (b: twist by position alone, u: other twist):

    δ = θm/G + e(θm) + b(θm) - θl         τ = K (δ + u) + D dδ/dt + H z
    Jm dwm/dt = Kt i - τ (1/G + e') - (A cos(n θm + φ) + loss_nm + friction) / G
    (Jl1 + Jl2) dwl1/dt = (τ1 - load1) - (τ2 - load2)      sensor = τ1 - load1 - Jl1 dwl1/dt

A kinematic error brings its virtual work τ b' along as its loss. Dissipative losses are part of the implicit
friction, so a joint sticks with them as without. A class of its own, because evaluating hooks costs time that a plant
without effects must not pay; with effects of size zero both give the same numbers bit by bit. Pure.

`JointEffects` has the effects of one joint by place of action: losses on the motor side (those that are friction in the
implicit friction), twist on the spring, loads between gear and sensor. A twist by the positions of gear and link alone (a
kinematic error) bends the gear; any other twist is a property of the spring and sees the torsion of the bent gear, so that
no pair of effects makes energy. `Readings` are the errors of the instruments.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from jtqd.estimator.effects.effect import Effect, Functions, ScalarFunctions, State, Values
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.sim_can.plant import JointFriction, Plant, relaxed_angle
from jtqd.sim_can.plant_file import (
    PROBE_TORSION_RAD,
    PROBES,
    STEEPEST_KINEMATIC_ERROR,
    JointConstants,
    PlantParameters,
    effects_of,
    probe_state,
    substep_limit,
)

Hook = tuple[Callable[..., Any], Values, Functions]


def total(hooks: list[Hook], state: State, joint: Joint) -> float:
    """Return the sum of the hooks at this state."""
    value = 0.0
    for call, values, functions in hooks:
        value += call(values, state, joint, functions)
    return value


class JointEffects:
    """Effects of one joint: its hooks by place of action, and the state at which they are evaluated.

    joint: parameters for the hooks: the file's friction, the true stiffness and torque constant.

    Raises:
        ConfigError: a hook that is not finite, or needs what the inner loop does not know.
    """

    def __init__(self, joint: Joint) -> None:
        self.joint = joint
        self.state = probe_state(0.0)
        self.friction: list[Hook] = []  # losses that oppose the velocity
        self.loss: list[Hook] = []  # other losses
        self.bend: list[Hook] = []  # twist by position alone
        self.spring: list[Hook] = []  # twist by torsion
        self.load: list[Hook] = []
        for effect, values in effects_of(joint):
            if effect.changes_joint:
                continue
            for name in ("loss_nm", "twist_rad", "load_nm"):
                if name in effect.hooks:
                    call = getattr(effect, name)
                    self._check(effect.name, call, values)
                    self._place(effect, name, call, values).append((call, values, ScalarFunctions()))

    def _place(self, effect: Effect, name: str, call: Callable[..., Any], values: Values) -> list[Hook]:
        if name == "load_nm":
            return self.load
        if name == "loss_nm":
            return self.friction if effect.dissipative else self.loss
        by_place = set()
        for place in PROBES:
            functions = (
                ScalarFunctions()
            )  # the same for both: a hysteresis starts where it is evaluated first
            slack = call(values, probe_state(place), self.joint, functions)
            if call(values, probe_state(place, PROBE_TORSION_RAD), self.joint, functions) != slack:
                return self.spring
            by_place.add(slack)
        return self.bend if len(by_place) > 1 else self.spring

    def _check(self, name: str, call: Callable[..., Any], values: Values) -> None:
        for place in PROBES:
            value = call(values, probe_state(place, PROBE_TORSION_RAD), self.joint, ScalarFunctions())
            if not math.isfinite(value):
                where = f"joint {self.joint.name}: effect {name}"
                raise ConfigError(
                    f"{where}: {call.__name__} is {value!r}, expected a finite number: "
                    "its parameters, or it needs a quantity that the plant's inner loop does not have"
                )

    def bend_rad(self, motor_rad: float, link_rad: float = 0.0) -> float:
        """Return the twist by position alone at this motor angle, rad."""
        self.state.motor_position_rad = motor_rad
        self.state.link_position_rad = link_rad
        return total(self.bend, self.state, self.joint)

    def steepest_bend(self) -> float:
        """Return the largest |d bend/dθm| over two motor turns, times G: part of the gear's own transmission."""
        if not self.bend:
            return 0.0
        e = 1.0e-5
        angles = (4.0 * math.pi * k / 1440.0 for k in range(1440))
        slopes = (abs(self.bend_rad(angle + e) - self.bend_rad(angle - e)) for angle in angles)
        return self.joint.gear_ratio * max(slopes) / (2.0 * e)

    def stiffest_spring(self) -> float:
        """Return the largest slope of the spring's torque over torsion against the stiffness alone, at least 1.

        Over torsions up to three times the rated torque, loaded once from rest.

        Raises:
            ConfigError: the torque falls with torsion before it has reached the rated torque: the joint would run away.
        """
        if not self.spring:
            return 1.0
        fresh: list[Hook] = [(call, values, ScalarFunctions()) for call, values, _ in self.spring]
        rated = self.joint.rated_torque_nm / self.joint.stiffness_nm_per_rad
        grid = [0.0] + [3.0 * rated * 10.0 ** (-(400 - k) / 64.0) for k in range(401)]
        largest, before, at = 1.0, 0.0, 0.0
        for torsion in grid:
            if before > 3.0 * rated:
                break
            whole = torsion + total(fresh, probe_state(0.0, torsion), self.joint)
            if whole < before < rated:
                raise ConfigError(
                    f"joint {self.joint.name}: effects: the torque falls with torsion from {at:.2g} rad on, "
                    f"expected it to rise up to rated_torque_nm ({self.joint.rated_torque_nm:g} Nm)"
                )
            if torsion > 0.0:
                largest = max(largest, (whole - before) / (torsion - at))
            before, at = whole, torsion
        return largest


class EffectFriction:
    """Friction of a joint with effects: that of its file and its dissipative effects, never below zero.

    Called like `JointFriction`; the effects see the direction that the joint would move in.
    """

    def __init__(self, file: JointFriction, effects: JointEffects) -> None:
        self._file = file
        self._effects = effects
        self._hooks = effects.friction

    def __call__(self, torque_nm: float, velocity_rad_s: float) -> float:
        """Return the magnitude in Nm at transmitted torque and joint velocity (v = 0 counts as forward)."""
        state = self._effects.state
        state.torque_nm = torque_nm
        state.velocity_rad_s = velocity_rad_s
        state.direction = direction = -1.0 if velocity_rad_s < 0.0 else 1.0
        lost = total(self._hooks, state, self._effects.joint)
        force = self._file(torque_nm, velocity_rad_s) + direction * lost
        return force if force > 0.0 else 0.0


# The plant


class _Side:
    """One joint in the inner loop, in its own frame: motor state, torsion, hysteresis of the plant file."""

    def __init__(self, constants: JointConstants, effects: JointEffects, sign: float) -> None:
        self.constants = constants
        self.sign = sign  # of joint 1's link position in this joint's frame
        self.effects = effects
        self.angle = self.velocity = self.slip = 0.0  # motor side; z
        self.link = self.torsion = 0.0  # θl, δ
        self.slope = 1.0  # dδ/dθm of the plant file's kinematic error in units of 1/G
        self.bend = self.bend_rate = 0.0
        self.load = 0.0  # Nm taken between gear and sensor

    def place(self, angle: float, velocity: float, slip: float, link: float, h: float) -> None:
        """Set the state; the bend's rate is that of the last step of h seconds."""
        self.angle, self.velocity, self.slip, self.link = angle, velocity, slip, link
        if self.effects.bend:
            before = self.effects.bend_rad(angle - h * velocity, link)
            self.bend = self.effects.bend_rad(angle, link)
            self.bend_rate = (self.bend - before) / h
        self.torsion = self._torsion()

    def _torsion(self) -> float:
        c = self.constants
        x = self.angle * (1.0 / c.gear_ratio)
        if c.error_rad:
            x += c.error_rad * math.sin(c.error_order * self.angle + c.error_phase)
        if self.effects.bend:
            x += self.bend
        return x - self.link

    def torque(self, link_velocity: float) -> float:
        """Return τ at the present state; sets the hooks' state and `load`."""
        c, effects = self.constants, self.effects
        state = effects.state
        joint_velocity = self.velocity * (1.0 / c.gear_ratio)
        if c.error_rad:
            self.slope = 1.0 + c.error_slope * math.cos(c.error_order * self.angle + c.error_phase)
        rate = joint_velocity * self.slope - link_velocity
        if effects.bend:
            rate += self.bend_rate
        state.velocity_rad_s = joint_velocity
        state.direction = 1.0 if joint_velocity > 0.0 else -1.0 if joint_velocity < 0.0 else 0.0
        state.motor_position_rad = self.angle
        state.link_position_rad = self.link
        state.coupling_position_rad = self.sign * self.link
        state.link_velocity_rad_s = link_velocity
        state.torsion_rad = torsion = self.torsion
        if effects.spring:
            torsion += total(effects.spring, state, effects.joint)
        torque = c.stiffness * torsion + c.damping * rate
        if c.slip_nm:
            torque += c.slip_nm * self.slip
        state.torque_nm = torque
        if effects.load:
            self.load = total(effects.load, state, effects.joint)
        return torque

    def push(self, current_a: float, torque_nm: float, h: float) -> float:
        """Return the motor velocity after h seconds without friction, from the state that `torque` set."""
        c, effects = self.constants, self.effects
        angle = self.angle
        load = torque_nm * self.slope + c.ripple_nm * math.cos(c.ripple_order * angle + c.ripple_phase)
        if effects.loss:
            effects.state.current_a = current_a
            load += total(effects.loss, effects.state, effects.joint)
        per_motor = h / c.rotor_inertia
        return self.velocity + (
            per_motor * c.torque_constant * current_a - per_motor * (1.0 / c.gear_ratio) * load
        )

    def turn(self, velocity: float, link: float, h: float) -> None:
        """Advance by h seconds at this motor velocity, to this link position."""
        effects, c = self.effects, self.constants
        effects.state.motor_acceleration_rad_s2 = (velocity - self.velocity) / h
        self.velocity = velocity
        self.angle += h * velocity
        self.link = link
        if effects.bend:
            bend = effects.bend_rad(self.angle, link)
            self.bend_rate = (bend - self.bend) / h
            self.bend = bend
        torsion = self._torsion()
        if c.slip_nm:
            z = self.slip + c.per_travel * (torsion - self.torsion)
            self.slip = 1.0 if z > 1.0 else -1.0 if z < -1.0 else z
        self.torsion = torsion


class EffectPlant(Plant):
    """`Plant` with the effects of its joint files; `time_s` counts from the last `begin_run`.

    Raises:
        ConfigError: effects of wrong parameters, or with which no joint could work.
    """

    def __init__(self, parameters: PlantParameters) -> None:
        super().__init__(parameters)
        one, two = (JointEffects(side.true_joint) for side in parameters.joints)
        self.effects = (one, two)
        bends = (one.steepest_bend(), two.steepest_bend())
        for side, bend in zip(parameters.joints, bends, strict=True):
            steepest = bend + side.constants.error_slope
            if steepest > STEEPEST_KINEMATIC_ERROR:
                where = f"joint {side.joint.name}: effects"
                raise ConfigError(
                    f"{where}: the kinematic error changes the gear's transmission by {steepest:.2g} of itself, "
                    f"expected at most {STEEPEST_KINEMATIC_ERROR:g}"
                )
        self.substep_s = substep_limit(parameters, (one.stiffest_spring(), two.stiffest_spring()), bends)
        files = self.friction
        self._link_inertia = tuple(side.true_joint.link_inertia_kgm2 for side in parameters.joints)
        self._sides = (
            _Side(parameters.joints[0].constants, one, 1.0),
            _Side(parameters.joints[1].constants, two, -1.0),
        )
        self._frictions = tuple(
            EffectFriction(file, effects) if effects.friction else file
            for file, effects in zip(files, self.effects, strict=True)
        )
        self.motor_position = [
            relaxed_angle(side.constants, side.effects.bend_rad if side.effects.bend else None)
            for side in self._sides
        ]
        self.time_s = 0.0

    def begin_run(self) -> None:
        """Start the time that effects may depend on."""
        self.time_s = 0.0

    def _integrate(self, steps: int, h: float) -> None:
        one, two = self._sides
        self._place(h)
        control1, control2 = self.drives[0].step, self.drives[1].step
        friction1, friction2 = self._frictions
        g1, g2 = 1.0 / one.constants.gear_ratio, 1.0 / two.constants.gear_ratio
        h1, h2 = h / one.constants.rotor_inertia, h / two.constants.rotor_inertia
        f1, f2 = h1 * g1, h2 * g2
        hl = h / sum(self._link_inertia)
        thl, wl = self.link_position, self.link_velocity
        stop1 = stop2 = 0.0
        for _ in range(steps):
            i1 = control1(h, one.velocity)
            i2 = control2(h, two.velocity)
            t1 = one.torque(wl)
            t2 = two.torque(-wl)
            w1 = one.push(i1, t1, h)
            stop1 = f1 * friction1(t1, w1 * g1)
            w1 = w1 - stop1 if w1 > stop1 else w1 + stop1 if w1 < -stop1 else 0.0
            w2 = two.push(i2, t2, h)
            stop2 = f2 * friction2(t2, w2 * g2)
            w2 = w2 - stop2 if w2 > stop2 else w2 + stop2 if w2 < -stop2 else 0.0
            change = hl * ((t1 - one.load) - (t2 - two.load))
            wl += change
            thl += h * wl
            one.effects.state.link_acceleration_rad_s2 = change / h
            two.effects.state.link_acceleration_rad_s2 = -change / h
            one.turn(w1, thl, h)
            two.turn(w2, -thl, h)
        self.motor_position, self.motor_velocity = [one.angle, two.angle], [one.velocity, two.velocity]
        self.link_position, self.link_velocity = thl, wl
        self.slip = [one.slip, two.slip]
        self.loss_w = [stop1 * abs(w1) / h1, stop2 * abs(w2) / h2]
        self.time_s += steps * h

    def _place(self, h: float) -> None:
        """Copy the plant's public state to both sides, temperature and time to their effects' states."""
        for k, side in enumerate(self._sides):
            state = side.effects.state
            state.temperature_c = self.temperatures[k].celsius
            state.time_s = self.time_s
            link = side.sign * self.link_position
            side.place(self.motor_position[k], self.motor_velocity[k], self.slip[k], link, h)

    def joint_torques(self) -> tuple[float, float]:
        """Return (τ1, τ2): torque of each flexible spline in Nm, own frames."""
        self._place(self.substep_s)
        one, two = self._sides
        return one.torque(self.link_velocity), two.torque(-self.link_velocity)

    def sensor_torque(self) -> float:
        """Return the true torque in the sensor, Nm: τ1 - load1 - Jl1 dwl1/dt."""
        tau_1, tau_2 = self.joint_torques()
        one, two = tau_1 - self._sides[0].load, tau_2 - self._sides[1].load
        share = self._link_inertia[0] / sum(self._link_inertia)
        return one - share * (one - two)


# What instruments read

Errors = tuple[float, float, float]
"""What motor encoder [rad, motor side], link encoder [rad] and current [A] read above the truth."""


class _Truth(NamedTuple):
    """True values of the quantities that a channel delay acts on, at one time."""

    time_s: float
    currents: tuple[float, float]
    link_rad: float  # of joint 1
    torque_nm: float


def _between(early: _Truth, late: _Truth, time_s: float) -> _Truth:
    share = (time_s - early.time_s) / (late.time_s - early.time_s)

    def mix(a: float, b: float) -> float:
        return a + share * (b - a)

    return _Truth(
        time_s,
        (mix(early.currents[0], late.currents[0]), mix(early.currents[1], late.currents[1])),
        mix(early.link_rad, late.link_rad),
        mix(early.torque_nm, late.torque_nm),
    )


class _Past:
    """Samples of the truth over the last `span_s`; before the first one it was as in the first one."""

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s
        self._samples: deque[_Truth] = deque()

    def add(self, now: _Truth) -> None:
        samples = self._samples
        if samples and now.time_s <= samples[-1].time_s:
            samples.pop()
        samples.append(now)
        while len(samples) > 2 and samples[1].time_s <= now.time_s - self._span_s:
            samples.popleft()

    def ago(self, delay_s: float) -> _Truth:
        """Return the truth of delay_s ago, between samples by a straight line; 0: of the last sample before this one."""
        samples = self._samples
        if delay_s <= 0.0:
            return samples[-2] if len(samples) > 1 else samples[-1]
        time_s = samples[-1].time_s - delay_s
        if time_s <= samples[0].time_s:
            return samples[0]._replace(time_s=time_s)
        for k in range(len(samples) - 2, -1, -1):
            if samples[k].time_s <= time_s:
                return _between(samples[k], samples[k + 1], time_s)
        raise AssertionError("the first sample is earlier")


class _Reading:
    """One hook of one effect, with a state of its own.

    Its rates are means over its own delay d, so that truth - d * rate is the truth d ago.
    """

    def __init__(self, effect: Effect, name: str, values: Values, joint: Joint, number: int) -> None:
        self._call: Callable[..., Any] = getattr(effect, name)
        self._values = values
        self.joint = joint
        self._number = number
        self._functions = ScalarFunctions()
        self.state = State()
        self.delay_s = abs(values.get("delay_s", 0.0))
        self.at_motor = name == "link_rad" and effect.at_motor_of(values)

    def update(self, plant: EffectPlant, truth: _Truth, past: _Past) -> None:
        """Set the hook's state to the truth in this joint's own frame."""
        number, state = self._number, self.state
        sign = -1.0 if number else 1.0
        inner = plant.effects[number].state
        for name in ("direction", "velocity_rad_s", "motor_position_rad", "torsion_rad", "torque_nm"):
            setattr(state, name, getattr(inner, name))
        state.motor_acceleration_rad_s2 = inner.motor_acceleration_rad_s2
        state.link_acceleration_rad_s2 = inner.link_acceleration_rad_s2
        state.temperature_c, state.time_s = inner.temperature_c, inner.time_s
        state.current_a = truth.currents[number]
        state.link_position_rad, state.coupling_position_rad = sign * truth.link_rad, truth.link_rad
        before = past.ago(self.delay_s)
        span_s = truth.time_s - before.time_s
        if span_s > 0.0:
            state.current_rate_a_s = (truth.currents[number] - before.currents[number]) / span_s
            state.torque_rate_nm_s = (truth.torque_nm - before.torque_nm) / span_s
            state.link_velocity_rad_s = sign * (truth.link_rad - before.link_rad) / span_s
        else:
            state.current_rate_a_s = state.torque_rate_nm_s = 0.0
            state.link_velocity_rad_s = sign * plant.link_velocity

    def error(self) -> float:
        """Return the hook's value at the state."""
        return float(self._call(self._values, self.state, self.joint, self._functions))


class Readings:
    """Errors by effects of all instruments of one bench; `read` once per sample, after the plant's step.

    An error of the motor's encoder, which the library expresses as one of the link's (motor_side=1), is the motor's here.
    """

    def __init__(self, plant: EffectPlant) -> None:
        self._plant = plant
        sides = [side.true_joint for side in plant.parameters.joints]
        entries = [(k, *entry) for k, joint in enumerate(sides) for entry in effects_of(joint)]
        first = next((k for k, effect, values in entries if effect.at_sensor_of(values)), 0)
        self._current: list[list[_Reading]] = [[], []]
        self._position: list[list[_Reading]] = [[], []]
        self._sensor: list[_Reading] = []
        for k, effect, values in entries:
            for name, readings in (
                ("current_a", self._current[k]),
                ("link_rad", self._position[k]),
                ("sensor_nm", self._sensor if k == first else []),
            ):
                if name in effect.hooks:
                    readings.append(_Reading(effect, name, values, sides[k], k))
        self._all = [
            *self._current[0],
            *self._current[1],
            *self._position[0],
            *self._position[1],
            *self._sensor,
        ]
        self._past = _Past(max((reading.delay_s for reading in self._all), default=0.0))
        self._time_s = 0.0

    def read(self, torque_nm: float, dt_s: float) -> tuple[tuple[Errors, Errors], float]:
        """Return the errors of both joints' instruments, and what the sensor reads where torque_nm is the truth.

        dt_s: time since the last call.
        """
        self._time_s += dt_s
        plant = self._plant
        one, two = plant.drives
        truth = _Truth(self._time_s, (one.current_a, two.current_a), plant.link_position, torque_nm)
        self._past.add(truth)
        for reading in self._all:
            reading.update(plant, truth, self._past)
        return (self._of_joint(0), self._of_joint(1)), self._of_sensor(torque_nm)

    def _of_joint(self, k: int) -> Errors:
        motor = link = current = 0.0
        for reading in self._current[k]:
            current += reading.error()
        for reading in self._position[k]:
            if reading.at_motor:
                motor -= reading.joint.gear_ratio * reading.error()
            else:
                link += reading.error()
        return motor, link, current

    def _of_sensor(self, truth_nm: float) -> float:
        """Return what the sensor reads. Its hooks depend on just that, linearly: a secant is exact."""
        if not self._sensor:
            return truth_nm
        low, high = (self._sensor_errors(truth_nm + more) for more in (0.0, 1.0))
        return truth_nm + low / (1.0 - (high - low))

    def _sensor_errors(self, reading_nm: float) -> float:
        error = 0.0
        for reading in self._sensor:
            reading.state.torque_nm = reading_nm
            error += reading.error()
        return error
