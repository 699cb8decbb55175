"""Runs in which not every joint can be used: what is stacked, and that what is left out is said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import with_the_same_joints
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Findings
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run


def runs_of(*joints: Sequence[int]) -> list[list[Any]]:
    return [[SimpleNamespace(run=f"run{k}", number=n) for n in each] for k, each in enumerate(joints)]


def left(*joints: Sequence[int]) -> tuple[list[tuple[str, int]], list[str]]:
    stacked, reasons = with_the_same_joints(runs_of(*joints))
    return [(s.run, s.number) for run in stacked for s in run], reasons


def test_a_run_without_a_joint_that_the_others_have_is_left_out_and_not_the_joint() -> None:
    stacked, (reason,) = left((1, 2), (1, 2), (2,), (1, 2))
    assert stacked == [(f"run{k}", n) for k in (0, 1, 3) for n in (1, 2)]
    assert reason == "run2: left out, because joint 1 of it cannot be used as in the others"


def test_a_joint_that_few_runs_have_is_left_out_and_not_the_runs() -> None:
    stacked, (reason,) = left((2,), (1, 2), (2,), (2,))
    assert stacked == [(f"run{k}", 2) for k in range(4)]
    assert reason == "joint 1: left out, because only 1 of 4 runs of it can be used"


def test_runs_of_different_joints_are_those_of_one() -> None:
    stacked, reasons = left((1,), (2,), (2,))
    assert stacked == [("run1", 2), ("run2", 2)]
    assert reasons == [
        "run0: left out, because joint 2 of it cannot be used as in the others",
        "joint 1: left out, because only 1 of 3 runs of it can be used",
    ]


@pytest.mark.parametrize("joints", [(1,), (1, 2)])
def test_runs_with_the_same_joints_are_as_they_were(joints: tuple[int, ...]) -> None:
    stacked, reasons = left(joints, joints)
    assert stacked == [(f"run{k}", n) for k in range(2) for n in joints]
    assert not reasons


def two_joints(seed: int, *, first: bool) -> RunTable:
    """Both joints at one sensor; first: whether joint 1 can be used."""
    run = rich_run(PLAIN, seed, seconds=10.0, step_s=4e-3, noise=0.002)
    one = run.joints[1]
    assert one.current_a is not None
    noise = np.random.default_rng(seed + 100).normal(0.0, 0.01, len(run.time_s))
    two = replace(one, current_a=one.current_a + noise)
    return RunTable(run.time_s, {1: one, 2: two} if first else {2: two})


def found(*usable: bool) -> Findings:
    runs = [(f"run{k}", two_joints(k, first=first)) for k, first in enumerate(usable)]
    return diagnose(runs, {1: PLAIN, 2: PLAIN})


def test_no_gap_is_not_said_of_a_joint_that_was_not_judged() -> None:
    findings = found(True, False, False, False)
    assert findings.verdict == "insufficient_data"
    assert findings.joints == (2,)
    assert findings.reasons[0] == "joint 1: left out, because only 1 of 4 runs of it can be used"


def test_a_run_that_is_left_out_is_said_and_both_joints_are_judged() -> None:
    findings = found(True, True, False, True, True)
    assert findings.verdict == "no_gap"
    assert findings.joints == (1, 2)
    assert findings.used == ("run0", "run1", "run3", "run4")
    assert "run2: left out, because joint 1 of it cannot be used as in the others" in findings.channel_notes
