"""The benches by name. Which one is for what was chosen before any result was seen: docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from tests.worlds.measured_bench import MeasuredBench
from tests.worlds.mujoco_bench import MujocoBench
from tests.worlds.sets import Bench

BENCHES: Final[dict[str, Callable[[], Bench]]] = {"mujoco": MujocoBench, "measured": MeasuredBench}
