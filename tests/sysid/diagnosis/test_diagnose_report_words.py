"""What the report of a diagnosis says in words, numbers and bars, against what the findings hold. No page is made here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from jtqd.sysid.diagnosis.findings import (
    CandidateEvidence,
    Findings,
    Gain,
    Gap,
    Place,
    UnexplainedResidual,
    Value,
    summary_lines,
    to_mapping,
)
from jtqd.sysid.diagnosis.report.views import evidence_views, gain_views, gap_views
from jtqd.sysid.diagnosis.report.words import effect_title, gain_sentence, parameter_title, verdict_sentence
from tests.sysid.diagnosis import findings_examples as examples
from tests.sysid.diagnosis.findings_parts import gap

PLAIN_SPACE = str.maketrans("\u00a0\u202f", "  ")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (examples.one_cause, "Cause of the simulation error: torque ripple of joint 1."),
        (
            examples.two_causes,
            "Cause of the simulation error: viscous friction of joint 1 and either link inertia or channel delay "
            "(joint 1); these runs cannot distinguish the alternatives.",
        ),
        (
            examples.no_gap,
            "The simulation explains these runs; the remaining error of 0.155 Nm is noise (0.153 Nm).",
        ),
        (
            examples.unexplained,
            "The simulation has a gap that no effect of the library explains: joint 1, residual 0.610 Nm, "
            "noise floor 0.200 Nm; 52 % of it at link angle 1.18 to 1.57 rad.",
        ),
        (examples.insufficient, "These runs are not sufficient to assess the simulation."),
        (examples.sensor, "Cause of the simulation error: sensor gain."),
    ],
)
def test_the_verdict_is_one_sentence(make: Callable[[], Findings], said: str) -> None:
    assert verdict_sentence(make()).translate(PLAIN_SPACE) == said


def test_a_line_and_bursts_are_said_as_what_they_are() -> None:
    base = examples.unexplained()

    def said(place: Place) -> str:
        gaps = (replace(base.gaps[0], localisation=(place,)),)
        return verdict_sentence(replace(base, gaps=gaps)).translate(PLAIN_SPACE)

    line = Place("motor_angle", "order 3.57 per motor revolution", 1.0, 3.57, 3.57, "1/rev")
    assert said(line).endswith("; 100 % of it in a line at order 3.57 per motor revolution.")
    burst = Place("time", "events: run1 3.2 s, run4 0.7 s", 0.8, 3.2, 3.3, "s")
    assert said(burst).endswith(
        "; 80 % of it in events that noise does not explain, the strongest run1 3.2 s."
    )


def test_classes_of_any_size_are_said_whole() -> None:
    base = examples.two_causes()
    (viscous, inertia) = base.causes
    three = replace(inertia, names=("link_inertia", "channel_delay", "rotor_inertia"))
    assert "one of link inertia, channel delay or rotor inertia (joint 1)" in verdict_sentence(
        replace(base, causes=(viscous, three))
    )
    other = replace(
        inertia, name="coulomb_friction", names=("coulomb_friction", "coulomb_friction of joint 2")
    )
    assert "either Coulomb friction or Coulomb friction of joint 2 (joint 1)" in verdict_sentence(
        replace(base, causes=(other,))
    )


def test_the_same_effect_in_both_joints_is_said_once() -> None:
    base = examples.one_cause()
    (ripple,) = base.causes
    both = (
        ripple,
        replace(ripple, name="torque_constant", names=("torque_constant",)),
        replace(ripple, joint=2),
    )
    assert verdict_sentence(replace(base, causes=both)) == (
        "Cause of the simulation error: torque ripple of joints 1 and 2 and torque constant of joint 1."
    )


def test_the_gain_is_said_with_its_interval_which_is_in_newton_metres() -> None:
    gain = Gain(0.8, 0.2, "split", (0.56, 0.64))
    findings = replace(examples.one_cause(), gain=gain)
    assert gain_sentence(findings).translate(PLAIN_SPACE) == (
        "With it, the error on held-out runs falls from 0.800 to 0.200 Nm, by 0.600 Nm (95 % interval 0.560 to 0.640)."
    )
    (bar,) = gain_views(gain)
    assert (bar.before_width, bar.after_width) == (100.0, 25.0)
    assert bar.whisker == pytest.approx((20.0, 30.0))
    assert gain_sentence(replace(findings, causes=())) == ""


def test_a_gain_beside_what_runs_have_of_their_own_is_said_with_the_plain_errors() -> None:
    gain = Gain(0.2, 0.1, "split; without run-to-run variation", (0.08, 0.12), plain_nm=(0.141, 0.142))
    findings = replace(examples.one_cause(), gain=gain)
    beside = (
        "without run-to-run variation (offset and friction of the day), which is most of the error: with it "
        "0.141 -> 0.142 Nm rms"
    )
    assert (
        gain_sentence(findings).translate(PLAIN_SPACE).endswith(f"(95 % interval 0.080 to 0.120), {beside}.")
    )
    (line,) = [line for line in summary_lines(findings) if line.startswith("gain on held-out runs")]
    assert line.endswith(f"95 % interval), {beside}")
    assert to_mapping(findings)["gain"]["plain_nm"] == [0.141, 0.142]


def test_a_gain_that_is_a_loss_fits_its_bars() -> None:
    (bar,) = gain_views(Gain(0.2, 0.4, "split", (-0.3, -0.1)))
    assert bar.after_width / bar.before_width == pytest.approx(2.0)
    assert bar.whisker is not None
    assert max(bar.before_width, bar.after_width, *bar.whisker) == pytest.approx(100.0)
    (unknown,) = gain_views(Gain(math.nan, math.nan, "split", (math.nan, math.nan)))
    assert (unknown.before, unknown.whisker) == ("–\u00a0Nm", None)


def test_a_size_that_no_run_would_show_is_called_invisible() -> None:
    row = CandidateEvidence("unbalance", 1, math.nan, math.nan, math.nan, {}, "needs link_position_rad")
    seen = {"moment_nm": Value(0.05, (0.05, 0.05), "Nm")}
    never = {"moment_nm": Value(math.inf, (math.inf, math.inf), "Nm")}
    none = {"moment_nm": Value(0.0, (0.0, 0.0), "Nm")}
    texts = [
        evidence_views([replace(row, minimum=each)])[0].minimum.translate(PLAIN_SPACE)
        for each in ({}, seen, never, none)
    ]
    assert texts == ["–", "0.050 Nm", "invisible", "–"]


def test_the_map_puts_axes_by_unevenness_and_marks_what_stands_out() -> None:
    (view,) = gap_views([gap(1, "motor", 0.6, 0.2, {"link_angle": {3: 0.52, 4: 0.21}, "velocity": {6: 0.3}})])
    assert [a.title for a in view.uneven_axes][:2] == ["link angle", "velocity"]
    assert {a.title for a in view.uneven_axes}.isdisjoint({a.title for a in view.even_axes})
    assert len(view.uneven_axes) + len(view.even_axes) == 8
    link = view.uneven_axes[0]
    assert [k for k, b in enumerate(link.bins) if b.hot] == [3, 4]
    assert link.bins[3].height == pytest.approx(1.0)
    assert link.bins[4].height == pytest.approx(0.21 / 0.52)
    # one scale for all axes: equal density is equal height
    assert view.uneven_axes[1].bins[6].height == pytest.approx((0.3 * 12) / (0.52 * 16))
    assert link.even == pytest.approx(1.0 / (0.52 * 16))
    assert view.floor == pytest.approx(1.0 / 3.0)


def test_shares_of_one_axis_are_never_more_than_the_whole() -> None:
    """Where the gap is small beside the noise, the excess of a bin can be larger than that of all."""
    bins = tuple(Place("load", f"bin {k}", 1.0, float(k), k + 1.0, "Nm") for k in range(4))
    (view,) = gap_views([Gap(1, "motor", 0.21, 0.2, "repeated runs", (), bins)])
    assert [b.text.translate(PLAIN_SPACE) for b in view.even_axes[0].bins] == [
        f"bin {k}: 25 %" for k in range(4)
    ]


def test_a_gap_without_a_map_still_says_where() -> None:
    base = gap(1, "motor", 0.6, 0.2, {"velocity": {6: 0.3}})
    (view,) = gap_views([replace(base, map=())])
    assert (view.uneven_axes, view.even_axes) == ((), ())
    assert [p.where.translate(PLAIN_SPACE) for p in view.places] == ["at velocity 0 to 0.3 rad/s"]
    (empty,) = gap_views([Gap(1, "motor", 0.0, 0.0, "repeated runs", ())])
    assert empty.floor == 1.0


def test_names_are_words() -> None:
    assert [effect_title(n) for n in ("stribeck_friction", "torque_ripple")] == [
        "Stribeck friction",
        "torque ripple",
    ]
    assert [parameter_title(n) for n in ("amplitude_nm", "viscous_nms_per_rad", "gain", "offset_a")] == [
        "amplitude",
        "viscous",
        "gain",
        "offset",
    ]


def test_what_is_as_large_as_what_matters_and_does_not_is_explained() -> None:
    left = UnexplainedResidual(1, "motor", 0.3, 0.003, 0.04, 0.2, matters=False)
    assert left.limit("0.2 Nm") == "more than 0.2 Nm, but 4.0% of the gap"
    assert (
        replace(left, unconfirmed=True).limit("0.2 Nm").endswith("effects that are not confirmed explain it")
    )
    assert replace(left, matters=True).limit("0.2 Nm") == "from 0.2 Nm on it matters"
    assert replace(left, rms_nm=0.1).limit("0.2 Nm") == "from 0.2 Nm on it matters"
