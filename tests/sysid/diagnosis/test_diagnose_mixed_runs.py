"""Runs that do not all have the same channels: stacked as far as they go, and said."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import NO_GAP, Findings
from tests.hidden.case import draw
from tests.hidden.trials import joint_files, tables


@pytest.mark.parametrize("lacking", [0, 1])
def test_a_run_without_a_link_encoder_takes_the_torsion_balance_from_all(lacking: int) -> None:
    findings = _without("link_position_rad", lacking)
    assert {g.balance for g in findings.gaps} == {"motor"}
    assert findings.verdict == NO_GAP


def test_a_run_without_the_sensor_is_left_out_and_named() -> None:
    findings = _without("torque_nm", 1)
    assert any("run2" in note and "torque_nm" in note for note in findings.channel_notes)
    assert findings.verdict == NO_GAP


def test_a_run_of_another_rate_is_left_out_and_named() -> None:
    case = draw(12, runs=5, duration_s=8.0)
    runs = tables(case.runs)
    name, table = runs[3]
    joints = {
        n: JointColumns(**{f.name: None if (x := getattr(c, f.name)) is None else x[::2] for f in fields(c)})
        for n, c in table.joints.items()
    }
    runs[3] = name, RunTable(table.time_s[::2], joints)
    findings = diagnose(runs, joint_files(case))
    assert findings.channel_notes == ("run4: found 500 samples per second, expected 1000 as in the others",)
    assert findings.verdict == NO_GAP


def _without(name: str, which: int) -> Findings:
    case = draw(12, runs=5, duration_s=8.0)
    runs = tables(case.runs)
    run, table = runs[which]
    velocity = {"link_velocity_rad_s": None} if name == "link_position_rad" else {}
    joints = {n: replace(c, **{name: None}, **velocity) for n, c in table.joints.items()}
    runs[which] = run, RunTable(table.time_s, joints)
    return diagnose(runs, joint_files(case))
