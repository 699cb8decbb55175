"""Two harmonic-drive joints facing each other, coupled by a stiff torque sensor: the paper's Eqs. (1)-(3).

Per joint j in its own frame (θ motor side m, link side l; w = dθ/dt), with the kinematic error of the gear
e(θm) = E sin(k θm + ψ), its slope e' = de/dθm, and a Maxwell-slip element z beside the spring:

    Jm dwm/dt = Kt i - τ (1/G + e') - (A cos(n θm + φ) + friction) / G       (1)
    δ = θm/G + e(θm) - θl              τ = K δ + D dδ/dt + H z               (3)
    dz = dδ / travel, z held within -1 .. 1

The motor's load is τ dδ/dθm: the virtual work of the spring, so a kinematic error makes no energy. Both links
and the sensor are one rigid body, and the joints face each other, so θl2 = -θl1:

    (Jl1 + Jl2) dwl1/dt = τ1 - τ2                                            (2)
    sensor = τ1 - Jl1 dwl1/dt = τ2 - Jl2 dwl2/dt

The sensor's torque is positive along the positive current of either joint.

Integration is semi-implicit Euler (velocities first, then positions with the new velocities). Friction is
implicit: within a step its impulse can stop the motor but never turn it round, h F/(G Jm) against |w|. So a
joint sticks at exactly zero velocity, does not creep, and no step size makes friction unstable. Pure: no
clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from jtqd.estimator.losses import LossModel
from jtqd.sim_can.days import NOMINAL_DAY, Day, JointTemperature
from jtqd.sim_can.drive_control import DriveControl
from jtqd.sim_can.losses import JointFriction, LossTable
from jtqd.sim_can.plant_file import JointPlant, PlantParameters, substep_limit

CONTROL_CYCLE_S = 0.001


class JointConstants(NamedTuple):
    """Constants of one joint for the inner loop, SI units."""

    gear_ratio: float
    torque_constant: float
    rotor_inertia: float
    stiffness: float
    damping: float
    ripple_nm: float
    ripple_order: float
    ripple_phase: float
    error_rad: float  # E, kinematic error
    error_order: float
    error_phase: float
    error_slope: float  # G E k: e' in units of 1/G
    slip_nm: float  # H, hysteresis
    per_travel: float


def _constants(side: JointPlant) -> JointConstants:
    d = side.deviations
    return JointConstants(
        side.joint.gear_ratio,
        side.torque_constant,
        side.rotor_inertia,
        side.stiffness,
        side.joint.damping_nms_per_rad,
        d.ripple_nm,
        d.ripple_order_per_motor_rev,
        d.ripple_phase_rad,
        d.kinematic_error_rad,
        d.kinematic_error_order_per_motor_rev,
        d.kinematic_error_phase_rad,
        side.joint.gear_ratio * d.kinematic_slope,
        d.hysteresis_nm,
        1.0 / d.hysteresis_travel_rad,
    )


def relaxed_angle(c: JointConstants, bend_rad: Callable[[float], float] | None = None) -> float:
    """Return the motor angle without torsion at link angle zero, θ = -G (e(θ) + b(θ)): a bench is assembled without stress.

    bend_rad: b(θ), twist by position alone. The iteration contracts: G |e' + b'| < 1/2 (`plant_file`). 0 without either.
    """
    angle = 0.0
    for _ in range(60):
        bend = 0.0 if bend_rad is None else bend_rad(angle)
        angle = -c.gear_ratio * c.error_rad * math.sin(c.error_order * angle + c.error_phase)
        angle -= c.gear_ratio * bend
    return angle if c.error_rad or bend_rad is not None else 0.0


def loss_table(side: JointPlant) -> LossTable:
    """Return the losses of the joint's file over what the gear transmits, without a Stribeck peak: that is a deviation."""
    joint = side.joint
    if joint.efficiency is None:
        joint = replace(joint, friction=replace(joint.friction, stribeck_nm=0.0))
    return LossTable(
        LossModel(joint).loss_many,
        joint.gear_ratio,
        joint.torque_constant_nm_per_a,
        side.drive.current_limit_a,
    )


def joint_friction(side: JointPlant, table: LossTable | None = None) -> JointFriction:
    """Return the friction law of a true joint from its file's losses (`table`, else made here) and its deviations."""
    joint, d = side.joint, side.deviations
    viscous = (d.viscous_scale - 1.0) * joint.friction.viscous_nms_per_rad
    table = loss_table(side) if table is None else table
    return JointFriction(table, d.friction_scale, viscous, d.stribeck_nm, d.stribeck_velocity_rad_s)


class Plant:
    """State and equations of the bench. Angles in rad, velocities in rad/s; `link_*` is joint 1's frame.

    Public state (may be set before a run): motor_position, motor_velocity (lists of two, motor side),
    link_position, link_velocity, slip (z of both joints); `drives` are the control loops, `temperatures` the
    joints' thermal states. Joint files with effects need `jtqd.sim_can.effect_plant.EffectPlant` (ValueError here).
    """

    def __init__(self, parameters: PlantParameters) -> None:
        if parameters.has_effects and type(self) is Plant:
            raise ValueError("found joints with effects, expected none: use EffectPlant")
        self.parameters = parameters
        one, two = parameters.joints
        self._joints = (_constants(one), _constants(two))
        self._link_inertia = (one.link_inertia, two.link_inertia)
        table = loss_table(one)
        same = one.joint == two.joint and one.drive.current_limit_a == two.drive.current_limit_a
        self.friction = (joint_friction(one, table), joint_friction(two, table if same else None))
        self.drives = (DriveControl(one), DriveControl(two))
        self.temperatures = (JointTemperature(one.thermal), JointTemperature(two.thermal))
        self._warming = any(side.thermal.kelvin_per_w > 0.0 for side in parameters.joints)
        self._day = NOMINAL_DAY
        self.substep_s = substep_limit(parameters)
        self.motor_position = [relaxed_angle(c) for c in self._joints]
        self.motor_velocity = [0.0, 0.0]
        self.link_position = 0.0
        self.link_velocity = 0.0
        self.slip = [0.0, 0.0]
        self._loss_w = [0.0, 0.0]  # power of the friction in the last integration step

    def begin_run(self) -> None:
        """Start a run: the drives are about to be enabled; the time that effects may depend on counts from here."""

    def begin_day(self, day: Day) -> None:
        """Set friction and temperature of another day; both joints are as warm as their surroundings."""
        self._day = day
        for k, temperature in enumerate(self.temperatures):
            temperature.start(day.temperature_k[k])
            self._set_friction(k)

    def _set_friction(self, k: int) -> None:
        """Set the Coulomb and viscous friction of the present day and temperature, as differences to the file's."""
        side, temperature = self.parameters.joints[k], self.temperatures[k]
        file = side.joint.friction
        viscous = side.deviations.viscous_scale * (1.0 + self._day.viscous[k]) * temperature.viscous
        self.friction[k].differ(
            (temperature.coulomb - 1.0) * file.coulomb_nm, (viscous - 1.0) * file.viscous_nms_per_rad
        )

    def command(self, drive: int, mode: int, target: float) -> None:
        """Set mode and target of drive 0 or 1; see `jtqd.sim_can.source`."""
        self.drives[drive].command(mode, target, self.motor_velocity[drive])

    def step(self, dt_s: float) -> None:
        """Advance by dt_s: whole control cycles of about 1 ms, each in equal integration steps of at most
        `substep_s`.
        """
        if dt_s <= 0.0:
            return
        cycles = max(1, round(dt_s / CONTROL_CYCLE_S))
        cycle = dt_s / cycles
        # the small excess keeps stamps that jitter by a few nanoseconds at the same number of steps
        steps = max(1, math.ceil(cycle / self.substep_s - 1e-3))
        one, two = self.drives
        for _ in range(cycles):
            one.plan(cycle)
            two.plan(cycle)
            self._integrate(steps, cycle / steps)
            if self._warming:
                self._warm(cycle)

    def _warm(self, dt_s: float) -> None:
        """Add the losses of dt_s seconds to the joints' temperatures."""
        for k, temperature in enumerate(self.temperatures):
            if temperature.add(self._loss_w[k], dt_s):
                self._set_friction(k)

    def _integrate(self, steps: int, h: float) -> None:  # noqa: PLR0915 - both joints written out for speed
        """Integrate `steps` steps of h seconds."""
        G1, Kt1, Jm1, K1, D1, A1, n1, p1, E1, k1, q1, S1, H1, c1 = self._joints[0]
        G2, Kt2, Jm2, K2, D2, A2, n2, p2, E2, k2, q2, S2, H2, c2 = self._joints[1]
        control1, control2 = self.drives[0].step, self.drives[1].step
        friction1, friction2 = self.friction
        th1, th2 = self.motor_position
        w1, w2 = self.motor_velocity
        thl, wl = self.link_position, self.link_velocity
        z1, z2 = self.slip
        g1, g2 = 1.0 / G1, 1.0 / G2
        h1, h2 = h / Jm1, h / Jm2
        f1, f2 = h1 * g1, h2 * g2
        hl = h / (self._link_inertia[0] + self._link_inertia[1])
        sin, cos = math.sin, math.cos
        s1 = s2 = 1.0  # dδ/dθm in units of 1/G
        d1 = th1 * g1 + (E1 * sin(k1 * th1 + q1) if E1 else 0.0) - thl
        d2 = th2 * g2 + (E2 * sin(k2 * th2 + q2) if E2 else 0.0) + thl
        stop1 = stop2 = 0.0
        for _ in range(steps):
            i1 = control1(h, w1)
            i2 = control2(h, w2)
            if E1:
                s1 = 1.0 + S1 * cos(k1 * th1 + q1)
            if E2:
                s2 = 1.0 + S2 * cos(k2 * th2 + q2)
            t1 = K1 * d1 + D1 * (w1 * g1 * s1 - wl)
            t2 = K2 * d2 + D2 * (w2 * g2 * s2 + wl)
            if H1:
                t1 += H1 * z1
            if H2:
                t2 += H2 * z2
            w1 += h1 * Kt1 * i1 - f1 * (t1 * s1 + A1 * cos(n1 * th1 + p1))
            stop1 = f1 * friction1(t1, w1 * g1)
            w1 = w1 - stop1 if w1 > stop1 else w1 + stop1 if w1 < -stop1 else 0.0
            w2 += h2 * Kt2 * i2 - f2 * (t2 * s2 + A2 * cos(n2 * th2 + p2))
            stop2 = f2 * friction2(t2, w2 * g2)
            w2 = w2 - stop2 if w2 > stop2 else w2 + stop2 if w2 < -stop2 else 0.0
            wl += hl * (t1 - t2)
            th1 += h * w1
            th2 += h * w2
            thl += h * wl
            x1 = th1 * g1
            x2 = th2 * g2
            if E1:
                x1 += E1 * sin(k1 * th1 + q1)
            if E2:
                x2 += E2 * sin(k2 * th2 + q2)
            x1 -= thl
            x2 += thl
            if H1:
                z1 += c1 * (x1 - d1)
                z1 = 1.0 if z1 > 1.0 else -1.0 if z1 < -1.0 else z1
            if H2:
                z2 += c2 * (x2 - d2)
                z2 = 1.0 if z2 > 1.0 else -1.0 if z2 < -1.0 else z2
            d1 = x1
            d2 = x2
        self.motor_position[0], self.motor_position[1] = th1, th2
        self.motor_velocity[0], self.motor_velocity[1] = w1, w2
        self.link_position, self.link_velocity = thl, wl
        self.slip[0], self.slip[1] = z1, z2
        # F = G Jm stop / h at the joint side, times |w|/G
        self._loss_w[0], self._loss_w[1] = stop1 * abs(w1) / h1, stop2 * abs(w2) / h2

    def _torsions(self) -> tuple[float, float]:
        """Return (δ1, δ2) in rad, own frames."""
        one, two = self._joints
        th1, th2 = self.motor_position
        x1 = th1 / one.gear_ratio
        x2 = th2 / two.gear_ratio
        if one.error_rad:
            x1 += one.error_rad * math.sin(one.error_order * th1 + one.error_phase)
        if two.error_rad:
            x2 += two.error_rad * math.sin(two.error_order * th2 + two.error_phase)
        return x1 - self.link_position, x2 + self.link_position

    def joint_torques(self) -> tuple[float, float]:
        """Return (τ1, τ2): torque of each flexible spline in Nm, Eq. (3), own frames."""
        G1, _, _, K1, D1, _, _, _, E1, k1, q1, S1, H1, _ = self._joints[0]
        G2, _, _, K2, D2, _, _, _, E2, k2, q2, S2, H2, _ = self._joints[1]
        d1, d2 = self._torsions()
        v1, v2 = self.motor_velocity[0] / G1, self.motor_velocity[1] / G2
        if E1:
            v1 *= 1.0 + S1 * math.cos(k1 * self.motor_position[0] + q1)
        if E2:
            v2 *= 1.0 + S2 * math.cos(k2 * self.motor_position[1] + q2)
        wl = self.link_velocity
        z1, z2 = self.slip
        return K1 * d1 + D1 * (v1 - wl) + H1 * z1, K2 * d2 + D2 * (v2 + wl) + H2 * z2

    def sensor_torque(self) -> float:
        """Return the true torque in the sensor, Nm: τ1 - Jl1 dwl1/dt."""
        one, two = self.joint_torques()
        share = self._link_inertia[0] / (self._link_inertia[0] + self._link_inertia[1])
        return one - share * (one - two)

    def energy(self) -> float:
        """Return kinetic and elastic energy and the ripple's potential, J. Without motor current it can only fall."""
        total = 0.5 * (self._link_inertia[0] + self._link_inertia[1]) * self.link_velocity**2
        for k, (c, torsion) in enumerate(zip(self._joints, self._torsions(), strict=True)):
            total += 0.5 * c.rotor_inertia * self.motor_velocity[k] ** 2 + 0.5 * c.stiffness * torsion**2
            total += 0.5 * c.slip_nm / c.per_travel * self.slip[k] ** 2
            if c.ripple_order > 0.0:
                angle = c.ripple_order * self.motor_position[k] + c.ripple_phase
                total += c.ripple_nm / (c.gear_ratio * c.ripple_order) * math.sin(angle)
        return total
