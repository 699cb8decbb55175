"""From which size the diagnosis would tell each effect on runs of a bench in which nothing is hidden, in newton metres.

    python -m validation smallest --bench measured --sets 4 --seed 1

Beside what these runs leave over as they are: of each effect the smallest size of the sets' findings (`minimum` of
`candidates` in findings.json) as its leading parameter and as torque, and as torque in percent of the rated; and what the
bench itself says is visible to somebody who knows what is hidden (`oracle.py`).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from jtqd.sysid.diagnosis.findings import CandidateEvidence, Findings
from validation.worlds.benches import BENCHES, missing
from validation.worlds.judge import judged
from validation.worlds.oracle import sizes
from validation.worlds.recorder import PRESETS
from validation.worlds.units import UNITS, rated_nm

FAILED: Final = 1


def rows_of(found: Findings, joints: Mapping[int, Mapping[str, object]]) -> dict[str, tuple[float, float]]:
    """Return per effect its smallest size relative to the joint (`units.Unit`) and in percent of rated torque, of the joint
    where it is least; infinite where no size shows.
    """
    out: dict[str, tuple[float, float]] = {}
    for c in found.candidates:
        joint = joints[c.joint if isinstance(c.joint, int) else min(joints)]
        if c.name in UNITS:
            new = (_size(c) / UNITS[c.name].of(joint), 100.0 * c.minimum_rms_nm / rated_nm(joint))
            out[c.name] = min(out.get(c.name, (math.inf, math.inf)), new, key=lambda row: row[1])
    return out


def _size(c: CandidateEvidence) -> float:
    """Return the size of the parameter that carries the effect, infinite where another one shows it first."""
    found = c.minimum.get(UNITS[c.name].parameter)
    return math.inf if found is None else found.value


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one row per effect: medians over the sets."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--bench", choices=sorted(BENCHES), required=True)
    parser.add_argument("--sets", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    if lacking := missing(options.bench):
        print(lacking, file=sys.stderr)
        return FAILED
    bench = BENCHES[options.bench]()
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    left = []
    for k in range(options.sets):
        drawn = bench.draw(1000 * options.seed + k)
        findings = judged(drawn.runs, drawn.joints, PRESETS["full"], k)
        for name, row in rows_of(findings, drawn.joints).items():
            found[name].append(row)
        if findings.unexplained is not None:
            left.append(100.0 * findings.unexplained.of_rated)
    print(
        f"{options.sets} sets with nothing hidden; unexplained, worst run: median {np.median(left):.2g} % of rated"
    )
    print(
        "| effect | smallest size told | as torque, % of rated rms | visible to the oracle | largest hidden |"
    )
    print("|---|---|---|---|---|")
    visible = sizes(options.bench)
    for name, rows in sorted(found.items(), key=lambda item: float(np.median([r[1] for r in item[1]]))):
        size, torque = (float(np.median([r[k] for r in rows])) for k in (0, 1))
        seen = ", ".join(f"{x:.2g}" for k, x in visible.items() if k.split()[0] == name) or "-"
        text = [f"{x:.2g}" if math.isfinite(x) else "-" for x in (size, torque)]
        print(f"| {name} | {text[0]} | {text[1]} | {seen} | {UNITS[name].largest:g} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
