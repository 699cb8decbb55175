"""Runs of a campaign: each that is not done is driven, recorded, checked and kept; the outcome is reported.

One attempt starts jtqd, plays the motion, ends jtqd, and turns its log into a run table (`recorded`). An attempt that fails
for want of time is repeated. Where the run can be cut, its partial runs are driven one by one (NAME~1, NAME~2, ...) and stay
separate tables, because the joints stood elsewhere in between.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from jtqd.daemon.logs import LogError
from jtqd.estimator.text import counted
from jtqd.sysid.campaign.bench import Bench, BenchConfig, Play
from jtqd.sysid.campaign.processes import Interrupted, Jtqd, ProcessError, StopAsked
from jtqd.sysid.campaign.recorded import (
    LONGEST_GAP,
    LOST_FINDING,
    findings,
    gaps_of,
    interpolate_gaps,
    unusable,
)
from jtqd.sysid.campaign.reporter import Reporter
from jtqd.sysid.campaign.state import DONE, FAILED, PARTS, STATUSES, STOPPED, CampaignDirectory, RunState
from jtqd.sysid.motion.setpoints import MotionError, MotionResult, Setpoints
from jtqd.sysid.planner.plan import Plan, Run, expand, marks_of, partial_runs
from jtqd.sysid.runs.logs import log_to_run
from jtqd.sysid.runs.tables import write_run

ATTEMPTS: Final = 3
_BUS_WAS_LATE: Final = re.compile(
    r"SYNC missing|missing for \d+ cycles|no heartbeat for|no temperature for|late by|transmit queue"
)
_SIGNALLED: Final = re.compile(r"SIGINT|SIGTERM")


class Attempt(NamedTuple):
    """How an attempt at a run ended.

    Attributes:
        state: to be kept. again: a repetition may succeed, because the machine or the bus was late.
        begun: the joints were moved; otherwise the bench itself is not ready. signalled: the operator ended it.
    """

    state: RunState
    again: bool = False
    begun: bool = True
    signalled: bool = False


def attempt(
    run: Run, setpoints: Setpoints, bench: Bench, out: Path, *, motion: Play, stop_asked: StopAsked
) -> Attempt:
    """Play a run; leave table, marks and log in `out` where it is done, the log alone where it is not.

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
            _keep([jtqd.messages], out, run.name, ".jtqd.log")
            return Attempt(RunState(FAILED, str(error)), again=isinstance(error, MotionError), begun=False)
        if result.status == "stopped":
            _keep(log, out, run.name, ".stopped.mcap")
            return stopped(result)
        last = _recorded(run, setpoints, bench.config, log, out)
        lost = int((summary.get("recording") or {}).get("lost", 0))
        state = replace(last.state, played_s=result.played_s)
        if lost and state.rows:
            line = f"log: found {counted(lost, 'cycle')} lost by the recorder"
            state = replace(state, findings=(line, *state.findings))
        _keep(log, out, run.name, ".mcap" if state.status == DONE else ".failed.mcap")
        return last._replace(state=state)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def stopped(result: MotionResult) -> Attempt:
    """Return the attempt at a motion that was stopped before its end."""
    signalled = bool(_SIGNALLED.search(result.reason))
    return Attempt(
        RunState(STOPPED, result.reason, played_s=result.played_s),
        again=not signalled and bool(_BUS_WAS_LATE.search(result.reason)),
        signalled=signalled,
    )


def _recorded(run: Run, setpoints: Setpoints, config: BenchConfig, log: Sequence[Path], out: Path) -> Attempt:
    """Write table and marks of a motion that was played to its end, if its log is usable."""
    try:
        logged = log_to_run(
            log,
            joints=run.joints,
            all_needed=True,
            nodes=config.nodes,
            sensor=config.sensor is not None,
            enabled=range(1, len(config.joints) + 1),
            last_motion=run.current_joint is None,  # the approach of a joint that is moved alone is left out
        )
    except LogError as error:
        return Attempt(RunState(FAILED, str(error)), again=True)
    longest_gap_s = LONGEST_GAP * config.period_s
    gaps = gaps_of(logged.table.time_s, longest_gap_s)
    logged, interpolated = interpolate_gaps(logged, longest_gap_s, config.period_s)
    measured = [number for number in run.joints if config.measured(number)]
    state = RunState(
        FAILED,
        unusable(logged, setpoints, longest_gap_s) or "",
        rows=len(logged.table.time_s),
        missed=logged.missed,
        incomplete=logged.incomplete,
        incomplete_by=dict(logged.incomplete_by),
        findings=findings(logged, setpoints, config.joints, measured=measured),
        interpolated=interpolated,
    )
    if state.reason:
        return Attempt(state, again=True)
    sha256 = write_run(out / f"{run.name}.csv.gz", logged.table)
    marks = marks_of(run, setpoints) | ({"interpolated_s": gaps} if interpolated else {})
    (out / f"{run.name}.json").write_text(json.dumps(marks, indent=1) + "\n")
    return Attempt(replace(state, status=DONE, sha256=sha256))


def _keep(paths: Iterable[Path], out: Path, run: str, ending: str) -> None:
    """Move files out of the run's own directory: RUN.ENDING, RUN@2.ENDING, ... (no name has a @)."""
    for number, file in enumerate(paths, start=1):
        if file.exists():
            os.replace(file, out / (run + ("" if number == 1 else f"@{number}") + ending))


AttemptRun = Callable[[Run, Setpoints], Attempt]


@dataclass(frozen=True)
class Outcome:
    """What was done of a campaign.

    Attributes:
        runs: state of every run of the plan. ended: why it ended before the last run; "" when it did not.
        late: it ended at the first run that was lost because this machine was late: the others are for exact time.
    """

    runs: Mapping[str, RunState]
    ended: str = ""
    late: bool = False

    @property
    def short_of_time(self) -> bool:
        """Whether a run is not done because the bus or the machine was late."""
        reasons = [state.reason for state in self.runs.values() if state.status in (STOPPED, FAILED)]
        return any(_BUS_WAS_LATE.search(reason) or "found a gap of" in reason for reason in reasons)

    def count(self, status: str) -> int:
        """Return runs with this status."""
        return sum(state.status == status for state in self.runs.values())

    @property
    def exit_status(self) -> int:
        """0 all done and nothing found, 3 gone through with findings or losses, 1 ended early."""
        if self.ended:
            return 1
        clean = all(state.status == DONE and not state.findings for state in self.runs.values())
        return 0 if clean else 3

    def content(self) -> dict[str, Any]:
        """Return the outcome for a program (jtq.campaign_outcome/1)."""
        return {
            "schema": "jtq.campaign_outcome/1",
            "runs": {status: self.count(status) for status in STATUSES},
            "rows": sum(state.rows for state in self.runs.values()),
            "missed_cycles": self._some("missed"),
            "incomplete_cycles": self._some("incomplete"),
            "interpolated_rows": self._some("interpolated"),
            "pieces": {name: s.pieces for name, s in self.runs.items() if s.pieces > 1},
            "findings": {name: list(lines) for name, lines in self._some("findings").items()},
            "not_done": {name: s.reason for name, s in self.runs.items() if s.status in (STOPPED, FAILED)},
            "ended": self.ended or None,
        }

    def text(self) -> str:
        """Return the outcome for people."""
        counts = {status: self.count(status) for status in STATUSES}
        rows = sum(state.rows for state in self.runs.values())
        lines = [
            f"runs      {', '.join(f'{number} {status}' for status, number in counts.items() if number)}",
            f"cycles    {counted(rows, 'row')}, {self._places('missed')}, {self._places('incomplete')}",
        ]
        if self._some("interpolated"):
            lines.append(f"rows      {self._places('interpolated')}: lost cycles in a row, at most 50 ms")
        for name, state in self.runs.items():
            if state.pieces > 1:
                lines.append(f"pieces    {name}: {', '.join(state.tables(name))}")
            if state.status in (STOPPED, FAILED):
                lines.append(f"{state.status:<9} {name}: {state.reason}")
            lines += [f"finding   {name}: {finding}" for finding in state.findings]
        if self.ended:
            lines.append(f"ended by  {self.ended}; the same command continues with the remaining runs")
        return "\n".join(lines)

    def _some(self, field: str) -> dict[str, Any]:
        """Return a field of the states where it is not empty, by run."""
        return {name: value for name, state in self.runs.items() if (value := getattr(state, field))}

    def _places(self, field: str) -> str:
        """Return the total, and the three runs with the most: "missed 12 (forward_1_p3 9, back_1_n3 3)"."""
        counts = Counter(self._some(field))
        if not counts:
            return f"{field} 0"
        places = [f"{name} {count}" for name, count in counts.most_common(3)]
        return f"{field} {counts.total()} ({', '.join(places)}{', ...' if len(counts) > 3 else ''})"


def go_through(
    plan: Plan,
    setpoints: Mapping[str, Setpoints],
    directory: CampaignDirectory,
    reporter: Reporter,
    attempt_run: AttemptRun,
    *,
    keep_going: bool = False,
    exact_next: bool = False,
) -> Outcome:
    """Play what is not done; the directory always holds the state of every run.

    An attempt that failed for want of time is repeated, up to ATTEMPTS times; a run that can be cut is tried once, and then
    each partial run up to ATTEMPTS times. A run that is lost all the same does not keep the others back. A limit ends the
    campaign unless keep_going; so does a bench that cannot be started, or a signal. With exact_next (the emulated bench can
    be had in exact time) the first run that is lost for want of time, or with too many cycles missing, ends it.
    """
    for run in plan.runs:
        if directory.runs[run.name].status == DONE:
            continue
        motion_s = setpoints[run.name].duration_s
        reporter.begin(run.name)
        try:
            if exact_next:
                last, state = _attempt_on_time(run, setpoints[run.name], attempt_run)
            else:
                last, state = _attempts(run, setpoints[run.name], reporter, attempt_run)
        except Interrupted:
            return Outcome(directory.runs, f"a signal, before {run.name} moved")
        directory.put(run.name, state)
        reporter.end(run.name, motion_s, state)
        if last.signalled:
            return Outcome(directory.runs, f"{state.reason} during {run.name}")
        late = exact_next and last.again
        no_bench = state.status != DONE and not last.begun
        at_limit = state.status == STOPPED and not last.again and not keep_going
        if late or no_bench or at_limit:
            return Outcome(directory.runs, f"{run.name}: {state.reason}", late=late)
    return Outcome(directory.runs)


def _attempt_on_time(run: Run, setpoints: Setpoints, attempt_run: AttemptRun) -> tuple[Attempt, RunState]:
    """Return the only attempt and the run's state; with too many cycles missing it has failed."""
    last = attempt_run(run, setpoints)
    lost = [finding for finding in last.state.findings if finding.startswith(LOST_FINDING)]
    if last.state.status == DONE and lost:
        last = Attempt(replace(last.state, status=FAILED, reason=lost[0], sha256=""), again=True)
    return last, replace(last.state, attempts=1)


def _attempts(
    run: Run, setpoints: Setpoints, reporter: Reporter, attempt_run: AttemptRun
) -> tuple[Attempt, RunState]:
    """Return the last attempt and the run's state."""
    parts = partial_runs(run)
    number, last = _repeated(run, setpoints, reporter, attempt_run, ATTEMPTS if len(parts) == 1 else 1)
    state = last.state
    if len(parts) > 1 and last.again and last.begun and state.status != DONE:
        reporter.write_line(f"{run.name}: {state.reason}; repeated in {len(parts)} pieces")
        states = []
        for part in parts:
            attempts, last = _repeated(part, expand(part), reporter, attempt_run, ATTEMPTS)
            number += attempts
            states.append(last.state)
            if last.state.status != DONE:
                break
        state = _joined(parts, states)
    return last, replace(state, attempts=number)


def _repeated(
    run: Run, setpoints: Setpoints, reporter: Reporter, attempt_run: AttemptRun, most: int
) -> tuple[int, Attempt]:
    """Return the number of attempts, and the last of them."""
    for number in range(1, most + 1):
        last = attempt_run(run, setpoints)
        if last.state.status == DONE or not last.again or number == most:
            break
        reporter.attempt_failed(run.name, last.state.reason, number)
    return number, last


def _joined(parts: Sequence[Run], states: Sequence[RunState]) -> RunState:
    """Return the state of a run that was driven in parts; done when all of them are."""
    last = states[-1]
    done = len(states) == len(parts) and last.status == DONE
    incomplete_by: Counter[str] = Counter()
    for state in states:
        incomplete_by.update(state.incomplete_by)
    return RunState(
        status=last.status,
        reason="" if done else f"{parts[len(states) - 1].name}: {last.reason}",
        played_s=sum(state.played_s for state in states),
        rows=sum(state.rows for state in states),
        missed=sum(state.missed for state in states),
        incomplete=sum(state.incomplete for state in states),
        incomplete_by=dict(incomplete_by),
        findings=tuple(
            f"{part.name}: {finding}"
            for part, state in zip(parts, states, strict=False)
            for finding in state.findings
        ),
        sha256=" ".join(state.sha256 for state in states) if done else "",
        interpolated=sum(state.interpolated for state in states),
        pieces=len(parts) if done else 1,
    )
