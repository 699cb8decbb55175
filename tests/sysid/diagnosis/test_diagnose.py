"""The order of the steps of a diagnosis: which runs and joints it takes, how findings of several joints become one."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis import dataset
from jtqd.sysid.diagnosis import diagnose as module
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.diagnose import combined, diagnose, one_sensor
from jtqd.sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Findings,
    Gap,
)
from jtqd.sysid.diagnosis.regressors import contribution
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals
from jtqd.sysid.diagnosis.smoothing import Smoother
from tests.estimator.effects.effect_signals import PLAIN, extended
from tests.sysid.diagnosis.diagnose_core_helpers import rigid_run
from tests.sysid.diagnosis.diagnose_helpers import JOINT, RIPPLE, bench_run, cause, findings, value
from validation.diagnosis.trials import joint_files, tables
from validation.generator.draw import Case, draw


def signals(table: RunTable, joint: Joint = PLAIN, name: str = "run") -> JointSignals:
    return joint_signals(name, table, 1, joint, BaseLoss(joint))


FOLDED = (
    ("viscous_friction", {"viscous_nms_per_rad": 4.5}),
    ("coulomb_friction", {"coulomb_nm": 3.1}),
    ("rotor_inertia", {"rotor_inertia_kgm2": 8e-5}),
)


def test_an_effect_for_a_value_of_the_file_is_that_value() -> None:
    """Residuals of the joint with the value are those of the file less what the effect leaves."""
    table = rigid_run(PLAIN, noise=0.1)
    bare = replace(signals(table), visible=Smoother(1e-3))  # no filter
    s = joint_signals("run", table, 1, PLAIN, BaseLoss(PLAIN), bare)
    joint = extended(PLAIN, *FOLDED)
    other = with_effects_applied(joint)
    assert other.effects == ()
    assert (other.friction.viscous_nms_per_rad, other.friction.coulomb_nm) == (4.5, 3.1)
    assert other.rotor_inertia_kgm2 == 8e-5
    left = s.motor_nm - sum(contribution(EFFECTS[n], p, s)["motor"] for n, p in FOLDED)
    found = joint_signals("run", table, 1, other, BaseLoss(other), s)
    assert found.motor_nm == pytest.approx(left, abs=1e-9)


def test_effects_that_are_more_than_a_value_stay() -> None:
    ripple = ("torque_ripple", {"amplitude_nm": 0.3})
    cubic = ("nonlinear_stiffness", {"cubic_nm_per_rad3": 1e9, "stiffness_nm_per_rad": 11000.0})
    found = with_effects_applied(extended(PLAIN, ripple, FOLDED[0], cubic))
    assert [e.name for e in found.effects] == ["torque_ripple", "nonlinear_stiffness"]
    assert found.friction.viscous_nms_per_rad == 4.5
    assert with_effects_applied(found) == found
    assert with_effects_applied(PLAIN) == PLAIN


def test_one_sensor_is_the_same_column() -> None:
    one = rigid_run(PLAIN)
    both = RunTable(one.time_s, {1: one.joints[1], 2: one.joints[1]})
    torque = one.joints[1].torque_nm
    assert torque is not None
    own = RunTable(one.time_s, {1: one.joints[1], 2: replace(one.joints[1], torque_nm=torque + 0.1)})
    assert one_sensor([("a", both), ("b", one)], (1, 2))
    assert not one_sensor([("a", both), ("b", own)], (1, 2))


@pytest.mark.parametrize(
    ("verdicts", "whole"),
    [
        ((NO_GAP, NO_GAP), NO_GAP),
        ((CAUSE, NO_GAP), CAUSE),
        ((CAUSE, AMBIGUOUS), AMBIGUOUS),
        ((UNEXPLAINED, AMBIGUOUS), UNEXPLAINED),
        ((NO_GAP, INSUFFICIENT), INSUFFICIENT),
    ],
)
def test_joints_together_have_the_verdict_that_asks_for_most(verdicts: tuple[str, str], whole: str) -> None:
    parts = [
        replace(findings(v, (), gain=None), joints=(n,), reasons=("why",), gaps=())
        for n, v in enumerate(verdicts, 1)
    ]
    found = combined(parts)
    assert found.verdict == whole
    assert found.joints == (1, 2)
    assert found.reasons == ("joint 1: why", "joint 2: why")


def test_joints_together_put_the_largest_first() -> None:
    small, large = (
        replace(cause("coulomb_friction", n, {"coulomb_nm": value(4.4)}), rms_nm=rms)
        for n, rms in ((1, 0.2), (2, 0.9))
    )

    def part(n: int, one: object, gap: float, plan: str) -> Findings:
        base = findings(CAUSE, (one,), joints=(n,), gaps=(Gap(n, "motor", gap, 0.1, ()),))  # type: ignore[arg-type]
        assert base.gain is not None
        gain = replace(base.gain, split=f"joint {n}", rmse_before_nm=gap, rmse_after_nm=0.1)
        return replace(base, gain=gain, next_experiment={"why": plan})

    found = combined([part(1, small, 0.3, "first"), part(2, large, 0.8, "second")])
    assert [c.joint for c in found.causes] == [2, 1]
    assert [g.joint for g in found.gaps] == [2, 1]
    assert found.gain is not None
    assert found.gain.split == "joint 2", "of the joint that gains most"
    assert found.next_experiment is not None
    assert found.next_experiment["why"] == "Joint 1: first Joint 2: second"


def test_what_a_file_has_too_little_of_is_reported_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cause that the file has already: once more without it, so that the cause is the whole and not what is missing."""
    known = (Effect("torque_ripple", {"amplitude_nm": 0.2}), Effect("sensor_gain", {"gain": 1.01}))
    asked: list[list[str]] = []

    def stand_in(runs: object, joints: dict[int, Joint], numbers: tuple[int, ...], *_: object) -> Findings:
        asked.append([e.name for e in joints[1].effects])
        return findings(CAUSE, (RIPPLE,), reasons=(f"diagnosis {len(asked)}",))

    monkeypatch.setattr(module, "_diagnosed", stand_in)
    runs = [("run", bench_run(numbers=(1,)))]
    found = diagnose(runs, {1: replace(JOINT, effects=known)})
    assert asked == [["torque_ripple", "sensor_gain"], ["sensor_gain"]]
    assert found.reasons == ("diagnosis 2",)
    asked.clear()
    diagnose(runs, {1: replace(JOINT, effects=known[1:])})
    assert asked == [["sensor_gain"]], "another effect of the file stays, and once is enough"


def reason_of(runs: list[tuple[str, RunTable]], joints: dict[int, Joint]) -> str:
    found = diagnose(runs, joints)
    assert found.verdict == INSUFFICIENT
    assert (found.causes, found.gaps, found.gain) == ((), (), None)
    return found.reasons[0]


def test_data_that_cannot_serve_are_said_to_be_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "next_experiment", lambda *_, **__: None)
    joints = {1: JOINT}
    runs = [(f"run{k}", bench_run(phase=0.7 * k, numbers=(1,))) for k in range(2)]
    assert "found 1 usable run, expected" in reason_of(runs[:1], joints)
    assert "found no joint" in reason_of(runs, {3: JOINT})
    slow = [(name, every(table, 25)) for name, table in runs]
    assert "found 20 samples per second" in reason_of(slow, joints)
    deaf = [(name, RunTable(t.time_s, {1: replace(t.joints[1], torque_nm=None)})) for name, t in runs]
    assert reason_of(deaf, joints).startswith("run0: j1.torque_nm: missing")
    still = [(name, slice_of(table, 0.5)) for name, table in runs]
    assert "s in motion in all runs, expected at least 5 s" in reason_of(still, joints)
    monkeypatch.setattr(dataset, "moving_s", lambda _: 4.97)
    assert reason_of(runs, joints) == "found 4.9 s in motion in all runs, expected at least 5 s"


def every(table: RunTable, k: int) -> RunTable:
    columns = table.joints[1]
    names = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
    return RunTable(table.time_s[::k], {1: replace(columns, **{n: getattr(columns, n)[::k] for n in names})})


def slice_of(table: RunTable, seconds: float) -> RunTable:
    columns, n = table.joints[1], int(np.sum(table.time_s < seconds))
    names = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
    return RunTable(table.time_s[:n], {1: replace(columns, **{k: getattr(columns, k)[:n] for k in names})})


def test_a_run_without_a_link_encoder_takes_the_torsion_balance_from_all() -> None:
    """Whether it comes first or not."""
    findings = _found(_without("link_position_rad", 1))
    assert {g.balance for g in findings.gaps} == {"motor"}
    assert findings.verdict == NO_GAP
    first, _ = usable_signals(_without("link_position_rad", 0), joint_files(_case()), (1,))
    assert {c.balance for run in build_dataset(first, joint_files(_case())).runs for c in run.channels} == {
        "motor"
    }


def test_a_run_without_the_sensor_is_left_out_and_named() -> None:
    findings = _found(_without("torque_nm", 1))
    assert any("run2" in note and "torque_nm" in note for note in findings.channel_notes)
    assert findings.verdict == NO_GAP


def test_a_run_of_another_rate_is_used_with_the_others() -> None:
    runs = tables(_case().runs)
    name, table = runs[3]
    joints = {
        n: JointColumns(**{f.name: None if (x := getattr(c, f.name)) is None else x[::2] for f in fields(c)})
        for n, c in table.joints.items()
    }
    runs[3] = name, RunTable(table.time_s[::2], joints)
    findings = _found(runs)
    assert findings.used_runs == tuple(name for name, _ in runs)
    assert findings.verdict == NO_GAP


@cache
def _case() -> Case:
    return draw(12, runs=5, duration_s=8.0)


def _found(runs: list[tuple[str, RunTable]]) -> Findings:
    """Of one joint of two; those of both are diagnosed in test_verdict."""
    return diagnose(runs, {1: joint_files(_case())[1]})


def _without(name: str, which: int) -> list[tuple[str, RunTable]]:
    runs = tables(_case().runs)
    run, table = runs[which]
    velocity = {"link_velocity_rad_s": None} if name == "link_position_rad" else {}
    joints = {n: replace(c, **{name: None}, **velocity) for n, c in table.joints.items()}
    runs[which] = run, RunTable(table.time_s, joints)
    return runs
