"""Why a status is what it is, in words; and numbers for people."""

import pytest

from jtqd.daemon.cli.checks import duration, histogram, number, share, size
from jtqd.daemon.config import load_config
from jtqd.daemon.shared.cycle_record import DRIVE_FAULT
from jtqd.daemon.shared.reasons import drive_state, joint_reason, silent_s
from jtqd.daemon.shared.runtime_dir import About
from jtqd.daemon.shared.snapshot import InputView, JointView
from jtqd.daemon.supervisor.description import about
from jtqd.estimator import status as st
from jtqd.estimator.plausibility import LINK_JUMP, MOTOR_JUMP
from tests.daemon.supervisor.watch_views import NAN, WELL, view


@pytest.fixture(scope="module")
def bench() -> About:
    return about(load_config(None), bus="vcan0", instance="vcan0", log_directory=None)


def why(bench: About, one: JointView, **more: int) -> str:
    now = view(1000, one, **more)
    return joint_reason(bench, 1, now, view(900))


def test_a_good_estimate_needs_no_reason(bench: About) -> None:
    assert why(bench, WELL) == ""


def test_stale_names_the_pdo_the_node_or_the_bus(bench: About) -> None:
    stale = WELL._replace(status=st.STALE, torque_nm=NAN, input_flags=1)
    assert why(bench, stale) == "281h drive 1 TPDO2 not received in time"
    assert why(bench, stale._replace(input_flags=2)) == "181h drive 1 TPDO1 not received in time"
    assert why(bench, stale, bus_errors=3) == "the bus is down"
    assert why(bench, stale, foreign_sync=3) == "another SYNC is on the bus"
    assert why(bench, stale._replace(input_flags=3)).startswith("the inputs are back; held until")
    assert (
        why(bench, stale._replace(input_flags=3), overruns=1)
        == "the estimate is not ready before the next SYNC"
    )
    heard = tuple(1_000_000_000 if node == 1 else 0 for node in range(128))
    silent = view(1000, stale)._replace(sync_realtime_ns=3_500_000_000, node_heard_ns=heard)
    assert joint_reason(bench, 1, silent, view(900)) == "node 1 is silent: no heartbeat for 2.5 s"
    assert silent_s(silent._replace(sync_realtime_ns=1_200_000_000), 1, 100) is None
    assert silent_s(silent, 2, 100) is None, "one that has never been heard is not silent"
    unready = view(1000, stale, unconfigured=(1,))
    assert joint_reason(bench, 1, unready, view(900)) == "node 1 is not configured as it was"
    restarted = view(1000, stale, unconfigured=(1,), states={1: 127})
    assert joint_reason(bench, 1, restarted, view(900)).startswith("node 1 has restarted")
    assert (
        joint_reason(bench, 1, view(1000, stale, states={1: 127}), view(900)) == "node 1 is pre-operational"
    )


def test_drive_states(bench: About) -> None:
    assert why(bench, WELL._replace(status=st.OFF, statusword=0x0250)).startswith(
        "drive 1: switch on disabled (6041h 0250h)"
    )
    assert why(bench, WELL._replace(status=st.DRIVE_FAULT, statusword=0x18)) == "drive 1: fault (6041h 0018h)"
    back = why(bench, WELL._replace(status=st.DRIVE_FAULT, statusword=0x27))
    assert back.startswith("drive 1: operation enabled (6041h 0027h); held until")
    assert drive_state(0x1637) == "operation enabled"
    assert drive_state(0x0031) == "ready to switch on"
    assert drive_state(0x0023) == "switched on, not enabled"
    assert drive_state(0x0007) == "quick stop active"
    assert drive_state(0x000F) == "fault reaction active"


def test_degraded_and_invalid(bench: About) -> None:
    far = 1.01 * bench.joints[0].network_limit_nm
    degraded = WELL._replace(status=st.DEGRADED, physics_nm=10.0, network_nm=10.5)
    assert why(bench, degraded).startswith("outside what the network was trained on")
    assert "Nm from physics, trusted to" in why(bench, degraded._replace(network_nm=10.0 - far))
    assert "not a number" in why(bench, degraded._replace(network_nm=NAN))
    assert "no time for the network" in why(bench, degraded._replace(input_flags=0x1F))
    invalid = WELL._replace(status=st.INVALID, torque_nm=NAN)
    found = why(bench, invalid._replace(input_flags=7 | (MOTOR_JUMP | LINK_JUMP) << 8))
    assert found == "the motor position jumped, the link position jumped"
    assert why(bench, invalid).startswith("a fault is over; held until")
    latched = why(bench, invalid._replace(latched=DRIVE_FAULT))
    assert latched == "latched: the drive was in fault; `jtq control reset` releases it"


def test_starting_and_standstill(bench: About) -> None:
    starting = WELL._replace(status=st.STARTING)
    assert joint_reason(bench, 1, view(8, starting), view(0)) == "the first cycles"
    assert joint_reason(bench, 1, view(800, starting), view(0)).startswith("the observer starts again")
    assert "half the interval" in why(bench, WELL._replace(status=st.STANDSTILL))


def test_numbers_for_people() -> None:
    assert [duration(each) for each in (0.0451, 2.34, 59.94, 59.96, 751.2, 11_100.0, 187_300.0, NAN)] == [
        *("45 ms", "2.3 s", "59.9 s", "1 min 00 s", "12 min 31 s", "3 h 05 min", "2 d 04 h", "-"),
    ]
    assert [size(each) for each in (0, 999, 1000, 123_456, 1_230_000_000, None)] == [
        *("0 B", "999 B", "1 kB", "123 kB", "1.23 GB", "-"),
    ]
    assert (number(-1.005), number(NAN), share(0.8476), share(NAN)) == ("-1.00", "-", "84.8 %", "-")


def test_a_histogram_shows_one_cycle_in_a_million() -> None:
    bins = [0] * 100
    bins[10], bins[11], bins[30] = 1_000_000, 500, 1
    line = histogram(bins, 4.0, 60)
    assert line.startswith("40 █▄")
    assert line.endswith("▁ 124 us")
    assert line.count(" ") == 18 + 3, "bins without a cycle are empty"
    assert len(histogram(bins, 4.0, 10)) <= 10 + len("40  136 us")
    assert histogram([0] * 9 + [1], 4.0, 10).endswith("us and more")
    assert histogram([0] * 10, 4.0, 10) == ""


def test_every_field_of_an_input_is_named() -> None:
    assert InputView._fields[:8] == (
        *("used_ns", "delay_ns", "low_ns", "high_ns", "late", "lost", "duplicates", "rejected"),
    )
