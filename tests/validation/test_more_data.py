"""More data never makes a diagnosis worse: the rule, and the rule over the benches."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from jtqd.sysid.diagnosis.findings import Cause, Findings, Value
from validation.worlds.measured_bench import MeasuredBench
from validation.worlds.more_data import OWN, held_out_rms, sets_of, step, steps
from validation.worlds.recorder import PRESETS
from validation.worlds.sets import SENSOR, Hidden


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


def test_a_cause_may_go_only_with_a_word() -> None:
    drawn = MeasuredBench().draw(3, [Hidden("sensor_gain", SENSOR, 0.2)])
    true = drawn.truth[0]["parameters"]["gain"]

    def judge(fewer: Findings, more: Findings) -> tuple[tuple[str, ...], bool]:
        each = step(4, fewer, more, drawn.runs[-1], drawn.joints)
        return each.lost, each.worse

    said = "sensor_gain of the sensor would be named without run3.csv"
    right = gain(true)
    assert judge(found(right), found(right)) == ((), False)
    assert judge(found(right), found(gain(true, "torque_constant"))) == ((), False)
    assert judge(found(right), found()) == (("sensor_gain",), True)
    assert judge(found(right), found(reasons=("sensor_gain of joint 2 fits",))) == (("sensor_gain",), True)
    assert judge(found(right), found(reasons=(said,))) == (("sensor_gain",), False)
    lost = step(4, found(right), found(reasons=(said,)), drawn.runs[-1], drawn.joints)
    assert lost.missed
    wrong = step(4, found(gain(2.0 - true)), found(reasons=(said,)), drawn.runs[-1], drawn.joints)
    assert not wrong.missed


@pytest.mark.campaign
@pytest.mark.parametrize("bench", ["mujoco", "measured", OWN])
def test_more_runs_never_make_a_diagnosis_worse(bench: str) -> None:
    pytest.importorskip(
        "mujoco", reason="mujoco is not installed: pip install -e '.[dev]'; more data was NOT tested"
    )
    seed = int(np.random.default_rng().integers(10**6))
    worse = [
        (key, each)
        for key, own, drawn in islice(sets_of(bench, seed), 6)
        for each in steps(drawn, PRESETS["full"], own)
        if each.worse
    ]
    assert not worse, f"seed {seed}: {worse}"
