"""The page that all reports share: colours, template, figures that follow it."""

from __future__ import annotations

import re

import pytest

from jtqd.sysid.report import page
from jtqd.sysid.report.page import page_svg

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from matplotlib import pyplot as plt

TEXT = ("ink", "soft", "before", "after", "good", "bad", "warn")
"""Roles that are written with, on `paper` and on `panel`."""


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours, 1 to 21 (WCAG 2.1: text needs 4.5)."""
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    shares = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_text_is_readable_on_its_ground_in_light_and_dark() -> None:
    for colours in (page.LIGHT, page.DARK):
        for role in TEXT:
            for ground in ("paper", "panel"):
                assert contrast(colours[role], colours[ground]) >= 4.5, (role, ground)
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert page.LIGHT.keys() == page.DARK.keys()


def test_series_are_told_apart_from_the_ground() -> None:
    for colours in (page.LIGHT, page.DARK):
        for role in (each for each in colours if each.startswith("series_")):
            assert contrast(colours[role], colours["paper"]) >= 3.0, role


def test_content_is_escaped_and_a_missing_variable_is_an_error() -> None:
    content = {
        "command": "diagnose",
        "where": "<here>",
        "made": "today & now",
        "counts": {"groups": 1, "done": 1, "kept": 0, "failed": 0},
        "headings": ("gap, Nm",),
        "gap": "",
        "lines": (),
        "badges": (),
        "causes": (),
        "logs": 1,
        "seconds": 1.0,
    }
    text = page.render("jtqd.sysid.batch", "summary.html.j2", content)
    assert "&lt;here&gt;" in text
    assert "today &amp; now" in text
    assert "--before: #ec9f62;" in text
    del content["logs"]
    with pytest.raises(Exception, match="'logs' is undefined"):
        page.render("jtqd.sysid.batch", "summary.html.j2", content)


def test_a_figure_takes_the_colours_of_the_page_and_ids_of_its_own() -> None:
    def draw() -> object:
        figure, axis = plt.subplots()
        axis.plot([0.0, 1.0], [1.0, 0.0], color=page.LIGHT["before"])
        return figure

    svg = page_svg(draw, "one")
    assert "var(--before)" in svg
    ids = re.findall(r'\bid="([^"]*)"', svg)
    assert ids
    assert all(each.startswith("one-") for each in ids)
    assert set(re.findall(r"url\(#([^)]*)\)", svg)) <= set(ids)
    assert page_svg(lambda: None, "none") == ""
