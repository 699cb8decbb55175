"""Runs in which not every joint can be used: what is stacked, and that what is left out is said."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from jtqd.sysid.diagnosis.dataset import with_the_same_joints


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
