"""What report and terminal state of a diagnosis: numbers, names and order against what the findings hold."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from jtqd.sysid.diagnosis.findings import (
    EFFECTIVE,
    CandidateEvidence,
    Findings,
    Gain,
    Place,
    UnexplainedResidual,
    Untold,
    Value,
    priors,
    to_mapping,
)
from jtqd.sysid.diagnosis.report import (
    MOST_ROWS,
    candidate_row,
    effect_title,
    headline,
    in_words,
    parameter_title,
    provenance_text,
    summary,
    terminal_lines,
)
from tests.sysid.diagnosis import findings_examples as examples
from tests.sysid.diagnosis.diagnose_helpers import JOINT
from tests.sysid.diagnosis.findings_parts import value

NARROW = "\u00a0"
INTERVAL = re.compile(r"\[(\S+), (\S+)\]")


def with_value(name: str, parameter: str, found: Value) -> Findings:
    """One cause with one parameter, beside the joint file that ships."""
    base = examples.one_cause()
    one = replace(base.causes[0], name=name, parameters={parameter: found})
    return replace(base, causes=(one,), joint_files={1: JOINT}, too_small=())


def test_the_terminal_shows_this() -> None:
    """One page as a whole: a change of it is to be looked at."""
    assert terminal_lines(examples.one_cause()) == [
        "cause: Torque ripple of joint 1 explains 94 % of the gap: 0.42 Nm (certain). The extended model errs by 0.15 "
        "instead of 0.34 Nm on held-out runs.",
        f"  outlier run: {examples.one_cause().outlier_runs[0].text}",
        "  place    entry          file -> found  95 % interval   share  grade",
        "  joint 1  torque ripple  0.418 Nm       [0.397, 0.439]  94 %   certain (order 2 per revolution, phase 0.71 rad)",
        "too small to matter: current offset of joint 1 12 mA",
        "certain: given torque ripple ± 1 % of rated.",
        "remains: 0.072 Nm rms (0.18 % of rated) at joint 1, motor balance; it would matter from 0.20 Nm",
        "these runs cannot tell: gear damping (would take quick changes); sensor drift (would take warm up)",
        "2026-11-26, jtqd 0.2.0, sha256 of joint1.yaml abababababab: jtq diagnose runs --out d",
    ]


@pytest.mark.parametrize("make", examples.EXAMPLES.values())
def test_a_person_reads_few_lines_and_no_evidence(make: Callable[[], Findings]) -> None:
    found = make()
    s, lines = summary(found), terminal_lines(found)
    assert 1 <= len(s.headline) <= 2
    assert all(sentence.endswith(".") for sentence in s.headline)
    shown = [*s.headline, *s.rows, *(text for name, text in s.lines.items() if name != "run it")]
    assert sum(1 for each in shown if each) <= 10  # with badge and head of the table 12
    assert not re.search(r"\b(nan|inf|None|BIC)\b", "\n".join(lines))
    for cause in found.causes:
        assert f"{cause.delta_evidence:.0f}" not in re.findall(r"\d+", "\n".join(lines))


@pytest.mark.parametrize(
    ("name", "parameter", "found", "row", "first"),
    [
        ("coulomb_friction", "coulomb_nm", value(4.4, 0.1, "Nm"), "3.00 -> 4.40 Nm", "3.0 -> 4.4 Nm"),
        (
            "coulomb_friction",
            "coulomb_nm",
            value(3.004, 0.001, "Nm"),
            "3.0000 -> 3.0040 Nm",
            "3.000 -> 3.004 Nm",
        ),
        (
            *("rotor_inertia", "rotor_inertia_kgm2", value(1.2e-5, 1e-6, "kg m2")),
            *("7.00e-05 -> 1.20e-05 kg m²", "7.0e-05 -> 1.2e-05 kg m²"),
        ),
        ("current_offset", "offset_a", value(0.0123, 0.001, "A"), "12.3 mA", "12 mA"),
        ("sensor_gain", "gain", value(1.0481, 0.0017, ""), "1.0000 -> 1.0481", "1.00 -> 1.05"),
        ("hysteresis", "torque_nm", Value(1.5, (-math.inf, math.inf), "Nm"), "1.50 Nm", "1.5 Nm"),
    ],
)
def test_values_of_file_and_found_have_one_power_of_ten(
    name: str, parameter: str, found: Value, row: str, first: str
) -> None:
    s = summary(with_value(name, parameter, found))
    assert s.rows[0].found.replace(NARROW, " ") == row
    assert first in s.headline[0].replace(NARROW, " ")
    ends = INTERVAL.fullmatch(s.rows[0].interval)
    assert (ends is None) == (not math.isfinite(found.ci95[0]))
    if ends is not None:
        powers = {
            text.partition("e")[2] for text in (*ends.groups(), row.rpartition("> ")[2].partition(" ")[0])
        }
        assert len(powers) == 1
        scale = 1e3 if "mA" in row else 1.0
        assert [float(x) for x in ends.groups()] == pytest.approx([scale * x for x in found.ci95], rel=0.02)


def test_a_value_at_its_bound_is_zero_and_what_differs_is_seen_to_differ() -> None:
    at_bound = Value(1e-9, (1e-9, 1.04e-5), "kg m2")
    (row,) = summary(with_value("rotor_inertia", "rotor_inertia_kgm2", at_bound)).rows
    assert (row.found.replace(NARROW, " "), row.interval) == ("7.00e-05 -> 0 kg m²", "[0, 1.04e-05]")
    wide = value(1.23, 0.4, "Nm")
    joint = replace(JOINT, friction=replace(JOINT.friction, coulomb_nm=0.001))
    made = replace(with_value("coulomb_friction", "coulomb_nm", wide), joint_files={1: joint})
    assert summary(made).rows[0].found == "0.001 -> 1.23 Nm"


def test_one_of_several_is_named_with_its_rivals() -> None:
    base = examples.two_causes()
    inertia = replace(
        base.causes[1], explained_share=0.95, rivals=("channel_delay", "sensor_offset of the sensor")
    )
    found = replace(base, causes=(base.causes[0], inertia))
    first = headline(found)[0].replace(NARROW, " ")
    assert first.startswith(
        "Link inertia of joint 1, its channel delay or sensor offset explains 95 % of the gap"
    )
    assert "(0.21 kg m² if it is link inertia)" in first
    assert summary(found).rows[0].grade == "one of 3: or its channel delay, sensor offset"
    assert "one of:" in summary(found).lines["grades"]


def test_entries_without_a_row_are_listed_and_counted() -> None:
    base = examples.one_cause()
    causes = tuple(replace(base.causes[0], joint=k, explained_share=0.3 - 0.01 * k) for k in range(1, 7))
    found = replace(base, causes=causes, joints=tuple(range(1, 7)))
    s = summary(found)
    assert [row.place for row in s.rows] == [f"joint {k}" for k in range(1, MOST_ROWS + 1)]
    assert all(
        f"torque ripple of joint {k} 0.42 Nm (certain)" in s.lines["also"] for k in range(MOST_ROWS + 1, 7)
    )


def test_an_entry_below_the_relevance_has_no_row() -> None:
    base = examples.one_cause()
    small = replace(base.causes[0], joint=2, rms_nm=0.05, matters=False)
    s = summary(replace(base, causes=(*base.causes, small)))
    assert [row.place for row in s.rows] == ["joint 1"]
    assert (
        s.lines["too small to matter"] == "torque ripple of joint 2 0.42 Nm, current offset of joint 1 12 mA"
    )
    assert "joint 2" not in s.headline[0]


def test_unexplained_has_entries_and_gain_first_then_what_remains() -> None:
    left = UnexplainedResidual(1, "motor", 0.61, 1.5, 0.3, 0.2, matters=True)
    found = replace(examples.one_cause(), verdict="unexplained", unexplained=left)
    first, second = headline(found)
    assert first.startswith("Torque ripple of joint 1 explains 94 % of the gap")
    assert second == (
        "The extended model errs by 0.15 instead of 0.34 Nm on held-out runs, but 0.61 Nm rms at joint 1 remain unexplained."
    )
    assert summary(found).lines["remains"].endswith("it matters from 0.20 Nm")
    assert (
        "21 % of it at motor angle" in summary(found).lines["remains"]
        or "22 % of it at motor angle" in summary(found).lines["remains"]
    )
    assert headline(replace(found, gain=None))[1] == "0.61 Nm rms at joint 1 remain unexplained."
    assert headline(examples.unexplained())[0].startswith(
        "No entry explains the gap: 0.58 Nm rms at joint 1, 52 % of it at "
    )


def test_no_gap_and_too_little_are_one_sentence() -> None:
    found = examples.no_gap()
    (only,) = headline(replace(found, relevance=0.01))
    assert "below 1 % of rated torque" in only
    assert "1 entry is too small to matter" in only
    assert "too small" not in headline(replace(found, too_small=()))[0]
    (only,) = headline(examples.insufficient())
    assert examples.insufficient().reasons[0] in only


def test_a_gain_that_is_a_loss_is_stated_as_one() -> None:
    worse = replace(examples.one_cause(), gain=Gain(0.2, 0.4, "split", (-0.3, -0.1)))
    assert "errs by 0.40 Nm on held-out runs, no less than the joint file" in headline(worse)[1]
    both = replace(worse, joints=(1, 2), gain=Gain(0.4, 0.2, "split", (0.1, 0.3), joint=2))
    assert "by 0.20 instead of 0.40 Nm at joint 2 on held-out runs" in headline(both)[1]
    close = replace(worse, gain=Gain(0.2049, 0.2041, "split", (0.0, 0.1)))
    assert "by 0.2041 instead of 0.2049 Nm" in headline(close)[1]
    unknown = replace(worse, gain=Gain(math.nan, math.nan, "split", (math.nan, math.nan)))
    assert len(headline(unknown)) == 1


def test_the_priors_that_a_certain_entry_rests_on_are_stated_as_set() -> None:
    found = examples.sensor()
    assert "sensor gain ± 1 %" in summary(found).lines["grades"]
    assert "torque constant ± 10 %" in summary(found).lines["grades"]  # what it would otherwise be
    set_ = replace(found, trust={"sensor_gain": 5.0})
    assert "sensor gain ± 5 % (as set)" in summary(set_).lines["grades"]
    rows = {row.name: row for row in priors(set_.trust)}
    assert (rows["sensor_gain"].size, rows["sensor_gain"].set_by_user) == ("5 %", True)
    assert (rows["torque_constant"].size, rows["torque_constant"].set_by_user) == ("10 %", False)
    mapping = to_mapping(set_)
    assert {"name": "sensor_gain", "size": "5 %", "set_by_user": True} in mapping["priors"]
    assert mapping["relevance"] == 0.005


def test_an_effective_entry_has_the_reason_why_it_is_not_certain() -> None:
    base = examples.one_cause()
    one = replace(base.causes[0], grade=EFFECTIVE, doubts=("its size differs by 18 % from run to run",))
    text = summary(replace(base, causes=(one,))).lines["grades"]
    assert one.doubts[0] in text
    assert one.doubts[0] not in summary(base).lines["grades"]


def test_what_these_runs_cannot_tell_is_grouped_by_the_motion_that_would() -> None:
    lost = (
        Untold("lost_motion", 1, "w", "load_ramp"),
        Untold("lost_motion", 2, "w", "load_ramp"),
        Untold("hysteresis", 2, "w", "load_ramp"),
        Untold("sensor_drift", "sensor", "w", "warm_up"),
    )
    text = summary(replace(examples.two_causes(), cannot_be_told=lost)).lines["these runs cannot tell"]
    assert text == (
        "lost motion of joints 1 and 2, hysteresis of joint 2 (would take load ramp); sensor drift (would take warm up)"
    )


def test_a_line_and_bursts_are_stated_as_what_they_are() -> None:
    base = examples.unexplained()

    def first(place: Place) -> str:
        return headline(replace(base, gaps=(replace(base.gaps[0], localisation=(place,)),)))[0]

    line = Place("motor_angle", "order 3.57 per motor revolution", 1.0, 3.57, 3.57, "1/rev")
    assert first(line).endswith(", 100 % of it in a line at order 3.57 per motor revolution.")
    burst = Place("time", "events: run1 3.2 s, run4 0.7 s", 0.8, 3.2, 3.3, "s")
    assert first(burst).endswith(
        ", 80 % of it in events that noise does not explain, the strongest run1 3.2 s."
    )


def test_the_kinds_of_motion_of_the_next_experiment_come_first() -> None:
    why = "unbalance and sensor_offset fit alike. Proposed: full_turns: a. zero_reading: b. Joint 1 alone."
    found = replace(
        examples.two_causes(), next_experiment={"why": why, "plan": None, "command": "jtq campaign p"}
    )
    assert (
        summary(found).lines["measure next"]
        == "full turns and zero reading, because unbalance and sensor offset fit alike"
    )
    assert "run it: jtq campaign p" in terminal_lines(found)


def test_provenance_has_twelve_digits_of_every_hash() -> None:
    made = examples.one_cause().provenance
    assert made is not None
    many = replace(made, inputs={f"r{k}.csv": f"{k}" * 64 for k in range(9)})
    assert "r8.csv" not in provenance_text(many)
    assert "and 3 more" in provenance_text(many)
    assert "r8.csv 888888888888:" in provenance_text(many, most=9)
    assert provenance_text(None) == ""
    assert (
        to_mapping(replace(examples.one_cause(), provenance=many))["provenance"]["inputs"]["r8.csv"]
        == "8" * 64
    )


@pytest.mark.parametrize(
    ("cubic", "words"), [(None, "stiffness"), (0.0, "stiffness"), (1e8, "nonlinear stiffness")]
)
def test_a_stiffness_that_is_wrong_is_named_stiffness(cubic: float | None, words: str) -> None:
    parameters = {"stiffness_nm_per_rad": value(9643.0, 90.0, "Nm/rad")}
    if cubic is not None:
        parameters["cubic_nm_per_rad3"] = value(cubic, 0.1 * cubic, "Nm/rad3")
    found = replace(
        examples.one_cause(),
        causes=(
            replace(
                examples.one_cause().causes[0], name="nonlinear_stiffness", joint=1, parameters=parameters
            ),
        ),
    )
    assert [row.entry for row in summary(found).rows] == [words]
    assert headline(found)[0].startswith(f"{words.capitalize()} of joint 1 explains")
    assert to_mapping(found)["causes"][0]["name"] == "nonlinear_stiffness"


def test_names_are_words() -> None:
    assert [effect_title(n) for n in ("stribeck_friction", "torque_ripple")] == [
        "Stribeck friction",
        "torque ripple",
    ]
    names = ("amplitude_nm", "viscous_nms_per_rad", "gain", "offset_a", "order_per_motor_rev")
    assert [parameter_title(n) for n in names] == ["amplitude", "viscous", "gain", "offset", "order"]
    assert in_words("b.csv: j1.torque_nm and link_inertia, sensor_gain;") == (
        "b.csv: j1.torque_nm and link inertia, sensor gain;"
    )
    assert in_words("in the set, one_of") == "in the set, one of"
    named = "r: time_s: found peaks of rated_torque_nm (15 Nm), gear_ratio"
    assert in_words(f"{named}; speed_ladder: load_dependent_friction") == (
        f"{named}; speed ladder: load dependent friction"
    )


def test_an_entry_of_no_size_is_not_listed() -> None:
    base = examples.one_cause()
    (small,) = base.too_small
    nothing = replace(small, name="link_inertia", rms_nm=0.0)
    assert summary(replace(base, too_small=(small, nothing))).lines == summary(base).lines
    agree = replace(base, verdict="no_gap", causes=(), too_small=(nothing,))
    assert "too small" not in " ".join(headline(agree))


def test_a_certain_entry_rests_on_no_prior_of_a_sensor_that_is_none() -> None:
    one = replace(examples.one_cause().causes[0], name="torque_constant", balance="motor")
    base = replace(examples.one_cause(), causes=(one,), too_small=(), candidates=())
    assert summary(base).lines["grades"] == "certain: given torque constant ± 10 %, sensor gain ± 1 %."
    absent = CandidateEvidence("sensor_gain", 1, math.nan, {}, "no torque was measured")
    known = summary(replace(base, candidates=(absent,)))
    assert known.lines["grades"] == "certain: given torque constant ± 10 %."


def test_a_row_of_every_entry_has_its_smallest_size() -> None:
    row = CandidateEvidence("unbalance", 1, 5e6, {}, "cannot be told from these runs")
    seen = {"moment_nm": Value(0.05, (math.nan, math.nan), "Nm")}
    never = {"moment_nm": Value(math.inf, (math.inf, math.inf), "Nm")}
    texts = [candidate_row(replace(row, minimum=each)) for each in ({}, seen, never)]
    assert [each[3].replace(NARROW, " ") for each in texts] == ["–", "0.050 Nm", "–"]
    assert texts[0][:3] == ("unbalance", "joint 1", "cannot be told from these runs")


@pytest.mark.parametrize("make", examples.EXAMPLES.values())
def test_what_a_session_prints_is_one_line_with_every_cause(make: Callable[[], Findings]) -> None:
    findings = make()
    shown = repr(findings)
    assert shown.startswith(f"Findings({findings.verdict}")
    assert shown.endswith(f"; {findings.runs_text})")
    assert re.findall(r"(\w+) of [\w ]+ \((\w+)\)", shown) == [
        (each.name, each.grade) for each in findings.causes
    ]
    assert "\n" not in shown
