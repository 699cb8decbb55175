"""Inertial parameters of an arm from its own motion, by Bayes' rule and physically consistent.

Torques are linear in the parameters theta of the links: torque = Y(q, v, a) theta (Atkeson, An, Hollerbach 1986), and each
run has an offset per joint of its own. A link is m = m0 exp(s), c = c0 + d, S = exp(s) L exp(E) L' with the second moments S
about its centre: every x = (s, d, E) is a body that can exist (Wensing, Kim, Slotine 2018). CAD values are the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.daemon.arm.belief import LASTING_S
from jtqd.daemon.arm.estimator import ArmEstimator, ArmNoise
from jtqd.daemon.arm.filtering import Filtered
from jtqd.daemon.arm.model import INERTIAL, ArmModel, Array, Payload

MASS: Final = 0.10
CENTRE_M: Final = 0.01
SHAPE: Final = 0.2
"""Standard deviations of CAD values: mass as a share, each coordinate of a centre, second moments as a share."""
DEVIATION: Final = np.array([MASS, *[CENTRE_M] * 3, *[SHAPE] * 6])
EVERY_S: Final = 0.02
SKIPPED_S: Final = 0.1
DETERMINED: Final = 0.7
"""A value is from the motion where its standard deviation is below this share of the prior's."""
STEPS: Final = 20
LEARNED_S: Final = 10.0
"""From here on a run counts for what free motion leaves."""
NEVER: Final = 1e6
LEAST: Final = 0.1
"""Of what free motion leaves, in sigmas: a few runs may leave less by chance."""


class FreeMotion(NamedTuple):
    """A run without contact: positions, torques and their sigmas [m, n] every period, and what hung at the tool."""

    period_s: float
    position_rad: Array
    torque_nm: Array
    sigma_nm: Array
    payload: Payload = Payload()


class Normal(NamedTuple):
    """Normal equations of a run, by joint, its offset marginalised: sums of Y'Y [n, s, s], Y'y [n, s], y'y [n]; s = 10 n.

    samples [n]: that stand for themselves; sigma_nm [n]: of the joints.
    """

    information: Array
    pull: Array
    square: Array
    samples: Array
    sigma_nm: Array

    def left_nm(self, inertial: Array) -> Array:
        """Return the rms [n] of what parameters leave of the run's torques, beside its offsets."""
        theta = inertial.ravel()
        square = (
            self.square - 2.0 * self.pull @ theta + np.einsum("i,nij,j->n", theta, self.information, theta)
        )
        return np.asarray(self.sigma_nm * np.sqrt(np.maximum(square, 0.0) / np.maximum(self.samples, 1e-9)))


class Identified(NamedTuple):
    """Inertial parameters [n, 10]; standard deviations of x as shares of the prior's [n, 10] (see DETERMINED)."""

    inertial: Array
    relative: Array


class Body:
    """A link: theta of x. theta: that of CAD, at x = 0; moments that no body has become moments that one has."""

    def __init__(self, theta: Array) -> None:
        self.mass = max(float(theta[0]), 1e-9)
        self.centre = theta[1:4] / self.mass
        about = _matrix(theta[4:]) + self.mass * _twice_crossed(self.centre)
        values, vectors = np.linalg.eigh(0.5 * np.trace(about) * np.eye(3) - about)
        least = 1e-4 * max(float(values[-1]), self.mass * 1e-4)
        self.root = vectors * np.sqrt(np.maximum(values, least))

    def theta(self, x: Array) -> Array:
        """Return the inertial parameters [10] of x [10]."""
        scale = np.exp(x[0])
        mass, centre = self.mass * scale, self.centre + x[1:4]
        values, vectors = np.linalg.eigh(_matrix(x[4:]))
        second = scale * self.root @ (vectors * np.exp(values)) @ vectors.T @ self.root.T
        about = np.trace(second) * np.eye(3) - second - mass * _twice_crossed(centre)
        return np.array([mass, *(mass * centre), *about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])

    def slope(self, x: Array) -> Array:
        """Return d theta / dx [10, 10]."""
        step = 1e-5
        ways = step * np.eye(INERTIAL)
        return np.stack([(self.theta(x + way) - self.theta(x - way)) / (2.0 * step) for way in ways], axis=1)


def _matrix(six: Array) -> Array:
    xx, xy, yy, xz, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _twice_crossed(c: Array) -> Array:
    """Return the matrix of c x (c x .)."""
    return np.outer(c, c) - float(c @ c) * np.eye(3)


def identify(model: ArmModel, normals: Sequence[Normal]) -> Identified:
    """Return what runs tell of the links; `model` has the CAD values and stays as it is (Gauss-Newton)."""
    size = INERTIAL * model.n
    information = np.sum([each.information.sum(axis=0) for each in normals], axis=0)
    pull = np.sum([each.pull.sum(axis=0) for each in normals], axis=0)
    bodies = [Body(each) for each in model.inertial()]
    deviation = np.tile(DEVIATION, model.n)
    prior = np.diag(1.0 / deviation**2)
    x = np.zeros(size)
    for _ in range(STEPS):
        theta, slope = np.zeros(size), np.zeros((size, size))
        for k, body in enumerate(bodies):
            at = slice(INERTIAL * k, INERTIAL * (k + 1))
            theta[at], slope[at, at] = body.theta(x[at]), body.slope(x[at])
        curvature = slope.T @ information @ slope + prior
        step = np.linalg.solve(curvature, slope.T @ (pull - information @ theta) - prior @ x)
        x = x + step
        if np.abs(step / deviation).max() < 1e-6:
            break
    parts = x.reshape(model.n, INERTIAL)
    inertial = np.stack([body.theta(part) for body, part in zip(bodies, parts, strict=True)])
    spread = np.sqrt(np.diag(np.linalg.inv(curvature))) / deviation
    return Identified(inertial, spread.reshape(model.n, INERTIAL))


def normal_of(model: ArmModel, run: FreeMotion) -> Normal:
    """Return the normal equations of a run; offsets are as large as the joints' sigmas."""
    n, size = model.n, INERTIAL * model.n
    filtered = Filtered(n, run.period_s)
    every, skipped = max(1, round(EVERY_S / run.period_s)), round(SKIPPED_S / run.period_s)
    hidden = np.zeros(size)
    first = INERTIAL * (model.tool_joint - 1)
    hidden[first : first + INERTIAL] = model.payload_parameters(run.payload)
    tables, lefts = [], []
    for k in range(len(run.position_rad)):
        filtered.add(run.position_rad[k], run.torque_nm[k])
        if k < skipped or k % every:
            continue
        columns = model.regressor(*filtered.motion())
        weight = 1.0 / (run.sigma_nm[k] * np.sqrt(LASTING_S / EVERY_S))
        left = (filtered.torques() - columns @ hidden) * weight
        there = np.isfinite(left)
        weight = np.where(there, weight, 0.0)
        constant = np.where(there, run.sigma_nm[k] * weight, 0.0)
        tables.append(np.concatenate((columns * weight[:, None], constant[:, None]), axis=1))
        lefts.append(np.where(there, left, 0.0))
    table, y = np.stack(tables), np.stack(lefts)  # [m, n, s + 1], [m, n]
    whole = np.einsum("mni,mnj->nij", table, table, optimize=True)
    pull = np.einsum("mni,mn->ni", table, y)
    inner = 1.0 / (whole[:, -1, -1] + 1.0)
    cross = whole[:, :-1, -1]
    return Normal(
        whole[:, :-1, :-1] - inner[:, None, None] * cross[:, :, None] * cross[:, None, :],
        pull[:, :-1] - (inner * pull[:, -1])[:, None] * cross,
        (y * y).sum(axis=0) - inner * pull[:, -1] ** 2,
        (table[:, :, -1] ** 2).sum(axis=0),
        np.sqrt(np.nanmean(run.sigma_nm**2, axis=0)),
    )


def noise_of(model: ArmModel, runs: Sequence[FreeMotion]) -> ArmNoise:
    """Return what runs leave of the external torque, each as the estimator sees a day with a payload that it knows."""
    n = model.n
    squares, counts, offsets = np.zeros((4, n)), np.zeros((4, n)), []
    position = np.sqrt(np.mean([_white(run.position_rad) for run in runs], axis=0))
    blind = ArmNoise(np.ones(n), 1.0, np.full((3, n), NEVER), position)
    for run in runs:
        estimator = ArmEstimator(model, run.period_s, blind, run.payload)
        first = round(LEARNED_S / run.period_s)
        for k in range(len(run.position_rad)):
            sigma = run.sigma_nm[k]
            estimate = estimator.step(run.position_rad[k], run.torque_nm[k], sigma)
            if k < first or k % 5:
                continue
            tests, known = estimator.detector.tests()
            there = np.isfinite(estimate.external_nm * sigma)
            every = [(estimate.external_nm, there), *zip(tests, known & there, strict=True)]
            shaken = estimator.shaken * (estimator.motion / estimator.motion[0])[:, 0]
            for row, (each, seen) in enumerate(every):
                squares[row] += np.where(seen, (each * each - shaken[row]) / sigma**2, 0.0)
                counts[row] += seen
        offsets.append(estimator.belief.mean[4:] / np.sqrt(np.maximum(estimator.belief.day, 1e-12)))
    root = np.sqrt(np.maximum(squares / np.maximum(counts, 1), LEAST**2))
    unknown = ArmNoise.unknown(n)  # runs that are too short, or a joint whose torque is not in them
    root = np.where(counts > 0, root, np.stack((unknown.total, *unknown.tests)))
    model.set_payload(Payload())
    return ArmNoise(root[0], float(np.sqrt(np.mean(np.square(offsets)))), root[1:], position)


def _white(position_rad: Array) -> Array:
    """Return the variance of white noise in positions [m, n]: in third differences motion is nothing, and noise 20 times."""
    third = np.diff(position_rad, 3, axis=0)
    return np.asarray(np.nanmean(third * third, axis=0) / 20.0)
