"""What to draw: which effects on which joint, and how many runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from validation.hidden.menu import Size
from validation.hidden.profiles import RUN_S

RUNS: Final = 6


@dataclass(frozen=True)
class Hidden:
    """One effect to hide: joint 1, 2 or "sensor"; size as `menu.parameters` takes it; fixed: further parameters."""

    name: str
    joint: int | str = 1
    size: Size = None
    fixed: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Order:
    """What to draw: see `case.draw`."""

    seed: int
    effects: Sequence[Hidden | tuple[Any, ...]] = ()
    profile: str = "mixed"
    runs: int = RUNS
    duration_s: float = RUN_S
    quiet: bool = False
