"""The discrepancy: it imitates what is smooth over the conditions, and no quick wave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.regressors import RunData, features
from jtqd.sysid.diagnosis.signals import Channel
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, run_data

Axes = dict[str, FloatArray]


def moved(seed: int) -> RunData:
    rng = np.random.default_rng(seed)
    t = np.arange(3000) * 0.01
    a, b, c = rng.uniform(0.1, 0.4, 3)
    angle = np.sin(2.0 * np.pi * a * t) + 0.4 * np.sin(2.0 * np.pi * b * t)
    load = 10.0 * np.sin(2.0 * np.pi * c * t) + 5.0 * np.sin(angle)
    axes = {"velocity": np.gradient(angle, t), "load": load, "link_angle": angle}
    axes |= {"load_rate": np.gradient(load, t), "load_second_rate": np.gradient(np.gradient(load, t), t)}
    zero = np.zeros(len(t))
    return run_data(f"run{seed}", {MOTOR1: zero, TORSION1: zero}, axes)


RUNS = [moved(k) for k in range(3)]


@pytest.mark.parametrize("channel", [MOTOR1, TORSION1])
def test_its_features_have_a_mean_square_of_one(channel: Channel) -> None:
    made = np.vstack(features(RUNS, channel, np.random.default_rng(0)))
    assert np.mean(np.sum(made**2, axis=1)) == pytest.approx(1.0)


def test_a_joint_that_is_held_has_a_discrepancy_too() -> None:
    """Nothing of it is in the direction of motion."""
    held = [replace(run, axes={1: run.axes[1] | {"velocity": np.zeros(3000)}}) for run in RUNS]
    made = np.vstack(features(held, MOTOR1, np.random.default_rng(0)))
    load = np.concatenate([run.axes[1]["load"] for run in held])
    left = load - made @ np.linalg.lstsq(made, load, rcond=None)[0]
    assert float(left @ left) < 0.05 * float(load @ load)


@pytest.mark.parametrize(
    ("law", "least", "most"),
    [
        (lambda a: np.sign(a["velocity"]), 0.97, 1.0),
        (lambda a: a["velocity"], 0.97, 1.0),
        (lambda a: np.abs(a["load"]) * np.sign(a["velocity"]), 0.9, 1.0),
        (lambda a: np.tanh(a["velocity"] / 0.5) * (1.0 + 0.02 * a["load"]), 0.95, 1.0),
        (lambda a: np.interp(np.arange(3000.0) - 1.0, np.arange(3000.0), a["load"]) - a["load"], 0.97, 1.0),
        (lambda a: np.cos(100.0 * a["link_angle"]), 0.0, 0.05),
    ],
    ids=["Coulomb", "viscous", "load", "another friction", "late load", "wave"],
)
def test_it_imitates_frictions_and_no_wave(
    law: Callable[[Axes], FloatArray], least: float, most: float
) -> None:
    made = np.vstack(features(RUNS, MOTOR1, np.random.default_rng(0)))
    y = np.concatenate([law(run.axes[1]) for run in RUNS])
    left = y - made @ np.linalg.lstsq(made, y, rcond=None)[0]
    assert least <= 1.0 - float(left @ left) / float(y @ y) <= most
