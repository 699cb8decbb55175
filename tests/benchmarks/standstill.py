r"""Does the interval of a standing joint hold the true torque? Joint files without and with section `fused.standstill`.

    python -m tests.benchmarks.standstill table typical bad_day --runs 32 --fit-seed 1 --seed 9571
    python -m tests.benchmarks.standstill table typical bad_day --link-zero 1e-4
    python -m tests.benchmarks.standstill --world 9561 9562

Plants: joints fitted to so many runs of a campaign; judged on other days, 30 runs: `start`, before the first motion, and
`stop`, after it; `begun`, as `stop`, but the estimator begins in the stop, so that the slip of the torsion is anything;
`push`, a joint that came to rest and is held is pushed from outside by up to so much as its friction holds, either way, one
second each. `--link-zero`: so much is added to the link encoder [rad] from the first sample on. `--world`: the MuJoCo bench
(tests/worlds), joints fitted on ten runs of each seed and judged on six from among them. Settings are those of a new
configuration. Only samples with status 6 count.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.age import aligned
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.run import EstimateRun, RunTable
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sim_can.emulated_run import JointCommand, Push, emulate
from jtqd.sysid.goals.identify import QUICK, drive, identify_physics, judging_runs, nominal_joints
from jtqd.sysid.goals.plants import PlantFile, the_three
from tests.benchmarks.envelope import judging_runs as world_runs

SETTLED_S: Final = 0.1
FEWEST: Final = 50
PUSHED_DAYS: Final = 12
STOP_S: Final = 3.0
PUSHES_NM: Final = (3.0, -3.0, 8.0, -8.0)


class Row(NamedTuple):
    """Of one joint in one run at rest: share held, half width and RMSE [Nm], samples."""

    inside: float
    half_nm: float
    square_nm2: float
    samples: int


Rows = dict[str, list[tuple[Row, Row]]]
"""By situation: without and with the section."""


class Observed(NamedTuple):
    """Estimates of a run and their error against the torque as old [Nm], arrays [n]."""

    got: EstimateRun
    error_nm: FloatArray


def estimated(joint: Joint, table: RunTable, number: int, truth_nm: FloatArray, first: int = 0) -> Observed:
    """Estimate one joint of a run from sample `first` on."""
    settings = recommended("fused")
    columns = table.joint(number, joint.gear_ratio)
    inputs = table.estimator_inputs(number, joint.gear_ratio)[1:]
    got = make_estimator(joint, settings).run(
        table.dt_s[first:],
        *(each[first:] for each in inputs),
        None if columns.temperature_c is None else columns.temperature_c[first:],
    )
    return Observed(got, got.torque_nm - aligned(truth_nm[first:], table.dt_s[first:], joint, settings))


def row(seen: Observed, where: BoolArray) -> Row | None:
    """Return the row of samples at rest; None for too few."""
    rest = where & (seen.got.status == STANDSTILL)
    count = int(np.count_nonzero(rest))
    if count < FEWEST:
        return None
    error, half = seen.error_nm[rest], seen.got.sigma_nm[rest]
    return Row(float(np.mean(np.abs(error) <= half)), float(half.mean()), float(error @ error) / count, count)


def situations(joint: Joint, table: RunTable, number: int, truth_nm: FloatArray) -> Iterator[tuple[str, Row]]:
    """Yield (situation, row) of one joint in one run: start, stop, begun."""
    time_s = table.time_s - table.time_s[0]
    whole = estimated(joint, table, number, truth_nm)
    moved = np.maximum.accumulate(np.isin(whole.got.status, (VALID, DEGRADED)))
    for name, where in (("start", ~moved & (time_s > SETTLED_S)), ("stop", moved)):
        found = row(whole, where)
        if found is not None:
            yield name, found
    moving = np.flatnonzero(np.isin(whole.got.status, (VALID, DEGRADED)))
    if len(moving) and len(time_s) - moving[-1] > FEWEST + 200:
        first = int(moving[-1]) + 100
        late = estimated(joint, table, number, truth_nm, first)
        found = row(late, time_s[first:] - time_s[first] > SETTLED_S)
        if found is not None:
            yield "begun", found


def both(
    joint: Joint, table: RunTable, number: int, truth_nm: FloatArray
) -> Iterator[tuple[str, tuple[Row, Row]]]:
    """Yield (situation, rows without and with the section)."""
    assert joint.fused is not None
    plain = replace(joint, fused=replace(joint.fused, standstill=None))
    without, with_section = (dict(situations(each, table, number, truth_nm)) for each in (plain, joint))
    for name in without:
        if name in with_section:
            yield name, (without[name], with_section[name])


def pushed_run(plant: PlantFile, seed: int, day: int) -> tuple[RunTable, FloatArray]:
    """Return a run in which both joints move, come to rest, and are pushed while they are held; with the true torques."""
    source = np.random.default_rng([seed, day])
    speed, rate, load = source.uniform((0.5, 2.0, 0.5), (1.2, 3.5, 2.5)).tolist()

    def ending(t: float) -> float:
        return min(1.0, max(0.0, 2.0 * (STOP_S - t)))

    commands = (
        JointCommand.velocity(lambda t: ending(t) * speed * math.sin(rate * t)),
        JointCommand.current(lambda t: ending(t) * load * math.sin(1.1 * rate * t)),
    )
    factor = float(source.uniform(0.6, 1.2))
    pushes = [Push(STOP_S + 1.0 + k, factor * torque) for k, torque in enumerate(PUSHES_NM)]
    made = emulate(plant.bench(), commands, STOP_S + 1.0 + len(PUSHES_NM), seed, day=day, pushes=pushes)
    return made.table, made.joint_torque_nm


def zeroed(table: RunTable, link_zero_rad: float) -> RunTable:
    """Return the run with a zero added to the link encoders."""
    joints = {}
    for number, columns in table.joints.items():
        assert columns.link_position_rad is not None
        joints[number] = replace(columns, link_position_rad=columns.link_position_rad + link_zero_rad)
    return replace(table, joints=joints)


def of_plant(
    runs: int, fit_seed: int, seed: int, link_zero_rad: float, plant: PlantFile
) -> tuple[list[float], Rows]:
    """Return the factors of both joints and the rows of a plant."""
    models, _ = identify_physics(plant, QUICK._replace(fit_runs=runs, evaluations=60), fit_seed)
    days = drive(plant.bench(), judging_runs(QUICK, nominal_joints(plant), seed), seed)
    found: Rows = {}
    for one in models:
        for day in days:
            truth = np.ascontiguousarray(day.true_nm[:, one.number - 1])
            for name, rows in both(one.joint, zeroed(day.table, link_zero_rad), one.number, truth):
                found.setdefault(name, []).append(rows)
    for day_number in range(PUSHED_DAYS):
        table, truths = pushed_run(plant, seed, day_number)
        table = zeroed(table, link_zero_rad)
        time_s = table.time_s - table.time_s[0]
        for one in models:
            assert one.joint.fused is not None
            plain = replace(one.joint, fused=replace(one.joint.fused, standstill=None))
            truth = np.ascontiguousarray(truths[:, one.number - 1])
            pair = [
                row(estimated(joint, table, one.number, truth), time_s > STOP_S + 1.0)
                for joint in (plain, one.joint)
            ]
            if pair[0] is not None and pair[1] is not None:
                found.setdefault("push", []).append((pair[0], pair[1]))
    return [_factor(one.joint) for one in models], found


def of_seed(seed: int) -> tuple[list[float], Rows]:
    """Return the factors of the joints and the rows of one seed of the bench of others."""
    found: Rows = {}
    factors: dict[str, float] = {}
    for run in world_runs("mixed", seed):
        factors[run.joint.name] = _factor(run.joint)
        for name, rows in both(run.joint, run.table, run.number, run.truth_nm):
            found.setdefault(name, []).append(rows)
    return list(factors.values()), found


def _factor(joint: Joint) -> float:
    assert joint.fused is not None
    return math.nan if joint.fused.standstill is None else joint.fused.standstill.sigmas


def lines(title: str, factors: list[float], found: Rows) -> Iterator[str]:
    """Yield the table of a plant."""
    yield f"{title}: sigmas {', '.join(f'{each:.2f}' for each in factors)}"
    for name, rows in found.items():
        parts = []
        for k in (0, 1):
            inside, half, square, samples = np.array([pair[k] for pair in rows]).T
            total = np.average(inside, weights=samples)
            parts.append(
                f"{100 * total:5.1f} %, below 90 % {np.count_nonzero(inside < 0.9):2}, worst {100 * inside.min():3.0f} %, "
                f"half {np.average(half, weights=samples):5.2f} Nm, "
                f"RMSE {math.sqrt(np.average(square, weights=samples)):5.2f}"
            )
        yield f"  {name:6} {len(rows):3} runs | {' | '.join(parts)}"


def main() -> None:
    """Print a table per plant, or of the bench of others."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="table, typical, bad_day")
    parser.add_argument("--runs", type=int, default=32, help="of the campaign (default %(default)s)")
    parser.add_argument("--fit-seed", type=int, default=1)
    parser.add_argument("--seed", type=int, default=9571)
    parser.add_argument("--link-zero", type=float, default=0.0, metavar="RAD")
    parser.add_argument("--world", type=int, nargs="+", default=[], metavar="SEED")
    options = parser.parse_args()
    named = dict(zip(("table", "typical", "bad_day"), the_three(), strict=True))
    with ProcessPoolExecutor(2) as pool:
        work = partial(of_plant, options.runs, options.fit_seed, options.seed, options.link_zero)
        for name, (factors, found) in zip(
            options.plants, pool.map(work, [named[name] for name in options.plants]), strict=True
        ):
            print("\n".join(lines(name, factors, found)), flush=True)
        whole: Rows = {}
        every: list[float] = []
        for factors, found in pool.map(of_seed, options.world):
            every += factors
            for name, rows in found.items():
                whole.setdefault(name, []).extend(rows)
        if every:
            print("\n".join(lines("of others", every, whole)))


if __name__ == "__main__":
    main()
