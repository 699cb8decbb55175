"""Contact: whether something pushes, since when, on which link, where and how strongly.

What free motion leaves changes little within a short time and more within a long one (its structure function). A contact
is a change that free motion does not make: within FAST_S, within SLOW_S, or from zero for a hand that leans. Each is a
chi-square of the joints; one quantile decides.

Where it is: each point of the links' surface (`model.Surface`) is a hypothesis with a force that pushes into it within a
cone of friction. The marginal likelihood of the joints' torques weighs them (Bayes' rule).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from jtqd.daemon.arm.filtering import acceleration_gain
from jtqd.daemon.arm.model import ArmModel, Array

FAST_S, SLOW_S = 0.04, 0.3
SMOOTH_S: Final = (0.0, 0.03, 0.1)
"""Of the three tests: time constants by which residuals are smoothed."""
BEGINS, LASTS = 5.0, 2.0
"""Standard normal quantiles at which a contact begins, and below which it ends."""
ENDED_S: Final = 0.03
LONG_S: Final = 1.0
"""After this time zero tells more of what is there without contact than what was there before."""
SIDEWAYS: Final = 0.25
"""Of a force: standard deviation along the surface, as a share of that into it (friction)."""
STRONG_N: Final = 40.0
"""Of forces into a surface: standard deviation of the prior."""


def motion_gains(period_s: float) -> Array:
    """Return the variances [4] that a white noise of one radian in positions has in an acceleration, in its changes within
    FAST_S and SLOW_S, and smoothed for the level."""
    response = acceleration_gain(period_s)
    found = [float(response @ response)]
    for smooth_s, lag_s in zip(SMOOTH_S, (FAST_S, SLOW_S, None), strict=True):
        keep = math.exp(-period_s / smooth_s) if smooth_s else 0.0
        total, state = 0.0, 0.0
        for each in (*response, *[0.0] * math.ceil(8.0 * smooth_s / period_s)):
            state = keep * state + (1.0 - keep) * each
            total += state * state
        found.append(total if lag_s is None else 2.0 * total)
    return np.array(found)


def quantile(freedom: float, normal: float) -> float:
    """Return the quantile of a chi-square by a normal one (Wilson, Hilferty 1931): at 5 sigma and one joint 17 % large."""
    part = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - part + normal * part**0.5) ** 3)


def _beyond_by(x: Array, weight: Array, more: Array) -> float:
    """Return x' S^-1 x, S = diag(1/weight) + more."""
    spread = np.diag(1.0 / np.maximum(weight, 1e-12)) + more
    return float(x @ np.linalg.solve(spread, x))


class Place(NamedTuple):
    """Where something pushes: link 1..n, point in its frame and how far it may be off, force [3] in base axes."""

    link: int
    point_m: Array
    point_sigma_m: float
    force_n: Array


class Detector:
    """Tests of residuals [n] of every cycle. spread [3, n]: standard deviations of the tests in free motion, in sigmas."""

    def __init__(self, n: int, period_s: float, spread: Array) -> None:
        self.certain = 1.0 / np.asarray(spread, float) ** 2
        self.lags = tuple(round(each / period_s) for each in (FAST_S, SLOW_S))
        self.length = self.lags[1] + 1
        self.needed = np.array([*self.lags, 0])[:, None]
        self.keep = np.array([math.exp(-period_s / t) if t else 0.0 for t in SMOOTH_S])[:, None]
        self.share = 1.0 - self.keep
        self.limits = [math.inf, *(quantile(freedom, BEGINS) for freedom in range(1, n + 1))]
        self.history = np.zeros((2, self.length, n))
        self.ending, self.long = round(ENDED_S / period_s), round(LONG_S / period_s)
        self.smooth = np.zeros((3, n))
        self.at = -1
        self.seen = np.zeros(n, np.intp)
        self.whole = False
        self.since = -1
        self.below = 0
        self.sudden = False
        """Whether the change came within FAST_S: else what was before may have been part of it."""
        self.reference = np.zeros(n)
        self.cycle = -1

    def forget(self) -> None:
        """Forget what was before."""
        self.seen[:] = 0
        self.whole = False

    def shift(self, by: Array) -> None:
        """Take all residuals of before as larger by `by` [n]: what is believed of payload and offsets has changed."""
        self.smooth += by
        self.history += by

    def add(self, residual: Array, variance: Array, belief: Array) -> bool:
        """Take residuals [n], NaN for none, and variances of the joints [n]; return whether there is contact.

        belief [3, n, n]: covariances that what is believed of payload and offsets, and noise of positions, add to the tests.
        """
        self.cycle += 1
        freedom, x, weight = len(residual), residual, 1.0 / variance
        if self.whole and math.isfinite(x @ weight):
            self.seen += 1
        else:
            there = np.isfinite(residual)
            x, weight = np.where(there, x, 0.0), np.where(there, weight, 0.0)
            fresh = self.seen == 0
            self.smooth[:, fresh] = x[fresh]
            self.seen = (self.seen + 1) * there
            freedom = int(there.sum())
            self.whole = freedom == len(residual)
        self.smooth = self.keep * self.smooth + self.share * x
        self.at = (self.at + 1) % self.length
        self.history[:, self.at] = self.smooth[:2]
        if self.since >= 0:
            return self._goes_on(weight, belief, freedom)
        tests, known = self.tests()
        weights = self.certain * weight * known
        sizes = (tests * tests * weights).sum(axis=1)
        limit = self.limits[freedom]
        if sizes.max() <= limit:  # beliefs can only make it less
            return False
        for k in np.flatnonzero(sizes > limit):
            if _beyond_by(tests[k], weights[k], belief[k]) > limit:
                self.sudden = k == 0
                self.reference = self.smooth[k] - tests[k]
                self.since, self.below = self.cycle - (*self.lags, self.lags[1])[k], 0
                return True
        return False

    def tests(self) -> tuple[Array, Array]:
        """Return changes within FAST_S and SLOW_S and the level, and which of them are known [3, n]."""
        values = self.smooth.copy()
        for k, lag in enumerate(self.lags):
            values[k] -= self.history[k, self.at - lag]  # from the end where it is negative
        return values, self.seen > self.needed

    def change(self) -> Array:
        """Return what has come with the contact [n]."""
        return np.asarray(self.smooth[1] - self.reference)

    def _goes_on(self, weight: Array, belief: Array, freedom: int) -> bool:
        if not freedom:  # it goes on when something is known again, or ends
            return False
        weights = self.certain[1] * weight
        level, least = _beyond_by(self.smooth[1], weights, belief[2]), quantile(freedom, LASTS)
        much = level > (self.limits[freedom] if self.sudden else least)
        if not much and self.sudden:
            much = _beyond_by(self.change(), weights, belief[1]) > least
            self.sudden = self.cycle - self.since < self.long
        self.below = 0 if much else self.below + 1
        if self.below > self.ending:
            self.end()
            return False
        return True

    def end(self) -> None:
        """End the contact; changes count from here."""
        self.since = -1
        self.forget()


def place(model: ArmModel, change: Array, variance: Array) -> Place | None:
    """Return where a change of the joints' torques [n] of these variances [n] comes from; None where no point explains it.

    Places and Jacobians of the pose are those of the last `model.place`.
    """
    if not len(model.surface.link):
        return None
    jacobian, normal = model.surface_jacobians()
    root = 1.0 / np.sqrt(variance)
    z = change * root
    tall = jacobian * root[None, :, None]
    inward = np.einsum("pnk,pk->pn", tall, -normal)
    power = np.einsum("pn,pn->p", inward, inward)
    along = np.einsum("pn,n->p", inward, z) / (power + 1.0 / STRONG_N**2)
    pushes = along > 0.0
    if not pushes.any():
        return None
    jacobian, normal, tall, along = tall[pushes], normal[pushes], tall[pushes], along[pushes]
    side = (SIDEWAYS * np.maximum(along, 1.0)) ** 2
    # prior covariance of the force: STRONG_N along the normal, `side` along the surface
    across = normal[:, :, None] * normal[:, None, :]
    certain = np.eye(3) / side[:, None, None] + (STRONG_N**-2 - 1.0 / side)[:, None, None] * across
    one, two, three = np.moveaxis(certain + tall.transpose(0, 2, 1) @ tall, 1, 0)
    crosses = np.stack((np.cross(two, three), np.cross(three, one), np.cross(one, two)), axis=2)
    determinant = np.einsum("pi,pi->p", one, crosses[:, :, 0])
    pull = np.einsum("pnk,n->pk", tall, z)
    force = np.einsum("pij,pj->pi", crosses, pull) / determinant[:, None]
    fit = np.einsum("pi,pi->p", pull, force)
    size = np.log(determinant * side * side)
    weight = 0.5 * (fit - size)
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    links = model.surface.link[pushes]
    share = np.bincount(links, weight, model.n + 1)
    link = int(np.argmax(share))
    own = np.where(links == link, weight, 0.0) / share[link]
    points = model.surface.point_m[pushes]
    point = own @ points
    off = float(np.sqrt(own @ ((points - point) ** 2).sum(axis=1)))
    return Place(link, point, off, np.asarray(own @ force))
