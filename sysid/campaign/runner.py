"""Runs of a campaign: play what is not done, record, check, keep the files, report the outcome.

One attempt: jtqd is started, the motion played, jtqd ended, its log turned into the run table and checked (`findings`).
`go_through` does so for every run that is not done. A run that was lost only because the machine was late is tried again.
Where it can be cut, its pieces are driven one by one (NAME~1, NAME~2, ...) and stay separate tables: the joints stood
elsewhere in between, and a table has no jump. Short gaps of lost cycles are interpolated (`fill`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.daemon.logs import LogError
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.campaign.bench import Bench, BenchConfig, Play
from jtqd.sysid.campaign.processes import Interrupted, Jtqd, ProcessError, StopAsked
from jtqd.sysid.campaign.reporter import Reporter
from jtqd.sysid.campaign.state import DONE, FAILED, PARTS, PENDING, STOPPED, CampaignDirectory, RunState
from jtqd.sysid.motion.setpoints import PERIOD_S, MotionError, MotionResult, Setpoints
from jtqd.sysid.planner.plan import Plan, Run, expand, marks_of, partial_runs
from jtqd.sysid.runs.checks import check_run
from jtqd.sysid.runs.logs import LoggedRun, log_to_run
from jtqd.sysid.runs.tables import write_run

LONGEST_FILLED_S: Final = 0.0505
"""Longest time between two rows that is interpolated: 50 periods of 1 ms. The trajectories' harmonics lie below 1 Hz."""
FILLED_SHARE: Final = 0.005
"""Largest part of a table that may be interpolated."""


def gaps_of(time_s: FloatArray, longest_gap_s: float) -> list[list[float]]:
    """Return the last row before and the first behind [s] of each step that is longer than longest_gap_s."""
    places = np.flatnonzero(np.diff(time_s) > longest_gap_s)
    return [[round(float(time_s[place]), 6), round(float(time_s[place + 1]), 6)] for place in places]


def fill(logged: LoggedRun, longest_gap_s: float, period_s: float = PERIOD_S) -> tuple[LoggedRun, int]:
    """Interpolate the gaps that are longer than readers bear; returns the run and the number of rows made, period_s apart.

    The run as it was, and 0, where a gap is longer than LONGEST_FILLED_S, or more than FILLED_SHARE would be made.
    Values between two rows are linear in time.
    """
    time_s = logged.table.time_s
    steps = np.diff(time_s)
    places = np.flatnonzero(steps > longest_gap_s)
    if not len(places) or float(steps.max()) > LONGEST_FILLED_S:
        return logged, 0
    made = [
        time_s[place] + period_s * np.arange(1, round(float(steps[place]) / period_s)) for place in places
    ]
    added = np.concatenate(made)
    if len(added) > FILLED_SHARE * (len(added) + len(time_s)):
        return logged, 0
    whole: FloatArray = np.sort(np.concatenate((time_s, added)))
    table = RunTable(
        whole,
        {number: _interpolated(columns, time_s, whole) for number, columns in logged.table.joints.items()},
    )
    return replace(logged, table=table, longest_gap_s=float(np.diff(whole).max())), len(added)


def _interpolated(columns: JointColumns, time_s: FloatArray, whole: FloatArray) -> JointColumns:
    def column(name: str) -> FloatArray | None:
        values = getattr(columns, name)
        if values is None:
            return None
        found: FloatArray = np.interp(whole, time_s, values)
        return np.round(found) if name == "enabled" else found

    return JointColumns(**{item.name: column(item.name) for item in fields(JointColumns)})


_BUS_WAS_LATE: Final = re.compile(
    r"SYNC missing|missing for \d+ cycles|no heartbeat for|no temperature for|late by|transmit queue"
)
_SIGNALLED: Final = re.compile(r"SIGINT|SIGTERM")
LONGEST_GAP: Final = 9.5
"""In periods of SYNC. A longer step, of 10 cycles or more: the table would be refused by whoever reads it
(jtqd.sysid.runs.segments)."""
LOST_SHARE: Final = 0.01
LOST_FINDING: Final = "cycles:"
"""How the finding begins that more than that are missing."""
LOST_END_S: Final = 0.1
FOLLOW_VELOCITY: Final = (0.05, 0.05)
FOLLOW_CURRENT: Final = (0.1, 0.05)
"""RMS that is allowed between set-point and measurement: rad/s or A, and a part of the peak."""
OPPOSITE_TOLERANCE: Final = 0.02
MOVED_RAD: Final = 1.0
"""Least motion of a link from which the other one's says anything."""


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
            _keep([jtqd.messages], out, run.name, ".jtqd.log")
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
        logged = log_to_run(
            log,
            joints=run.joints,
            all_needed=True,
            nodes=config.nodes,
            sensor=config.sensor is not None,
            enabled=range(1, len(config.joints) + 1),
            last_motion=run.current_joint is None,  # what brought it to its place is none of it
        )
    except LogError as error:
        _keep(log, out, run.name, ".failed.mcap")
        return Attempt(replace(state, reason=str(error)), again=True)
    longest_gap_s = LONGEST_GAP * config.period_s
    gaps = gaps_of(logged.table.time_s, longest_gap_s)
    logged, interpolated = fill(logged, longest_gap_s, config.period_s)
    state = replace(
        state,
        interpolated=interpolated,
        rows=len(logged.table.time_s),
        missed=logged.missed,
        incomplete=logged.incomplete,
        incomplete_by=dict(logged.incomplete_by),
        findings=findings(
            logged, setpoints, config.joints, measured=[n for n in run.joints if config.measured(n)]
        ),
    )
    if lost:
        state = replace(
            state, findings=(f"log: found {counted(lost, 'cycle')} lost by the recorder", *state.findings)
        )
    why = gap_too_long(logged, longest_gap_s) or ends_early(logged, setpoints)
    if why is not None:
        _keep(log, out, run.name, ".failed.mcap")
        return Attempt(replace(state, reason=why), again=True)
    sha256 = write_run(out / f"{run.name}.csv.gz", logged.table)
    marks = marks_of(run, setpoints)
    if interpolated:
        marks["interpolated_s"] = gaps
    (out / f"{run.name}.json").write_text(json.dumps(marks, indent=1) + "\n")
    _keep(log, out, run.name, ".mcap")
    return Attempt(replace(state, status=DONE, sha256=sha256))


def _keep(paths: Sequence[Path], out: Path, run: str, ending: str) -> None:
    """Move files out of the run's own directory, as far as they are there; both lie in the same file system.

    The first becomes RUN.ENDING, the second RUN@2.ENDING and so on (no name has a @): a long run's log has several parts.
    """
    for number, file in enumerate(paths, start=1):
        if file.exists():
            os.replace(file, out / (run + ("" if number == 1 else f"@{number}") + ending))


def ends_early(logged: LoggedRun, setpoints: Setpoints) -> str | None:
    """Return that the log has lost the end of the motion, or None; lost cycles only make a motion longer."""
    last_s = float(logged.table.time_s[-1])
    if last_s >= setpoints.duration_s - LOST_END_S:
        return None
    return f"found the last row of the log at {last_s:.3f} s, expected it after {setpoints.duration_s:.3f} s"


def gap_too_long(logged: LoggedRun, longest_gap_s: float) -> str | None:
    """Return why a table cannot be kept at all, or None."""
    if logged.longest_gap_s > longest_gap_s:
        time_s = logged.table.time_s
        at = time_s[int(np.argmax(np.diff(time_s)))]
        return (
            f"found a gap of {logged.longest_gap_s * 1e3:.1f} ms in the log at {at:.3f} s, "
            f"expected at most {longest_gap_s * 1e3:.1f} ms"
        )
    return None


def findings(
    logged: LoggedRun, setpoints: Setpoints, joints: Sequence[Joint], *, measured: Collection[int]
) -> tuple[str, ...]:
    """Return what is wrong with a run beside its set-points, a line each; empty when nothing is.

    Nothing here judges a model: looked for are missing cycles, broken channels, wrong wiring, and motions that did not
    take place.

    Args:
        logged: whose first row belongs to the first set-point.
        joints: as in jtqd's configuration, 1, 2, ... measured: those of the run that have a channel of the torque sensor.
    """
    by_number = {number: joints[number - 1] for number in setpoints.joints}
    channels = [issue.text for issue in check_run(logged.table, by_number).refused]
    return (
        *_lost(logged),
        *_no_sensor(logged, measured),
        *channels,
        *_followed(logged, setpoints, joints),
        *(() if setpoints.current_joint is None else _opposite(logged, setpoints.joints, joints)),
    )


def _lost(logged: LoggedRun) -> Iterator[str]:
    if logged.lost_share <= LOST_SHARE:
        return
    by = ", ".join(f"{name} {count}" for name, count in logged.incomplete_by.items() if count)
    yield (
        f"{LOST_FINDING} found {logged.lost_share:.1%} missing ({logged.missed} without a cycle, "
        f"{logged.incomplete} incomplete{': ' + by if by else ''}), expected at most {LOST_SHARE:.0%}"
    )


def _no_sensor(logged: LoggedRun, measured: Collection[int]) -> Iterator[str]:
    for number, columns in logged.table.joints.items():
        if columns.torque_nm is None and number in measured:
            yield f"j{number}.torque_nm: found no value in the whole run, expected the sensor's: dead channel"


def _followed(logged: LoggedRun, setpoints: Setpoints, joints: Sequence[Joint]) -> Iterator[str]:
    """Yield the velocity joint against its velocity, the other one against its current."""
    table = logged.table
    place = np.minimum(np.round(table.time_s / PERIOD_S).astype(np.intp), len(setpoints) - 1)
    mover, driver = setpoints.velocity_joint, setpoints.current_joint
    velocity = table.joints[mover].motor_velocity_rad_s
    assert velocity is not None  # log_to_run sees to it that these are there
    yield from _follows(
        velocity / joints[mover - 1].gear_ratio,
        setpoints.velocity_rad_s[place],
        FOLLOW_VELOCITY,
        f"j{mover}.motor_velocity_rad_s: through the gear",
        "rad/s",
    )
    if driver is None:
        return
    current = table.joints[driver].current_a
    assert current is not None
    yield from _follows(current, setpoints.current_a[place], FOLLOW_CURRENT, f"j{driver}.current_a:", "A")


def _follows(
    found: FloatArray, wanted: FloatArray, allowed: tuple[float, float], what: str, unit: str
) -> Iterator[str]:
    rms = float(np.sqrt(np.mean((found - wanted) ** 2)))
    limit = allowed[0] + allowed[1] * float(np.abs(wanted).max())
    if rms <= limit:
        return
    opposite = float(np.sqrt(np.mean((found + wanted) ** 2))) <= limit
    yield (
        f"{what} found {rms:.3g} {unit} rms off the set-point, expected at most {limit:.3g} {unit}"
        f"{': it has the opposite sign' if opposite else ''}"
    )


def _opposite(logged: LoggedRun, pair: tuple[int, ...], joints: Sequence[Joint]) -> Iterator[str]:
    """The links are one body: in their own frames they turn oppositely. With one encoder the motor's, through the gear."""
    one, two = (
        logged.table.joint(number, joints[number - 1].gear_ratio).link_position_rad for number in pair
    )
    assert one is not None
    assert two is not None
    if max(float(np.ptp(one)), float(np.ptp(two))) < MOVED_RAD:
        return
    dx: FloatArray = one - one.mean()
    variance = float(dx @ dx)
    slope = float(dx @ (two - two.mean())) / variance if variance else np.inf
    if abs(slope + 1.0) > OPPOSITE_TOLERANCE:
        link = logged.table.joints[pair[1]].link_position_rad is not None
        name = "link_position_rad:" if link else "motor_position_rad: through the gear"
        yield f"j{pair[1]}.{name} found it turning {slope:.4g} times as far as j{pair[0]}'s, expected -1"


ATTEMPTS: Final = 3

AttemptRun = Callable[[Run, Setpoints], Attempt]


@dataclass(frozen=True)
class Outcome:
    """What became of a campaign.

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
        """For a program."""
        return {
            "schema": "jtq.campaign_outcome/1",
            "runs": {status: self.count(status) for status in (DONE, STOPPED, FAILED, PENDING)},
            "rows": sum(state.rows for state in self.runs.values()),
            "missed_cycles": {name: s.missed for name, s in self.runs.items() if s.missed},
            "incomplete_cycles": {name: s.incomplete for name, s in self.runs.items() if s.incomplete},
            "interpolated_rows": {name: s.interpolated for name, s in self.runs.items() if s.interpolated},
            "pieces": {name: s.pieces for name, s in self.runs.items() if s.pieces > 1},
            "findings": {name: list(s.findings) for name, s in self.runs.items() if s.findings},
            "not_done": {name: s.reason for name, s in self.runs.items() if s.status in (STOPPED, FAILED)},
            "ended": self.ended or None,
        }

    def text(self) -> str:
        """For people."""
        counts = [f"{self.count(status)} {status}" for status in (DONE, STOPPED, FAILED, PENDING)]
        lines = [f"runs      {', '.join(text for text in counts if not text.startswith('0 '))}"]
        rows = sum(state.rows for state in self.runs.values())
        lines.append(
            f"cycles    {counted(rows, 'row')}, {_where(self.runs, 'missed')}, {_where(self.runs, 'incomplete')}"
        )
        if any(state.interpolated for state in self.runs.values()):
            lines.append(
                f"rows      {_where(self.runs, 'interpolated')}: lost cycles in a row, at most 50 ms"
            )
        for name, state in self.runs.items():
            if state.pieces > 1:
                lines.append(f"pieces    {name}: {', '.join(state.tables(name))}")
            if state.status in (STOPPED, FAILED):
                lines.append(f"{state.status:<9} {name}: {state.reason}")
            lines += [f"finding   {name}: {finding}" for finding in state.findings]
        if self.ended:
            lines.append(f"ended by  {self.ended}; the same command continues with the remaining runs")
        return "\n".join(lines)


def _where(runs: Mapping[str, RunState], what: str) -> str:
    """ "missed 12 (forward_1_p3 9, back_1_n3 3)": how many, and the three runs with the most."""
    counts = {name: getattr(state, what) for name, state in runs.items() if getattr(state, what)}
    most = sorted(counts, key=lambda name: -counts[name])[:3]
    places = ", ".join(f"{name} {counts[name]}" for name in most) + (
        ", ..." if len(counts) > len(most) else ""
    )
    return f"{what} {sum(counts.values())}" + (f" ({places})" if counts else "")


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

    A run whose attempt failed for want of time only is tried again, up to ATTEMPTS times; one that can be cut into
    pieces is tried once, and then each piece up to ATTEMPTS times. What is lost all the same does not keep the other runs
    back. A limit ends the campaign unless keep_going; so does a bench that cannot be started, or a signal. With exact_next
    (the emulated bench, which can be had in exact time as well) the first run that is lost for want of time ends it, and
    so does one with more than LOST_SHARE of its cycles missing, which is not kept.
    """
    for run in plan.runs:
        if directory.runs[run.name].status == DONE:
            continue
        motion_s = setpoints[run.name].duration_s
        reporter.begin(run.name, motion_s)
        try:
            if exact_next:
                last = _attempt_on_time(run, setpoints[run.name], directory, attempt_run)
            else:
                last = _attempts(run, setpoints[run.name], directory, reporter, attempt_run)
        except Interrupted:
            return Outcome(directory.runs, f"a signal, before {run.name} moved")
        state = directory.runs[run.name]
        reporter.end(run.name, motion_s, state)
        if last.signalled:
            return Outcome(directory.runs, f"{state.reason} during {run.name}")
        if exact_next and last.again:
            return Outcome(directory.runs, f"{run.name}: {state.reason}", late=True)
        if state.status != DONE and not last.begun:
            return Outcome(directory.runs, f"{run.name}: {state.reason}")
        if state.status == STOPPED and not last.again and not keep_going:
            return Outcome(directory.runs, f"{run.name}: {state.reason}")
    return Outcome(directory.runs)


def _attempt_on_time(
    run: Run, setpoints: Setpoints, directory: CampaignDirectory, attempt_run: AttemptRun
) -> Attempt:
    """Return the only attempt; one that has lost too many cycles for a run without findings has failed."""
    last = attempt_run(run, setpoints)
    lost = [finding for finding in last.state.findings if finding.startswith(LOST_FINDING)]
    if last.state.status == DONE and lost:
        last = Attempt(replace(last.state, status=FAILED, reason=lost[0], sha256=""), again=True)
    directory.put(run.name, replace(last.state, attempts=1))
    return last


def _attempts(
    run: Run,
    setpoints: Setpoints,
    directory: CampaignDirectory,
    reporter: Reporter,
    attempt_run: AttemptRun,
) -> Attempt:
    """Return the last attempt; the directory has its state."""
    pieces = partial_runs(run)
    whole = ATTEMPTS if len(pieces) == 1 else 1
    number, last = _tried(run, setpoints, reporter, attempt_run, whole)
    state = replace(last.state, attempts=number)
    if len(pieces) > 1 and last.again and last.begun and state.status != DONE:
        reporter.write_line(f"{run.name}: {state.reason}; driven again in {len(pieces)} pieces")
        states = []
        for piece in pieces:
            tries, last = _tried(piece, expand(piece), reporter, attempt_run, ATTEMPTS)
            number += tries
            states.append(last.state)
            if last.state.status != DONE:
                break
        state = replace(_together(pieces, states), attempts=number)
    directory.put(run.name, state)
    return last


def _tried(
    run: Run, setpoints: Setpoints, reporter: Reporter, attempt_run: AttemptRun, attempts: int
) -> tuple[int, Attempt]:
    """Return the number of attempts, and the last of them."""
    for number in range(1, attempts + 1):
        last = attempt_run(run, setpoints)
        if last.state.status == DONE or not last.again or number == attempts:
            break
        reporter.attempt_failed(run.name, last.state.reason, number)
    return number, last


def _together(pieces: Sequence[Run], states: Sequence[RunState]) -> RunState:
    """Return the state of a run that was driven in pieces; done when all of them are."""
    last = states[-1]
    by: dict[str, int] = {}
    for state in states:
        for name, count in state.incomplete_by.items():
            by[name] = by.get(name, 0) + count
    done = len(states) == len(pieces) and last.status == DONE
    return RunState(
        status=DONE if done else last.status,
        reason="" if done else f"{pieces[len(states) - 1].name}: {last.reason}",
        played_s=sum(state.played_s for state in states),
        rows=sum(state.rows for state in states),
        missed=sum(state.missed for state in states),
        incomplete=sum(state.incomplete for state in states),
        incomplete_by=by,
        findings=tuple(
            f"{piece.name}: {finding}"
            for piece, state in zip(pieces, states, strict=False)
            for finding in state.findings
        ),
        sha256=" ".join(state.sha256 for state in states) if done else "",
        interpolated=sum(state.interpolated for state in states),
        pieces=len(pieces) if done else 1,
    )
