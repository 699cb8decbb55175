"""Colours of the report by role, light and dark. Pictures are drawn in the light ones and follow the page afterwards."""

from __future__ import annotations

import re
from typing import Final

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
}
TEXT: Final = ("ink", "soft", "before", "after", "good", "bad", "warn")
"""Roles that are written with, on `paper` and on `panel`."""


def variables(colours: dict[str, str]) -> str:
    """Return the declarations of the roles for a style sheet."""
    return " ".join(f"--{role}: {colour};" for role, colour in colours.items())


def by_role(svg: str) -> str:
    """Return a picture drawn in the light colours with references to their roles, so that it follows the page."""
    roles = {colour: role for role, colour in LIGHT.items()}
    return re.sub(
        r"#[0-9a-f]{6}\b",
        lambda m: f"var(--{roles[m[0]]})" if m[0] in roles else m[0],
        svg,
        flags=re.IGNORECASE,
    )


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio of two colours, 1 to 21 (WCAG 2.1: text needs 4.5)."""
    light, dark = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: str) -> float:
    shares = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
