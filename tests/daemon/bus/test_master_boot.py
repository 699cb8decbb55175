"""Boot by CiA 302-2: signature 1020h, error behaviour 1029h, optional nodes, other masters, status letters G, H, L."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from jtqd.drivers.boot import BootReport
from jtqd.drivers.boot_node import BootError, signature
from jtqd.drivers.drive import drive_tpdo1
from jtqd.drivers.frame import FRAME
from tests.drivers.canopen_nodes import HubResponder, TestNode, boot_all, drive_store, sensor_store

REQUEST: dict[str, Any] = {
    "bus": "virtual",
    "answer_timeout_s": 0.3,
    "heartbeat_ms": 30,
    "error_behaviour": 0,
    "nodes": [
        {"node": 1, "kind": "drive"},
        {"node": 2, "kind": "drive"},
        {"node": 3, "kind": "sensor", "mandatory": False},
    ],
}


class Bus:
    """Two drives and a sensor; `extra` frames come beside theirs."""

    def __init__(self, directory: Path) -> None:
        self._path = str(directory / "hub")
        self.one, self.two, self.sensor = (
            TestNode(drive_store(1)),
            TestNode(drive_store(2)),
            TestNode(sensor_store(3)),
        )
        self.nodes = [self.one, self.two, self.sensor]
        self.extra: Callable[[], list[tuple[int, bytes]]] = list
        self.heard: list[tuple[int, bytes]] = []

    def boot(self, **changes: Any) -> BootReport:
        responder = HubResponder(self._path, self.nodes)
        responder.extra = self.extra
        responder.hub.attach(self._hear)
        with responder:
            return boot_all({**REQUEST, "bus": f"unix:{self._path}", **changes})

    def _hear(self, frame16: bytes, _stamp_ns: int) -> None:
        can_id, length, data = FRAME.unpack(frame16)
        self.heard.append((can_id, data[:length]))

    def fails(self, **changes: Any) -> BootError:
        with pytest.raises(BootError) as caught:
            self.boot(**changes)
        return caught.value


@pytest.fixture
def bus(tmp_path: Path) -> Bus:
    return Bus(tmp_path)


def test_the_configuration_is_signed_where_the_device_has_1020h(bus: Bus) -> None:
    report = bus.boot()
    date, time = signature(report.nodes[1].configuration_sha256)
    assert (bus.one.store.number(0x1020, 1), bus.one.store.number(0x1020, 2)) == (date, time)
    assert (report.nodes[1].signed, report.nodes[3].signed) == (True, False)
    written = [each for each in bus.one.requests if each[0] >> 5 == 1]
    assert [each[1:4] for each in written[-2:]] == [b"\x20\x10\x01", b"\x20\x10\x02"], (
        "last, when all is in place"
    )
    again = bus.boot()
    assert again.nodes[1].configuration_sha256 == report.nodes[1].configuration_sha256


def test_a_signature_that_is_not_kept_is_a_configuration_that_is_not_taken(bus: Bus) -> None:
    bus.one.store.on_read(0x1020, 1, lambda: 0)
    error = bus.fails()
    assert error.letter == "J"
    assert "1020h:1 configuration signature read back" in str(error)


@pytest.mark.parametrize("behaviour", [0, 1, 2])
def test_error_behaviour_is_written_and_read_back(bus: Bus, behaviour: int) -> None:
    for node in bus.nodes:
        node.store.set_number(0x1029, 1, (behaviour + 1) % 3)
    bus.boot(error_behaviour=behaviour)
    assert [node.store.number(0x1029, 1) for node in bus.nodes] == [behaviour] * 3
    assert bus.one.store.number(0x1016, 1) == 0x20 << 16 | 500, "drives watch jtqd's heartbeat"


def test_error_behaviour_that_does_not_stick_and_a_node_without(bus: Bus) -> None:
    bus.one.store.on_read(0x1029, 1, lambda: 1)
    assert bus.boot().nodes[1].notes == ("1029h:1 error behaviour read back: expected 0x00, found 0x01",)
    for sub in (0, 1):
        del bus.one.store.entries[0x1029, sub]
    bus.one.store._indices.discard(0x1029)
    bus.boot()


def test_without_error_behaviour_in_the_request_it_is_left_alone(bus: Bus) -> None:
    bus.one.store.set_number(0x1029, 1, 2)
    bus.boot(error_behaviour=None)
    assert bus.one.store.number(0x1029, 1) == 2


# Optional nodes ---------------------------------------------------------------------------------------------


def test_an_absent_optional_node_is_named_and_the_others_run(bus: Bus) -> None:
    bus.nodes.remove(bus.sensor)
    report = bus.boot()
    assert sorted(report.nodes) == [1, 2]
    assert str(report.absent[3]) == "node 3: no answer to SDO 1000h:0 within 0.3 s (status B)"
    assert [node.state for node in bus.nodes] == [5, 5]
    assert report.as_json()["absent"]["3"]["letter"] == "B"  # type: ignore[index]


def test_an_absent_mandatory_node_is_a_refusal(bus: Bus) -> None:
    bus.nodes.remove(bus.two)
    assert bus.fails().letter == "B"
    assert bus.one.state != 5


@pytest.mark.parametrize("fault", ["identity", "mapping", "heartbeat", "start", "restart"])
def test_whatever_fails_with_an_optional_node_does_not_keep_the_others(bus: Bus, fault: str) -> None:
    sensor = bus.sensor
    if fault == "identity":
        sensor.store.set_number(0x1000, 0, 0x00020192)
    elif fault == "mapping":
        sensor.store.on_read(0x1A00, 1, lambda: 0)
    elif fault == "heartbeat":
        sensor.beats = False
    elif fault == "start":
        sensor.obeys_start = False
    else:
        sent: list[int] = []

        def boot_up() -> list[tuple[int, bytes]]:
            configured = [each for each in sensor.requests if each[:3] == bytes.fromhex("2b 17 10")]
            if len(sent) == len(configured):
                return []
            sent.append(1)
            return [(0x703, b"\x00")]

        bus.extra = boot_up
    report = bus.boot()
    assert sorted(report.nodes) == [1, 2]
    expected = {"identity": "C", "mapping": "J", "heartbeat": "K", "start": "", "restart": ""}
    assert report.absent[3].letter == expected[fault]


# Another master ---------------------------------------------------------------------------------------------


def test_jtqd_says_its_boot_up_message_before_it_touches_a_node(bus: Bus) -> None:
    bus.boot()
    ours = [each for each in bus.heard if each[0] in (0x000, 0x720)]
    assert ours[0] == (0x720, b"\x00")
    orders = [data for can_id, data in ours if can_id == 0x000]
    assert orders[:4] == [b"\x82\x01", b"\x82\x02", b"\x82\x03", b"\x80\x01"]


def test_jtqds_heartbeat_runs_from_its_boot_up_message_on(bus: Bus) -> None:
    """A drive that watches it (1016h) from its configuration on never misses it, until the loop takes over."""
    bus.boot(answer_timeout_s=1.0)
    ours = [data for can_id, data in bus.heard if can_id == 0x720]
    assert ours[0] == b"\x00"
    assert ours[1:]
    assert set(ours[1:]) == {b"\x7f"}
    first_write = next(n for n, (can_id, data) in enumerate(bus.heard) if can_id == 0x601 and data[0] != 0x40)
    assert (0x720, b"\x7f") in bus.heard[:first_write]


def test_without_the_reset_the_nodes_are_only_stopped(bus: Bus) -> None:
    bus.boot(reset=False)
    orders = [data for can_id, data in bus.heard if can_id == 0x000]
    assert orders[0] == b"\x80\x01"
    assert not any(data[0] in (0x81, 0x82) for data in orders)


def test_another_jtqd_that_boots_at_the_same_time_is_noticed_by_its_boot_up_message(bus: Bus) -> None:
    """It comes late, when the first check has passed."""
    said: list[int] = []

    def boot_up() -> list[tuple[int, bytes]]:
        if said or not bus.one.requests:
            return []
        said.append(1)
        return [(0x720, b"\x00")]

    bus.extra = boot_up
    error = bus.fails()
    assert str(error) == (
        "another node 20h, jtqd's own node-ID, is on the bus (heartbeat or boot-up COB-ID 720h)"
    )
    assert 5 not in [node.state for node in bus.nodes], "nothing is started"


def test_a_running_jtqd_is_not_disturbed(bus: Bus) -> None:
    bus.extra = lambda: [(0x720, b"\x05")]
    bus.fails()
    assert not [each for each in bus.heard if each[0] in (0x000, 0x601, 0x602, 0x603)], (
        "not a word to the nodes"
    )


# Letters ----------------------------------------------------------------------------------------------------


def test_l_a_node_that_was_operational_is_named_and_configured(bus: Bus) -> None:
    bus.one.state = 5
    bus.one.store.set_number(0x1017, 0, 20)  # its heartbeat is heard before anything is sent
    report = bus.boot()
    assert report.nodes[1].notes == ("it was already operational (status L): stopped and configured again",)
    assert bus.one.parameters.tpdos()[0] == drive_tpdo1(1)
    assert report.nodes[2].notes == ()


@pytest.mark.parametrize(("present", "letter"), [(True, "H"), (False, "G")])
def test_g_and_h_software_version(bus: Bus, present: bool, letter: str) -> None:
    if not present:
        del bus.one.store.entries[0x100A, 0]
        bus.one.store._indices.discard(0x100A)
    node = {"node": 1, "kind": "drive", "identity": {"software": "2.7"}}
    error = bus.fails(nodes=[node])
    found = "1.0" if present else "no such object"
    assert str(error) == f"node 1: 100Ah:0 software version: expected 2.7, found {found} (status {letter})"
    if present:
        bus.boot(nodes=[{**node, "identity": {"software": "1.0"}}])
