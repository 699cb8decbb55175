"""A gear that is damped otherwise than the joint file says, from runs to its name."""

from __future__ import annotations

from dataclasses import replace

import pytest

from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Findings
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run

NOISE = 0.002


def diagnosed(truth: Joint, file: Joint = PLAIN, relevance: float = 1e-3) -> Findings:
    """A damper of a gear makes a tenth of a newton metre: it matters to whom a thousandth of the rated torque does."""
    runs = [(f"run{k}", rich_run(truth, k, seconds=10.0, noise=NOISE)) for k in range(5)]
    return diagnose(runs, {1: file}, relevance=relevance)


@pytest.mark.parametrize(
    ("true", "in_file"), [pytest.param(30.0, 8.0, marks=pytest.mark.campaign), (8.0, 30.0)]
)
def test_a_wrong_damping_is_found_alone_and_is_no_delay(true: float, in_file: float) -> None:
    found = diagnosed(replace(PLAIN, damping_nms_per_rad=true), replace(PLAIN, damping_nms_per_rad=in_file))
    assert found.verdict == "cause", found.reasons
    (cause,) = (c for c in found.causes if c.matters)
    assert cause.names == ("gear_damping",)
    # the runs are to first order in the damper's time constant
    assert cause.parameters["damping_nms_per_rad"].value == pytest.approx(true, rel=0.06)


def test_nothing_is_found_where_the_file_is_right() -> None:
    found = diagnosed(PLAIN)
    assert found.verdict == "no_gap"
    assert not found.causes
