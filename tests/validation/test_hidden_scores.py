"""What counts as found, wrong, covered and rightly placed: findings made by hand against truths made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.sysid.diagnosis.findings import Cause, Findings, Gap, Place, Value
from validation.hidden.campaign import main
from validation.hidden.case import draw, follow_up
from validation.hidden.figures import figures, table, wilson
from validation.hidden.menu import MENU, base_value, scaled
from validation.hidden.order import Order
from validation.hidden.profiles import Reference
from validation.hidden.scores import Outcome, intervals, place_is_right, score

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
    return Cause(name, joint, (name, *others), parameters, 50.0, 0.5, 0.3, "motor")


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
        (("sensor_gain", "torque_constant"), None, False),
        (("torque_constant", "sensor_gain"), PLAN, True),
        (("torque_constant", "sensor_gain of the sensor", "hysteresis"), PLAN, True),
        (("sensor_gain", "a", "b", "c"), PLAN, False),
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
    assert replace(outcome, settled=False).found == (False,)
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
    gap = Gap(1, "motor", 1.0, 0.1, "", (Place(axis, text, 0.8, low, high, unit),))
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
def test_a_channel_check_that_says_what_clips_has_placed_it(
    verdict: str, channel: str, nm: float, word: str, right: bool
) -> None:
    place = {"axis": "channel", "channel": "torque_nm", "low": 20.5, "high": 20.9}
    truth = {**unknown("load", 18.0, np.inf), "joint": "sensor"}
    line = f"run1.csv: j2.{channel}: found exactly {nm} Nm held for 4.1% of the moving time: {word} channel"
    found = replace(findings(verdict), reasons=(line,))
    assert place_is_right({**truth, "places": [*truth["places"], place]}, found) is right
    assert not place_is_right(truth, found), "what does not clip is not placed by it"


@pytest.mark.parametrize(
    ("verdict", "line", "right"),
    [
        (
            "unexplained",
            "run2.csv: j1.current_a: found exactly 1 A held, from 5.1, 9.3 s on; stuck channel",
            True,
        ),
        (
            "unexplained",
            "run2.csv: j1.current_a: found exactly 1 A held, from 5.1, 7, 8 s on; stuck channel",
            False,
        ),
        (
            "unexplained",
            "run3.csv: j1.current_a: found exactly 1 A held, from 5.1, 9.3 s on; stuck channel",
            False,
        ),
        (
            "unexplained",
            "run2.csv: j2.current_a: found exactly 1 A held, from 5.1, 9.3 s on; stuck channel",
            False,
        ),
        (
            "unexplained",
            "run2.csv: j1.current_a: found exactly 1 A held, from 5.1 s on; clipped channel",
            False,
        ),
        (
            "no_gap",
            "run2.csv: j1.current_a: found exactly 1 A held, from 5.1, 9.3 s on; stuck channel",
            False,
        ),
    ],
)
def test_a_channel_check_that_says_when_a_channel_is_stuck_has_placed_it(
    verdict: str, line: str, right: bool
) -> None:
    times = [unknown("time", t, t + 0.1, run="run2")["places"][0] for t in (5.0, 9.2)]
    channel = {"axis": "channel", "channel": "current_a", "stuck": True}
    truth = {**unknown("time", 0.0, 0.0), "joint": 1, "places": [*times, channel]}
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


def test_table_counts() -> None:
    good = score(
        "one", 1, [RIPPLE], findings("cause", cause("torque_ripple", 1, amplitude_nm=(0.4, 0.3, 0.5)))
    )
    bad = score("one", 2, [RIPPLE], findings("cause", cause("cogging", 1)))
    unseen = Outcome("one", 3, (("sensor_drift", None),), "invisible")
    quiet = score("nothing", 4, [], findings("no_gap"))
    loud = score("nothing", 5, [], findings("cause", cause("cogging", 1)))
    rows = figures([replace(good, gain=(1.0, 0.6, 0.6)), bad, unseen, quiet, loud])
    by_name = {row.what.split(":")[0]: row for row in rows}
    assert by_name["hidden effect at 3x its minimum"].value == 0.5
    assert by_name["hidden effect at 3x its minimum"].trials == 2
    assert by_name["hidden effect at 3x its minimum"].reached is False
    assert by_name["wrong single name"].value == 0.5
    assert by_name["nothing hidden"].value == 0.5
    assert by_name["95 % intervals of parameters cover the truth"].value == 1.0
    assert by_name["gain, as share of what the true model would gain"].value == pytest.approx(1.0)
    assert "at most 2 %" in table(rows)
    assert wilson(95, 100) == pytest.approx((0.888, 0.978), abs=2e-3)


def test_scaled_size_is_a_multiple_of_the_deviation() -> None:
    case = draw(3, runs=1, duration_s=1.0)
    rng = np.random.default_rng(3)
    for name, entry in MENU.items():
        nominal = case.joints[1]
        for parameter in filter(None, (entry.leading, entry.second)):
            base = base_value(name, nominal, parameter)
            step = 0.02 * (abs(base) or 1.0)
            values = scaled(name, nominal, {parameter: base + step}, 3.0, rng)
            assert abs(values[parameter] - base) == pytest.approx(3.0 * step)


def test_further_runs_come_from_the_same_bench() -> None:
    """A bench with a large sensor offset shows it again in runs that somebody else designs."""
    order = Order(8, (("sensor_offset", "sensor", {"offset_nm": 5.0}),), runs=1, duration_s=2.0)
    t = np.arange(3000) * 1e-3
    ramp = np.minimum(t, 0.5)
    asked = [
        Reference(0, ramp, 0.0 * t),
        Reference(1, ramp[:2000], 0.5 * ramp[:2000]),
    ]
    first, second = follow_up(order, asked)
    assert len(first["time_s"]) == 3000
    assert len(second["time_s"]) == 2000
    ratio = draw(8, runs=1, duration_s=1.0).joints[1]["gear_ratio"]
    assert np.mean(first["j1.motor_velocity_rad_s"][2000:]) / ratio == pytest.approx(0.5, abs=0.02)
    assert np.mean(first["j1.torque_nm"][:20]) == pytest.approx(5.0, abs=0.6)
    assert np.mean(second["j2.torque_nm"][:20]) == pytest.approx(5.0, abs=0.6)


def test_drives_that_somebody_wants_off_carry_no_current_and_the_table_says_so() -> None:
    """Only what is asked for is marked; what is read then is the offset."""
    order = Order(8, (("current_offset", 1, {"offset_a": 0.2}),), runs=1, duration_s=2.0)
    t = np.arange(2500) * 1e-3
    velocity = 0.3 * np.sin(2.0 * np.pi * np.clip(t, 0.0, 1.0))
    one, other = follow_up(
        order, [Reference(0, velocity, 0.0 * t, ((1000, 2000),)), Reference(0, velocity, 0.0 * t)]
    )
    off = one["j1.enabled"] == 0.0
    assert np.flatnonzero(off).tolist() == list(range(1000, 2000))
    assert np.array_equal(one["j1.enabled"], one["j2.enabled"])
    assert "j1.enabled" not in other
    late = np.arange(1100, 2000)
    assert np.mean(one["j1.current_a"][late]) == pytest.approx(0.2, abs=0.003)
    assert np.mean(one["j2.current_a"][late]) == pytest.approx(0.0, abs=0.003)
    assert np.ptp(one["j1.motor_position_rad"][late]) < 0.01


def test_campaign_prints_its_table(capsys: pytest.CaptureFixture[str]) -> None:
    status = main(["--trials", "1", "--seed", "4", "--kinds", "nothing", "--processes", "1", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["seed"] == 4
    assert result["outcomes"][0]["kind"] == "nothing"
    assert (status == 0) == all(row["reached"] for row in result["figures"])
    assert main(["--trials", "1", "--kinds", "everything"]) == 2
    assert "found --kinds 'everything'" in capsys.readouterr().err
