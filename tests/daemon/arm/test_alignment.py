"""Joints of several buses at one instant, from records of a motion that is known at every time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from jtqd.daemon.arm.alignment import BRIDGED_PERIODS, WAITED_PERIODS, Aligned, Aligner, Bus
from jtqd.daemon.arm.arm_file import JointSource
from jtqd.daemon.shared.cycle_record import JointRecord
from jtqd.estimator.status import (
    DEGRADED,
    DRIVE_FAULT,
    INVALID,
    OFF,
    STALE,
    STANDSTILL,
    STARTING,
    VALID,
)
from tests.daemon.arm.small_arm import NOTHING, record_of

MS = 1_000_000
BEGIN = 50_000 * MS
GRID = [BEGIN + k * MS for k in range(400)]
AGE_MS = 5.0


def position(t_ns: float, joint: int) -> float:
    return math.sin(2e-9 * (t_ns - BEGIN) + joint)


def torque(t_ns: float, joint: int) -> float:
    return 10.0 * math.cos(3e-9 * (t_ns - BEGIN) + joint)


def record(t_ns: int, *joints: int, status: int = VALID, age_ms: float = AGE_MS) -> bytes:
    """The record of a jtqd with these joints of the arm: the torque is `age_ms` old."""
    return record_of(t_ns, *(fields(t_ns, each, status=status, age_ms=age_ms) for each in joints))


def fields(t_ns: int, joint: int, *, status: int = VALID, age_ms: float = AGE_MS) -> JointRecord:
    """What the record of a cycle has of a joint."""
    past = torque(t_ns - 1e6 * (0.0 if math.isnan(age_ms) else age_ms), joint)
    return NOTHING._replace(
        link_position_rad=position(t_ns, joint),
        torque_nm=past if status in (VALID, DEGRADED, STANDSTILL) else math.nan,
        sigma_nm=0.1 + joint,
        age_ms=age_ms,
        status=int(status),
    )


def source(bus: str, number: int) -> JointSource:
    return JointSource(bus, number, 1, 0.0)


def two_buses(first_ns: int = MS, second_ns: int = MS) -> tuple[Bus, Bus]:
    """Joints 0 and 2 on the first bus, 1 on the second."""
    one = Bus({2: source("a", 2), 0: source("a", 1)}, first_ns)
    return one, Bus({1: source("b", 1)}, second_ns)


def errors(found: Iterable[Aligned]) -> tuple[float, float]:
    """Largest errors of position and torque, which must be numbers from 20 ms on."""
    rows = [
        (
            max(abs(each.position_rad[n] - position(each.instant_ns, n)) for n in range(3)),
            max(abs(each.torque_nm[n] - torque(each.instant_ns, n)) for n in range(3)),
        )
        for each in found
        if each.instant_ns > BEGIN + 20 * MS
    ]
    assert rows
    worst = np.array(rows).max(axis=0)
    return float(worst[0]), float(worst[1])


def played(
    buses: tuple[Bus, Bus],
    grids: tuple[Iterable[int], Iterable[int]],
    period_ns: int,
    change: Callable[[int, int, bytes], bytes | None] = lambda _bus, _t, made: made,
) -> list[Aligned]:
    """Instants of two buses with SYNCs at these times, in bites of 4 ms."""
    aligner = Aligner(buses, period_ns)
    sent = sorted((t, n) for n, grid in enumerate(grids) for t in grid)
    found: list[Aligned] = []
    bite = sent[0][0]
    for t, n in sent:
        if t - bite > 4 * MS:
            bite = t
            found += aligner.ready(t)
        made = change(n, t, record(t, *((0, 2) if n == 0 else (1,))))
        buses[n].take([] if made is None else [made])
    return found + aligner.ready(sent[-1][0])


@pytest.mark.parametrize(
    ("first_us", "second_us"),
    [(1000.0, 1000.0), (1000.0, 2000.0), (2000.0, 1000.0), (1000.0, 1000.2), (1003.0, 999.5)],
)
def test_other_periods_and_clocks_that_drift(first_us: float, second_us: float) -> None:
    """SYNCs of two masters, 0.37 ms apart at the beginning; 200 ppm, and half a percent."""
    grids = tuple(
        [BEGIN + round(1e3 * (at + k * period)) for k in range(int(4e6 / period))]
        for at, period in ((0.0, first_us), (370.0, second_us))
    )
    slowest = MS * round(max(first_us, second_us) / 1000)
    buses = two_buses(*(MS * round(each / 1000) for each in (first_us, second_us)))
    found = played(buses, (grids[0], grids[1]), slowest)
    assert len(found) == pytest.approx(4000 * MS / slowest, abs=12)
    assert set(np.diff([each.instant_ns for each in found])) == {slowest}
    worst = errors(found)
    step = 2e-3 if slowest > MS else 1e-3
    assert worst[0] < 4.0 * step**2 / 8 * 1.1, "a straight line between samples, a <= 4 rad/s2"
    assert worst[1] < 90.0 * step**2 / 8 * 1.1
    assert all((each.status == VALID).all() for each in found[20:])
    assert found[-1].sigma_nm == pytest.approx([0.1, 1.1, 2.1])


def test_ages_of_one_bus_may_differ() -> None:
    bus = Bus({0: source("a", 1), 1: source("a", 2)}, MS)
    for t in GRID[:100]:
        bus.take([record_of(t, fields(t, 0, age_ms=5.0), fields(t, 1, age_ms=1.25))])
    aligner = Aligner([bus], MS)
    (found,) = aligner.ready(GRID[99])
    assert found.instant_ns == BEGIN + 94 * MS
    for n in (0, 1):
        assert found.torque_nm[n] == pytest.approx(torque(found.instant_ns, n), abs=1e-4)


def test_torques_that_are_older_than_silence_lasts() -> None:
    """An observer of 2 rad/s; the jtqd on the other bus has stopped, of which an age is not known any more."""
    found = played(two_buses(), (GRID, GRID), MS, lambda n, t, _: record(t, *((0, 2), (1,))[n], age_ms=200.0))
    assert np.isfinite(found[-1].torque_nm).all()
    assert errors(each for each in found if np.isfinite(each.torque_nm).all())[1] < 1e-3


def test_an_age_that_changes_with_a_restart() -> None:
    def change(n: int, t: int, made: bytes) -> bytes:
        return record(t, 1, age_ms=25.0 if t > BEGIN + 200 * MS else AGE_MS) if n else made

    found = played(two_buses(), (GRID, GRID), MS, change)
    assert np.isfinite(found[-1].torque_nm).all()
    assert errors(each for each in found if np.isfinite(each.torque_nm).all())[1] < 1e-3


def test_more_records_than_are_kept() -> None:
    bus = Bus({0: source("a", 1)}, MS)
    aligner = Aligner([bus], MS)
    aligner.ready(GRID[0])
    bus.take([record(BEGIN + k * MS, 0) for k in range(4900)])
    found = aligner.ready(BEGIN + 4900 * MS)
    assert math.isnan(at(found, 500).torque_nm[0])
    for ms in (1000, 4500):
        assert at(found, ms).torque_nm[0] == pytest.approx(torque(BEGIN + ms * MS, 0), abs=1e-3)


def test_directions_and_zeros() -> None:
    bus = Bus({0: JointSource("a", 2, -1, 0.25), 1: JointSource("a", 1, 1, -0.5)}, MS)
    bus.take([record(t, 7, 8) for t in GRID[:20]])
    (found,) = Aligner([bus], MS).ready(GRID[19])
    t = found.instant_ns
    assert found.position_rad == pytest.approx([-(position(t, 8) - 0.25), position(t, 7) + 0.5], abs=1e-6)
    assert found.torque_nm == pytest.approx([-torque(t, 8), torque(t, 7)], abs=1e-4)
    assert found.sigma_nm == pytest.approx([8.1, 7.1])


def at(found: list[Aligned], ms: float) -> Aligned:
    """The instant so many ms after the beginning."""
    return min(found, key=lambda each: abs(each.instant_ns - BEGIN - ms * MS))


def missing(cycles: Iterable[int]) -> Callable[[int, int, bytes], bytes | None]:
    """The second bus without these records."""
    gone = {BEGIN + k * MS for k in cycles}
    return lambda n, t, made: None if n == 1 and t in gone else made


def test_missed_slots_are_bridged_up_to_a_few_periods() -> None:
    short, long = range(100, 100 + BRIDGED_PERIODS - 1), range(200, 200 + BRIDGED_PERIODS)
    found = played(two_buses(), (GRID, GRID), MS, missing([*short, *long]))
    assert np.isfinite(at(found, 100.5).position_rad).all()
    assert errors([each for each in found if each.instant_ns < BEGIN + 190 * MS])[0] < 1e-5
    gap = at(found, 201)
    assert np.isfinite(gap.position_rad).tolist() == [True, False, True]
    assert errors([each for each in found if each.instant_ns > BEGIN + 210 * MS])[0] < 1e-5
    assert set(np.diff([each.instant_ns for each in found])) == {MS}


def test_a_bus_that_stops_is_not_waited_for_and_comes_back() -> None:
    """Jtqd stopped for 100 ms, as for a restart: the others go on, WAITED_PERIODS late."""
    buses = two_buses()
    aligner = Aligner(buses, MS)
    found = []
    for k in range(400):
        buses[0].take([record(BEGIN + k * MS, 0, 2)])
        if not 100 <= k < 200:
            buses[1].take([record(BEGIN + k * MS, 1)])
        found += aligner.ready(BEGIN + k * MS)
        if k == 150:
            assert found[-1].instant_ns == BEGIN + (k - WAITED_PERIODS - AGE_MS) * MS
    stopped = at(found, 150)
    assert stopped.status.tolist() == [VALID, STALE, VALID]
    assert np.isfinite(stopped.position_rad).tolist() == [True, False, True]
    assert np.isfinite(stopped.torque_nm).tolist() == [True, False, True]
    assert errors(each for each in found if each.instant_ns > BEGIN + 210 * MS)[0] < 1e-5
    assert len(found) == len({each.instant_ns for each in found})


def test_without_the_first_record_of_a_bus_its_joints_are_off() -> None:
    buses = two_buses()
    buses[0].take([record(t, 0, 2) for t in GRID])
    (found,) = Aligner(buses, MS).ready(GRID[-1])
    assert found.status.tolist() == [VALID, OFF, VALID]
    assert math.isnan(found.position_rad[1])


@pytest.mark.parametrize("status", [OFF, STARTING, STALE, DRIVE_FAULT, INVALID])
def test_a_torque_that_does_not_count_is_none_and_the_position_stays(status: int) -> None:
    def change(n: int, t: int, made: bytes) -> bytes:
        return record(t, 1, status=status) if n == 1 and t >= BEGIN + 200 * MS else made

    found = played(two_buses(), (GRID, GRID), MS, change)
    before, after = at(found, 190), at(found, 210)
    assert before.status.tolist() == [VALID] * 3
    assert after.status.tolist() == [VALID, status, VALID]
    assert (
        np.isfinite(after.torque_nm).tolist() == np.isfinite(after.sigma_nm).tolist() == [True, False, True]
    )
    assert np.isfinite(after.position_rad).all()


@pytest.mark.parametrize("status", [VALID, DEGRADED, STANDSTILL])
def test_a_torque_that_counts_keeps_its_status(status: int) -> None:
    found = played(
        two_buses(), (GRID, GRID), MS, lambda n, t, _: record(t, *((0, 2), (1,))[n], status=status)
    )
    assert found[-1].status.tolist() == [status] * 3
    assert errors(found)[1] < 1e-3


def test_one_cycle_without_torque_is_bridged_and_degraded() -> None:
    def change(n: int, t: int, made: bytes) -> bytes:
        return record(t, 1, status=STALE) if n == 1 and t == BEGIN + 200 * MS else made

    found = played(two_buses(), (GRID, GRID), MS, change)
    assert errors(found)[1] < 1e-3
    marked = [each.instant_ns for each in found if each.status[1] == DEGRADED]
    assert marked == [BEGIN + 195 * MS]


def test_a_torque_without_a_known_age_does_not_count() -> None:
    found = played(
        two_buses(), (GRID, GRID), MS, lambda n, t, made: record(t, 1, age_ms=math.nan) if n else made
    )
    assert np.isnan(found[-1].torque_nm).tolist() == [False, True, False]
    assert found[-1].status.tolist() == [VALID, STALE, VALID]


def test_a_missing_position_is_bridged_like_a_record() -> None:
    gone = {BEGIN + k * MS for k in (100, *range(200, 220))}

    def change(n: int, t: int, made: bytes) -> bytes:
        blind = fields(t, 1)._replace(link_position_rad=math.nan)
        return record_of(t, blind) if n == 1 and t in gone else made

    found = played(two_buses(), (GRID, GRID), MS, change)
    assert np.isfinite(at(found, 100).position_rad).all()
    assert np.isfinite(at(found, 210).position_rad).tolist() == [True, False, True]


def test_a_long_stop_of_everything_is_not_gone_through() -> None:
    later = [BEGIN + 60_000 * MS + k * MS for k in range(100)]
    found = played(two_buses(), (GRID + later, GRID + later), MS)
    assert len(found) < 600
    assert errors(found[-50:])[0] < 1e-5


def test_where_all_are_silent_the_grid_goes_on_without_numbers() -> None:
    buses = two_buses()
    aligner = Aligner(buses, MS)
    found = aligner.ready(GRID[0])
    assert [each.status.tolist() for each in found] == [[OFF] * 3]
    for t in GRID:
        buses[0].take([record(t, 0, 2)])
        buses[1].take([record(t, 1)])
        found += aligner.ready(t)
    for k in range(0, 2000, 4):
        found += aligner.ready(GRID[-1] + k * MS)
    assert set(np.diff([each.instant_ns for each in found])) == {MS}
    assert found[-1].instant_ns == pytest.approx(GRID[-1] + 1890 * MS, abs=20 * MS)
    assert np.isfinite(at(found, 390).torque_nm).all()
    assert np.isnan(found[-1].position_rad).all()
    assert found[-1].status.tolist() == [STALE] * 3
