"""One thing changed after identification: two encoders with the network of the current path beside the same without it.

Joints are identified and their networks trained as in `current_path`; a network that its gate refuses is none. Judged are
ordinary days, and the motions of variable velocity with one of CHANGES. Errors are against the true torque now.

python -m validation changed --plant coarse
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.command_line import count, natural
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.sysid.evaluate.inputs import SETTLE_S
from jtqd.sysid.planner.campaigns import make_plan, seed_of
from jtqd.sysid.train.current_path import USUAL, PathRun, Recipe, gate_of, train_path
from validation.current_path.study import KINDS
from validation.goals.goals import ZEROS, settings_of
from validation.goals.identify import (
    CHANGES,
    FEW,
    FIT_SEED,
    TINY,
    Change,
    Driven,
    Identified,
    PlantFile,
    Sizes,
    drive,
    fit_physics,
    judging_runs,
    nominal_joints,
    scale_of,
    the_four,
)
from validation.study import Report, Table, UsageError, in_processes

JUDGE_SEED: Final = 8807
"""Days and motions that nothing was chosen on."""
ORDINARY: Final = Change("ordinary days", link=lambda link, motor: link)
SIZES: Final = {"full": (FEW, USUAL), "tiny": (TINY, replace(USUAL, epochs=2, fewest_steps=8))}
_QUICK: Final = 40_000
"""Between the seeds of ordinary and of quick runs."""
Networks = tuple[PathNetwork | None, ...]


class Cell(NamedTuple):
    """In motion: RMSE [Nm], inside the 90 % interval, degraded, neither degraded nor within 3 sigma [%], mean sigma [Nm]."""

    rmse_nm: float
    inside: float
    degraded: float
    beyond: float
    sigma_nm: float

    @property
    def text(self) -> str:
        return f"{self.rmse_nm:.2f}, {self.inside:.1f}, {self.degraded:.1f}, {self.beyond:.1f}, {self.sigma_nm:.2f}"


def cell_of(runs: Sequence[Driven], change: Change, models: Sequence[Identified], networks: Networks) -> Cell:
    """Return the figures over all samples of both joints."""
    parts = []
    for one, network in zip(models, networks, strict=True):
        for run in runs:
            columns, time_s = run.columns(one.number, one.joint), run.table.time_s
            if change.link is not None:
                assert columns.link_position_rad is not None
                assert columns.motor_position_rad is not None
                moved = change.link(
                    columns.link_position_rad, columns.motor_position_rad / one.joint.gear_ratio
                )
                columns = replace(columns, link_position_rad=moved)
            found = estimate_columns(one.joint, settings_of(ZEROS), network, time_s, columns)
            error = np.abs(found.torque_nm - run.true_nm[:, one.number - 1])
            keep = (
                (time_s - time_s[0] >= SETTLE_S)
                & np.isin(found.status, (VALID, DEGRADED))
                & np.isfinite(error)
            )
            parts.append((error[keep], found.sigma_nm[keep], found.status[keep] == DEGRADED))
    error, sigma, degraded = map(np.concatenate, zip(*parts, strict=True))
    shares = (error <= GAUSS * sigma, degraded, ~degraded & (error > 3.0 * sigma))
    inside, flagged, beyond = (100.0 * float(np.mean(each)) for each in shares)
    return Cell(float(np.sqrt(np.mean(error**2))), inside, flagged, beyond, float(np.mean(sigma)))


def networks_of(models: Sequence[Identified], runs: Sequence[Driven], recipe: Recipe) -> Networks:
    """Return the network of each joint, None where its gate refuses it. Raises ValueError as `train_path`."""
    found: list[PathNetwork | None] = []
    for one in models:
        paths = [
            PathRun(f"{k}", run.table.time_s, run.columns(one.number, one.joint))
            for k, run in enumerate(runs)
        ]
        made = train_path(paths, one.joint, {run.name: "0" * 64 for run in paths}, recipe)
        found.append(PathNetwork(made.data) if gate_of(made.held_out).passed else None)
    return tuple(found)


class Found(NamedTuple):
    """Of a plant: by change, without networks and with them; how many networks pass."""

    plant: str
    networks: int
    cells: dict[str, tuple[Cell, Cell]]


def studied(sizes: Sizes, recipe: Recipe, fit_seed: int, seed: int, plant: PlantFile) -> Found:
    """Raises as `identify`."""
    joints, bench = nominal_joints(plant), plant.bench()
    plan = make_plan("excitation", scale_of(sizes, joints, fit_seed, "excitation"))
    ordinary = drive(bench, plan.runs, fit_seed)
    number = max(sizes.fit_runs // 16, 2)
    quick = [run for made in KINDS.values() for run in made(number, sizes.judge_s, fit_seed + _QUICK)]
    models = fit_physics(joints, ordinary)
    networks = networks_of(models, [*ordinary, *drive(bench, quick, fit_seed + _QUICK)], recipe)
    runs = judging_runs(sizes, joints, seed)
    motions = [run for run in runs if run.name.startswith("variable")][: sizes.changed_runs]
    cells, changes = {}, [each for each in CHANGES if each.possible(plant)]
    for change in (ORDINARY, *changes):
        driven = (runs, seed) if change is ORDINARY else (motions, seed_of("changes", 0.0, seed))
        days = drive(change.bench(plant), *driven)
        cells[change.name] = (
            cell_of(days, change, models, (None, None)),
            cell_of(days, change, models, networks),
        )
    return Found(plant.name, sum(each is not None for each in networks), cells)


def options(parser: argparse.ArgumentParser) -> None:
    names = [each.name.lower().replace(" ", "_") for each in the_four()]
    parser.add_argument("--tiny", action="store_const", const="tiny", dest="size", help="to test the steps")
    parser.add_argument("--plant", action="append", choices=names, help="this plant alone; may be repeated")
    parser.add_argument(
        "--seed", type=natural, default=JUDGE_SEED, help="of the days that judge (default %(default)s)"
    )
    parser.add_argument("--fit-seed", type=natural, default=FIT_SEED, help="of the campaigns (%(default)s)")
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="plants at a time (default 1)")


def run(options: argparse.Namespace) -> Report:
    if options.seed == options.fit_seed:
        raise UsageError(
            "--seed, --fit-seed: found one for both, expected two: the same days would fit and judge"
        )
    names = options.plant or [each.name.lower().replace(" ", "_") for each in the_four()]
    plants = [each for each in the_four() if each.name.lower().replace(" ", "_") in names]
    work = partial(studied, *SIZES[options.size or "full"], options.fit_seed, options.seed)
    done = list(in_processes(work, plants, options.jobs, "plants"))
    head = "RMSE Nm, inside %, degraded %, not degraded and beyond 3 sigma %, mean sigma Nm"
    tables = [
        Table(
            (f"{each.plant}: {head}", "without a network", f"with it ({each.networks} of 2 joints)"),
            [(name, *(cell.text for cell in both)) for name, both in each.cells.items()],
        )
        for each in done
    ]
    return Report(tables, {"judge": options.seed, "fit": options.fit_seed}, (), done)
