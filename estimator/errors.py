"""Errors of an operator's input: one line that names file, key, what was found and what was expected."""

from __future__ import annotations

import reprlib
from typing import Final

from jtqd.estimator.text import printable

_LONGEST: Final = 2000


class OneLineError(ValueError):
    """An error whose message is one line of bounded length, whatever names and texts of files it quotes."""

    def __init__(self, message: str) -> None:
        line = printable(message).replace("\n", "?")
        super().__init__(line if len(line) <= _LONGEST else f"{line[:_LONGEST]}...")


class ConfigError(OneLineError):
    """An operator's input cannot be used; the message is one line: file and key, what was found, what was expected."""


_SHORT: Final = reprlib.Repr()
"""YAML's aliases can make a list of lists without end out of a few bytes: repr() would fill the memory with it."""
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict, _SHORT.maxset = 3, 20, 20, 20
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 200


class Verbatim(str):
    """A description of what was found: a message shows it without quotes."""

    __slots__ = ()


def shown(value: object) -> str:
    """Return a value as messages show it: its repr, shortened; a `Verbatim` as it is."""
    if isinstance(value, Verbatim):
        return value
    text = _SHORT.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def number_as_text(value: object) -> str:
    """Return an explanation for a number that arrived as text: YAML 1.1 needs a point and a signed exponent."""
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return ""
        return " (YAML reads this as text: write 7.0e-5, not 7e-5, and no quotes)"
    return ""


def range_text(kind: str, low: float | None, high: float | None, above: float | None) -> str:
    """Return a kind of number with its range in words."""
    if low is not None and high is not None:
        return f"{kind} from {_bound(low)} to {_bound(high)}"
    if low is not None:
        return f"{kind} >= {_bound(low)}"
    if above is not None:
        return f"{kind} > {_bound(above)}" + (f" and <= {_bound(high)}" if high is not None else "")
    return f"{kind} <= {_bound(high)}" if high is not None else kind


def in_unit(unit: str) -> str:
    """Return " in UNIT", nothing for a number without one."""
    return f" in {unit}" if unit not in {"", "1"} else ""


def _bound(value: float) -> str:
    """Whole numbers in full: 1000000 and not 1e+06, where the operator counts bits or nodes."""
    return str(value) if isinstance(value, int) else f"{value:g}"
