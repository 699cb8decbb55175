"""Plant of joints whose files have effects: the equations of `jtqd.sim_can.plant` with the effects in them.

Per joint, with the sums of the hooks of `jtqd.estimator.effects.effect` (b: twist by position alone, u: other twist):

    δ = θm/G + e(θm) + b(θm) - θl         τ = K (δ + u) + D dδ/dt + H z
    Jm dwm/dt = Kt i - τ (1/G + e') - (A cos(n θm + φ) + loss_nm + friction) / G
    (Jl1 + Jl2) dwl1/dt = (τ1 - load1) - (τ2 - load2)      sensor = τ1 - load1 - Jl1 dwl1/dt

A kinematic error brings its virtual work τ b' along as its loss. Dissipative losses are part of the implicit
friction, so a joint sticks with them as without. A class of its own, because evaluating hooks costs time that a plant
without effects must not pay; with effects of size zero both give the same numbers bit by bit. Pure.
"""

from __future__ import annotations

import math

from jtqd.estimator.errors import ConfigError
from jtqd.sim_can.joint_effects import EffectFriction, JointEffects, total
from jtqd.sim_can.plant import JointConstants, Plant, relaxed_angle
from jtqd.sim_can.plant_file import STEEPEST_KINEMATIC_ERROR, PlantParameters, substep_limit


class _Side:
    """One joint in the inner loop, in its own frame: motor state, torsion, hysteresis of the plant file."""

    __slots__ = (
        "angle",
        "bend",
        "bend_rate",
        "constants",
        "effects",
        "link",
        "load",
        "sign",
        "slip",
        "slope",
        "torsion",
        "velocity",
    )

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
            steepest = bend + side.joint.gear_ratio * side.deviations.kinematic_slope
            if steepest > STEEPEST_KINEMATIC_ERROR:
                raise ConfigError(
                    f"joint {side.joint.name}: effects: the kinematic error changes the gear's transmission by "
                    f"{steepest:.2g} of itself, expected at most {STEEPEST_KINEMATIC_ERROR:g}"
                )
        self.substep_s = substep_limit(parameters, (one.stiffest_spring(), two.stiffest_spring()), bends)
        files = self.friction
        self._sides = (_Side(self._joints[0], one, 1.0), _Side(self._joints[1], two, -1.0))
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
        hl = h / (self._link_inertia[0] + self._link_inertia[1])
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
        self.motor_position[0], self.motor_position[1] = one.angle, two.angle
        self.motor_velocity[0], self.motor_velocity[1] = one.velocity, two.velocity
        self.link_position, self.link_velocity = thl, wl
        self.slip[0], self.slip[1] = one.slip, two.slip
        self._loss_w[0], self._loss_w[1] = stop1 * abs(w1) / h1, stop2 * abs(w2) / h2
        self.time_s += steps * h

    def _place(self, h: float) -> None:
        """Copy the plant's public state to both sides, temperature and time to their effects' states."""
        for k, side in enumerate(self._sides):
            state = side.effects.state
            state.temperature_c = self.temperatures[k].celsius
            state.time_s = self.time_s
            side.place(
                self.motor_position[k],
                self.motor_velocity[k],
                self.slip[k],
                side.sign * self.link_position,
                h,
            )

    def joint_torques(self) -> tuple[float, float]:
        """Return (τ1, τ2): torque of each flexible spline in Nm, own frames."""
        self._place(self.substep_s)
        one, two = self._sides
        return one.torque(self.link_velocity), two.torque(-self.link_velocity)

    def sensor_torque(self) -> float:
        """Return the true torque in the sensor, Nm: τ1 - load1 - Jl1 dwl1/dt."""
        tau_1, tau_2 = self.joint_torques()
        one, two = tau_1 - self._sides[0].load, tau_2 - self._sides[1].load
        share = self._link_inertia[0] / (self._link_inertia[0] + self._link_inertia[1])
        return one - share * (one - two)
