"""Base template and colours of every HTML report: one self-contained file, light and dark."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

LIGHT: Final = {
    "paper": "#ffffff",
    "panel": "#f4f6f9",
    "ink": "#1b2430",
    "soft": "#556070",
    "line": "#d5dbe3",
    "before": "#b5541a",
    "after": "#1a6cb0",
    "noise": "#dfe4ea",
    "good": "#17774a",
    "bad": "#b02a20",
    "warn": "#8a5b00",
    "series_1": "#c0392b",
    "series_2": "#9a6a00",
    "series_3": "#7d3c98",
    "series_4": "#1f7a50",
    "series_5": "#1565a7",
}
DARK: Final = {
    "paper": "#12161c",
    "panel": "#1b212a",
    "ink": "#e7ebf1",
    "soft": "#a5b0be",
    "line": "#333c48",
    "before": "#ec9f62",
    "after": "#6ab2f2",
    "noise": "#2a323d",
    "good": "#63cd96",
    "bad": "#ff8d82",
    "warn": "#e5b64c",
    "series_1": "#ff8677",
    "series_2": "#e0b040",
    "series_3": "#c99be0",
    "series_4": "#5fc793",
    "series_5": "#72b4f0",
}
TEXT: Final = ("ink", "soft", "before", "after", "good", "bad", "warn")
"""Roles that are written with, on `paper` and on `panel`."""


def render(
    package: str,
    template: str,
    content: Mapping[str, Any],
    filters: Mapping[str, Callable[..., Any]] | None = None,
) -> str:
    """Return the HTML page of a template that extends "base.html.j2".

    Args:
        package: that the template lies in.
        template: its file name.
        content: variables of the template; `made`, when and by what the page was made, goes to its foot.
        filters: filters of the template.

    Raises:
        ImportError: jinja2 is not installed.
        jinja2.UndefinedError: the template uses a variable that `content` does not have.
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(each, ".") for each in (package, "jtqd.sysid.report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters or {})
    page = environment.get_template(template)
    return f"{page.render(light=variables(LIGHT), dark=variables(DARK), **content)}\n"


def variables(colours: dict[str, str]) -> str:
    """Return the declarations of the roles for a style sheet."""
    return " ".join(f"--{role}: {colour};" for role, colour in colours.items())


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours, 1 to 21 (WCAG 2.1: text needs 4.5)."""
    light, dark = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: str) -> float:
    shares = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
