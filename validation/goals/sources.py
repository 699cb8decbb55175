"""What the error of our estimate on a bench of docs/testing.md is made of.

Three tables, in % of rated torque, RMSE in motion:

| table | how |
|---|---|
| parts | the error, split: constant in a run, over the motor's turn, over the link's turn, slow, the rest |
| known | what it would be if more were known than a fit can: the day's zeros, the true torsion; the age alone |
| sources | one effect taken out of the plant, in the campaign as in the judging runs: identified again, judged again |

Ours, zeros tracked, as a new configuration has it. Days are those of practice, not those of the goals' table.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.command_line import count
from jtqd.estimator.joint import Fused, Torsion
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import EstimatorSettings, bandwidth_of
from jtqd.models.files import shipped
from jtqd.sim_can.towing.bench_file import AngleWave, TowedJoint, TowingBench
from jtqd.sysid.fit.calibration import calibrated, fit_sigma, path_residuals
from jtqd.sysid.fit.fused import fit_zeros
from jtqd.sysid.fit.signals import run_signals
from jtqd.sysid.planner.campaigns import make_plan
from jtqd.sysid.planner.plan import Run
from validation.goals.goals import LOW_PASS, ZEROS, Judged, judge, settings_of
from validation.goals.identify import (
    QUICK,
    TINY,
    Driven,
    Identified,
    Mapped,
    PlantFile,
    Sizes,
    drive,
    fit_physics,
    judging_runs,
    nominal_joints,
    of_sides,
    plant_file,
    scale_of,
)
from validation.study import Report, Table, in_processes

SIZES: Final = {"usual": QUICK._replace(fit_runs=16, evaluations=40, judge_runs=12), "tiny": TINY}
PLANTS: Final = ("typical", "bad_day")
SEED, FIT_SEED = 500, 2
"""Of practice: choices may be made by looking at these tables."""
MOTOR_ORDERS: Final = (1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0, 12.0, 14.0)
LINK_ORDERS: Final = (1.0, 2.0, 3.0)
SLOW_HZ: Final = 1.0
PARTS: Final = ("constant in a run", "motor's turn", "link's turn", "slower than 1 Hz", "the rest")


def _days(*names: str) -> Callable[[Mapped], None]:
    def without(mapping: Mapped) -> None:
        for name in names:
            mapping["run_to_run"][name] = 0.0

    return without


def _each(**sections: Mapped) -> Callable[[Mapped], None]:
    @of_sides
    def without(side: Mapped) -> None:
        for section, values in sections.items():
            side[section] |= values

    return without


@of_sides
def _straight(side: Mapped) -> None:
    side["gear"]["stiffness_nm_per_rad"] = 3 * [side["gear"]["stiffness_nm_per_rad"][1]]


SOURCES: Final[Mapping[str, Callable[[Mapped], None]]] = {
    "zeros of the encoders, by day": _days("link_zero_rad", "motor_zero_rad"),
    "friction, by day": _days("viscous", "coulomb"),
    "temperature, by day": _days("temperature_k"),
    "zero and gain of the current, by day": _days("current_zero_a", "current_gain"),
    "waves of friction over the motor's turn": _each(friction={"angle": []}),
    "friction by load": _each(friction={"load_nm": 0.0}),
    "kinematic errors of the gear": _each(gear={"errors": []}),
    "errors of the motor encoder": _each(measurement={"motor_errors": []}),
    "errors of the link encoder": _each(measurement={"link_errors": []}),
    "slips of the gear": _each(gear={"slips": []}),
    "hardening of the spring": _straight,
    "cogging and ripple of the current": _each(motor={"cogging": []}, measurement={"current_ripple": []}),
    "noise of link encoder and current": _each(measurement={"link_noise_rad": 0.0, "current_noise_a": 0.0}),
}
"""What is taken out, by name."""


class Scored(NamedTuple):
    """RMSE in % of rated: with the low pass against the torque as old; against that of now, with it and tracked."""

    aligned: float
    now: float
    tracked: float


def scored(judged: Sequence[Judged]) -> Scored:
    """Return the figures of joints in runs, over all samples in motion."""

    def rmse(error: Callable[[Judged], FloatArray]) -> float:
        every = np.concatenate([error(one)[one.moving] / one.rated_nm for one in judged])
        return 100.0 * float(np.sqrt(np.mean(every * every)))

    return Scored(
        rmse(lambda one: one.results[LOW_PASS].error_nm),
        rmse(lambda one: one.results[LOW_PASS].torque_nm - one.true_nm),
        rmse(lambda one: one.results[ZEROS].torque_nm - one.true_nm),
    )


def parts_of(error_nm: FloatArray, motor_rad: FloatArray, link_rad: FloatArray, dt_s: float) -> FloatArray:
    """Return the mean squares [Nm^2] of PARTS, in this order, of one error [n] in motion; they add up to its own.

    The mean first, then waves of both turns by least squares together, then a moving mean of what is left.
    """
    mean = float(error_nm.mean())
    turns = [
        [wave(order * angle) for order in orders for wave in (np.cos, np.sin)]
        for angle, orders in ((motor_rad, MOTOR_ORDERS), (link_rad, LINK_ORDERS))
    ]
    columns = np.column_stack([*turns[0], *turns[1]])
    columns -= columns.mean(axis=0)
    weights = np.linalg.lstsq(columns, error_nm - mean, rcond=None)[0]
    first = 2 * len(MOTOR_ORDERS)
    motor, link = columns[:, :first] @ weights[:first], columns[:, first:] @ weights[first:]
    left = error_nm - mean - motor - link
    width = min(max(round(0.5 / (SLOW_HZ * dt_s)), 1), len(left))
    slow = np.convolve(left, np.ones(width) / width, mode="same")
    both = float(np.mean((motor + link) ** 2))
    own = np.array([np.mean(motor * motor), np.mean(link * link)])
    shares = both * own / max(float(own.sum()), 1e-300)  # hardly correlated, but not exactly
    squares = (mean * mean, *shares.tolist(), float(np.mean(slow * left)))
    return np.array([*squares, float(np.mean(error_nm * error_nm)) - sum(squares)])


def table_of_parts(
    judged: Sequence[Judged], runs: Sequence[Driven], models: Sequence[Identified]
) -> FloatArray:
    """Return the parts of all joints in runs, mean squares in (% of rated)^2."""
    by_name, by_number = {run.name: run for run in runs}, {one.number: one for one in models}
    total, samples = np.zeros(len(PARTS)), 0
    for one in judged:
        run, joint = by_name[one.run], by_number[one.number].joint
        columns = run.columns(one.number, joint)
        assert columns.motor_position_rad is not None
        assert columns.link_position_rad is not None
        if np.count_nonzero(one.moving) < 1000:
            continue
        error = (100.0 / one.rated_nm) * one.results[LOW_PASS].error_nm[one.moving]
        motor, link = columns.motor_position_rad[one.moving], columns.link_position_rad[one.moving]
        total += len(error) * parts_of(error, motor, link, float(run.table.dt_s[1:].mean()))
        samples += len(error)
    result: FloatArray = total / max(samples, 1)
    return result


def true_torsion(side: TowedJoint) -> Torsion:
    """Return the torsion of a bench's joint as the parameters of its file say, encoders' errors included, zero 0."""
    gear, measured, ratio = side.gear, side.measurement, side.joint.gear_ratio
    k1, k2, k3 = gear.stiffness_nm_per_rad
    first = gear.corners_nm[0] / k1
    second = first + (gear.corners_nm[1] - gear.corners_nm[0]) / k2
    motor = _summed(
        [(wave, -1.0) for wave in gear.errors] + [(wave, 1.0 / ratio) for wave in measured.motor_errors]
    )
    link = _summed([(wave, -1.0) for wave in measured.link_errors])
    return Torsion(
        stiffness_nm_per_rad=k1,
        cubic_nm_per_rad3=0.0,
        zero_rad=0.0,
        orders_per_motor_rev=tuple(motor) or (2.0,),
        cos_rad=tuple(c for c, _ in motor.values()) or (0.0,),
        sin_rad=tuple(s for _, s in motor.values()) or (0.0,),
        damping_nms_per_rad=gear.damping_nms_per_rad,
        link_orders_per_rev=tuple(link),
        link_cos_rad=tuple(c for c, _ in link.values()),
        link_sin_rad=tuple(s for _, s in link.values()),
        hardening_rad=(first, second),
        hardening_nm_per_rad=(k2 - k1, k3 - k2),
        slips_nm=tuple(slip.torque_nm for slip in gear.slips),
        slips_travel_rad=tuple(slip.travel_rad for slip in gear.slips),
    )


def _summed(waves: Sequence[tuple[AngleWave, float]]) -> dict[float, tuple[float, float]]:
    """Return (cos, sin) by order of the sum of factor amplitude cos(order angle + phase)."""
    found: dict[float, tuple[float, float]] = {}
    for wave, factor in waves:
        c, s = found.get(wave.order, (0.0, 0.0))
        size = factor * wave.amplitude_rad
        found[wave.order] = (c + size * math.cos(wave.phase_rad), s - size * math.sin(wave.phase_rad))
    return found


def knowing(
    one: Identified, torsion: Torsion, excitation: Sequence[Driven], zeros: Mapping[str, float]
) -> Identified:
    """Return a joint with this torsion, its variances found again on the runs of the fit; zeros [rad]: known, by run."""
    joint, settings = one.joint, EstimatorSettings(method="fused")
    assert joint.fused is not None
    found = []
    for run in excitation:
        columns = run.columns(one.number, joint)
        assert columns.link_position_rad is not None
        columns = replace(columns, link_position_rad=columns.link_position_rad - zeros.get(run.name, 0.0))
        signals = run_signals(run.name, joint, settings, run.table.time_s, columns)
        if signals.moving.any():
            found.append(path_residuals(signals, joint.fused.loss, torsion))
    fused = Fused(joint.fused.loss, torsion, fit_sigma(found), tracking=joint.fused.tracking)
    if not zeros:  # else nothing is left to learn
        fused = replace(fused, zeros=fit_zeros(found, fused, joint.rated_torque_nm))
    fused = calibrated(found, fused, joint.rated_torque_nm)
    return replace(one, joint=replace(joint, fused=fused))


def day_zeros(bench: TowingBench, runs: Sequence[Driven], seed: int, number: int) -> dict[str, float]:
    """Return by run what the torsion's zero of its day is, as an angle of the link encoder [rad]."""
    ratio = bench.joints[number - 1].joint.gear_ratio
    found = {}
    for k, run in enumerate(runs):
        day = bench.run_to_run.day(seed, k)
        found[run.name] = day.link_zero_rad[number - 1] - day.motor_zero_rad[number - 1] / ratio
    return found


def _judged(
    runs: Sequence[Driven], models: Sequence[Identified], zeros: Sequence[Mapping[str, float]] | None = None
) -> list[Judged]:
    found = []
    for run in runs:
        for one in models:
            off = 0.0 if zeros is None else zeros[one.number - 1][run.name]
            link = None if zeros is None else (lambda link, motor, off=off: link - off)
            found.append(judge(run, one, link, (ZEROS, LOW_PASS)))
    return found


def age_alone(judged: Sequence[Judged], models: Sequence[Identified], runs: Sequence[Driven]) -> float:
    """Return the RMSE [% of rated] of an estimate without any error that is as old as ours."""
    joints, dt = {one.number: one.joint for one in models}, {run.name: run.table.dt_s for run in runs}
    squares = []
    for one in judged:
        old = low_pass(one.true_nm, dt[one.run], bandwidth_of(joints[one.number], settings_of(LOW_PASS)))
        squares.append((((old - one.true_nm)[one.moving]) / one.rated_nm) ** 2)
    return 100.0 * float(np.sqrt(np.mean(np.concatenate(squares))))


class Plans(NamedTuple):
    """Motions of the campaign and of the judging runs: the same with whatever is taken out."""

    campaign: tuple[Run, ...]
    judging: tuple[Run, ...]


def planned(plant: PlantFile, sizes: Sizes) -> Plans:
    joints = nominal_joints(plant)
    plan = make_plan("excitation", scale_of(sizes, joints, FIT_SEED, "excitation"))
    return Plans(plan.runs, judging_runs(sizes, joints, SEED))


def without(plant: PlantFile, plans: Plans, names: Sequence[str]) -> Scored:
    """Return the figures of a plant without these sources, identified and judged. Raises as `identify`."""
    for name in names:
        plant = plant.changed(SOURCES[name])
    bench = plant.bench()
    models = fit_physics(nominal_joints(plant), drive(bench, plans.campaign, FIT_SEED))
    return scored(_judged(drive(bench, plans.judging, SEED), models))


def _row(name: str, found: Scored) -> tuple[str, ...]:
    return (name, f"{found.aligned:.2f}", f"{found.now:.2f}", f"{found.tracked:.2f}")


def _table(what: str, rows: Sequence[tuple[str, ...]]) -> Table:
    return Table((what, "low pass: aligned", "now", "torsion tracked: now"), rows)


def known_tables(plant: PlantFile, plans: Plans) -> list[Table]:
    """Return the tables `parts` and `known`. Raises as `identify`."""
    bench = plant.bench()
    assert isinstance(bench, TowingBench)
    excitation, runs = drive(bench, plans.campaign, FIT_SEED), drive(bench, plans.judging, SEED)
    models = fit_physics(nominal_joints(plant), excitation)
    fitted = [one.joint.fused.torsion for one in models if one.joint.fused is not None]
    assert all(torsion is not None for torsion in fitted)
    torsions = [torsion for torsion in fitted if torsion is not None]
    true = [true_torsion(side) for side in bench.joints]
    in_fit = [day_zeros(bench, excitation, FIT_SEED, one.number) for one in models]
    judging = [day_zeros(bench, runs, SEED, one.number) for one in models]
    judged = _judged(runs, models)
    parts = table_of_parts(judged, runs, models)
    shares = Table(
        ("part of the aligned error", "% of rated, RMS", "share of its square"),
        [
            (name, f"{np.sqrt(max(part, 0.0)):.2f}", f"{100 * part / parts.sum():.0f} %")
            for name, part in zip(PARTS, parts, strict=True)
        ],
    )
    # zero 0 is the mean day's: a fit's own zero_rad stands for it where days are known
    free = [replace(torsion, zero_rad=0.0) for torsion in torsions]
    none: list[dict[str, float]] = [{} for _ in models]
    rows = [_row("ours", scored(judged))]
    for name, given, zeros, off in (
        ("the zeros of the day", free, in_fit, judging),
        ("the true torsion", true, none, None),
        ("both", true, in_fit, judging),
    ):
        made = [knowing(one, t, excitation, z) for one, t, z in zip(models, given, zeros, strict=True)]
        rows.append(_row(name, scored(_judged(runs, made, off))))
    rows.append(("the torque itself, as old as ours", "0", f"{age_alone(judged, models, runs):.2f}", "-"))
    return [shares, _table("what is known", rows)]


def source_tables(plant: PlantFile, plans: Plans, only: bool, jobs: int) -> list[Table]:
    """Return the table `sources`; only: and that of each source alone. Raises as `identify`."""
    work = partial(without, plant, plans)
    out: dict[str, tuple[str, ...]] = {"nothing": (), **{name: (name,) for name in SOURCES}}
    out["all of these"] = tuple(SOURCES)
    others = {name: tuple(each for each in SOURCES if each != name) for name in SOURCES if only}
    tables = []
    for what, names in (("taken out", out), ("left in alone", others)):
        found = in_processes(work, list(names.values()), jobs, what)
        if names:
            rows = [_row(name, each) for name, each in zip(names, found, strict=True)]
            tables.append(_table(what, rows))
    return tables


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plant", choices=PLANTS, default="bad_day", help="default %(default)s")
    parser.add_argument("--sources", action="store_true", help="also take out one source after the other")
    parser.add_argument(
        "--only", action="store_true", help="--sources, and each source alone, all others out"
    )
    parser.add_argument("--tiny", action="store_true", help="to test the steps")
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="sources at a time (default 1)")


def run(options: argparse.Namespace) -> Report:
    plant = plant_file(options.plant, shipped(f"plants/{options.plant}.yaml"))
    plans = planned(plant, SIZES["tiny" if options.tiny else "usual"])
    tables = known_tables(plant, plans)
    if options.sources or options.only:
        tables += source_tables(plant, plans, options.only, options.jobs)
    note = (
        f"{plant.name}: campaign of {len(plans.campaign)} runs; {len(plans.judging)} runs of two joints judge; "
        "% of rated torque"
    )
    return Report(tables, {"judge": SEED, "fit": FIT_SEED}, [note])
