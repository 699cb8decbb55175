"""An effect is steady when it has one size in all runs and under all conditions; what imitates it in a band has not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.mixed_model import Mixed
from jtqd.sysid.diagnosis.noise import ORDER, Noise, run_sums
from jtqd.sysid.diagnosis.refine import PresentEffect, Refined
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.stability import RUNS, Stability, jackknife, needed, stability
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, run_data

NOISE_NM = 0.02
WHITE = Noise((MOTOR1,), {MOTOR1: np.zeros(ORDER)}, np.array([NOISE_NM]), np.eye(1), 1.0)
COUNT = 3000


def asked(more_nm: FloatArray | float, runs: int = 6, spread: float = 0.0) -> Stability:
    """How steady a viscous friction is that is fitted to these runs: `more_nm` over the velocities -1 to 1 rad/s that all of
    them go through, and in each run another viscous friction of its own.
    """
    rng = np.random.default_rng(5)
    velocity = np.linspace(-1.0, 1.0, COUNT)
    made: list[RunData] = []
    for k in range(runs):
        own = spread * (-1.0) ** k * velocity
        order = rng.permutation(COUNT)
        y = (more_nm + own + NOISE_NM * rng.normal(size=COUNT))[order]
        run = run_data(f"run{k}", {MOTOR1: y}, {"velocity": velocity[order]})
        d = replace(run.channels[MOTOR1], regressors=velocity[order][:, None], index=np.array([0]))
        made.append(replace(run, channels={MOTOR1: d}))

    def mixed() -> Mixed:
        return Mixed([run_sums(run, WHITE, 1, 1) for run in made], 1, np.array([0.01]))

    found = mixed().fit([0])
    size = float(found.beta[0])
    for k, run in enumerate(made):  # the residual at the fitted parameters
        d = run.channels[MOTOR1]
        left = replace(d, residual=d.residual - size * d.regressors[:, 0])
        made[k] = replace(run, channels={MOTOR1: left})
    name = "viscous_nms_per_rad"
    present = PresentEffect(EFFECTS["viscous_friction"], 1, {name: 2.0 + size}, (name,))
    refined = Refined(
        (present,), found.covariance, np.zeros(1), mixed(), found.variances, np.zeros((runs, 1)), tuple(made)
    )
    return stability(refined, WHITE, [{name: 2.0}])[0]


V = np.linspace(-1.0, 1.0, COUNT)


def test_one_size_everywhere_is_certain() -> None:
    found = asked(0.3 * V)
    assert found.margin > 1.0
    assert found.ratio > 50.0


def test_a_loss_in_a_band_of_velocities_is_no_viscous_friction_however_equal_in_all_runs() -> None:
    band = 0.5 * np.sign(V) * (np.abs(np.abs(V) - 0.8) < 0.1)
    found = asked(band)
    assert found.left_out == "velocity"
    assert found.margin < 1.0


def test_what_differs_from_run_to_run_is_not_certain() -> None:
    found = asked(0.1 * V, spread=0.1)
    assert found.left_out == RUNS
    assert found.margin < 1.0


def test_one_run_says_nothing_about_others() -> None:
    assert asked(0.3 * V, runs=1).ratio == 0.0


def test_fewer_parts_ask_for_more() -> None:
    # Student's t with 5 degrees of freedom, 0.01 over 25 effects, two-sided
    assert needed(6) == pytest.approx(8.36 * (len(EFFECTS) / 25) ** 0.2, rel=0.01)
    assert needed(4) > 2.0 * needed(6) > 2.0 * needed(11)


def test_jackknife_of_a_mean_is_its_standard_error() -> None:
    x = np.random.default_rng(1).normal(size=(9, 1))
    left_out = (x.sum(axis=0) - x) / 8.0
    assert jackknife(left_out) == pytest.approx(x.std(axis=0, ddof=1) / 3.0)
