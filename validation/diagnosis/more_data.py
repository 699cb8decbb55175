"""What one more run is worth: the error on a held-out run with the extended joint files of k and of k + 1 runs, set by set.

    python -m validation more_data --bench measured --sets 10 --seed 1

The last run of each set is held out of all diagnoses. More data may make the extended file better; it must not make it worse
by more than `WORSE`. Bench `own` is the generator in validation/generator, `measured` the Kinova runs that ship.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Final

import numpy as np

from jtqd.estimator.command_line import count
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Findings, shows_at
from validation.diagnosis.benches import Counts, bench_option, jobs, made
from validation.diagnosis.entries import Columns, Set
from validation.diagnosis.entries import Joint as JointFile
from validation.diagnosis.recorder import PRESETS, Recorder
from validation.diagnosis.scores import judged
from validation.diagnosis.trials import joint_files, orders_of, rms, run_table, tables, unexplained
from validation.generator.draw import Order, draw_many
from validation.study import Report, Table

FEWEST: Final = 2
WORSE: Final = 0.2
"""Part by which the squared error on the held-out run may rise: a run more is a run of another day."""
OWN: Final = "own"


@dataclass(frozen=True)
class Step:
    """From `runs` runs to one more: error on the held-out run of the joint file, and of the extended file of either [Nm]."""

    runs: int
    file_nm: float
    fewer_nm: float
    more_nm: float

    @property
    def worse(self) -> bool:
        return self.more_nm**2 > (1.0 + WORSE) * self.fewer_nm**2

    @property
    def text(self) -> str:
        return f"{self.fewer_nm:.3f} -> {self.more_nm:.3f} Nm" + (" WORSE" if self.worse else "")


def held_out_rms(findings: Findings, run: Columns, joints: Mapping[int, JointFile]) -> float:
    """Return the error [Nm rms] of the extended joint files on a run, over all balances that it has."""
    parts = []
    table = run_table(run, joints)
    for number, mapping in joints.items():
        effects = [
            {"name": p.name, "parameters": dict(p.values)}
            for p in findings.predicts
            if shows_at(p.joint, number)
        ]
        joint = Joint.from_mapping({**mapping, "effects": effects}, f"joint{number}")
        parts += [
            unexplained(joint, number, "held out", table, balance, visible=True)
            for balance in ("motor", "torsion")
        ]
    return rms([part for part in parts if part is not None])


def steps(drawn: Set, recorder: Recorder, seed: int, fewest: int = FEWEST) -> list[Step]:
    """Return the steps from `fewest` runs to all but the last, which is held out."""
    held_out = drawn.runs[-1]
    nothing = held_out_rms(Findings("no_gap", (), (), tuple(drawn.joints)), held_out, drawn.joints)
    errors = [
        held_out_rms(judged(drawn.runs[:k], drawn.joints, recorder, seed), held_out, drawn.joints)
        for k in range(fewest, len(drawn.runs))
    ]
    return [Step(fewest + k, nothing, a, b) for k, (a, b) in enumerate(pairwise(errors))]


def sets_of(bench: str, seed: int) -> Iterator[tuple[str, int, Set]]:
    """Yield (key, seed, set) of a bench, sets of all kinds in a mixed order."""
    if bench == OWN:
        yield from _own_sets(seed)
        return
    world = made(bench)
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


def options(parser: argparse.ArgumentParser) -> None:
    bench_option(parser, OWN)
    parser.add_argument("--sets", type=count, default=10)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--recorder", choices=sorted(PRESETS), default="full")


def run(options: argparse.Namespace) -> Report:
    done: list[Step] = []
    rows = []
    for key, seed, drawn in islice(sets_of(options.bench, options.seed), options.sets):
        for each in steps(drawn, PRESETS[options.recorder], seed):
            done.append(each)
            rows.append((key, f"{each.runs} to {each.runs + 1}", f"{each.file_nm:.3f} Nm", each.text))
    head = ("set", "runs", "joint file", "extended, held-out error")
    table = Table(head, rows, f"bench {options.bench}")
    return Report([table], {"seed": options.seed}, [summary(done)], done, not any(e.worse for e in done))


def summary(done: Sequence[Step]) -> str:
    """Return counts, and the ratio of the errors of more and fewer runs over all steps."""
    ratio = math.sqrt(sum(s.more_nm**2 for s in done) / max(sum(s.fewer_nm**2 for s in done), 1e-30))
    return (
        f"{len(done)} steps, the held-out error with one run more is {ratio:.2f} of that without; more than "
        f"{100 * WORSE:.0f} % worse as squares in {sum(s.worse for s in done)}"
    )
