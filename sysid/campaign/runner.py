"""Goes through the runs of a campaign that are not done, and says what became of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from sysid.campaign.one_run import Attempt
from sysid.campaign.plan import Plan, Run
from sysid.campaign.processes import Interrupted
from sysid.campaign.progress import Reporter
from sysid.campaign.state import DONE, FAILED, PENDING, STOPPED, CampaignDirectory, RunState
from sysid.motion.setpoints import Setpoints

ATTEMPTS: Final = 3

AttemptRun = Callable[[Run, Setpoints], Attempt]


@dataclass(frozen=True)
class Outcome:
    """What became of a campaign.

    Attributes:
        runs: state of every run of the plan. ended: why it ended before the last run; "" when it did not.
    """

    runs: Mapping[str, RunState]
    ended: str = ""

    def count(self, status: str) -> int:
        """Runs with this status."""
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
            f"cycles    {rows} rows, {_where(self.runs, 'missed')}, {_where(self.runs, 'incomplete')}"
        )
        for name, state in self.runs.items():
            if state.status in (STOPPED, FAILED):
                lines.append(f"{state.status:<9} {name}: {state.reason}")
            lines += [f"found     {name}: {finding}" for finding in state.findings]
        if self.ended:
            lines.append(f"ended by  {self.ended}; the same command goes on with what is not done")
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
) -> Outcome:
    """Play what is not done; the directory always holds the state of every run.

    A run whose attempt failed for want of time only is tried again, up to ATTEMPTS times. A limit ends the campaign
    unless keep_going; so does a bench that cannot be started, or a signal.
    """
    for run in plan.runs:
        if directory.runs[run.name].status == DONE:
            continue
        motion_s = setpoints[run.name].duration_s
        reporter.begin(run.name, motion_s)
        try:
            last = _attempts(run, setpoints[run.name], directory, reporter, attempt_run)
        except Interrupted:
            return Outcome(directory.runs, f"a signal, before {run.name} moved")
        state = directory.runs[run.name]
        reporter.end(run.name, motion_s, state)
        if last.signalled:
            return Outcome(directory.runs, f"{state.reason} during {run.name}")
        if state.status != DONE and not last.begun:
            return Outcome(directory.runs, f"{run.name}: {state.reason}")
        if state.status == STOPPED and not keep_going:
            return Outcome(directory.runs, f"{run.name}: {state.reason}")
    return Outcome(directory.runs)


def _attempts(
    run: Run,
    setpoints: Setpoints,
    directory: CampaignDirectory,
    reporter: Reporter,
    attempt_run: AttemptRun,
) -> Attempt:
    """The last attempt; the directory has its state."""
    for number in range(1, ATTEMPTS + 1):
        last = attempt_run(run, setpoints)
        directory.put(run.name, replace(last.state, attempts=number))
        if last.state.status == DONE or not last.again or number == ATTEMPTS:
            break
        reporter.attempt_failed(run.name, last.state.reason, number)
    return last
