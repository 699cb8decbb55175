"""The accuracy card as a page, as values for programs, and as lines for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from jtqd.sysid.evaluate.card import SCHEMA, Advice, Bin, Card, load_name
from jtqd.sysid.evaluate.card_figure import card_figure, source, tiles
from jtqd.sysid.evaluate.report import plain_values, table
from jtqd.sysid.report import page
from jtqd.sysid.report.figures import page_svg
from jtqd.sysid.runs.checks import RunIssue

_TEMPLATE: Final = "card.html.j2"


def card_html(
    cards: Sequence[Card], files: Mapping[int, Mapping[str, str]], findings: Sequence[RunIssue], made: str
) -> str:
    """Return the page; files: name to SHA-256, by joint. Needs jinja2 and matplotlib."""
    content = {
        "cards": [
            {
                "joint": card.joint,
                "title": f"method {card.method}",
                "source": source(card),
                "tiles": tiles(card),
                "advice": card.advice,
                "picture": page_svg(lambda card=card: card_figure(card), f"card-{card.number}"),  # type: ignore[misc]
                "files": sorted(files[card.number].items()),
            }
            for card in cards
        ],
        "findings": [f"{each.kind}: {each.text}" for each in findings],
        "made": made,
    }
    return page.render("jtqd.sysid.evaluate", _TEMPLATE, content)


def card_mapping(cards: Sequence[Card], findings: Sequence[RunIssue]) -> dict[str, Any]:
    """Return the cards for a program (schema jtq.accuracy/1); an axis that was not measured is an empty list."""
    joints = []
    for card in cards:
        values = card._asdict() | {
            "standstill": vars(card.standstill),
            "speed": [_bin(each) for each in card.speed],
            "load": [_bin(each) for each in card.load],
            "temperature": [_bin(each) for each in card.temperature],
            "cells": [[_bin(each) for each in row] for row in card.cells],
        }
        joints.append(values)
    found: dict[str, Any] = plain_values({"schema": SCHEMA, "joints": joints, "findings": list(findings)})
    return found


def _bin(each: Bin) -> dict[str, Any]:
    return each._asdict() | {"known": each.known}


def card_lines(card: Card) -> list[str]:
    """Return the card for a terminal."""
    lines = [f"{card.joint}: method {card.method}; {source(card)}"]
    lines += [
        f"  {title:<15}{value}{f' ({more})' if more else ''}".rstrip() for title, value, more in tiles(card)
    ]
    for title, bins, name in (
        ("speed", card.speed, lambda low, high: f"{low:g} to {high:g} rad/s"),
        ("load", card.load, load_name),
        ("temperature", card.temperature, lambda low, high: f"{low:g} to {high:g} degC"),
    ):
        rows = [
            [
                name(each.low, each.high),
                f"{each.error.rmse_nm:.3f}" if each.error is not None else "-",
                f"{100.0 * each.interval.share:.0f} %" if each.interval is not None else "-",
                str(each.runs),
                f"{each.seconds:.0f}",
            ]
            for each in bins
        ]
        if rows:
            lines += ["", *table([title, "RMSE [Nm]", "90 % interval", "runs", "seconds"], rows)]
    lines += ["", "  what to measure next", *_next(card.advice)]
    return lines


def _next(advice: Sequence[Advice]) -> list[str]:
    return [f"  - {each.text}" for each in advice] or [
        "  - nothing: every speed, load and temperature was measured"
    ]
