"""Numbers of a command line: argparse types whose refusals say what was found and what was expected."""

from __future__ import annotations

import argparse
import math


def seconds(text: str) -> float:
    """A time in seconds, > 0 and below 1e9 (30 years). Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time in seconds > 0")
    return value


def count(text: str) -> int:
    """A whole number >= 1. Raises argparse.ArgumentTypeError."""
    return _whole(text, 1)


def natural(text: str) -> int:
    """A whole number >= 0. Raises argparse.ArgumentTypeError."""
    return _whole(text, 0)


def _whole(text: str, low: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if value < low:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number >= {low}")
    return value
