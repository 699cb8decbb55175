"""Boots in service: how often one is tried, what is refused, and what counts as the same device."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import ReturningNodes, boot_request, gear_ratio_error
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from tests.shipped_bench import shipped_bench

NODE = {"scaling": {"k": 1.0}, "gear_ratio": 100.0, "serial": 7, "notes": []}


class Boot:
    """A boot process that has ended, with `said`."""

    def __init__(self, said: dict[str, Any]) -> None:
        self._said: dict[str, Any] | None = said
        self.request: dict[str, Any] = {}

    def send(self, request: dict[str, Any]) -> None:
        self.request = request

    def end_of_input(self) -> None:
        pass

    def alive(self) -> bool:
        return False

    def poll_answer(self) -> dict[str, Any] | None:
        said, self._said = self._said, None
        return said


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
    assert case.lines == ["boot in service: node 1: no answer"], "said once a minute"
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
def test_a_node_that_tells_an_error_of_communication_is_reset_at_once(
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


def test_what_the_configuration_says_of_the_boot_is_in_its_request(tmp_path: Path) -> None:
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
