"""Torque observer of Eqs. (4) and (7) in exact discrete form.

    tau_raw = [ g/(s+g) (i Kt + J g w) - J g w ] G            = G LPF(i Kt - J dw/dt), without any loss
    tau_tob = tau_raw - g/(s+g) tau_f                         = Eq. (4), tau_f = G f_m
    v       = g/(s+g) w/G                                     velocity of the same age as tau_raw

Symbols: i current [A], w motor velocity [rad/s], Kt torque constant, J rotor inertia (motor side), G gear
ratio, g bandwidth [rad/s], tau_f friction [Nm, joint side].

Discretisation: z' = g (u - z) is integrated exactly for an input that is linear between samples
(first-order hold), with the measured step dt:

    z_k = a z_(k-1) + b0 u_k + b1 u_(k-1),   a = exp(-g dt),  b0 = 1 - (1-a)/(g dt),  b1 = (1-a)/(g dt) - a

The state starts at the first input, so a joint at rest or at constant speed has no start transient. A ramp
is followed with a lag of exactly 1/g: the group delay at DC (5 ms at 200 rad/s).

The link velocity is the derivative of the link position through p/(s+p), exact for a position that is
linear between samples: r_k = exp(-p dt) r_(k-1) + (1 - exp(-p dt)) (q_k - q_(k-1))/dt.
"""

from __future__ import annotations

from math import expm1
from typing import Final, NamedTuple

from estimator.friction import FrictionModel
from estimator.parameters import Joint


class Observed(NamedTuple):
    """Outputs of one step; torques [Nm, joint side], velocities [rad/s, joint side]."""

    raw_nm: float
    tob_nm: float
    joint_velocity_rad_s: float
    link_velocity_rad_s: float


def first_order_hold(rate_rad_s: float, dt_s: float) -> tuple[float, float, float]:
    """Return (a, b0, b1) of the recursion for one step dt_s > 0; expm1 keeps tiny steps exact."""
    x = rate_rad_s * dt_s
    gone = -expm1(-x)
    share = gone / x
    return 1.0 - gone, 1.0 - share, share - 1.0 + gone


class Observer:
    """Step-by-step observer of one joint: plain floats, no allocation but its result.

    joint: parameters; bandwidth_rad_s: g; link_bandwidth_rad_s: p of the link velocity.
    """

    __slots__ = (
        "_friction",
        "_friction_last",
        "_gear",
        "_inertia_rate",
        "_inverse_gear",
        "_kt",
        "_link",
        "_link_rate",
        "_link_velocity",
        "_rate",
        "_u",
        "_v",
        "_z",
        "_z_friction",
        "_z_v",
    )

    def __init__(self, joint: Joint, bandwidth_rad_s: float, link_bandwidth_rad_s: float) -> None:
        self._friction: Final = FrictionModel(joint.friction).torque
        self._gear: Final = joint.gear_ratio
        self._inverse_gear: Final = 1.0 / joint.gear_ratio
        self._kt: Final = joint.torque_constant_nm_per_a
        self._inertia_rate: Final = joint.rotor_inertia_kgm2 * bandwidth_rad_s
        self._rate: Final = bandwidth_rad_s
        self._link_rate: Final = link_bandwidth_rad_s
        self._u = self._z = self._v = self._z_v = self._friction_last = self._z_friction = 0.0
        self._link = self._link_velocity = 0.0

    def start(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> Observed:
        """Set the states of a joint that has always moved at this speed, without acceleration."""
        v = motor_velocity_rad_s * self._inverse_gear
        u = current_a * self._kt + self._inertia_rate * motor_velocity_rad_s
        self._u = self._z = u
        self._v = self._z_v = v
        self._friction_last = self._z_friction = self._friction(v)
        self._link = link_position_rad
        self._link_velocity = v
        raw = (u - self._inertia_rate * motor_velocity_rad_s) * self._gear
        return Observed(raw, raw - self._z_friction, v, v)

    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> Observed:
        """Advance by dt_s > 0 to the sample given and return the outputs at that sample."""
        x = self._rate * dt_s
        gone = -expm1(-x)
        share = gone / x
        a = 1.0 - gone
        b0 = 1.0 - share
        b1 = share - a
        spin = self._inertia_rate * motor_velocity_rad_s
        u = current_a * self._kt + spin
        v = motor_velocity_rad_s * self._inverse_gear
        friction = self._friction(v)
        self._z = z = a * self._z + b0 * u + b1 * self._u
        self._z_v = z_v = a * self._z_v + b0 * v + b1 * self._v
        self._z_friction = z_f = a * self._z_friction + b0 * friction + b1 * self._friction_last
        self._u = u
        self._v = v
        self._friction_last = friction
        gone = -expm1(-self._link_rate * dt_s)
        slope = (link_position_rad - self._link) / dt_s
        self._link_velocity = r = self._link_velocity + gone * (slope - self._link_velocity)
        self._link = link_position_rad
        raw = (z - spin) * self._gear
        return _new(Observed, (raw, raw - z_f, z_v, r))


_new: Final = tuple.__new__  # a NamedTuple's own constructor costs twice as much
