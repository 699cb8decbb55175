"""Right-hand side of the bench, joint side, for B benches at once. Arrays are [2, B]: joint, run.

    tau_j = K d + K3 d^3 + H z + D dd/dt          d = theta_m/G + E sin(k theta_m + psi) - theta_l (- play)
    J dv/dt = drive(i) - tau (1 + G E k cos(k theta_m + psi)) - friction - waves(theta_m)      J = Jm G^2, v = omega_m/G
    (Jl1 + Jl2) dw/dt = (tau_1 - load_1) - (tau_2 - load_2)      w = omega_l1 = -omega_l2
    sensor = tau_1 - load_1 - Jl1 dw/dt

Friction is a bristle: s in -1..1 is its bending over a travel of 40 urad, so that a joint sticks without creeping and
turns round over a travel that no speed of 0.03 rad/s ever resolves. z is the bending of the gear's own Maxwell element.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from validation.hidden.plant import Array, Plant
from validation.hidden.strange import Strange

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
        used = {
            name: bool(np.any(getattr(p, name))) for name in vars(p) if isinstance(getattr(p, name), Array)
        }
        self.has_stribeck = used["stribeck"]
        self.has_load_friction = used["load_coefficient"]
        self.has_asymmetry = used["asymmetry"]
        self.has_temperature = used["viscous_per_k"] or used["coulomb_per_k"] or used["constant_per_k"]
        self.has_kinematic = used["kinematic"]
        self.has_cubic = used["cubic"]
        self.has_hysteresis = used["hysteresis"]
        self.has_play = used["play"]
        self.has_saturation = used["saturation"]
        self.has_unbalance = used["unbalance"]

    def warm(self, temperature_c: Array) -> None:
        """Take over the temperatures [2, B]; they change slowly, once per control cycle is enough."""
        if not self.has_temperature:
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
        if self.has_kinematic:
            angle = p.kinematic_order * p.ratio * q + p.kinematic_phase
            d += p.kinematic * np.sin(angle)
            slope = self.kinematic_slope * np.cos(angle)
        if self.strange.has_slips:
            d -= self.strange.slipped_rad
        return d, slope

    def drive(self, current: Array) -> Array:
        """Return the motor's torque on the joint side [Nm] at the true current."""
        if self.strange.has_dead_band:
            current = self.strange.dead_band(current)
        if self.has_saturation:
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
        if self.has_play:
            free = np.clip(d, -self.half_play, self.half_play)
            d = d - free
            rate *= (d != 0.0) | (self.half_play == 0.0)
        tau = p.stiffness * d
        tau += p.damping * rate
        if self.has_cubic:
            tau += p.cubic * d * d * d
        if self.has_hysteresis:
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
        if self.has_unbalance:
            tau = tau - p.unbalance * np.sin(link + p.unbalance_phase)
        return net, (tau[0] - tau[1]) * self.inverse_links, tau

    def friction(self, v: Array, link: Array, s: Array, tau: Array) -> Array:
        """Return the friction torque [Nm] at bristle state s."""
        p = self.p
        magnitude = self.coulomb
        if self.has_stribeck:
            x = v / p.stribeck_velocity
            magnitude = magnitude + p.stribeck * np.exp(-x * x)
        if self.has_load_friction:
            magnitude = magnitude + p.load_coefficient * np.abs(tau)
        if self.strange.has_friction:
            magnitude = magnitude + self.strange.friction(v, link, tau)
        x = v / _BRISTLE_FADE_RAD_S
        total: Array = magnitude * s + self.viscous * v
        total += self.bristle * (v - np.abs(v) * s) / (1.0 + x * x)
        if self.has_asymmetry:
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
