"""Two harmonic-drive joints facing each other, coupled by a stiff torque sensor: the paper's Eqs. (1)-(3).

Per joint j in its own frame (θ motor side m, link side l; w = dθ/dt):

    Jm dwm/dt = Kt i - (τ + A cos(n θm + φ) + friction) / G          (1)
    τ = K (θm/G - θl) + D (wm/G - wl)                                (3)

Both links and the sensor are one rigid body, and the joints face each other, so θl2 = -θl1:

    (Jl1 + Jl2) dwl1/dt = τ1 - τ2                                    (2)
    sensor = τ1 - Jl1 dwl1/dt = τ2 - Jl2 dwl2/dt

The sensor's torque is positive along the positive current of either joint.

Integration is semi-implicit Euler (velocities first, then positions with the new velocities). Friction is
implicit: within a step its impulse can stop the motor but never turn it round, h F/(G Jm) against |w|. So a
joint sticks at exactly zero velocity, does not creep, and no step size makes friction unstable. Pure: no
clock.
"""

import math
from typing import NamedTuple

from estimator.losses import LossModel
from sim_can.drive_control import DriveControl
from sim_can.loss_table import JointFriction, LossTable
from sim_can.plant_parameters import JointPlant, PlantParameters, substep_limit

CONTROL_CYCLE_S = 0.001


class _Constants(NamedTuple):
    """Numbers of one joint that the inner loop uses."""

    gear_ratio: float
    torque_constant: float
    rotor_inertia: float
    stiffness: float
    damping: float
    ripple_nm: float
    ripple_order: float
    ripple_phase: float


def _constants(side: JointPlant) -> _Constants:
    d = side.deviations
    return _Constants(
        side.joint.gear_ratio,
        side.torque_constant,
        side.rotor_inertia,
        side.stiffness,
        side.joint.damping_nms_per_rad,
        d.ripple_nm,
        d.ripple_order_per_motor_rev,
        d.ripple_phase_rad,
    )


def joint_friction(side: JointPlant) -> JointFriction:
    """Friction law of a true joint from its file's losses and its deviations."""
    joint, d = side.joint, side.deviations
    table = LossTable(
        LossModel(joint).loss_many,
        joint.gear_ratio,
        joint.torque_constant_nm_per_a,
        side.drive.current_limit_a,
    )
    viscous = (d.viscous_scale - 1.0) * joint.friction.viscous_nms_per_rad
    return JointFriction(table, d.friction_scale, viscous, d.stribeck_nm, d.stribeck_velocity_rad_s)


class Plant:
    """State and equations of the bench. Angles in rad, velocities in rad/s; `link_*` is joint 1's frame.

    Public state (may be set before a run): motor_position, motor_velocity (lists of two, motor side),
    link_position, link_velocity; `drives` are the control loops.
    """

    def __init__(self, parameters: PlantParameters) -> None:
        self.parameters = parameters
        one, two = parameters.joints
        self._joints = (_constants(one), _constants(two))
        self._link_inertia = (one.joint.link_inertia_kgm2, two.joint.link_inertia_kgm2)
        same = one.joint == two.joint and one.deviations == two.deviations and one.drive == two.drive
        first = joint_friction(one)
        self.friction = (first, first if same else joint_friction(two))
        self.drives = (DriveControl(one), DriveControl(two))
        self.substep_s = substep_limit(parameters)
        self.motor_position = [0.0, 0.0]
        self.motor_velocity = [0.0, 0.0]
        self.link_position = 0.0
        self.link_velocity = 0.0

    def command(self, drive: int, mode: int, target: float) -> None:
        """Mode and target of drive 0 or 1 from now on; see `sim_can.source`."""
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

    def _integrate(self, steps: int, h: float) -> None:
        """`steps` integration steps of h seconds."""
        G1, Kt1, Jm1, K1, D1, A1, n1, p1 = self._joints[0]
        G2, Kt2, Jm2, K2, D2, A2, n2, p2 = self._joints[1]
        control1, control2 = self.drives[0].step, self.drives[1].step
        friction1, friction2 = self.friction
        th1, th2 = self.motor_position
        w1, w2 = self.motor_velocity
        thl, wl = self.link_position, self.link_velocity
        g1, g2 = 1.0 / G1, 1.0 / G2
        h1, h2 = h / Jm1, h / Jm2
        f1, f2 = h1 * g1, h2 * g2
        hl = h / (self._link_inertia[0] + self._link_inertia[1])
        cos = math.cos
        for _ in range(steps):
            i1 = control1(h, w1)
            i2 = control2(h, w2)
            t1 = K1 * (th1 * g1 - thl) + D1 * (w1 * g1 - wl)
            t2 = K2 * (th2 * g2 + thl) + D2 * (w2 * g2 + wl)
            w1 += h1 * Kt1 * i1 - f1 * (t1 + A1 * cos(n1 * th1 + p1))
            stop = f1 * friction1(t1, w1 * g1)
            w1 = w1 - stop if w1 > stop else w1 + stop if w1 < -stop else 0.0
            w2 += h2 * Kt2 * i2 - f2 * (t2 + A2 * cos(n2 * th2 + p2))
            stop = f2 * friction2(t2, w2 * g2)
            w2 = w2 - stop if w2 > stop else w2 + stop if w2 < -stop else 0.0
            wl += hl * (t1 - t2)
            th1 += h * w1
            th2 += h * w2
            thl += h * wl
        self.motor_position[0], self.motor_position[1] = th1, th2
        self.motor_velocity[0], self.motor_velocity[1] = w1, w2
        self.link_position, self.link_velocity = thl, wl

    def joint_torques(self) -> tuple[float, float]:
        """(τ1, τ2): torque of each flexible spline in Nm, Eq. (3), own frames."""
        G1, _, _, K1, D1, *_ = self._joints[0]
        G2, _, _, K2, D2, *_ = self._joints[1]
        th1, th2 = self.motor_position
        w1, w2 = self.motor_velocity
        thl, wl = self.link_position, self.link_velocity
        return K1 * (th1 / G1 - thl) + D1 * (w1 / G1 - wl), K2 * (th2 / G2 + thl) + D2 * (w2 / G2 + wl)

    def sensor_torque(self) -> float:
        """True torque in the sensor, Nm: τ1 - Jl1 dwl1/dt."""
        one, two = self.joint_torques()
        share = self._link_inertia[0] / (self._link_inertia[0] + self._link_inertia[1])
        return one - share * (one - two)

    def energy(self) -> float:
        """Kinetic and elastic energy and the ripple's potential, J. Without motor current it can only fall."""
        total = 0.5 * (self._link_inertia[0] + self._link_inertia[1]) * self.link_velocity**2
        for k, sign in ((0, 1.0), (1, -1.0)):
            c = self._joints[k]
            torsion = self.motor_position[k] / c.gear_ratio - sign * self.link_position
            total += 0.5 * c.rotor_inertia * self.motor_velocity[k] ** 2 + 0.5 * c.stiffness * torsion**2
            if c.ripple_order > 0.0:
                angle = c.ripple_order * self.motor_position[k] + c.ripple_phase
                total += c.ripple_nm / (c.gear_ratio * c.ripple_order) * math.sin(angle)
        return total
