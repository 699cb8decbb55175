"""From jtqd's log to the run table: its columns, the rows that are left out, and an account of every slot."""

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.logs import LogError
from jtqd.estimator.run import COLUMN_NAMES
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.logs import log_to_run
from tests.daemon.logs.campaign_log import OFF, Cycle, Joint, regular, temperature, write_log
from tests.sysid.runs.spoiled_runs import column

NAN = math.nan


def joints(n: int, **changes: float) -> tuple[Joint, Joint]:
    """Every column of either joint another function of the cycle."""
    one = Joint(0.1 * n, 10.0 + n, 20.0 + 2 * n, 0.01 * n, 3.0 + 0.5 * n)
    two = Joint(-0.2 * n, -10.0 - n, -20.0 - 2 * n, -0.01 * n, 3.0 + 0.5 * n)
    return one._replace(**changes), two  # type: ignore[arg-type]


def test_every_column_is_the_log_s_and_time_is_that_of_sync(tmp_path):
    cycles = regular(50, joints)
    cycles = [cycle._replace(time_ns=cycle.time_ns + 1000 * (cycle.index % 7)) for cycle in cycles]
    logged = log_to_run(write_log(tmp_path / "a.mcap", cycles))
    expected = (np.array([c.time_ns for c in cycles]) - cycles[0].time_ns) * 1e-9
    assert logged.table.time_s == pytest.approx(expected, abs=1e-12)
    for number in (1, 2):
        for name, field in zip(
            ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "torque_nm"),
            ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "sensor_nm"),
            strict=True,
        ):
            wanted = [getattr(cycle.joints[number - 1], field) for cycle in cycles]
            assert getattr(logged.table.joints[number], name).tolist() == wanted
        assert logged.table.joints[number].temperature_c is None
        assert logged.table.joints[number].link_velocity_rad_s is None
    assert (logged.missed, logged.incomplete, logged.lost_share) == (0, 0, 0.0)


def test_a_run_of_several_parts_is_one_table(tmp_path):
    """A run longer than recording.rotate_s; the recorder was killed as well: cycles 30 to 34 are in both parts."""
    cycles = regular(90, joints)
    whole = log_to_run(write_log(tmp_path / "a.mcap", cycles))
    parts = [tmp_path / "b-20260101T000000Z-0001.mcap", tmp_path / "b-20260101T000000Z-0002.mcap"]
    write_log(parts[0], cycles[:35])
    write_log(parts[1], cycles[30:])
    logged = log_to_run(parts)
    assert logged.table.time_s.tolist() == whole.table.time_s.tolist()
    assert (logged.missed, logged.incomplete) == (0, 0)
    for number in (1, 2):
        columns = [each.table.joints[number] for each in (logged, whole)]
        assert columns[0].motor_position_rad.tolist() == columns[1].motor_position_rad.tolist()


def test_only_cycles_in_which_both_drives_are_enabled_are_the_run(tmp_path):
    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        # joint 1 is enabled from 10 to 79, joint 2 from 20 to 89: the run is 20 to 79
        return (
            one if 10 <= n < 80 else one._replace(statusword=OFF),
            two if 20 <= n < 90 else two._replace(statusword=OFF),
        )

    logged = log_to_run(write_log(tmp_path / "a.mcap", regular(100, wanted)))
    assert len(logged.table.time_s) == 60
    assert column(logged.table, "current_a")[0] == pytest.approx(2.0)


def test_the_column_enabled_is_there_where_the_power_was_off_within_the_run(tmp_path):
    """Switch on disabled, ready and switched on carry no current; quick stop active (1217h) does."""
    words = {10: 0x1250, 11: 0x1231, 12: 0x1233, 13: 0x1217}

    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one._replace(statusword=words.get(n, one.statusword)), two

    logged = log_to_run(write_log(tmp_path / "a.mcap", regular(30, wanted)))
    enabled = column(logged.table, "enabled")
    assert np.flatnonzero(enabled == 0.0).tolist() == [10, 11, 12]
    assert set(enabled) == {0.0, 1.0}
    assert logged.table.joints[2].enabled is None, "its power was on all the time"
    assert (logged.missed, logged.incomplete) == (0, 0)


def test_missing_inputs_and_cycles_are_left_out_and_counted_by_input(tmp_path):
    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        if n in (5, 6):
            one = Joint(NAN, NAN, NAN, NAN, one.sensor_nm, 0, 4)
        if n == 6:
            two = Joint(NAN, NAN, NAN, NAN, two.sensor_nm, 0, 4)
        if n in (6, 9, 10):
            one, two = one._replace(sensor_nm=NAN), two._replace(sensor_nm=NAN)
        return one, two

    cycles = [cycle for n, cycle in enumerate(regular(40, wanted)) if n not in (20, 21, 22)]
    logged = log_to_run(write_log(tmp_path / "a.mcap", cycles))
    assert logged.missed == 3
    assert logged.incomplete == 4
    assert logged.incomplete_by == {"joint 1": 2, "joint 2": 1, "sensor": 3}
    assert len(logged.table.time_s) + logged.missed + logged.incomplete == 40
    assert logged.lost_share == pytest.approx(7 / 40)
    assert logged.longest_gap_s == pytest.approx(0.004)
    for columns in logged.table.joints.values():
        for name in COLUMN_NAMES:
            column = getattr(columns, name)
            assert column is None or np.isfinite(column).all()


def test_a_sensor_without_a_value_leaves_the_rest(tmp_path):
    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one._replace(sensor_nm=NAN, input_flags=3), two._replace(sensor_nm=NAN, input_flags=3)

    for sensor in (True, False):
        log = write_log(tmp_path / f"{sensor}.mcap", regular(30, wanted))
        logged = log_to_run(log, sensor=sensor)
        assert len(logged.table.time_s) == 30
        assert logged.table.joints[1].torque_nm is None
        assert logged.table.joints[1].current_a is not None


def test_a_joint_without_a_channel_of_the_sensor_has_no_torque(tmp_path):
    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one, two._replace(sensor_nm=NAN, input_flags=3)

    table = log_to_run(write_log(tmp_path / "a.mcap", regular(30, wanted))).table
    assert table.joints[1].torque_nm is not None
    assert table.joints[2].torque_nm is None
    assert len(table.time_s) == 30


def test_temperature_holds_between_its_frames_and_before_the_first_one(tmp_path):
    cycles = regular(40, joints)

    def with_frames(at: int, *frames: tuple[int, bytes]) -> None:
        cycles[at] = cycles[at]._replace(frames=[(0x181, bytes(8)), *frames])

    with_frames(10, temperature(4, 31.5), temperature(5, -3.2))
    with_frames(20, temperature(4, 33.0), (0x385, b"\x00\x80"))  # 8000h: not measured
    with_frames(30, (0x384, b"\x01"))  # too short: not a temperature
    logged = log_to_run(write_log(tmp_path / "a.mcap", cycles), nodes=(4, 5))
    one, two = (column(logged.table, "temperature_c", number) for number in (1, 2))
    assert one.tolist() == pytest.approx([31.5] * 20 + [33.0] * 20)
    assert two.tolist() == pytest.approx([-3.2] * 40)
    assert log_to_run(tmp_path / "a.mcap", nodes=(1, 2)).table.joints[1].temperature_c is None


@pytest.mark.parametrize(
    ("rows", "first", "frames", "expected"),
    [
        (1300, 0, {100: 25.0, 1200: 29.0}, [25.0] * 1200 + [29.0] * 100),
        (40, 20, {3: 25.0}, [25.0] * 20),
        (40, 20, {3: 25.0, 27: 29.0, 35: 29.5}, [29.0] * 15 + [29.5] * 5),
    ],
    ids=["in several chunks of 0.5 s", "before the motion only", "before and in the motion"],
)
def test_a_temperature_belongs_to_its_cycle(tmp_path, rows, first, frames, expected):
    """One from before the motion counts only where the motion has none: an emulated day begins with the motion."""

    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return (one, two) if n >= first else (one._replace(statusword=OFF), two)

    cycles = regular(rows, wanted)
    for at, value in frames.items():
        cycles[at] = cycles[at]._replace(frames=[temperature(1, value)])
    table = log_to_run(write_log(tmp_path / "a.mcap", cycles)).table
    assert column(table, "temperature_c").tolist() == pytest.approx(expected)


def test_logs_without_a_motion_are_refused_in_one_line(tmp_path):
    def off(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one, two._replace(statusword=OFF)

    def deaf(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one._replace(motor_position_rad=NAN), two

    for name, wanted, words in (
        ("off", off, ["operation enabled", "found 0"]),
        ("deaf", deaf, ["j1.motor_position_rad", "found no value"]),
    ):
        path = write_log(tmp_path / f"{name}.mcap", regular(30, wanted))
        with pytest.raises(LogError) as caught:
            log_to_run(path, all_needed=True)
        assert len(str(caught.value).splitlines()) == 1
        for word in [str(path), *words]:
            assert word in str(caught.value)


def test_a_joint_with_one_encoder_has_no_link_position_and_a_note(tmp_path):
    """The cycles of the other joint, which has one, are complete only with it."""

    def wanted(n: int) -> tuple[Joint, Joint]:
        one, two = joints(n)
        return one._replace(link_position_rad=NAN), two._replace(link_position_rad=NAN if n == 7 else 0.1 * n)

    path = write_log(tmp_path / "a.mcap", regular(30, wanted))
    logged = log_to_run(path, all_needed=True)
    one, two = logged.table.joints[1], logged.table.joints[2]
    assert (one.two_encoders(100.0), two.two_encoders(100.0)) == (False, True)
    assert one.link_position_rad is None
    assert len(column(logged.table, "current_a")) == 29
    assert logged.incomplete_by == {"joint 1": 0, "joint 2": 1, "sensor": 0}
    [run] = read_runs([path])
    assert "joint 1: one encoder, no link position: nothing is known of the torsion of the gear" in run.notes


def four(n: int) -> tuple[Joint, ...]:
    """Joints 1 to 4; a sensor at joint 3 only."""
    return tuple(
        Joint(
            0.1 * n * k,
            k + n,
            2.0 * n * k,
            0.01 * n * k,
            3.0 + n if k == 3 else NAN,
            input_flags=7 if k == 3 else 3,
        )
        for k in (1, 2, 3, 4)
    )


def test_one_to_four_joints_and_the_reference_of_those_that_have_one(tmp_path):
    for count in (1, 3, 4):
        cycles = regular(50, lambda n, count=count: four(n)[:count])  # type: ignore[misc]
        logged = log_to_run(write_log(tmp_path / f"{count}.mcap", cycles, count))
        assert list(logged.table.joints) == list(range(1, count + 1))
        for number, columns in logged.table.joints.items():
            assert column(logged.table, "current_a", number).tolist() == [0.1 * n * number for n in range(50)]
            assert (columns.torque_nm is not None) == (number == 3)
        assert (logged.missed, logged.incomplete, dict(logged.left_out)) == (0, 0, {})
    assert column(logged.table, "torque_nm", 3).tolist() == [3.0 + n for n in range(50)]


def test_one_joint_alone_has_its_own_cycles(tmp_path):
    """Joint 4 is enabled before the others and loses inputs at other times."""

    def wanted(n: int) -> tuple[Joint, ...]:
        *others, last = four(n)
        if not 20 <= n < 40:
            others = [each._replace(statusword=OFF) for each in others]
        return (*others, last._replace(input_flags=1) if n == 30 else last)

    path = write_log(tmp_path / "a.mcap", regular(60, wanted), 4)
    together, alone = log_to_run(path), log_to_run(path, joints=[4])
    assert (len(together.table.time_s), together.incomplete_by["joint 4"]) == (19, 1)
    assert list(alone.table.joints) == [4]
    assert len(alone.table.time_s) == 59
    assert column(alone.table, "current_a", 4)[0] == 0.0
    assert len(log_to_run(path, joints=[2, 3]).table.time_s) == 20


def test_the_last_motion_of_a_joint_begins_when_all_drives_are_enabled(tmp_path):
    """Joint 3 was brought to its place from 5 to 14; then it moves from 20 on, and joint 1 is enabled at 25 only."""

    def wanted(n: int) -> tuple[Joint, ...]:
        one, two, three, four_ = four(n)
        if not 5 <= n < 15 and not 20 <= n < 50:
            three = three._replace(statusword=OFF)
        if not 5 <= n < 15 and not 25 <= n < 50:
            one = one._replace(statusword=OFF)
        return one, two, three, four_._replace(input_flags=0) if n == 40 else four_

    path = write_log(tmp_path / "a.mcap", regular(60, wanted), 4)
    whole = log_to_run(path, joints=[3])
    assert len(whole.table.time_s) == 45, "from 5 to 49, without power in between"
    last = log_to_run(path, joints=[3], enabled=[1, 2, 3], last_motion=True)
    assert list(last.table.joints) == [3]
    assert column(last.table, "motor_position_rad", 3).tolist() == [3.0 + n for n in range(25, 50)]
    assert (last.missed, last.incomplete) == (0, 0), "losses of joint 4 do not count"


def test_a_joint_that_was_never_enabled_is_left_out_with_a_note(tmp_path):
    def wanted(n: int) -> tuple[Joint, ...]:
        one, two, three, last = four(n)
        return one._replace(statusword=OFF), two._replace(current_a=NAN), three, last

    path = write_log(tmp_path / "a.mcap", regular(120, wanted), 4)
    logged = log_to_run(path)
    assert list(logged.table.joints) == [3, 4]
    assert "operation enabled" in logged.left_out[1]
    assert "j2.current_a" in logged.left_out[2]
    [run] = read_runs([path])
    assert [note.split(":")[0] for note in run.notes] == ["joint 1 left out", "joint 2 left out"]
    for joints_wanted, needed, words in (
        ([1], False, "operation enabled"),
        ([3, 5], True, "found no joint 5, the log has 1, 2, 3, 4"),
        (None, True, "j2.current_a"),
    ):
        with pytest.raises(LogError, match=words):
            log_to_run(path, joints=joints_wanted, all_needed=needed)
    assert list(log_to_run(path, joints=[3, 5]).table.joints) == [3]


def test_the_temperature_of_a_joint_is_that_of_the_node_in_the_attached_configuration(tmp_path):
    cycles = regular(40, four)
    cycles[5] = cycles[5]._replace(frames=[temperature(1, 31.0), temperature(12, 35.5)])
    own = "objects: {temperature: {index: 0x2040, factor: 0.01}}"
    configuration = (
        f"joint_1: {{node: 11}}\njoint_2: {{node: 12, {own}}}\njoint_3: {{node: 1}}\njoint_4: {{}}\n"
    )
    table = log_to_run(write_log(tmp_path / "a.mcap", cycles, 4, configuration)).table
    first = [column(table, "temperature_c", number)[0] for number in (2, 3)]
    assert first == [pytest.approx(3.55), 31.0], "in the unit of its object"
    assert table.joints[1].temperature_c is table.joints[4].temperature_c is None


def test_the_account_holds_for_any_losses(tmp_path):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        lost = rng.random((200, 4)) < 0.05
        lost[[0, -1]] = False  # the run's own ends

        def wanted(n: int, lost: np.ndarray = lost) -> tuple[Joint, Joint]:
            one, two = joints(n)
            if lost[n, 0]:
                one = Joint(NAN, NAN, NAN, NAN, one.sensor_nm, 0, 4)
            if lost[n, 1]:
                two = Joint(NAN, NAN, NAN, NAN, two.sensor_nm, 0, 4)
            if lost[n, 2]:
                one, two = one._replace(sensor_nm=NAN), two._replace(sensor_nm=NAN)
            return one, two

        cycles: list[Cycle] = [c for n, c in enumerate(regular(200, wanted)) if not lost[n, 3]]
        logged = log_to_run(write_log(tmp_path / f"{seed}.mcap", cycles))
        good = ~lost.any(axis=1)
        assert logged.missed == int(lost[:, 3].sum()), f"seed {seed}"
        assert len(logged.table.time_s) == int(good.sum()), f"seed {seed}"
        assert len(logged.table.time_s) + logged.missed + logged.incomplete == 200, f"seed {seed}"
        found = column(logged.table, "current_a")
        assert found.tolist() == pytest.approx((0.1 * np.flatnonzero(good)).tolist()), f"seed {seed}"
        assert replace(logged, incomplete=0).lost_share <= logged.lost_share


def test_the_parts_of_a_run_are_one_recording(tmp_path):
    """In segments: two parts of one run and a log of another; the second part lacks its first 60 ms."""
    cycles = regular(4000, joints)
    parts = [tmp_path / f"b-20260101T000000Z-000{k}.mcap" for k in (1, 2)]
    write_log(parts[0], cycles[:2000])
    write_log(parts[1], cycles[2060:])
    write_log(tmp_path / "b-20260102T000000Z-0001.mcap", regular(1500, lambda n: joints(n + 9000), start=9))
    runs = read_runs([tmp_path], segments=True)
    assert [run.name for run in runs] == [
        f"{parts[0].name} (1 of 2)",
        f"{parts[0].name} (2 of 2)",
        "b-20260102T000000Z-0001.mcap",
    ]
    assert runs[1].table.time_s[0] == pytest.approx(2.06)
    assert runs[0].notes[0] == f"2 parts of one run: {parts[0].name} to {parts[1].name}"
    whole = b"".join(part.read_bytes() for part in parts)
    assert runs[0].sha256 == runs[1].sha256 == hashlib.sha256(whole).hexdigest()
    assert len(read_runs([parts[1]], segments=True)) == 1
