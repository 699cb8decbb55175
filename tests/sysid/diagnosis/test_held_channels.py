"""Samples of a held channel are in no fit, and count by what they cost; one vibration is one in all channels."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis import dataset as datasets
from jtqd.sysid.diagnosis.dataset import unknown_lines, usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import UNEXPLAINED
from jtqd.sysid.diagnosis.regressors import ChannelData, RunData, families, run_data
from jtqd.sysid.diagnosis.signals import Channel, Line
from jtqd.sysid.diagnosis.unexplained import Remaining, held_nm
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, rigid_run

LIMIT = 0.2 * PLAIN.rated_torque_nm


def clipped_runs() -> list[tuple[str, RunTable]]:
    """Two runs of a sensor that clips: the first often, the second for the few samples before it is let go."""
    out = []
    for name, phase, last in (("often", 0.2, None), ("seldom", 0.9, 400)):
        table = rigid_run(PLAIN, phase, seconds=5.0)
        torque = table.joints[1].torque_nm
        assert torque is not None
        torque = torque.copy()
        torque[:last] = np.clip(torque[:last], -LIMIT, LIMIT)
        out.append((name, RunTable(table.time_s, {1: replace(table.joints[1], torque_nm=torque)})))
    return out


def nothing_taken_out(runs: list[RunData], families: int) -> Remaining:
    def of(channel: Channel) -> list[ChannelData]:
        return [run.channels[channel] for run in runs]

    residual = {c: [d.residual for d in of(c)] for c in (MOTOR1, TORSION1)}
    return Remaining(cast("Any", SimpleNamespace(of=of)), residual, np.zeros((len(runs), families)))


def test_clipped_samples_are_in_no_fit_however_few_and_count_by_what_they_cost() -> None:
    runs, reasons = usable_signals(clipped_runs(), {1: PLAIN}, (1,))
    assert not reasons
    binned = [run_data(run, [], 5, families(runs)) for run in runs]
    for (_, table), run in zip(clipped_runs(), binned, strict=True):
        torque = table.joints[1].torque_nm
        assert torque is not None
        for channel in (MOTOR1, TORSION1):
            d = run.channels[channel]
            assert d.held is not None
            at_limit = (np.abs(torque) == LIMIT)[: 5 * len(d.valid)].reshape(-1, 5).any(axis=1)
            assert at_limit.any()
            assert not (d.valid & (at_limit | d.held)).any()
            rest = d.residual[d.valid]
            assert np.sqrt(np.mean((rest - rest.mean()) ** 2)) < 0.01 * LIMIT, "what is left is measured"
    cost = held_nm(nothing_taken_out(binned, len(families(runs))))
    whole = rigid_run(PLAIN, 0.2, seconds=5.0).joints[1].torque_nm
    assert whole is not None
    over = np.maximum(np.abs(whole) - LIMIT, 0.0)
    assert cost[TORSION1] == pytest.approx(float(np.sqrt(np.mean(over**2))), rel=0.1)


def test_a_channel_that_is_held_at_rest_costs_what_it_jumps_by_afterwards() -> None:
    """The current is stuck while the joint comes to rest, and on; the motor balance knows nothing of the rest."""
    table = rigid_run(PLAIN, 0.2, seconds=5.0)
    columns = table.joints[1]
    assert columns.current_a is not None
    assert columns.motor_position_rad is not None
    speed = np.gradient(columns.motor_position_rad)
    rated_a = PLAIN.rated_torque_nm / (PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a)
    rng = np.random.default_rng(4)
    current = columns.current_a + 1e-4 * rated_a * np.round(20.0 * rng.normal(size=len(table.time_s)))
    begin = 1000 + int(np.argmin(np.abs(speed[1000:4000])))  # a reversal
    after = begin + 60
    current[begin - 60 : after] = current[begin - 61]
    current[after:] += 0.5 * rated_a
    runs, _ = usable_signals(
        [(name, RunTable(table.time_s, {1: replace(columns, current_a=current)})) for name in ("a", "b")],
        {1: PLAIN},
        (1,),
    )
    binned = [run_data(run, [], 5, families(runs)) for run in runs]
    at_rest = binned[0].channels[MOTOR1].at_rest_nm
    assert len(at_rest) > 5
    line = np.interp(np.arange(begin - 60, after), [begin - 61, after], current[[begin - 61, after]])
    worth = PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a * (current[begin - 61] - line)
    assert min(at_rest) >= min(worth) - 1e-9
    assert max(at_rest) <= max(worth) + 1e-9
    fit = nothing_taken_out(binned, len(families(runs)))
    whole = held_nm(fit)[MOTOR1] ** 2
    d = binned[0].channels[MOTOR1]
    assert d.held is not None
    count = int(np.sum(d.valid | d.held))
    for run in binned:
        run.channels[MOTOR1] = replace(run.channels[MOTOR1], at_rest_nm=np.empty(0))
    moving = held_nm(fit)[MOTOR1] ** 2
    assert whole * (count + len(at_rest)) - moving * count == pytest.approx(float(np.sum(at_rest**2)))


@pytest.mark.parametrize(("relevance", "matters"), [(0.005, True), (0.5, False)])
def test_a_held_channel_matters_by_its_size(relevance: float, matters: bool) -> None:
    found = diagnose(clipped_runs(), {1: PLAIN}, relevance=relevance)
    assert found.unexplained is not None
    assert found.unexplained.matters is matters
    assert (found.verdict == UNEXPLAINED) is matters
    assert found.unexplained.rms_nm > 0.05 * PLAIN.rated_torque_nm, "what the sensor has not shown"
    assert not any(cause.matters for cause in found.causes)


def test_one_vibration_is_taken_out_of_every_channel_that_shows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    other = Channel(2, "torsion")
    seen = [
        Line(TORSION1, 24.5, 0.9, 900.0, "Hz"),
        Line(other, 24.4, 0.9, 800.0, "Hz"),
        Line(MOTOR1, 31.0, 0.2, 300.0, "Hz"),
        Line(MOTOR1, 24.5, 0.1, 3.0, "Hz"),
    ]
    monkeypatch.setattr(datasets, "frequency_lines", lambda *_: seen)
    monkeypatch.setattr(datasets, "order_lines", lambda *_: [])
    runs, _ = usable_signals(clipped_runs(), {1: PLAIN}, (1,))
    assert unknown_lines(runs, [], 0.005) == seen[:2]
