"""Drives and time: control at 1 kHz, explicit midpoint rule at 4 kHz, many benches side by side.

The friction bristle is integrated exactly within each half step; the rest is explicit. The current runs in straight lines
from set-point to set-point, one cycle late, so that its samples are fair to what is between them. The link
resonance of the stiffest bench (1900 rad/s) has omega h = 0.48 and is damped well beyond the rule's own growth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from validation.hidden.equations import BRISTLE_RAD, SIDE, Forces
from validation.hidden.plant import Array, Plant
from validation.hidden.profiles import STEP_S, Motion
from validation.hidden.strange import Strange

SUBSTEPS: Final = 4
_VELOCITY_LOOP_RAD_S: Final = 50.0
_RESET_RAD_S: Final = 12.0
_CURRENT_LIMIT: Final = 2.2  # times rated torque over G Kt


@dataclass(frozen=True)
class Truth:
    """True signals at 1 kHz: [n, 2, B], theta_l1 and the sensor's torque [n, B]."""

    current_a: Array
    motor_rad: Array
    motor_rad_s: Array
    link_rad: Array
    sensor_nm: Array


def integrate(p: Plant, nominal: Plant, motions: list[Motion], strange: Strange) -> Truth:
    """Return the true signals of B benches; `nominal` is what the drives believe (feedforward)."""
    forces = Forces(p, strange)
    n, count = len(motions[0].on), p.count
    out = Truth(*(np.empty((n, 2, count)) for _ in range(3)), *(np.empty((n, count)) for _ in range(2)))
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
            zm = np.clip(z + (dm - d) / p.travel, -1.0, 1.0) if forces.has_hysteresis else z
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
            if forces.has_hysteresis:
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
