"""One filter for all that is compared: position, speed, acceleration and torque are equally old.

Three equal poles F(s) = 1/(1 + s T)^3. What a motion needs, computed from F q, F dq/dt and F d2q/dt2, less F tau, is what a
momentum observer of third order gives for the external torque as long as the pose changes little within 3 T.

Differences of the poles' states are backward differences: an acceleration is one period older than a position. Position and
torque are delayed by that period, speed by half of it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

Array = np.ndarray
LAG_S: Final = 0.004
"""T."""


class Filtered:
    """Positions and torques [n] of every cycle through F. A torque that is missing is missing until F has settled again."""

    def __init__(self, n: int, period_s: float) -> None:
        keep = math.exp(-period_s / LAG_S)
        share = 1.0 - keep
        self.n = n
        self.lag_s = period_s * keep / share
        # the poles follow each other within a period: x0 = k x0 + s u, x1 = k x1 + s x0, x2 = k x2 + s x1
        self.steps = np.array(
            [[keep, 0.0, 0.0], [share * keep, keep, 0.0], [share**2 * keep, share * keep, keep]]
        )
        self.enters = np.array([[share], [share**2], [share**3]])
        self.settled = math.ceil(6.0 * LAG_S / period_s)
        self.waits = math.ceil(15.0 * LAG_S / period_s)
        """Cycles until positions that began in motion are settled."""
        self.poles = np.zeros((3, 2 * n))
        self.input = np.zeros(2 * n)
        self.last = np.full(n, np.nan)
        self.before = self.poles
        self.seen = np.zeros(n, np.intp)
        self.whole = 0
        """Cycles in a row in which all torques were there and settled."""
        self.started = False

    def add(self, position: Array, torque: Array) -> None:
        """Take one cycle; positions must be there, a torque may be NaN."""
        n = self.n
        if not self.started:
            self.poles[:, :n] = position
            self.started = True
        torque, self.last = self.last, torque
        self.waits -= 1
        if self.whole and math.isfinite(torque.sum()):
            self.input[n:] = torque
            self.whole += 1
        else:
            self._add_some(torque)
        self.input[:n] = position
        self.before = self.poles
        self.poles = self.steps @ self.poles + self.enters * self.input

    def _add_some(self, torque: Array) -> None:
        """Take torques of which some are missing, or were missing before."""
        there = np.isfinite(torque)
        fresh = there & (self.seen == 0)
        self.poles[:, self.n :][:, fresh] = torque[fresh]
        self.input[self.n :] = np.where(there, torque, 0.0)
        self.seen = (self.seen + 1) * there
        self.whole = int(self.seen.min() > self.settled)

    def motion(self) -> tuple[Array, Array, Array]:
        """Return position, speed and acceleration [n]."""
        n, lag = self.n, self.lag_s
        first, second, third = self.poles[:, :n]
        _, one, two = self.before[:, :n]
        slope = second - third
        return two, (0.5 / lag) * (slope + one - two), (first - second - slope) / (lag * lag)

    def torques(self) -> Array:
        """Return the torques [n]; NaN where they are not there or not settled."""
        if self.whole and self.waits <= 0 and math.isfinite(self.last.sum()):
            return self.poles[2, self.n :]
        known = (self.seen > self.settled) & np.isfinite(self.last) & (self.waits <= 0)
        return np.where(known, self.poles[2, self.n :], np.nan)


def acceleration_gain(period_s: float) -> Array:
    """Return the acceleration's response [m] to a position of one at one instant [1/s2]."""
    filtered = Filtered(1, period_s)
    filtered.add(np.zeros(1), np.zeros(1))
    found = []
    for k in range(20 * math.ceil(LAG_S / period_s)):
        filtered.add(np.array([float(k == 0)]), np.zeros(1))
        found.append(filtered.motion()[2][0])
    return np.array(found)
