"""Boot against emulated nodes (CiA 302-2): the way it goes, and each thing that goes wrong with the message it gets."""

import dataclasses
import json
import subprocess
import sys

import pytest

from jtqd.drivers import boot as boot_process
from jtqd.drivers.boot import RequestError, parse_request
from jtqd.drivers.boot_node import BootError, BusSettings, NodeBoot, signature
from jtqd.drivers.drive import DriveProfile, Temperature, drive_tpdo1, drive_tpdo2, drive_tpdo3
from jtqd.drivers.frame import FRAME
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.pdo import SYNC_LISTEN_S, PdoParameters, whole_entry
from jtqd.drivers.sensor import SensorProfile, sensor_tpdo1, sensor_tpdo2
from tests.drivers.canopen_nodes import HubResponder, Responder, TestNode, boot_all, drive_store, sensor_store
from tests.paths import ROOT

NODES = [
    {"node": 1, "kind": "drive", "identity": {"vendor": 0x7A1, "product": 0x402}},
    {"node": 2, "kind": "drive", "identity": {"serial": 22}},
    {"node": 3, "kind": "sensor", "channels": [1]},
]
OPTIONAL_SENSOR = [*NODES[:2], {**NODES[2], "mandatory": False}]
REQUEST = {
    "bus": "virtual",
    "answer_timeout_s": 0.2,
    "heartbeat_ms": 30,
    "sync": {"counter_overflow": 240},
    "nodes": NODES,
}


class Bench:
    """Three nodes in a hub; `extra` gives frames of others, `heard` has all frames."""

    def __init__(self, directory):
        self._path = str(directory / "hub")
        self.drive1, self.drive2 = TestNode(drive_store(1)), TestNode(drive_store(2))
        self.sensor = TestNode(sensor_store(3))
        self.nodes = [self.drive1, self.drive2, self.sensor]
        self.drive2.store.set_number(0x1018, 4, 22)
        self.extra, self.heard = list, []

    def boot(self, **changes):
        responder = HubResponder(self._path, self.nodes)
        responder.extra = self.extra
        responder.hub.attach(self._hear)
        with responder:
            return boot_all({**REQUEST, "bus": f"unix:{self._path}", **changes})

    def _hear(self, frame16, _stamp_ns):
        can_id, length, data = FRAME.unpack(frame16)
        self.heard.append((can_id, data[:length]))

    def fails(self, **changes):
        with pytest.raises(BootError) as caught:
            self.boot(**changes)
        return caught.value


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.setattr(boot_process, "SYNC_LISTEN_S", 0.05)  # the nodes here send every 30 ms
    return Bench(tmp_path)


def remove(node, *keys):
    """Take objects out of a node's dictionary."""
    store = node.store
    for key in keys:
        del store.entries[key]
    store._indices.clear()
    store._indices.update(index for index, _ in store.entries)


def change_access(node, key, access):
    node.store.entries[key] = dataclasses.replace(node.store.entries[key], access=access)


def once(frame, condition=lambda: True):
    """Frames of another node: this one, when `condition()` is true for the first time."""
    sent = []

    def extra():
        if sent or not condition():
            return []
        sent.append(1)
        return [frame]

    return extra


def test_three_nodes_end_operational_and_mapped(bench):
    report = bench.boot()
    assert [node.state for node in bench.nodes] == [5, 5, 5]
    assert bench.drive1.parameters.tpdos() == [drive_tpdo1(1), drive_tpdo2(1)]
    assert bench.drive2.parameters.tpdos() == [drive_tpdo1(2), drive_tpdo2(2)]
    assert bench.sensor.parameters.tpdos() == [sensor_tpdo1(3)]  # its second TPDO is switched off
    drive = bench.drive1.store
    assert drive.number(0x1016, 1) == 0x20 << 16 | 500  # watches jtqd's heartbeat
    assert drive.number(0x1017) == 30
    assert drive.number(0x1019) == 240
    assert report.nodes[1].gear_ratio == 100.0
    assert report.nodes[1].name == "emulated joint drive"
    assert report.nodes[2].serial == 22
    assert report.nodes[3].scaling.nm_per_unit == {1: pytest.approx(1e-3)}


def test_the_masters_boot_up_message_and_heartbeat_come_first_then_resets_then_requests(bench, monkeypatch):
    """A drive that watches its master would miss it, and one whose master has ended refuses to be started."""
    monkeypatch.setattr(boot_process, "SYNC_LISTEN_S", SYNC_LISTEN_S)  # as on a bus: time for heartbeats
    bench.boot()
    heard = bench.heard
    boot_up, start = heard.index((0x720, b"\0")), heard.index((0x000, bytes([1, 1])))
    resets = [heard.index((0x000, bytes([0x82, node]))) for node in (1, 2, 3)]
    beats = [n for n, each in enumerate(heard) if each == (0x720, b"\x7f")]
    requests = [n for n, (can_id, _) in enumerate(heard) if 0x600 < can_id < 0x680]
    first_write = next(n for n, (can_id, data) in enumerate(heard) if can_id == 0x601 and data[0] != 0x40)
    assert boot_up < min(resets) <= max(resets) < requests[0] < first_write < start
    assert boot_up < beats[0] < requests[0]
    assert len([n for n in beats if n < start]) >= 3
    orders = [data for can_id, data in heard if can_id == 0x000]
    assert orders[:4] == [b"\x82\x01", b"\x82\x02", b"\x82\x03", b"\x80\x01"]


def test_without_the_reset_the_nodes_are_only_stopped(bench):
    bench.boot(reset=False)
    orders = [data for can_id, data in bench.heard if can_id == 0x000]
    assert orders[0] == b"\x80\x01"
    assert not any(data[0] in (0x81, 0x82) for data in orders)


def test_second_channel_is_mapped_when_used(bench):
    bench.boot(nodes=[{"node": 3, "kind": "sensor", "channels": [1, 2]}])
    assert bench.sensor.parameters.tpdos() == [sensor_tpdo1(3), sensor_tpdo2(3)]
    assert bench.drive1.requests == []  # one node alone can be booted again


def test_the_hash_and_its_signature_change_with_the_configuration(bench):
    first = bench.boot()
    sha256 = first.nodes[1].configuration_sha256
    written = [each[1:4] for each in bench.drive1.requests if each[0] >> 5 == 1]
    assert written[-2:] == [b"\x20\x10\x01", b"\x20\x10\x02"], "last, when all is in place"
    assert tuple(bench.drive1.store.number(0x1020, sub) for sub in (1, 2)) == signature(sha256)
    assert (first.nodes[1].signed, first.nodes[3].signed) == (True, False)
    assert bench.boot().nodes[1].configuration_sha256 == sha256
    bench.drive1.store.set_number(0x6075, 0, 4000)
    assert bench.boot().nodes[1].configuration_sha256 != sha256


def test_mapping_is_written_in_the_order_of_cia_301():
    """Transcript of TPDO1: destroy, clear, entries, count, type, create."""
    node = TestNode(drive_store(1))
    written = []

    class Access:
        def read(self, index, subindex):
            return node.store.read(index, subindex)

        def write(self, index, subindex, data):
            written.append((index, subindex, int.from_bytes(data, "little")))
            node.store.write(index, subindex, data)

    NodeBoot(Access(), DriveProfile(1, temperature=Temperature()), BusSettings()).configure_pdos()
    assert written[:7] == [
        (0x1800, 1, 0xC0000181),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60640020),
        (0x1A00, 2, 0x60E40120),
        (0x1A00, 0, 2),
        (0x1800, 2, 1),
        (0x1800, 1, 0x40000181),
    ]
    assert PdoParameters(node.store).tpdos() == [drive_tpdo1(1), drive_tpdo2(1), drive_tpdo3(1)]
    assert written[15:] == [
        (0x1802, 1, 0xC0000381),
        (0x1A02, 0, 0),
        (0x1A02, 1, 0x30010010),
        (0x1A02, 0, 1),
        (0x1802, 2, 255),
        (0x1802, 3, 5000),  # 100 us: a value that flickers sends no more than the timer does
        (0x1802, 5, 500),
        (0x1802, 1, 0x40000381),
    ]


@pytest.mark.parametrize("behaviour", [0, 1, 2, None])
def test_error_behaviour_is_written_and_read_back_or_left_alone(bench, behaviour):
    for node in bench.nodes:
        node.store.set_number(0x1029, 1, ((behaviour or 0) + 1) % 3)
    bench.boot(error_behaviour=behaviour)
    assert [node.store.number(0x1029, 1) for node in bench.nodes] == [
        1 if behaviour is None else behaviour
    ] * 3


def test_1019h_is_written_only_where_it_differs(bench):
    for overflow, writes in ((0, 0), (240, 1)):
        bench.boot(sync={"counter_overflow": overflow})
        written = [request for request in bench.drive1.requests if request[:3] == bytes.fromhex("2f 19 10")]
        assert len(written) == writes


# Temperature ------------------------------------------------------------------------------------------------


def test_temperature_is_mapped_where_it_is_configured(bench):
    bench.drive1.store.set_number(0x1802, 5, 0)  # left without its timer, and off, by another master
    bench.drive1.store.set_number(0x1802, 1, 0xC0000381)
    nodes = [{"node": 1, "kind": "drive", "temperature": {}}, {"node": 2, "kind": "drive"}]
    report = bench.boot(nodes=nodes)
    assert bench.drive1.parameters.tpdos() == [drive_tpdo1(1), drive_tpdo2(1), drive_tpdo3(1)]
    assert bench.drive2.parameters.tpdos() == [drive_tpdo1(2), drive_tpdo2(2)]
    assert bench.drive1.store.number(0x1802, 5) == 500
    assert report.nodes[1].tpdos == (drive_tpdo1(1), drive_tpdo2(1), drive_tpdo3(1))
    cold = report.nodes[1].configuration_sha256
    bench.drive1.store.set_number(0x3001, 0, 300)
    assert bench.boot(nodes=nodes).nodes[1].configuration_sha256 == cold, "a value is no configuration"


def test_a_temperature_in_another_object_is_mapped_as_3001h_would_be(bench):
    store, standard = bench.drive1.store, bench.drive1.store.entries[0x3001, 0]
    store.entries[0x2040, 1] = dataclasses.replace(standard, index=0x2040, subindex=1)
    store._indices.add(0x2040)
    store._values[0x2040, 1] = standard.default
    own = {"index": 0x2040, "subindex": 1, "c_per_unit": 0.01}
    report = bench.boot(nodes=[{"node": 1, "kind": "drive", "temperature": own}])
    assert report.nodes[1].tpdos[2] == drive_tpdo3(1, Temperature(0x2040, 1))
    assert bench.drive1.parameters.tpdos()[2].words == (0x2040_0110,)
    assert (store.number(0x1802, 3), store.number(0x1802, 5)) == (5000, 500)
    own["index"] = 0x2041
    error = bench.fails(nodes=[{"node": 1, "kind": "drive", "temperature": own}])
    assert "2041h:1 joint temperature: expected a value" in str(error)


def test_a_node_without_an_inhibit_time_is_mapped_all_the_same(bench):
    remove(bench.drive1, (0x1802, 3))
    bench.boot(nodes=[{"node": 1, "kind": "drive", "temperature": {}}])
    assert bench.drive1.parameters.tpdos()[2] == drive_tpdo3(1)


# What goes wrong --------------------------------------------------------------------------------------------


def test_absent_node(bench):
    bench.nodes.remove(bench.drive2)
    error = bench.fails()
    assert str(error) == "node 2: no answer to SDO 1000h:0 within 0.2 s (status B)"
    assert (error.node, error.object, error.letter) == (2, "1000h:0", "B")
    assert bench.drive1.state == bench.sensor.state == 0x7F  # nothing is started


def test_a_lost_answer_is_asked_for_again(bench):
    lost = []

    def lose_first(request, reply):
        if not lost:
            lost.append(request)
            return None
        return reply

    bench.drive1.answer = lose_first
    bench.boot(nodes=[{**NODES[0], "sdo_timeout_ms": 50}, *NODES[1:]])
    assert bench.drive1.requests.count(lost[0]) == 2


def test_a_late_answer_to_another_request_is_not_taken(bench):
    """Before the real answer to the write of 1A00h:1, one for another object arrives."""

    def wrong_index(request, reply):
        if request[:4] == bytes.fromhex("23 00 1A 01") and bench.drive1.requests.count(request) == 1:
            return bytes.fromhex("60 17 10 00 00 00 00 00")
        return reply

    bench.drive1.answer = wrong_index
    bench.boot(nodes=[{**NODES[0], "sdo_timeout_ms": 50}, *NODES[1:]])
    assert bench.drive1.requests.count(bytes.fromhex("23 00 1A 01 20 00 64 60")) == 2  # asked again
    assert bench.drive1.parameters.tpdos()[0] == drive_tpdo1(1)


@pytest.mark.parametrize(
    ("identity", "place", "value", "text"),
    [
        (
            "",
            (1, 0x1000, 0),
            0x20194,
            "device type: expected profile 402 (0x....0192), found 0x00020194 (status C)",
        ),
        ("", (1, 0x1005, 0), 0x90, "COB-ID SYNC: expected 080h, found 0x00000090"),
        ("", (2, 0x6091, 2), 0, "gear ratio driving shaft revolutions: expected 1..2147483648, found 0"),
        ("", (2, 0x6075, 0), 0, "motor rated current in mA: expected 1..1000000, found 0"),
        ("", (3, 0x6112, 1), 0, "channel operating mode: expected 1 (normal operation), found 0"),
        ("vendor", (2, 0x1018, 1), 0x403, "vendor-ID: expected 0x00000402, found 0x00000403 (status D)"),
        ("product", (2, 0x1018, 2), 0x403, "product code: expected 0x00000402, found 0x00000403 (status M)"),
        (
            "revision",
            (2, 0x1018, 3),
            0x403,
            "revision number: expected 0x00000402, found 0x00000403 (status N)",
        ),
        ("serial", (2, 0x1018, 4), 0x403, "serial number: expected 0x00000402, found 0x00000403 (status O)"),
    ],
)
def test_a_wrong_value_is_named(bench, identity, place, value, text):
    node, index, subindex = place
    bench.nodes[node - 1].store.set_number(index, subindex, value)
    nodes = [{"node": 2, "kind": "drive", "identity": {identity: 0x402}}] if identity else NODES
    assert str(bench.fails(nodes=nodes)) == f"node {node}: {index:04X}h:{subindex} {text}"


@pytest.mark.parametrize(("present", "letter"), [(True, "H"), (False, "G")])
def test_another_software_version(bench, present, letter):
    if not present:
        remove(bench.drive1, (0x100A, 0))
    node = {"node": 1, "kind": "drive", "identity": {"software": "2.7"}}
    found = "1.0" if present else "no such object"
    expected = f"node 1: 100Ah:0 software version: expected 2.7, found {found} (status {letter})"
    assert str(bench.fails(nodes=[node])) == expected
    if present:
        bench.boot(nodes=[{**node, "identity": {"software": "1.0"}}])


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ((0x1A01, 2), 0x60770010, "mapping entry read back: expected 0x60780010, found 0x60770010"),
        ((0x1800, 2), 255, "transmission type read back: expected 0x01, found 0xFF"),
        ((0x1A02, 1), 0x30010020, "mapping entry read back: expected 0x30010010, found 0x30010020"),
        ((0x1802, 2), 1, "transmission type read back: expected 0xFF, found 0x01"),
        ((0x1802, 3), 0, "inhibit time in 100 us read back: expected 0x1388, found 0x0000"),
        ((0x1802, 5), 0, "event timer in ms read back: expected 0x01F4, found 0x0000"),
        ((0x1020, 1), 0, "configuration signature read back: expected 0x"),
    ],
)
def test_a_value_that_is_not_kept(bench, key, value, text):
    bench.drive1.store.on_read(*key, lambda: value)
    error = bench.fails(nodes=[{"node": 1, "kind": "drive", "temperature": {}}])
    assert str(error).startswith(f"node 1: {key[0]:04X}h:{key[1]} {text}")
    assert error.letter == "J"


@pytest.mark.parametrize(
    ("node", "missing", "text"),
    [
        (
            {"node": 2, "kind": "drive", "temperature": {}},
            [(0x3001, 0)],
            "3001h:0 joint temperature: expected a value (required by the configuration), "
            "found no such object (status J)",
        ),
        (
            {"node": 2, "kind": "drive"},
            [(0x60E6, 0), (0x60E6, 1)],
            "60E6h:1: read refused: object does not exist (06020000h)",
        ),
        (
            {"node": 2, "kind": "drive"},
            [(0x1019, 0)],
            "1019h:0 SYNC counter overflow: expected 240 (sync.counter_overflow; 0 for SYNC without a counter), "
            "found no such object (status J)",
        ),
    ],
)
def test_a_missing_object_is_named(bench, node, missing, text):
    remove(bench.drive2, *missing)
    assert str(bench.fails(nodes=[node])) == f"node 2: {text}"


def test_what_a_node_may_lack(bench):
    """Serial number, operating mode; a temperature that is not configured, a scaling object that is given, a counter."""
    remove(bench.sensor, (0x6112, 0), (0x6112, 1), (0x6112, 2))
    remove(bench.drive1, (0x1018, 4), (0x3001, 0), (0x60E6, 0), (0x60E6, 1), (0x1019, 0))
    given = {"node": 1, "kind": "drive", "identity": {"revision": 0x10000}, "given": {"60E6h:1": 1024}}
    report = bench.boot(nodes=[given, NODES[2]], sync={"counter_overflow": 0})
    assert report.nodes[1].serial == 0
    assert report.nodes[1].notes == ()
    assert report.nodes[1].scaling.link_rad_per_count == pytest.approx(2 * 3.141592653589793 / 1024)
    assert sorted(report.nodes) == [1, 3]


def test_what_is_cosmetic_or_optional_fails_nothing(bench):
    """1008h is refused with another code, 1016h and 1029h do not keep what is written, 1014h is another COB-ID."""
    store = bench.drive1.store
    answered = bench.drive1.answer

    def refuse_name(request, reply):
        if request[1:3] == bytes.fromhex("08 10"):
            return bytes.fromhex("80 08 10 00 20 00 00 08")
        return answered(request, reply)

    bench.drive1.answer = refuse_name
    store.on_read(0x1016, 1, lambda: 0)
    store.on_read(0x1014, 0, lambda: 0x8000_0081)
    store.on_read(0x1029, 1, lambda: 1)
    remove(bench.drive2, (0x1029, 0), (0x1029, 1))
    report = bench.boot(error_behaviour=0)
    assert report.nodes[2].notes == ()
    node = report.nodes[1]
    assert node.name == ""
    assert node.notes == (
        "1016h:1 consumer heartbeat time read back: expected 0x002001F4, found 0x00000000: "
        "the drive does not notice when jtqd's heartbeat ends",
        "1014h COB-ID EMCY: expected 081h, found 0x80000081: its EMCY messages are not read",
        "1029h:1 error behaviour read back: expected 0x00, found 0x01",
    )


def test_a_name_that_steers_a_terminal_is_replaced(bench):
    bench.drive1.store.set_text(0x1008, 0, "\x1b[2Jdrive")
    assert bench.boot().nodes[1].name == "?[2Jdrive"


def test_a_sync_producer_is_switched_off(bench):
    store = bench.drive1.store
    change_access(bench.drive1, (0x1005, 0), "rw")
    store.set_number(0x1005, 0, 0x4000_0080)
    report = bench.boot(sync={"counter_overflow": 0})
    assert store.number(0x1005, 0) == 0x80
    assert report.nodes[1].notes == ("1005h: it was a SYNC producer, which jtqd is",)


# NMT and heartbeat ------------------------------------------------------------------------------------------


def test_no_heartbeat(bench):
    bench.sensor.beats = False
    assert str(bench.fails()) == "node 3: no heartbeat 703h within 0.1 s (status K)"
    assert bench.drive1.state == 0x7F


def test_a_node_that_is_never_operational_explains_itself(bench):
    """1001h, 1003h and the last EMCY of the boot are in the line."""
    node = bench.drive1
    node.obeys_start = False
    node.store.set_number(0x1001, 0, 0x11)
    node.store.on_read(0x1003, 0, lambda: 1)
    node.store.on_read(0x1003, 1, lambda: 0x8130)
    bench.extra = once((0x081, bytes.fromhex("10 23 03 00 00 00 00 00")), lambda: node.requests)
    assert str(bench.fails()) == (
        "node 1: NMT start: expected operational within 0.1 s, found pre-operational"
        "; 1001h is 11h (generic, communication), 1003h:1 is 8130h (life guard or heartbeat)"
        ", its last EMCY is 2310h (continuous overcurrent)"
    )


def restarting(node, times):
    """Frames of a node that sends its boot-up message again each time that it has been configured, so many times."""
    sent = []

    def boot_up():
        configured = [request for request in node.requests if request[:3] == bytes.fromhex("2b 17 10")]
        if len(sent) == min(times, len(configured)):
            return []
        sent.append(1)
        return [(0x700 + node.node, b"\x00")]

    return boot_up


def test_a_node_that_restarts_during_its_configuration_is_configured_again(bench):
    """Some send their boot-up message twice; of others the mapping is the default one again."""
    bench.extra = restarting(bench.drive2, 1)
    report = bench.boot()
    assert report.nodes[2].notes == (
        "it sent its boot-up message again during its configuration: configured once more",
    )
    assert bench.drive2.state == 5


def test_a_node_that_restarts_at_every_configuration_is_refused(bench):
    bench.extra = restarting(bench.drive2, 100)
    assert str(bench.fails()).startswith("node 2: the node restarted during boot")


def test_a_drive_that_leaves_operational_once_is_started_again(bench):
    """Its watch (1016h) runs out right after NMT start: it leaves operational (1029h), once."""

    class WatchingDrive(TestNode):
        starts = 0

        def frames(self, can_id, data):
            out = super().frames(can_id, data)
            if can_id == 0 and data[0] == 1:
                self.starts += 1
                self.state = 0x7F if self.starts == 1 else self.state
            return out

    drive = WatchingDrive(drive_store(1))
    bench.nodes[:] = [drive]
    bench.boot(nodes=[{"node": 1, "kind": "drive"}])
    assert (drive.state, drive.starts) == (5, 2)
    # It watches its master all the same: one that dies stops it.
    assert drive.store.number(0x1016, 1) == 0x20 << 16 | 500


def test_a_node_that_was_operational_is_named_and_configured(bench):
    bench.drive1.state = 5
    bench.drive1.store.set_number(0x1017, 0, 20)  # its heartbeat is heard before anything is sent
    report = bench.boot()
    assert report.nodes[1].notes == ("it was already operational (status L): stopped and configured again",)
    assert bench.drive1.parameters.tpdos()[0] == drive_tpdo1(1)
    assert report.nodes[2].notes == ()


def test_garbage_on_the_answer_identifiers_is_ignored(bench):
    bench.extra = lambda: [(0x581, b""), (0x581, b"\x80"), (0x701, b""), (0x701, b"\x00\x00")]
    bench.boot()


# Another master ---------------------------------------------------------------------------------------------


def test_foreign_sync(bench):
    bench.extra = lambda: [(0x080, b"\x01")]
    assert "another SYNC producer is on the bus (COB-ID 080h" in str(bench.fails())
    assert [node.state for node in bench.nodes] == [0x7F] * 3
    bench.boot(sync={"check_foreign": False})  # jtqd's own SYNC runs when one node is booted again


def test_a_running_jtqd_is_not_disturbed(bench):
    bench.extra = lambda: [(0x720, b"\x05")]
    bench.fails()
    assert not [each for each in bench.heard if each[0] in (0x000, 0x601, 0x602, 0x603)]


def test_another_jtqd_that_boots_at_the_same_time_is_noticed_by_its_boot_up_message(bench):
    """It comes late, when the first check has passed."""
    bench.extra = once((0x720, b"\x00"), lambda: bench.drive1.requests)
    assert str(bench.fails()) == (
        "another node 20h, jtqd's own node-ID, is on the bus (heartbeat or boot-up COB-ID 720h)"
    )
    assert 5 not in [node.state for node in bench.nodes], "nothing is started"


# Optional nodes ---------------------------------------------------------------------------------------------


def test_an_absent_optional_node_is_named_and_the_others_run(bench):
    bench.nodes.remove(bench.sensor)
    report = bench.boot(nodes=OPTIONAL_SENSOR)
    assert sorted(report.nodes) == [1, 2]
    assert str(report.absent[3]) == "node 3: no answer to SDO 1000h:0 within 0.2 s (status B)"
    assert [node.state for node in bench.nodes] == [5, 5]
    assert report.as_json()["absent"]["3"]["letter"] == "B"


@pytest.mark.parametrize(
    ("fault", "letter"),
    [("identity", "C"), ("mapping", "J"), ("heartbeat", "K"), ("start", ""), ("restart", "")],
)
def test_a_failure_of_an_optional_node_does_not_stop_the_others(bench, fault, letter):
    sensor = bench.sensor
    if fault == "identity":
        sensor.store.set_number(0x1000, 0, 0x00020192)
    elif fault == "mapping":
        sensor.store.on_read(0x1A00, 1, lambda: 0)
    elif fault == "heartbeat":
        sensor.beats = False
    elif fault == "start":
        sensor.obeys_start = False
    else:
        bench.extra = restarting(sensor, 100)
    report = bench.boot(nodes=OPTIONAL_SENSOR)
    assert sorted(report.nodes) == [1, 2]
    assert report.absent[3].letter == letter


def test_an_optional_node_is_waited_for_half_a_second_at_most():
    for answer_s, expected in ((2.0, (2.0, 0.5)), (0.2, (0.2, 0.2))):
        request = parse_request({"bus": "can0", "answer_timeout_s": answer_s, "nodes": OPTIONAL_SENSOR})
        assert (request.timeout_s(1), request.timeout_s(3)) == expected


# Mapping that is fixed in the drive -------------------------------------------------------------------------


def test_refused_mapping(bench):
    def refuse(request, reply):
        if request[:4] == bytes.fromhex("23 00 1A 01"):
            return bytes.fromhex("80 00 1A 01 41 00 04 06")
        return reply

    bench.drive1.answer = refuse
    error = bench.fails()
    assert str(error).startswith(
        "node 1: 1A00h:1: write of 0x60640020 refused: object cannot be mapped (06040041h); "
        "no TPDO carries 60E4h:1 (link position), 6078h:0 (current), 6041h:0 (statusword); TPDO1 carries"
    )
    assert error.letter == "J"


def test_what_was_written_before_a_refusal_is_put_back(bench):
    """TPDO1 was mapped, and the second entry of TPDO2 is refused: entries, numbers, types and COB-IDs are as before."""
    store = bench.drive1.store

    def objects():
        keys = [(0x1A00 + n, sub) for n in range(3) for sub in range(3)]
        keys += [(0x1800 + n, sub) for n in range(3) for sub in (1, 2)]
        return {key: store.number(*key) for key in keys}

    for index, subindex, value in (
        (0x1A00, 0, 1),
        (0x1A00, 1, 0x6041_0010),
        (0x1A01, 0, 2),
        (0x1A01, 1, 0x6061_0008),
        (0x1A01, 2, 0x6077_0010),
        (0x1800, 2, 255),
    ):
        store.set_number(index, subindex, value)
    before = objects()
    change_access(bench.drive1, (0x1A01, 2), "ro")
    assert "no TPDO carries 6064h:0" in str(bench.fails())
    assert objects() == before


def fixed(node, *tpdos, valid=True, kind=1, writable=()):
    """Make the mapping of its TPDOs 1, 2, ... read-only, with these words; entries `writable` stay so."""
    store = node.store
    for number in range(4):
        if not store.has(0x1A00 + number, 1):
            continue
        words = tpdos[number] if number < len(tpdos) else ()
        store.set_number(0x1A00 + number, 0, len(words))
        for entry, word in enumerate(words, 1):
            store.set_number(0x1A00 + number, entry, word)
        cob_id = 0x4000_0180 + 0x100 * number + 1
        store.set_number(0x1800 + number, 1, cob_id if valid and words else cob_id | 0x8000_0000)
        store.set_number(0x1800 + number, 2, kind)
    for key in [key for key in store.entries if 0x1800 <= key[0] < 0x1C00 and key not in writable]:
        change_access(node, key, "ro")


COB_IDS = tuple((index, 1) for index in range(0x1800, 0x1804))
RIGHT = tuple(pdo.words for pdo in (drive_tpdo1(1), drive_tpdo2(1)))
ELSEWHERE = (0x6041_0010, 0x6064_0020), (0x606C_0020, 0x6078_0010, 0x6061_0008), (0x60E4_0120,)
"""Layout of a drive whose maker has thought of other readers."""


def test_what_is_as_wanted_is_not_written(bench):
    """The second boot finds what the first has written: it maps nothing."""
    bench.boot()
    bench.drive1.requests.clear()
    node = bench.boot(reset=False).nodes[1]
    written = [each for each in bench.drive1.requests if each[0] & 0xE0 == 0x20 and 0x18 <= each[2] < 0x1C]
    assert written == []
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))


@pytest.mark.parametrize("writable", [(), COB_IDS])
def test_a_fixed_mapping_that_is_the_right_one_is_used(bench, writable):
    fixed(bench.drive1, *RIGHT, valid=not writable, writable=writable)
    node = bench.boot().nodes[1]
    assert bench.drive1.state == 5
    assert bench.drive1.store.number(0x1800, 1) == 0x4000_0181, "it is on"
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))


@pytest.mark.parametrize("writable", [(), COB_IDS])
def test_another_fixed_mapping_is_used_as_it_is(bench, writable):
    fixed(bench.drive1, *ELSEWHERE, writable=writable)
    node = bench.boot().nodes[1]
    assert bench.drive1.state == 5
    assert [(pdo.number, pdo.cob_id, pdo.words) for pdo in node.tpdos] == [
        (1, 0x181, ELSEWHERE[0]),
        (2, 0x281, ELSEWHERE[1]),
        (3, 0x381, ELSEWHERE[2]),
    ]
    assert node.notes[0].startswith(
        "its mapping is used as it is: TPDO1 (181h), TPDO2 (281h), TPDO3 (381h) (1"
    )
    cob_ids = [bench.drive1.store.number(0x1800 + n, 1) for n in range(3)]
    assert cob_ids == [0x4000_0181, 0x4000_0281, 0x4000_0381]
    watched = {(index, sub): value for index, sub, value in node.watched}
    assert watched[0x1A01, 2] == 0x6078_0010, "and watched in service"
    again = bench.boot().nodes[1].configuration_sha256
    assert again == node.configuration_sha256, "what the attempt has read is not in it"


@pytest.mark.parametrize("layout", [RIGHT, ELSEWHERE])
@pytest.mark.parametrize("writable", [(), COB_IDS])
def test_bit_7_of_a_mapped_length_does_not_count(bench, layout, writable):
    """Some drives set it for a signed object; what else is above 64 bits is no length."""
    odd = {0x6064_0020, 0x606C_0020, 0x6078_0010, 0x60E4_0120}
    words = [tuple(word | 0x80 if word in odd else word for word in pdo) for pdo in layout]
    fixed(bench.drive1, *words, writable=writable)
    node = bench.boot().nodes[1]
    assert bench.drive1.state == 5
    assert [pdo.words for pdo in node.tpdos] == list(layout)
    assert "TPDO1: taken as " in "".join(node.notes) or layout == RIGHT
    again = bench.boot().nodes[1]
    assert (again.configuration_sha256, again.tpdos) == (node.configuration_sha256, node.tpdos)


@pytest.mark.parametrize(
    ("bits", "taken"), [(0xA0, 32), (0x90, 16), (0xC0, 64), (0x48, 72), (0xC8, 72), (0x40, 64)]
)
def test_lengths_of_a_mapping(bits, taken):
    assert whole_entry(0x6064_0000 | bits) == 0x6064_0000 | taken


def test_a_temperature_in_a_fixed_mapping_is_used_where_it_is_alone_in_tpdo3(bench):
    fixed(bench.drive1, *ELSEWHERE[:2], (0x3001_0010,))
    bench.drive1.store.set_number(0x1802, 2, 255)
    node = {"node": 1, "kind": "drive", "temperature": {}, "objects": {"link_position": None}}
    used = bench.boot(nodes=[node]).nodes[1].tpdos
    assert [pdo.words for pdo in used][2:] == [(0x3001_0010,)]
    assert used[2].transmission_type == 255
    node["temperature"] = {"index": 0x6077, "c_per_unit": 0.1}
    error = bench.fails(nodes=[node])
    assert "no TPDO with COB-ID 381h carries 6077h:0 alone (temperature)" in str(error)


def test_a_tpdo_that_is_not_needed_and_cannot_be_switched_off_is_noted(bench):
    fixed(bench.drive1, *RIGHT, (0x6061_0008,))
    node = bench.boot().nodes[1]
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))
    assert any("TPDO3 is not needed and stays on" in note for note in node.notes)


def test_another_cob_id_of_the_predefined_set(bench):
    fixed(bench.drive1, *ELSEWHERE)
    bench.drive1.store.set_number(0x1802, 1, 0x4000_0481)
    assert [pdo.cob_id for pdo in bench.boot().nodes[1].tpdos] == [0x181, 0x281, 0x481]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ((0x1802, 1, 0x4000_0391), "TPDO3: TPDO3 has COB-ID 391h, expected one of 181h, 281h, 381h, 481h"),
        ((0x1802, 1, 0x6000_0381), "TPDO3: TPDO3 has a 29-bit COB-ID"),
        ((0x1A02, 1, 0x60E4_0110), "TPDO3: 60E4h:1 is mapped with 16 bits, expected 32"),
        (
            (0x1A02, 1, 0x6064_0020),
            "no TPDO carries 60E4h:1 (link position); TPDO1 carries 0x60410010, 0x60640020",
        ),
    ],
)
def test_a_fixed_mapping_that_is_not_enough_is_named(bench, change, text):
    fixed(bench.drive1, *ELSEWHERE)
    bench.drive1.store.set_number(*change)
    found = str(bench.fails())
    assert "node 1: 1800h:1: write of 0xC0000181 refused: object is read only (06010002h); no TPDO" in found
    assert text in found


def test_a_transmission_type_that_cannot_be_written_is_named(bench):
    fixed(bench.drive1, *ELSEWHERE, kind=10)
    assert "1800h:2: write of 0x01 refused" in str(bench.fails())


@pytest.mark.parametrize("kind", [0, 254, 255])
def test_an_acyclic_type_that_cannot_be_written_is_accepted_where_an_age_is_configured(bench, kind):
    fixed(bench.drive1, *ELSEWHERE, kind=kind)
    assert f"TPDO1 has transmission type {kind}: joint_N.max_age_ms allows it" in str(bench.fails())
    node = bench.boot(nodes=[{**NODES[0], "acyclic": True}, *NODES[1:]]).nodes[1]
    assert [pdo.transmission_type for pdo in node.tpdos] == [kind] * 3
    assert f"TPDO1 keeps transmission type {kind}" in node.notes


def test_a_configured_layout_is_written(bench):
    """TPDOs of the request: one PDO has two quantities, another one the rest."""
    words = [0x6041_0010, 0x6064_0020], [0x606C_0020, 0x6078_0010], [0x60E4_0120]
    tpdos = [
        {"number": number, "cob_id": cob_id, "transmission_type": 1, "words": entries}
        for number, cob_id, entries in zip((1, 2, 3), (0x381, 0x281, 0x181), words, strict=True)
    ]
    node = bench.boot(nodes=[{**NODES[0], "tpdos": tpdos}, *NODES[1:]]).nodes[1]
    assert [(pdo.number, pdo.cob_id) for pdo in node.tpdos] == [(1, 0x381), (2, 0x281), (3, 0x181)]
    assert bench.drive1.parameters.tpdos() == list(node.tpdos)


# The request and the process --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "key", "text"),
    [
        ({"bus": 3}, "bus", "found 3, expected `str`"),
        ({"nodes": []}, "nodes", "found [], expected `array` of length >= 1"),
        ({"nodes": [{"node": 1, "kind": "motor"}]}, "nodes[0].kind", "invalid value 'motor'"),
        ({"nodes": [{"node": 200, "kind": "drive"}]}, "nodes[0].node", "found 200, expected `int` <= 127"),
        ({"nodes": [{"node": 1, "kind": "drive"}] * 2}, "request", "found [1, 1] and master 32"),
        ({"nodes": [{"node": 1, "kind": "drive", "speed": 1}]}, "nodes[0]", "unknown field `speed`"),
        ({"nodes": [{"node": 1, "kind": "drive", "given": {"x": 1}}]}, "request", "nodes[0]: 'x' is not an"),
        ({"nodes": [{"node": 3, "kind": "sensor", "channels": [2]}]}, "request", "channels (2,), expected"),
        ({"nodes": [{"node": 1, "kind": "drive", "temperature": 1}]}, "nodes[0].temperature", "found 1"),
        (
            {
                "nodes": [
                    {"node": 1, "kind": "drive", "tpdos": [{"number": 1, "cob_id": 0x191, "words": [0]}]}
                ]
            },
            "request",
            "nodes[0]: TPDO1 has COB-ID 191h, expected one of 181h, 281h, 381h, 481h",
        ),
        (
            {
                "nodes": [
                    {"node": 1, "kind": "drive", "objects": {"current": {"index": 0x6077, "by": "6076h"}}}
                ]
            },
            "request",
            "nodes[0]: torque_constant_nm_per_a: found 0.0, expected a number above 0",
        ),
        ({"nodes": [{"node": 1, "kind": "drive", "mandatory": "no"}]}, "nodes[0].mandatory", "found 'no'"),
        (
            {"nodes": [{"node": 1, "kind": "drive", "identity": {"software": 2}}]},
            "nodes[0].identity.software",
            "found 2, expected `str | null`",
        ),
        ({"answer_timeout_s": 0}, "answer_timeout_s", "found 0, expected `float` > 0.0"),
        ({"heartbeat_ms": True}, "heartbeat_ms", "found True, expected `int`"),
        ({"error_behaviour": 3}, "error_behaviour", "found 3, expected `int` <= 2"),
        ({"sync": {"counter_overflow": 241}}, "sync.counter_overflow", "found 241, expected `int` <= 240"),
    ],
)
def test_wrong_requests_are_named(change, key, text):
    with pytest.raises(RequestError) as caught:
        parse_request({**REQUEST, **change})
    message = str(caught.value)
    assert message.startswith(f"{key}: ")
    assert text in message


def test_request_becomes_profiles():
    request = parse_request(REQUEST)
    assert request.profiles == (
        DriveProfile(1, Identity(vendor=0x7A1, product=0x402)),
        DriveProfile(2, Identity(serial=22)),
        SensorProfile(3),
    )
    assert (request.heartbeat_ms, request.sync.counter_overflow) == (30, 240)
    assert parse_request(json.loads(json.dumps(request.as_json()))) == request


def run_boot(request, *arguments):
    text = request if isinstance(request, str) else json.dumps(request)
    command = [sys.executable, "-m", "jtqd.drivers.boot", *arguments]
    done = subprocess.run(
        command, input=text, capture_output=True, text=True, timeout=20, check=False, cwd=ROOT
    )
    assert done.stderr == ""
    return done.returncode, json.loads(done.stdout)


def test_process_over_the_unix_bus(tmp_path, bench):
    path = str(tmp_path / "bus")
    with HubResponder(path, bench.nodes):
        status, report = run_boot({**REQUEST, "bus": f"unix:{path}"}, "drivers/eds/jtqd.eds", "32")
    assert (status, report["ok"]) == (0, True)
    assert report["duration_s"] < 0.5
    assert sorted(report["nodes"]) == ["1", "2", "3"]
    assert report["nodes"]["1"]["scaling"]["ampere_per_unit"] == pytest.approx(0.005)
    assert report["nodes"]["3"]["scaling"] == {"nm_per_unit": {"1": pytest.approx(0.001)}}
    assert bench.drive2.parameters.tpdos() == [drive_tpdo1(2), drive_tpdo2(2)]
    assert report["own_entries"][0]["index"] == 0x1000


def test_process_names_the_fault_without_a_traceback(tmp_path, bench):
    path = str(tmp_path / "bus")
    bench.drive2.store.set_number(0x1018, 4, 23)
    with HubResponder(path, bench.nodes):
        status, report = run_boot({**REQUEST, "bus": f"unix:{path}"})
    assert status == 1
    assert report == {
        "ok": False,
        "error": {
            "node": 2,
            "object": "1018h:4",
            "expected": "0x00000016",
            "found": "0x00000017",
            "letter": "O",
            "message": "node 2: 1018h:4 serial number: expected 0x00000016, found 0x00000017 (status O)",
        },
    }


def test_process_without_a_bus(tmp_path):
    for bus in (f"unix:{tmp_path}/none", "nocan7"):
        status, report = run_boot({**REQUEST, "bus": bus})
        assert (status, report["ok"]) == (1, False)
        assert report["error"]["message"].startswith(f"bus {bus}: ")


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"bus": "can0"}'])
def test_process_with_a_broken_request(text):
    status, report = run_boot(text)
    assert status == 1
    assert report["error"]["message"].startswith("boot request: ")


@pytest.mark.socketcan
def test_boot_over_socketcan(bench):
    with Responder("vcan0", bench.nodes):
        report = boot_all({**REQUEST, "bus": "vcan0"})
    assert sorted(report.nodes) == [1, 2, 3]
    assert [node.state for node in bench.nodes] == [5, 5, 5]
