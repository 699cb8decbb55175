"""What an estimator may say, and what of it reaches the bus: no number that is none, none that the joint cannot have."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.estimator import make_estimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import (
    DEGRADED,
    INVALID,
    NAMES,
    PUBLISHED,
    STALE,
    STANDSTILL,
    STARTING,
    VALID,
    Estimate,
)
from jtqd.models.files import load_joint, shipped
from tests.daemon.loop.cycle_helpers import (
    I32,
    MOTION,
    ExactTime,
    ScriptedSocket,
    estimates,
    frame,
    inputs,
    make,
)

JOINTS = [load_joint(shipped(f"joint{n}.yaml")) for n in (1, 2)]
SETTINGS = EstimatorSettings(method="efficiency")
LIMIT_NM = [SETTINGS.torque_limit * joint.rated_torque_nm for joint in JOINTS]
NAN, INF = math.nan, math.inf
GOOD = Estimate(5.0, 0.5, VALID, 5.0, 5.0, 5.0)


class Scripted:
    """An estimator with scripted answers: the only way to have one that is broken."""

    with_network = True

    def __init__(self, reported: Iterator[Estimate]) -> None:
        self._reported = reported

    def step(self, *_: Any) -> Estimate:
        return next(self._reported)

    def reset(self) -> None:
        """Nothing to forget."""


def checked(tmp_path: Path, reported: Iterator[Estimate], latch: int = 0, script: Any = None) -> Any:
    """A cycle in which joint 1 has scripted estimates and joint 2 is good; limits of the shipped joints."""
    settings = SafetySettings(latch=latch, plausibility=None)
    safety = [JointSafety(settings, SETTINGS, joint, 10_000_000) for joint in JOINTS]
    estimators = [Scripted(reported), Scripted(itertools.repeat(GOOD))]
    return make(tmp_path, script or (lambda n: inputs()), estimators=estimators, safety=safety)


def pdos(socket: ScriptedSocket) -> list[Any]:
    return [decode(data) for data in estimates(socket)]


BROKEN = [
    # torque, sigma, name of the fault
    (NAN, 0.5, "not_finite"),
    (INF, 0.5, "not_finite"),
    (-INF, 0.5, "not_finite"),
    (5.0, NAN, "not_finite"),
    (5.0, INF, "not_finite"),
    (5.0, -0.1, "not_finite"),
    (NAN, NAN, "not_finite"),
    (1e300, 0.5, "out_of_range"),
    (-1e300, 0.5, "out_of_range"),
    (LIMIT_NM[0] * 1.0001, 0.5, "out_of_range"),
    (-LIMIT_NM[0] * 1.0001, 0.5, "out_of_range"),
    (400.0, 0.5, "out_of_range"),
    (5.0, 0.5001 * JOINTS[0].rated_torque_nm, "out_of_range"),
]


@pytest.mark.parametrize("status", [VALID, DEGRADED, STANDSTILL])
@pytest.mark.parametrize("broken", BROKEN)
def test_a_number_that_is_none_is_invalid_named_and_counted(
    tmp_path: Path, clock: ExactTime, broken: tuple[float, float, str], status: int
) -> None:
    torque, sigma, name = broken
    reported = itertools.chain(
        itertools.repeat(GOOD, 30),
        [GOOD._replace(torque_nm=torque, sigma_nm=sigma, status=status)],
        itertools.repeat(GOOD),
    )
    cycle, socket, reader = checked(tmp_path, reported)
    clock.turn(cycle, 31)
    last = pdos(socket)[-1]
    assert (last.status, last.torque_nm[0], last.sigma_nm[0]) == ((INVALID, VALID), None, None)
    assert last.torque_nm[1] == 5.0, "the other joint is not concerned"
    joint = cr.joint_of(reader.read(limit=64).records[-1], 1)
    assert (joint.status, math.isnan(joint.torque_nm), math.isnan(joint.sigma_nm)) == (INVALID, True, True)
    assert faults.names_of(joint.input_flags >> 8) == (name,)
    clock.turn(cycle, 10)
    counters = SnapshotReader(tmp_path / "snapshot").read().counters
    assert counters[f"fault_{name}"] == 1
    assert sum(count for key, count in counters.items() if key.startswith("fault_")) == 1


def test_the_largest_torque_that_a_joint_can_have_is_published(tmp_path: Path, clock: ExactTime) -> None:
    reported = itertools.repeat(GOOD._replace(torque_nm=LIMIT_NM[0]))
    cycle, socket, _ = checked(tmp_path, reported)
    clock.turn(cycle, 25)
    assert pdos(socket)[-1].torque_nm[0] == pytest.approx(LIMIT_NM[0])


def test_a_sigma_of_half_the_rated_torque_is_published(tmp_path: Path, clock: ExactTime) -> None:
    reported = itertools.repeat(GOOD._replace(sigma_nm=0.5 * JOINTS[0].rated_torque_nm))
    cycle, socket, _ = checked(tmp_path, reported)
    clock.turn(cycle, 25)
    assert pdos(socket)[-1].torque_nm[0] == 5.0


def _status_at_6_a(joint: Joint) -> int:
    estimator = make_estimator(joint, dataclasses.replace(SETTINGS, method="efficiency"))
    run = [estimator.step(1e-3, 6.0, 0.1 * k, 100.0, 1e-3 * k) for k in range(100)]
    return run[-1].status


def test_the_peak_torque_of_a_joint_is_its_limit() -> None:
    peaked = dataclasses.replace(JOINTS[0], peak_torque_nm=57.0)
    assert JointSafety(SafetySettings(), SETTINGS, peaked).torque_limit_nm == 57.0
    assert [_status_at_6_a(joint) for joint in (peaked, dataclasses.replace(peaked, peak_torque_nm=5.0))] == [
        VALID,
        INVALID,
    ]
    assert JointSafety(SafetySettings(), SETTINGS, JOINTS[0]).torque_limit_nm == LIMIT_NM[0]


def test_a_torque_beyond_the_field_is_out_of_range_for_the_strongest_joint_too() -> None:
    strong = dataclasses.replace(JOINTS[0], rated_torque_nm=1000.0)
    assert JointSafety(SafetySettings(), SETTINGS, strong).torque_limit_nm == 327.67


@pytest.mark.parametrize("seed", range(4))
def test_whatever_an_estimator_says(tmp_path: Path, clock: ExactTime, seed: int) -> None:
    """Every field drawn from numbers, absurd ones and none, every status; frames lost, drives off and in fault."""
    draw = random.Random(seed)
    some = (NAN, INF, -INF, 0.0, -0.0, 1.0, -1.0, 5e-324, 1e308, -1e308, 119.9, 120.1, 327.67, 327.68, 1e-9)

    def say() -> Iterator[Estimate]:
        while True:
            if draw.random() < 0.99:
                yield GOOD
                continue
            torque, sigma, tob, physics, network = (draw.choice(some) for _ in range(5))
            yield Estimate(torque, sigma, draw.choice(list(NAMES)), tob, physics, network)

    def script(n: int) -> list[bytes]:
        word = draw.choice((0x27,) * 600 + (0x08, 0x40, 0x07, 0x1F))
        frames = inputs(status=word)
        return [each for each in frames if draw.random() > 0.0005]

    latch = draw.choice((0, faults.NOT_FINITE, 0x3FF & ~faults.STALE))
    cycle, socket, reader = checked(tmp_path, say(), latch, script)
    seen = []
    for _ in range(40):
        clock.turn(cycle, 50)
        cycle.reset_faults()
        seen += reader.read(limit=64).records
    published = pdos(socket)
    assert len(seen) == len(published) == 2000
    for record, pdo in zip(seen, published, strict=True):
        for n in (0, 1):
            joint = cr.joint_of(record, n + 1)
            assert joint.status == pdo.status[n], f"seed {seed}"
            numbers = (joint.torque_nm, joint.sigma_nm)
            if joint.status in PUBLISHED:
                assert abs(joint.torque_nm) <= LIMIT_NM[n]
                assert 0.0 <= joint.sigma_nm < INF
                assert pdo.torque_nm[n] == pytest.approx(joint.torque_nm, abs=0.00501)
                assert joint.input_flags & 0xFF00 == 0, "no fault in a cycle with a number"
                assert joint.input_flags & 3 == 3
                assert joint.statusword & 0x6F in {0x27, 0x07}
            else:
                assert all(map(math.isnan, numbers))
                assert (pdo.torque_nm[n], pdo.sigma_nm[n]) == (None, None)
    shown = [pdo.status[0] for pdo in published]
    assert {VALID, INVALID, STARTING} <= set(shown)
    back = [a not in PUBLISHED and b in PUBLISHED for a, b in itertools.pairwise(shown)]
    assert max(sum(back[n : n + 1000]) for n in range(0, 1000, 50)) <= 50


def test_the_network_that_is_dropped_is_counted_by_its_reason(tmp_path: Path, clock: ExactTime) -> None:
    limit = SETTINGS.network_limit * JOINTS[0].rated_torque_nm
    dropped = {
        "network_not_finite": GOOD._replace(status=DEGRADED, network_nm=NAN),
        "network_far": GOOD._replace(status=DEGRADED, network_nm=5.0 + limit * 1.01),
        "network_outside": GOOD._replace(status=DEGRADED, network_nm=5.1),
    }
    reported = itertools.chain(itertools.repeat(GOOD, 30), dropped.values(), itertools.repeat(GOOD))
    cycle, socket, _ = checked(tmp_path, reported)
    clock.turn(cycle, 41)
    counters = SnapshotReader(tmp_path / "snapshot").read().counters
    assert {name: counters[name] for name in dropped} == dict.fromkeys(dropped, 1)
    assert (counters["network_fallbacks"], counters["network_no_time"]) == (3, 0)
    assert [pdo.status[0] for pdo in pdos(socket)[29:34]] == [VALID, DEGRADED, DEGRADED, DEGRADED, DEGRADED]


def test_no_number_of_a_network_at_standstill_is_counted_too(tmp_path: Path, clock: ExactTime) -> None:
    """There it is not used, and the status stays 6."""
    reported = itertools.chain(itertools.repeat(GOOD._replace(status=STANDSTILL), 30), [
        GOOD._replace(status=STANDSTILL, network_nm=INF)
    ], itertools.repeat(GOOD))  # fmt: skip
    cycle, socket, _ = checked(tmp_path, reported)
    clock.turn(cycle, 31)
    assert pdos(socket)[-1].status[0] == STANDSTILL
    clock.turn(cycle, 10)
    assert SnapshotReader(tmp_path / "snapshot").read().counters["network_not_finite"] == 1


def moving(n: int, *, jump: int = 0, word: int = 0x27) -> list[bytes]:
    """Both joints turn with 50 rad/s of the motor; counts of joint 1's motor position are off by `jump`."""
    steps = 5000 * n  # 10 ms per cycle, 1e-4 rad per count, 1e-5 on the link side, G = 100
    return [
        frame(0x181, I32.pack(steps + jump, steps // 10)),
        frame(0x281, MOTION.pack(50_000, 200 + n % 3, word)),
        frame(0x182, I32.pack(-steps, -steps // 10)),
        frame(0x282, MOTION.pack(-50_000, 200 + n % 3, 0x27)),
        inputs()[4],
    ]


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    """Exact time for cycle and bus."""
    return ExactTime().install(monkeypatch)


def live(tmp_path: Path, script: Any, settings: SafetySettings | None = None) -> Any:
    """Real estimators and all checks, as the loop has them."""
    safety = [JointSafety(settings, SETTINGS, joint, 10_000_000) for joint in JOINTS]
    return make(tmp_path, script, safety=safety, slots=1024)


def test_a_jump_is_latched_until_the_reset_and_the_record_tells_it_all(
    tmp_path: Path, clock: ExactTime
) -> None:
    cycle, socket, reader = live(tmp_path, lambda n: moving(n, jump=90_000 if n > 100 else 0))
    clock.turn(cycle, 400)
    shown = [pdo.status[0] for pdo in pdos(socket)]
    assert set(shown[30:100]) == {VALID}
    assert set(shown[100:]) == {INVALID}
    view = SnapshotReader(tmp_path / "snapshot").read()
    assert faults.names_of(view.joints[0].latched) == ("motor_jump",)
    assert (view.counters["fault_motor_jump"], view.counters["latches"], view.joints[1].latched) == (1, 1, 0)
    cycle.reset_faults()
    clock.turn(cycle, 100)
    shown = [pdo.status for pdo in pdos(socket)]
    assert shown[-1] == (VALID, VALID)
    assert {two for _, two in shown[30:]} == {VALID}
    assert shown[400:].index((VALID, VALID)) < 60, "50 good cycles after the reset"
    records = reader.read(limit=1024).records
    flags = [cr.joint_of(record, 1).input_flags for record in records]
    assert flags[99] >> 8 == 0
    assert "motor_jump" in faults.names_of(flags[100] >> 8)
    assert all(each & 0x20 for each in flags[100:400])
    assert not any(each & 0x20 for each in flags[400:])
    resets = [n for n, record in enumerate(records) if cr.header_of(record).flags & cr.FLAG_RESET]
    assert resets == [400]
    clock.turn(cycle, 9)
    view = SnapshotReader(tmp_path / "snapshot").read()
    assert view.counters["latch_resets"] == 1
    one, two = view.joints
    assert (one.latched, one.latches, faults.names_of(one.released)) == (0, 1, ("motor_jump",))
    assert (two.latched, two.latches, two.released) == (0, 0, 0)


def test_a_reset_without_a_latch_does_nothing(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, reader = live(tmp_path, moving)
    clock.turn(cycle, 50)
    cycle.reset_faults()
    clock.turn(cycle, 50)
    assert {pdo.status for pdo in pdos(socket)[25:]} == {(VALID, VALID)}
    assert not any(cr.header_of(record).flags & cr.FLAG_RESET for record in reader.read(limit=128).records)


def test_a_frozen_encoder_is_invalid_and_recovers_by_itself(tmp_path: Path, clock: ExactTime) -> None:
    """Frames keep coming in time, their position does not change, the velocity says 50 rad/s."""

    def script(n: int) -> list[bytes]:
        frames = moving(n)
        return [moving(150)[0], *frames[1:]] if 150 <= n < 350 else frames

    settings = SafetySettings(latch=0)
    cycle, socket, _ = live(tmp_path, script, settings)
    clock.turn(cycle, 600)
    shown = [pdo.status[0] for pdo in pdos(socket)]
    assert set(shown[30:150]) == {VALID}
    assert INVALID in shown[150:280], "noticed"
    assert shown[349] == INVALID
    assert shown[-1] == VALID
    counters = SnapshotReader(tmp_path / "snapshot").read().counters
    assert counters["fault_velocity_mismatch"] + counters["fault_torsion"] >= 1


def test_too_far_from_the_sensor_for_too_long_is_latched_where_it_is_configured(
    tmp_path: Path, clock: ExactTime
) -> None:
    settings = SafetySettings(latch=faults.DEVIATION, deviation_sigmas=3.0, deviation_s=1.0)
    for name, off in (("near", 0.0), ("far", 1.0)):
        directory = tmp_path / name
        directory.mkdir()
        reported = itertools.repeat(GOOD._replace(torque_nm=9.0 + 10.0 * off, sigma_nm=1.0))
        safety = [JointSafety(settings, SETTINGS, joint, 10_000_000) for joint in JOINTS]
        estimators = [Scripted(reported), Scripted(reported)]
        cycle, socket, _ = make(directory, lambda n: inputs(), estimators=estimators, safety=safety)
        clock.turn(cycle, 99)
        assert pdos(socket)[-1].status == (VALID, VALID)
        clock.turn(cycle, 30)
        expected = (INVALID, INVALID) if off else (VALID, VALID)
        assert pdos(socket)[-1].status == expected, name


def test_a_stale_sequence_never_carries_a_number(tmp_path: Path, clock: ExactTime) -> None:
    """The last line of defence is the bytes themselves."""
    cycle, socket, _ = make(tmp_path, lambda n: inputs()[1:] if n % 7 == 0 else inputs())
    clock.turn(cycle, 200)
    for data in estimates(socket):
        torque, _, _, _, status, _ = struct.unpack("<hhBBBB", data)
        assert (torque == -0x8000) == (status & 0x0F not in PUBLISHED)


@pytest.mark.parametrize(
    "other",
    [frame(0x080, b"\x07"), frame(0x181, I32.pack(77, 77))],
    ids=["a foreign SYNC", "a second sender of a PDO"],
)
def test_while_there_are_two_masters_or_two_nodes_of_one_number_there_is_no_torque(
    tmp_path: Path, clock: ExactTime, other: bytes
) -> None:
    """In every third cycle only: the others are held back too."""
    cycle, socket, _ = live(
        tmp_path, lambda n: [*moving(n), *([other] if 100 <= n < 200 and n % 3 == 0 else [])]
    )
    clock.turn(cycle, 300)
    shown = [pdo.status[0] for pdo in pdos(socket)]
    assert set(shown[30:101]) == {VALID}
    assert set(shown[101:198]) == {STALE}
    assert shown[-1] == VALID
