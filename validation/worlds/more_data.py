"""Does more data make a diagnosis worse? The runs of a set are given one more at a time; one is held out of all.

    python -m validation more_data --bench measured --sets 10 --seed 1

From two runs on, a cause that is named alone on k runs is named on k + 1 (alone or in a class), or else a line says what
became of it and what the held-out runs say of it (`jtqd.sysid.diagnosis.fewer_runs`). For each cause that goes the error on
the run held out of all is printed with it and without. Bench `own` is the generator in validation/hidden, `measured` the
Kinova runs that ship. Exit status 0: so in all sets, 3: not.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any, Final

import numpy as np

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.diagnosis.base_loss import BaseLoss
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Cause, Findings, joint_text
from jtqd.sysid.diagnosis.leave_one_out import FALL
from jtqd.sysid.diagnosis.regressors import all_in_bin, bin_samples, binned, contribution
from jtqd.sysid.diagnosis.signals import joint_signals
from validation.hidden.case import draw_many
from validation.hidden.order import Order
from validation.hidden.trials import joint_files, orders_of, tables
from validation.worlds.benches import BENCHES, missing
from validation.worlds.campaign import Counts, jobs
from validation.worlds.judge import judged
from validation.worlds.recorder import PRESETS, Recorder
from validation.worlds.sets import SENSOR, Columns, Set

REACHED, FAILED, MISSED = 0, 1, 3
FEWEST: Final = 2
OWN: Final = "own"


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
        """Return whether a cause went without a word."""
        return bool(self.unsaid)

    @property
    def missed(self) -> bool:
        """Return whether the held-out run is clearly better predicted by what fewer runs said."""
        return bool(self.lost) and self.fewer_nm**2 < (1.0 - FALL) * self.more_nm**2

    @property
    def text(self) -> str:
        """What became of the causes."""
        if not self.lost:
            return "kept"
        word = f"; not a word about {', '.join(self.unsaid)}" if self.unsaid else "; said"
        error = f"{self.fewer_nm:.3f} -> {self.more_nm:.3f} Nm"
        return f"{', '.join(self.lost)} went; held-out error {error}{word}"


def step(
    runs: int, fewer: Findings, more: Findings, held_out: Columns, joints: Mapping[int, Mapping[str, Any]]
) -> Step:
    """Return what one more run changes."""
    still = {(c.name, c.joint) for c in more.causes}
    in_classes = " ".join(name for c in more.causes for name in c.names[1:])
    gone = [
        c
        for c in fewer.causes
        if len(c.names) == 1 and (c.name, c.joint) not in still and c.name not in in_classes
    ]
    if not gone:
        return Step(runs, (), (), float("nan"), float("nan"))
    return Step(
        runs,
        tuple(c.name for c in gone),
        tuple(c.name for c in gone if not any(_says(line, c) for line in more.reasons)),
        held_out_rms(fewer, held_out, joints),
        held_out_rms(more, held_out, joints),
    )


def _says(line: str, cause: Cause) -> bool:
    """Return whether a line is about an effect: by its name, and by its joint where the line names one."""
    return f"{cause.name} of {joint_text(cause.joint)}" in line


def held_out_rms(findings: Findings, run: Columns, joints: Mapping[int, Mapping[str, Any]]) -> float:
    """Return the error [Nm rms] of the joint files with the findings' causes on a run, over all balances that it has."""
    square, count = 0.0, 0
    for number, mapping in joints.items():
        effects = [
            {"name": c.name, "parameters": {k: v.value for k, v in c.parameters.items()}}
            for c in findings.causes
            if c.joint in (number, SENSOR)
        ]
        joint = Joint.from_mapping({**mapping, "effects": effects}, f"joint{number}")
        signals = joint_signals("held out", table_of(run, joints), number, joint, BaseLoss(joint))
        samples = bin_samples([signals])
        for balance, residual in (("motor", signals.motor_nm), ("torsion", signals.torsion_nm)):
            if residual is None:
                continue
            left = residual
            for effect in joint.effects:
                there = contribution(EFFECTS[effect.name], effect.parameters, signals)
                left = left - there.get(balance, 0.0)
            means = binned(signals.seen(balance, left), samples)  # where the recording shows it
            means = means[all_in_bin(signals.moving, samples)] if balance == "motor" else means - means.mean()
            square += float(means @ means)
            count += len(means)
    return float(np.sqrt(square / max(count, 1)))


def table_of(run: Columns, joints: Mapping[int, Mapping[str, Any]]) -> RunTable:
    """Return the columns of a run as a run table."""
    numbers = {n: JointColumns(**{x: run.get(f"j{n}.{x}") for x in COLUMN_NAMES}) for n in joints}
    return RunTable(run["time_s"], numbers)


def steps(drawn: Set, recorder: Recorder, seed: int, fewest: int = FEWEST) -> list[Step]:
    """Return the steps from `fewest` runs to all but the last, which is held out."""
    held_out = drawn.runs[-1]
    findings = [judged(drawn.runs[:k], drawn.joints, recorder, seed) for k in range(fewest, len(drawn.runs))]
    return [step(fewest + k, a, b, held_out, drawn.joints) for k, (a, b) in enumerate(pairwise(findings))]


def sets_of(bench: str, seed: int) -> Iterator[tuple[str, int, Set]]:
    """Yield (key, seed, set) of a bench, sets of all kinds in a mixed order."""
    if bench == OWN:
        yield from _own_sets(seed)
        return
    world = BENCHES[bench]()
    every = jobs(world, seed, Counts())
    for k in np.random.default_rng([seed, 1]).permutation(len(every)):
        job = every[int(k)]
        yield job.key, job.seed, world.draw(job.seed, job.hidden)


def _own_sets(seed: int) -> Iterator[tuple[str, int, Set]]:
    """Yield what the project's own trials hide, trial after trial; sizes as there."""
    number = 0
    while True:
        own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        [plain] = draw_many([Order(own)])
        findings = diagnose(tables(plain.runs), joint_files(plain))
        rng = np.random.default_rng([own, 77])
        orders = orders_of(number, own, rng, plain, findings, ("one", "least", "two", "unknown"), [])
        for (kind, _), case in zip(orders, draw_many([order for _, order in orders]), strict=True):
            yield f"{kind}.{number}", own, Set(case.runs, case.joints, case.truth)
        number += 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what became of the causes, set by set."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--bench", choices=sorted([*BENCHES, OWN]), required=True)
    parser.add_argument("--sets", type=int, default=10)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--recorder", choices=sorted(PRESETS), default="full")
    options = parser.parse_args(arguments)
    if lacking := missing(options.bench):
        print(lacking, file=sys.stderr)
        return FAILED
    done: list[Step] = []
    for key, seed, drawn in islice(sets_of(options.bench, options.seed), options.sets):
        for each in steps(drawn, PRESETS[options.recorder], seed):
            done.append(each)
            print(f"{key} {each.runs} -> {each.runs + 1} runs: {each.text}", flush=True)
        print(f"{options.bench}, seed {options.seed}: {summary(done)}", flush=True)
    return MISSED if any(each.worse for each in done) else REACHED


def summary(done: Sequence[Step]) -> str:
    """Return the figures of these steps in one line."""
    went = [each for each in done if each.lost]
    return (
        f"{len(done)} steps, a cause went in {len(went)}, without a word in {sum(s.worse for s in went)}; "
        f"the run held out is clearly better predicted with it in {sum(s.missed for s in went)}"
    )


if __name__ == "__main__":
    sys.exit(main())
