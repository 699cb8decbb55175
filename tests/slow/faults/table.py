"""Outcomes as lines, JSON and the table of docs/testing.md."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tests.slow.faults.runner import Outcome


def as_json(outcome: Outcome) -> dict[str, Any]:
    """One outcome."""
    return {
        "case": outcome.case.key,
        "title": outcome.case.title,
        "injected": outcome.case.injected,
        "proof": outcome.proof,
        "status": [sorted(outcome.one), sorted(outcome.two)],
        "emcy": [f"{code:04X}h" for code in sorted(outcome.emcy)],
        "counters": outcome.counters,
        "noticed_ms": outcome.noticed_ms,
        "recovered_ms": outcome.recovered_ms,
        "quiet_ms": outcome.quiet_ms,
        "ok": not outcome.wrong,
        "wrong": list(outcome.wrong),
        "note": outcome.case.note,
    }


def cells(outcome: Outcome) -> list[str]:
    """Cells of the table."""
    seen = as_json(outcome)
    statuses = [",".join(map(str, each)) or "-" for each in seen["status"]]
    expected = outcome.case.counters
    counters = {name: n for name, n in outcome.counters.items() if name in expected} or outcome.counters
    return [
        outcome.case.key,
        outcome.case.title,
        outcome.case.injected,
        outcome.proof,
        " / ".join(statuses) if statuses != ["-", "-"] else "-",
        " ".join(seen["emcy"]) or "-",
        ", ".join(f"{name} {n}" for name, n in counters.items()) or "-",
        _ms(outcome.noticed_ms),
        _ms(outcome.recovered_ms) if outcome.one or outcome.two else "-",
        "OK" if seen["ok"] else "NOT",
    ]


HEAD = (
    "case",
    "fault",
    "injected",
    "proof",
    "status 1 / 2",
    "EMCY",
    "counters",
    "noticed",
    "recovered",
    "",
)


def line(outcome: Outcome) -> str:
    """One line for a terminal, and one for each thing that is wrong."""
    key, title, _, proof, status, emcy, counters, noticed, recovered, verdict = cells(outcome)
    text = f"{key:>4} {title:46.46} {status:12} {emcy:22} {noticed:>9} {recovered:>9} {verdict:3} {counters}"
    return "\n".join([text, f"       {proof}", *(f"       {each}" for each in outcome.wrong)])


def row(texts: Iterable[str]) -> str:
    """One row of the table in docs/testing.md."""
    return "| " + " | ".join(texts) + " |"


def _ms(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.1f} ms" if value < 100.0 else f"{value / 1000.0:.2f} s"
