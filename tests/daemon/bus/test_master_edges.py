"""Edges of the parts that watch bus and joints: the very last moment, the second time, what is told and what is kept."""

from __future__ import annotations

import pytest

from jtqd.daemon.bus.errors import BusState, EmcyLog, OwnErrors
from jtqd.daemon.bus.nodes import NodeWatch
from jtqd.daemon.shared.conditions import Subject
from jtqd.daemon.shared.snapshot import InputView
from jtqd.daemon.supervisor.health import TIMEOUT_CYCLES, PdoChange, PdoWatch
from jtqd.drivers.object_dictionary import ObjectStore
from tests.daemon.supervisor.watch_views import WELL, Observer, view
from tests.drivers.canopen_nodes import EDS

PDO = Subject("181h drive 1 TPDO1", 0x181, 1, node=1)
SEEN = InputView(*(0,) * 12)
ERR = 0x2000_0000


@pytest.fixture
def errors() -> OwnErrors:
    store = ObjectStore(EDS / "jtqd.eds", 0x20)
    store.set_number(0x1015, 0, 100)  # 10 ms
    return OwnErrors(store)


def test_a_node_has_its_whole_time_and_is_lost_again_after_its_return() -> None:
    watch = NodeWatch((1,), (), 0.1, 0.5)
    watch.watch(1, 1.0)
    assert watch.tick(1.5) == []
    assert [event.kind for event in watch.tick(1.5001)] == ["never"]
    assert [event.kind for event in watch.receive(1, b"\x05", 2.0)] == ["back"]
    assert [event.kind for event in watch.tick(2.6)] == ["lost"]


def test_the_first_state_after_a_restart_is_no_change() -> None:
    watch = NodeWatch((1,), (), 0.1, 0.5)
    watch.watch(1, 0.0)
    watch.receive(1, b"\x05", 0.1)
    assert [event.kind for event in watch.receive(1, b"\x00", 0.2)] == ["restarted"]
    assert watch.receive(1, b"\x7f", 0.3) == []


def test_what_waits_to_be_told_is_bounded_although_all_of_it_is_present(errors: OwnErrors) -> None:
    for detail in range(5000):
        errors.report(0x8210, detail)
    assert len(errors._queue) == 64
    assert len(errors.present) == 5000


def test_an_error_that_comes_again_is_told_again_just_when_the_time_is_over(errors: OwnErrors) -> None:
    told = []
    for n in range(2):
        errors.report(0x8130, 1)
        told.append(errors.tick(0.5 * n))
        errors.reset(0x8130, 1)
        told.append(errors.tick(0.5 * n + 0.25))
    assert [message is not None and message[:2].hex() for message in told] == ["3081", "0000", "3081", "0000"]
    errors.report(0x8130, 1)
    errors.report(0x8130, 2)
    assert errors.tick(2.0) is not None
    assert errors.tick(2.0 + 100 * 1e-4) is not None, "1015h is over"


def test_error_counters_stay_until_a_message_brings_others() -> None:
    bus = BusState()
    bus.error_frame(ERR | 0x204, bytes.fromhex("0020000000008003"))
    bus.error_frame(ERR | 0x080, bytes(8))  # a bus error alone: no counters, one protocol error
    assert (bus.counts["tx_errors"], bus.counts["rx_errors"], bus.counts["protocol_errors"]) == (128, 3, 1)


def test_the_twentieth_cycle_is_the_deadline_and_absent_nodes_have_none() -> None:
    watch = PdoWatch([PDO])
    watch.changes([SEEN], (), 0.0)
    row = SEEN._replace(missed=TIMEOUT_CYCLES, in_a_row=TIMEOUT_CYCLES)
    assert watch.changes([row], (), 0.1) == [PdoChange(0x8250, PDO, True)]
    watch = PdoWatch([PDO])
    watch.changes([SEEN], {1}, 0.0)
    assert watch.changes([row._replace(in_a_row=0)], {1}, 0.1) == []


def test_another_register_is_another_message() -> None:
    seen = EmcyLog([1])
    assert seen.receive(1, bytes.fromhex("1023030000000000"), 0.0) is not None
    assert seen.receive(1, bytes.fromhex("1023010000000000"), 0.1) is not None
    assert seen.receive(1, bytes.fromhex("1023010000000000"), 0.2) is None


def test_a_counters_error_lasts_a_second_and_a_latch_alone_is_a_fault_too(errors: OwnErrors) -> None:
    watch = Observer()
    watch.conditions.subscribe(errors.follow)
    watch.lines(view(1), 10.0)
    watch.lines(view(2, rx_dropped=3), 10.1)
    for now in (10.2, 11.0):
        watch.lines(view(3, rx_dropped=3), now)
        assert (0x8110, 1) in errors.present, now
    watch.lines(view(4, rx_dropped=3), 11.2)
    assert (0x8110, 1) not in errors.present
    watch.lines(view(5, WELL._replace(latched=0x100)), 11.3)
    assert (0xFF01, 1) in errors.present
    assert (0xFF02, 1) in errors.present
    assert (0xFF01, 2) not in errors.present


def test_a_fault_that_is_joined_by_another_has_lasted_from_the_first_on() -> None:
    watch, lines = Observer(), []
    flags = {0.0: 0x04, 2.0: 0x0C, 4.0: 0x0C, 9.0: 0}
    for now, bits in flags.items():
        lines += watch.lines(view(int(now), WELL._replace(input_flags=bits << 8)), now)
    assert [line.split(" (")[-1] for line in lines[:2]] == ["motor_jump)", "link_jump)"]
    assert lines[2:] == ["joint 1: fault cleared after 9.0 s"]


def test_a_fault_that_is_latched_later_says_so() -> None:
    watch = Observer()
    fault = WELL._replace(input_flags=0x0400)
    assert len(watch.lines(view(1, fault), 0.0)) == 1
    (line,) = watch.lines(view(2, fault._replace(latched=0x04)), 10.0)
    assert line == "joint 1: latched: the motor position jumped (motor_jump); `jtq control reset` releases it"
