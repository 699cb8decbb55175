"""The process that prepares estimators, and the supervisor's side: what is wrong with new files ends here, in one line."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import stat
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
import yaml
from onnx import helper

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.reload.block_file import decoded
from jtqd.daemon.reload.files import Reload, ReloadError
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.child_process import Child
from jtqd.daemon.shared.cycle_record import RECORD_SIZE
from jtqd.daemon.shared.ring import Ring
from tests.daemon.loop.cycle_helpers import ExactTime, make, moving
from tests.estimator.fused_configuration import configured, network_of, networks


class RunningLoop:
    """In place of the loop process: what it was told, and which signals it got."""

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []
        self.signals: list[int] = []
        self.process = self

    def tell(self, message: dict[str, Any]) -> None:
        self.told.append(message)

    def send_signal(self, number: int) -> None:
        self.signals.append(number)


class Bench:
    """A running daemon's ring and configuration, without the daemon."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.directory = directory
        self.path = configured(directory, "fused", networks())
        self.config = load_config(self.path)
        clock = ExactTime().install(monkeypatch)
        cycle, _, _ = make(directory, moving, slots=4096)
        clock.turn(cycle, 900)
        self.loop = RunningLoop()
        self.children: list[Child] = []
        request = {"config": str(self.path), "ring": str(directory / "ring")}
        self.reload = Reload(request, self._child, lambda config: None)
        self.file = directory / "estimators"

    def _child(self, module: str, arguments: list[str], name: str) -> Child:
        self.children.append(Child(module, arguments, name=name))
        return self.children[-1]

    def until_ordered(self, between: Callable[[], None] = lambda: None) -> None:
        self.reload.start(self.config, self.path)
        between()
        deadline = time.monotonic() + 60.0
        while not self.loop.told:
            assert time.monotonic() < deadline
            self.reload.poll(self.loop)  # type: ignore[arg-type]
            time.sleep(0.01)

    def refused(self, between: Callable[[], None] = lambda: None) -> str:
        """Reload, which must be refused before the loop hears of it; return the reason."""
        with pytest.raises(ReloadError) as error:
            self.until_ordered(between)
        assert (self.loop.told, self.loop.signals) == ([], [])
        assert not self.reload.running
        assert not self.file.exists()
        assert all(not child.alive() for child in self.children)
        return str(error.value)

    def edit(self, name: str, change: Callable[[Any], Any]) -> None:
        path = self.directory / name
        content = yaml.safe_load(path.read_text())
        change(content)
        path.write_text(yaml.safe_dump(content))


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def test_the_loop_gets_its_order_when_all_is_prepared(bench: Bench) -> None:
    bench.edit("j2.yaml", lambda joint: joint.update(torque_constant_nm_per_a=0.1))
    bench.until_ordered()
    assert bench.reload.running
    content = bench.file.read_bytes()
    assert bench.loop.told == [
        {"swap": str(bench.file), "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    ]
    assert bench.loop.signals == [signal.SIGUSR2]
    assert stat.S_IMODE(bench.file.stat().st_mode) == 0o600
    position, joints = decoded(memoryview(content))
    assert position == 900
    assert joints[1].plain["joint"]["torque_constant_nm_per_a"] == 0.1
    with pytest.raises(ReloadError, match="another reload is under way"):
        bench.reload.start(bench.config, bench.path)
    config, about = bench.reload.answered({"swapped": True, "cycle": 905, "missed": 0})
    assert isinstance(config, Config)
    assert config.joints[1].joint.torque_constant_nm_per_a == 0.1
    assert (about["cycle"], about["cycles"]) == (905, 900)
    assert about["changes"].keys() == {"joint_1", "joint_2"}
    assert not bench.reload.running
    assert not bench.file.exists()


def test_a_loop_that_refuses_goes_on_with_the_old_files(bench: Bench) -> None:
    bench.until_ordered()
    with pytest.raises(ReloadError, match="found another SHA-256"):
        bench.reload.answered({"not_swapped": "found another SHA-256"})
    assert not bench.reload.running
    assert not bench.file.exists()
    bench.loop.told.clear()
    bench.until_ordered()


def test_no_real_time_priority_and_below_the_others(bench: Bench) -> None:
    def look() -> None:
        stat_of = Path(f"/proc/{bench.children[-1].pid}/stat")
        deadline = time.monotonic() + 30.0
        nice = str(min(19, os.getpriority(os.PRIO_PROCESS, 0) + 10))
        while (fields := stat_of.read_text().rpartition(")")[2].split())[16] != nice:
            assert time.monotonic() < deadline
        assert fields[38] == "0"  # SCHED_OTHER

    bench.until_ordered(look)


def test_a_preparation_that_is_killed(bench: Bench) -> None:
    why = bench.refused(lambda: os.kill(bench.children[-1].pid, signal.SIGKILL))
    assert why == "the preparation of estimators ended with exit status -9"
    bench.until_ordered()


def test_a_preparation_is_ended_with_the_daemon(bench: Bench) -> None:
    bench.reload.start(bench.config, bench.path)
    bench.reload.abandon()
    assert not bench.children[-1].alive()


def test_files_that_change_while_they_are_read(bench: Bench) -> None:
    def change() -> None:
        bench.edit("j1.yaml", lambda joint: joint.update(rated_torque_nm=99.0))

    assert "was changed during reading" in bench.refused(change)


def broken_yaml(bench: Bench) -> None:
    (bench.directory / "j1.yaml").write_text("name: [\n")


def negative(bench: Bench) -> None:
    bench.edit("j1.yaml", lambda joint: joint.update(gear_ratio=-5))


def unknown_key(bench: Bench) -> None:
    bench.edit("j2.yaml", lambda joint: joint.update(gear_ration=5))


def missing(bench: Bench) -> None:
    (bench.directory / "j2.yaml").unlink()


def no_section(bench: Bench) -> None:
    bench.edit("j2.yaml", lambda joint: joint.pop("fused"))


def other_hash(bench: Bench) -> None:
    (bench.directory / "n1.onnx").write_bytes(network_of(2))


def with_network(bench: Bench, data: bytes) -> None:
    (bench.directory / "n1.onnx").write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    bench.edit("c.yaml", lambda config: config["joint_1"]["network"].update(sha256=digest))


def no_onnx(bench: Bench) -> None:
    with_network(bench, b"no network")


def of_the_other_joint(bench: Bench) -> None:
    with_network(bench, network_of(2))


def not_finite(bench: Bench) -> None:
    model = onnx.load_from_string(network_of(1))
    weights = model.graph.initializer[0]
    raw = bytearray(weights.raw_data)
    raw[:8] = struct.pack("<d", math.nan)
    weights.raw_data = bytes(raw)
    with_network(bench, model.SerializeToString())


def foreign(bench: Bench) -> None:
    """The same answer by a graph that is none of ours."""
    model = onnx.load_from_string(network_of(1))
    last = model.graph.node[-1]
    answer, last.output[0] = last.output[0], "negative"
    model.graph.node.append(helper.make_node("Neg", ["negative"], ["positive"]))
    model.graph.node.append(helper.make_node("Neg", ["positive"], [answer]))
    with_network(bench, model.SerializeToString())


def too_low(bench: Bench) -> None:
    """No torque that the bench shows is believable any more."""
    for name in ("j1.yaml", "j2.yaml"):
        bench.edit(name, lambda joint: joint.update(rated_torque_nm=0.001))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (broken_yaml, "j1.yaml"),
        (negative, "gear_ratio"),
        (unknown_key, "gear_ration"),
        (missing, "j2.yaml"),
        (no_section, "j2.yaml: key 'fused': missing"),
        (other_hash, "sha256"),
        (no_onnx, "n1.onnx"),
        (of_the_other_joint, "found a network of joint 'joint2'"),
        (not_finite, "n1.onnx"),
        (
            foreign,
            "n1.onnx: its graph is none of 'jtq train', so that ONNX Runtime evaluates it: needs a restart",
        ),
        (too_low, "estimates that are published now would be invalid with the new files"),
    ],
)
def test_each_kind_of_bad_file_is_refused_before_the_loop_hears_of_it(
    bench: Bench, change: Callable[[Bench], None], why: str
) -> None:
    change(bench)
    said = bench.refused()
    assert why in said
    assert "\n" not in said
    assert "Traceback" not in said


def test_a_ring_of_another_layout(bench: Bench) -> None:
    Ring(bench.directory / "ring", 8, RECORD_SIZE + 8)
    assert "not a ring of" in bench.refused()
    Ring(bench.directory / "ring", 8, cr.RECORD_SIZE)
    assert json.dumps(bench.reload.running) == "false"
