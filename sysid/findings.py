"""What a fit noticed about runs or joint file: a name for programs, one line for people."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """kind: a fixed name, e.g. "torque_stuck"; text: one line with what was found and what was expected."""

    kind: str
    text: str
