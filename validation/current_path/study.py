"""Study of a network of the current path: the torque of one encoder on the four plants, with and without the network.

Each plant is driven by a campaign (ordinary runs of excitation and quick ones), and judged on other days and motions. The
network of `sysid/train/current_path.py` learns from 96, 24 and 12 ordinary runs and as many quick ones in proportion; its
teacher is the torque sensor, or the fused estimate of a joint file that was fitted to 8 runs with a sensor. It is compared
with the estimates of the joint file for one encoder and for two, fitted to the ordinary runs. Figures: RMSE against the true
torque of the same instant, % of rated, over both joints. A second table has what a joint file gives in service with the
network of `jtq train` and without one: error, and how often its interval holds.

python -m validation current_path --quick --plant typical      fewer runs
python -m validation current_path --json current_path.json
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import count, natural
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Joint
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings, recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sysid.evaluate.inputs import SETTLE_S
from jtqd.sysid.planner.campaigns import make_plan
from jtqd.sysid.planner.plan import Plateau, Rest, Run, Segment
from jtqd.sysid.train.current_path import (
    USUAL,
    Block,
    PathRun,
    Recipe,
    block,
    estimate_nm,
    seen,
    train,
    train_path,
)
from validation.goals.identify import (
    FIT_SEED,
    FULL,
    QUICK,
    Driven,
    Identified,
    PlantFile,
    Sizes,
    drive,
    fit_one_encoder,
    fit_physics,
    judging_runs,
    nominal_joints,
    one_encoder,
    scale_of,
    the_four,
)
from validation.goals.situations import creeping_runs, quick_runs, step_runs
from validation.study import Report, Table, UsageError, in_processes

JUDGE_SEED: Final = 7035
"""Days and motions that nothing was chosen on."""
SENSOR_RUNS: Final = 8
"""Runs with a sensor behind the joint file that teaches."""
_MOVES_RAD_S: Final = 0.01
_SETTINGS: Final = replace(recommended("fused"), track_zeros=True, track_torsion=True)


class Scale(NamedTuple):
    """sizes.fit_runs: ordinary runs, of which the counts are parts; quick: runs beside all of them; judged: of each kind."""

    sizes: Sizes
    counts: tuple[int, ...]
    quick: int
    judged: int


SCALES: Final = {
    "full": Scale(FULL._replace(judge_runs=24), (96, 24, 12), 18, 12),
    "quick": Scale(QUICK._replace(fit_runs=24, evaluations=40, judge_runs=6), (24, 12), 6, 3),
}
QUICK_TITLE: Final = "quick reversals"
ORDINARY: Final = "ordinary days"


def load_step_runs(runs: int, seconds: float, seed: int) -> tuple[Run, ...]:
    """Return motions at constant velocity against steps of current within 3 ms, as a contact would make."""

    def one(number: int) -> Run:
        rng = np.random.default_rng([seed, 4, number])
        velocity = float(rng.uniform(0.1, 1.5)) * (1.0 if rng.uniform() < 0.5 else -1.0)
        segments: list[Segment] = [Rest(0.6, 0.0), Plateau(velocity, 0.0, 0.4, 0.4)]
        for _ in range(max(int((seconds - 2.2) / 0.6), 2)):
            current = float(rng.uniform(-4.0, 4.0))
            segments.append(Plateau(velocity, current, 0.597, 0.003))
        return Run(f"load_steps_{number:02d}", 1 + number % 2, (*segments, Rest(0.4, 0.4)))

    return tuple(map(one, range(runs)))


KINDS: Final[Mapping[str, Callable[[int, float, int], tuple[Run, ...]]]] = {
    QUICK_TITLE: quick_runs,
    "steps at rest": step_runs,
    "load steps in motion": load_step_runs,
}
"""What the campaign has beside ordinary runs, and what is judged by itself."""


class Days(NamedTuple):
    """Runs of a plant: the campaign's ordinary and quick ones; judging ones by kind."""

    ordinary: Sequence[Driven]
    quick: Sequence[Driven]
    judging: Mapping[str, Sequence[Driven]]


def driven(plant: PlantFile, scale: Scale, fit_seed: int, seed: int) -> Days:
    """Drive everything; campaign and judging runs share neither day nor motion. Raises ConfigError."""
    joints, bench, seconds = nominal_joints(plant), plant.bench(), scale.sizes.judge_s
    plan = make_plan("excitation", scale_of(scale.sizes, joints, fit_seed, "excitation"))
    each = scale.quick // len(KINDS)
    quick = [run for made in KINDS.values() for run in made(each, seconds, fit_seed + 40_000)]
    judging = {ORDINARY: judging_runs(scale.sizes, joints, seed)}
    judging |= {kind: made(scale.judged, seconds, seed) for kind, made in KINDS.items()}
    judging["creeping"] = creeping_runs(scale.judged, seconds, seed)
    return Days(
        drive(bench, plan.runs, fit_seed),
        drive(bench, quick, fit_seed + 40_000),
        {kind: drive(bench, runs, seed + number) for number, (kind, runs) in enumerate(judging.items())},
    )


@dataclass(frozen=True)
class Example:
    """One joint in one run, arrays [n]: what the network sees, the sensor, the truth, when settled, and in motion."""

    known: FloatArray
    sensor_nm: FloatArray
    true_nm: FloatArray
    settled: BoolArray
    moves: BoolArray


def example(run: Driven, number: int, joint: Joint) -> Example:
    """Return a run as the network sees it with one encoder; joint: with section `fused`."""
    columns = run.columns(number, joint)
    assert columns.torque_nm is not None
    assert columns.motor_velocity_rad_s is not None
    time_s = run.table.time_s
    moves: BoolArray = np.abs(columns.motor_velocity_rad_s) > _MOVES_RAD_S * joint.gear_ratio
    return Example(
        seen(joint, time_s, columns),
        columns.torque_nm,
        np.ascontiguousarray(run.true_nm[:, number - 1]),
        time_s - time_s[0] >= SETTLE_S,
        moves,
    )


def fused_nm(run: Driven, number: int, joint: Joint, settings: EstimatorSettings = _SETTINGS) -> FloatArray:
    """Return the estimate [n] with two encoders; NaN where there is none."""
    found = estimate_columns(joint, settings, None, run.table.time_s, run.columns(number, joint))
    return np.array(found.torque_nm)


def one_encoder_nm(run: Driven, number: int, joint: Joint) -> FloatArray:
    columns = one_encoder(run.columns(number, joint), joint)
    found = estimate_columns(joint, _SETTINGS, None, run.table.time_s, columns)
    return np.array(found.torque_nm)


Estimate = Callable[[Driven, Example], FloatArray]


class Share(NamedTuple):
    """Sum of squares of (error / rated), and samples: in motion, at rest."""

    moving: tuple[float, int]
    standing: tuple[float, int]


def share(found: FloatArray, one: Example, rated_nm: float) -> Share:
    error = (found - one.true_nm) / rated_nm
    known = one.settled & np.isfinite(error)
    parts = [error[known & (one.moves == moving)] for moving in (True, False)]
    return Share(*((float(each @ each), len(each)) for each in parts))


def percent(parts: Sequence[tuple[float, int]]) -> float:
    """Return the RMSE in % of rated of these sums."""
    squares, samples = (sum(each) for each in zip(*parts, strict=True))
    return 100.0 * float(np.sqrt(squares / samples)) if samples else float("nan")


class Scored(NamedTuple):
    """RMSE of a method [% of rated] by kind of runs: in motion, at rest."""

    moving: Mapping[str, float]
    standing: Mapping[str, float]


SERVICE: Final = ("one encoder", "one encoder, network", "two encoders", "two encoders, network")


class Served(NamedTuple):
    """Sums over samples of an estimate in service: in motion, at rest, published in motion, status 6, valid."""

    squares: FloatArray
    counts: FloatArray
    held: FloatArray

    def text(self, rated_nm: float) -> str:
        """Return RMSE [% of rated] in motion; at rest | inside of the interval in motion; at rest | beyond 3 sigma, %."""
        rmse = 100.0 * np.sqrt(self.squares[:2] / np.maximum(self.counts[:2], 1)) / rated_nm
        share = 100.0 * self.held / np.maximum(self.counts[2:], 1)
        return f"{rmse[0]:.2f}; {rmse[1]:.2f} | {share[0]:.1f}; {share[1]:.1f} | {share[2]:.1f}"


def served(
    run: Driven, number: int, joint: Joint, network: PathNetwork | None, columns: JointColumns
) -> Served:
    """Return what a joint file gives in a run, with a network or without."""
    time_s = run.table.time_s
    found = estimate_columns(joint, _SETTINGS, network, time_s, columns)
    error = np.abs(found.torque_nm - run.true_nm[:, number - 1])
    assert columns.motor_velocity_rad_s is not None
    moves = np.abs(columns.motor_velocity_rad_s) > _MOVES_RAD_S * joint.gear_ratio
    known = (time_s - time_s[0] >= SETTLE_S) & np.isfinite(error)
    kinds = (
        known & moves,
        known & ~moves,
        known & np.isin(found.status, (VALID, DEGRADED)),
        known & (found.status == STANDSTILL),
        known & (found.status == VALID),
    )
    limits = (GAUSS, 1.0, 3.0)
    return Served(
        np.array([float(error[kind] @ error[kind]) for kind in kinds[:2]]),
        np.array([float(np.count_nonzero(kind)) for kind in kinds]),
        np.array(
            [
                float(
                    np.count_nonzero(
                        (error > limit * found.sigma_nm if limit == 3.0 else error < limit * found.sigma_nm)
                        & kind
                    )
                )
                for kind, limit in zip(kinds[2:], limits, strict=True)
            ]
        ),
    )


def in_service(
    joint: Joint, two: Identified, days: Days, recipe: Recipe
) -> dict[str, dict[str, list[Served]]]:
    """Return by estimate and kind of runs what both joint files of a joint give, with the network and without."""
    number = two.number
    files = {"one encoder": fit_one_encoder(joint, number, days.ordinary), "two encoders": two.joint}
    found: dict[str, dict[str, list[Served]]] = {}
    for name, file in files.items():

        def columns(run: Driven, name: str = name) -> JointColumns:
            each = run.columns(number, joint)
            return one_encoder(each, joint) if name == "one encoder" else each

        runs = [
            PathRun(f"{k}", run.table.time_s, columns(run))
            for k, run in enumerate((*days.ordinary, *days.quick))
        ]
        made = train_path(runs, file, {run.name: "0" * 64 for run in runs}, recipe)
        for title, network in ((name, None), (f"{name}, network", PathNetwork(made.data))):
            found[title] = {
                kind: [served(run, number, file, network, columns(run)) for run in some]
                for kind, some in days.judging.items()
            }
    return found


@dataclass(frozen=True)
class Found:
    """What one plant gave: by method; rated torque [Nm]; in service, by estimate and kind of runs, as text."""

    plant: str
    rated_nm: float
    scores: Mapping[str, Scored]
    service: Mapping[str, Mapping[str, str]]
    seconds: float


def trained_on(
    examples: Sequence[Example], quick: Sequence[Example], teachers: Sequence[FloatArray], recipe: Recipe
) -> Estimate:
    """Return the estimate of a network that learned from these runs; teachers [n]: of the ordinary, then the quick ones."""
    blocks: list[Block] = [
        block(one.known, teacher, one.settled)
        for one, teacher in zip((*examples, *quick), teachers, strict=True)
    ]
    network = train(blocks, recipe)
    return lambda run, one: estimate_nm(network, one.known)


def methods_of(
    files: tuple[Joint, Identified, Identified], days: Days, scale: Scale, recipe: Recipe
) -> dict[str, Estimate]:
    """Return the estimates of one joint by name; files: as its user has it, fitted to all ordinary runs, to SENSOR_RUNS."""
    joint, two, teacher = files
    number = two.number
    one = fit_one_encoder(joint, number, days.ordinary)
    ordinary = [example(run, number, two.joint) for run in days.ordinary]
    quick = [example(run, number, two.joint) for run in days.quick]
    found: dict[str, Estimate] = {
        "without it, two encoders": lambda run, each: fused_nm(run, number, two.joint),
        "without it, one encoder": lambda run, each: one_encoder_nm(run, number, one),
    }
    sensor = [each.sensor_nm for each in (*ordinary, *quick)]
    most = scale.counts[0]
    for runs in scale.counts:
        some, beside = ordinary[:runs], quick[:: max(most // runs, 1)]
        teachers = sensor[:runs] + sensor[len(ordinary) :: max(most // runs, 1)]
        found[f"network, {runs} runs"] = trained_on(some, beside, teachers, recipe)
    fused = [fused_nm(run, number, teacher.joint) for run in (*days.ordinary, *days.quick)]
    found[f"the teacher: two encoders, {SENSOR_RUNS} runs"] = lambda run, each: fused_nm(
        run, number, teacher.joint
    )
    found[f"network, {most} runs, taught by it"] = trained_on(ordinary, quick, fused, recipe)
    plain = trained_on(ordinary, [], sensor[: len(ordinary)], recipe)
    found[f"network, {most} runs, none quick"] = plain
    return found


def studied(scale: Scale, fit_seed: int, seed: int, recipe: Recipe, plant: PlantFile) -> Found:
    """Return the figures of a plant. Raises as `identify`."""
    before = time.process_time()
    days, joints = driven(plant, scale, fit_seed, seed), nominal_joints(plant)
    sums: dict[str, dict[str, list[Share]]] = {}
    service: dict[str, dict[str, list[Served]]] = {}
    fitted = (fit_physics(joints, runs) for runs in (days.ordinary, days.ordinary[:SENSOR_RUNS]))
    for joint, two, teacher in zip(joints, *fitted, strict=True):
        number = two.number
        for name, of_kind in in_service(joint, two, days, recipe).items():
            for kind, each in of_kind.items():
                service.setdefault(name, {}).setdefault(kind, []).extend(each)
        examples = {
            kind: [example(run, number, two.joint) for run in runs] for kind, runs in days.judging.items()
        }
        for name, estimate in methods_of((joint, two, teacher), days, scale, recipe).items():
            for kind, runs in days.judging.items():
                parts = sums.setdefault(name, {}).setdefault(kind, [])
                for run, one in zip(runs, examples[kind], strict=True):
                    parts.append(share(estimate(run, one), one, joint.rated_torque_nm))
    scores = {
        name: Scored(
            {kind: percent([each.moving for each in parts]) for kind, parts in kinds.items()},
            {kind: percent([each.standing for each in parts]) for kind, parts in kinds.items()},
        )
        for name, kinds in sums.items()
    }
    rated_nm = joints[0].rated_torque_nm
    texts = {
        name: {
            kind: Served(*(np.sum(part, axis=0) for part in zip(*each, strict=True))).text(rated_nm)
            for kind, each in of_kind.items()
        }
        for name, of_kind in service.items()
    }
    return Found(plant.name, rated_nm, scores, texts, time.process_time() - before)


def service_table(found: Found) -> Table:
    """Return the table of the estimates in service."""
    kinds = list(next(iter(found.service.values())))
    title = f"{found.plant}, in service: RMSE, %, in motion; at rest | interval holds, % | valid beyond 3 sigma, %"
    return Table(
        (title, *kinds), [(name, *(found.service[name][kind] for kind in kinds)) for name in SERVICE]
    )


def table_of(found: Found) -> Table:
    """Return the table of a plant, % of rated."""
    kinds = list(next(iter(found.scores.values())).moving)

    def cell(score: Scored, kind: str) -> str:
        return f"{score.moving[kind]:.2f}; {score.standing[kind]:.2f}"

    return Table(
        (f"{found.plant}: RMSE now, % of {found.rated_nm:g} Nm, in motion; at rest", *kinds),
        [(name, *(cell(score, kind) for kind in kinds)) for name, score in found.scores.items()],
    )


def options(parser: argparse.ArgumentParser) -> None:
    names = [each.name.lower().replace(" ", "_") for each in the_four()]
    parser.add_argument("--quick", action="store_const", const="quick", dest="size", help="fewer runs")
    parser.add_argument("--plant", action="append", choices=names, help="this plant alone; may be repeated")
    parser.add_argument(
        "--seed", type=natural, default=JUDGE_SEED, help="of the days that judge (default %(default)s)"
    )
    parser.add_argument("--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (%(default)s)")
    parser.add_argument("--net-seed", type=natural, default=0, help="of weights and batches (%(default)s)")
    parser.add_argument("--epochs", type=count, default=USUAL.epochs, help="of a training (%(default)s)")
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="plants at a time (default 1)")


def run(options: argparse.Namespace) -> Report:
    if options.seed == options.fit_seed:
        raise UsageError(
            "--seed, --fit-seed: found one for both, expected two: the same days would fit and judge"
        )
    recipe = replace(USUAL, seed=options.net_seed, epochs=options.epochs)
    plants = [
        each
        for each in the_four()
        if not options.plant or each.name.lower().replace(" ", "_") in options.plant
    ]
    work = partial(studied, SCALES[options.size or "full"], options.fit_seed, options.seed, recipe)
    done = list(in_processes(work, plants, options.jobs, "plants"))
    note = f"{options.size or 'full'}: {sum(each.seconds for each in done):.0f} s of CPU"
    seeds = {"judge": options.seed, "fit": options.fit_seed, "network": options.net_seed}
    tables = [table for each in done for table in (table_of(each), service_table(each))]
    return Report(tables, seeds, [note], done)
