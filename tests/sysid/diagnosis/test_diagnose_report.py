"""The report of a diagnosis: what it says is what the findings hold; one file, readable by all, nothing from outside."""

from __future__ import annotations

import base64
import hashlib
import html.parser
import itertools
import json
import os
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
from jtqd.sysid.diagnosis.findings import Provenance, Trace
from jtqd.sysid.diagnosis.report import effect_title, in_words, place, summary
from jtqd.sysid.report.numbers import number
from tests.sysid.diagnosis import findings_examples as examples

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from jtqd.sysid.diagnosis.report import MOST, chosen_traces, panels, pictures, render

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
def test_pictures_have_a_text_for_those_who_cannot_see_them(pages: dict[str, str], name: str) -> None:
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
    arrays = {
        "measured": trace.measured_nm,
        "before": trace.before_nm,
        "after": trace.after_nm,
        "velocity": trace.velocity_rad_s,
    }
    assert data["curves"].keys() == arrays.keys()
    for name, values in arrays.items():
        curve = data["curves"][name]
        whole = np.frombuffer(base64.b64decode(curve["values"]), "<i2")
        back = np.where(whole == -32768, np.nan, whole * curve["scale"])
        assert back == pytest.approx(values, abs=1e-4 * np.nanmax(np.abs(values)), nan_ok=True)
    assert data["start_s"] + data["step_s"] * (len(trace.time_s) - 1) == pytest.approx(trace.time_s[-1])


def test_a_figure_has_measurement_and_simulation_before_and_after_and_their_difference() -> None:
    trace = examples.two_causes().traces[0]
    lines = [[(line.curve, line.less) for line in panel.lines] for panel in panels(trace, both=True)]
    measured = ("measured", "")
    assert lines == [
        [measured, ("measured", "before")],
        [measured, ("measured", "after")],
        [("before", ""), ("after", "")],
        [("velocity", "")],
    ]
    assert [[line.curve for line in panel.lines] for panel in panels(trace, both=False)] == [
        ["measured", "measured"],
        ["before"],
        ["velocity"],
    ]


BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def in_a_browser(page: str, path: Path, script: str, width: int) -> str:
    """The page after the script has run in it; an error is its title."""
    errors = 'window.onerror = (text) => { document.title = "ERROR " + text; };'
    path.write_text(page.replace("</body>", f"<script>{errors}{script}</script></body>"), encoding="utf-8")
    assert BROWSER is not None
    profile = f"--user-data-dir={path.parent / 'profile'}"
    quiet = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        profile,
        "--virtual-time-budget=2000",
        "--dump-dom",
    )
    command = [BROWSER, *quiet, f"--window-size={width},1500", path.as_uri()]
    found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout
    assert "ERROR" not in found.partition("</title>")[0]
    return found


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_a_browser_draws_them(pages: dict[str, str], tmp_path: Path) -> None:
    """Dragging over a third of the first figure leaves a third of its run."""
    drag = """
    const svg = document.querySelector(".zoom svg"), box = svg.getBoundingClientRect();
    svg.setPointerCapture = () => {};
    const send = (kind, x) => svg.dispatchEvent(
      new PointerEvent(kind, { clientX: box.left + x, clientY: box.top + 40, pointerId: 1, bubbles: true }));
    send("pointerdown", 300); send("pointermove", 400); send("pointerup", 500);
    """
    found = in_a_browser(pages["one_cause"], tmp_path / "page.html", drag, 1000)
    assert found.count('class="live"') == found.count("<figure data-trace")
    assert re.search(r"[\d.]+ to [\d.]+ s; double click: whole run", found)


@pytest.mark.skipif(BROWSER is None, reason="no browser")
@pytest.mark.parametrize("width", [360, 600, 1000])
def test_the_legend_is_inside_the_figure(pages: dict[str, str], tmp_path: Path, width: int) -> None:
    measure = """
    setTimeout(() => {
      const inside = (t, box) => t.getBoundingClientRect().right < box.right && t.getBoundingClientRect().top >= box.top;
      const all = [...document.querySelectorAll(".zoom svg text.title")];
      const good = all.filter((t) => inside(t, t.ownerSVGElement.getBoundingClientRect()));
      document.title = `${good.length} of ${all.length} inside`;
    }, 500);
    """
    page = pages["one_cause"].replace("</head>", f"<style>body {{ width: {width}px; }}</style></head>")
    found = in_a_browser(page, tmp_path / "page.html", measure, 1000)
    inside = re.search(r"(\d+) of (\d+) inside</title>", found)
    assert inside is not None
    assert int(inside[1]) == int(inside[2]) > 0


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
    trace = Trace(
        "long", 1, "motor", time, before, 0.1 * np.sin(time), np.sin(time), *(2 * [9 * np.cos(time)])
    )
    page = render(replace(examples.one_cause(), traces=(trace,)))
    svg = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(svg) == 2, "one for a laptop, one for a phone"
    for one in svg:
        points = peaks(one, "before_2")
        top = points[np.argmin(points[:, 1])]
        share = (top[0] - points[0, 0]) / (points[-1, 0] - points[0, 0])
        assert share == pytest.approx(0.75, abs=2e-3)
        calm = peaks(one, "after_2")
        assert np.ptp(calm[:, 1]) == pytest.approx(np.ptp(points[:, 1]) * 0.2 / 5.1, rel=0.25), (
            "not on one scale"
        )


def test_gaps_in_the_record_and_empty_records_are_drawn_without_a_word() -> None:
    base = examples.one_cause().traces[0]
    before = base.before_nm.copy()
    before[2000:4000] = np.nan
    nothing = np.full(len(before), np.nan)
    traces = (replace(base, before_nm=before), replace(base, balance="torsion", before_nm=nothing))
    page = render(replace(examples.one_cause(), traces=traces))
    assert page.count("<svg") == 4


def test_the_worst_held_out_run_of_the_gains_balance_is_drawn_first_then_one_of_every_other() -> None:
    findings = examples.one_cause()
    drawn = chosen_traces(findings)
    assert [(t.joint, t.balance) for t in drawn] == [(1, "motor"), (1, "torsion")]
    assert drawn[0].run == "excitation_03.csv.gz"  # by the errors of Gain.runs
    assert pictures(findings)[0].title.endswith("the worst held-out run")
    assert findings.gain is not None
    torsion = replace(findings, gain=replace(findings.gain, balance="torsion"))
    assert chosen_traces(torsion)[0].balance == "torsion"
    alone = replace(findings, gain=None)
    loudest = chosen_traces(alone)[0]
    assert float(np.sum(loudest.before_nm**2)) == max(
        float(np.sum(t.before_nm**2)) for t in findings.traces if t.balance == "motor"
    )
    assert "held-out" not in pictures(alone)[0].title
    assert len(chosen_traces(examples.two_causes())) == MOST


def test_ten_long_runs_of_two_joints_stay_a_small_page() -> None:
    random = np.random.default_rng(0)
    time = np.arange(0.0, 60.0, 0.005)
    traces = tuple(
        Trace(f"run_{k}.csv.gz", j, balance, time, *random.normal(0.0, 1.0, (5, len(time))))
        for k in range(10)
        for j in (1, 2)
        for balance in ("motor", "torsion")
    )
    page = render(
        replace(examples.two_causes(), runs=tuple(f"run_{k}.csv.gz" for k in range(10)), traces=traces)
    )
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
