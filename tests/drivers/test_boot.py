"""Boot against emulated nodes: the way it goes, and each thing that goes wrong with the message it gets."""

import dataclasses
import json
import subprocess
import sys
import time

import pytest

from jtqd.drivers.boot import RequestError, parse_request
from jtqd.drivers.boot_node import BootError, BusSettings, NodeBoot
from jtqd.drivers.drive import DriveProfile, Temperature, drive_tpdo1, drive_tpdo2, drive_tpdo3
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.pdo import PdoParameters
from jtqd.drivers.sensor import SensorProfile, sensor_tpdo1, sensor_tpdo2
from tests.drivers.canopen_nodes import HubResponder, Responder, TestNode, boot_all, drive_store, sensor_store
from tests.paths import ROOT

NODES = [
    {"node": 1, "kind": "drive", "identity": {"vendor": 0x7A1, "product": 0x402}},
    {"node": 2, "kind": "drive", "identity": {"serial": 22}},
    {"node": 3, "kind": "sensor", "channels": [1]},
]
REQUEST = {
    "bus": "virtual",
    "answer_timeout_s": 0.2,
    "heartbeat_ms": 30,
    "sync": {"counter_overflow": 240},
    "nodes": NODES,
}


class Bench:
    """Three nodes in a hub."""

    def __init__(self, directory):
        self._path = str(directory / "hub")
        self.drive1, self.drive2 = TestNode(drive_store(1)), TestNode(drive_store(2))
        self.sensor = TestNode(sensor_store(3))
        self.nodes = [self.drive1, self.drive2, self.sensor]
        self.drive2.store.set_number(0x1018, 4, 22)
        self.extra = list

    def boot(self, **changes):
        responder = HubResponder(self._path, self.nodes)
        responder.extra = self.extra
        with responder:
            return boot_all({**REQUEST, "bus": f"unix:{self._path}", **changes})

    def fails(self, **changes):
        with pytest.raises(BootError) as caught:
            self.boot(**changes)
        return caught.value


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


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


class Ear:
    """Hears what the boot sends, and says nothing."""

    def __init__(self):
        self.heard = []

    def frames(self, can_id, data):
        self.heard.append((can_id, data))
        return []

    def beat(self, _now):
        return []


def test_the_master_s_heartbeat_runs_and_all_are_reset_before_anything_is_asked(bench):
    """A drive that watches its master would miss it, and one whose master has ended refuses to be started."""
    ear = Ear()
    bench.nodes.append(ear)
    bench.boot(reset=True)
    boot_up, asked = (
        ear.heard.index((0x720, b"\0")),
        [n for n, each in enumerate(ear.heard) if each[0] > 0x600],
    )
    resets = [ear.heard.index((0x000, bytes([130, node]))) for node in (1, 2, 3)]
    start = ear.heard.index((0x000, bytes([1, 1])))
    beats = [n for n, each in enumerate(ear.heard) if each == (0x720, b"\x7f")]
    requests = [n for n in asked if ear.heard[n][0] < 0x680]
    assert boot_up < beats[0] < requests[0] < start
    assert boot_up < min(resets) <= max(resets) < requests[0]
    assert len([n for n in beats if n < start]) >= 3
    ear.heard.clear()
    bench.boot(reset=False)
    assert not [data for can_id, data in ear.heard if can_id == 0 and data[0] in (129, 130)]


def test_second_channel_is_mapped_when_used(bench):
    bench.boot(nodes=[{"node": 3, "kind": "sensor", "channels": [1, 2]}])
    assert bench.sensor.parameters.tpdos() == [sensor_tpdo1(3), sensor_tpdo2(3)]
    assert bench.drive1.requests == []  # one node alone can be booted again


def test_hash_says_whether_the_configuration_is_the_same(bench):
    first = bench.boot().nodes[1].configuration_sha256
    assert bench.boot().nodes[1].configuration_sha256 == first
    bench.drive1.store.set_number(0x6075, 0, 4000)
    assert bench.boot().nodes[1].configuration_sha256 != first


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

    NodeBoot(Access(), DriveProfile(1, temperature=Temperature()), BusSettings(0x20)).configure_pdos()
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


def test_temperature_is_mapped_where_it_is_asked_for(bench):
    bench.drive1.store.set_number(0x1802, 5, 0)  # left without its timer, and off, by somebody else
    bench.drive1.store.set_number(0x1802, 1, 0xC0000381)
    nodes = [{"node": 1, "kind": "drive", "temperature": {}}, {"node": 2, "kind": "drive"}]
    report = bench.boot(nodes=nodes)
    one, two = bench.drive1.parameters, bench.drive2.parameters
    assert one.tpdos() == [drive_tpdo1(1), drive_tpdo2(1), drive_tpdo3(1)]
    assert two.tpdos() == [drive_tpdo1(2), drive_tpdo2(2)]
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
    with pytest.raises(BootError, match="2041h:1 joint temperature: expected a value"):
        bench.boot(nodes=[{"node": 1, "kind": "drive", "temperature": own}])


def test_a_node_without_an_inhibit_time_is_mapped_all_the_same(bench):
    del bench.drive1.store.entries[0x1802, 3]
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
    bench.boot()
    assert bench.drive1.requests.count(bytes.fromhex("23 00 1A 01 20 00 64 60")) == 2  # asked again
    assert bench.drive1.parameters.tpdos()[0] == drive_tpdo1(1)


def test_wrong_device_type(bench):
    bench.drive1.store.set_number(0x1000, 0, 0x00020194)
    error = bench.fails()
    assert "node 1: 1000h:0 device type: expected profile 402 (0x....0192), found 0x00020194" in str(error)
    assert error.letter == "C"


@pytest.mark.parametrize(
    ("subindex", "key", "name", "letter"),
    [
        (1, "vendor", "vendor-ID", "D"),
        (2, "product", "product code", "M"),
        (3, "revision", "revision number", "N"),
        (4, "serial", "serial number", "O"),
    ],
)
def test_wrong_identity(bench, subindex, key, name, letter):
    bench.drive2.store.set_number(0x1018, subindex, 0x403)
    error = bench.fails(nodes=[{"node": 2, "kind": "drive", "identity": {key: 0x402}}])
    expected = f"1018h:{subindex} {name}: expected 0x00000402, found 0x00000403 (status {letter})"
    assert str(error) == f"node 2: {expected}"


def test_refused_mapping(bench):
    def refuse(request, reply):
        if request[:4] == bytes.fromhex("23 00 1A 01"):
            return bytes.fromhex("80 00 1A 01 41 00 04 06")
        return reply

    bench.drive1.answer = refuse
    error = bench.fails()
    said = str(error)
    assert said.startswith(
        "node 1: 1A00h:1: write of 0x60640020 refused: object cannot be mapped (06040041h); "
    )
    assert (
        "no TPDO carries 60E4h:1 (link position), 6078h:0 (current), 6041h:0 (statusword); TPDO1 carries"
        in said
    )
    assert error.letter == "J"


def test_what_was_written_before_a_refusal_is_put_back(bench):
    """TPDO1 was mapped, and the second entry of TPDO2 is refused: entries, numbers, types and COB-IDs are as before."""

    def objects():
        store = bench.drive1.store
        keys = [(0x1A00 + n, sub) for n in range(3) for sub in range(3)]
        keys += [(0x1800 + n, sub) for n in range(3) for sub in (1, 2)]
        return {key: store.number(*key) for key in keys}

    store = bench.drive1.store
    store.set_number(0x1A00, 0, 1)
    store.set_number(0x1A00, 1, 0x6041_0010)
    store.set_number(0x1A01, 0, 2)
    store.set_number(0x1A01, 1, 0x6061_0008)
    store.set_number(0x1A01, 2, 0x6077_0010)
    store.set_number(0x1800, 2, 255)
    before = objects()

    store.entries[0x1A01, 2] = dataclasses.replace(store.entries[0x1A01, 2], access="ro")
    assert "no TPDO carries 6064h:0" in str(bench.fails())
    assert objects() == before


def test_mapping_that_reads_back_different(bench):
    bench.drive1.store.on_read(0x1A01, 2, lambda: 0x60770010)
    error = bench.fails()
    expected = "mapping entry read back: expected 0x60780010, found 0x60770010"
    assert str(error) == f"node 1: 1A01h:2 {expected} (status J)"


def test_transmission_type_that_does_not_stick(bench):
    bench.drive1.store.on_read(0x1800, 2, lambda: 255)
    assert "1800h:2 transmission type read back: expected 0x01, found 0xFF" in str(bench.fails())


def test_a_drive_without_the_temperature_that_is_asked_for(bench):
    del bench.drive2.store.entries[0x3001, 0]
    bench.drive2.store._indices.discard(0x3001)
    error = bench.fails(nodes=[{"node": 2, "kind": "drive", "temperature": {}}])
    assert str(error) == (
        "node 2: 3001h:0 joint temperature: expected a value (required by the configuration), "
        "found no such object (status J)"
    )
    assert bench.drive2.store.number(0x1A00, 1) != drive_tpdo1(2).words[0], "found before anything is written"
    bench.boot(nodes=[{"node": 2, "kind": "drive"}])


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ((0x1A02, 1), 0x30010020, "1A02h:1 mapping entry read back: expected 0x30010010, found 0x30010020"),
        ((0x1802, 2), 1, "1802h:2 transmission type read back: expected 0xFF, found 0x01"),
        ((0x1802, 3), 0, "1802h:3 inhibit time in 100 us read back: expected 0x1388, found 0x0000"),
        ((0x1802, 5), 0, "1802h:5 event timer in ms read back: expected 0x01F4, found 0x0000"),
    ],
)
def test_a_temperature_that_is_not_taken_as_written(bench, key, value, text):
    bench.drive1.store.on_read(*key, lambda: value)
    error = bench.fails(nodes=[{"node": 1, "kind": "drive", "temperature": {}}])
    assert str(error) == f"node 1: {text} (status J)"


def test_zero_gear_ratio_and_rated_current(bench):
    bench.drive2.store.set_number(0x6091, 2, 0)
    assert str(bench.fails()).startswith("node 2: 6091h:2 gear ratio driving shaft revolutions: expected 1..")
    bench.drive2.store.restore()
    bench.drive2.store.set_number(0x1018, 4, 22)
    bench.drive2.store.set_number(0x6075, 0, 0)
    error = bench.fails()
    assert str(error) == "node 2: 6075h:0 motor rated current in mA: expected 1..1000000, found 0"


def test_missing_scaling_object_is_named_and_can_be_given(bench):
    for subindex in (0, 1):
        del bench.drive1.store.entries[0x60E6, subindex]
    bench.drive1.store._indices.discard(0x60E6)
    error = bench.fails()
    assert str(error) == "node 1: 60E6h:1: read refused: object does not exist (06020000h)"
    nodes = [{"node": 1, "kind": "drive", "given": {"60E6h:1": 1024}}]
    scaling = bench.boot(nodes=nodes).nodes[1].scaling
    assert scaling.link_rad_per_count == pytest.approx(2 * 3.141592653589793 / 1024)


def test_sensor_channel_that_is_off(bench):
    bench.sensor.store.set_number(0x6112, 1, 0)
    error = bench.fails()
    assert str(error) == "node 3: 6112h:1 channel operating mode: expected 1 (normal operation), found 0"


def test_a_sensor_without_operating_mode_and_a_drive_without_serial_number(bench):
    for subindex in (0, 1, 2):
        del bench.sensor.store.entries[0x6112, subindex]
    del bench.drive1.store.entries[0x1018, 4]
    report = bench.boot(nodes=[{"node": 1, "kind": "drive", "identity": {"revision": 0x10000}}, *NODES[2:]])
    assert report.nodes[1].serial == 0
    assert sorted(report.nodes) == [1, 3]


def test_another_sync_identifier(bench):
    bench.drive1.store.set_number(0x1005, 0, 0x90)
    assert "node 1: 1005h:0 COB-ID SYNC: expected 080h, found 0x00000090" in str(bench.fails())


def test_no_heartbeat(bench):
    bench.sensor.beats = False
    error = bench.fails()
    assert str(error) == "node 3: no heartbeat 703h within 0.1 s (status K)"
    assert bench.drive1.state == 0x7F


def test_never_operational(bench):
    bench.drive2.obeys_start = False
    error = bench.fails()
    assert str(error) == "node 2: NMT start: expected operational within 0.1 s, found pre-operational"


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


def test_foreign_sync(bench):
    bench.extra = lambda: [(0x080, b"\x01")]
    error = bench.fails()
    assert "another SYNC producer is on the bus (COB-ID 080h" in str(error)
    assert [node.state for node in bench.nodes] == [0x7F] * 3
    bench.boot(sync={"check_foreign": False})  # jtqd's own SYNC runs when one node is booted again


def test_garbage_on_the_answer_identifiers_is_passed_over(bench):
    """Short and 29-bit frames on 581h and 701h, all the time."""
    bench.extra = lambda: [(0x581, b""), (0x581, b"\x80"), (0x701, b""), (0x701, b"\x00\x00")]
    bench.boot()


class WatchingDrive(TestNode):
    """The watch (1016h) runs out right after NMT start: the drive leaves operational (1029h), once."""

    def __init__(self) -> None:
        super().__init__(drive_store(1))
        self.starts = 0

    def frames(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        out = super().frames(can_id, data)
        if can_id == 0 and data[0] == 1:
            self.starts += 1
            if self.starts == 1:
                self.state = 0x7F
        return out


def test_a_drive_that_leaves_operational_once_is_started_again(bench) -> None:
    drive = WatchingDrive()
    bench.nodes[:] = [drive]
    bench.boot(nodes=[{"node": 1, "kind": "drive"}])
    assert (drive.state, drive.starts) == (5, 2)
    # It watches its master all the same: one that dies stops it.
    assert drive.store.number(0x1016, 1) == 0x20 << 16 | 500


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
    assert request.settings == BusSettings(0x20, heartbeat_ms=30, counter_overflow=240)
    assert parse_request(json.loads(json.dumps(request.as_json()))) == request


def test_an_optional_node_is_waited_for_half_a_second_at_most():
    nodes = [{"node": 1, "kind": "drive"}, {"node": 3, "kind": "sensor", "mandatory": False}]
    patient = parse_request({"bus": "can0", "answer_timeout_s": 2.0, "nodes": nodes})
    assert (patient.timeout_s(1), patient.timeout_s(3)) == (2.0, 0.5)
    hasty = parse_request({"bus": "can0", "answer_timeout_s": 0.2, "nodes": nodes})
    assert (hasty.timeout_s(1), hasty.timeout_s(3)) == (0.2, 0.2)


def run_boot(request):
    text = request if isinstance(request, str) else json.dumps(request)
    command = [sys.executable, "-m", "jtqd.drivers.boot"]
    done = subprocess.run(
        command, input=text, capture_output=True, text=True, timeout=20, check=False, cwd=ROOT
    )
    assert done.stderr == ""
    return done.returncode, json.loads(done.stdout)


def test_process_over_the_unix_bus(tmp_path, bench):
    path = str(tmp_path / "bus")
    started = time.monotonic()
    with HubResponder(path, bench.nodes):
        status, report = run_boot({**REQUEST, "bus": f"unix:{path}"})
    assert (status, report["ok"]) == (0, True)
    print(f"boot {report['duration_s']} s, process {time.monotonic() - started:.2f} s")
    assert report["duration_s"] < 0.5
    assert sorted(report["nodes"]) == ["1", "2", "3"]
    assert report["nodes"]["1"]["scaling"]["ampere_per_unit"] == pytest.approx(0.005)
    assert report["nodes"]["3"]["scaling"] == {"nm_per_unit": {"1": pytest.approx(0.001)}}
    assert bench.drive2.parameters.tpdos() == [drive_tpdo1(2), drive_tpdo2(2)]


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


def test_a_sync_producer_is_told_to_leave_it(bench):
    store = bench.drive1.store
    store.entries[0x1005, 0] = dataclasses.replace(store.entries[0x1005, 0], access="rw")
    store.set_number(0x1005, 0, 0x4000_0080)
    report = bench.boot(sync={"counter_overflow": 0})
    assert bench.drive1.store.number(0x1005, 0) == 0x80
    assert report.nodes[1].notes == ("1005h: it was a SYNC producer, which jtqd is",)


def test_a_node_that_cannot_count_syncs_is_refused_only_where_they_have_a_counter(bench):
    del bench.drive1.store.entries[0x1019, 0]
    bench.drive1.store._indices.discard(0x1019)
    assert bench.boot(sync={"counter_overflow": 0}).nodes[1].notes == ()
    assert str(bench.fails()) == (
        "node 1: 1019h:0 SYNC counter overflow: expected 240 (sync.counter_overflow; 0 for SYNC without a counter), "
        "found no such object (status J)"
    )


def test_1019h_is_written_only_where_it_differs(bench):
    bench.boot(sync={"counter_overflow": 0})
    assert not [request for request in bench.drive1.requests if request[:3] == bytes.fromhex("2f 19 10")]
    bench.boot(sync={"counter_overflow": 240})
    assert [request for request in bench.drive1.requests if request[:3] == bytes.fromhex("2f 19 10")]


def test_a_node_that_fails_says_why(bench):
    """It does not start: 1001h, 1003h and the last EMCY of the boot are in the line."""
    node, sent = bench.drive1, []
    node.obeys_start = False
    node.store.set_number(0x1001, 0, 0x11)
    node.store.on_read(0x1003, 0, lambda: 1)
    node.store.on_read(0x1003, 1, lambda: 0x8130)

    def emergency():
        if sent or not node.requests:
            return []
        sent.append(1)
        return [(0x081, bytes.fromhex("10 23 03 00 00 00 00 00"))]

    bench.extra = emergency
    said = str(bench.fails())
    assert said.startswith("node 1: NMT start: expected operational")
    assert "; 1001h is 11h (generic, communication), 1003h:1 is 8130h (life guard or heartbeat)" in said
    assert said.endswith(", its last EMCY is 2310h (continuous overcurrent)")


def test_what_is_cosmetic_or_optional_fails_nothing(bench):
    """1008h is refused with a code of its own, 1016h does not keep what is written, 1014h is another COB-ID."""
    store = bench.drive1.store
    answered = bench.drive1.answer

    def refuse_name(request, reply):
        if request[1:3] == bytes.fromhex("08 10"):
            return bytes.fromhex("80 08 10 00 20 00 00 08")
        return answered(request, reply)

    bench.drive1.answer = refuse_name
    store.on_read(0x1016, 1, lambda: 0)
    store.on_read(0x1014, 0, lambda: 0x8000_0081)
    node = bench.boot().nodes[1]
    assert node.name == ""
    assert node.notes == (
        "1016h:1 consumer heartbeat time read back: expected 0x002001F4, found 0x00000000: "
        "the drive does not notice when jtqd's heartbeat ends",
        "1014h COB-ID EMCY: expected 081h, found 0x80000081: its EMCY messages are not read",
    )


def test_a_name_that_steers_a_terminal_is_replaced(bench):
    bench.drive1.store.set_text(0x1008, 0, "\x1b[2Jdrive")
    assert bench.boot().nodes[1].name == "?[2Jdrive"


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
    for key, entry in store.entries.items():
        if 0x1800 <= key[0] < 0x1C00 and key not in writable:
            store.entries[key] = dataclasses.replace(entry, access="ro")


COB_IDS = tuple((index, 1) for index in range(0x1800, 0x1804))
RIGHT = tuple(pdo.words for pdo in (drive_tpdo1(1), drive_tpdo2(1)))
ELSEWHERE = (0x6041_0010, 0x6064_0020), (0x606C_0020, 0x6078_0010, 0x6061_0008), (0x60E4_0120,)
"""Layout of a drive whose maker has thought of other readers."""


def test_what_is_as_wanted_is_not_written(bench):
    """The second boot finds what the first has written: it maps nothing."""
    bench.boot()
    written = []
    answered = bench.drive1.answer

    def watch(request, reply):
        if request[0] & 0xE0 == 0x20 and 0x18 <= request[2] < 0x1C:
            written.append(request.hex(" "))
        return answered(request, reply)

    bench.drive1.answer = watch
    node = bench.boot(reset=False).nodes[1]
    assert written == []
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))


@pytest.mark.parametrize("writable", [(), COB_IDS])
def test_a_mapping_that_is_fixed_in_the_drive_is_used_where_it_is_the_right_one(bench, writable):
    fixed(bench.drive1, *RIGHT, valid=not writable, writable=writable)
    node = bench.boot().nodes[1]
    assert bench.drive1.state == 5
    assert bench.drive1.store.number(0x1800, 1) == 0x4000_0181, "it is on"
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))


def test_a_temperature_in_a_fixed_mapping_is_used_where_it_is_alone_in_tpdo3(bench):
    fixed(bench.drive1, *ELSEWHERE[:2], (0x3001_0010,))
    bench.drive1.store.set_number(0x1802, 2, 255)
    objects = {"link_position": None}
    nodes = [{"node": 1, "kind": "drive", "temperature": {}, "objects": objects}]
    used = bench.boot(nodes=nodes).nodes[1].tpdos
    assert [pdo.words for pdo in used][2:] == [(0x3001_0010,)]
    assert used[2].transmission_type == 255
    nodes[0]["temperature"] = {"index": 0x6077, "c_per_unit": 0.1}
    with pytest.raises(BootError, match=r"no TPDO with COB-ID 381h carries 6077h:0 alone \(temperature\)"):
        bench.boot(nodes=nodes)


@pytest.mark.parametrize("writable", [(), COB_IDS])
def test_a_mapping_that_is_fixed_otherwise_is_used_as_it_is(bench, writable):
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
    assert [bench.drive1.store.number(0x1800 + n, 1) for n in range(3)] == [
        0x4000_0181,
        0x4000_0281,
        0x4000_0381,
    ]
    watched = {(index, sub): value for index, sub, value in node.watched}
    assert watched[0x1A01, 2] == 0x6078_0010, "and watched in service"


def test_a_fixed_mapping_with_the_same_numbers_has_one_hash(bench):
    """What the attempt has read of what is not in force is not in it."""
    fixed(bench.drive1, *ELSEWHERE)
    first = bench.boot().nodes[1].configuration_sha256
    assert bench.boot().nodes[1].configuration_sha256 == first


def test_a_tpdo_that_is_not_needed_and_cannot_be_switched_off_is_told(bench):
    fixed(bench.drive1, *RIGHT, (0x6061_0008,))
    node = bench.boot().nodes[1]
    assert node.tpdos == (drive_tpdo1(1), drive_tpdo2(1))
    assert any("TPDO3 is not needed and stays on" in note for note in node.notes)


def test_another_cob_id_of_the_predefined_set(bench):
    fixed(bench.drive1, *ELSEWHERE)
    bench.drive1.store.set_number(0x1802, 1, 0x4000_0481)
    assert [pdo.cob_id for pdo in bench.boot().nodes[1].tpdos] == [0x181, 0x281, 0x481]


@pytest.mark.parametrize(
    ("change", "said"),
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
def test_a_mapping_that_is_fixed_and_not_enough_is_named(bench, change, said):
    fixed(bench.drive1, *ELSEWHERE)
    bench.drive1.store.set_number(*change)
    found = str(bench.fails())
    assert (
        "node 1: 1800h:1: write of 0xC0000181 refused: object is read only (06010002h); no TPDO carries"
        in found
    )
    assert said in found


def test_a_transmission_type_that_cannot_be_written_is_named(bench):
    fixed(bench.drive1, *ELSEWHERE, kind=10)
    found = str(bench.fails())
    assert "1800h:2: write of 0x01 refused" in found


@pytest.mark.parametrize("kind", [0, 254, 255])
def test_a_type_that_cannot_be_written_is_accepted_where_an_age_is_configured(bench, kind):
    fixed(bench.drive1, *ELSEWHERE, kind=kind)
    assert f"TPDO1 has transmission type {kind}: joint_N.max_age_ms allows it" in str(bench.fails())
    node = bench.boot(nodes=[{**NODES[0], "acyclic": True}, *NODES[1:]]).nodes[1]
    assert [pdo.transmission_type for pdo in node.tpdos] == [kind] * 3
    assert f"TPDO1 keeps transmission type {kind}" in node.notes


def test_a_layout_that_is_asked_for_is_written(bench):
    """TPDOs of the request: one PDO has two quantities, another one the rest."""
    words = [0x6041_0010, 0x6064_0020], [0x606C_0020, 0x6078_0010], [0x60E4_0120]
    tpdos = [
        {"number": number, "cob_id": cob_id, "transmission_type": 1, "words": entries}
        for number, cob_id, entries in zip((1, 2, 3), (0x381, 0x281, 0x181), words, strict=True)
    ]
    node = bench.boot(nodes=[{**NODES[0], "tpdos": tpdos}, *NODES[1:]]).nodes[1]
    assert [(pdo.number, pdo.cob_id) for pdo in node.tpdos] == [(1, 0x381), (2, 0x281), (3, 0x181)]
    assert bench.drive1.parameters.tpdos() == list(node.tpdos)
