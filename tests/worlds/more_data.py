"""Does more data make a diagnosis worse? The runs of a set are given one more at a time; one is held out of all.

    python -m tests.worlds.more_data --bench measured --sets 10 --seed 1

A cause that is named alone on k runs must be named on k + 1 (alone or in a class), or else the findings on k + 1 runs
predict the held-out run better and their reasons say what became of it. Exit status 0: so in all sets, 3: not.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.diagnosis.findings import Findings
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, contribution
from jtqd.sysid.diagnosis.signals import BaseLoss, joint_signals
from tests.worlds.benches import BENCHES, missing
from tests.worlds.campaign import Counts, jobs
from tests.worlds.judge import judged
from tests.worlds.recorder import PRESETS, Recorder
from tests.worlds.sets import SENSOR, Columns, Set

REACHED, FAILED, MISSED = 0, 1, 3
FEWEST = 4
"""With fewer runs other rules hold (docs/diagnosis.md, Fewer than four runs)."""


@dataclass(frozen=True)
class Step:
    """From `runs` runs to one more: what was named alone and is not any more, error on the held-out run with either."""

    runs: int
    lost: tuple[str, ...]
    unsaid: tuple[str, ...]
    fewer_nm: float
    more_nm: float

    @property
    def worse(self) -> bool:
        """Return whether a cause went without a better prediction, or without a word."""
        return bool(self.lost) and (self.more_nm >= self.fewer_nm or bool(self.unsaid))


def step(
    runs: int, fewer: Findings, more: Findings, held_out: Columns, joints: Mapping[int, Mapping[str, Any]]
) -> Step:
    """Return what one more run changes."""
    still = {(c.name, c.joint) for c in more.causes}
    in_classes = " ".join(name for c in more.causes for name in c.names[1:])
    lost = tuple(
        c.name
        for c in fewer.causes
        if len(c.names) == 1 and (c.name, c.joint) not in still and c.name not in in_classes
    )
    said = " ".join(more.reasons).replace(" ", "_")
    unsaid = tuple(name for name in lost if name not in said)
    if not lost:
        return Step(runs, (), (), float("nan"), float("nan"))
    return Step(
        runs, lost, unsaid, held_out_rms(fewer, held_out, joints), held_out_rms(more, held_out, joints)
    )


def held_out_rms(findings: Findings, run: Columns, joints: Mapping[int, Mapping[str, Any]]) -> float:
    """Return the error [Nm rms] of the joint files with the findings' causes on a run, over all balances that it has."""
    square, count = 0.0, 0
    numbers = {n: JointColumns(**{x: run.get(f"j{n}.{x}") for x in COLUMN_NAMES}) for n in joints}
    table = RunTable(run["time_s"], numbers)
    for number, mapping in joints.items():
        effects = [
            {"name": c.name, "parameters": {k: v.value for k, v in c.parameters.items()}}
            for c in findings.causes
            if c.joint in (number, SENSOR)
        ]
        joint = Joint.from_mapping({**mapping, "effects": effects}, f"joint{number}")
        signals = joint_signals("held out", table, number, joint, BaseLoss(joint))
        samples = bin_samples([signals])
        for balance, residual in (("motor", signals.motor_nm), ("torsion", signals.torsion_nm)):
            if residual is None:
                continue
            left = residual
            for effect in joint.effects:
                there = contribution(EFFECTS[effect.name], effect.parameters, signals)
                left = left - there.get(balance, 0.0)
            means = binned(left, samples)
            means = means[all_in_bin(signals.moving, samples)] if balance == "motor" else means - means.mean()
            square += float(means @ means)
            count += len(means)
    return float(np.sqrt(square / max(count, 1)))


def steps(drawn: Set, recorder: Recorder, seed: int, fewest: int = FEWEST) -> list[Step]:
    """Return the steps from `fewest` runs to all but the last, which is held out."""
    held_out = drawn.runs[-1]
    findings = [judged(drawn.runs[:k], drawn.joints, recorder, seed) for k in range(fewest, len(drawn.runs))]
    return [step(fewest + k, a, b, held_out, drawn.joints) for k, (a, b) in enumerate(pairwise(findings))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what became of the causes, set by set."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--bench", choices=sorted(BENCHES), required=True)
    parser.add_argument("--sets", type=int, default=10)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--recorder", choices=sorted(PRESETS), default="full")
    options = parser.parse_args(arguments)
    if lacking := missing(options.bench):
        print(lacking, file=sys.stderr)
        return FAILED
    bench = BENCHES[options.bench]()
    chosen = [j for j in jobs(bench, options.seed, Counts()) if j.kind in ("single", "pair")][: options.sets]
    worse = 0
    for job in chosen:
        drawn = bench.draw(job.seed, job.hidden)
        for each in steps(drawn, PRESETS[options.recorder], job.seed):
            worse += each.worse
            became = "kept" if not each.lost else f"lost {', '.join(each.lost)}"
            if each.lost:
                became += f"; held-out error {each.fewer_nm:.3f} -> {each.more_nm:.3f} Nm"
                became += f"; not a word about {', '.join(each.unsaid)}" if each.unsaid else ""
            print(f"{job.key} {each.runs} -> {each.runs + 1} runs: {became}", flush=True)
    print(f"bench {options.bench}, seed {options.seed}: worse in {worse} of {len(chosen)} sets")
    return MISSED if worse else REACHED


if __name__ == "__main__":
    sys.exit(main())
