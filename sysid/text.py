"""Counted nouns for messages and reports."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return number and noun in agreement.

    >>> counted(1, "run"), counted(2, "run"), counted(0, "velocity", "velocities")
    ('1 run', '2 runs', '0 velocities')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
