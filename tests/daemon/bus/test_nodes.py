"""Nodes in service: their heartbeats, whether each is configured as at its boot, and boots of those that need one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import ReturningNodes, boot_request, gear_ratio_error
from jtqd.daemon.bus.nodes import ACTIVE as HEARD
from jtqd.daemon.bus.nodes import (
    LOST,
    WAITING,
    ConfigurationMismatch,
    ConfigurationWatch,
    NodeWatch,
    checks_of,
)
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.drivers.boot_node import signature
from tests.shipped_bench import shipped_bench


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


BEAT = 0.1


def make_watch() -> NodeWatch:
    watch = NodeWatch((1, 2, 3), (0x20, 0x21), BEAT, 0.3)
    for node in (1, 2, 3):
        watch.watch(node, 0.0)
    return watch


def kinds(events: list) -> list[tuple[str, int]]:
    return [(event.kind, event.node) for event in events]


def test_a_node_that_never_comes_and_one_that_stops_are_reported() -> None:
    watch = make_watch()
    watch.receive(1, b"\x05", 0.05)
    watch.receive(2, b"\x05", 0.05)
    assert watch.tick(0.29) == []
    assert kinds(watch.tick(0.31)) == [("never", 3)]
    watch.receive(1, b"\x05", 0.32)
    (lost,) = watch.tick(0.36)
    assert lost == ("lost", 2, "0.3 s", 0.05)
    assert [watch.state(node) for node in (1, 2, 3)] == [HEARD, LOST, LOST]
    (back,) = watch.receive(2, b"\x05", 2.05)
    assert back == ("back", 2, "", 2.05)


def test_late_beats_within_the_time_are_no_loss() -> None:
    watch = make_watch()
    for n in range(1, 40):
        for node in (1, 2, 3):
            assert watch.receive(node, b"\x05", 0.28 * n) == []
        assert watch.tick(0.28 * n) == []


@pytest.mark.parametrize("data", [b"", b"\x05\x00", b"\x85", b"\x06", b"\xff"])
def test_what_is_no_heartbeat_does_not_keep_a_node_alive(data: bytes) -> None:
    watch = make_watch()
    for n in range(10):
        watch.receive(1, data, 0.1 * n)
    assert watch.malformed == 10
    assert ("never", 1) in kinds(watch.tick(0.95))


def test_a_toggling_state_is_few_lines() -> None:
    watch, lines = make_watch(), []
    for n in range(1000):
        events = watch.receive(1, b"\x05" if n % 2 else b"\x7f", 0.1 * n)
        lines += [event.text for event in events if event.text]
    assert 2 <= len(lines) <= 25, "100 s of toggling"


def test_two_producers_with_one_node_id_show_by_the_rate() -> None:
    watch, seen = make_watch(), []
    for n in range(100):
        seen += kinds(watch.receive(1, b"\x05", BEAT * n))
        if n > 40:
            seen += kinds(watch.receive(1, b"\x05", BEAT * n + 0.03))
    assert seen == [("doubled", 1)]
    for n in range(100, 150):
        seen += kinds(watch.receive(1, b"\x05", BEAT * n))
    assert seen == [("doubled", 1), ("single", 1)]


def test_a_restart_and_a_node_that_is_not_in_the_configuration() -> None:
    watch = make_watch()
    assert kinds(watch.receive(1, b"\x00", 0.1)) == [("restarted", 1)]
    (foreign,) = watch.receive(9, b"\x00", 0.1)
    assert foreign.text == "node 9: on the bus but not in the configuration (status A)"
    assert watch.receive(9, b"\x7f", 0.2) == [], "once"
    assert watch.receive(0x20, b"\x05", 0.2) == watch.receive(0x21, b"\x05", 0.2) == []
    for node in range(40, 127):  # a scan of all node-IDs: bounded
        watch.receive(node, b"\x00", 0.3)
    assert len(watch._known) < 30


def test_a_node_is_not_watched_before_it_is_configured() -> None:
    watch = NodeWatch((3,), (), BEAT, 0.3)
    assert watch.tick(100.0) == []
    watch.watch(3, 100.0)
    assert watch.state(3) == WAITING
    assert kinds(watch.tick(100.31)) == [("never", 3)]


def test_what_queued_up_while_the_reader_was_away_is_no_second_node() -> None:
    """A supervisor that was stopped for 10 s reads all heartbeats in one moment; two producers that follow are reported."""
    watch = make_watch()
    for node in (1, 2, 3):
        watch.watch(node, 0.0)
    now = 0.0
    for _ in range(30):
        now += BEAT
        watch.receive(1, frame("05"), now)
        watch.tick(now)
    now += 100 * BEAT
    events = [event for _ in range(100) for event in watch.receive(1, frame("05"), now)]
    assert [event.kind for event in events] == []
    watch.tick(now)
    seen = []
    for _ in range(60):
        now += BEAT / 2
        seen += [event.kind for event in watch.receive(1, frame("05"), now)]
        watch.tick(now)
    assert seen == ["doubled"]


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


# Configuration

REPORT = {
    "signed": True,
    "configuration_sha256": "0123456789abcdef" * 4,
    "gear_ratio": 100.0,
    "watched": [
        *([0x1800, 1, 0x4000_0181], [0x1800, 2, 1], [0x1803, 1, 0xC000_0481]),
        *([0x1A00, 0, 2], [0x1A00, 1, 0x6064_0020], [0x1A00, 2, 0x60E4_0120], [0x6075, 0, 9500]),
    ],
}
SIGNED = frame("67 45 23 01")


def answer(
    watch: ConfigurationWatch, changes: Mapping[int, int] = MappingProxyType({})
) -> ConfigurationMismatch | None:
    """As a node whose objects are as in REPORT, but for `changes` of whole indices."""
    check = watch.next()
    value = check.expected if check.expected is not None else 3
    return watch.result(changes.get(check.index, value).to_bytes(4, "little"))


def until_found(watch: ConfigurationWatch, changes: Mapping[int, int]) -> tuple[ConfigurationMismatch, int]:
    for readings in range(1, 100):
        finding = answer(watch, changes)
        if finding is not None:
            return finding, readings
    raise AssertionError("nothing was found")


def test_the_signature_is_two_words_of_the_hash_and_never_zero() -> None:
    assert signature("0123456789abcdef" * 4) == (0x0123_4567, 0x89AB_CDEF)
    assert signature("0" * 64) == (1, 1)


def test_signature_and_objects_are_read_by_turns_and_all_of_them() -> None:
    watch, asked = ConfigurationWatch(REPORT), []
    for _ in range(12):
        asked.append((watch.next().index, watch.next().subindex))
        assert answer(watch) is None
    mark = (0x1020, 1)
    objects = [(index, subindex) for index, subindex, _ in REPORT["watched"]]
    assert asked == [mark, *objects[:3], mark, *objects[3:6], mark, objects[6], (0x6061, 0), objects[0]]


def test_a_signature_that_is_gone_leads_to_the_objects() -> None:
    watch = ConfigurationWatch(REPORT)
    assert watch.result(SIGNED) is None
    for _ in range(3):
        assert answer(watch) is None
    finding = watch.result(bytes(4))  # 0: another master has written to the configuration
    assert finding == (
        False,
        "its configuration was written by another master (1020h:1: expected 0x1234567, found 0x0)",
    )
    asked = []
    for expected in checks_of(REPORT):
        asked.append((watch.next().index, watch.next().subindex))
        # bit 30 of a COB-ID (no RTR) is the device's own
        value = (expected.expected or 0) | (0x4000_0000 if asked[-1] == (0x1800, 1) else 0)
        assert watch.result(value.to_bytes(4, "little")) is None
    assert asked[0] == (0x1800, 1), "from the beginning"
    assert asked[-2:] == [(0x6075, 0), (0x6061, 0)]
    assert watch.next().index == 0x1800, "and again"


@pytest.mark.parametrize(
    ("index", "value", "text"),
    [
        (0x1800, 0x8000_0181, "1800h:1: expected 0x181, found 0x80000181"),  # switched off: bit 31
        (0x1803, 0x0000_0481, "1803h:1: expected 0x80000000, found 0x481"),  # one that was off is on
        (0x1A00, 3, "1A00h:0: expected 0x2, found 0x3"),
        (0x6075, 4750, "6075h:0: expected 9500, found 4750"),
    ],
)
@pytest.mark.parametrize("signed", [True, False])
def test_whatever_the_meaning_of_the_pdos_depends_on_is_found(
    index: int, value: int, text: str, signed: bool
) -> None:
    """With the signature intact, and in at most one round of all objects with the signature between them."""
    finding, readings = until_found(ConfigurationWatch({**REPORT, "signed": signed}), {index: value})
    assert finding == (True, f"its configuration was changed ({text})")
    assert readings <= (1 + len(REPORT["watched"])) * (4 / 3 if signed else 1) + 1


def test_bit_7_of_a_mapped_length_is_no_change() -> None:
    watch = ConfigurationWatch({**REPORT, "signed": False})
    for _ in range(4):
        assert answer(watch) is None
    assert (watch.next().index, watch.next().subindex) == (0x1A00, 1)
    assert watch.result(frame("a0 00 64 60")) is None
    assert watch.result(frame("a0 01 e4 60")) is None
    assert checks_of({**REPORT, "watched": [[0x1A00, 1, 0x6064_00A0]]})[0].expected == 0x6064_0020


def test_a_mapping_that_was_changed_needs_a_boot() -> None:
    watch = ConfigurationWatch({**REPORT, "signed": False})
    for _ in range(4):
        assert answer(watch) is None
    assert (watch.next().index, watch.next().subindex) == (0x1A00, 1)
    finding = watch.result(frame("20 01 e4 60"))  # the two positions swapped: same length, other meaning
    assert finding == (True, "its configuration was changed (1A00h:1: expected 0x60640020, found 0x60E40120)")


def test_a_mode_of_operation_that_changes_is_reported_and_no_reason_for_a_boot() -> None:
    watch = ConfigurationWatch({**REPORT, "signed": False})
    for _ in range(30):
        assert answer(watch) is None, "whatever it is at first"
    finding, _ = until_found(watch, {0x6061: 0xFD})
    assert finding == (False, "its mode of operation (6061h) is -3 now, 3 before")
    for _ in range(20):
        assert answer(watch, {0x6061: 0xFD}) is None, "reported once"
    assert checks_of({**REPORT, "gear_ratio": None})[-1].index == 0x6075, "a sensor has no mode"


def test_silence_and_refusals_do_not_stop_the_round() -> None:
    watch, asked = ConfigurationWatch({**REPORT, "signed": False}), []
    for _ in range(8):
        asked.append(watch.next())
        assert watch.result(None) is None, "no answer"
    assert len(set(asked)) == 8
    for _ in range(7):
        assert watch.result(None, 0x0800_0022) is None, "not now, because of the device's state"
    assert watch.next().index == 0x6061
    assert watch.result(None, 0x0602_0000) is None, "a drive without 6061h"
    assert 0x6061 not in {answer(watch) or watch.next().index for _ in range(20)}
    while watch.next().index != 0x6075:
        answer(watch)
    finding = watch.result(None, 0x0602_0000)
    assert finding == (True, "its configuration was changed (6075h:0: expected 9500, found no such object)")


# Boots in service


NODE = {"scaling": {"k": 1.0}, "gear_ratio": 100.0, "serial": 7, "notes": []}


class Boot:
    """A boot process that has ended, with this answer."""

    def __init__(self, answer: dict[str, Any]) -> None:
        self._answer: dict[str, Any] | None = answer
        self.request: dict[str, Any] = {}

    def send(self, request: dict[str, Any]) -> None:
        self.request = request

    def end_of_input(self) -> None:
        pass

    def alive(self) -> bool:
        return False

    def poll_answer(self) -> dict[str, Any] | None:
        answer, self._answer = self._answer, None
        return answer


class Case:
    """Node 1 was booted at the start, node 3 was absent; `now` is what each finds at its next boot (None: no answer)."""

    def __init__(self, directory: Path, config: Config) -> None:
        self.snapshot = Snapshot(directory / "s", 1e-3, 0.8)
        self.reader = SnapshotReader(directory / "s", supervisor=True)
        self.report: dict[str, Any] = {"nodes": {"1": NODE}, "absent": {"3": {"message": "no answer"}}}
        self.lines: list[str] = []
        self.starts: list[float] = []
        self.now: dict[int, dict[str, Any] | None] = {1: NODE, 3: None}
        self.time = 100.0
        self.nodes = ReturningNodes(
            config, "b", self.report, self._start, lambda *all_: self.lines.append(all_[2])
        )

    def _start(self, *_: object) -> Any:
        self.starts.append(self.time)
        found = self.now[self.nodes.busy]
        error = {"ok": False, "error": {"message": f"node {self.nodes.busy}: no answer"}}
        self.boot = Boot(error if found is None else {"ok": True, "nodes": {str(self.nodes.busy): found}})
        return self.boot

    def run(self, seconds: float, present: tuple[int, ...] = (1,)) -> None:
        for _ in range(round(seconds / 0.05)):
            self.time += 0.05
            self.nodes.watch(self.reader.read(), lambda node: node in present, self.reader, self.time)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None)


@pytest.fixture
def case(tmp_path: Path, config: Config) -> Case:
    return Case(tmp_path, config)


def test_a_boot_that_fails_is_tried_less_and_less_often_and_from_the_beginning_after_a_good_one(
    case: Case,
) -> None:
    case.nodes.request(1, "changed")
    case.now[1] = None
    case.run(40.0)
    waits = [after - before for before, after in zip(case.starts, case.starts[1:], strict=False)]
    assert waits == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0], abs=0.16)
    assert case.lines == ["boot in service: node 1: no answer"], "logged once a minute"
    case.now[1] = NODE
    case.run(9.0)
    assert "node 1 is configured again: changed" in case.lines
    assert case.nodes.waiting(case.reader.read(), case.time) == [3], "the absent one"
    case.now[1] = None
    case.nodes.request(1, "again")
    case.starts.clear()
    case.run(2.0)
    assert case.starts[1] - case.starts[0] == pytest.approx(0.5, abs=0.16)


@pytest.mark.parametrize(
    ("registers", "reset"), [((), False), ((0x11,), True), ((0x03,), False), ((0x11, 0), False)]
)
def test_a_node_with_an_error_of_communication_is_reset_at_once(
    case: Case, registers: tuple[int, ...], reset: bool
) -> None:
    """And not once more at the boot after it."""
    for register in registers:
        case.nodes.note_error(1, register)
    case.nodes.request(1, "changed")
    case.run(0.1)
    assert case.boot.request["reset"] is reset
    case.run(1.0)
    case.nodes.request(1, "changed")
    case.run(0.1)
    assert case.boot.request["reset"] is False


def test_just_after_a_boot_the_last_heartbeat_may_still_say_pre_operational(case: Case) -> None:
    case.snapshot.node_states[1] = 127
    case.run(0.25)
    assert (len(case.starts), case.snapshot.configured[1]) == (1, 1)
    case.run(0.4)
    assert len(case.starts) == 2, "but not for long"


@pytest.mark.parametrize("change", [{"scaling": {"k": 2.0}}, {"gear_ratio": 50.0}])
def test_another_scaling_or_gear_ratio_is_refused(case: Case, change: dict[str, Any]) -> None:
    case.nodes.request(1, "changed")
    case.now[1] = {**NODE, **change}
    case.run(3.0)
    assert case.snapshot.configured[1] == 0
    (name,) = change
    assert f"node 1 has another {name} than at the start" in case.lines[0]
    assert case.report["nodes"]["1"] == NODE


def test_another_device_is_named_and_used(case: Case) -> None:
    case.nodes.request(1, "changed")
    case.now[1] = {**NODE, "serial": 8, "notes": ["it squeaks"]}
    case.run(0.5)
    assert case.snapshot.configured[1] == 1
    assert case.lines[0] == "node 1: another device: serial number 00000008h, before 00000007h"
    assert case.lines[-1] == "node 1: it squeaks"


def test_an_absent_node_is_booted_when_it_is_there_and_only_then(case: Case) -> None:
    case.run(3.0)
    assert case.starts == []
    case.now[3] = {**NODE, "scaling": {"nm_per_unit": {"1": 0.25}}, "gear_ratio": None}
    case.run(0.5, present=(3,))
    assert case.lines == ["node 3 appeared and is configured"]
    assert case.nodes.absent == set()
    assert case.snapshot.factors(3) == (0.25, 0.0, 0.0, 0.0)
    case.run(3.0, present=(3,))
    assert len(case.starts) == 1
    assert json.loads(json.dumps(case.report))["nodes"]["3"]["gear_ratio"] is None


def test_a_gear_ratio_of_another_joint_is_an_error_from_half_a_percent_on(config: Config) -> None:
    joint = config.joints[0]
    ratio = joint.joint.gear_ratio
    assert gear_ratio_error(config, joint.node_id, 1.004 * ratio) is None
    assert gear_ratio_error(config, joint.node_id, None) is None
    assert "6091h gear ratio" in (gear_ratio_error(config, joint.node_id, 0.99 * ratio) or "")
    assert gear_ratio_error(config, 99, 1.0) is None


def test_settings_of_the_boot_are_in_its_request(tmp_path: Path) -> None:
    content = shipped_bench()
    content["estimator"] = {"method": "tob"}
    content["joint_2"]["sdo_timeout_ms"] = 900
    path = tmp_path / "c.yaml"

    def asked(**nodes: object) -> dict[str, Any]:
        path.write_text(yaml.safe_dump(content | {"nodes": nodes}))
        found: dict[str, Any] = boot_request(load_config(path), "b").as_json()
        return found

    assert asked()["reset"] is True
    assert asked()["sync"]["counter_overflow"] == 0, "a drive comes back with 1019h = 0"
    found = asked(reset_communication=False, sdo_timeout_ms=700)
    assert found["reset"] is False
    assert [each["sdo_timeout_ms"] for each in found["nodes"]] == [700, 900, 700]
    content["sync"]["counter_overflow"] = 240
    assert asked()["sync"]["counter_overflow"] == 240


def test_where_resets_are_switched_off_a_boot_that_failed_resets_nothing(
    tmp_path: Path, config: Config
) -> None:
    case = Case(tmp_path, replace(config, reset_communication=False))
    case.nodes.note_error(1, 0x11)
    case.nodes.request(1, "changed")
    case.now[1] = None
    for _ in range(2):
        case.run(1.0)
        assert case.boot.request["reset"] is False
