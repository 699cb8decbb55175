"""Conditions from readings of the snapshot: lost inputs with their cause, deviations from the sensor, deadlines of PDOs."""

from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.shared.conditions import Change, Conditions, Subject
from jtqd.daemon.shared.snapshot import InputView, JointView, View
from jtqd.daemon.supervisor.health import LENGTH_S, TIMEOUT_CYCLES, PdoWatch
from jtqd.estimator.status import OFF, STALE
from jtqd.models.files import shipped
from tests.daemon.supervisor.watch_views import NAN, WELL, Observer, view

LOST = WELL._replace(torque_nm=NAN, status=STALE, input_flags=1 | 4)
"""TPDO2 is missing."""
COLD = ["joint 1: temperature lost: 381h drive 1 TPDO3 not received for 2 s, or reported as not measured"]
FAR = "joint 2: the estimate has been more than 3 sigma away from the torque sensor for 1 s: "


def lines_of(lost: View, before: View | None = None, seconds: float = 0.5) -> list[str]:
    """Lines of a loss that follows healthy readings."""
    watch = Observer()
    lines = watch.lines(before or view(0), 0.0)
    for n in range(1, round(seconds / 0.05) + 1):
        lines += watch.lines(lost._replace(cycle=8 * n), 0.05 * n)
    return [line for line in lines if not line.startswith("bus: ")]


def test_a_recorder_that_loses_cycles_is_reported_while_it_runs() -> None:
    watch = Observer()
    watch.lines(view(0), 0.0)
    assert watch.lines(view(8), 1.0, cycles_lost=31) == ["recorder: cycles are lost: 31 are not in the log"]
    assert watch.lines(view(16), 2.0, cycles_lost=90) == []
    assert watch.lines(view(24), 30.0, cycles_lost=90) == ["recorder: no further cycles lost after 29.0 s"]


def test_healthy_and_switched_off_joints_are_no_news() -> None:
    assert lines_of(view(8, two=WELL._replace(status=OFF, torque_nm=NAN)), seconds=10) == []


IN_TIME = "281h drive 1 TPDO2 not received in time"


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({}, IN_TIME),
        ({"late_frames": 9}, f"{IN_TIME} (late frames on the bus)"),
        ({"rejected_frames": 9}, f"{IN_TIME} (frames of a wrong format on the bus)"),
        ({"foreign_sync": 1}, "another SYNC producer is on the bus"),
        ({"sync_errors": 1}, "SYNC waits in the transmit queue, or is irregular"),
        ({"bus_errors": 1, "late_frames": 3}, "the bus is down"),
        ({"states": {1: 4}}, "node 1 is stopped"),
        ({"states": {1: 127}, "bus_errors": 1}, "node 1 is pre-operational"),
        ({"unconfigured": (1,), "states": {1: 127}}, "node 1 has restarted and is not configured yet"),
        ({"unconfigured": (1,), "states": {1: 0}}, "node 1 is absent"),
        ({"unconfigured": (1,), "states": {1: 5}}, "node 1 has a changed configuration"),
        ({"unconfigured": (2, 3)}, IN_TIME),
    ],
)
def test_the_likeliest_cause_of_lost_inputs(options: dict[str, Any], cause: str) -> None:
    assert lines_of(view(8, LOST, **options)) == [f"joint 1: inputs lost: {cause}"]


@pytest.mark.parametrize(
    ("before", "flags", "counters", "cause"),
    [
        (WELL, 5, {"foreign_sync": 5, "late_frames": 7}, "282h drive 2 TPDO2 not received in time"),
        (WELL, 4, {}, "182h drive 2 TPDO1 and 282h drive 2 TPDO2 not received in time"),
        (WELL, 7, {}, "the estimate is not ready before the next SYNC"),
        (LOST, 5, {}, "282h drive 2 TPDO2 not received in time"),
    ],
    ids=["counters that rose before", "every missing PDO", "a late estimate", "from the first cycle on"],
)
def test_what_is_missing(before: JointView, flags: int, counters: dict[str, int], cause: str) -> None:
    lost = view(8, two=LOST._replace(input_flags=flags), **counters)
    assert lines_of(lost, view(0, two=before, **counters)) == [f"joint 2: inputs lost: {cause}"]


@pytest.mark.parametrize(
    ("flags", "status", "options", "cause"),
    [
        (3, 0, {}, "183h sensor 3 channel 1 not received in time"),
        (7, 1, {}, "183h sensor 3 channel 1 reports not valid"),
        (7, 2, {}, "183h sensor 3 channel 1 reports positive overload"),
        (7, 5, {}, "183h sensor 3 channel 1 reports not valid, negative overload"),
        (3, 0, {"unconfigured": (3,), "states": {3: 0}}, "node 3 is absent"),
    ],
)
def test_the_sensor_has_its_own_line(flags: int, status: int, options: dict[str, Any], cause: str) -> None:
    joint = WELL._replace(sensor_nm=NAN, sensor_status=status, input_flags=flags)
    assert lines_of(view(8, joint, **options)) == [f"joint 1: torque sensor lost: {cause}"]


@pytest.mark.parametrize(
    ("lost_s", "start_s", "expected"),
    [
        ((1.0, 3.0), 100.0, [*COLD, "joint 1: temperature back after 2.0 s"]),
        ((0.0, 1.5), 0.0, []),  # it cannot be there yet
        ((0.0, 9.0), 0.0, COLD),
    ],
)
def test_a_lost_temperature(lost_s: tuple[float, float], start_s: float, expected: list[str]) -> None:
    watch, lines = Observer(), []
    for n in range(80):
        lost = lost_s[0] <= 0.05 * n < lost_s[1]
        joint = WELL._replace(input_flags=7) if lost else WELL
        lines += watch.lines(view(round(1000 * (start_s + 0.05 * n)), joint), 0.05 * n)
    assert lines == expected


def test_joints_without_a_temperature_have_no_line(tmp_path: Path) -> None:
    text = shipped("bench.yaml").read_text().replace("temperature: true", "temperature: false")
    config = tmp_path / "c.yaml"
    config.write_text(text.replace("file: ", f"file: {shipped('bench.yaml').parent}/"))
    watch = Observer(load_config(config))
    cold = WELL._replace(input_flags=7)
    assert not any(watch.lines(view(100_000 + 50 * n, cold, cold), 0.05 * n) for n in range(200))


def test_the_end_of_a_loss() -> None:
    watch, lines = Observer(), []
    for n in range(100):
        lines += watch.lines(view(8 * n, LOST if 20 <= n < 60 else WELL), 0.05 * n)
    assert lines[1:] == ["joint 1: inputs back after 2.0 s"]


# Deviation from the sensor


def begins(sigmas: list[float | None], period_s: float = 0.05) -> list[int]:
    """Readings of joint 2 so many sigmas above the sensor (None: no estimate); at which of them a deviation begins."""
    watch, found = Observer(), []
    for n, distance in enumerate(sigmas):
        joint = WELL._replace(torque_nm=10.0 + 0.5 * (distance or 0.0), sigma_nm=0.5)
        if distance is None:
            joint = WELL._replace(torque_nm=NAN, sigma_nm=NAN, status=STALE)
        before = watch.conditions.is_present("deviation", "joint 2")
        lines = watch.lines(view(8 * n, two=joint), n * period_s)
        if watch.conditions.is_present("deviation", "joint 2") and not before:
            found.append(n)
            assert n > 30 or lines[-1].startswith(FAR), lines
    (times,) = [each.times for each in watch.conditions.history(0.0) if each.name == "deviation"] or [0]
    assert times == len(found)
    return found


@pytest.mark.parametrize(
    ("sigmas", "expected"),
    [
        ([0.0] * 10 + [4.0] * 30, [10 + 20]),
        ([0.0] * 200, []),
        ([2.9] * 200, []),
        ([-2.9] * 200, []),
        ([-4.0] * 40, [20]),
        (([4.0] * 20 + [1.0]) * 20, []),  # not for a second
        ([4.0] * 21, [20]),
        ([4.0] * 500, [20]),
        (([4.0] * 25 + [2.5] * 25) * 10, [20]),  # never within 2 sigma
        (([4.0] * 25 + [1.0] * 15) * 10, [20]),  # within 2 sigma, but not for a second
        (([4.0] * 25 + [1.0] * 25) * 10, [50 * n + 20 for n in range(10)]),
        (([4.0] * 15 + [None] * 11) * 20, []),  # half a second without a number
        (([4.0] * 9 + [None]) * 4, [20]),  # a moment without a number is passed over
        ([4.0] * 25 + [None] * 100 + [4.0] * 25, [20]),  # the episode has not ended
    ],
)
def test_a_deviation_lasts_a_second_and_is_one_episode(
    sigmas: list[float | None], expected: list[int]
) -> None:
    assert begins(sigmas) == expected


def test_readings_far_apart_or_of_one_cycle_are_no_duration() -> None:
    assert begins([4.0] * 40, period_s=0.6) == []
    far = WELL._replace(torque_nm=20.0)
    for joint, step in ((far, 0), (far._replace(sensor_nm=NAN, reference_nm=NAN), 8)):
        watch = Observer()
        for n in range(100):
            watch.lines(view(8 + step * n, joint), 0.05 * n)
        assert ("deviation", "joint 1") not in watch.present()


# Errors of a PDO


PDO = Subject("181h drive 1 TPDO1", 0x181, 1, node=1)
SENSOR = Subject("183h sensor 3 channel 1", 0x183, node=3)
N = TIMEOUT_CYCLES
BEGUN, ENDED, BOTH = "8250h", "8250h ended", "8250h,8250h ended"


@pytest.mark.parametrize(
    "readings",
    [  # time, missed, in a row, short, long, changes
        pytest.param(
            [(0.0, 0, 0, 0, 0, ""), (0.1, N, N, 0, 0, BEGUN)], id="the twentieth cycle is the deadline"
        ),
        pytest.param(
            [
                (0.0, 19, 19, 0, 0, ""),
                (0.0, 25, 25, 0, 0, BEGUN),
                (0.0, 200, 200, 0, 0, ""),
                (0.0, 200, 0, 0, 0, ENDED),
                (0.0, 200 + N, 0, 0, 0, BOTH),
            ],
            id="it ends with the next valid one; a loss over before anybody looked counts too",
        ),
        pytest.param(
            [
                (0.0, 0, 0, 0, 0, ""),
                (0.05, 15, 15, 0, 0, ""),
                (0.1, N, 0, 0, 0, BOTH),
                (0.15, N, 0, 0, 0, ""),
                (0.2, N + 5, 0, 0, 0, ""),
            ],
            id="a loss that two readings share",
        ),
        pytest.param(
            [(0.0, 0, 0, 0, 0, ""), (0.05, N + 3, 3, 0, 0, BOTH), (0.1, N + 19, 19, 0, 0, "")],
            id="a loss that is over while a short one goes on",
        ),
        pytest.param(
            [
                (0.0, 0, 0, 0, 0, ""),
                (1.0, 0, 0, 1, 0, "8210h"),
                (1.5, 0, 0, 1, 3, "8220h"),
                (1.0 + LENGTH_S, 0, 0, 1, 3, "8210h ended"),
                (1.5 + LENGTH_S, 0, 0, 1, 3, "8220h ended"),
            ],
            id="wrong lengths last as long as they come",
        ),
    ],
)
def test_errors_of_a_pdo(readings: list[tuple[float, int, int, int, int, str]]) -> None:
    watch, changes = pdo_watch(PDO, SENSOR)
    for now_s, missed, in_a_row, short, long, expected in readings:
        seen = InputView(0, 0, 0, 0, 0, 0, 0, 0, missed, in_a_row, short, long)
        watch.observe([seen, InputView(*(0,) * 12)], (), now_s)
        assert ",".join(changes) == expected, now_s
        changes.clear()


def test_a_pdo_of_an_absent_optional_node_is_not_missed() -> None:
    watch, changes = pdo_watch(SENSOR)
    gone = InputView(0, 0, 0, 0, 0, 0, 0, 0, 500, 500, 0, 0)
    watch.observe([gone._replace(missed=0, in_a_row=0)], {3}, 0.0)
    watch.observe([gone._replace(in_a_row=0)], {3}, 0.0)
    watch.observe([gone], {3}, 0.0)
    assert changes == []
    watch.observe([gone], (), 0.0)
    assert changes == [BEGUN]


def pdo_watch(*pdos: Subject) -> tuple[PdoWatch, list[str]]:
    """A watch of PDOs, and the EMCY codes of what it changes."""
    conditions, changes = Conditions(), []

    def changed(change: Change) -> None:
        assert change.definition.emcy is not None
        changes.append(f"{change.definition.emcy.code:04X}h" + ("" if change.present else " ended"))

    conditions.subscribe(changed)
    return PdoWatch(pdos, conditions), changes
