"""The rules that withdraw a torque, each at its limit: what is still published, what is not, and what the record shows."""

from __future__ import annotations

import itertools
import math
import sys
from array import array
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jtqd.daemon.config import SafetySettings, load_config
from jtqd.daemon.core.status import JointRules, JointSafety, safety_of
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.observer import reference_of
from jtqd.estimator.settings import bandwidth_of, largest_difference_nm, recommended
from jtqd.estimator.status import DEGRADED, INVALID, STANDSTILL, VALID, Estimate
from tests.daemon.loop.cycle_helpers import ExactTime, inputs, make
from tests.daemon.loop.test_safety_published import GOOD, JOINTS, LIMIT_NM, SETTINGS, Scripted, checked, pdos

SENSOR_NM = 9.0
"""Of `inputs`."""
LONG = 100
"""Cycles of 10 ms that make the fault `deviation`."""


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    """Exact time for cycle and bus."""
    return ExactTime().install(monkeypatch)


def deviating(tmp_path: Path, reported: Iterator[Estimate], joint: Any = None, estimator: Any = None) -> Any:
    """A cycle that watches the deviation from the sensor for 1 s at 3 sigma; joint, estimator: whose limits it has."""
    settings = SafetySettings(
        latch=faults.DEVIATION, deviation_sigmas=3.0, deviation_s=1.0, plausibility=None
    )
    safety = [JointSafety(settings, estimator, joint, 10_000_000) for _ in JOINTS]
    return make(
        tmp_path,
        lambda n: inputs(),
        estimators=[Scripted(reported), Scripted(itertools.repeat(GOOD))],
        safety=safety,
    )


def at(torque_nm: float, sigma_nm: float = 1.0) -> Estimate:
    return GOOD._replace(torque_nm=torque_nm, sigma_nm=sigma_nm)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_a_deviation_of_the_bound_is_none_and_more_is_one(
    tmp_path: Path, clock: ExactTime, side: float, sigma: float
) -> None:
    """Without a joint file the sensor has no offset of its own, and the bound is 3 sigma."""
    for name, off, expected in (("at", 3.0, VALID), ("beyond", 3.001, INVALID)):
        (tmp_path / name).mkdir()
        reported = itertools.repeat(at(SENSOR_NM + side * off * sigma, sigma))
        cycle, socket, _ = deviating(tmp_path / name, reported)
        clock.turn(cycle, 2 * LONG)
        assert pdos(socket)[-1].status[0] == expected


def test_the_offset_of_the_sensor_adds_to_sigma(tmp_path: Path, clock: ExactTime) -> None:
    fused = recommended("fused")  # its sigma has no floor that holds the sensor's offset
    zero = fused.sensor_zero_nm(JOINTS[0].rated_torque_nm)
    bound = 3.0 * math.sqrt(0.6**2 + zero**2)
    assert bound > 1.05 * 3.0 * 0.6
    for name, off, expected in (("within", 0.99, VALID), ("beyond", 1.01, INVALID)):
        (tmp_path / name).mkdir()
        cycle, socket, _ = deviating(
            tmp_path / name, itertools.repeat(at(SENSOR_NM + off * bound, 0.6)), JOINTS[0], fused
        )
        clock.turn(cycle, 3 * LONG)
        assert pdos(socket)[-1].status[0] == expected


def test_a_deviation_is_a_fault_in_the_cycle_that_makes_it_long(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, reader = deviating(tmp_path, itertools.repeat(at(SENSOR_NM + 4.0)))
    clock.turn(cycle, LONG + 1)
    shown = [pdo.status[0] for pdo in pdos(socket)]
    assert shown.index(INVALID) == LONG - 1
    flags = cr.joint_of(reader.read(limit=256).records[-1], 1).input_flags
    assert faults.names_of(flags >> 8) == ("deviation",)
    assert flags & cr.FLAG_LATCHED


def test_one_cycle_near_the_sensor_begins_the_count_again(tmp_path: Path, clock: ExactTime) -> None:
    far, near = at(SENSOR_NM + 4.0), at(SENSOR_NM)
    reported = itertools.chain(*[[*[far] * (LONG - 1), near]] * 3, itertools.repeat(far))
    cycle, socket, _ = deviating(tmp_path, reported)
    clock.turn(cycle, 4 * LONG)
    assert [pdo.status[0] for pdo in pdos(socket)].index(INVALID) == 4 * LONG - 1


def test_a_restart_of_the_drive_begins_the_count_again(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, _ = deviating(tmp_path, itertools.repeat(at(SENSOR_NM + 4.0)))
    clock.turn(cycle, LONG - 1)
    cycle.joints[0].begin_again()
    clock.turn(cycle, LONG)
    assert [pdo.status[0] for pdo in pdos(socket)].index(INVALID) == 2 * LONG - 2


def test_limits_belong_to_what_is_published(tmp_path: Path, clock: ExactTime) -> None:
    published = [at(-LIMIT_NM[0], 0.5), at(LIMIT_NM[0], 0.5), at(1.0, 0.0)]
    cycle, socket, _ = checked(tmp_path, itertools.chain(*([each] * 30 for each in published)))
    clock.turn(cycle, 90)
    shown = pdos(socket)
    for n, each in enumerate(published):
        assert shown[30 * n + 29].torque_nm[0] == pytest.approx(each.torque_nm, abs=0.00501)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 1e300])
def test_a_finite_torque_with_a_finite_sigma_is_out_of_range(
    tmp_path: Path, clock: ExactTime, sigma: float
) -> None:
    cycle, _, reader = checked(tmp_path, itertools.chain([GOOD] * 30, itertools.repeat(at(1e300, sigma))))
    clock.turn(cycle, 31)
    flags = cr.joint_of(reader.read(limit=64).records[-1], 1).input_flags
    assert faults.names_of(flags >> 8) == ("out_of_range",)


def test_an_estimator_that_finds_its_torque_out_of_range_is_reported(
    tmp_path: Path, clock: ExactTime
) -> None:
    invalid = Estimate(math.nan, math.nan, INVALID, math.nan, math.nan, math.nan)
    cycle, _, reader = checked(tmp_path, itertools.chain([GOOD] * 30, [invalid] * 3, itertools.repeat(GOOD)))
    clock.turn(cycle, 31)
    flags = cr.joint_of(reader.read(limit=64).records[-1], 1).input_flags
    assert faults.names_of(flags >> 8) == ("out_of_range",)
    clock.turn(cycle, 20)
    assert SnapshotReader(tmp_path / "snapshot").read().counters["fault_out_of_range"] == 1


@pytest.mark.parametrize("good", [VALID, STANDSTILL, DEGRADED])
def test_a_published_torque_has_no_fault_in_its_record(tmp_path: Path, clock: ExactTime, good: int) -> None:
    again = itertools.repeat(GOOD._replace(status=good))
    cycle, _, reader = checked(tmp_path, itertools.chain([GOOD] * 30, [at(1e300)], again))
    records = []
    for _ in range(2):
        clock.turn(cycle, 50)
        records += [cr.joint_of(each, 1) for each in reader.read(limit=64).records]
    assert [each.status for each in records[30:]] == [INVALID] * 50 + [good] * 20
    assert [each.input_flags >> 8 for each in records[30:]] == [faults.OUT_OF_RANGE] * 50 + [0] * 20


@pytest.mark.parametrize("latch", [faults.OUT_OF_RANGE, faults.OUT_OF_RANGE | faults.DRIVE_FAULT])
def test_the_record_of_a_cycle_without_inputs_shows_what_is_latched(
    tmp_path: Path, clock: ExactTime, latch: int
) -> None:
    reported = itertools.chain([GOOD] * 30, [at(1e300)], itertools.repeat(GOOD))

    def script(n: int) -> list[bytes]:
        return inputs(status=0x08 if n == 40 else 0x27)[1 if n == 45 else 0 :]

    cycle, _, reader = checked(tmp_path, reported, latch, script)
    clock.turn(cycle, 45)
    records = [cr.joint_of(each, 1) for each in reader.read(limit=64).records]
    there = cr.FLAG_POSITION | cr.FLAG_MOTION | cr.FLAG_SENSOR
    expected = cr.FLAG_LATCHED | faults.OUT_OF_RANGE << 8
    assert [each.input_flags & ~there for each in records[29:45]] == [0] + [expected] * 15
    assert [each.input_flags & there for each in records[29:45]] == [there] * 15 + [there & ~cr.FLAG_POSITION]


def test_the_network_that_is_far_is_not_counted_as_one_outside_of_its_range(
    tmp_path: Path, clock: ExactTime
) -> None:
    limit = SETTINGS.network_limit * JOINTS[0].rated_torque_nm
    networks = {
        limit: "outside",
        -limit: "outside",
        1.01 * limit: "far",
        -1.01 * limit: "far",
        2.0 * limit: "far",
    }
    dropped = [GOOD._replace(status=DEGRADED, physics_nm=0.0, network_nm=each) for each in networks]
    cycle, _, _ = checked(tmp_path, itertools.chain([GOOD] * 30, dropped, itertools.repeat(GOOD)))
    clock.turn(cycle, 45)
    counters = SnapshotReader(tmp_path / "snapshot").read().counters
    assert (counters["network_far"], counters["network_outside"]) == (3, 2)


def tally(errors: int) -> Any:
    return SimpleNamespace(
        counters=array("Q", bytes(8 * len(COUNTERS))), errors=array("d", bytes(8 * errors))
    )


def test_rules_need_room_for_the_errors_of_their_joint() -> None:
    JointRules(1, tally(6), JointSafety(), False)
    for joint, errors in ((0, 2), (1, 5), (1, 3)):
        with pytest.raises(ValueError, match="counters and errors"):
            JointRules(joint, tally(errors), JointSafety(), False)


def test_errors_against_the_sensor_are_summed_per_joint(tmp_path: Path, clock: ExactTime) -> None:
    """The sensor has stood at 9 Nm for long, so that the reference of the estimate's age is 9 Nm as well."""
    settings = SafetySettings(plausibility=None)
    safety = [JointSafety(settings, SETTINGS, joint, 10_000_000) for joint in JOINTS]
    estimators = [
        Scripted(itertools.repeat(at(SENSOR_NM + 2.0))),
        Scripted(itertools.repeat(at(SENSOR_NM - 0.5))),
    ]
    cycle, _, _ = make(tmp_path, lambda n: inputs(), estimators=estimators, safety=safety)
    clock.turn(cycle, 201)
    view = SnapshotReader(tmp_path / "snapshot").read()
    assert [joint.age_ms for joint in view.joints] == [
        pytest.approx(1e3 / bandwidth_of(joint, SETTINGS, network=False)) for joint in JOINTS
    ]
    assert view.rmse_nm == pytest.approx((2.0, 0.5))
    assert view.rmse_now_nm == pytest.approx((2.0, 0.5))


def test_the_reference_is_the_sensor_as_old_as_the_estimate(tmp_path: Path, clock: ExactTime) -> None:
    torques = [9000] * 30 + [-3000] * 30
    safety = [JointSafety(SafetySettings(plausibility=None), SETTINGS, joint, 10_000_000) for joint in JOINTS]
    estimators = [Scripted(itertools.repeat(GOOD)) for _ in JOINTS]
    cycle, _, reader = make(
        tmp_path, lambda n: inputs(torque=torques[n - 1]), estimators=estimators, safety=safety
    )
    clock.turn(cycle, 60)
    bandwidth = bandwidth_of(JOINTS[0], SETTINGS, network=False)
    sensor = [torque / 1000 for torque in torques]
    expected = reference_of(sensor, [0.0] + [0.01] * 59, bandwidth, SETTINGS.max_gap_s)
    shown = [cr.joint_of(each, 1).reference_nm for each in reader.read(limit=64).records]
    assert shown[10:] == pytest.approx(list(expected[10:]))
    assert abs(shown[30] - sensor[30]) > 0.1


def limits_of(safety: JointSafety) -> tuple[float, ...]:
    numbers = (safety.torque_limit_nm, safety.sigma_limit_nm, safety.network_limit_nm, safety.sensor_zero_nm)
    return (*numbers, safety.bandwidth_rad_s, safety.max_gap_s, safety.deviation_cycles)


@pytest.mark.parametrize("method", ["efficiency", "network", "fused"])
def test_limits_are_those_of_the_joint_and_the_settings(method: str) -> None:
    joint, estimator, network = JOINTS[0], recommended(method), method == "network"
    settings = SafetySettings(latch=faults.DEVIATION, deviation_s=0.5)
    safety = JointSafety(settings, estimator, joint, 2_000_000, network)
    rated = joint.rated_torque_nm
    expected = (estimator.torque_limit * rated, 0.5 * rated, largest_difference_nm(joint, estimator))
    times = (bandwidth_of(joint, estimator, network=network), estimator.max_gap_s, 250)
    assert limits_of(safety) == pytest.approx((*expected, estimator.sensor_zero_nm(rated), *times))
    assert safety.plausibility is not None
    assert JointSafety(SafetySettings(plausibility=None), estimator, joint).plausibility is None
    assert JointSafety(SafetySettings(), estimator, joint).deviation_cycles == 0


@pytest.mark.parametrize(("dt_s", "mismatch_rad"), [(0.04, 0.5), (0.06, 0.0)])
def test_a_step_of_more_than_five_periods_is_a_gap(dt_s: float, mismatch_rad: float) -> None:
    checks = JointSafety(SafetySettings(), SETTINGS, JOINTS[0], 10_000_000).plausibility
    assert checks.step(0.0, 0.0, 0.0, 0.0, 0.1) == 0
    assert checks.step(dt_s, 0.5, 0.0, 0.5 / JOINTS[0].gear_ratio, 0.2) == 0
    assert checks.mismatch_rad == mismatch_rad


def test_without_a_joint_file_only_the_range_of_the_fields_is_left() -> None:
    settings = SafetySettings(latch=faults.DEVIATION, deviation_s=0.01)
    none = (327.67, sys.float_info.max, math.inf, 0.0, 0.0, 0.05)
    assert limits_of(JointSafety()) == (*none, 0)
    assert limits_of(JointSafety(settings)) == (*none, 10)
    assert limits_of(JointSafety(settings, period_ns=4_000_000)) == (*none, 2)
    assert limits_of(JointSafety(settings, period_ns=30_000_000)) == (*none, 1), "one cycle at least"
    for joint, estimator in ((None, SETTINGS), (JOINTS[0], None)):
        assert limits_of(JointSafety(settings, estimator, joint)) == (*none, 10)
        assert JointSafety(settings, estimator, joint).plausibility is None


def test_a_configuration_has_limits_for_each_joint() -> None:
    config = load_config(None)
    assert [limits_of(each) for each in safety_of(config)] == [
        limits_of(
            JointSafety(
                config.safety, config.estimator, each.joint, config.period_ns, each.network is not None
            )
        )
        for each in config.joints
    ]
