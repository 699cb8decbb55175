"""One run of a campaign: jtqd started, the motion played, jtqd ended, its log turned into the run's files."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from daemon.logs.reader import LogError
from sim_can.run_table_file import write_run
from sysid.campaign.bench_config import BenchConfig
from sysid.campaign.log_to_run import log_to_run
from sysid.campaign.plan import Run
from sysid.campaign.processes import Interrupted, Jtqd, ProcessError, StopAsked, on_time
from sysid.campaign.state import DONE, FAILED, PARTS, STOPPED, RunState
from sysid.campaign.table_checks import findings, unusable
from sysid.motion.limits import Limits
from sysid.motion.result import MotionError, MotionResult
from sysid.motion.setpoints import Setpoints
from sysid.motion.shell import Progress, play

_BUS_WAS_LATE: Final = re.compile(
    r"SYNC missing|missing for \d+ cycles|no heartbeat for|no temperature for|late by|transmit queue"
)
_SIGNALLED: Final = re.compile(r"SIGINT|SIGTERM")

Play = Callable[[Setpoints], MotionResult]
"""The motion itself: `sysid.motion.shell.play` on the bench, or what a test puts in its place. Raises MotionError."""


@dataclass(frozen=True)
class Bench:
    """Where the runs take place: bus, jtqd's configuration (None: the one that ships) and what is in it."""

    bus: str
    config_path: Path | None
    config: BenchConfig

    def play(self, limits: Limits, on_progress: Progress) -> Play:
        """The commander on this bench."""

        def motion(setpoints: Setpoints) -> MotionResult:
            with on_time():
                return play(
                    self.bus,
                    setpoints,
                    limits,
                    on_progress=on_progress,
                    drives=self.config.drives,
                    sensor=self.config.sensor,
                )

        return motion


class Attempt(NamedTuple):
    """How an attempt at a run ended.

    Attributes:
        state: to be kept. again: another attempt may fare better, because nothing but time was against this one.
        begun: the joints were moved; otherwise the bench itself is not ready. signalled: the operator ended it.
    """

    state: RunState
    again: bool = False
    begun: bool = True
    signalled: bool = False


class Recorded(NamedTuple):
    """What jtqd left of a run: parts of the log, summary; and where the run's files go."""

    log: tuple[Path, ...]
    summary: dict[str, Any]
    out: Path


def attempt(
    run: Run, setpoints: Setpoints, bench: Bench, out: Path, *, motion: Play, stop_asked: StopAsked
) -> Attempt:
    """Play a run and leave its files in `out`: all of a run that is done, the log of one that is not.

    Raises:
        Interrupted: a signal came before the motion had begun.
        OSError: the files cannot be written.
    """
    if stop_asked():
        raise Interrupted
    folder = out / (run.name + PARTS)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    jtqd = Jtqd(
        bench.bus,
        bench.config_path,
        folder,
        setpoints.duration_s,
        estimate_cob_id=bench.config.estimate_cob_id,
        stop_asked=stop_asked,
    )
    try:
        try:
            with jtqd:
                result = motion(setpoints)
            log, summary = jtqd.log()
        except (ProcessError, MotionError) as error:
            _keep([jtqd.said], out, run.name, ".jtqd.log")
            return Attempt(RunState(FAILED, str(error)), again=isinstance(error, MotionError), begun=False)
        if result.status == "stopped":
            _keep(log, out, run.name, ".stopped.mcap")
            return _stopped(result)
        state = RunState(played_s=result.played_s)
        return _kept(run, setpoints, bench.config, Recorded(log, summary, out), state)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _stopped(result: MotionResult) -> Attempt:
    signalled = bool(_SIGNALLED.search(result.reason))
    return Attempt(
        RunState(STOPPED, result.reason, played_s=result.played_s),
        again=not signalled and bool(_BUS_WAS_LATE.search(result.reason)),
        signalled=signalled,
    )


def _kept(
    run: Run, setpoints: Setpoints, config: BenchConfig, recorded: Recorded, state: RunState
) -> Attempt:
    """Run table, marks and log of a motion that was played to its end."""
    log, out = recorded.log, recorded.out
    state = replace(state, status=FAILED)
    lost = int((recorded.summary.get("recording") or {}).get("lost", 0))
    try:
        logged = log_to_run(log, nodes=config.nodes, sensor=config.sensor is not None)
    except LogError as error:
        _keep(log, out, run.name, ".failed.mcap")
        return Attempt(replace(state, reason=str(error)), again=True)
    state = replace(
        state,
        rows=len(logged.table.time_s),
        missed=logged.missed,
        incomplete=logged.incomplete,
        incomplete_by=dict(logged.incomplete_by),
        findings=findings(logged, setpoints, config.joints, sensor=config.sensor is not None),
    )
    if lost:
        state = replace(state, findings=(f"log: found {lost} cycles lost by the recorder", *state.findings))
    why = unusable(logged)
    if why is not None:
        _keep(log, out, run.name, ".failed.mcap")
        return Attempt(replace(state, reason=why), again=True)
    sha256 = write_run(out / f"{run.name}.csv.gz", logged.table)
    (out / f"{run.name}.json").write_text(json.dumps(marks_of(run, setpoints), indent=1) + "\n")
    _keep(log, out, run.name, ".mcap")
    return Attempt(replace(state, status=DONE, sha256=sha256))


def marks_of(run: Run, setpoints: Setpoints) -> dict[str, Any]:
    """Content of NAME.json: which segment was when, in seconds of the run table (to about a cycle)."""
    return {
        "run": run.name,
        "velocity_joint": run.velocity_joint,
        "segments": [
            {
                "kind": mark.kind,
                "start_s": mark.start_s,
                "end_s": mark.end_s,
                "velocity_joint": run.velocity_joint,
                "velocity_rad_s": mark.velocity_rad_s,
                "current_a": mark.current_a,
            }
            for mark in setpoints.marks
        ],
    }


def _keep(paths: Sequence[Path], out: Path, run: str, ending: str) -> None:
    """Move files out of the run's own directory, as far as they are there; both lie in the same file system.

    The first becomes RUN.ENDING, the second RUN@2.ENDING and so on (no name has a @): a long run's log has several parts.
    """
    for number, path in enumerate(paths, start=1):
        if path.exists():
            os.replace(path, out / (run + ("" if number == 1 else f"@{number}") + ending))
