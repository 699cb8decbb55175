"""External torque of an arm, cycle by cycle: what pushes on the joints, the wrench at the tool, the payload, contact.

Pure: arrays in, `ArmEstimate` out; no clock, file or socket.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from jtqd.daemon.arm.belief import LEARNS_S, Belief, Observation
from jtqd.daemon.arm.contact import FAST_S, SLOW_S, Detector, Place, motion_gains, place
from jtqd.daemon.arm.filtering import Filtered
from jtqd.daemon.arm.model import ArmModel, Array, Payload

MOVES_RAD_S: Final = 0.05
"""Below this speed of all joints nothing is learned: an error that belongs to a pose is not one of the day."""
CONDITIONED: Final = 30.0
"""A wrench is published where the pose makes no way of pushing so many times less certain than another."""
SCALE_M: Final = 0.25
"""Torques of a wrench count as forces at this distance."""
FASTEST_RAD_S: Final = 50.0
"""A position that has gone farther in a cycle has gone nowhere: it has another zero, or lacks a turn."""
PLACES_S: Final = 0.02
WRENCH_S: Final = 0.005
"""Between two poses at which the wrench's matrix is computed."""
NOWHERE: Final = Place(0, np.full(3, np.nan), np.nan, np.full(3, np.nan))


class ArmEstimate(NamedTuple):
    """What is known after a cycle; NaN where it is not. n joints.

    external_nm, sigma_nm [n]: what pushes on each joint. wrench [6]: force and torque about the tool's origin, base axes, on
    the arm; wrench_sigma [6]; conditioning: of the pose. payload_kg, payload_sigma_kg, centre_m [3] in the tool's frame.
    contact: link 1..n or 0; strength_n; since_cycle: first cycle of the contact; point_m [3] in the frame of that link,
    point_sigma_m.
    """

    external_nm: Array
    sigma_nm: Array
    wrench: Array
    wrench_sigma: Array
    conditioning: float
    payload_kg: float
    payload_sigma_kg: float
    centre_m: Array
    contact: int
    strength_n: float
    since_cycle: int
    point_m: Array
    point_sigma_m: float


class ArmNoise(NamedTuple):
    """What free motion leaves of the external torque, in sigmas of each joint's torque (`jtq fit arm`).

    total [n]: standard deviation. offset: of what is constant in a run. tests [3, n]: of the tests of `contact.Detector`.
    position_rad [n]: white noise of the positions, which acts through the arm's inertia and is in none of the others.
    """

    total: Array
    offset: float
    tests: Array
    position_rad: Array

    @classmethod
    def unknown(cls, n: int) -> ArmNoise:
        """Return what holds before any fit: errors as large as the sigmas, and the model's own as large again."""
        return cls(np.full(n, 1.5), 1.0, np.full((3, n), 1.5), np.full(n, 1e-5))


class ArmEstimator:
    """Estimates of one arm. period_s: between cycles. payload: known, None to learn it."""

    def __init__(
        self, model: ArmModel, period_s: float, noise: ArmNoise | None = None, payload: Payload | None = None
    ) -> None:
        self.model, self.period_s = model, period_s
        self.noise = ArmNoise.unknown(model.n) if noise is None else noise
        self.every, self.placing, self.wrenching = (
            max(1, round(each / period_s)) for each in (LEARNS_S, PLACES_S, WRENCH_S)
        )
        self.conditioning = math.inf
        self.to_wrench, self.wrench_sigma = np.full((6, model.n), np.nan), np.full(6, np.nan)
        self.cycle, n = -1, model.n
        self.position = np.full(n, np.nan)
        self.filtered = Filtered(n, period_s)
        self.motion = motion_gains(period_s)[:, None, None]
        self.shaken = np.zeros(n)
        self.detector = Detector(n, period_s, self.noise.tests)
        self.found: Place | None = None
        self.belief = Belief(n, payload)
        self.forget_payload()

    def forget_payload(self) -> None:
        """Learn the payload from the beginning: a gripper has taken or left something."""
        n = self.model.n
        self.belief.forget_payload()
        self.columns = np.concatenate((np.zeros((n, 4)), np.eye(n)), axis=1)
        self.uncertainty = np.zeros((3, n, n))
        self.uncertain = np.zeros(n)
        self.before = deque([self.columns[:, :4]], maxlen=1 + round(SLOW_S / LEARNS_S))
        self._hang()

    def _hang(self) -> None:
        self.model.set_payload(self.belief.payload)
        self.centre = np.array(self.belief.payload.centre_m)

    def step(self, position_rad: Array, torque_nm: Array, sigma_nm: Array) -> ArmEstimate:
        """Take positions, drive-side torques and their sigmas [n] of one cycle (NaN: none); return what is known after it.

        A position that is missing, or jumps, makes everything missing; the filter starts again with the next. A torque
        counts with a sigma that is > 0.
        """
        self.cycle += 1
        model = self.model
        before, self.position = self.position, position_rad
        way = float(np.abs(position_rad - before).max())  # NaN after a gap, and in one
        if way > FASTEST_RAD_S * self.period_s or (way != way and not math.isfinite(position_rad.sum())):  # noqa: PLR0124
            self.filtered = Filtered(model.n, self.period_s)
            self.detector.forget()
            return self._nothing()
        known = (sigma_nm > 1e-9) & (sigma_nm < 1e9)
        if not known.all():
            torque_nm, sigma_nm = np.where(known, torque_nm, np.nan), np.where(known, sigma_nm, np.nan)
        self.filtered.add(position_rad, torque_nm)
        q, v, a = self.filtered.motion()
        raw = model.torque(q, v, a) - self.filtered.torques()
        variance = sigma_nm * sigma_nm
        belief = self.belief
        learning = self.cycle % self.every == 0
        if learning:
            belief.begin(self.noise.offset**2 * variance)
            self._believe(-model.of_payload(q, v, a), model.inertia(q))
        residual = raw - belief.hung[4:]
        total = self.noise.total**2 * variance
        contact = self.detector.add(residual, variance, self.uncertainty)
        if learning:
            contact = self._learn(raw, v, total + self.shaken, contact)
        if not contact:
            self.found = None
        elif self.found is None or self.cycle % self.placing == 0:
            model.place(q)
            self.found = self._name(variance)
        spread = total + self.uncertain
        wrench = self.to_wrench @ residual
        others = self.conditioning <= CONDITIONED and not math.isfinite(wrench[0])  # are felt than before
        if self.cycle % self.wrenching == 0 or others:
            model.place(q)
            wrench = self._solve_wrench(residual, spread)
        found = NOWHERE if self.found is None else self.found
        return ArmEstimate(
            residual,
            np.sqrt(spread),
            wrench,
            self.wrench_sigma,
            self.conditioning,
            belief.payload.mass_kg,
            belief.sigma_kg,
            self.centre,
            found.link,
            math.hypot(*found.force_n),
            self.detector.since,
            found.point_m,
            found.point_sigma_m,
        )

    def _believe(self, payload: Array, inertia: Array) -> None:
        """Compute what beliefs and noise of positions add to residuals and to their changes; payload [n, 4]: its columns."""
        root = inertia * self.noise.position_rad
        shaken = self.motion * (root @ root.T)
        self.shaken = np.diag(shaken[0])
        self.columns[:, :4] = payload
        self.before.append(payload)
        covariance = self.belief.covariance
        for k, lag_s in enumerate((FAST_S, SLOW_S)):
            change = payload - self.before[max(-1 - round(lag_s / LEARNS_S), -len(self.before))]
            self.uncertainty[k] = change @ covariance[:4, :4] @ change.T
        self.uncertainty[2] = self.columns @ covariance @ self.columns.T
        self.uncertain = np.diag(self.uncertainty[2]) + self.shaken
        self.uncertainty += shaken[1:]

    def _name(self, variance: Array) -> Place:
        change = self.detector.change()
        spread = variance / self.detector.certain[1]
        there = np.isfinite(spread)
        found = place(self.model, np.where(there, change, 0.0), np.where(there, spread, 1e12))
        if found is None:  # no shapes: the last joint that feels it
            felt = np.abs(change) > 3.0 * np.sqrt(np.where(there, spread, np.inf))
            found = NOWHERE._replace(link=int(np.max(np.flatnonzero(felt), initial=0)) + 1)
        return found

    def _solve_wrench(self, residual: Array, spread: Array) -> Array:
        """Return the tool's wrench [6] by least squares in the sigmas; the matrix that gives it serves the next cycles."""
        jacobian = self.model.tool_jacobian()
        there = np.isfinite(residual * spread)
        weight = np.where(there, 1.0 / np.sqrt(spread), 0.0)
        white = jacobian * weight
        information = white @ white.T
        values = np.linalg.eigvalsh(information * self._scales)
        self.conditioning = math.sqrt(values[-1] / values[0]) if values[0] > 0.0 else math.inf
        if self.conditioning <= CONDITIONED:
            covariance = np.linalg.inv(information)
            self.to_wrench, self.wrench_sigma = covariance @ (white * weight), np.sqrt(np.diag(covariance))
        else:
            self.to_wrench, self.wrench_sigma = np.full((6, self.model.n), np.nan), np.full(6, np.nan)
        return self.to_wrench @ np.where(there, residual, 0.0)

    _scales: Final = np.outer(*[np.array([1.0, 1.0, 1.0, SCALE_M, SCALE_M, SCALE_M])] * 2)

    def _learn(self, raw: Array, v: Array, variance: Array, contact: bool) -> bool:
        """Give a cycle of motion to the belief, and take what it has learned; return whether there still is contact."""
        belief, detector = self.belief, self.detector
        if np.abs(v).max() <= MOVES_RAD_S:
            return contact
        bare = raw + self.columns[:, :4] @ belief.hung[:4]
        seen, before = (
            Observation(self.cycle * self.period_s, bare, self.columns.copy(), variance),
            belief.hung,
        )
        if not contact:
            belief.learn(seen)
        elif belief.is_payload(seen):
            detector.end()
            contact = False
        if belief.hung is not before:
            self._hang()
            shift = -self.columns @ (belief.hung - before)
            detector.shift(shift)
            if (shift * shift > variance).any():  # what was before was of other poses
                detector.forget()
        return contact

    def _nothing(self) -> ArmEstimate:
        nan = math.nan
        joints, six, three = (np.full(count, nan) for count in (self.model.n, 6, 3))
        return ArmEstimate(joints, joints, six, six, nan, nan, nan, three, 0, nan, -1, three, nan)
