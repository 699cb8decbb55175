"""What may change in a running daemon and what needs a restart; new estimators beside the running loop."""

import math
import re
import shutil
from pathlib import Path

import pytest

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.reload.files import needs_restart
from jtqd.daemon.reload.shadow import Shadow, follow
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import INVALID, VALID, Estimate
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import ExactTime, inputs, make


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    shutil.copytree(shipped("bench.yaml").parent / "trained", tmp_path / "trained")
    shutil.copy(shipped("bench.yaml"), tmp_path / "bench.yaml")
    return tmp_path


def changed(directory: Path, name: str, old: str, new: str) -> Config:
    path = directory / name
    text = path.read_text()
    assert len(re.findall(old, text)) >= 1, old
    path.write_text(re.sub(old, new, text, count=1))
    return load_config(directory / "bench.yaml")


@pytest.mark.parametrize(
    ("name", "old", "new", "keys"),
    [
        ("bench.yaml", "bandwidth_rad_s: 200.0", "bandwidth_rad_s: 150.0", []),
        ("bench.yaml", "method: fused", "method: tob", []),
        ("trained/joint1.yaml", r"rotor_inertia_kgm2: (\S+)", r"rotor_inertia_kgm2: 1.0e-04", []),
        ("bench.yaml", "period_us: 1000", "period_us: 2000", ["period_ns"]),
        ("bench.yaml", "node: 1", "node: 7", ["joint_1.node_id"]),
        ("bench.yaml", "temperature: true .*", "temperature: false", ["joint_1.temperature"]),
        ("bench.yaml", "node: 3, channels: 1", "node: 4, channels: 1", ["sensor"]),
        ("bench.yaml", "heartbeat_ms: 100", "heartbeat_ms: 90", ["heartbeat_ms"]),
        ("bench.yaml", "ring_cycles: 4096", "ring_cycles: 8192", ["recording"]),
        ("bench.yaml", "priority: 80", "priority: 70", ["realtime"]),
        ("bench.yaml", "node_id: 32", "node_id: 33", ["node_id"]),
    ],
)
def test_what_may_change_and_what_needs_a_restart(
    directory: Path, name: str, old: str, new: str, keys: list[str]
) -> None:
    before = load_config(directory / "bench.yaml")
    assert needs_restart(before, changed(directory, name, old, new)) == keys


class Twin:
    """In place of an estimator: what it was given, and an answer."""

    def __init__(self, answer: Estimate) -> None:
        self.answer = answer
        self.given: list[tuple[float, ...]] = []

    def step(self, *values: float) -> Estimate:
        self.given.append(values)
        return self.answer


def run_with_gaps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cycles: int = 900
) -> list[list[tuple[float, ...]]]:
    """A loop whose inputs are missing now and then; what its own estimators were given."""
    clock = ExactTime().install(monkeypatch)
    given: list[list[tuple[float, ...]]] = [[], []]

    def script(sync: int) -> list[bytes]:
        frames = inputs(velocity=5000 + sync, current=100 + sync)
        return frames[1:] if sync % 50 == 7 else frames

    cycle, _, _ = make(tmp_path, script, slots=4096)
    for n, joint in enumerate(cycle.joints):
        step = joint.estimator.step

        def watched(*values: float, n: int = n, step: object = step) -> Estimate:
            given[n].append(values)
            return step(*values)  # type: ignore[operator,no-any-return]

        joint.estimator = type("Watched", (), {"step": staticmethod(watched), "with_network": False})()
    clock.turn(cycle, cycles)
    return given


def test_the_shadow_is_given_what_the_loop_was_given_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = run_with_gaps(tmp_path, monkeypatch)
    twins = [Twin(Estimate(1.0, 0.1, VALID, 1.0, 1.0, math.nan)) for _ in range(2)]
    shadow = Shadow(tmp_path / "ring", twins)  # type: ignore[arg-type]
    shadow.catch_up()
    assert shadow.cycles == 900
    for twin, expected in zip(twins, given, strict=True):
        assert str(twin.given) == str(expected)  # NaN temperatures and all
    assert len(given[0]) < 900, "cycles without inputs are skipped by both"


def test_estimators_that_would_make_most_estimates_invalid_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_with_gaps(tmp_path, monkeypatch, 2000)
    good = Twin(Estimate(1.0, 0.1, VALID, 1.0, 1.0, math.nan))
    bad = Twin(Estimate(math.nan, math.nan, INVALID, math.nan, math.nan, math.nan))
    for twins, refused in (([good, good], False), ([good, bad], True)):
        shadow = Shadow(tmp_path / "ring", twins)  # type: ignore[arg-type]
        shadow.catch_up()
        objection = shadow.objection()
        assert (objection is not None) == refused
    assert objection is not None
    assert re.match(r"joint 2: (\d+) of \1 estimates that are published now would be invalid", objection)


def test_it_tells_how_far_the_new_estimates_are_from_the_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_with_gaps(tmp_path, monkeypatch, 2000)
    same = [
        JointEstimator(load_joint(shipped(f"joint{n}.yaml")), EstimatorSettings(method="efficiency"))
        for n in (1, 2)
    ]
    shadow = Shadow(tmp_path / "ring", same)
    shadow.catch_up()
    assert shadow.changes()["joint_1"]["rms_change_nm"] == 0.0
    other = [
        JointEstimator(load_joint(shipped(f"joint{n}.yaml")), EstimatorSettings(method="tob")) for n in (1, 2)
    ]
    shadow = Shadow(tmp_path / "ring", other)
    shadow.catch_up()
    assert shadow.changes()["joint_1"]["rms_change_nm"] > 0.5


def test_a_cycle_without_time_for_the_network_is_one_in_the_shadow_too() -> None:
    record = cr.JointRecord(
        1.0, 0.1, 2.0, 0.01, 3.0, 25.0, *(math.nan,) * 5, 0.001, *(math.nan,) * 4, 0x27, VALID, 0, 0
    )
    twin = Twin(Estimate(1.0, 0.1, VALID, 1.0, 1.0, math.nan))
    both = cr.FLAG_POSITION | cr.FLAG_MOTION
    for flags in (both, both | cr.FLAG_NETWORK_SKIPPED):
        assert follow(twin, record._replace(input_flags=flags)) is twin.answer  # type: ignore[arg-type]
    sample = (0.001, 1.0, 0.1, 2.0, 0.01, 25.0)
    assert twin.given == [(*sample, True), (*sample, False)]
    for flags in (0, cr.FLAG_POSITION, cr.FLAG_MOTION):
        assert follow(twin, record._replace(input_flags=flags)) is None  # type: ignore[arg-type]
