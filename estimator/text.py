"""Numbers, percentages, sizes, durations, tables and hashes as text. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, Final

NOTHING: Final = "-"
"""Shown in place of a number that is not known."""
_CONTROL: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
_BYTES: Final = ("B", "kB", "MB", "GB", "TB")


def printable(text: str) -> str:
    """Return a text as a terminal may get it: "?" for control characters but newline and tab, and for half characters."""
    return _CONTROL.sub("?", text)


def finite(value: float) -> float | None:
    """Return the number, or None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return number and noun in agreement.

    >>> counted(1, "run"), counted(2, "run"), counted(0, "velocity", "velocities")
    ('1 run', '2 runs', '0 velocities')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def number(value: float, decimals: int = 2) -> str:
    """Return a number with fixed decimals, "-" if it is not known."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else NOTHING


def percent(share: float, decimals: int = 1) -> str:
    """Return a share in percent: 0.848 is "84.8 %"; "-" if it is not known."""
    return f"{100 * share:.{decimals}f} %" if math.isfinite(share) else NOTHING


def size(count: int | None) -> str:
    """Return bytes in decimal units with three digits, "-" for None."""
    if count is None:
        return NOTHING
    power = 0
    while count >= 999.5 * 1000**power and power < len(_BYTES) - 1:
        power += 1
    value = count / 1000**power
    return f"{value:.0f} {_BYTES[power]}" if value >= 100 or not power else f"{value:.3g} {_BYTES[power]}"


def duration(seconds: float) -> str:
    """Return a duration with at most two units: "45 ms", "2.3 s", "12 min 31 s", "3 h 05 min", "2 d 04 h"."""
    if not math.isfinite(seconds):
        return NOTHING
    if seconds < 0.9995:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 86400} d {whole % 86400 // 3600:02d} h"


def table_lines(
    rows: Sequence[Sequence[str]], left: Container[int] = (0,), *, rule: bool = False
) -> list[str]:
    """Return the lines of a table with columns as wide as they must be.

    rows: the first has the headings. left: columns that are aligned to the left. rule: a line below the headings.

    >>> table_lines([["joint", "Nm"], ["1", "2.5"]])
    ['joint   Nm', '1      2.5']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    head, *body = rows
    return [
        "  ".join(
            cell.ljust(width) if n in left else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *([["-" * width for width in widths]] if rule else []), *body)
    ]


def _implementation() -> Any:
    """Return `sha256` of CPython up to 3.11, from 3.12 on, or of any other Python."""
    for module in ("_sha256", "_sha2"):
        with suppress(ImportError):
            return import_module(module).sha256
    return import_module("hashlib").sha256


sha256: Final = _implementation()


def sha256_hex(data: bytes) -> str:
    """Return the SHA-256 of some bytes in hexadecimal."""
    return str(sha256(data).hexdigest())
