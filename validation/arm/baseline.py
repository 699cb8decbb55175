"""The baseline: momentum observer on motor current, Coulomb and viscous friction fitted (De Luca and Mattone 2005).

It has what a user has: the URDF, data-sheet values of the joints, and the runs of the identification. Total momentum on the
joint side, motors' positions for the links', tau_f = Fc sign(v) + Fv v + Fo fitted per joint:

    p = (M(q) + J) v        r = K (p - integral of (G Kt i - tau_f + C(q, v)' v - g(q) + r))

Its payload is found by least squares over the first LEARN_S; it reports contact above what it saw without any.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from scipy.signal import lfilter, savgol_filter

from validation.arm.arm import CYCLE_S, JOINTS, Arm, Array, Payload, Readings, Truth, rigid
from validation.arm.judge import Published, nothing, tool_jacobians, wrench_information
from validation.arm.trial import ERRORS, LEARN_S

GAIN: Final = 50.0
"""K [1/s]."""
SMOOTHED: Final = 101
"""Cycles of the polynomials that smooth positions and currents for fits."""
SLOW_RAD_S: Final = 0.02
"""Below this speed friction is not fitted; sign(v) is v over this."""
MARGIN: Final = 1.2
"""Threshold over the largest residual of the identification."""
EVERY: Final = 10
LASTING: Final = 50.0
"""So many samples of EVERY are as wrong as one."""


class Dynamics:
    """Momentum and inverse dynamics of rigid bodies, of `rigid`."""

    def __init__(self, model: Any) -> None:
        self.model, self.data = model, mujoco.MjData(model)

    def momentum(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return M v and C' v - g, each [n, 7], at q, v [n, 7].

        C' v = dM/dt v - C v, with dM/dt v as a difference along v.
        """
        model, data, step = self.model, self.data, 1e-6
        out, beta, after = np.empty_like(q), np.empty_like(q), np.empty(JOINTS)
        for k in range(len(q)):
            data.qpos[:], data.qvel[:] = q[k], v[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_mulM(model, data, out[k], v[k])
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, beta[k])
            data.qpos[:] = q[k] + step * v[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_mulM(model, data, after, v[k])
            beta[k] = (after - out[k]) / step - beta[k]
        return out, beta

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torque [n, 7] of a motion."""
        out = np.empty_like(q)
        for k in range(len(q)):
            self.data.qpos[:], self.data.qvel[:], self.data.qacc[:] = q[k], v[k], a[k]
            mujoco.mj_inverse(self.model, self.data)
            out[k] = self.data.qfrc_inverse
        return out


class Baseline:
    """Fitted to the identification: readings, and the payload as weighed. Attribute `friction` [3, 7]: Fc, Fv, Fo."""

    def __init__(self, arm: Arm, identification: Sequence[tuple[Readings, Payload]]) -> None:
        self.ratio, self.rated = arm.ratio, arm.rated_nm
        self.per_amp = arm.ratio * arm.nominal["torque_constant_nm_per_a"]
        self.rotor = arm.nominal["rotor_kgm2"]
        self.empty = Dynamics(rigid())
        sides = [
            self._sides(readings, Dynamics(rigid(payload=payload))) for readings, payload in identification
        ]
        speed, torque = (np.concatenate(each) for each in zip(*sides, strict=True))
        self.friction = np.zeros((3, JOINTS))
        for j in range(JOINTS):
            moving = np.abs(speed[:, j]) > SLOW_RAD_S
            columns = self._columns(speed[moving, j])
            self.friction[:, j] = np.linalg.lstsq(columns, torque[moving, j], rcond=None)[0]
        residuals = [
            self._residual(readings, Dynamics(rigid(payload=payload))) for readings, payload in identification
        ]
        every = np.concatenate([r[1000:] for r in residuals])
        self.sigma = np.sqrt(np.mean(every * every, axis=0))
        self.threshold = MARGIN * np.abs(every).max(axis=0)

    @staticmethod
    def _columns(v: Array) -> Array:
        return np.stack((np.clip(v / SLOW_RAD_S, -1.0, 1.0), v, np.ones_like(v)), axis=-1)

    def _rubbing(self, v: Array) -> Array:
        return np.asarray(np.einsum("njf,fj->nj", self._columns(v), self.friction))

    def _smooth(self, readings: Readings) -> tuple[Array, Array, Array, Array]:
        """Return q, v, a and motor torque [m, 7], smoothed, every EVERYth cycle."""
        q = readings.motor_rad / self.ratio

        def fitted(x: Array, deriv: int) -> Array:
            return np.asarray(
                savgol_filter(x, SMOOTHED, 3, deriv=deriv, delta=CYCLE_S, axis=0)[SMOOTHED::EVERY]
            )

        return fitted(q, 0), fitted(q, 1), fitted(q, 2), fitted(self.per_amp * readings.current_a, 0)

    def _sides(self, readings: Readings, dynamics: Dynamics) -> tuple[Array, Array]:
        q, v, a, driving = self._smooth(readings)
        return v, driving - self.rotor * a - dynamics.inverse(q, v, a)

    def _residual(self, readings: Readings, dynamics: Dynamics) -> Array:
        """Return r [n, 7], what pushes on the joints."""
        q, v = readings.motor_rad / self.ratio, readings.motor_rad_s / self.ratio
        momentum, beta = dynamics.momentum(q, v)
        momentum += self.rotor * v
        known = self.per_amp * readings.current_a - self._rubbing(v) + beta
        wanted = np.diff(momentum, axis=0, prepend=momentum[:1]) / CYCLE_S - known
        share = 1.0 - np.exp(-GAIN * CYCLE_S)
        return np.asarray(lfilter([share], [1.0, share - 1.0], wanted, axis=0))

    def _payload(self, readings: Readings) -> Payload:
        q, v, a, driving = self._smooth(readings)
        torque = driving - self.rotor * a - self._rubbing(v)
        return fit_payload(lambda payload: rigid(payload=payload), (q, v, a), torque, self.rated)

    def run(self, readings: Readings) -> Published:
        """Return what it publishes of a day."""
        n, learned = len(readings.time_s), round(LEARN_S / CYCLE_S)
        out = nothing(n)
        first = Readings(*(each[:learned] for each in readings))
        payload = self._payload(first)
        residual = self._residual(readings, Dynamics(rigid(payload=payload)))
        residual[:learned] = self._residual(first, self.empty)
        out.external_nm[:], out.sigma_nm[:] = residual, self.sigma
        out.payload_kg[learned:], out.centre_m[learned:] = payload
        beyond = np.abs(residual) > self.threshold
        beyond[:learned] = False
        out.contact[:] = np.where(beyond.any(axis=1), JOINTS - np.argmax(beyond[:, ::-1], axis=1), 0)
        chosen = slice(learned, n)
        jacobian = tool_jacobians(readings.motor_rad[chosen] / self.ratio)
        sigma = np.broadcast_to(self.sigma, residual[chosen].shape)
        information, _ = wrench_information(jacobian, sigma)
        weighted: Any = (residual[chosen] / sigma**2)[:, :, None]
        out.wrench[chosen] = np.linalg.solve(information + 1e-9 * np.eye(6), jacobian @ weighted)[:, :, 0]
        return out


def fit_payload(
    model: Callable[[Payload], Any],
    motion: tuple[Array, Array, Array],
    torque_nm: Array,
    sigma_nm: Array,
    offset: float = 0.0,
) -> Payload:
    """Return the payload that explains torques [n, 7] of a motion q, v, a [n, 7] best: m and m c, of a point at first.

    offset: what is constant in the torques, standard deviation in sigmas [7]; samples of LASTING count as one.
    """
    without, small = Dynamics(model(Payload())).inverse(*motion), 1e-3
    corners = ((0.0, 0.0, 0.0), (small, 0.0, 0.0), (0.0, small, 0.0), (0.0, 0.0, small))
    at = [Dynamics(model(Payload(1.0, corner))).inverse(*motion) - without for corner in corners]
    columns = np.stack([at[0], *((each - at[0]) / small for each in at[1:])], axis=-1)
    constant = np.broadcast_to(np.eye(JOINTS), (*torque_nm.shape, JOINTS)) * offset * sigma_nm
    every = np.concatenate((columns, constant), axis=-1) / sigma_nm[:, None] / np.sqrt(LASTING)
    left = ((torque_nm - without) / sigma_nm / np.sqrt(LASTING)).ravel()
    prior = np.diag([0.0] * 4 + [1.0] * JOINTS)
    x = np.concatenate((every.reshape(-1, 4 + JOINTS), prior))
    found = np.linalg.lstsq(x, np.concatenate((left, np.zeros(len(prior)))), rcond=None)[0]
    mass = max(float(found[0]), 0.0)
    centre = np.clip(found[1:4] / max(mass, 0.1), -0.3, 0.3)
    return Payload(mass, (float(centre[0]), float(centre[1]), float(centre[2])))


def best_payload(arm: Arm, truth: Truth, readings: Readings, plant: str) -> Payload:
    """Return the payload that the joints' torques of the first LEARN_S tell to who has the true model and motion."""
    learned = round(LEARN_S / CYCLE_S)

    def fitted(x: Array, deriv: int = 0) -> Array:
        smooth = savgol_filter(x[:learned], SMOOTHED, 3, deriv, CYCLE_S, axis=0, mode="nearest")
        return np.asarray(smooth[SMOOTHED:-SMOOTHED:EVERY])

    torque, sigma = fitted(readings.torque_nm), np.nanmean(readings.sigma_nm[:learned], axis=0)
    known = np.isfinite(torque).all(axis=1)
    q, v, a = fitted(truth.link_rad), fitted(truth.link_rad_s), fitted(truth.link_rad_s, 1)
    parts = ERRORS[plant][1]
    return fit_payload(
        arm.model, (q[known], v[known], a[known]), torque[known], sigma, float(np.sqrt(parts[0] + parts[2]))
    )
