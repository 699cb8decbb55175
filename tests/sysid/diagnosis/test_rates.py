"""Runs of different rates in one set: bins of one duration, each run at its own rate."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, samples_in
from jtqd.sysid.diagnosis.signals import Channel

RATES: Final = (1000.0, 500.0, 333.0, 250.0, 400.0)
JOINT: Final[Joint] = replace(
    load_joint(shipped("joint1.yaml")), efficiency=None, effects=(), friction=Friction(1.0, 2.0)
)
COULOMB_NM: Final = 1.6
"""Of the truth."""


def swing(rate_hz: float, phase: float, seconds: float = 10.0) -> RunTable:
    """One encoder; a load that swings on its own; noise of the current."""
    rng = np.random.default_rng(round(100 * phase))
    t = np.arange(0.0, seconds, 1.0 / rate_hz)
    position, speed, bent = (
        0.8 * np.sin(1.7 * t + phase),
        1.36 * np.cos(1.7 * t + phase),
        -2.312 * np.sin(1.7 * t + phase),
    )
    torque = 0.3 * JOINT.rated_torque_nm * np.sin(2.9 * t + 2.0 * phase)
    friction = COULOMB_NM * np.sign(speed) + JOINT.friction.viscous_nms_per_rad * speed
    inertia = JOINT.gear_ratio**2 * JOINT.rotor_inertia_kgm2 + JOINT.link_inertia_kgm2
    scale = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
    current = (torque + friction + inertia * bent + rng.normal(scale=0.2, size=len(t))) / scale
    return RunTable(
        t,
        {1: JointColumns(current, motor_position_rad=JOINT.gear_ratio * position, torque_nm=torque)},
    )


def mixed() -> list[tuple[str, RunTable]]:
    return [(f"{rate:g} Hz", swing(rate, 0.4 + 0.9 * k)) for k, rate in enumerate(RATES)]


@pytest.mark.parametrize("samples", [1.0, 4.0, 1.332, 2.5, 7.9, 5.0000000001])
def test_a_bin_is_the_mean_over_its_time(samples: float) -> None:
    """Each sample is a step of the signal: a straight line has the mean of its ends, sums are kept."""
    x = np.arange(1000.0)
    means = binned(x, samples)
    assert len(means) == int(1000 / samples)
    inner = samples * (np.arange(len(means)) + 0.5) - 0.5
    assert np.max(np.abs(means - inner)) < 0.2, "no bin is off by more than what one sample shares"
    whole = int(len(means) * samples)
    assert means.sum() * samples == pytest.approx(x[:whole].sum(), rel=3e-3)
    assert binned(np.full(1000, 3.7), samples) == pytest.approx(3.7, abs=1e-12)


@pytest.mark.parametrize(
    ("samples", "touched"), [(2.0, [2]), (2.5, [2]), (1.25, [4]), (5.5, [0, 1]), (5.0, [1])]
)
def test_a_bin_is_good_where_all_its_samples_are(samples: float, touched: list[int]) -> None:
    good = np.ones(40, np.bool_)
    good[5] = False
    assert np.flatnonzero(~all_in_bin(good, samples)).tolist() == touched


def test_the_same_motion_has_the_same_bins_at_every_rate() -> None:
    signals, reasons = usable_signals(mixed(), {1: JOINT}, (1,))
    assert reasons == []
    data = build_dataset(signals, {1: JOINT})
    assert data.step_s == pytest.approx(bin_samples([run[0] for run in signals]) * 0.004)
    for run, rate, mine in zip(data.runs, RATES, signals, strict=True):
        assert run.samples == pytest.approx(data.step_s * rate, rel=0.05)
        assert run.samples == samples_in(data.step_s, mine)
        assert float(np.median(np.diff(run.time_s))) == pytest.approx(data.step_s, rel=0.05)
        channel = run.channels[Channel(1, "motor")]
        d: FloatArray = run.axes[1]["velocity"]
        extra = (COULOMB_NM - JOINT.friction.coulomb_nm) * np.sign(d)
        rest = (channel.residual - extra)[channel.valid]
        noise = 0.2 / np.sqrt(run.samples)
        assert float(np.std(rest)) == pytest.approx(noise, rel=0.2), "what is left is the current's"
        assert abs(float(np.mean(rest))) < 0.02


def test_runs_of_different_rates_are_all_used() -> None:
    findings = diagnose(mixed(), {1: JOINT})
    assert findings.used == findings.runs
    assert findings.channel_notes == ()
    [cause] = findings.causes
    assert cause.name == "coulomb_friction"
    assert cause.parameters["coulomb_nm"].value == pytest.approx(COULOMB_NM, rel=0.03)
