"""What counts as found, wrong, covered and rightly placed: findings made by hand against truths made by hand; the tables."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.sysid.diagnosis.findings import CERTAIN, ONE_OF, Cause, Findings, Gap, Place, Value
from validation.diagnosis.scores import (
    Outcome,
    bench_shares,
    failures,
    generator_shares,
    intervals,
    lost_to_wrong,
    place_is_right,
    score,
)

RIPPLE = {
    "name": "torque_ripple",
    "joint": 1,
    "parameters": {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 3.1},
    "size": 0.4,
}
GAIN = {"name": "sensor_gain", "joint": "sensor", "parameters": {"gain": 1.03}, "size": 0.03}
PLAN = {"why": "", "plan": {}}


def cause(name: str, joint: int | str, *others: str, **values: tuple[float, float, float]) -> Cause:
    parameters = {k: Value(v, (low, high), "") for k, (v, low, high) in values.items()}
    grade = ONE_OF if others else CERTAIN
    return Cause(name, joint, parameters, 50.0, 0.3, "motor", grade=grade, rivals=others)


def findings(verdict: str, *causes: Cause, **more: Any) -> Findings:
    return Findings(verdict, ("",), ("run1",), (1, 2), causes=causes, **more)


def test_name_and_joint_must_both_be_right() -> None:
    right = score("one", 1, [RIPPLE], findings("cause", cause("torque_ripple", 1)))
    assert right.found == (True,)
    assert not right.wrong
    other = score("one", 1, [RIPPLE], findings("cause", cause("torque_ripple", 2)))
    assert other.found == (False,)
    assert other.wrong == ("torque_ripple of 2",)


def test_name_beside_the_right_one_is_wrong() -> None:
    both = score("one", 1, [RIPPLE], findings("cause", cause("torque_ripple", 1), cause("cogging", 1)))
    assert both.found == (True,)
    assert both.wrong == ("cogging of 1",)


@pytest.mark.parametrize(
    ("names", "plan", "found"),
    [
        (("sensor_gain", "torque_constant"), PLAN, True),
        (("sensor_gain", "torque_constant"), None, True),
        (("torque_constant", "sensor_gain"), PLAN, False),  # of joint 1, which has no such effect
        (("torque_constant", "sensor_gain of joint 2"), PLAN, False),
        (("torque_constant", "sensor_gain of the sensor"), PLAN, True),
        (("torque_constant", "sensor_gain of the sensor", "hysteresis"), PLAN, True),
        (("sensor_gain", "a", "b", "c"), PLAN, True),
        (("torque_constant", "sensor_gain of the sensor", "a", "b"), PLAN, False),
        (("torque_constant", "hysteresis"), PLAN, False),
    ],
)
def test_small_class_counts_with_an_experiment(names: tuple[str, ...], plan: Any, found: bool) -> None:
    joint = "sensor" if names[0] == "sensor_gain" else 1
    outcome = score(
        "one", 1, [GAIN], findings("ambiguous", cause(names[0], joint, *names[1:]), next_experiment=plan)
    )
    assert outcome.found == (found,)
    assert not outcome.wrong
    assert replace(outcome, settled=False).found == (names[0] == "sensor_gain",)
    assert replace(outcome, settled=True).found == (found,)


def test_interval_of_a_phase_is_taken_round_the_circle() -> None:
    near = cause(
        "torque_ripple",
        1,
        amplitude_nm=(0.41, 0.39, 0.43),
        phase_rad=(-3.15, -3.25, -3.05),
        order_per_motor_rev=(2.0, 2.0, 2.0),
    )
    assert intervals(RIPPLE, [near]) == [
        ("torque_ripple", "amplitude_nm", True),
        ("torque_ripple", "phase_rad", True),
    ]
    far = cause("torque_ripple", 1, amplitude_nm=(0.45, 0.41, 0.49), phase_rad=(2.9, 2.8, 3.0))
    assert [good for *_, good in intervals(RIPPLE, [far])] == [False, False]
    assert intervals(RIPPLE, [cause("torque_ripple", 2)]) == []


def unknown(axis: str, low: float, high: float, **more: Any) -> dict[str, Any]:
    place = {"axis": axis, "low": low, "high": high, **more}
    return {"name": "odd", "joint": 1, "parameters": {}, "size": 1.0, "places": [place]}


def mapped(  # noqa: PLR0917
    axis: str, text: str, low: float, high: float, unit: str, verdict: str = "unexplained"
) -> Findings:
    gap = Gap(1, "motor", 1.0, 0.1, (Place(axis, text, 0.8, low, high, unit),))
    return findings(verdict, gaps=(gap,))


@pytest.mark.parametrize(
    ("truth", "found", "right"),
    [
        (unknown("velocity", 0.5, 0.7), mapped("velocity", "", 0.6, 0.9, "rad/s"), True),
        (unknown("velocity", 0.5, 0.7), mapped("velocity", "", 0.8, 0.9, "rad/s"), False),
        (unknown("velocity", 0.5, 0.7), mapped("load", "", 0.5, 0.7, "Nm"), False),
        (unknown("velocity", 0.5, 0.7), mapped("velocity", "", 0.6, 0.9, "rad/s", "cause"), False),
        (unknown("link_angle", 6.0, 6.5), mapped("link_angle", "", -0.1, 0.1, "rad"), True),
        (unknown("link_angle", 6.0, 6.5), mapped("link_angle", "", -0.9, -0.5, "rad"), False),
        (unknown("link_angle", -0.2, 0.2), mapped("link_angle", "", -0.9, -0.1, "rad"), True),
        (
            unknown("frequency", 3.4, 3.7, unit="per motor rev"),
            mapped("motor_angle", "order 3.57 per motor revolution", 3.57, 3.57, "1/rev"),
            True,
        ),
        (
            unknown("frequency", 3.4, 3.7, unit="per motor rev"),
            mapped("frequency", "", 3.5, 3.6, "Hz"),
            False,
        ),
        (unknown("frequency", 3.4, 3.7, unit="Hz"), mapped("frequency", "", 3.5, 3.6, "Hz"), True),
        (unknown("time", 5.0, 5.2, run="run2"), mapped("time", "bursts: run2 5.1 s", 0, 0, "s"), True),
        (unknown("time", 5.0, 5.2, run="run2"), mapped("time", "bursts: run3 5.1 s", 0, 0, "s"), False),
        (unknown("time", 5.0, 5.2, run="run2"), mapped("time", "4 to 6 s", 4, 6, "s"), False),
        (
            unknown("time", 5.0, 5.2, run="run2"),
            mapped("time", "run2 5.1 s, run2 9.0 s, run1 1.0 s", 0, 0, "s"),
            False,
        ),
    ],
)
def test_place_in_the_map(truth: dict[str, Any], found: Findings, right: bool) -> None:
    assert place_is_right(truth, found) is right
    elsewhere = replace(found, gaps=(replace(found.gaps[0], joint=2),))
    assert not place_is_right(truth, elsewhere)


@pytest.mark.parametrize(
    ("verdict", "channel", "nm", "word", "right"),
    [
        ("insufficient_data", "torque_nm", -20.7, "saturated or clipped", True),
        ("unexplained", "torque_nm", 20.7, "saturated or clipped", True),
        ("no_gap", "torque_nm", 20.7, "saturated or clipped", False),
        ("insufficient_data", "current_a", 20.7, "saturated or clipped", False),
        ("insufficient_data", "torque_nm", 12.0, "saturated or clipped", False),
        ("insufficient_data", "torque_nm", 20.7, "stuck", False),
    ],
)
def test_a_channel_check_that_gives_what_clips_has_placed_it(
    verdict: str, channel: str, nm: float, word: str, right: bool
) -> None:
    place = {"axis": "channel", "channel": "torque_nm", "low": 20.5, "high": 20.9}
    truth = {**unknown("load", 18.0, np.inf), "joint": "sensor"}
    line = f"run1.csv: j2.{channel}: found exactly {nm} Nm held for 4.1% of the moving time: {word} channel"
    found = replace(findings(verdict), reasons=(line,))
    assert place_is_right({**truth, "places": [*truth["places"], place]}, found) is right
    assert not place_is_right(truth, found), "what does not clip is not placed by it"


@pytest.mark.parametrize(
    ("verdict", "run", "joint", "times", "word", "right"),
    [
        ("unexplained", 2, 1, "5.1, 9.3", "stuck", True),
        ("unexplained", 2, 1, "5.1, 7, 8", "stuck", False),
        ("unexplained", 3, 1, "5.1, 9.3", "stuck", False),
        ("unexplained", 2, 2, "5.1, 9.3", "stuck", False),
        ("unexplained", 2, 1, "5.1", "clipped", False),
        ("no_gap", 2, 1, "5.1, 9.3", "stuck", False),
    ],
)
def test_a_channel_check_that_gives_when_a_channel_is_stuck_has_placed_it(  # noqa: PLR0917
    verdict: str, run: int, joint: int, times: str, word: str, right: bool
) -> None:
    line = f"run{run}.csv: j{joint}.current_a: found exactly 1 A held, from {times} s on; {word} channel"
    moments = [unknown("time", t, t + 0.1, run="run2")["places"][0] for t in (5.0, 9.2)]
    channel = {"axis": "channel", "channel": "current_a", "stuck": True}
    truth = {**unknown("time", 0.0, 0.0), "joint": 1, "places": [*moments, channel]}
    elsewhere = mapped("load", "", 1.0, 2.0, "Nm").gaps
    assert place_is_right(truth, replace(findings(verdict), channel_notes=(line,), gaps=elsewhere)) is right


def test_naming_times_is_no_answer_where_it_is_wrong_half_of_the_time() -> None:
    """The same four moments, three of them right: an answer where events are rare, luck where they fill half of the run."""
    named = mapped("time", "seconds: run1 2.0 s, run1 6.0 s, run1 14.0 s, run1 9.0 s", 0, 0, "s")

    def truth(width: float) -> dict[str, Any]:
        spans = [unknown("time", t, t + width, run="run1")["places"][0] for t in (2.0, 6.0, 14.0, 17.0)]
        return {**unknown("time", 0.0, 0.0), "places": spans}

    assert place_is_right(truth(0.2), named)
    assert not place_is_right(truth(2.0), named)


def test_the_generators_table_counts() -> None:
    good = score(
        "one", 1, [RIPPLE], findings("cause", cause("torque_ripple", 1, amplitude_nm=(0.4, 0.3, 0.5)))
    )
    bad = score("one", 2, [RIPPLE], findings("cause", cause("cogging", 1)))
    unseen = Outcome("one", 3, (("sensor_drift", None),), "invisible")
    quiet = score("nothing", 4, [], findings("no_gap"))
    loud = score("nothing", 5, [], findings("cause", cause("cogging", 1)))
    rows = generator_shares([replace(good, gain=(1.0, 0.6, 0.6)), bad, unseen, quiet, loud])
    by_name = {row.what.split(":")[0]: row for row in rows}
    assert by_name["hidden effect at 3x its minimum"].value == 0.5
    assert by_name["hidden effect at 3x its minimum"].trials == 2
    assert by_name["hidden effect at 3x its minimum"].reached is False
    assert by_name["certain and wrong"].value == 0.5
    assert by_name["nothing hidden"].value == 0.5
    assert by_name["95 % intervals of parameters cover the truth"].value == 1.0
    assert by_name["gain, as share of what the true model would gain"].value == pytest.approx(1.0)
    assert by_name["certain and wrong"].target == "at most 2 %"


def outcome(kind: str, **values: Any) -> Outcome:
    return Outcome(kind, 1, (("torque_ripple", 1),), values.pop("verdict", "cause"), **values)


def test_the_benches_table_counts_what_the_targets_ask() -> None:
    found, missed = (
        outcome("single", named=(True,), classed=(False,)),
        outcome("single", named=(False,), classed=(False,)),
    )
    wrong = outcome("half", named=(False,), classed=(True,), wrong=("cogging of 1",))
    refused = outcome("foreign", verdict="unexplained", place=True)
    rows = {
        row.what: row
        for row in bench_shares([found, missed, wrong, outcome("nothing", verdict="unexplained"), refused])
    }
    assert rows["single, three times visible: a cause, or class of at most 3"].value == 0.5
    assert rows["half of that size"].value == 1.0
    assert rows["certain and wrong"].value == pytest.approx(1 / 4)
    assert rows["nothing hidden: a cause, or unexplained"].value == 1.0
    assert rows["foreign: refused and placed"].reached
    assert rows["foreign worth more than the relevance called no_gap"].reached
    beside = outcome("beside", named=(True,), classed=(False,), wrong=("cogging of 1",))
    with_it = {f.what: f for f in bench_shares([found, beside])}
    assert with_it["certain and wrong"].value == 0.5
    assert with_it["cause beside a foreign effect: found"].value == 1.0
    assert failures([found, beside])[0].startswith("beside")
    gone = outcome("foreign", verdict="no_gap", place=False)
    row = "foreign worth more than the relevance called no_gap"
    assert not {f.what: f for f in bench_shares([gone])}[row].reached
    assert {f.what: f for f in bench_shares([replace(gone, slight=True)])}[row].reached


def test_a_set_of_a_real_bench_counts_beside_the_one_that_hides_nothing() -> None:
    plain = outcome("nothing", causes=(("cogging", 1, ("cogging",)),))
    same = outcome("single", named=(True,), classed=(False,), wrong=("cogging of 1",))
    new = outcome("single", named=(True,), classed=(False,), wrong=("unbalance of 1",))
    both = {row.what: row for row in bench_shares([plain, same, new], real=True)}
    assert both["certain and wrong"].value == pytest.approx(1 / 3)
    assert both["single, three times visible: a cause, or class of at most 3"].trials == 2
    named = outcome("nothing", causes=(("torque_ripple", 1, ("torque_ripple",)),))
    assert not any(row.what.startswith("single") for row in bench_shares([named, same], real=True))
    assert not any(row.what.startswith("single") for row in bench_shares([same], real=True))


def test_a_found_name_that_turns_wrong_is_seen() -> None:
    full = {
        "a": outcome("single", named=(True,), classed=(False,)),
        "b": outcome("single", named=(True,), classed=(False,)),
    }
    recorded = {
        "a": outcome("single", named=(False,), classed=(False,), wrong=("cogging of 1",)),
        "b": outcome("single", named=(False,), classed=(False,)),
    }
    assert lost_to_wrong(full, recorded) == ["a"]
