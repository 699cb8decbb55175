"""`jtq campaign`: plans, checks and runs a campaign; docs/campaign.md."""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any, Final

from estimator.checked import ConfigError
from models.files import shipped
from sysid.campaign import dry_run
from sysid.campaign.bench_config import BenchConfig
from sysid.campaign.fourier_runs import seed_of
from sysid.campaign.one_run import Bench, attempt
from sysid.campaign.options import EMULATED, PLANT, emulated, misuse, parser, recipe, scale_of, wanted_plan
from sysid.campaign.plan import Plan
from sysid.campaign.processes import EmulatedBench, ProcessError, StopAsked, unix_bus
from sysid.campaign.progress import Designing, Reporter
from sysid.campaign.runner import Outcome, go_through
from sysid.campaign.segments import check_plan
from sysid.campaign.state import DONE, CampaignDirectory, StateError
from sysid.motion.setpoints import Setpoints

_MASTER_GONE: Final = "fault 8130h"
"""Drives watch jtqd's heartbeat (1016h:1): when jtqd ended with the run before, they went to this fault, powered off."""


def main(argv: list[str]) -> int:
    """Plan and run; exit status 0 done, 1 failure or ended early, 2 usage, 3 done with findings."""
    options = parser().parse_args(argv)
    problem = misuse(options)
    if problem:
        print(f"jtq campaign: {problem}", file=sys.stderr)
        return 2
    try:
        return _dry(options) if options.dry_run else _campaign(options)
    except (ConfigError, StateError, ProcessError) as error:
        print(f"jtq campaign: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"jtq campaign: {error.filename or options.out}: {error.strerror or error}", file=sys.stderr)
        return 1


def _made(options: argparse.Namespace, config: BenchConfig) -> Plan:
    """The plan, with a bar or a line where making it takes its time."""
    if options.plan != "excitation":
        return wanted_plan(options, config.joints)
    with Designing(scale_of(options, config.joints).motions_tried) as designing:
        return wanted_plan(options, config.joints, designing.advance)


def _checked(plan: Plan, options: argparse.Namespace) -> dict[str, Setpoints]:
    try:
        return check_plan(plan)
    except ConfigError as error:
        raise ConfigError(f"{options.plan}: {error}") from None


def _dry(options: argparse.Namespace) -> int:
    config = BenchConfig.load(options.config)
    load = config.load_with_commander()
    plan = _made(options, config)
    setpoints = _checked(plan, options)
    if options.json:
        print(json.dumps(dry_run.content(plan, setpoints, load)))
    else:
        print(dry_run.text(plan, setpoints, load))
    return 0


def _campaign(options: argparse.Namespace) -> int:
    config = BenchConfig.load(options.config)
    config.load_with_commander()  # refuses what does not fit the bus
    made_from = recipe(options, config.joints)
    directory = CampaignDirectory(options.out)
    try:
        plan = directory.same_recipe(made_from) or _made(options, config)
        setpoints = _checked(plan, options)
        directory.begin(plan, made_from)
        outcome = _run(options, config, plan, setpoints, directory)
    finally:
        directory.close()
    print(json.dumps(outcome.content()) if options.json else outcome.text())
    return outcome.exit_status


def _run(
    options: argparse.Namespace,
    config: BenchConfig,
    plan: Plan,
    setpoints: dict[str, Setpoints],
    directory: CampaignDirectory,
) -> Outcome:
    to_do = [setpoints[run.name].duration_s for run in plan.runs if directory.runs[run.name].status != DONE]
    if not to_do:
        return Outcome(directory.runs)
    with _stop_flag() as stop_asked, _folder() as folder:
        bus, done = options.bus, len(plan.runs) - len(to_do)
        process: Any = nullcontext()
        if emulated(bus):
            bus = bus.removeprefix(EMULATED).removeprefix(":") or unix_bus(folder)
            process = EmulatedBench(
                bus, folder, options.plant or shipped(PLANT), _bench_seed(plan, options, done)
            )
        with process, Reporter(to_do, len(plan.runs), done) as reporter, _commander_says(reporter):
            bench = Bench(bus, options.config, config)
            motion = bench.play(plan.limits, reporter.on_progress)
            return go_through(
                plan,
                setpoints,
                directory,
                reporter,
                lambda run, points: attempt(
                    run, points, bench, directory.path, motion=motion, stop_asked=stop_asked
                ),
                keep_going=options.keep_going,
            )


def _bench_seed(plan: Plan, options: argparse.Namespace, done: int) -> int:
    """Other days of the emulated bench, and other noise, for every campaign, and for what is left of one.

    Runs that are to judge must not take place on the days that were trained on.
    """
    return seed_of(f"bench/{plan.name}", float(done), options.seed)


class _Said(logging.Handler):
    """What the commander logs, to the reporter; but not what jtqd's own end leaves behind in every run."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__()
        self._reporter = reporter

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if _MASTER_GONE not in text:
            self._reporter.say(text)


@contextmanager
def _commander_says(reporter: Reporter) -> Iterator[None]:
    logger, handler = logging.getLogger("sysid.motion"), _Said(reporter)
    logger.addHandler(handler)
    propagate, logger.propagate = logger.propagate, False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


@contextmanager
def _folder() -> Iterator[Path]:
    """A short path: the address of a unix socket holds 107 bytes."""
    folder = Path(tempfile.mkdtemp(prefix="jtq-campaign-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _stop_flag() -> Iterator[StopAsked]:
    """SIGINT and SIGTERM set a flag between motions; during one the commander takes them itself."""
    taken: list[int] = []

    def take(number: int, frame: FrameType | None) -> None:
        taken.append(number)

    before = {number: signal.signal(number, take) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(taken)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
