"""Runs of a campaign: each that is not done is driven, recorded, checked and kept; the outcome is reported.

One attempt starts jtqd, plays the motion, ends jtqd, and turns its log into a run table. Short gaps of lost cycles are
interpolated, and faults of the run are found: missing cycles, broken channels, wrong wiring, a motion that did not take
place. No model is judged. An attempt that fails for want of time is repeated. Where the run can be cut, its partial runs are
driven one by one (NAME~1, NAME~2, ...) and stay separate tables, because the joints stood elsewhere in between.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.estimator.text import counted, printable
from jtqd.sysid.campaign.bench import Bench, BenchConfig, Interrupted, Jtqd, Play, ProcessError, StopAsked
from jtqd.sysid.campaign.state import DONE, FAILED, PARTS, STATUSES, STOPPED, CampaignDirectory, RunState
from jtqd.sysid.motion.setpoints import PERIOD_S, MotionError, MotionResult, Setpoints
from jtqd.sysid.planner.plan import Plan, Run, expand, marks_of, partial_runs

if TYPE_CHECKING:  # readers of logs, which --help does not need
    from jtqd.sysid.runs.logs import LoggedRun

# The run table of a motion --------------------------------------------------------------------------------------

LONGEST_INTERPOLATED_S: Final = 0.0505
"""50 periods of 1 ms; the trajectories' harmonics lie below 1 Hz."""
_INTERPOLATED_SHARE: Final = 0.005
"""Largest part of a table that is interpolated."""
LONGEST_GAP: Final = 9.5
"""In periods of SYNC: readers refuse a table with a gap of 10 cycles (jtqd.sysid.runs.run_file)."""
_LOST_SHARE: Final = 0.01
LOST_FINDING: Final = "cycles:"
"""First word of the finding that more cycles than that are missing."""
_LOST_END_S: Final = 0.1
_FOLLOW_VELOCITY: Final = (0.05, 0.05)
_FOLLOW_CURRENT: Final = (0.1, 0.05)
"""RMS that is allowed between set-point and measurement: rad/s or A, and a part of the peak."""
_OPPOSITE_TOLERANCE: Final = 0.02
_LEAST_MOTION_RAD: Final = 1.0
"""Of a link, for its motion to be compared with the other one's."""


def interpolate_gaps(
    logged: LoggedRun, longest_gap_s: float, period_s: float = PERIOD_S
) -> tuple[LoggedRun, int]:
    """Interpolate gaps longer than longest_gap_s linearly; returns the run and the number of rows added, period_s apart.

    The run is returned as it is where a gap is longer than LONGEST_INTERPOLATED_S, or too many rows would be added.
    """
    time_s = logged.table.time_s
    steps = np.diff(time_s)
    places = np.flatnonzero(steps > longest_gap_s)
    if not len(places) or float(steps.max()) > LONGEST_INTERPOLATED_S:
        return logged, 0
    added = np.concatenate(
        [time_s[place] + period_s * np.arange(1, round(float(steps[place]) / period_s)) for place in places]
    )
    if len(added) > _INTERPOLATED_SHARE * (len(added) + len(time_s)):
        return logged, 0
    whole: FloatArray = np.sort(np.concatenate((time_s, added)))

    def at_all_times(name: str, column: FloatArray) -> FloatArray:
        values: FloatArray = np.interp(whole, time_s, column)
        return np.round(values) if name == "enabled" else values

    joints = {number: columns.map(at_all_times) for number, columns in logged.table.joints.items()}
    longest = float(np.diff(whole).max())
    return replace(logged, table=RunTable(whole, joints), longest_gap_s=longest), len(added)


def unusable(logged: LoggedRun, setpoints: Setpoints, longest_gap_s: float) -> str | None:
    """Return why a table cannot be kept at all: a gap, or the end of the motion is missing; else None."""
    time_s = logged.table.time_s
    if logged.longest_gap_s > longest_gap_s:
        at = time_s[int(np.argmax(np.diff(time_s)))]
        return (
            f"found a gap of {logged.longest_gap_s * 1e3:.1f} ms in the log at {at:.3f} s, "
            f"expected at most {longest_gap_s * 1e3:.1f} ms"
        )
    if time_s[-1] < setpoints.duration_s - _LOST_END_S:  # lost cycles only make a motion longer
        return f"found the last row of the log at {time_s[-1]:.3f} s, expected it after {setpoints.duration_s:.3f} s"
    return None


def findings(
    logged: LoggedRun, setpoints: Setpoints, joints: Sequence[Joint], *, measured: Collection[int]
) -> tuple[str, ...]:
    """Return the faults of a run, a line each; its first row belongs to the first set-point.

    joints: of jtqd's configuration, 1, 2, ...; measured: numbers of those with a channel of the torque sensor.
    """
    from jtqd.sysid.runs.checks import check_run

    by_number = {number: joints[number - 1] for number in setpoints.joints}
    lines = []
    if logged.lost_share > _LOST_SHARE:
        by = ", ".join(f"{name} {count}" for name, count in logged.incomplete_by.items() if count)
        lines.append(
            f"{LOST_FINDING} found {logged.lost_share:.1%} missing ({logged.missed} without a cycle, "
            f"{logged.incomplete} incomplete{': ' + by if by else ''}), expected at most {_LOST_SHARE:.0%}"
        )
    lines += [
        f"j{number}.torque_nm: found no value in the whole run, expected the sensor's: dead channel"
        for number, columns in logged.table.joints.items()
        if columns.torque_nm is None and number in measured
    ]
    lines += [issue.text for issue in check_run(logged.table, by_number).refused]
    lines += _followed(logged.table, setpoints, joints)
    if setpoints.current_joint is not None:
        lines += _opposite(logged.table, setpoints.joints, joints)
    return tuple(lines)


def _followed(table: RunTable, setpoints: Setpoints, joints: Sequence[Joint]) -> Iterator[str]:
    """Compare the velocity joint with its velocity, the other one with its current, at the time of each row."""
    place = np.minimum(np.round(table.time_s / PERIOD_S).astype(np.intp), len(setpoints) - 1)
    mover, driver = setpoints.velocity_joint, setpoints.current_joint
    velocity = table.joints[mover].motor_velocity_rad_s
    assert velocity is not None  # log_to_run was asked for all columns
    what = f"j{mover}.motor_velocity_rad_s: through the gear"
    wanted = setpoints.velocity_rad_s[place]
    yield from _follows(velocity / joints[mover - 1].gear_ratio, wanted, _FOLLOW_VELOCITY, what, "rad/s")
    if driver is not None:
        current = table.joints[driver].current_a
        assert current is not None
        yield from _follows(
            current, setpoints.current_a[place], _FOLLOW_CURRENT, f"j{driver}.current_a:", "A"
        )


def _follows(
    found: FloatArray, wanted: FloatArray, allowed: tuple[float, float], what: str, unit: str
) -> Iterator[str]:
    rms = float(np.sqrt(np.mean((found - wanted) ** 2)))
    limit = allowed[0] + allowed[1] * float(np.abs(wanted).max())
    if rms > limit:
        opposite = float(np.sqrt(np.mean((found + wanted) ** 2))) <= limit
        yield (
            f"{what} found {rms:.3g} {unit} rms off the set-point, expected at most {limit:.3g} {unit}"
            f"{': it has the opposite sign' if opposite else ''}"
        )


def _opposite(table: RunTable, pair: tuple[int, ...], joints: Sequence[Joint]) -> Iterator[str]:
    """Compare the links, which are one body and turn oppositely; a joint with one encoder through its gear."""
    one, two = (table.joint(number, joints[number - 1].gear_ratio).link_position_rad for number in pair)
    assert one is not None
    assert two is not None
    if max(float(np.ptp(one)), float(np.ptp(two))) < _LEAST_MOTION_RAD:
        return
    dx: FloatArray = one - one.mean()
    variance = float(dx @ dx)
    slope = float(dx @ (two - two.mean())) / variance if variance else np.inf
    if abs(slope + 1.0) > _OPPOSITE_TOLERANCE:
        link = table.joints[pair[1]].link_position_rad is not None
        name = "link_position_rad:" if link else "motor_position_rad: through the gear"
        yield f"j{pair[1]}.{name} found it turning {slope:.4g} times as far as j{pair[0]}'s, expected -1"


# Attempts -------------------------------------------------------------------------------------------------------

ATTEMPTS: Final = 3
_BUS_WAS_LATE: Final = re.compile(
    r"SYNC missing|missing for \d+ cycles|no heartbeat for|no temperature for|late by|transmit queue"
)
_SIGNALLED: Final = re.compile(r"SIGINT|SIGTERM")


class Attempt(NamedTuple):
    """How an attempt at a run ended.

    again: a repetition may succeed, because the machine or the bus was late. begun: the joints were moved; otherwise the
    bench itself is not ready. signalled: the operator ended it.
    """

    state: RunState
    again: bool = False
    begun: bool = True
    signalled: bool = False


def attempt(
    run: Run, setpoints: Setpoints, bench: Bench, out: Path, *, motion: Play, stop_asked: StopAsked
) -> Attempt:
    """Play a run; leave table, marks and log in `out` where it is done, the log alone where it is not.

    Raises Interrupted for a signal before the motion has begun, OSError where the files cannot be written.
    """
    if stop_asked():
        raise Interrupted
    folder = out / (run.name + PARTS)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    jtqd = Jtqd(bench, folder, setpoints.duration_s, stop_asked)
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
    again = not signalled and bool(_BUS_WAS_LATE.search(result.reason))
    return Attempt(RunState(STOPPED, result.reason, played_s=result.played_s), again, signalled=signalled)


def _recorded(run: Run, setpoints: Setpoints, config: BenchConfig, log: Sequence[Path], out: Path) -> Attempt:
    """Write table and marks of a motion that was played to its end, if its log is usable."""
    from jtqd.daemon.logs import LogError
    from jtqd.sysid.runs.logs import log_to_run
    from jtqd.sysid.runs.tables import write_run

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
    time_s = logged.table.time_s
    gaps = [
        [round(float(time_s[place]), 6), round(float(time_s[place + 1]), 6)]
        for place in np.flatnonzero(np.diff(time_s) > longest_gap_s)
    ]
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
    write_whole(out / f"{run.name}.json", f"{json.dumps(marks, indent=1)}\n".encode())
    return Attempt(replace(state, status=DONE, sha256=sha256))


def _keep(paths: Iterable[Path], out: Path, run: str, ending: str) -> None:
    """Move files out of the run's own directory: RUN.ENDING, RUN@2.ENDING, ... (no name has a @)."""
    for number, file in enumerate(paths, start=1):
        if file.exists():
            os.replace(file, out / (run + ("" if number == 1 else f"@{number}") + ending))


# Progress -------------------------------------------------------------------------------------------------------

BETWEEN_RUNS_S: Final = 4.0
"""Assumed before the first run is measured: start of jtqd, set-up of the drives, run table."""
_REFRESH_S: Final = 1.0
"""Drawing takes 0.5 ms between two set-points."""


def clock_text(seconds: float) -> str:
    """62.4 -> "1:02", 3723 -> "1:02:03"."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Remaining:
    """Remaining time of a campaign: motions to be played (their lengths [s]), and the measured time between them."""

    def __init__(self, motions_s: list[float], now: Callable[[], float] = time.monotonic) -> None:
        self.total_s: Final = sum(motions_s)
        self.played_s = 0.0
        """Motions of the runs that are over."""
        self._left, self._over = len(motions_s), 0
        self._now, self._began = now, now()

    def end(self, motion_s: float) -> None:
        """Count a run that is over."""
        self.played_s += motion_s
        self._left -= 1
        self._over += 1

    def seconds(self, played_s: float = 0.0) -> float:
        """Return the remaining time after played_s of the current run."""
        motion_s = self.played_s + played_s
        between_s = BETWEEN_RUNS_S
        if self._over:
            begun = self._over + (played_s > 0.0)
            between_s = max((self._now() - self._began - motion_s) / begun, 0.0)
        return self.total_s - motion_s + between_s * self._left


class Reporter:
    """Progress on standard error around the runs: a bar with the remaining time on a terminal, else a line per run."""

    def __init__(self, motions_s: list[float], total: int, done: int, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._remaining = Remaining(motions_s)
        self._total, self._number = total, done
        self._name = ""
        self._shown_s = 0.0
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(None),
            TextColumn("{task.percentage:3.0f} %"),
            TextColumn("{task.fields[left]} left"),
            console=self._console,
            auto_refresh=False,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=max(self._remaining.total_s, 1e-9), left="")

    def __enter__(self) -> Reporter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, name: str) -> None:
        """Show the next run."""
        self._name = name
        self._number += 1
        self._shown_s = -_REFRESH_S
        self.on_progress(0.0, 0.0)

    def on_progress(self, played_s: float, _total_s: float) -> None:
        """Draw the bar; called by the commander between two set-points."""
        if not self._console.is_terminal or time.monotonic() - self._shown_s < _REFRESH_S:
            return
        self._shown_s = time.monotonic()
        self._bar.update(
            self._task,
            completed=self._remaining.played_s + played_s,
            description=f"{self._number}/{self._total} {self._name}",
            left=clock_text(self._remaining.seconds(played_s)),
            refresh=True,
        )

    def end(self, name: str, motion_s: float, state: RunState) -> None:
        """Report a run that is over."""
        self._remaining.end(motion_s)
        if self._console.is_terminal and state.status == DONE and not state.findings:
            return
        text = f"run {self._number} of {self._total}: {name}: {state.status}"
        if state.status == DONE:
            missing = counted(state.missed + state.incomplete, "cycle")
            text += f", {counted(state.rows, 'row')}, {missing} missing"
        else:
            text += f": {state.reason}"
        left_s = self._remaining.seconds()
        self.write_line(text + (f"; {clock_text(left_s)} left" if left_s > 0.0 else ""))
        for finding in state.findings:
            self.write_line(f"{name}: {finding}")

    def write_line(self, text: str) -> None:
        """Write a line on stderr, above the bar where there is one."""
        if self._console.is_terminal:
            self._bar.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
        else:
            print(f"jtq campaign: {text}", file=sys.stderr, flush=True)


# The campaign ---------------------------------------------------------------------------------------------------

AttemptRun = Callable[[Run, Setpoints], Attempt]


@dataclass(frozen=True)
class Outcome:
    """What was done of a campaign: state of every run, and why it ended before the last one ("" when it did not).

    late: it ended at the first run that was lost because this machine was late: the others are for exact time.
    """

    runs: Mapping[str, RunState]
    ended: str = ""
    late: bool = False

    @property
    def short_of_time(self) -> bool:
        """Whether a run is not done because the bus or the machine was late."""
        reasons = self._not_done().values()
        return any(_BUS_WAS_LATE.search(reason) or "found a gap of" in reason for reason in reasons)

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
            "runs": self._counts(),
            "rows": sum(state.rows for state in self.runs.values()),
            "missed_cycles": self._some("missed"),
            "incomplete_cycles": self._some("incomplete"),
            "interpolated_rows": self._some("interpolated"),
            "pieces": {name: s.pieces for name, s in self.runs.items() if s.pieces > 1},
            "findings": {name: list(lines) for name, lines in self._some("findings").items()},
            "not_done": self._not_done(),
            "ended": self.ended or None,
        }

    def text(self) -> str:
        """Return the outcome for people."""
        rows = sum(state.rows for state in self.runs.values())
        lines = [
            f"runs      {', '.join(f'{number} {status}' for status, number in self._counts().items() if number)}",
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

    def _counts(self) -> dict[str, int]:
        return {each: sum(state.status == each for state in self.runs.values()) for each in STATUSES}

    def _not_done(self) -> dict[str, str]:
        return {name: s.reason for name, s in self.runs.items() if s.status in (STOPPED, FAILED)}

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
        points = setpoints[run.name]
        reporter.begin(run.name)
        try:
            if exact_next:
                last, state = _attempt_on_time(run, points, attempt_run)
            else:
                last, state = _attempts(run, points, reporter, attempt_run)
        except Interrupted:
            return Outcome(directory.runs, f"a signal, before {run.name} moved")
        directory.put(run.name, state)
        reporter.end(run.name, points.duration_s, state)
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
        reporter.write_line(f"{run.name}: attempt {number}: {last.state.reason}; repeated")
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
