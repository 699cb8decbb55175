"""One run with another gain, zero or delay than the others is named as a run; what all runs share is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis import outlier_runs
from jtqd.sysid.diagnosis.dataset import usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose, without_outlier_runs
from jtqd.sysid.diagnosis.findings import Findings, OutlierRun, to_mapping
from jtqd.sysid.diagnosis.outlier_runs import FAR, Comparison, Deviation, comparison, echo
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run

NOMINAL = load_joint(shipped("joint1.yaml"))
PLAIN = replace(NOMINAL, efficiency=None, friction=replace(NOMINAL.friction, stribeck_nm=0.0))
COUNT = 5


def runs(joint: Joint = PLAIN, count: int = COUNT) -> list[tuple[str, RunTable]]:
    """Runs of 6 s by the equations, each with a zero of its own, as days have."""
    zeros = np.linspace(-2e-3, 2e-3, count)
    return [(f"run{k}", rich_run(joint, 20 + k, noise=2e-3, zero=float(zeros[k]))) for k in range(count)]


def changed(
    all_runs: list[tuple[str, RunTable]],
    where: list[int],
    change: Callable[[RunTable, JointColumns], JointColumns],
) -> list[tuple[str, RunTable]]:
    return [
        (name, RunTable(t.time_s, {1: change(t, t.joints[1])}) if k in where else t)
        for k, (name, t) in enumerate(all_runs)
    ]


def odd_runs(all_runs: list[tuple[str, RunTable]]) -> list[OutlierRun]:
    """What a diagnosis does first with these runs."""
    signals, _ = usable_signals(all_runs, {1: PLAIN}, (1,), as_recorded=True)
    return without_outlier_runs(signals, {1: PLAIN})[2]


def current_gain(table: RunTable, c: JointColumns) -> JointColumns:
    assert c.current_a is not None
    return replace(c, current_a=1.08 * c.current_a)


def sensor_gain(table: RunTable, c: JointColumns) -> JointColumns:
    assert c.torque_nm is not None
    return replace(c, torque_nm=1.2 * c.torque_nm)


def sensor_zero(table: RunTable, c: JointColumns) -> JointColumns:
    assert c.torque_nm is not None
    return replace(c, torque_nm=c.torque_nm + 0.05 * PLAIN.rated_torque_nm)


def late_current(table: RunTable, c: JointColumns) -> JointColumns:
    assert c.current_a is not None
    return replace(c, current_a=np.interp(table.time_s - 0.006, table.time_s, c.current_a))


TAMPERED: list[tuple[Callable[[RunTable, JointColumns], JointColumns], str, str, float]] = [
    (current_gain, "gain", "current_a", 0.08),
    (sensor_zero, "zero", "torque_nm", 0.05),
    (late_current, "delay", "current_a", 0.006),
]


@pytest.mark.parametrize(("change", "what", "channel", "size"), TAMPERED[1:], ids=["zero", "delay"])
def test_one_run_is_named(
    change: Callable[[RunTable, JointColumns], JointColumns], what: str, channel: str, size: float
) -> None:
    check_odd(odd_runs(changed(runs(), [2], change)), what, channel, size)


def check_odd(found: Sequence[OutlierRun], what: str, channel: str, size: float) -> OutlierRun:
    (odd,) = found
    of = "joint 1" if channel == "current_a" else "the sensor"
    assert (odd.run, odd.what) == ("run2", what)
    assert odd.channel == channel or f"{what} of {channel} of {of}" in odd.others, (
        "one joint: two zeros are one"
    )
    assert abs(odd.value) == pytest.approx(size, rel=0.15)
    return odd


@pytest.mark.parametrize(
    ("change", "what", "channel", "size"),
    [TAMPERED[0], *(pytest.param(*each, marks=pytest.mark.campaign) for each in TAMPERED[1:])],
    ids=["gain", "zero", "delay"],
)
def test_one_run_is_named_and_the_joint_is_not(
    change: Callable[[RunTable, JointColumns], JointColumns], what: str, channel: str, size: float
) -> None:
    findings = diagnose(changed(runs(), [2], change), {1: PLAIN})
    odd = check_odd(findings.outlier_runs, what, channel, size)
    assert findings.causes == (), "nothing is wrong with the joint"
    assert findings.verdict == "no_gap"
    (found,) = to_mapping(findings)["outlier_runs"]
    assert (found["run"], found["what"], found["joint"]) == ("run2", what, odd.joint)
    assert odd.text in findings.channel_notes
    assert findings.used_runs == tuple(name for name in findings.runs if name != "run2")


def test_a_gain_is_a_part_of_the_true_value() -> None:
    """A torque is regressed on what was read, of which a gain of 1.2 leaves a sixth; a current on what the motion needs."""
    (more,) = odd_runs(changed(runs(), [2], current_gain))
    assert more.value == pytest.approx(0.08, abs=0.003)
    (sensor,) = odd_runs(changed(runs(), [2], sensor_gain))
    assert (sensor.run, sensor.what, sensor.channel) == ("run2", "gain", "torque_nm")
    assert sensor.value == pytest.approx(0.2, abs=0.01)


def test_what_all_runs_share_is_an_effect_and_days_are_none() -> None:
    assert odd_runs(runs()) == []
    shared = diagnose(changed(runs(), list(range(COUNT)), current_gain), {1: PLAIN})
    assert shared.outlier_runs == ()
    assert "torque_constant" in {name for cause in shared.causes for name in cause.names}


def test_two_runs_cannot_tell_which_is_odd() -> None:
    assert odd_runs(changed(runs(count=2), [1], current_gain)) == []


def compared_rows(rows: Sequence[FloatArray], usual: float = 0.02, echo: float = 0.0) -> Comparison:
    """Rows [n, 3] of each run: of what all share, of a deviation, residual in units of noise; echo: of run 2."""
    echoes = np.zeros(len(rows))
    echoes[2] = echo
    count = np.full(len(rows), float(len(rows[0])))
    return comparison(np.array([x.T @ x for x in rows]), count, np.array([usual]), echoes)


def test_size_of_a_deviation_beside_the_others() -> None:
    rng = np.random.default_rng(1)
    rows = [np.column_stack([rng.normal(size=(9000, 2)), np.zeros(9000)]) for _ in range(4)]
    for k, row in enumerate(rows):
        row[:, 2] = 0.7 * row[:, 0] + (0.5 if k == 2 else 0.0) * row[:, 1] + rng.normal(size=9000)
    seen = compared_rows(rows)
    assert seen.apart == pytest.approx([-1.0 / 6.0, -1.0 / 6.0, 0.5, -1.0 / 6.0], abs=0.04)
    error = np.sqrt((1.0 + 1.0 / 3.0) / 9000.0 + 0.02**2 / 3.0)
    assert seen.error == pytest.approx(np.full(4, error), rel=0.1), "and of the mean of the others"
    spread = 0.02 * np.sqrt(4.0 / 7.0)
    assert seen.spread[2] == pytest.approx(spread, rel=0.1), (
        "the others agree; what is usual counts as four runs"
    )
    assert seen.distance[2] == pytest.approx(0.5 / np.hypot(spread, error), rel=0.1)
    assert seen.distance[[0, 1, 3]].max() < 3.0


def test_runs_that_differ_among_themselves_make_none_odd() -> None:
    """A deviation of 0.3 is far where the others agree, and near where they differ by as much."""
    rng = np.random.default_rng(2)
    far = {}
    for spread in (0.0, 0.2):
        rows = [np.column_stack([rng.normal(size=(20000, 2)), np.zeros(20000)]) for _ in range(8)]
        for k, row in enumerate(rows):
            own = 0.3 if k == 2 else spread * (-1.0) ** k
            row[:, 2] = 0.7 * row[:, 0] + own * row[:, 1] + rng.normal(size=20000)
        far[spread] = compared_rows(rows).distance[2]
    assert far[0.2] < 3.0
    assert far[0.0] > 10.0


@pytest.mark.parametrize(("own", "strange", "odd"), [(3.0, 1.0, True), (0.5, 5.0, False)])
def test_a_run_is_odd_by_what_sets_it_apart(own: float, strange: float, odd: bool) -> None:
    """A brake that drags in one run is imitated by a delay that explains a little of it: no outlier run, however certain."""
    rng = np.random.default_rng(4)
    rows = [rng.normal(size=(2000, 3)) for _ in range(5)]  # an effect of all, a deviation, the residual
    for k, row in enumerate(rows):
        row[:, 2] = 0.7 * row[:, 0] + (own * row[:, 1] + strange * row[:, 2] if k == 2 else row[:, 2])
    seen = compared_rows(rows)
    assert seen.distance[2] > 10.0, "certain in both cases"
    assert seen.explains[2] == odd


def test_a_run_that_is_set_apart_by_something_else_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def explains_nothing(*given: Any) -> Comparison:
        seen = comparison(*given)
        return seen._replace(explains=np.zeros_like(seen.explains))

    monkeypatch.setattr(outlier_runs, "comparison", explains_nothing)
    assert odd_runs(changed(runs(), [2], current_gain)) == []


def test_a_channel_that_is_all_noise_makes_no_run_odd() -> None:
    """A drive that is off in one run and shows noise: of that noise its own column says all, a gain of one more."""

    def without_power(table: RunTable, c: JointColumns) -> JointColumns:
        """Keep what the current has of the joint out of the sensor, too: the joint is towed."""
        assert c.current_a is not None
        assert c.torque_nm is not None
        scale = PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a
        noise = 0.004 * PLAIN.rated_torque_nm / scale * np.random.default_rng(9).normal(size=len(c.current_a))
        clean = rich_run(PLAIN, 22).joints[1].current_a
        assert clean is not None
        return replace(c, current_a=noise, torque_nm=c.torque_nm - scale * clean)

    def one_encoder(table: RunTable, c: JointColumns) -> JointColumns:
        return replace(c, link_position_rad=None)

    idle = changed(changed(runs(), [2], without_power), list(range(COUNT)), one_encoder)
    assert odd_runs(idle) == []
    table = dict(idle)["run2"]
    (signals,), _ = usable_signals([("run2", table)], {1: PLAIN}, (1,))
    gain, zero = Deviation("gain", "current_a", 1), Deviation("zero", "current_a", 1)
    assert echo(zero, signals, 5) == 0.0
    (driven,), _ = usable_signals([("run1", dict(runs())["run1"])], {1: PLAIN}, (1,))
    assert echo(gain, driven, 5) < 1e-3 < echo(gain, signals, 5)
    rng = np.random.default_rng(4)
    rows = [rng.normal(size=(2000, 3)) for _ in range(5)]
    rows[2][:, 2] += rows[2][:, 1]
    assert compared_rows(rows).distance[2] > FAR > compared_rows(rows, echo=1.0).distance[2]


def test_text_says_what_run_and_channel() -> None:
    odd = OutlierRun(
        "b.csv", "delay", "current_a", 3, -0.004, 0.0002, "s", ("delay of torque_nm of the sensor",)
    )
    assert odd.text == (
        "b.csv: j3.current_a is 4 ms earlier than in the other runs, which differ by 0.2 ms among themselves, or it differs "
        "in the delay of torque_nm of the sensor: a matter of this run, which is not used"
    )
    assert Findings("no_gap", (), ("b.csv",), (3,)).outlier_runs == ()
