"""The page and the figures of a batch, from results alone."""

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from jtqd.sysid.batch.command import DONE, FAILED, KEPT, Group, Row, counts, figures_of, render, to_mapping


def diagnosis(verdict="cause", rmse=1.25, *causes):
    return {
        "verdict": verdict,
        "gap": {"joint": 1, "rmse_nm": rmse, "noise_floor_nm": 0.2},
        "gain": {"rmse_after_nm": 0.3},
        "causes": [
            {"name": names[0], "joint": joint, "class": list(names), "parameters": {}}
            for joint, names in causes
        ],
    }


def run_of(identity, largest=0.5, sensor=(0.4, 0.6)):
    joints = [
        {"max_nm": largest, "sensor_logged_nm": sensor[0], "sensor_replayed_nm": sensor[1]},
        {"max_nm": None, "sensor_logged_nm": None, "sensor_replayed_nm": None},
    ]
    return {"seconds": 5.0, "cycles": 5000, "identity": identity, "joints": joints}


def identity(identical, explained=True):
    return {"identical": identical, "bit_identical": identical == 5000, "explained": explained}


def row(name, result, state=DONE, error=""):
    content = None if result is None else {"exit_status": 3, "result": result, "files": ["report.html"]}
    key = None if result is None else f"key-{name}"
    return Row(Group(name, (Path("/logs") / name,)), state, key, content, error, 2.0)


class Page(HTMLParser):
    """Texts, and whether every element is closed."""

    VOID = frozenset({"meta", "br", "link"})

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.links = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data.strip())


def test_figures_of_a_diagnosis():
    ripple, gain = (2, ("torque_ripple",)), ("sensor", ("sensor_gain", "torque_constant"))
    made = figures_of("diagnose", row("a", diagnosis("ambiguous", 1.25, ripple, gain)))
    assert made.badge == ("warn", "ambiguous")
    assert made.cells[:3] == ("1.25", "0.2", "0.3")
    assert made.causes == ("torque ripple (joint 2)", "sensor gain or torque constant (torque sensor)")
    assert made.gap_nm == 1.25
    assert made.values["causes"][1]["class"] == ["sensor_gain", "torque_constant"]


@pytest.mark.parametrize(
    ("identities", "badge"),
    [
        ([identity(5000), identity(5000)], ("good", "identical")),
        ([identity(5000), identity(4000)], ("good", "identical, differences explained")),
        ([identity(5000), identity(4999, explained=False)], ("warn", "differs")),
        ([None], ("after", "other models")),
    ],
)
def test_figures_of_a_replay(identities, badge):
    made = figures_of("replay", row("a", {"runs": [run_of(each) for each in identities]}))
    assert made.badge == badge
    assert made.gap_nm == 0.5
    assert made.cells[3] == "0.4 → 0.6"
    assert made.values["cycles"] == 5000 * len(identities)


def test_the_largest_difference_of_several_runs_counts():
    made = figures_of(
        "replay", row("a", {"runs": [run_of(None, 0.5, (0.4, 0.9)), run_of(None, 0.7, (0.8, 0.6))]})
    )
    assert made.gap_nm == 0.7
    assert made.cells[3] == "0.8 → 0.9"


def test_the_page_shows_every_group_failed_ones_first_and_then_by_gap():
    rows = [
        row("small", diagnosis("no_gap", 0.5)),
        row("large", diagnosis("cause", 2.0, (1, ("torque_ripple",)))),
        row("old", diagnosis("cause", 1.0, (1, ("torque_ripple",))), KEPT),
        row("<b>&", None, FAILED, "x.csv: <script>"),
    ]
    text = render("diagnose", rows, "this machine", "today")
    page = Page(text)
    assert page.open == []
    assert page.links == [
        "results/key-large/report.html",
        "results/key-old/report.html",
        "results/key-small/report.html",
    ]
    order = [page.texts.index(name) for name in ("<b>&", "large", "old", "small")]
    assert order == sorted(order)
    assert "x.csv: <script>" in page.texts, "escaped"
    assert page.texts[page.texts.index("torque ripple (joint 1)") + 1] == "2", "in two groups"
    assert "2.0 s, earlier" in page.texts
    assert 'style="width:50%"' in text, "of the largest gap"
    assert "@import" not in text
    assert "url(" not in text


def test_a_page_of_failures_only():
    page = Page(render("replay", [row("a", None, FAILED, "no")], "here", "today"))
    assert "no" in page.texts


def test_summary_is_plain():
    rows = [row("a", diagnosis()), row("b", None, FAILED, "why")]
    mapping = json.loads(
        json.dumps(to_mapping("diagnose", {"joint": {"0": "h"}}, "1.2.3", rows, "here"), allow_nan=False)
    )
    assert mapping["counts"] == counts(rows) == {"groups": 2, "done": 1, "kept": 0, "failed": 1}
    assert [group["error"] for group in mapping["groups"]] == [None, "why"]
    assert mapping["groups"][0]["figures"]["verdict"] == "cause"
    assert mapping["groups"][0]["logs"] == ["/logs/a"]
