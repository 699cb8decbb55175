"""Friction at no load: Coulomb and viscous are separated from the offsets, and what cannot be friction is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import Friction
from jtqd.estimator.losses import FrictionModel
from jtqd.sysid.fit.plateaus import (
    FitError,
    Mean,
    Plateau,
    effective_samples,
    fit_no_load,
    no_load,
    student_975,
)
from tests.estimator.estimator_helpers import joint1


def idle(friction: Friction, zero_nm: float, noise: float, velocities: list[float]) -> list[Plateau]:
    rng = np.random.default_rng(4)
    loss = FrictionModel(friction).torque_many(np.array(velocities))
    return [
        Plateau(
            "r", 0.0, 1.0, Mean(v, 0.0), Mean(0.0, 0.0), Mean(-f - zero_nm + noise * rng.normal(), 0.0), 9
        )
        for v, f in zip(velocities, loss.tolist(), strict=True)
    ]


BOTH = [s * v for v in (0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0) for s in (1.0, -1.0)]


def test_friction_at_no_load_is_told_from_the_zero_of_the_sensor() -> None:
    truth = Friction(3.7, 1.4, stribeck_nm=0.8, stribeck_velocity_rad_s=0.05)
    fit = fit_no_load(idle(truth, 0.35, 0.05, BOTH), joint1())
    values = {term.name: term for term in fit.terms}
    for name, expected in (("coulomb_nm", 3.7), ("viscous_nms_per_rad", 1.4), ("zero_nm", 0.35)):
        assert abs(values[name].value - expected) < 1.5 * values[name].ci95
        assert values[name].ci95 < 0.1
    assert fit.rmse_nm < 0.08
    assert fit.warnings == ()
    assert fit.friction.stribeck_nm == joint1().friction.stribeck_nm


def test_one_direction_warns_and_what_drives_is_refused() -> None:
    fit = fit_no_load(idle(Friction(3.0, 2.0), 0.0, 0.0, BOTH[::2]), joint1())
    assert "one direction" in fit.warnings[0]
    assert [term.name for term in fit.terms] == ["coulomb_nm", "viscous_nms_per_rad"]
    with pytest.raises(FitError, match="found 2 velocities at no load"):
        fit_no_load(idle(Friction(3.0, 2.0), 0.0, 0.0, [0.2, -0.2, 1.0]), joint1())
    wrong = [replace(p, torque=Mean(-p.torque.value, 0.0)) for p in idle(Friction(3.0, 2.0), 0.0, 0.0, BOTH)]
    with pytest.raises(FitError, match="expected a friction >= 0: swapped sign"):
        fit_no_load(wrong, joint1())


def test_no_load_is_no_current_or_no_torque() -> None:
    def at(i: float, tau: float) -> Plateau:
        return Plateau("r", 0.0, 1.0, Mean(1.0, 0.0), Mean(i, 0.0), Mean(tau, 0.0), 9)

    plateaus = [at(0.0, -8.0), at(0.6, -6.0), at(0.9, 1.9), at(1.2, 3.0), at(5.0, 25.0)]
    assert no_load(plateaus, joint1(), 0.61) == plateaus[:3]


def test_effective_samples_of_white_and_of_correlated_noise() -> None:
    random_ = np.random.default_rng(1)
    white = random_.normal(size=20000)
    assert effective_samples(white) == pytest.approx(20000, rel=0.1)
    # First-order autoregressive, rho = 0.9: n (1 - rho)/(1 + rho) = n/19.
    coloured = np.empty(20000)
    state = 0.0
    for index, value in enumerate(white.tolist()):
        state = 0.9 * state + value
        coloured[index] = state
    assert effective_samples(coloured) == pytest.approx(20000 / 19.0, rel=0.15)


@pytest.mark.parametrize(
    ("freedom", "value"), [(3, 3.182), (5, 2.571), (10, 2.228), (30, 2.042), (1000, 1.962)]
)
def test_student_quantile_against_the_table(freedom: float, value: float) -> None:
    assert student_975(freedom) == pytest.approx(value, rel=0.02)
