"""A known joint written at 1 kHz and polled slower: what is estimated is not moved by the noise of single samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.signals import BaseLoss, joint_signals
from jtqd.sysid.diagnosis.smoothing import mean_ahead
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run

NOISE: Final = 0.01
TRUE_KT: Final = 0.0816
NAME: Final = "torque_constant_nm_per_a"


def polled(table: RunTable, every: int) -> RunTable:
    (columns,) = table.joints.values()
    names = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
    values = {name: getattr(columns, name)[::every] for name in names}
    return RunTable(table.time_s[::every], {1: JointColumns(**values)})


@pytest.mark.parametrize(
    "every",
    [pytest.param(1, marks=pytest.mark.campaign), 4, pytest.param(10, marks=pytest.mark.campaign)],
    ids=["1 kHz", "250 Hz", "100 Hz"],
)
def test_a_torque_constant_is_found_as_it_is_whatever_the_rate_of_the_recorder(every: int) -> None:
    """The current's noise, 1 % of the rated one, is in the residual as well. As a regressor of single samples it
    explains itself: at 250 Hz the constant is then found smaller by five standard deviations.
    """
    truth = replace(PLAIN, torque_constant_nm_per_a=TRUE_KT)
    tables = [polled(rich_run(truth, seed, seconds=10.0, noise=NOISE), every) for seed in range(6)]
    found = diagnose([(f"run{k}", table) for k, table in enumerate(tables)], {1: PLAIN})
    (cause,) = found.causes
    assert cause.name == "torque_constant"
    value = cause.parameters[NAME]
    assert value.ci95[0] <= TRUE_KT <= value.ci95[1]
    assert value.value == pytest.approx(TRUE_KT, abs=0.1 * (TRUE_KT - PLAIN.torque_constant_nm_per_a))


def test_a_rate_of_the_sensor_keeps_what_swings_at_40_hz() -> None:
    """A central difference over 8 ms has 0.84 of it, one of fourth order 0.95, and a delay is found larger by as much."""
    t = np.arange(0.0, 1.0, 0.004)
    w = 2.0 * np.pi * 40.0
    link = 0.3 * np.sin(1.7 * t)
    columns = JointColumns(
        current_a=0.0 * t,
        motor_position_rad=PLAIN.gear_ratio * link,
        link_position_rad=link,
        torque_nm=np.sin(w * t),
    )
    rate = joint_signals("run", RunTable(t, {1: columns}), 1, PLAIN, BaseLoss(PLAIN)).state.torque_rate_nm_s
    assert np.std(rate[4:-4]) * np.sqrt(2.0) == pytest.approx(w, rel=0.01)


@pytest.mark.parametrize("span_s", [-0.004, 2e-5, 0.0073])
def test_a_mean_ahead_is_the_difference_of_what_it_is_the_rate_of(span_s: float) -> None:
    """Also of noise: three samples of it would have a third of the noise of each."""
    t = np.arange(0.0, 1.0, 1e-3)
    x = np.cumsum(np.random.default_rng(5).normal(size=len(t)))
    whole = np.concatenate(([0.0], np.cumsum(0.5 * (x[1:] + x[:-1]) * 1e-3)))
    found = mean_ahead(t, x, span_s)
    fine = np.arange(0.0, 1.0 - 1e-3, 1e-5)
    sums = np.concatenate(([0.0], np.cumsum(np.interp(fine[:-1] + 5e-6, t, x) * 1e-5)))
    assert found[10:-20] == pytest.approx(
        (np.interp(t + span_s, fine, sums) - whole)[10:-20] / span_s, rel=1e-3, abs=1e-2
    )
    assert found[-1] == pytest.approx(x[-1] if span_s > 0.0 else found[-1])
