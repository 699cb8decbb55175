"""Cycle records as messages: what is a number and what is not, and where it comes from. No process, no DDS."""

import math

import pytest

from jtqd.daemon import ros2 as launch
from jtqd.daemon.config import Config, Ros2Settings, load_config
from jtqd.daemon.recording.messages import Status
from jtqd.daemon.ros2.messages import JointMessages, diagnostic_array
from jtqd.daemon.ros2.process import domain_xml
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.snapshot import JointView, View
from jtqd.estimator import status as st
from jtqd.estimator.errors import ConfigError
from tests.daemon.recording.recorder_bench import START_NS, joint_values, record_of

RATIOS = (100.0, 160.0)


def messages(*records, names=("shoulder", "elbow")):
    made = JointMessages(names, RATIOS)
    made.take(records)
    return made


def fields(index, number):
    return cr.JointRecord._make(joint_values(index, number))


def with_joint(index, number, statuses=(2, 2), **changes):
    """A record in which the fields of one joint are others."""
    record = bytearray(record_of(index, statuses=statuses))
    joint = cr.joint_of(record, number)._replace(**changes)
    cr.JOINT.pack_into(record, cr.HEADER.size + (number - 1) * cr.JOINT.size, *joint)
    return bytes(record)


def test_a_joint_state_is_the_newest_cycle_on_the_joint_side():
    state = messages(record_of(7), record_of(8)).joint_state()
    assert (state.header.stamp.sec, state.header.stamp.nanosec) == divmod(START_NS + 8_000_000, 10**9)
    assert (state.header.frame_id, state.name) == ("", ["shoulder", "elbow"])
    joints = [fields(8, number) for number in (1, 2)]
    assert state.position == [joint.link_position_rad for joint in joints]
    assert state.velocity == [joints[0].motor_velocity_rad_s / 100.0, joints[1].motor_velocity_rad_s / 160.0]
    assert state.effort == [joint.torque_nm for joint in joints]


@pytest.mark.parametrize("status", sorted(st.NAMES))
def test_without_a_status_that_permits_it_no_torque_is_a_number(status):
    """The records of this test have numbers everywhere, whatever the status."""
    made = messages(record_of(8, statuses=(status, 2)))
    state, torques = made.joint_state(), made.torque_state(8_000_000)
    found = [state.effort, torques.torque, torques.sigma, torques.lower, torques.upper]
    assert [math.isnan(values[0]) for values in found] == [status not in st.PUBLISHED] * 5
    assert not any(math.isnan(values[1]) for values in found)
    assert torques.status == [status, 2]
    assert not math.isnan(state.position[0])  # the encoder's: another channel


def test_what_did_not_come_is_not_a_number():
    lost = with_joint(3, 2, link_position_rad=math.nan, motor_velocity_rad_s=math.nan)
    state = messages(lost).joint_state()
    assert math.isnan(state.position[1])
    assert math.isnan(state.velocity[1])
    assert not math.isnan(state.position[0] + state.velocity[0])


def test_the_torque_state_has_its_cycle_and_age():
    state = messages(record_of(481, missed=4)).torque_state(481_000_000 + 2_500_000)
    assert (state.cycle, state.sync_counter, state.missed) == (481, 2, 4)
    assert state.age == pytest.approx(0.0025, abs=1e-12)


def test_the_interval_is_that_of_the_standstill_or_95_percent():
    moving = with_joint(1, 1, torque_nm=5.0, sigma_nm=0.5)
    state = messages(moving).torque_state(0)
    assert (state.lower[0], state.upper[0]) == pytest.approx((5.0 - 0.98, 5.0 + 0.98))
    standing = with_joint(1, 1, (6, 2), torque_nm=5.0, sigma_nm=0.5)
    state = messages(standing).torque_state(0)
    assert (state.lower[0], state.upper[0]) == pytest.approx((4.5, 5.5))


def test_faults_and_latch_come_from_the_cycle():
    state = messages(with_joint(1, 2, (2, 15), input_flags=7 | cr.FLAG_LATCHED | 0x20 << 8)).torque_state(0)
    assert (state.faults, state.latched) == ([0, 0x20], [False, True])


def test_a_cycle_without_a_torque_is_counted_though_another_one_is_published():
    made = messages()
    made.take([record_of(n, statuses=(4 if n in (3, 4) else 2, 6)) for n in range(10)])
    assert made.torque_state(0).withheld == [2, 0]
    made.take([record_of(10)])
    assert made.torque_state(0).withheld == [0, 0]


def test_of_a_loop_that_stands_still_nothing_is_repeated():
    made = messages(record_of(5, statuses=(2, 6)))
    state = made.torque_state(1_005_000_000, stalled=True)
    assert state.status == [st.STALE, st.STALE]
    assert all(math.isnan(value) for value in (*state.torque, *state.sigma, *state.lower, *state.upper))
    assert (state.cycle, state.age) == (5, pytest.approx(1.0))


def test_nothing_before_the_first_cycle():
    made = messages()
    assert made.joint_state() is None
    assert made.torque_state(0) is None


def test_diagnostics_name_the_bus_and_tell_faults_and_age_of_the_joints():
    joint = JointView(1.0, 0.1, 1.0, 1.0, 0.0, 1.0, 0, 15, 0, 0x24 << 8, 0x04)
    view = View(1, 2, 3, 4, 0.001, 0.5, (joint,), dict.fromkeys(COUNTERS, 0), (0.1,), bytes(128), ())
    statuses = [
        Status("jtqd: loop", "can0", 0, "running", {"missed": 3, "late": 0.00123456789}),
        Status("jtqd: joint 1", "shoulder", 2, "INVALID", {"status": "INVALID"}),
    ]
    made = diagnostic_array(5_000_000_006, "can0", statuses, view, 0.0123)
    assert (made.header.stamp.sec, made.header.stamp.nanosec) == (5, 6)
    loop, shoulder = made.status
    assert (loop.level, loop.name, loop.message, loop.hardware_id) == (
        0,
        "jtqd can0: loop",
        "running",
        "can0",
    )
    assert [(each.key, each.value) for each in loop.values] == [("missed", "3"), ("late", "0.00123457")]
    values = {each.key: each.value for each in shoulder.values}
    assert values == {
        "status": "INVALID",
        "faults": "motor_jump, torsion",
        "latched": "motor_jump",
        "age_s": "0.0123",
    }


# ---- where it is published ----


@pytest.mark.parametrize(
    ("configured", "environment", "expected"),
    [
        (None, {}, 0),
        (None, {"ROS_DOMAIN_ID": "42"}, 42),
        (7, {"ROS_DOMAIN_ID": "42"}, 7),
        (0, {"ROS_DOMAIN_ID": "x"}, 0),
    ],
)
def test_the_domain_is_the_configured_one_else_that_of_ros(configured, environment, expected):
    assert launch.domain_id(configured, environment) == expected


@pytest.mark.parametrize("text", ["x", "-1", "233", "1.5", "²"])
def test_a_domain_that_is_none_is_refused(text):
    with pytest.raises(
        ConfigError, match=r"ROS_DOMAIN_ID: found '.*', expected a whole number from 0 to 232"
    ):
        launch.domain_id(None, {"ROS_DOMAIN_ID": text})


def test_where_there_is_no_wheel():
    assert launch.needed("x86_64") == "the package cyclonedds: pip install 'jtqd[ros2]'"
    assert "no wheel for aarch64: docs/ros2.md" in launch.needed("aarch64")


def test_announcements_to_single_addresses_are_for_the_loopback_alone():
    on_loopback, on_ethernet = (domain_xml(name, ["127.0.0.1", "192.0.2.2"]) for name in ("lo", "eth0"))
    assert 'NetworkInterface name="lo"' in on_loopback
    assert '<Peer address="127.0.0.1"' in on_loopback
    assert '<Peer address="192.0.2.2"' in on_loopback
    assert "Peer " not in on_ethernet


def test_section_of_the_configuration(tmp_path):
    def load(section: str) -> Config:
        path = tmp_path / "arm.yaml"
        shipped = load_config(None)
        text = shipped.text.replace("file: ", f"file: {shipped.path.parent}/").replace(
            f"{shipped.path.parent}/{shipped.path.parent}/", f"{shipped.path.parent}/"
        )
        path.write_text(f"{text}\n{section}\n")
        return load_config(path)

    assert load_config(None).ros2 is None
    assert load("ros2: {}").ros2 == Ros2Settings(None, "lo", 100.0, {})
    settings = load("ros2: {domain_id: 5, interface: eth0, rate_hz: 50, names: {joint_2: elbow}}").ros2
    assert settings == Ros2Settings(5, "eth0", 50.0, {"joint_2": "elbow"})
    assert settings.names_of(2) == ("joint_1", "elbow")
    for section, words in (
        ("{domain_id: 233}", "ros2.domain_id': found 233"),
        ("{rate_hz: 0}", "ros2.rate_hz': found 0"),
        ("{interface: 'lo\"/>'}", "ros2.interface': found 'lo\"/>', expected a network interface"),
        (
            "{names: {joint_3: wrist}}",
            "ros2.names.joint_3': found that joint, expected one of joint_1, joint_2",
        ),
        ("{names: {joint_1: joint_2}}", "ros2.names.joint_2': found 'joint_2', expected a name of its own"),
        ("{topic: x}", "ros2.topic"),
    ):
        with pytest.raises(ConfigError) as caught:
            load(f"ros2: {section}")
        assert words in str(caught.value)
