"""The benches by name. Which one is for what was chosen before any result was seen: docs/diagnosis.md."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Final

from validation.worlds.measured_bench import MeasuredBench
from validation.worlds.mujoco_bench import MujocoBench
from validation.worlds.sets import Bench

BENCHES: Final[dict[str, Callable[[], Bench]]] = {"mujoco": MujocoBench, "measured": MeasuredBench}


def missing(name: str) -> str:
    """Return one line when this bench needs what is not installed, else an empty text."""
    if name == MujocoBench.name and importlib.util.find_spec("mujoco") is None:
        return (
            "--bench mujoco: found no mujoco, expected it installed: make setup, or pip install -e '.[dev]'"
        )
    return ""
