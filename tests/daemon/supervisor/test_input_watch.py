"""Which joint lost its inputs, and why: one line, from the snapshot alone."""

import pytest

from jtqd.daemon.config import load_config
from jtqd.estimator.status import OFF, STALE
from jtqd.models.files import shipped
from tests.daemon.supervisor.watch_views import NAN, WELL, Observer, view

STALE_NO_MOTION = WELL._replace(torque_nm=NAN, status=STALE, input_flags=1 | 4)


def told(lost, before=None, seconds=0.5):
    """Lines of a loss that follows healthy readings."""
    watch = Observer()
    lines = watch.lines(before or view(0), 0.0)
    for n in range(1, round(seconds / 0.05) + 1):
        lines += watch.lines(lost._replace(cycle=8 * n), 0.05 * n)
    return [line for line in lines if "SYNC producer" not in line]


def test_healthy_and_switched_off_joints_are_no_news():
    assert told(view(8, two=WELL._replace(status=OFF, torque_nm=NAN)), seconds=10) == []


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({}, "281h drive 1 TPDO2 not received in time"),
        ({"late_frames": 9}, "281h drive 1 TPDO2 not received in time (late frames on the bus)"),
        (
            {"rejected_frames": 9},
            "281h drive 1 TPDO2 not received in time (frames of a wrong format on the bus)",
        ),
        ({"foreign_sync": 1}, "another SYNC is on the bus"),
        ({"sync_errors": 1}, "the own SYNC waits in the transmit queue"),
        ({"bus_errors": 1, "late_frames": 3}, "the bus is down"),
        ({"states": {1: 4}}, "node 1 is stopped"),
        ({"states": {1: 127}, "bus_errors": 1}, "node 1 is pre-operational"),
        ({"unconfigured": (1,), "states": {1: 127}}, "node 1 has restarted and is not configured yet"),
        ({"unconfigured": (1,), "states": {1: 0}}, "node 1 is not there"),
        ({"unconfigured": (1,), "states": {1: 5}}, "node 1 is not configured as it was"),
        ({"unconfigured": (2, 3)}, "281h drive 1 TPDO2 not received in time"),
    ],
)
def test_joint_and_likeliest_cause_are_named(options, cause):
    assert told(view(8, STALE_NO_MOTION, **options)) == [f"joint 1: inputs lost: {cause}"]


def test_counters_that_rose_before_the_loss_are_no_cause():
    before = view(0, foreign_sync=5, late_frames=7)
    lost = view(8, STALE_NO_MOTION, foreign_sync=5, late_frames=7)
    assert told(lost, before) == ["joint 1: inputs lost: 281h drive 1 TPDO2 not received in time"]


def test_every_missing_pdo_is_named_and_a_late_estimate_is_not_blamed_on_them():
    nothing = STALE_NO_MOTION._replace(input_flags=4)
    both = "182h drive 2 TPDO1 and 282h drive 2 TPDO2 not received in time"
    assert told(view(8, two=nothing)) == [f"joint 2: inputs lost: {both}"]
    late = STALE_NO_MOTION._replace(input_flags=7)
    assert told(view(8, two=late)) == ["joint 2: inputs lost: the estimate is not ready before the next SYNC"]


def test_inputs_that_are_missing_from_the_first_cycle_on_are_told():
    assert told(view(8, STALE_NO_MOTION), before=view(0, STALE_NO_MOTION)) != []


@pytest.mark.parametrize(
    ("flags", "status", "cause"),
    [
        (3, 0, "not received in time"),
        (7, 1, "says not valid"),
        (7, 2, "says positive overload"),
        (7, 5, "says not valid, negative overload"),
    ],
)
def test_the_sensor_has_its_own_line(flags, status, cause):
    joint = WELL._replace(sensor_nm=NAN, sensor_status=status, input_flags=flags)
    assert told(view(8, joint)) == [f"joint 1: torque sensor lost: 183h sensor 3 channel 1 {cause}"]


def warmth(known, *, seconds, start_s=100.0):
    """Lines while joint 1's temperature is known or not (one flag per 50 ms); the loop has run for `start_s`."""
    watch = Observer()
    lines = []
    for n in range(round(seconds / 0.05)):
        joint = WELL if known(0.05 * n) else WELL._replace(input_flags=7)
        lines += watch.lines(view(round(1000 * (start_s + 0.05 * n)), joint), 0.05 * n)
    return lines


def test_a_temperature_that_is_lost_and_comes_back_has_its_own_lines():
    lines = warmth(lambda t: not 1.0 <= t < 3.0, seconds=5.0)
    assert lines == [
        "joint 1: temperature lost: 381h drive 1 TPDO3 not received for 2 s, or it says not measured",
        "joint 1: temperature back after 2.0 s",
    ]


def test_a_temperature_is_not_missed_before_it_can_be_there():
    assert warmth(lambda t: t > 1.5, seconds=4.0, start_s=0.0) == []
    assert len(warmth(lambda t: False, seconds=4.0, start_s=0.0)) == 1


def test_joints_without_a_temperature_are_not_told_of(tmp_path):
    text = shipped("bench.yaml").read_text().replace("temperature: true", "temperature: false")
    path = shipped("bench.yaml").parent
    config = tmp_path / "c.yaml"
    config.write_text(text.replace("file: ", f"file: {path}/"))
    watch = Observer(load_config(config))
    cold = WELL._replace(input_flags=7)
    assert not any(watch.lines(view(100_000 + 50 * n, cold, cold), 0.05 * n) for n in range(200))


def test_the_end_is_told():
    watch = Observer()
    lines = []
    for n in range(100):
        lost = 20 <= n < 60
        lines += watch.lines(view(8 * n, STALE_NO_MOTION if lost else WELL), 0.05 * n)
    assert lines[1:] == ["joint 1: inputs back after 2.0 s"]


def test_an_absent_sensor_is_named_by_its_node():
    gone = WELL._replace(sensor_nm=NAN, input_flags=3)
    lines = told(view(8, one=gone, two=gone, unconfigured=(3,), states={3: 0}))
    assert lines == [f"joint {number}: torque sensor lost: node 3 is not there" for number in (1, 2)]
