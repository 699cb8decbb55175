"""The nodes of another master: taken from files and configuration, followed by what is heard of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import boot_request
from jtqd.daemon.bus.nodes import HeardNodes, NodeWatch
from jtqd.daemon.config import load_config
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader, View
from jtqd.drivers.boot import known_nodes
from jtqd.drivers.boot_node import BootError
from jtqd.drivers.object_dictionary import EdsError
from tests.shipped_bench import shipped_bench

SYNCS = [(n * 1_000_000, 0) for n in range(100)]
GIVEN = {"608Fh:1": 65536, "608Fh:2": 1, "6090h:1": 65536, "6090h:2": 1, "60E6h:1": 524288, "60EBh:1": 1}
GIVEN |= {"6075h:0": 8000, "6091h:1": 100, "6091h:2": 1}
OBJECTS = {1: [0x60640020, 0x60E40120], 2: [0x606C0020, 0x60780010, 0x60410010]}


def report(directory: Path, changes: dict[str, Any] | None = None, **heard: Any) -> dict[str, Any]:
    """Report of the shipped bench as a guest, with its layout in the configuration; `changes` of joint 1."""
    content = shipped_bench()
    for n in (1, 2):
        joint = content[f"joint_{n}"]
        joint["temperature"] = False
        joint["given"] = GIVEN
        joint["tpdos"] = [
            {"number": k, "cob_id": 0x80 + 0x100 * k + n, "objects": OBJECTS[k]} for k in (1, 2)
        ]
    content["joint_1"] |= changes or {}
    content["joint_1"] = {key: value for key, value in content["joint_1"].items() if value is not None}
    path = directory / "guest.yaml"
    path.write_text(yaml.safe_dump(content | heard.pop("configuration", {})))
    config = load_config(path, heard.pop("role", "guest"))
    request = boot_request(config, "can0")
    frames = {cob_id: [(0, 8)] for cob_id in heard.pop("ids", ())}
    return known_nodes(request, {**frames, 0x080: heard.pop("syncs", SYNCS)})


def test_layout_and_scaling_of_the_configuration(tmp_path: Path) -> None:
    found = report(tmp_path)
    assert found["nodes"]["1"]["scaling"]["ampere_per_unit"] == pytest.approx(0.008)
    assert [each["words"] for each in found["nodes"]["1"]["tpdos"]] == list(OBJECTS.values())
    assert found["unchecked"] == [], "its layout is pinned"
    assert list(found["absent"]) == ["3"], "of the optional sensor nothing is given"
    assert found["notes"] == []


def test_scaling_and_identity_of_a_dcf(tmp_path: Path) -> None:
    """ParameterValue is what the device is configured with; identity and type are those of the file."""
    drive = Path(__file__).parents[3] / "drivers" / "eds" / "drive.eds"
    text = drive.read_text()
    for section, value in (("608Fsub1", 4096), ("6075", 500), ("6091sub1", 100)):
        assert f"[{section}]\n" in text
        text = text.replace(f"[{section}]\n", f"[{section}]\nParameterValue={value}\n")
    (tmp_path / "drive.dcf").write_text(text)
    found = report(tmp_path, {"eds": "drive.dcf", "given": {"60E6h:1": 1000}, "identity": {"product": 5}})
    assert found["nodes"]["1"]["scaling"]["ampere_per_unit"] == pytest.approx(0.0005)
    assert found["nodes"]["1"]["scaling"]["motor_rad_per_count"] == pytest.approx(6.283185307 / 4096)
    assert found["identities"]["1"] == {"1": 1953, "2": 5, "3": 0x10000} or found["identities"]["1"] == {
        "1": 1953,
        "2": 5,
    }


@pytest.mark.parametrize(
    ("section", "refused"),
    [("2010", False), ("608Fsub1", True), ("6064", False), ("1A00sub1", True), ("1A02sub1", False)],
)
def test_an_odd_entry_of_a_dcf_is_a_note_where_nothing_depends_on_it(
    tmp_path: Path, section: str, refused: bool
) -> None:
    text = (Path(__file__).parents[3] / "drivers" / "eds" / "drive.eds").read_text()
    values = {"1800sub2": 1, "1801sub2": 1, "2010": 7, section: "abc"}
    for number, words in OBJECTS.items():
        found = {f"1A0{number - 1}sub{sub}": word for sub, word in enumerate((len(words), *words))}
        values = {**found, **values}
    text += "\n[2010]\nDataType=5\nAccessType=rw\n"
    for title, value in values.items():
        assert f"[{title}]\n" in text
        text = text.replace(f"[{title}]\n", f"[{title}]\nParameterValue={value}\n")
    (tmp_path / "drive.dcf").write_text(text)
    given = {"6075h": 500, "60E6h:1": 1000, "6091h:1": 100}
    changes = {"eds": "drive.dcf", "given": given, "tpdos": None}
    if refused:
        with pytest.raises((BootError, EdsError), match=rf"\[{section}\]: ParameterValue=abc"):
            report(tmp_path, changes)
    else:
        (note,) = report(tmp_path, changes)["notes"]
        assert f"[{section}]: ParameterValue=abc" in note


def test_a_name_that_cannot_be_read_is_a_note(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "drivers" / "eds" / "drive.eds").read_text()
    before, name, after = text.partition("[1008]\n")
    (tmp_path / "drive.eds").write_text(before + name + after.replace("DataType=0x0009\n", "", 1))
    found = report(tmp_path, {"eds": "drive.eds"})
    assert found["nodes"]["1"]["name"] == ""
    assert ["[1008]: no DataType" in each for each in found["notes"]] == [True]


@pytest.mark.parametrize(
    ("changes", "heard", "words"),
    [
        ({"tpdos": None}, {}, "node 1: not known: 1A00h (mapping: 'tpdos'): a guest asks no node"),
        ({"given": {}}, {}, "node 1: not known: 608Fh:1, 608Fh:2, "),
        ({"tpdos": None, "eds": "../../eds"}, {}, "eds"),
        (
            {},
            {"syncs": [(n * 2_000_000, 0) for n in range(50)]},
            "SYNC: expected one every 1000 us (sync.period_us), found one every 2000 us",
        ),
        ({}, {"configuration": {"sync": {"counter_overflow": 240}}}, "SYNC: expected a counter byte"),
        ({}, {"ids": {0x720}}, "node 20h, jtqd's own node-ID, is on the bus (COB-ID 720h)"),
        ({}, {"ids": {0x1A0}}, "node 20h, jtqd's own node-ID, is on the bus (COB-ID 1A0h)"),
    ],
)
def test_refusals(tmp_path: Path, changes: dict[str, Any], heard: dict[str, Any], words: str) -> None:
    with pytest.raises((BootError, EdsError)) as caught:
        report(tmp_path, changes, **heard)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_notes_and_what_a_listener_may_hear(tmp_path: Path) -> None:
    assert report(tmp_path, ids={0x720, 0x1A0}, role="listener")["nodes"].keys() == {"1", "2"}
    assert report(tmp_path, syncs=[])["notes"] == ["no SYNC within 1.2 s: jtqd waits for that of the master"]
    (note,) = report(tmp_path, syncs=[(at, 1) for at, _ in SYNCS])["notes"]
    assert note.startswith("SYNC has a counter byte: with sync.counter_overflow")


class Heard:
    """`HeardNodes` beside a loop that is played by the test."""

    def __init__(self, directory: Path, *, unchecked: bool) -> None:
        found = report(directory)
        if unchecked:
            found["unchecked"] = [1]
            found["identities"]["1"] = {"1": 1953, "2": 1026}
        self.snapshot = Snapshot(directory / "snapshot", 1e-3, 0.8)
        self.reader = SnapshotReader(directory / "snapshot", supervisor=True)
        self.lines: list[str] = []
        watch = NodeWatch((1, 2, 3), (), 0.0, 0.3)
        self.nodes = HeardNodes(
            found, {}, self.reader, None, watch, lambda _topic, _node, line: self.lines.append(line)
        )
        self.now_s = 0.0

    def turn(self) -> View:
        self.now_s += 0.05
        view = self.reader.read()
        assert self.nodes.turn(view, self.now_s) == [], "it asks nothing"
        return view

    def sdo(self, request: str, reply: str, node: int = 1) -> None:
        self.nodes.on_foreign_request(node, bytes.fromhex(request), self.now_s)
        self.nodes.on_reply(node, bytes.fromhex(reply), self.now_s)


READ, WRITTEN = "40 {} 00000000", "60 {} 00000000"


@pytest.mark.parametrize(
    ("request_", "reply", "text"),
    [
        ("23 001a01 2001e460", "60 001a01 00000000", "(1A00h:1: expected 0x60640020, found 0x60E40120)"),
        ("2f 001a00 00000000", "60 001a00 00000000", "(1A00h:0: expected 0x2, found 0x0)"),
        ("23 001801 81010080", "60 001801 00000000", "(1800h:1: expected 0x181, found 0x80000181)"),
        ("23 8f6001 00000200", "60 8f6001 00000000", "(608Fh:1: expected 65536, found 131072)"),
        ("40 756000 00000000", "43 756000 10270000", "(6075h:0: expected 8000, found 10000)"),
        ("21 001a01 04000000", "60 001a01 00000000", "(1A00h:1: expected 0x60640020, found 0xFFFFFFFF)"),
    ],
)
def test_what_its_master_writes_or_reads_puts_a_node_in_doubt(
    tmp_path: Path, request_: str, reply: str, text: str
) -> None:
    heard = Heard(tmp_path, unchecked=False)
    heard.turn()
    heard.sdo(request_, reply, node=2)
    if "181" not in text:
        heard.turn()
        assert list(heard.nodes.changed) == [2]
        heard.nodes.restarted(2)
    heard.sdo(request_, "80" + reply[2:9] + "11000906")
    heard.turn()
    assert 1 not in heard.nodes.changed, "refused by the node"
    heard.sdo(request_, reply)
    heard.turn()
    assert heard.nodes.changed[1] == text
    assert heard.snapshot.doubts[1] == 1
    heard.snapshot.unconfigured[1] = 1
    heard.snapshot.node_states[1] = 5
    heard.turn()
    assert heard.snapshot.configured[1] == 0, "not used while the value is another"


def test_a_node_is_used_again_when_it_runs_as_described(tmp_path: Path) -> None:
    heard = Heard(tmp_path, unchecked=False)
    heard.nodes.restarted(1)
    heard.snapshot.unconfigured[1], heard.snapshot.restarts[1] = 1, 7
    heard.turn()
    assert heard.snapshot.configured[1] == 0, "after its boot-up message it is not operational"
    heard.sdo("23 001801 81010080", "60 001801 00000000")
    heard.nodes.on_command(1, 0)
    heard.turn()
    assert heard.snapshot.configured[1] == 0
    heard.sdo("23 001801 81010000", "60 001801 00000000")
    heard.turn()
    assert (heard.snapshot.configured[1], heard.snapshot.configured_for[1]) == (1, 7)
    assert heard.lines == ["node 1 is operational and used again"]
    heard.nodes.on_command(0x99, 0)  # no node obeys it
    heard.turn()
    assert heard.snapshot.configured[1] == 2, "it still runs"
    heard.nodes.on_command(0x80, 1)
    heard.snapshot.node_states[1] = 5  # of its last heartbeat
    heard.turn()
    assert heard.snapshot.configured[1] == 2, "its master has commanded it to leave operational"


def test_a_sensor_that_nobody_has_described_may_restart(tmp_path: Path) -> None:
    heard = Heard(tmp_path, unchecked=False)
    heard.nodes.restarted(3)
    heard.sdo("40 181001 00000000", "43 181001 a1070000", node=3)
    heard.turn()
    assert heard.nodes.changed == {}


def test_identity_is_checked_when_its_master_reads_it(tmp_path: Path) -> None:
    heard = Heard(tmp_path, unchecked=True)
    assert (heard.snapshot.unchecked[1], heard.snapshot.unchecked[2]) == (1, 0)
    heard.sdo("40 181001 00000000", "43 181001 a1070000")
    assert heard.nodes.unchecked == {1}
    heard.sdo("40 181002 00000000", "43 181002 02040000")
    assert heard.nodes.unchecked == set()
    assert heard.snapshot.unchecked[1] == 0
    heard.nodes.restarted(1)
    assert heard.nodes.unchecked == {1}, "it may be another device"
    heard.sdo("40 181002 00000000", "43 181002 03040000")
    heard.turn()
    assert heard.nodes.changed[1] == "(1018h:2: expected 0x402, found 0x403)"


def test_boot_error_names_the_node(tmp_path: Path) -> None:
    with pytest.raises(BootError) as caught:
        report(tmp_path, {"given": {}})
    assert caught.value.node == 1
