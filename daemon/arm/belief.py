"""What is believed of a day: the payload at the tool and the constant parts of the joints' errors, by Bayes' rule.

A residual without contact is H x + e with x = (m, m c, offsets) and H = (-dtau/d(m, m c), 1); e is noise whose values within
LASTING_S are one. A contact takes back what was learned in the BACK_S before it was found, and nothing is learned under it.
But where one payload explains SPAN_S of motion as well as free motion is explained, that payload has come.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from jtqd.daemon.arm.model import Array, Payload

HEAVIEST_KG, FAR_M = 5.0, 0.15
"""Standard deviations of what is believed of a payload before it moves: mass, each coordinate of its centre."""
LEARNS_S: Final = 0.05
BACK_S: Final = 1.0
LASTING_S: Final = 0.5
DRIFT_S: Final = 600.0
"""In this time an offset changes by as much as it is on a new day."""
SPAN_S, EXPLAINED = 5.0, 1.5
"""A payload has come where motion of this length leaves at most so many times its variance."""


class Observation(NamedTuple):
    """One cycle: when [s], residual [n] of the arm without payload, H [n, 4 + n], variances [n]."""

    time_s: float
    bare: Array
    columns: Array
    variance: Array


class Belief:
    """Mean and covariance of x [4 + n]. payload: known, None to learn it."""

    def __init__(self, n: int, payload: Payload | None) -> None:
        self.n, self.known = n, payload
        self.mean, self.covariance = np.zeros(4 + n), np.zeros((4 + n, 4 + n))
        self.day = np.zeros(n)
        self.past: deque[tuple[float, Array, Array]] = deque()
        self.in_contact: deque[Observation] = deque(maxlen=round(2.0 * SPAN_S / LEARNS_S))
        self.forget_payload()

    def begin(self, variance: Array) -> None:
        """Believe of offsets [n] that they are as large as on any day, once for each joint; NaN: not known yet."""
        fresh = (self.day == 0.0) & np.isfinite(variance)
        if fresh.any():
            self.day = np.where(fresh, variance, self.day)
            self.covariance = self.covariance + np.diag(
                np.concatenate((np.zeros(4), np.where(fresh, variance, 0.0)))
            )

    def forget_payload(self) -> None:
        """Believe that anything may hang at the tool."""
        self.covariance[:4, :], self.covariance[:, :4] = 0.0, 0.0
        self.mean[:4] = 0.0
        if self.known is None:
            self.covariance[:4, :4] = np.diag([HEAVIEST_KG**2, *[(FAR_M * HEAVIEST_KG) ** 2] * 3])
        else:
            self.mean[:4] = self.known.mass_kg, *(self.known.mass_kg * np.array(self.known.centre_m))
        self.past.clear()
        self.in_contact.clear()
        self._hang()

    def _hang(self) -> None:
        mass = max(float(self.mean[0]), 0.0)
        centre = np.clip(self.mean[1:4] / max(mass, 0.1), -0.5, 0.5)
        self.payload = Payload(mass, (float(centre[0]), float(centre[1]), float(centre[2])))
        self.hung = np.concatenate(([mass], mass * centre, self.mean[4:]))
        """x as it acts: of masses that can be."""
        self.sigma_kg = float(np.sqrt(self.covariance[0, 0]))

    def learn(self, seen: Observation) -> None:
        """Learn one cycle of motion without contact."""
        self.in_contact.clear()
        self.past.append((seen.time_s, self.mean, self.covariance))
        while len(self.past) > 1 and self.past[1][0] <= seen.time_s - BACK_S:
            self.past.popleft()
        offsets = np.diag(np.concatenate((np.zeros(4), self.day * (LEARNS_S / DRIFT_S))))
        self.covariance = self.covariance + offsets
        self._update(seen)
        self._hang()

    def is_payload(self, seen: Observation) -> bool:
        """Take one cycle of motion under contact; return whether another payload, now believed, explains the contact."""
        if self.past:
            _, self.mean, self.covariance = self.past[0]
            self.past.clear()
            self._hang()
        if self.known is not None:
            return False
        self.in_contact.append(seen)
        if len(self.in_contact) * LEARNS_S < SPAN_S or len(self.in_contact) % round(1.0 / LEARNS_S):
            return False
        return self._explained()

    def _explained(self) -> bool:
        other = Belief(self.n, None)
        other.mean[4:], other.covariance[4:, 4:] = self.mean[4:], self.covariance[4:, 4:]
        for each in self.in_contact:
            other._update(each)
        left = [(each.bare - each.columns @ other.mean) ** 2 / each.variance for each in self.in_contact]
        if not np.nanmean(left) < EXPLAINED:
            return False
        self.mean, self.covariance = other.mean, other.covariance
        self.in_contact.clear()
        self._hang()
        return True

    def _update(self, seen: Observation) -> None:
        """Take one cycle by Kalman's equations; joints without a torque have no part."""
        there = np.isfinite(seen.bare * seen.variance)
        h = seen.columns[there]
        spread = h @ self.covariance @ h.T + np.diag(seen.variance[there] * (LASTING_S / LEARNS_S))
        gain = np.linalg.solve(spread, h @ self.covariance).T
        self.mean = self.mean + gain @ (seen.bare[there] - h @ self.mean)
        covariance = self.covariance - gain @ h @ self.covariance
        self.covariance = 0.5 * (covariance + covariance.T)
