"""An estimate that stays far from the sensor: one warning per episode, none for what passes by itself."""

import pytest

from jtqd.estimator.status import STALE
from tests.daemon.supervisor.watch_views import NAN, WELL, Observer, view


def watched(sigmas, period=0.05):
    """Readings of joint 2 so many sigmas above the sensor (None: no estimate); when it began, and its text."""
    watch, when = Observer(), []
    for n, distance in enumerate(sigmas):
        joint = WELL._replace(torque_nm=10.0 + 0.5 * (distance or 0.0), sigma_nm=0.5)
        if distance is None:
            joint = WELL._replace(torque_nm=NAN, sigma_nm=NAN, status=STALE)
        before = far(watch)
        watch.lines(view(8 * n, two=joint), n * period)
        if far(watch) and not before:
            when.append((n, far(watch)[0].line))
    (times,) = [each.times for each in watch.conditions.history(0.0) if each.name == "deviation"] or [0]
    assert times == len(when)
    return when


def far(watch):
    return [each for each in watch.conditions.present() if each.name == "deviation"]


def test_the_line_names_joint_and_numbers():
    ((at, line),) = watched([0.0] * 10 + [4.0] * 30)
    assert at == 10 + 20
    assert line == (
        "joint 2: the estimate has been more than 3 sigma away from the torque sensor for 1 s: "
        "12.00 Nm against 10.00 Nm, sigma 0.50 Nm"
    )


@pytest.mark.parametrize("distance", [0.0, 2.9, -2.9])
def test_within_three_sigma_is_as_it_should_be(distance):
    assert watched([distance] * 200) == []


def test_below_counts_as_above():
    assert len(watched([-4.0] * 40)) == 1


def test_a_second_is_the_least():
    assert watched(([4.0] * 20 + [1.0]) * 20) == []
    assert len(watched([4.0] * 21)) == 1


def test_one_warning_per_episode_and_the_edge_is_one_episode():
    assert len(watched([4.0] * 500)) == 1
    assert len(watched(([4.0] * 25 + [2.5] * 25) * 10)) == 1  # never within 2 sigma
    assert len(watched(([4.0] * 25 + [1.0] * 15) * 10)) == 1  # within 2 sigma, but not for a second
    assert len(watched(([4.0] * 25 + [1.0] * 25) * 10)) == 10


def test_what_is_not_known_is_neither_far_nor_near():
    assert watched(([4.0] * 15 + [None] * 11) * 20) == [], "half a second without a number: it begins anew"
    ((at, _),) = watched(([4.0] * 9 + [None]) * 4)
    assert at == 20, "a moment without a number is passed over"
    assert len(watched([4.0] * 25 + [None] * 100 + [4.0] * 25)) == 1, "the episode has not ended"
    watch = Observer()
    blind = WELL._replace(torque_nm=90.0, sensor_nm=NAN)
    for n in range(100):
        watch.lines(view(8 * n, blind), 0.05 * n)
    assert far(watch) == []


def test_readings_far_apart_or_of_one_cycle_are_no_duration():
    assert watched([4.0] * 40, period=0.6) == []
    watch = Observer()
    reading = view(8, WELL._replace(torque_nm=20.0))
    for n in range(100):
        watch.lines(reading, 0.05 * n)
    assert far(watch) == []
