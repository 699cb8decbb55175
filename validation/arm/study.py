"""External torque of a foreign arm: an estimator and the momentum observer on motor current, judged on held-out days.

Arms are drawn, identified from free motion with two payloads, and judged on days with pushes and clamps and on quiet days.
The judged method decides the exit status. `oracle` has the true model and knows payload and contact: what joints as wrong
as these allow. `zero` says that nothing ever pushes. With `--joints fitted` each joint is fitted on a towing bench and
publishes what the product's estimator makes of its readings; else it is as wrong as `trial.ERRORS` says.

python -m validation external_torque --quick             few days: shares are wide
python -m validation external_torque --jobs 2            30 days and 3 quiet hours of two plants, about an hour of processor
"""

from __future__ import annotations

import argparse
import importlib
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, cast

import numpy as np

from jtqd.estimator.command_line import count, natural
from validation.arm.arm import CYCLE_S, URDF, Joints, Readings, Run, Truth, read
from validation.arm.baseline import Baseline, best_payload
from validation.arm.judge import (
    LIGHTEST_KG,
    Figures,
    Found,
    Published,
    Row,
    curve_rows,
    figures,
    judge,
    of_the_past,
    oracle,
    rows,
    zero,
)
from validation.arm.trial import ERRORS, LEARN_S, QUIET_S, Trial, User, batches, error_process
from validation.study import Report, Table, UsageError, in_processes, percent

SEED: Final = 38021
"""Of the judging days; 38001 to 38020 are for practice."""
BASELINE: Final = "baseline"
STATED, FITTED = "stated", "fitted"
METHODS: Final = ("oracle", "zero")
AT_ONCE: Final = 10
"""Runs side by side."""
Method = Callable[[Run, Truth, Readings], Published]
Factory = Callable[[User], Callable[[Readings], Published]]


class Work(NamedTuple):
    """One arm of one plant: its days with contact, its quiet ones, the methods."""

    plant: str
    seed: int
    arm: int
    days: Sequence[int]
    quiet: Sequence[int]
    methods: Sequence[str]
    fitted: bool = False


class Done(NamedTuple):
    """What the runs tell by method; best: errors of payloads as `best_payload` finds them; processor time of a cycle."""

    plant: str
    found: dict[str, list[Found]]
    best: list[tuple[float, float]]
    cost_us: dict[str, float]
    past: bool | None = None


def made_of(name: str) -> Factory:
    """Return the factory of MODULE:NAME. Raises UsageError."""
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise UsageError(f"--method: {name}: {error}") from None
    if not callable(found):
        raise UsageError(f"--method: {name}: found no function")
    return cast(Factory, found)


def judged(work: Work) -> Done:
    """Identify and run one arm."""
    trial = Trial(work.plant, work.seed, work.arm)
    arm = trial.arm
    joints: Joints = partial(error_process, plant=work.plant)
    if work.fitted:
        from validation.arm.joints import RealJoints, towed

        joints = RealJoints(arm, *towed(arm))
    identification = []
    for part in batches(trial.identification(), AT_ONCE):
        for each, truth in zip(part, arm.record([one.run for one in part]), strict=True):
            identification.append((read(arm, each.run, truth, joints), each.payload))
    baseline = Baseline(arm, identification)
    made: dict[str, Method] = {
        "oracle": lambda run, truth, readings: oracle(arm, run, truth, readings),
        "zero": lambda run, truth, readings: zero(arm, readings, work.plant),
        BASELINE: lambda run, truth, readings: baseline.run(readings),
    }
    judged_one = work.methods[0]
    foreign: Callable[[Readings], Published] | None = None
    if judged_one not in made:
        values = arm.nominal
        user = User(
            URDF,
            arm.rated_nm,
            arm.ratio,
            values["torque_constant_nm_per_a"],
            values["rotor_kgm2"],
            identification,
        )
        foreign = estimate = made_of(judged_one)(user)
        made[judged_one] = lambda run, truth, readings: estimate(readings)
    past: bool | None = None
    found: dict[str, list[Found]] = {name: [] for name in work.methods}
    spent, cycles = dict.fromkeys(work.methods, 0.0), 0
    best = []
    for days, drawn in ((work.days, trial.contact), (work.quiet, trial.quiet)):
        for part in batches(days, AT_ONCE):
            runs = [drawn(day) for day in part]
            for run, truth in zip(runs, arm.record(runs), strict=True):
                readings = read(arm, run, truth, joints)
                cycles += len(readings.time_s)
                if run.contacts and run.payload.mass_kg >= LIGHTEST_KG:
                    payload = best_payload(arm, truth, readings, work.plant)
                    away = np.linalg.norm(np.subtract(payload.centre_m, run.payload.centre_m))
                    best.append((abs(payload.mass_kg / run.payload.mass_kg - 1.0), float(away)))
                for name in work.methods:
                    begin = time.process_time()
                    published = made[name](run, truth, readings)
                    spent[name] += time.process_time() - begin
                    found[name].append(judge(arm, run, truth, readings, published))
                    if foreign is not None and name == judged_one and past is None:
                        past = of_the_past(foreign, readings, published)
    cost_us = {name: 1e6 * spent[name] / max(cycles, 1) for name in work.methods}
    return Done(work.plant, found, best, cost_us, past)


def works(options: argparse.Namespace) -> list[Work]:
    """Return the arms of all plants with their days."""
    days, hours = (3, 0.06) if options.quick else (options.days, options.quiet_hours)
    arms = 1 if options.quick else options.arms
    quiet = math.ceil(3600.0 * hours / (QUIET_S - LEARN_S))
    if options.method not in METHODS:
        made_of(options.method)
    names = list(dict.fromkeys((options.method, BASELINE, *METHODS)))
    return [
        Work(
            plant,
            options.seed,
            arm,
            range(arm, days, arms),
            range(arm, quiet, arms),
            names,
            options.joints == FITTED,
        )
        for plant in options.plant or tuple(ERRORS)
        for arm in range(arms)
    ]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plant", action="append", choices=tuple(ERRORS), help="laws of the joints (default both)"
    )
    parser.add_argument(
        "--method",
        default="oracle",
        metavar="NAME",
        help="judged: oracle (default), zero, or MODULE:FUNCTION, which takes a `trial.User` and returns a function of a "
        "day's `arm.Readings` to `judge.Published`",
    )
    parser.add_argument(
        "--joints",
        choices=(STATED, FITTED),
        default=STATED,
        help="what a jtqd per joint publishes: as wrong as stated (default), or fitted and estimated",
    )
    parser.add_argument("--seed", type=natural, default=SEED, help="of arms and days (default %(default)s)")
    parser.add_argument("--arms", type=count, default=3, help="per plant (default %(default)s)")
    parser.add_argument("--days", type=count, default=30, help="with contacts (default %(default)s)")
    parser.add_argument("--quiet-hours", type=float, default=3.0, help="without (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="one arm, three days, four quiet minutes")
    parser.add_argument("--jobs", type=count, default=1, metavar="N", help="arms at a time (default 1)")


def run(options: argparse.Namespace) -> Report:
    work = works(options)
    done = list(in_processes(judged, work, options.jobs, "arms"))
    tables, values, notes, reached = [], {}, list(NOTES), True
    for plant in dict.fromkeys(each.plant for each in work):
        own = [each for each in done if each.plant == plant]
        names = list(own[0].found)
        made = [figures([f for each in own for f in each.found[name]], plant) for name in names]
        cost = float(np.mean([each.cost_us[names[0]] for each in own]))
        pasts = [each.past for each in own if each.past is not None]
        found = rows(plant, made, np.nan if names[0] in METHODS else cost, all(pasts) if pasts else None)
        reached = reached and all(row.reached is not False for row in found)
        notes.append(_noted(plant, [one for each in own for one in each.best]))
        tables += [
            _table(found, names, f"{plant}: {_sizes(own[0].found[names[0]], len(own))}"),
            _curve(made, names),
        ]
        values[plant] = dict(zip(names, (each._asdict() for each in made), strict=True))
    return Report(tables, {"trial": options.seed}, notes, values, reached)


NOTES: Final = (
    f"Days count after {LEARN_S:g} s of free motion, in which the payload may be learned; cycle {CYCLE_S:g} s.",
    "Link right: of contacts that the link's own joint can feel; the point where three joints are before it.",
)


def _noted(plant: str, best: Sequence[tuple[float, float]]) -> str:
    """Return what the figures of payloads would be with the true model and motion."""
    if not best:
        return f"{plant}: no payload to be found"
    mass, centre = np.median(best, axis=0)
    return f"{plant}: payload by least squares with the true model: half of the days {percent(mass)}, {100 * centre:.1f} cm"


def _sizes(found: Sequence[Found], arms: int) -> str:
    return f"{arms} arms, {len(found)} days, {sum(len(each.events) for each in found)} contacts"


def _table(found: Sequence[Row], names: Sequence[str], title: str) -> Table:
    marks = {True: "yes", False: "NO", None: ""}
    filled = [[*row.cells, *[""] * (len(names) - len(row.cells))] for row in found]
    return Table(
        ("figure", "to reach", *names, "reached"),
        [(row.what, row.limit, *cells, marks[row.reached]) for row, cells in zip(found, filled, strict=True)],
        title,
    )


def _curve(made: Sequence[Figures], names: Sequence[str]) -> Table:
    return Table(
        ("pushes reported in time, by force", *names), [(row.what, *row.cells) for row in curve_rows(made)]
    )
