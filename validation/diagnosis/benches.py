"""The benches that share nothing with the project's plant, and how large an effect must be there to be visible.

Which bench is for what was chosen before any result was seen: docs/diagnosis.md, "Second opinions".
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

from validation.diagnosis.entries import ENTRIES, Hidden, Set
from validation.diagnosis.measured_bench import MeasuredBench
from validation.diagnosis.mujoco_bench import MujocoBench

FILE: Final = Path(__file__).with_name("visible.json")
"""Visible sizes by bench and effect, frozen by the study `oracle`."""


class Bench(Protocol):
    """What trials need of a bench.

    foreign: kinds that are in no library. real: with nothing hidden there may still be something in its runs: every set is
    judged beside the set with nothing hidden of the same seed.
    """

    name: str
    real: bool
    effects: Sequence[str]
    foreign: Sequence[str]

    def draw(self, seed: int, hidden: Sequence[Hidden] = (), *, quiet: bool = False) -> Set:
        """Return the set of this seed: same joints, motions, noise and changes from run to run whatever is hidden.

        quiet: without noise, quantisation and changes from run to run.
        """

    def unseen(self) -> Bench:
        """Return the bench with what its joint files leave in runs that they were not fitted to; itself if to none."""

    def places(self, name: str) -> Sequence[int | str]:
        """Return where an effect can be: at joints, or at the sensor."""

    def variants(self, name: str) -> Sequence[str]:
        """Return the variants of an effect, one empty text where it has none."""


BENCHES: Final[dict[str, Callable[[], Bench]]] = {"mujoco": MujocoBench, "measured": MeasuredBench}


def bench_option(parser: argparse.ArgumentParser, *more: str, required: bool = True) -> None:
    """Add --bench to the options of a study; more: further names."""
    parser.add_argument("--bench", choices=sorted([*BENCHES, *more]), required=required)


def made(name: str) -> Bench:
    """Return a bench; ModuleNotFoundError with one line where it needs what is not installed."""
    if name == MujocoBench.name and importlib.util.find_spec("mujoco") is None:
        raise ModuleNotFoundError(
            "--bench mujoco: found no mujoco, expected it installed: make setup, or pip install -e '.[dev]'"
        )
    return BENCHES[name]()


def key(name: str, variant: str = "") -> str:
    """Return what an effect's size is kept under."""
    return f"{name} of {variant}" if variant else name


def sizes(bench: str) -> dict[str, float]:
    """Return the frozen visible sizes of a bench."""
    found: dict[str, float] = json.loads(FILE.read_text(encoding="utf-8"))[bench]
    return found


def hidden_size(bench: str, name: str, factor: float, variant: str = "") -> float | None:
    """Return `factor` times the visible size; None where a joint of that size would be broken, not badly modelled."""
    size = sizes(bench).get(key(name, variant))
    if size is None or factor * size > ENTRIES[name].bench.largest:
        return None
    return factor * size
