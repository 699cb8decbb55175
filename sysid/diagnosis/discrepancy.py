"""Discrepancy: what the library does not hold, as a random function of speed, load and angle, per balance.

Random Fourier features (Rahimi and Recht 2007) of a Gaussian process over the conditions, plain and, in the motor balance,
in the direction of motion, as friction is; rough, as laws with kinks are. Its variance is estimated with each set of entries
(`evidence`), capped, and each run has a part of its own: intervals are as wide as an incomplete model makes them (Kennedy
and O'Hagan 2001, J. R. Stat. Soc. B 63; Brynjarsdottir and O'Hagan 2014, Inverse Problems 30).
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


def features(runs: Sequence[RunData], channel: Channel, rng: np.random.Generator) -> list[FloatArray]:
    """Return the features of one balance per run [n, k]; a unit of each is 1 Nm over sqrt(k / 2)."""
    axes = [run.axes[channel.joint] for run in runs]
    valid = [run.channels[channel].valid for run in runs]
    halves = 2 if channel.balance == MOTOR else 1
    count = halves * limits.FEATURES
    scaled = [_scaled(name, axes, valid) for name in _CONDITIONS]
    rough = np.sqrt(rng.chisquare(limits.ROUGH, count) / limits.ROUGH)
    omega = rng.normal(size=(len(_CONDITIONS), count)) / (limits.LENGTH * rough)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    out = []
    for r, a in enumerate(axes):
        z = np.column_stack([x[r] for x in scaled])
        f = np.sqrt(2.0 / count) * np.cos(z @ omega + phase)
        f[:, limits.FEATURES :] *= np.sign(a["velocity"])[:, None]
        out.append(f)
    return out


def _scaled(name: str, axes: Sequence[dict[str, FloatArray]], valid: Sequence[BoolArray]) -> list[FloatArray]:
    """Return a condition per run in standard deviations about its mean; about zero where its sign has a meaning."""
    known = np.concatenate([a[name][v] for a, v in zip(axes, valid, strict=True)])
    middle = float(np.mean(known)) if name == "link_angle" and len(known) else 0.0
    width = max(float(np.sqrt(np.mean((known - middle) ** 2))) if len(known) else 0.0, 1e-9)
    return [(a[name] - middle) / width for a in axes]
