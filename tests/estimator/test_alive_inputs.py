"""Encoders that jump, turn noisy or stand still: sigma holds the error in the same cycle, and nothing else changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import make_estimator, observe_run
from jtqd.estimator.fusion import Fusion
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import recommended
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate
from jtqd.sim_can.plant_source import load_any_plant

JOINT = load_joint(shipped("trained/joint1.yaml"))
RATED = JOINT.rated_torque_nm
REST = slice(3000, 4000)
AT = 3400


class Inputs(NamedTuple):
    """Arrays [n] of joint 1, and its true torque."""

    current_a: FloatArray
    motor_rad: FloatArray
    motor_rad_s: FloatArray
    link_rad: FloatArray
    true_nm: FloatArray


@cache
def inputs() -> Inputs:
    """A motion both ways up to 2.4 s, then rest under a load that swings by 12 Nm."""
    t = 1e-3 * np.arange(4500)
    velocity = 0.8 * np.sin(2 * np.pi * t / 1.2) * (t < 2.4)
    load = np.where(t < 2.4, 1.0, 2.0 * np.sin(2 * np.pi * (t - 2.4) / 1.2))
    commands = (
        JointCommand.velocity(lambda at: float(velocity[min(round(1e3 * at), 4499)])),
        JointCommand.current(lambda at: float(load[min(round(1e3 * at), 4499)])),
    )
    made = emulate(load_any_plant(shipped("campaign_plant.yaml")), commands, 4.5, 5)
    one = made.table.joints[1]
    columns = (one.current_a, one.motor_position_rad, one.motor_velocity_rad_s, one.link_position_rad)
    return Inputs(*map(np.asarray, columns), made.joint_torque_nm[:, 0])


def estimated(given: Inputs) -> EstimateRun:
    n = len(given.true_nm)
    dt = np.full(n, 1e-3)
    estimator = make_estimator(JOINT, recommended("fused"))
    return estimator.run(dt, *given[:4], np.full(n, 25.0))


def held(found: EstimateRun, at: slice) -> bool:
    """No torque is more than 2 Nm and 4 sigma off."""
    error = np.abs(found.torque_nm - inputs().true_nm)[at]
    sigma = found.sigma_nm[at]
    return not np.any((error > 2.0) & (error > 4.0 * sigma))


def unproven_nm2(given: Inputs) -> tuple[slice, FloatArray]:
    """Last rest, and what sigma^2 has there of the torsion that nothing has proven [n]: (share U/3)^2 + K^2 r r'.

    U: range of the torsion since the stop, or of the torsion less the motor's torque where that is less, if it is above
    2.5 % of the rated torque; at most what the current path allows; at each sample with what the torsion is ahead by. r, r':
    what the tracking filter leaves of this reading and the last, where both share it.
    """
    fused, n = JOINT.fused, len(given.true_nm)
    assert fused is not None
    seen = observe_run(
        JOINT, recommended("fused"), fused.torsion, np.full(n, 1e-3), *given[:4], np.full(n, 25.0)
    )
    rest = slice(int(np.flatnonzero(seen.status != st.STANDSTILL)[-1]) + 1, n)
    raw, v, torsion, direction, ahead = (
        x[rest] for x in (seen.raw_nm, seen.velocity_rad_s, seen.torsion_nm, seen.direction, seen.ahead_nm)
    )

    def ranged(values: FloatArray, beyond: FloatArray | float = 0.0) -> FloatArray:
        high, low = np.maximum.accumulate(values), np.minimum.accumulate(values)
        return np.asarray(np.maximum(high, values + beyond) - np.minimum(low, values + beyond))

    def least(beyond: FloatArray | float = 0.0) -> FloatArray:
        changed = np.minimum(ranged(torsion, beyond), ranged(torsion - raw, beyond))
        return np.where(changed > 0.025 * RATED, changed, 0.0)

    loss, half = AdditiveLossModel(fused.loss).loss_many(raw, v, np.full(len(raw), 25.0), direction)
    paths = Fusion(replace(fused.sigma, reference_nm=0.0), True).fuse(
        raw, half, v, torsion, seen.open_nm[rest]
    )
    most = np.abs(torsion - (raw - loss)) + half + 3.0 * np.sqrt(paths.variance_nm2 - half**2)
    off = least()
    for k in range(1, len(off)):
        off[k] = min(max(off[k - 1], off[k]), most[k])
    off = np.maximum(off, np.minimum(least(ahead), most + np.abs(ahead)))
    stiffness = (
        fused.torsion.stiffness_nm_per_rad + 3.0 * fused.torsion.cubic_nm_per_rad3 * (torsion / 12e3) ** 2
    )
    return rest, (paths.alpha * off / 3.0) ** 2 + stiffness**2 * np.maximum(seen.behind_rad2[rest], 0.0)


def test_healthy_inputs_at_rest_are_in_doubt_by_what_the_load_has_changed_by_unseen() -> None:
    """The rest of sigma is the half width of the calibrated interval, which does not depend on the load here."""
    found = estimated(inputs())
    at, more = unproven_nm2(inputs())
    assert set(found.status[at].tolist()) == {st.STANDSTILL}
    assert held(found, slice(100, 4500))
    half = np.sqrt(found.sigma_nm[at] ** 2 - more)[100:]  # the friction interval of the motion has faded
    assert np.sqrt(more.max()) > 0.05 * RATED
    assert np.quantile(half, 0.99) < 0.025 * RATED
    # some samples are equal to those before by chance
    assert np.mean(np.abs(half / np.median(half) - 1.0) < 0.005) > 0.998


def changed(**columns: Callable[[FloatArray], FloatArray]) -> Inputs:
    given = inputs()
    return given._replace(**{name: change(getattr(given, name).copy()) for name, change in columns.items()})


def _from(values: FloatArray, error: FloatArray | float, count: int = 600) -> FloatArray:
    values[AT : AT + count] += error
    return values


def _stopped(values: FloatArray, count: int = 600) -> FloatArray:
    values[AT : AT + count] = values[AT]
    return values


NOISE = np.random.default_rng(1).uniform(-1.0, 1.0, 600)
SPIKES = 1.0 * (np.arange(600) % 25 == 7)
BROKEN = {
    "link steps": changed(link_rad=lambda x: _from(x, 1e-3)),
    "motor steps": changed(motor_rad=lambda x: _from(x, -0.2)),
    "link is noisy": changed(link_rad=lambda x: _from(x, 2e-3 * NOISE)),
    "motor is noisy": changed(motor_rad=lambda x: _from(x, 0.3 * NOISE)),
    "link has spikes": changed(link_rad=lambda x: _from(x, 2.5e-3 * SPIKES)),
    "link stands still": changed(link_rad=_stopped),
    "all stand still": changed(
        link_rad=_stopped, motor_rad=_stopped, motor_rad_s=_stopped, current_a=_stopped
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_encoder_that_breaks_at_rest_widens_sigma_in_the_same_cycle(name: str) -> None:
    found = estimated(BROKEN[name])
    assert held(found, slice(AT - 100, AT + 600)), name
    assert np.max(found.sigma_nm[AT : AT + 600]) > 0.05 * RATED


@pytest.mark.parametrize("name", BROKEN)
def test_what_ends_is_over_within_a_second(name: str) -> None:
    found, healthy = estimated(BROKEN[name]), estimated(inputs())
    last = slice(AT + 1000, 4500)
    np.testing.assert_array_equal(found.status[last], healthy.status[last])
    assert np.max(found.sigma_nm[last] - healthy.sigma_nm[last]) < 0.05 * RATED


@pytest.mark.parametrize("at", [2450, 2500, 2550])
def test_a_link_encoder_that_stops_soon_after_a_stop_is_found_by_the_few_runs_that_were_seen(at: int) -> None:
    def stopped(values: FloatArray) -> FloatArray:
        values[at : at + 300] = values[at]
        return values

    found = estimated(changed(link_rad=stopped))
    assert held(found, slice(at - 50, at + 300))
    assert found.sigma_nm[at + 60] > 0.1 * RATED


def test_channels_without_noise_are_not_stuck() -> None:
    """Nothing is known of an encoder that has never been seen to be noisy."""
    still = Inputs(*(np.full(6000, 0.0) for _ in range(5)))
    found = estimated(still)
    assert set(found.status[10:].tolist()) == {st.STANDSTILL}
    assert found.sigma_nm[5999] == pytest.approx(found.sigma_nm[100], rel=1e-3)


def test_a_link_encoder_of_14_bits_is_alive() -> None:
    """A count is 4.6 Nm: its steps are in order, and it stands still as its angle happens to lie."""
    count = 2.0 * np.pi / (1 << 14)
    found = estimated(changed(link_rad=lambda x: np.round(x / count) * count))
    assert np.quantile(found.sigma_nm[100:], 0.99) < 0.25 * RATED
    assert np.mean(found.status[2500:] == st.STANDSTILL) > 0.9


def test_an_encoder_that_freezes_in_motion_is_in_doubt_at_the_first_sample() -> None:
    def frozen(values: FloatArray) -> FloatArray:
        values[300:400] = values[300]
        return values

    found, healthy = estimated(changed(link_rad=frozen)), estimated(inputs())
    assert held(found, slice(290, 400))
    assert found.sigma_nm[302] > 2.0 * healthy.sigma_nm[302]


def moving() -> Inputs:
    """Eight seconds of a motion both ways under a load."""
    t = 1e-3 * np.arange(8000)
    commands = (
        JointCommand.velocity(lambda at: 0.8 * float(np.sin(2 * np.pi * at / 1.2))),
        JointCommand.current(lambda at: 2.0 * float(np.sin(2 * np.pi * at / 0.7))),
    )
    made = emulate(load_any_plant(shipped("campaign_plant.yaml")), commands, len(t) * 1e-3, 6, day=3)
    one = made.table.joints[1]
    columns = (one.current_a, one.motor_position_rad, one.motor_velocity_rad_s, one.link_position_rad)
    return Inputs(*map(np.asarray, columns), made.joint_torque_nm[:, 0])


FAULTY = slice(4000, 4500)
"""Of `moving`: the joint is fast, turns back and is fast again."""


def _lost(angle: FloatArray, part: float) -> FloatArray:
    return part * (angle - angle[0])


MISLED: dict[str, Callable[[FloatArray], FloatArray]] = {
    "counts are lost": lambda angle: _lost(angle, -0.02),
    "counts are lost one way": lambda angle: (
        -0.3 * np.cumsum(np.maximum(np.diff(angle, prepend=angle[0]), 0.0))
    ),
    "a bit is stuck": lambda angle: 0.02 * (np.arange(len(angle)) // 3 % 2),
    "eccentric": lambda angle: 0.03 * (np.sin(2.0 * angle) - np.sin(2.0 * angle[0])),
    "held for five cycles": lambda angle: angle[np.arange(len(angle)) // 5 * 5] - angle,
    "twelve cycles old": lambda angle: (
        np.interp(np.arange(len(angle)) - 12, np.arange(len(angle)), angle) - angle
    ),
}


@pytest.mark.parametrize("name", MISLED)
def test_a_motor_position_that_leaves_its_velocity_widens_sigma(name: str) -> None:
    """Each of its steps is in order; what they sum up to in a tenth of a second is not."""
    given = moving()
    motor = given.motor_rad.copy()
    motor[FAULTY] += MISLED[name](motor[FAULTY])
    found = estimated(given._replace(motor_rad=motor))
    error = np.abs(found.torque_nm - given.true_nm)[FAULTY]
    assert not np.any((error > 2.0) & (error > 4.0 * found.sigma_nm[FAULTY]))


def test_a_wrong_velocity_is_forgotten_within_half_a_second() -> None:
    given = moving()
    velocity = given.motor_rad_s.copy()
    velocity[FAULTY] *= -1.0
    found, healthy = estimated(given._replace(motor_rad_s=velocity)), estimated(given)
    assert np.median(found.sigma_nm[FAULTY][50:]) > 4.0 * np.median(healthy.sigma_nm[2000:])
    assert np.max(found.sigma_nm[5000:] - healthy.sigma_nm[5000:]) < 0.05 * RATED


@pytest.mark.parametrize("cycles", [1, 4])
@pytest.mark.parametrize("scale", [1.0, 0.97])
def test_the_filter_and_the_scale_of_a_drives_velocity_are_learned(cycles: int, scale: float) -> None:
    """The mean of some cycles, and another scale: sigma is that of the velocity itself."""
    given = moving()
    mean = np.convolve(given.motor_rad_s, np.full(cycles, scale / cycles))[: len(given.motor_rad_s)]
    found, exact = estimated(given._replace(motor_rad_s=mean)), estimated(given)
    assert np.median(found.sigma_nm[2000:]) < 1.2 * np.median(exact.sigma_nm[2000:])
    assert np.mean(found.status[2000:] == st.VALID) > 0.95 * np.mean(exact.status[2000:] == st.VALID)


@pytest.mark.parametrize("error_rad", [2e-4, -3e-4])
@pytest.mark.parametrize("cycles", [500, 2000])
def test_nothing_is_learned_from_a_fault(error_rad: float, cycles: int) -> None:
    """A step of the link encoder that ends: the offset is that of before, within a second."""
    given = moving()
    link = given.link_rad.copy()
    link[4000 : 4000 + cycles] += error_rad
    zeros = []
    for columns in (given, given._replace(link_rad=link)):
        estimator = make_estimator(JOINT, recommended("fused"))
        for k in range(4000 + cycles + 1000):
            estimator.step(1e-3, *(float(each[k]) for each in columns[:4]), 25.0)
        found = estimator.zeros  # type: ignore[attr-defined]
        zeros.append((found.link_used_rad, found.current_used_a))
    assert zeros[1][0] == pytest.approx(zeros[0][0], abs=2e-5)
    assert zeros[1][1] == pytest.approx(zeros[0][1], abs=0.02)


def test_an_encoder_that_has_slipped_is_learned() -> None:
    """What does not end is an offset: the estimate corrects it after a few seconds of motion."""
    given = moving()
    link = given.link_rad.copy()
    link[2000:] += 2.5e-4
    found = estimated(given._replace(link_rad=link))
    error = np.abs(found.torque_nm - given.true_nm)
    assert np.median(error[7500:]) < 0.4 * 2.5e-4 * JOINT.stiffness_nm_per_rad


@pytest.mark.parametrize("gap", [60, 300])
def test_what_comes_after_a_gap_is_no_torque_before_it_is_seen_to_be_alive(gap: int) -> None:
    """A joint at rest, whose load swings on, sends the same bytes again: nothing of it proves a torque."""
    given, n = inputs(), 4500 - AT
    last = [np.append(each[:AT], each[AT + gap :]) for each in given[:4]]
    dt = np.full(4500 - gap, 1e-3)
    dt[AT] = 1e-3 * (gap + 1)
    healthy = make_estimator(JOINT, recommended("fused")).run(dt, *last, np.full(len(dt), 25.0))
    assert healthy.status[AT] == st.STARTING
    assert set(healthy.status[AT + 5 :].tolist()) == {st.STANDSTILL}
    frozen = [np.append(each[:AT], np.full(n - gap, each[AT + gap])) for each in given[:4]]
    found = make_estimator(JOINT, recommended("fused")).run(dt, *frozen, np.full(len(dt), 25.0))
    assert set(found.status[AT:].tolist()) == {st.STARTING}
    assert np.isnan(found.torque_nm[AT:]).all()
    frozen[0][AT + 100 :] += 0.01
    found = make_estimator(JOINT, recommended("fused")).run(dt, *frozen, np.full(len(dt), 25.0))
    assert set(found.status[AT : AT + 100].tolist()) == {st.STARTING}
    assert np.isfinite(found.torque_nm[AT + 100])
