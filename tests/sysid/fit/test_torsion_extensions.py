"""Extensions of the torsion: found on a bench that has them, not on one that has not; the same in fit and observer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.estimator import observe_run
from jtqd.estimator.joint import Joint, Torsion
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plants import AnyPlant, load_any_plant
from jtqd.sysid.fit.signals import UNIT_TORSION, RunSignals, run_signals
from jtqd.sysid.fit.torsion import WORTH, extended, fit_torsion, torsion_torque
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, twisted
from tests.sim_can.towing.benches import TYPICAL
from tests.sysid.fit.fused_signals import FUSED
from validation.goals.sources import true_torsion

RICH = replace(
    TORSION,
    cubic_nm_per_rad3=0.0,
    orders_per_motor_rev=(2.0, 4.0, 1.0),
    cos_rad=(*TORSION.cos_rad, 2e-5),
    sin_rad=(*TORSION.sin_rad, -1e-5),
    link_orders_per_rev=(1.0, 2.0),
    link_cos_rad=(3e-5, 1e-5),
    link_sin_rad=(-1e-5, 2e-5),
    hardening_rad=(2e-4, 8e-4),
    hardening_nm_per_rad=(2000.0, -700.0),
    hysteresis_nm=0.3,
    slips_nm=(0.2, 0.1),
    slips_travel_rad=(3e-5, 4e-4),
)


def test_torsion_torque_with_every_extension_is_the_observers() -> None:
    m = twisted(25)
    time = np.cumsum(m.arrays()[0])
    raw = observe_run(joint1(), FUSED, UNIT_TORSION, *m.arrays())
    _, _, motor, _, link = m.arrays()[:5]
    flags = np.ones(len(time), bool)
    run = RunSignals("a", raw, np.zeros(len(time)), flags, ~flags, motor, link)
    torque, width = torsion_torque(RICH, run)
    seen = observe_run(joint1(), FUSED, RICH, *m.arrays())
    settled = np.flatnonzero(width == 0.0)[0]
    assert settled < 2000
    assert torque[settled:] == pytest.approx(seen.torsion_nm[settled:], abs=1e-9)
    plain = observe_run(joint1(), FUSED, TORSION, *m.arrays())
    assert np.abs(seen.torsion_nm - plain.torsion_nm)[settled:].max() > 0.5


def signals(bench: AnyPlant, days: range) -> list[RunSignals]:
    joint = load_joint(shipped("joint1.yaml"))
    runs = []
    for day in days:
        f = 0.17 + 0.03 * (day % 7)
        commands = (
            JointCommand.velocity(
                lambda t, f=f: 1.4 * math.sin(2 * math.pi * f * t) + 0.7 * math.sin(9.1 * f * t)
            ),
            JointCommand.current(
                lambda t, f=f: 4.5 * math.sin(5.3 * f * t) * math.sin(2.7 * f * t) * min(t, 1.0)
            ),
        )
        table = emulate_run(bench, commands, 8.0, seed=3, day=day)
        runs.append(run_signals(f"day {day}", joint, FUSED, table.time_s, table.joints[1]))
    return runs


def error(torsion: Torsion, runs: list[RunSignals]) -> float:
    """RMS [Nm] against the sensor, each run less its own zero."""
    parts = [(torsion_torque(torsion, run)[0] - run.sensor_nm)[run.moving] for run in runs]
    return float(np.sqrt(np.mean(np.concatenate([part - part.mean() for part in parts]) ** 2)))


def bare(torsion: Torsion) -> Torsion:
    return replace(
        torsion,
        link_orders_per_rev=(),
        link_cos_rad=(),
        link_sin_rad=(),
        hardening_rad=(),
        hardening_nm_per_rad=(),
        slips_nm=(),
        slips_travel_rad=(),
    )


@pytest.fixture(scope="module")
def typical() -> tuple[Torsion, list[RunSignals]]:
    return fit_torsion(signals(TYPICAL, range(12))), signals(TYPICAL, range(20, 24))


def test_on_a_bench_with_another_spring_the_error_of_unseen_days_falls_by_half(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    found, unseen = typical
    runs = signals(TYPICAL, range(12))
    # the fit as it is without extensions: too few runs for them
    plain = fit_torsion(runs[:7])
    assert plain == bare(plain)
    assert error(found, unseen) < 0.5 * error(plain, unseen)


def test_spring_slips_and_link_encoder_are_found_as_they_are(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    found, _ = typical
    law = TYPICAL.joints[0]
    for torque in (15.0, 30.0):  # below, the slips are not yet all the way
        d = np.linspace(0.0, 4e-3, 4001)
        spring = d * (found.stiffness_nm_per_rad + found.cubic_nm_per_rad3 * d * d)
        for beyond, stiffness in zip(found.hardening_rad, found.hardening_nm_per_rad, strict=True):
            spring += stiffness * np.maximum(d - beyond, 0.0)
        # the slips hold on top of the spring
        spring += sum(found.slips_nm) + found.hysteresis_nm
        true = torque - sum(slip.torque_nm for slip in law.gear.slips)
        k = law.gear.stiffness_nm_per_rad
        t = law.gear.corners_nm
        twist = (
            min(true, t[0]) / k[0] + max(min(true, t[1]) - t[0], 0.0) / k[1] + max(true - t[1], 0.0) / k[2]
        )
        assert float(np.interp(torque, spring, d)) == pytest.approx(twist, rel=0.03)
    c, s = found.link_cos_rad[0], found.link_sin_rad[0]
    first = law.measurement.link_errors[0]
    # the deflection has the link encoder's error with the other sign
    expected = (
        -first.amplitude_rad * math.cos(first.phase_rad),
        first.amplitude_rad * math.sin(first.phase_rad),
    )
    assert (c, s) == pytest.approx(expected, abs=1e-5)
    assert sum(found.slips_nm) == pytest.approx(sum(slip.torque_nm for slip in law.gear.slips), rel=0.35)


def test_waves_of_the_motor_turn_are_found_as_they_are_although_the_spring_hardens(
    typical: tuple[Torsion, list[RunSignals]],
) -> None:
    """With one stiffness for all deflections those of order 1 came out too large by 3 urad."""
    found, true = typical[0], true_torsion(TYPICAL.joints[0])
    for order in (1.0, 2.0):
        (c, s), expected = (
            (each.cos_rad[at], each.sin_rad[at])
            for each in (found, true)
            for at in (each.orders_per_motor_rev.index(order),)
        )
        assert (c, s) == pytest.approx(expected, abs=5e-7)


def test_on_a_bench_without_them_nothing_is_added() -> None:
    runs = signals(load_any_plant(shipped("campaign_plant.yaml")), range(10))
    found = fit_torsion(runs)
    assert found == bare(found)
    assert found.orders_per_motor_rev == (2.0, 4.0)


def test_extensions_need_enough_runs_and_positions(typical: tuple[Torsion, list[RunSignals]]) -> None:
    _, unseen = typical
    assert extended(unseen, TORSION) is TORSION
    unknown = [replace(run, motor_position_rad=None) for run in unseen * 3]
    assert extended(unknown, TORSION) is TORSION
    assert 0.0 < WORTH < 0.2


def test_file_keeps_them_and_refuses_what_does_not_fit() -> None:
    mapping = load_joint(shipped("trained/joint1.yaml")).to_mapping()
    assert "slips_nm" not in mapping["fused"]["torsion"]
    mapping["fused"]["torsion"] |= {"slips_nm": [0.2, 0.1], "slips_travel_rad": [3e-5, 4e-4]}
    joint = Joint.from_mapping(mapping, "j.yaml")
    assert Joint.from_mapping(joint.to_mapping(), "j.yaml") == joint
    for change, expected in (
        ({"slips_nm": [0.2]}, "slips_travel_rad"),
        ({"slips_nm": [0.2, -0.1]}, "slips_nm"),
        ({"hardening_rad": [1e-3]}, "hardening_nm_per_rad"),
    ):
        broken = {
            **mapping,
            "fused": {**mapping["fused"], "torsion": {**mapping["fused"]["torsion"], **change}},
        }
        with pytest.raises(ConfigError, match=f"j.yaml: key 'fused.torsion.{expected}'"):
            Joint.from_mapping(broken, "j.yaml")
