"""The report of a diagnosis: what it says is what the findings hold; one file, readable by all, nothing from outside."""

from __future__ import annotations

import base64
import hashlib
import html.parser
import itertools
import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.findings import Trace
from jtqd.sysid.diagnosis.report.views import evidence_views
from jtqd.sysid.diagnosis.report.words import effect_title
from tests.sysid.diagnosis import findings_examples as examples

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from jtqd.sysid.diagnosis.report.page import render
from jtqd.sysid.diagnosis.report.pictures import MOST, chosen_traces, pictures

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
    assert not {"link", "img", "iframe"} & {tag for tag, _ in page.elements}
    scripts = [named for tag, named in page.elements if tag == "script"]
    assert all(set(named) <= {"type"} for named in scripts), "a script from somewhere else"
    assert not re.search(r"https?://(?!www\.w3\.org/)", pages[name])
    assert "@import" not in pages[name]
    assert not re.search(r"\b(nan|NaN|inf|None|Undefined)\b", text_of(pages[name]))


@pytest.mark.parametrize("name", examples.EXAMPLES)
def test_whoever_cannot_see_the_pictures_is_told_what_they_show(pages: dict[str, str], name: str) -> None:
    page = Page(pages[name])
    pictures = [named for _, named in page.elements if named.get("role") == "img"]
    assert all(re.search(r"\d", str(named.get("aria-label"))) for named in pictures)
    assert pages[name].count("<svg") == sum(
        1 for _, n in page.elements if {"wide", "narrow"} & {n.get("class")} and n.get("role")
    )
    tables = [tag for tag, _ in page.elements if tag in {"table", "caption"}]
    assert tables == ["table", "caption"] * (len(tables) // 2)
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_the_curves_that_can_be_zoomed_are_the_traces() -> None:
    findings = examples.two_causes()
    picture = pictures(findings)[0]
    trace = chosen_traces(findings)[0]
    data = json.loads(picture.data)
    assert [curve["role"] for curve in data["curves"]] == ["before", "after", "soft", "soft"]
    for curve, values in zip(
        data["curves"], (trace.before_nm, trace.after_nm, trace.velocity_rad_s, trace.torque_nm), strict=True
    ):
        whole = np.frombuffer(base64.b64decode(curve["values"]), "<i2")
        back = np.where(whole == -32768, np.nan, whole * curve["scale"])
        assert back == pytest.approx(values, abs=1e-4 * np.nanmax(np.abs(values)), nan_ok=True)
    assert data["start_s"] + data["step_s"] * (len(trace.time_s) - 1) == pytest.approx(trace.time_s[-1])


BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_a_browser_draws_them(pages: dict[str, str], tmp_path: Path) -> None:
    """Dragging over a third of the first figure leaves a third of its run."""
    drag = """<script>
    window.onerror = (text) => { document.title = "ERROR " + text; };
    const svg = document.querySelector(".zoom svg"), box = svg.getBoundingClientRect();
    svg.setPointerCapture = () => {};
    const send = (kind, x) => svg.dispatchEvent(
      new PointerEvent(kind, { clientX: box.left + x, clientY: box.top + 40, pointerId: 1, bubbles: true }));
    send("pointerdown", 300); send("pointermove", 400); send("pointerup", 500);
    </script></body>"""
    path = tmp_path / "page.html"
    path.write_text(pages["one_cause"].replace("</body>", drag), encoding="utf-8")
    assert BROWSER is not None
    found = subprocess.run(
        [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--window-size=1000,1500",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=2000",
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    ).stdout
    assert "ERROR" not in found.partition("</title>")[0]
    assert found.count('class="live"') == found.count("<figure data-trace")
    assert re.search(r"[\d.]+ to [\d.]+ s; double click: whole run", found)


def test_the_files_value_stands_before_the_found_one() -> None:
    joint = load_joint(shipped("joint1.yaml"))
    found = replace(examples.two_causes(), joint_files={1: joint})
    text = text_of(render(found))
    viscous = found.causes[0].parameters["viscous_nms_per_rad"].value
    before = joint.friction.viscous_nms_per_rad
    assert f"{before:.2f} Nm s/rad → {viscous:.2f} Nm s/rad +{100.0 * (viscous / before - 1.0):.0f} %" in text
    assert "certain ΔBIC" in text
    assert "that it is one of 2" in text


def test_what_is_explained_left_over_and_odd_is_said() -> None:
    found = examples.one_cause()
    text = Page(render(found)).text.translate(PLAIN_SPACE)
    assert "0.296 Nm rms to the motor balance (current against sensor), 94 % of the structured gap" in text
    assert "57 times its jackknife standard error (leave one run out)" in text
    assert "0.18 % of rated" in text
    assert "joint 1, motor balance; it does not matter (from 0.200 Nm on it matters)" in text
    assert "Runs that differ from the others" in text
    assert found.outlier_runs[0].text in text
    assert found.unexplained is not None
    bad = replace(found, unexplained=replace(found.unexplained, matters=True), outlier_runs=())
    text = Page(render(bad)).text.translate(PLAIN_SPACE)
    assert "motor balance; it matters" in text
    assert "Runs that differ" not in text


def test_pictures_follow_the_page_into_the_dark(pages: dict[str, str]) -> None:
    svg = "".join(re.findall(r"<svg.*?</svg>", pages["one_cause"], re.DOTALL))
    fixed = {c.lower() for c in re.findall(r"#[0-9a-fA-F]{6}\b", svg)}
    assert not fixed - {"#ffffff"}, "a colour that stays the same in the dark"
    assert "var(--before)" in svg
    assert "var(--after)" in svg


def test_the_evidence_names_every_effect_chosen_first_then_class_then_by_evidence(
    pages: dict[str, str],
) -> None:
    findings = examples.two_causes()
    rows = evidence_views(findings.candidates)
    assert [(r.title, r.state) for r in rows[:4]] == [
        ("viscous friction", "chosen"),
        ("link inertia", "chosen"),
        ("channel delay", "class"),
        ("torque constant", ""),
    ]
    assert len(rows) == len(findings.candidates) == 49
    numbers = {(c.name, c.joint): c.delta_bic for c in findings.candidates}
    table = re.findall(
        r'<tr(?: class="\w+")?><th scope="row">([^<]+)</th><td>([^<]+)</td><td class="bic"',
        pages["two_causes"],
    )
    assert [(r.title, r.place) for r in rows] == table
    rest = [
        numbers[name, joint]
        for r in rows[3:]
        for name, joint in numbers
        if effect_title(name) == r.title
        and r.place == ("torque sensor" if joint == "sensor" else f"joint {joint}")
    ]
    known = [bic for bic in rest if math.isfinite(bic)]
    assert known == sorted(known, reverse=True)
    assert rest[: len(known)] == known, "unknown evidence comes last"
    assert all(r.reason for r in rows)


def test_the_plan_of_the_page_is_the_plan_of_the_findings(pages: dict[str, str]) -> None:
    experiment = examples.two_causes().next_experiment
    assert experiment is not None
    (plan,) = re.findall(r"<pre[^>]*>(.*?)</pre>", pages["two_causes"], re.DOTALL)
    assert yaml.safe_load(html.unescape(plan)) == experiment["plan"]
    seconds = 4 * 16 * 2.3
    assert f"4 runs, {seconds / 60:.2g} minutes of motion" in text_of(pages["two_causes"])
    assert str(experiment["why"]) in text_of(pages["two_causes"])
    assert "Next experiment" not in text_of(pages["one_cause"])


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
        ),
        made=evil,
    )
    assert evil not in page
    assert text_of(page).count(evil) >= 6


def peaks(svg: str, role: str) -> np.ndarray[Any, Any]:
    """Points [n, 2] of a curve of a picture."""
    (path,) = re.findall(rf'<g id="[^"]*{role}">\s*<path d="([^"]*)"', svg)
    return np.array(re.findall(r"[ML] (\S+) (\S+)", path), float)


def test_one_sample_that_stands_out_of_a_million_is_in_the_picture() -> None:
    n = 200_000
    time = np.arange(n) * 0.005
    before = 0.1 * np.sin(time)
    before[150_000] = 5.0
    trace = Trace("long", 1, "motor", time, before, 0.1 * np.sin(time), np.sin(time), 9 * np.cos(time))
    page = render(replace(examples.one_cause(), traces=(trace,)))
    svg = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(svg) == 2, "one for a laptop, one for a phone"
    for one in svg:
        points = peaks(one, "before")
        top = points[np.argmin(points[:, 1])]
        share = (top[0] - points[0, 0]) / (points[-1, 0] - points[0, 0])
        assert share == pytest.approx(0.75, abs=2e-3)
        calm = peaks(one, "after")
        assert np.ptp(calm[:, 1]) == pytest.approx(np.ptp(points[:, 1]) * 0.2 / 5.1, rel=0.25), (
            "not on one scale"
        )


def test_gaps_in_the_record_and_empty_records_are_drawn_without_a_word() -> None:
    base = examples.one_cause().traces[0]
    before = base.before_nm.copy()
    before[2000:4000] = np.nan
    nothing = np.full(len(before), np.nan)
    findings = examples.one_cause()
    page = render(
        replace(findings, traces=(replace(base, before_nm=before), replace(base, before_nm=nothing)))
    )
    assert page.count("<svg") == 4


def test_of_every_balance_the_run_in_the_middle_is_drawn_first() -> None:
    findings = examples.two_causes()
    drawn = chosen_traces(findings)
    assert len(drawn) == MOST
    assert [(t.joint, t.balance) for t in drawn[:4]] == [(g.joint, g.balance) for g in findings.gaps]
    parts = {
        t.run: 1.0 - float(np.sum(t.after_nm**2) / np.sum(t.before_nm**2))
        for t in findings.traces
        if (t.joint, t.balance) == (1, "motor")
    }
    assert sorted(parts, key=lambda run: -parts[run]).index(drawn[0].run) == 2, "of six"
    loudest = chosen_traces(examples.unexplained())[0]
    assert float(np.sum(loudest.before_nm**2)) == max(
        float(np.sum(t.before_nm**2)) for t in examples.unexplained().traces
    )


def test_ten_long_runs_of_two_joints_stay_a_small_page() -> None:
    random = np.random.default_rng(0)
    time = np.arange(0.0, 60.0, 0.005)
    traces = tuple(
        Trace(f"run_{k}.csv.gz", j, balance, time, *random.normal(0.0, 1.0, (4, len(time))))
        for k in range(10)
        for j in (1, 2)
        for balance in ("motor", "torsion")
    )
    page = render(replace(examples.two_causes(), traces=traces))
    assert len(page.encode()) < 1_500_000
    assert all(f"run_{k}.csv.gz" in text_of(page) for k in range(10)), (
        "runs that are not drawn are in the table"
    )


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
        env={"PYTHONHASHSEED": "1", "PATH": ""},
    ).stdout.strip()
    assert other == hashlib.sha256(pages["unexplained"].encode()).hexdigest()


def test_drawing_leaves_the_settings_of_others_alone() -> None:
    import matplotlib as mpl

    mpl.rcdefaults()
    before = dict(mpl.rcParams)
    render(examples.no_gap())
    changed = {key for key in before if mpl.rcParams[key] != before[key]}
    assert changed <= {"backend", "backend_fallback"}, "where pictures go, not how they look"
