"""More data never makes a diagnosis worse: what one more run changes in the findings, set by set.

    python -m validation more_data --bench measured --sets 10 --seed 1

From two runs on, a cause that is reported alone on k runs is reported on k + 1 (alone or in an equivalence class), or else a
line of the findings explains what became of it (`jtqd.sysid.diagnosis.fewer_runs`). For each cause that goes the error on
the run held out of all is printed with it and without. Bench `own` is the generator in validation/generator, `measured` the
Kinova runs that ship.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Final

import numpy as np

from jtqd.estimator.command_line import count
from jtqd.estimator.joint import Joint
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import Cause, Findings, joint_text
from jtqd.sysid.diagnosis.leave_one_out import FALL
from validation.diagnosis.benches import Counts, bench_option, jobs, made
from validation.diagnosis.entries import SENSOR, Columns, Set
from validation.diagnosis.entries import Joint as JointFile
from validation.diagnosis.recorder import PRESETS, Recorder
from validation.diagnosis.scores import judged, members
from validation.diagnosis.trials import joint_files, orders_of, rms, run_table, tables, unexplained
from validation.generator.draw import Order, draw_many
from validation.study import Report, Table

FEWEST: Final = 2
OWN: Final = "own"


@dataclass(frozen=True)
class Step:
    """From `runs` runs to one more: what was reported alone and is not any more, error on the held-out run with either."""

    runs: int
    lost: tuple[str, ...]
    unreported: tuple[str, ...]
    fewer_nm: float
    more_nm: float

    @property
    def worse(self) -> bool:
        return bool(self.unreported)

    @property
    def missed(self) -> bool:
        """Return whether the held-out run is clearly better predicted by the causes of fewer runs."""
        return bool(self.lost) and self.fewer_nm**2 < (1.0 - FALL) * self.more_nm**2

    @property
    def text(self) -> str:
        if not self.lost:
            return "kept"
        line = f"; no line about {', '.join(self.unreported)}" if self.unreported else "; explained"
        error = f"{self.fewer_nm:.3f} -> {self.more_nm:.3f} Nm"
        return f"{', '.join(self.lost)} went; held-out error {error}{line}"


def step(
    runs: int, fewer: Findings, more: Findings, held_out: Columns, joints: Mapping[int, JointFile]
) -> Step:
    still = {key for c in more.causes for key in members(c)}
    gone = [c for c in fewer.causes if len(c.names) == 1 and (c.name, c.joint) not in still]
    if not gone:
        return Step(runs, (), (), float("nan"), float("nan"))
    return Step(
        runs,
        tuple(c.name for c in gone),
        tuple(c.name for c in gone if not any(_names(line, c) for line in more.reasons)),
        held_out_rms(fewer, held_out, joints),
        held_out_rms(more, held_out, joints),
    )


def _names(line: str, cause: Cause) -> bool:
    """Return whether a line is about an effect: by its name, and by its joint where the line names one."""
    return f"{cause.name} of {joint_text(cause.joint)}" in line


def held_out_rms(findings: Findings, run: Columns, joints: Mapping[int, JointFile]) -> float:
    """Return the error [Nm rms] of the joint files with the findings' causes on a run, over all balances that it has."""
    parts = []
    for number, mapping in joints.items():
        effects = [
            {"name": c.name, "parameters": {k: v.value for k, v in c.parameters.items()}}
            for c in findings.causes
            if c.joint in (number, SENSOR)
        ]
        joint = Joint.from_mapping({**mapping, "effects": effects}, f"joint{number}")
        table = run_table(run, joints)
        parts += [
            unexplained(joint, number, "held out", table, balance, visible=True)
            for balance in ("motor", "torsion")
        ]
    return rms([part for part in parts if part is not None])


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
            rows.append((key, f"{each.runs} to {each.runs + 1}", each.text))
    table = Table(("set", "runs", "causes"), rows, f"bench {options.bench}")
    return Report([table], {"seed": options.seed}, [summary(done)], done, not any(e.worse for e in done))


def summary(done: Sequence[Step]) -> str:
    went = [each for each in done if each.lost]
    return (
        f"{len(done)} steps, a cause went in {len(went)}, without a line in {sum(s.worse for s in went)}; "
        f"the run held out is clearly better predicted with it in {sum(s.missed for s in went)}"
    )
