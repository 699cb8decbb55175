"""One encoder, two short runs: what is fitted to one is judged on the other. Ours beside least squares.

    python -m validation two_runs                                          three plants; three minutes
    python -m validation two_runs --world mujoco                           a minute
    python -m validation two_runs --world kinova --joints 2 3 4 5 6 7      a second

Ours is what `jtq fit losses` makes of one run (`sysid.fit.few_runs`, method `fused` without torsion). Beside it stand the
joint file as it was (`tob`), `tob` with Coulomb and viscous friction fitted (`fit_friction`), the baselines of the
goals' table that need one encoder, and

    current and speed     tau = a0 + a1 tau_raw + a2 s + a3 v + a4 s |tau_raw|
    ladder                tau = tau_raw - (c0 + c1 s + c2 v + c3 dv/dt + c4 s |tau_raw|)

All are fitted to the same run and judged on the same samples of the other: in motion, against the torque sensor of the same
age. The best of the regressions is the one that is best there, which nobody could have known before.

Worlds: `plants` are the three plants of the goals, each seed another day, motion and file: runs at varying speed and load,
of which two windows of 2 to 5 s are all that is known, many in one direction only. The joint files are wrong as guesses
are: friction by a factor (35 %, standard deviation of its logarithm), rotor inertia (20 %), torque constant (2 %
beside what the plant has of its own). `mujoco` is the same in MuJoCo, where friction, friction by load, torque constant and
current offset are hidden instead. `kinova` is the measured arm; joint 1, whose sensor is dead in one run, is left out. Both
of its runs have been looked at many times: practice, not proof.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.command_line import count
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.fusion import GAUSS
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns, ObservedRun, RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.few_runs import fit_few_runs
from jtqd.sysid.fit.losses import LossFitError
from jtqd.sysid.fit.plateaus import FitError, effective_samples, student_975
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.planner.campaigns import variable_runs
from jtqd.sysid.planner.plan import DEFAULT_LIMITS
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from validation.diagnosis.benches import made
from validation.diagnosis.entries import Hidden
from validation.diagnosis.mujoco_bench import MujocoBench
from validation.diagnosis.trials import run_table
from validation.goals.identify import (
    BASELINES,
    NUMBERS,
    Baseline,
    Example,
    PlantFile,
    drive,
    fit_baseline,
    nominal_joints,
    one_encoder,
    the_three,
)
from validation.measured import JOINTS, RUNS
from validation.study import Report, Table

SEEDS: Final = {"plants": range(9571, 9596), "mujoco": range(9581, 9606)}
"""Of the table in docs/results.md; those of 500 and up are for choices."""
RUN_S: Final = 9.0
_WINDOW_S: Final = (2.0, 5.0)
_MOVING_RAD_S: Final = 0.05
_MOVING_SHARE: Final = 0.5
_TRIES: Final = 40
COULOMB, VISCOUS = "coulomb_nm", "viscous_nms_per_rad"
_BANDWIDTH_RAD_S: Final = 200.0
_STANDSTILL_RAD_S: Final = 0.02
"""Joint side; below it stiction decides."""
_HIGHEST_CONDITION: Final = 30.0
INSIDE: Final = (85.0, 95.0)
"""Of an honest 90 % interval [%], as on the bench `bad_day`."""
OURS: Final = "ours"
METHODS: Final[Mapping[str, str]] = {OURS: "ours", "tob": "`tob`, friction fitted", "file": "joint file"}
"""Estimators of jtqd, with a sigma."""
RCOND: Final = 1e-3
"""What a run does not excite at all is left out of the regressions, too: some would err by 1e9 Nm else."""


def _current_and_speed(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(raw), raw, s, v, s * np.abs(raw)))


def _ladder(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, np.nan_to_num(seen.velocity_rad_s)
    acceleration = np.gradient(v, np.cumsum(np.maximum(seen.dt_s, 1e-9)))
    return np.column_stack((np.ones_like(raw), s, v, acceleration, s * np.abs(raw)))


SIMPLE: Final = {
    "current": Baseline(
        "least squares on current and speed, 5 coefficients", False, False, _current_and_speed
    ),
    "tob_load": BASELINES["tob_load"],
    "tob_fitted": BASELINES["tob_fitted"],
    "ladder": Baseline("ladder with inertia, 5 coefficients", False, True, _ladder),
}


class Run(NamedTuple):
    """One joint of one run: name, stamps [n], columns."""

    name: str
    time_s: FloatArray
    columns: JointColumns


class Case(NamedTuple):
    """One joint of a world with two runs; joint: its file as it was before them."""

    world: str
    name: str
    joint: Joint
    runs: tuple[Run, Run]


class Row(NamedTuple):
    """One case judged on one run, by method: RMSE in motion [Nm]; of the estimators, how often the 90 % interval holds the
    sensor in motion, and value +- sigma at standstill [%, NaN without such samples].

    A method that cannot be fitted to the run is in none.
    """

    world: str
    name: str
    judged: str
    fitted: str
    rated_nm: float
    rmse_nm: dict[str, float]
    inside: dict[str, float]
    standing: dict[str, float]

    @property
    def best_simple(self) -> str:
        """Name of the regression that is best on the judged run."""
        return min(SIMPLE, key=lambda name: self.rmse_nm[name])

    @property
    def reached(self) -> bool:
        return self.rmse_nm[OURS] <= self.rmse_nm[self.best_simple]

    @property
    def honest(self) -> bool:
        """Whether our interval holds about as much as its 90 %."""
        return INSIDE[0] <= self.inside[OURS] <= INSIDE[1]


def rows_of(case: Case) -> list[Row]:
    """Fit a case to each of its runs and judge it on the other. Raises ConfigError, LossFitError, ValueError."""
    return [_row(case, *pair) for pair in (case.runs, case.runs[::-1])]


def _row(case: Case, judged: Run, fitted: Run) -> Row:
    joint = case.joint
    settings = {name: EstimatorSettings(method="fused" if name == OURS else "tob") for name in METHODS}
    known, seen = (
        run_signals(each.name, joint, settings["tob"], each.time_s, each.columns) for each in (fitted, judged)
    )
    joints = {OURS: fit_few_runs([known], joint).joint, "file": joint}
    with suppress(FitError):  # too little motion for a fit without a prior
        joints["tob"] = replace(joint, friction=fit_friction(fitted.time_s, fitted.columns, joint))
    example = Example(known.seen, known.sensor_nm, known.sensor_nm, known.moving)
    found = {
        name: estimate_columns(each, settings[name], None, judged.time_s, judged.columns)
        for name, each in joints.items()
    }
    keep = seen.moving.copy()
    for each in found.values():
        keep &= np.isin(each.status, (VALID, DEGRADED))
    if not keep.any():
        raise LossFitError(f"{judged.name}: found no motion to judge by, expected some")
    errors = {name: each.torque_nm - seen.sensor_nm for name, each in found.items()}
    errors |= {
        name: each.estimate(seen.seen, fit_baseline(each, [example], RCOND)) - seen.sensor_nm
        for name, each in SIMPLE.items()
    }
    return Row(
        case.world,
        case.name,
        judged.name,
        fitted.name,
        joint.rated_torque_nm,
        {name: float(np.sqrt(np.mean(each[keep] ** 2))) for name, each in errors.items()},
        {name: _inside(errors[name], GAUSS * each.sigma_nm, keep) for name, each in found.items()},
        {
            name: _inside(errors[name], each.sigma_nm, seen.standing & (each.status == STANDSTILL))
            for name, each in found.items()
        },
    )


def fit_friction(time_s: FloatArray, run: JointColumns, joint: Joint) -> Friction:
    """Return Coulomb and viscous friction by least squares on a run in motion, all else in the joint file taken as true.

        LP(G (Kt i - Jm domega_m/dt) - tau) = LP(Fc s(w) + Fv w)        LP: the observer's low pass, w = omega_m/G

    LP(domega_m/dt) = g (omega_m - LP(omega_m)) is exact. A term keeps the file's value where the run cannot separate it from
    the other one (condition number), or where its best value is negative. Raises FitError where the run cannot serve.
    """
    current, omega_m, torque = run.current_a, run.motor_velocity_rad_s, run.torque_nm
    if current is None or omega_m is None or torque is None:
        missing = [n for n in ("current_a", "motor_velocity_rad_s", "torque_nm") if getattr(run, n) is None]
        raise FitError(f"found no {', '.join(missing)}, expected current, motor velocity and measured torque")
    dt_s = np.diff(time_s, prepend=time_s[0])
    speed = omega_m / joint.gear_ratio
    moving = np.abs(speed) > _STANDSTILL_RAD_S
    momentum = joint.rotor_inertia_kgm2 * _BANDWIDTH_RAD_S * omega_m
    motor = low_pass(joint.torque_constant_nm_per_a * current + momentum, dt_s, _BANDWIDTH_RAD_S) - momentum
    target = (joint.gear_ratio * motor - low_pass(torque, dt_s, _BANDWIDTH_RAD_S))[moving]
    none = replace(joint.friction, coulomb_nm=0.0, viscous_nms_per_rad=0.0, stribeck_nm=0.0)
    units = {n: FrictionModel(replace(none, **{n: 1.0})).torque_many(speed) for n in (COULOMB, VISCOUS)}
    columns = {n: low_pass(unit, dt_s, _BANDWIDTH_RAD_S)[moving] for n, unit in units.items()}
    if len(target) < 10 * len(columns):
        raise FitError(f"found {len(target)} rows in motion, expected at least {10 * len(columns)}")
    free = [COULOMB, VISCOUS]
    if (
        np.linalg.cond(np.column_stack([c / np.linalg.norm(c) for c in columns.values()]))
        > _HIGHEST_CONDITION
    ):
        free.remove(VISCOUS)
    values, half_widths, effective = _solve(columns, target, joint.friction, free)
    while negative := [name for name in free if values[name] < 0.0]:
        free.remove(min(negative, key=lambda name: values[name] / max(half_widths[name], 1e-12)))
        values, half_widths, effective = _solve(columns, target, joint.friction, free)
    if effective < 2.0 * len(free):
        raise FitError(f"found {effective:.1f} independent rows, expected 2 per fitted term")
    return replace(joint.friction, **values)


def _solve(
    columns: Mapping[str, FloatArray], target: FloatArray, file: Friction, free: Sequence[str]
) -> tuple[dict[str, float], dict[str, float], float]:
    """Return values and 95 % half widths of the free terms, and the independent rows: only those count in the widths."""
    values = {name: float(getattr(file, name)) for name in columns}
    rest = target - sum((values[n] * c for n, c in columns.items() if n not in free), start=0.0)
    if not free:
        return values, {}, effective_samples(rest)
    matrix = np.column_stack([columns[name] for name in free])
    solution = np.linalg.lstsq(matrix, rest, rcond=None)[0]
    rest = rest - matrix @ solution
    effective = effective_samples(rest)
    freedom = max(effective - len(free), 1.0)
    variance = float(rest @ rest) / len(rest) * effective / freedom
    inverse = np.linalg.pinv(matrix.T @ matrix) * (len(rest) / effective)
    widths = [student_975(freedom) * math.sqrt(variance * float(each)) for each in np.diag(inverse)]
    return (
        values | dict(zip(free, solution.tolist(), strict=True)),
        dict(zip(free, widths, strict=True)),
        effective,
    )


def _inside(error: FloatArray, half: FloatArray, where: BoolArray) -> float:
    return 100.0 * float(np.mean(np.abs(error[where]) <= half[where])) if where.any() else float("nan")


def guessed(joint: Joint, rng: np.random.Generator, friction: float) -> Joint:
    """Return a joint file that is wrong as guesses are; friction: standard deviation of the logarithm of its factors."""
    coulomb, viscous, inertia, constant = rng.normal(size=4)
    old = joint.friction
    new = replace(
        old,
        coulomb_nm=old.coulomb_nm * float(np.exp(friction * coulomb)),
        viscous_nms_per_rad=old.viscous_nms_per_rad * float(np.exp(friction * viscous)),
    )
    return replace(
        joint,
        friction=new,
        rotor_inertia_kgm2=joint.rotor_inertia_kgm2 * float(np.exp(0.2 * inertia)),
        torque_constant_nm_per_a=joint.torque_constant_nm_per_a * float(1.0 + 0.02 * constant),
        efficiency=None,
        fused=None,
    )


def window(
    name: str, time_s: FloatArray, columns: JointColumns, joint: Joint, rng: np.random.Generator
) -> Run | None:
    """Return a piece of a run of 2 to 5 s, at least half of it in motion; None where none was drawn."""
    rate = 1.0 / float(np.median(np.diff(time_s)))
    for _ in range(_TRIES):
        length = min(round(rate * rng.uniform(*_WINDOW_S)), len(time_s))
        rows = slice(start := int(rng.integers(0, len(time_s) - length + 1)), start + length)
        piece = _cut(columns, rows)
        assert piece.motor_velocity_rad_s is not None
        speed = np.abs(piece.motor_velocity_rad_s) / joint.gear_ratio
        if float(np.mean(speed > _MOVING_RAD_S)) > _MOVING_SHARE:
            return Run(name, time_s[rows] - time_s[start], one_encoder(piece, joint))
    return None


def _cut(columns: JointColumns, rows: slice) -> JointColumns:
    values: dict[str, Any] = {item.name: getattr(columns, item.name) for item in fields(columns)}
    arrays: dict[str, Any] = {key: each[rows] for key, each in values.items() if isinstance(each, np.ndarray)}
    return replace(columns, **arrays)


def _cases(
    world: str,
    seed: int,
    nominal: Sequence[Joint],
    runs: Sequence[tuple[str, RunTable]],
    friction: float = 0.35,
) -> Iterator[Case]:
    """Yield the joints of which both runs have a window in motion."""
    for number, file in zip(NUMBERS, nominal, strict=True):
        rng = np.random.default_rng([seed, number])
        joint = guessed(file, rng, friction)
        one, two = (
            window(name, table.time_s, table.joint(number, joint.gear_ratio), joint, rng)
            for name, table in runs
        )
        if one is not None and two is not None:
            yield Case(world, f"{number}, seed {seed}", joint, (one, two))


def plant_cases(plant: PlantFile, seeds: Sequence[int]) -> Iterator[Case]:
    """Yield both joints of a plant for each seed. Raises ConfigError."""
    bench, nominal = plant.bench(), nominal_joints(plant)
    for seed in seeds:
        driven = drive(bench, variable_runs(DEFAULT_LIMITS, 2, RUN_S, seed=seed, joints=nominal), seed)
        yield from _cases(plant.name, seed, nominal, [(run.name, run.table) for run in driven])


def mujoco_cases(seeds: Sequence[int]) -> Iterator[Case]:
    """Yield both joints of the MuJoCo bench for each seed. Raises ModuleNotFoundError without MuJoCo."""
    made(MujocoBench.name)
    for seed in seeds:
        rng = np.random.default_rng([seed, 77])
        drawn = MujocoBench(2, 8.0).draw(seed, [each for number in NUMBERS for each in _hidden(number, rng)])
        nominal = [Joint.from_mapping(dict(drawn.joints[number]), "mujoco") for number in NUMBERS]
        runs = [(f"run{n}", run_table(columns, NUMBERS)) for n, columns in enumerate(drawn.runs, 1)]
        yield from _cases("MuJoCo", seed, nominal, runs, 0.0)


def _hidden(number: int, rng: np.random.Generator) -> list[Hidden]:
    sizes = {
        "load_dependent_friction": rng.uniform(0.0, 0.15),
        "torque_constant": 0.03 * rng.normal(),
        "current_offset": 0.01 * rng.normal(),
        "coulomb_friction": 0.02 * rng.normal(),
        "viscous_friction": 0.015 * rng.normal(),
    }
    return [Hidden(name, number, abs(float(size))) for name, size in sizes.items()]


def kinova_cases(joints: Sequence[int]) -> Iterator[Case]:
    """Yield joints of the measured arm. Raises RunError, RunTableError, ConfigError."""
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    files = {run: read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns).table for run in RUNS}
    for number in joints:
        joint = load_joint(shipped(f"kinova_gen3/joint{number}.yaml"))
        one, two = (
            Run(name, table.time_s, one_encoder(table.joints[number], joint)) for name, table in files.items()
        )
        yield Case("Kinova Gen3", str(number), joint, (one, two))


def _titles() -> dict[str, str]:
    return {**METHODS, **{name: each.title for name, each in SIMPLE.items()}}


def row_table(rows: Sequence[Row]) -> Table:
    """Return a table of few cases: RMSE [Nm], the best regression in bold; shares inside of the estimators."""
    names = ", ".join(METHODS.values())

    def number(row: Row, name: str) -> str:
        if name not in row.rmse_nm:
            return "-"
        bold = "**" * (name == row.best_simple)
        return f"{bold}{row.rmse_nm[name]:.3f}{bold}"

    def shares(each: Mapping[str, float]) -> str:
        return ", ".join("-" if np.isnan(each.get(n, np.nan)) else f"{each[n]:.0f} %" for n in METHODS)

    return Table(
        ("joint, judged on", *_titles().values(), f"inside 90 %: {names}", f"standstill: {names}"),
        [
            (
                f"{row.name}, {row.judged}",
                *(number(row, name) for name in _titles()),
                shares(row.inside),
                shares(row.standing),
            )
            for row in rows
        ],
    )


def summary_table(rows: Sequence[Row]) -> Table:
    """Return a table of many cases, one line per world: RMSE in percent of the rated torque, median and worst."""
    names = {OURS: "ours", "best": "best regression in hindsight", **_titles()}
    worlds = {row.world: [each for each in rows if each.world == row.world] for row in rows}
    return Table(
        ("world, fits", *names.values(), "ours at most the best", "inside our 90 %", "of fits, 85 to 95 %"),
        [
            (
                f"{world}, {len(found)}",
                *(
                    _spread([_percent(row, name) for row in found if name == "best" or name in row.rmse_nm])
                    for name in names
                ),
                f"{100.0 * np.mean([row.reached for row in found]):.0f} %",
                f"{np.mean([row.inside[OURS] for row in found]):.0f} %",
                f"{100.0 * np.mean([row.honest for row in found]):.0f} %",
            )
            for world, found in worlds.items()
        ],
    )


def _percent(row: Row, name: str) -> float:
    return 100.0 * row.rmse_nm[row.best_simple if name == "best" else name] / row.rated_nm


def _spread(values: Sequence[float]) -> str:
    return f"{np.median(values):.1f}, {max(values):.0f}" if len(values) else "-"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--world", choices=("plants", "mujoco", "kinova"), default="plants")
    parser.add_argument("--first", type=int, metavar="SEED", help="of plants and mujoco")
    parser.add_argument("--seeds", type=count, default=25, metavar="N", help="default %(default)s")
    parser.add_argument(
        "--joints",
        type=int,
        nargs="+",
        choices=range(2, 8),
        default=list(JOINTS),
        metavar="N",
        help="of kinova",
    )


def run(options: argparse.Namespace) -> Report:
    if options.world == "kinova":
        rows = [row for case in kinova_cases(options.joints) for row in rows_of(case)]
        reached, honest = sum(row.reached for row in rows), sum(row.honest for row in rows)
        note = (
            f"ours: error at most that of the best simple regression in {reached} of {len(rows)}; "
            f"interval {INSIDE[0]:.0f} to {INSIDE[1]:.0f} % in {honest} of {len(rows)}; "
            f"on average {np.mean([row.inside['ours'] for row in rows]):.0f} %"
        )
        return Report([row_table(rows)], {}, [note], rows)
    first = SEEDS[options.world].start if options.first is None else options.first
    seeds = range(first, first + options.seeds)
    if options.world == "mujoco":
        cases = list(mujoco_cases(seeds))
    else:
        cases = [case for plant in the_three() for case in plant_cases(plant, seeds)]
    named = {"seeds": f"{seeds[0]} to {seeds[-1]}"}
    rows = [row for case in cases for row in rows_of(case)]
    return Report([summary_table(rows)], named, values=rows)
