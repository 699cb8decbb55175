"""One set of runs with something hidden in it: `draw`, `draw_many`, `write`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from validation.hidden.bench import Bench, integrate_together
from validation.hidden.order import RUNS, Hidden, Order
from validation.hidden.plant import Array
from validation.hidden.profiles import RUN_S, Motion, Reference

_BATCH: Final = (
    96  # benches side by side: more gain little and cost memory (0.9 MB per second of run and bench)
)


@dataclass(frozen=True)
class Case:
    """runs: columns of each run; joints: nominal joint files as mappings; truth: hidden effects {name, joint,
    parameters, size}, with `places` for what is in no library; motions: the references (for tests).
    """

    seed: int
    profile: str
    runs: list[dict[str, Array]]
    joints: dict[int, dict[str, Any]]
    truth: list[dict[str, Any]]
    motions: list[Motion] = field(repr=False, default_factory=list)

    @property
    def names(self) -> list[str]:
        """Names of the runs."""
        return [f"run{k + 1}" for k in range(len(self.runs))]


def draw(
    seed: int,
    effects: Sequence[Hidden | tuple[Any, ...]] = (),
    profile: str = "mixed",
    *,
    runs: int = RUNS,
    duration_s: float = RUN_S,
    quiet: bool = False,
) -> Case:
    """Return one set of runs.

    effects: `Hidden` or (name, joint, size). The same seed gives the same joints, motions, drift and noise whatever is
    hidden. quiet: without drift, noise and quantisation, for tests of the generator.
    """
    return draw_many([Order(seed, effects, profile, runs, duration_s, quiet)])[0]


def draw_many(orders: Sequence[Order]) -> list[Case]:
    """Return one case per order; all benches of equal duration are integrated side by side."""
    if len({order.duration_s for order in orders}) > 1:
        raise ValueError("duration_s: found different durations, expected one per batch")
    benches = [Bench(order) for order in orders]
    flat = [(one, k) for one in benches for k in range(order_runs(one))]
    for first in range(0, len(flat), _BATCH):
        integrate_together(flat[first : first + _BATCH])
    return [_case(one) for one in benches]


def order_runs(bench: Bench) -> int:
    """Return how many runs a bench makes."""
    return len(bench.motions)


def follow_up(order: Order, references: Sequence[Reference]) -> list[dict[str, Array]]:
    """Return further runs of the bench of this order, driven as somebody asks for: one table per reference.

    The same joints with the same things hidden, on other days; the runs may be of different lengths.
    """
    bench = Bench(order, references)
    integrate_together([(bench, k) for k in range(len(references))])
    tables = _case(bench).runs
    counts = [len(r.velocity_rad_s) for r in references]
    return [{k: x[:n] for k, x in t.items()} for t, n in zip(tables, counts, strict=True)]


def _case(bench: Bench) -> Case:
    order = bench.order
    tables = [t for t in bench.tables if t is not None]
    joints = {1: bench.joints[0], 2: bench.joints[1]}
    return Case(order.seed, order.profile, tables, joints, bench.truth, bench.motions)


def write(case: Case, directory: Path | str) -> None:
    """Write run1.csv.., joint1.yaml, joint2.yaml and truth.json."""
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for name, columns in zip(case.names, case.runs, strict=True):
        table = np.column_stack(list(columns.values()))
        np.savetxt(folder / f"{name}.csv", table, "%.9g", ",", header=",".join(columns), comments="")
    for number, joint in case.joints.items():
        (folder / f"joint{number}.yaml").write_text(yaml.safe_dump(joint, sort_keys=False), encoding="utf-8")
    truth = {"seed": case.seed, "profile": case.profile, "effects": case.truth}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
