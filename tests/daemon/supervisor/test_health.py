"""Conditions from readings of the snapshot: lost inputs with their cause, deviations from the sensor, deadlines of PDOs."""

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.shared.conditions import Change, Conditions, Subject
from jtqd.daemon.shared.snapshot import InputView
from jtqd.daemon.supervisor.health import LENGTH_S, TIMEOUT_CYCLES, PdoWatch
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
    return [line for line in lines if not line.startswith("bus: ")]


def test_a_recorder_that_loses_cycles_is_told_while_it_runs():
    watch = Observer()
    watch.lines(view(0), 0.0)
    assert watch.lines(view(8), 1.0, cycles_lost=31) == ["recorder: cycles are lost: 31 are not in the log"]
    assert watch.lines(view(16), 2.0, cycles_lost=90) == []
    assert watch.lines(view(24), 30.0, cycles_lost=90) == ["recorder: no further cycles lost after 29.0 s"]


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
        ({"foreign_sync": 1}, "another SYNC producer is on the bus"),
        ({"sync_errors": 1}, "the own SYNC waits in the transmit queue"),
        ({"bus_errors": 1, "late_frames": 3}, "the bus is down"),
        ({"states": {1: 4}}, "node 1 is stopped"),
        ({"states": {1: 127}, "bus_errors": 1}, "node 1 is pre-operational"),
        ({"unconfigured": (1,), "states": {1: 127}}, "node 1 has restarted and is not configured yet"),
        ({"unconfigured": (1,), "states": {1: 0}}, "node 1 is absent"),
        ({"unconfigured": (1,), "states": {1: 5}}, "node 1 has a changed configuration"),
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
        (7, 1, "reports not valid"),
        (7, 2, "reports positive overload"),
        (7, 5, "reports not valid, negative overload"),
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
        "joint 1: temperature lost: 381h drive 1 TPDO3 not received for 2 s, or reported as not measured",
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
    assert lines == [f"joint {number}: torque sensor lost: node 3 is absent" for number in (1, 2)]


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
    blind = WELL._replace(torque_nm=90.0, sensor_nm=NAN, reference_nm=NAN)
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
