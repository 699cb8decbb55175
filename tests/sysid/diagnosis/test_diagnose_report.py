"""The report of a diagnosis: what it says is what the findings hold; one file, readable by all, nothing from outside."""

from __future__ import annotations

import hashlib
import html.parser
import itertools
import os
import re
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.findings import Findings, Provenance, Trace
from jtqd.sysid.diagnosis.report import effect_title, in_words, place, summary
from jtqd.sysid.report.numbers import number
from tests.sysid.diagnosis import findings_examples as examples

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from jtqd.sysid.diagnosis.report import picture, render, worst_trace

VOID = {"meta", "br", "link", "img", "input", "hr"}
PLAIN_SPACE = str.maketrans("\u00a0\u202f", "  ")


class Page(html.parser.HTMLParser):
    """Elements, ids, addresses and texts of a page; fails on tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.refers: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._seen(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._seen(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes nothing, line {self.getpos()}"

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.text += data

    def _seen(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.elements.append((tag, named))
        if named.get("id"):
            self.ids.append(str(named["id"]))
        self.refers += [str(v) for k, v in attrs if k in {"href", "src", "xlink:href"}]


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {name: render(make()) for name, make in examples.EXAMPLES.items()}


def text_of(page: str) -> str:
    return re.sub(r"\s+", " ", Page(page).text.translate(PLAIN_SPACE))


@pytest.mark.parametrize("name", examples.EXAMPLES)
def test_a_page_is_whole_and_needs_nothing_else(pages: dict[str, str], name: str) -> None:
    page = Page(pages[name])
    assert len(pages[name].encode()) < 1_500_000
    assert len(page.ids) == len(set(page.ids)), "an id occurs twice"
    assert all(each.startswith("#") and each[1:] in page.ids for each in page.refers)
    for each in re.findall(r"url\(([^)]*)\)", pages[name]):
        assert each.startswith("#")
        assert each[1:] in page.ids
    assert not {"link", "img", "iframe", "script"} & {tag for tag, _ in page.elements}
    assert not re.search(r"https?://(?!www\.w3\.org/)", pages[name])
    assert "@import" not in pages[name]
    assert not re.search(r"\b(nan|NaN|inf|None|Undefined)\b", text_of(pages[name]))


@pytest.mark.parametrize("name", examples.EXAMPLES)
def test_pictures_have_a_text_for_those_who_cannot_see_them(pages: dict[str, str], name: str) -> None:
    page = Page(pages[name])
    pictures = [named for _, named in page.elements if named.get("role") == "img"]
    assert all(re.search(r"\d", str(named.get("aria-label"))) for named in pictures)
    assert pages[name].count("<svg") == len(pictures) <= 1
    tables = [tag for tag, _ in page.elements if tag in {"table", "caption"}]
    assert tables == ["table", "caption"] * (len(tables) // 2)
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


@pytest.mark.parametrize("name", ["one_cause", "unexplained"])
def test_a_figure_has_measurement_and_simulation_before_and_after_and_their_difference(
    pages: dict[str, str], name: str
) -> None:
    drawn = re.findall(r'<g id="p-((?:ink|before|after|soft)_\d)">', pages[name])
    after = ["ink_1", "after_1", "before_2", "after_2", "soft_3"]
    assert drawn == ["ink_0", "before_0", *(after if name == "one_cause" else ["before_1", "soft_2"])]


def test_the_table_has_the_files_value_and_the_found_one() -> None:
    joint = load_joint(shipped("joint1.yaml"))
    found = replace(examples.two_causes(), joint_files={1: joint})
    text = text_of(render(found))
    viscous = found.causes[0].parameters["viscous_nms_per_rad"].value
    before = joint.friction.viscous_nms_per_rad
    assert f"viscous friction{before:.2f} → {viscous:.2f} Nm s/rad[5.58, 5.86]91 %certain" in text
    assert "one of 2: or its channel delay" in text


@pytest.mark.parametrize("name", examples.EXAMPLES)
def test_the_page_states_what_the_terminal_does_before_the_first_picture(
    pages: dict[str, str], name: str
) -> None:
    found = examples.EXAMPLES[name]()
    s = summary(found)
    head = re.sub(r"<[^>]*>", "", pages[name].partition("<h2")[0].partition("</style>")[2])
    head = re.sub(r"\s+", " ", html.unescape(head).translate(PLAIN_SPACE)).replace("→", "->")
    for each in (*s.headline, *s.notes, *(text for name, text in s.lines.items() if name != "run it")):
        assert each.translate(PLAIN_SPACE) in head
    for row in s.rows:
        assert all(
            cell.translate(PLAIN_SPACE) in head for cell in (row.entry, row.found, row.interval, row.grade)
        )
    assert "BIC" not in text_of(pages[name])


def test_the_foot_has_provenance_and_the_folded_tables_their_rows(pages: dict[str, str]) -> None:
    findings = examples.one_cause()
    text = text_of(pages["one_cause"])
    assert "2026-11-26, jtqd 0.2.0, sha256 of joint1.yaml abababababab: jtq diagnose runs --out d" in text
    assert "set by the user" not in text
    assert "sensor gain5 %set by the user" in text_of(render(replace(findings, trust={"sensor_gain": 5.0})))
    rows = re.findall(
        r'<tr><th scope="row">([^<]+)</th><td>([^<]+)</td><td class="full">([^<]+)</td>', pages["one_cause"]
    )
    titles = {(effect_title(c.name), place(c.joint), in_words(c.reason)) for c in findings.candidates}
    assert set(rows) == titles
    assert len(rows) == len(findings.candidates)
    assert findings.gain is not None
    for each in findings.gain.runs:
        assert f"{each.run}{number(each.rmse_before_nm)}{number(each.rmse_after_nm)}" in text


def test_pictures_follow_the_page_into_the_dark(pages: dict[str, str]) -> None:
    svg = "".join(re.findall(r"<svg.*?</svg>", pages["one_cause"], re.DOTALL))
    fixed = {c.lower() for c in re.findall(r"#[0-9a-fA-F]{6}\b", svg)}
    assert not fixed - {"#ffffff"}, "a colour that stays the same in the dark"
    assert "var(--before)" in svg
    assert "var(--after)" in svg


def test_the_page_has_the_reason_and_the_command_of_the_next_experiment(pages: dict[str, str]) -> None:
    found = examples.two_causes()
    assert found.next_experiment is not None
    text = text_of(pages["two_causes"])
    assert str(found.next_experiment["why"]) in text
    assert "next_experiment.plan.yaml beside this page is the plan." in text
    command = {**found.next_experiment, "command": "jtq campaign p --bus can0"}
    assert "plan: jtq campaign p --bus can0, then" in text_of(render(replace(found, next_experiment=command)))
    assert "Next experiment" not in text_of(pages["one_cause"])


def test_the_page_has_the_motions_of_a_joint() -> None:
    run = {"name": "full_turns_1", "what": "with a payload", "duration_s": 16.2}
    motion = {"joint": 3, "runs": [run, run]}
    experiment = {"why": "By hand.", "plan": None, "motions": {"next_experiment.motion.csv": motion}}
    text = text_of(render(replace(examples.insufficient(), next_experiment=experiment)))
    assert "next_experiment.motion.csv beside this page" in text
    assert "2 runs of joint 3full_turns_1, with a payload: 16.2 s" in text


def test_a_plan_that_no_campaign_would_take_does_not_stop_the_report() -> None:
    bad = {"why": "By hand: hang a weight.", "plan": {"schema": "jtq.plan/1"}}
    for experiment in (bad, {"why": "By hand: hang a weight.", "plan": None}):
        text = text_of(render(replace(examples.insufficient(), next_experiment=experiment)))
        assert "By hand: hang a weight." in text


def test_names_from_outside_are_text_and_not_markup() -> None:
    evil = "<b>run&amp;\"'</b>"
    base = examples.unexplained()
    page = render(
        replace(
            base,
            runs=(evil,),
            reasons=(evil,),
            channel_notes=(evil,),
            traces=(replace(base.traces[0], run=evil),),
            next_experiment={"why": evil, "plan": {"name": evil}},
            provenance=Provenance("2026-11-26", "0.2.0", evil, {}),
        )
    )
    assert evil not in page
    assert text_of(page).count(evil) >= 6


def peaks(svg: str, name: str) -> np.ndarray[Any, Any]:
    """Points [n, 2] of a curve of a picture."""
    (path,) = re.findall(rf'<g id="[^"]*{name}">\s*<path d="([^"]*)"', svg)
    return np.array(re.findall(r"[ML] (\S+) (\S+)", path), float)


def test_one_sample_that_stands_out_of_a_million_is_in_the_picture() -> None:
    n = 200_000
    time = np.arange(n) * 0.005
    before = 0.1 * np.sin(time)
    before[150_000] = 5.0
    trace = Trace("long", 1, "motor", time, before, 0.1 * np.sin(time), np.sin(time), 9 * np.cos(time))
    page = render(replace(examples.one_cause(), traces=(trace,)))
    points = peaks(page, "before_2")
    top = points[np.argmin(points[:, 1])]
    share = (top[0] - points[0, 0]) / (points[-1, 0] - points[0, 0])
    assert share == pytest.approx(0.75, abs=2e-3)
    calm = peaks(page, "after_2")
    assert np.ptp(calm[:, 1]) == pytest.approx(np.ptp(points[:, 1]) * 0.2 / 5.1, rel=0.25), "not on one scale"


def test_gaps_in_the_record_and_empty_records_are_drawn_without_a_word() -> None:
    base = examples.one_cause().traces[0]
    before = base.before_nm.copy()
    before[2000:4000] = np.nan
    nothing = np.full(len(before), np.nan)
    for values in (before, nothing):
        page = render(replace(examples.one_cause(), traces=(replace(base, before_nm=values),)))
        assert page.count("<svg") == 1


def test_the_worst_held_out_run_of_the_gains_balance_is_drawn() -> None:
    findings = examples.one_cause()
    assert findings.gain is not None
    trace, held_out = drawn(findings)
    assert (trace.run, trace.balance, held_out) == ("excitation_03.csv.gz", "motor", True)  # by Gain.runs
    made = picture(findings)
    assert made is not None
    assert made.title.endswith("the worst held-out run")
    assert drawn(replace(findings, gain=replace(findings.gain, balance="torsion")))[0].balance == "torsion"
    loudest, held_out = drawn(replace(findings, gain=None))
    assert not held_out
    assert float(np.sum(loudest.before_nm**2)) == max(
        float(np.sum(t.before_nm**2)) for t in findings.traces if t.balance == "motor"
    )
    assert worst_trace(replace(findings, traces=())) is None


def drawn(findings: Findings) -> tuple[Trace, bool]:
    found = worst_trace(findings)
    assert found is not None
    return found


def test_ten_long_runs_of_two_joints_stay_a_small_page() -> None:
    random = np.random.default_rng(0)
    time = np.arange(0.0, 60.0, 0.005)
    traces = tuple(
        Trace(f"run_{k}.csv.gz", j, balance, time, *random.normal(0.0, 1.0, (4, len(time))))
        for k in range(10)
        for j in (1, 2)
        for balance in ("motor", "torsion")
    )
    page = render(
        replace(examples.two_causes(), runs=tuple(f"run_{k}.csv.gz" for k in range(10)), traces=traces)
    )
    assert len(page.encode()) < 1_500_000
    assert all(f"run_{k}.csv.gz" in text_of(page) for k in range(10)), "all runs are in the table"


def test_the_same_findings_give_the_same_page(pages: dict[str, str]) -> None:
    code = (
        "import hashlib; from tests.sysid.diagnosis.findings_examples import unexplained; "
        "from jtqd.sysid.diagnosis.report import render;"
        "print(hashlib.sha256(render(unexplained()).encode()).hexdigest())"
    )
    other = subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONHASHSEED": "1", "PATH": ""},
    ).stdout.strip()
    assert other == hashlib.sha256(pages["unexplained"].encode()).hexdigest()


def test_drawing_leaves_the_settings_of_others_alone() -> None:
    import matplotlib as mpl

    mpl.rcdefaults()
    before = dict(mpl.rcParams)
    render(examples.no_gap())
    changed = {key for key in before if mpl.rcParams[key] != before[key]}
    assert changed <= {"backend", "backend_fallback"}, "where pictures go, not how they look"
