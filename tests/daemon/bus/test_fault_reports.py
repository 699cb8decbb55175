"""Faults of joints and inputs: lines, objects and EMCY of jtqd's own node, their release."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from jtqd.daemon.bus.own_node import OwnErrors, OwnNode
from jtqd.daemon.config import load_config
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.snapshot import JointView, Snapshot, SnapshotReader, View
from jtqd.drivers.object_dictionary import ObjectStore, read_eds
from jtqd.estimator.status import INVALID
from tests.daemon.snapshots import EstimateWriter
from tests.daemon.supervisor.watch_views import WELL, Observer, view
from tests.paths import JTQD_EDS

JUMP, TORSION = faults.BITS["motor_jump"], faults.BITS["torsion"]


def faulty(bits: int, latched: int = 0) -> JointView:
    return WELL._replace(status=INVALID, input_flags=WELL.input_flags | bits << 8, latched=latched)


def reading(n: int, one: JointView = WELL, two: JointView = WELL) -> View:
    return view(n, one, two)


def test_a_fault_is_reported_when_it_begins_and_when_all_are_over() -> None:
    watch = Observer()
    assert watch.lines(reading(1), 0.0) == []
    assert watch.lines(reading(2, faulty(TORSION)), 1.0) == [
        "joint 1: no torque: the torsion exceeds the limit of the gear (torsion)"
    ]
    assert watch.lines(reading(3, faulty(TORSION)), 20.0) == [], "reported once"
    assert watch.lines(reading(4), 22.5) == ["joint 1: fault cleared after 21.5 s"]


def test_a_latched_fault_is_reported_with_its_release() -> None:
    watch = Observer()
    assert watch.lines(reading(1, WELL, faulty(JUMP, JUMP)), 0.0) == [
        "joint 2: no torque: the motor position jumped (motor_jump)",
        "joint 2: latched: the motor position jumped (motor_jump); `jtq control reset` releases it",
    ]
    assert watch.lines(reading(2, WELL, WELL._replace(latched=JUMP)), 1.0) == []
    assert watch.lines(reading(3), 2.0) == [
        "joint 2: fault cleared after 2.0 s",
        "joint 2: latched faults released after 2.0 s",
    ]


def test_a_fault_that_was_latched_and_released_between_two_readings_is_reported(errors: OwnErrors) -> None:
    """Both messages come, though the second waits for the inhibit time: the error lasts a second."""
    watch = Observer()
    watch.conditions.subscribe(errors.follow)
    released = WELL._replace(latches=1, released=JUMP)
    assert watch.lines(reading(1, WELL._replace(released=TORSION)), 0.0) == [], "released before the start"
    assert watch.lines(reading(2, released), 0.05) == [
        "joint 1: no torque: the motor position jumped (motor_jump)",
        "joint 1: latched: the motor position jumped (motor_jump); `jtq control reset` releases it",
    ]
    for n, now in enumerate((0.1, 0.3, 0.5, 0.7, 0.9, 1.0), start=3):
        assert watch.lines(reading(n, released), now) == []
        assert {(0xFF01, 1), (0xFF02, 1)} <= set(errors.present)
    assert watch.lines(reading(9, released), 1.1) == [
        "joint 1: fault cleared after 1.1 s",
        "joint 1: latched faults released after 1.1 s",
    ]
    again = released._replace(latches=2, released=JUMP | TORSION)
    assert len(watch.lines(reading(10, again), 9.0)) == 2


def test_a_fault_that_comes_and_goes_is_few_lines() -> None:
    watch = Observer()
    lines = [
        line
        for n in range(2000)
        for line in watch.lines(reading(n, faulty(TORSION) if n % 2 else WELL), 0.05 * n)
    ]
    assert 2 <= len(lines) <= 2 * 100 / 5 + 2


@pytest.fixture
def node(tmp_path: Path) -> tuple[ObjectStore, Snapshot, SnapshotReader]:
    """jtqd's own node beside a snapshot."""
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.8)
    reader = SnapshotReader(tmp_path / "s", supervisor=True)
    store = ObjectStore(read_eds(JTQD_EDS, 0x20).entries, 0x20)
    OwnNode(store, load_config(None), reader)
    return store, snapshot, reader


def test_the_latched_faults_are_an_object(node: tuple[ObjectStore, Snapshot, SnapshotReader]) -> None:
    store, snapshot, _ = node
    EstimateWriter(snapshot).write(8, 8, 1, (faulty(JUMP, JUMP | faults.DRIVE_FAULT), WELL))
    assert store.read(0x2104, 1) == struct.pack("<H", JUMP | 0x100)
    assert store.read(0x2104, 2) == bytes(2)


def test_a_reset_by_sdo_is_asked_for_once_and_shown_until_done(
    node: tuple[ObjectStore, Snapshot, SnapshotReader],
) -> None:
    store, snapshot, reader = node
    assert store.read(0x2110, 0) == b"\x00"
    store.write(0x2110, 0, b"\x00")
    assert snapshot.orders[0] == 0, "0 asks for nothing"
    store.write(0x2110, 0, b"\x01")
    assert (snapshot.orders[0], reader.resets_done) == (1, 0)
    assert store.read(0x2110, 0) == b"\x01"
    snapshot.orders[1] = 1  # the loop has done it
    assert store.read(0x2110, 0) == b"\x00"


def test_faults_and_latches_are_emcy_with_the_drives_node(
    node: tuple[ObjectStore, Snapshot, SnapshotReader],
) -> None:
    store, _, _ = node
    errors = OwnErrors(store)
    watch = Observer()
    watch.conditions.subscribe(errors.follow)
    store.set_number(0x1015, 0, 0)

    def reported(one: JointView, two: JointView) -> list[str]:
        watch.lines(reading(1, one, two), 0.0)
        return [message.hex(" ") for message in iter(lambda: errors.tick(0.0), None)]

    assert reported(WELL, WELL) == []
    assert reported(WELL, faulty(TORSION)) == ["01 ff 81 00 00 02 00 02"]
    assert reported(faulty(JUMP, JUMP), faulty(TORSION)) == [
        "01 ff 81 00 00 01 00 01",
        "02 ff 81 00 00 01 00 01",
    ]
    assert reported(faulty(JUMP, JUMP), faulty(TORSION)) == []
    assert reported(faulty(JUMP), WELL) == ["00 00 81 02 ff 01 00 01", "00 00 81 01 ff 02 00 02"]
    assert reported(WELL, WELL) == ["00 00 00 01 ff 01 00 01"]


@pytest.fixture
def errors(node: tuple[ObjectStore, Snapshot, SnapshotReader]) -> OwnErrors:
    return OwnErrors(node[0])


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


def test_a_fault_that_is_latched_later_is_reported_again() -> None:
    watch = Observer()
    fault = WELL._replace(input_flags=0x0400)
    assert len(watch.lines(view(1, fault), 0.0)) == 1
    (line,) = watch.lines(view(2, fault._replace(latched=0x04)), 10.0)
    assert line == "joint 1: latched: the motor position jumped (motor_jump); `jtq control reset` releases it"
