"""Discrepancy: what the library does not hold, as a random function of speed, load and angle, per balance.

A Gaussian process over the operating conditions, plain and, in the motor balance, in the direction of motion, as friction
is; Matern 3/2, because friction has kinks. It is written in its largest eigenfunctions over the conditions of the runs
(Nystrom approximation: Williams and Seeger 2001, NIPS 13), which hold the most of it that few features can. Its variance is
estimated with each set of entries (`evidence`), capped, and each run has a part of its own: intervals are as wide as an
incomplete model makes them (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63; Brynjarsdottir and O'Hagan 2014, Inverse
Problems 30).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.effects.effect import MOTOR
from jtqd.sysid.diagnosis import limits
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel

_CONDITIONS: Final = ("velocity", "load", "link_angle")
_POINTS: Final = 200
"""Of the conditions, at which the eigenfunctions are found."""


def features(runs: Sequence[RunData], channel: Channel, rng: np.random.Generator) -> list[FloatArray]:
    """Return the features of one balance per run [n, k]: functions whose squares add up to 1 Nm^2 in the mean."""
    axes = [run.axes[channel.joint] for run in runs]
    valid = [run.channels[channel].valid for run in runs]
    scaled = [_scaled(name, axes, valid) for name in _CONDITIONS]
    conditions = [np.column_stack([x[r] for x in scaled]) for r in range(len(runs))]
    known = np.vstack([x[v] if v.any() else x for x, v in zip(conditions, valid, strict=True)])
    points = known[rng.choice(len(known), min(_POINTS, len(known)), replace=False)]
    values, vectors = np.linalg.eigh(_kernel(points, points))
    largest = np.argsort(values)[::-1][: limits.FEATURES]
    weights = vectors[:, largest] / np.sqrt(np.maximum(values[largest], 1e-9))
    out = [_kernel(x, points) @ weights for x in conditions]
    if channel.balance == MOTOR:
        out = [np.hstack((f, f * np.sign(a["velocity"])[:, None])) for f, a in zip(out, axes, strict=True)]
    square = np.concatenate([np.sum(f[v] ** 2, axis=1) for f, v in zip(out, valid, strict=True)])
    size = float(np.sqrt(np.mean(square))) if len(square) else 1.0
    return [f / max(size, 1e-9) for f in out]


def _kernel(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the covariance of the process between conditions a [n, c] and b [m, c]: Matern 3/2 [n, m]."""
    square = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2.0 * a @ b.T
    distance = np.sqrt(3.0 * np.maximum(square, 0.0)) / limits.LENGTH
    return np.asarray((1.0 + distance) * np.exp(-distance))


def _scaled(name: str, axes: Sequence[dict[str, FloatArray]], valid: Sequence[BoolArray]) -> list[FloatArray]:
    """Return a condition per run in standard deviations about its mean; about zero where its sign has a meaning."""
    known = np.concatenate([a[name][v] for a, v in zip(axes, valid, strict=True)])
    middle = float(np.mean(known)) if name == "link_angle" and len(known) else 0.0
    width = max(float(np.sqrt(np.mean((known - middle) ** 2))) if len(known) else 0.0, 1e-9)
    return [(a[name] - middle) / width for a in axes]
