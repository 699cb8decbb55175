"""The figures of the hidden-effect campaign, drawn afresh on each run: `make test-all`.

A figure fails when it is missed by more than chance: its 95 % interval does not reach the target.
"""

from __future__ import annotations

import numpy as np
import pytest

from validation.hidden.campaign import run
from validation.hidden.figures import failures, figures, table

TRIALS = 50
TARGETS = {
    "hidden effect at 3x its minimum": ("at least", 0.95),
    "wrong single name": ("at most", 0.02),
    "nothing hidden": ("at most", 0.01),
    "two effects at once": ("at least", 0.85),
    "not in the library": ("at least", 0.90),
    "gain, as share": ("at least", 0.90),
}


@pytest.mark.campaign
def test_figures_are_reached() -> None:
    seed = int(np.random.default_rng().integers(10**6))
    outcomes = run(TRIALS, seed)
    rows = figures(outcomes)
    print(f"seed {seed}\n{table(rows)}\n" + "\n".join(failures(outcomes)))
    for start, (side, target) in TARGETS.items():
        (row,) = (r for r in rows if r.what.startswith(start))
        assert (row.high >= target) if side == "at least" else (row.low <= target), row
    (covered,) = (r for r in rows if r.what.startswith("95 % intervals"))
    assert covered.high >= 0.90
    assert covered.low <= 0.98
