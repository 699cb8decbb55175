"""More data never makes a diagnosis worse: the rule, and the rule over the benches."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.sysid.diagnosis.findings import Cause, Findings, Value
from tests.worlds.campaign import Counts, jobs
from tests.worlds.measured_bench import MeasuredBench
from tests.worlds.more_data import held_out_rms, step, steps
from tests.worlds.mujoco_bench import MujocoBench
from tests.worlds.recorder import PRESETS
from tests.worlds.sets import SENSOR, Bench, Hidden


def found(*causes: Cause, reasons: tuple[str, ...] = ()) -> Findings:
    return Findings("cause", reasons, (), (1,), causes=causes)


def gain(value: float, *others: str) -> Cause:
    given = {"gain": Value(value, (value - 0.01, value + 0.01), "")}
    return Cause("sensor_gain", SENSOR, ("sensor_gain", *others), given, 100.0, 0.5, 1.0, "motor")


def test_the_error_on_a_held_out_run_is_least_with_the_truth() -> None:
    drawn = MeasuredBench().draw(3, [Hidden("sensor_gain", SENSOR, 0.2)])
    true = drawn.truth[0]["parameters"]["gain"]
    errors = [
        held_out_rms(found(*c), drawn.runs[-1], drawn.joints)
        for c in ((), (gain(true),), (gain(2.0 - true),))
    ]
    assert errors[1] < errors[0] < errors[2]


def test_a_cause_may_go_only_for_a_better_prediction_and_with_a_word() -> None:
    drawn = MeasuredBench().draw(3, [Hidden("sensor_gain", SENSOR, 0.2)])
    true = drawn.truth[0]["parameters"]["gain"]

    def judge(fewer: Findings, more: Findings) -> tuple[tuple[str, ...], bool]:
        each = step(4, fewer, more, drawn.runs[-1], drawn.joints)
        return each.lost, each.worse

    right, wrong = gain(true), gain(2.0 - true)
    assert judge(found(right), found(right)) == ((), False)
    assert judge(found(right), found(gain(true, "torque_constant"))) == ((), False)
    assert judge(found(right), found()) == (("sensor_gain",), True)
    assert judge(found(wrong), found()) == (("sensor_gain",), True)  # better, but not a word
    assert judge(found(wrong), found(reasons=("sensor gain of 4 runs is not confirmed",))) == (
        ("sensor_gain",),
        False,
    )


@pytest.mark.campaign
@pytest.mark.parametrize("bench", [MujocoBench, MeasuredBench])
def test_more_runs_never_make_a_diagnosis_worse(bench: type[Bench]) -> None:
    pytest.importorskip(
        "mujoco", reason="mujoco is not installed: pip install -e '.[dev]'; more data was NOT tested"
    )
    seed = int(np.random.default_rng().integers(10**6))
    chosen = [job for job in jobs(bench(), seed, Counts()) if job.kind in ("single", "pair")][:6]
    worse = [
        (job.key, each)
        for job in chosen
        for each in steps(bench().draw(job.seed, job.hidden), PRESETS["full"], job.seed)
        if each.worse
    ]
    assert not worse, f"seed {seed}: {worse}"
