"""The diagnosis of run files: their channels are checked first, and the findings list what may not be used."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

from jtqd.estimator.command_line import check_installed
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.estimator.text import counted
from jtqd.sysid.diagnosis.findings import EVERYTHING, INSUFFICIENT, NO_GAP, Findings, Scope
from jtqd.sysid.diagnosis.limits import RELEVANCE
from jtqd.sysid.progress import waiting
from jtqd.sysid.runs.checks import CheckedRuns, check_runs, may_leave_out
from jtqd.sysid.runs.files import LEFT_OUT
from jtqd.sysid.runs.options import joint_for_runs
from jtqd.sysid.runs.run_file import RunFile

_PIECE: Final = re.compile(r" \(\d+ of \d+\)$")
_FIGURES: Final = re.compile(r"(?<![\w.])[-+]?\d[\d.e+-]*")

JointOrFile = Joint | Path | str


class NotebookFindings(Findings):
    """Findings that a notebook shows as the head of the report: headline, table of entries, lines."""

    def _repr_html_(self) -> str | None:
        """Return it as HTML; None without jinja2 (extra analysis)."""
        try:
            from jtqd.sysid.diagnosis.report import summary_html

            return summary_html(self)
        except ImportError:
            return None


def diagnose(
    runs: Sequence[RunFile | tuple[str, RunTable]],
    joint: JointOrFile | Mapping[int, JointOrFile],
    scope: Scope = EVERYTHING,
    *,
    relevance: float = RELEVANCE,
    trust: Mapping[str, float] = MappingProxyType({}),
) -> NotebookFindings:
    """Return what a joint file's simulation gets wrong in these runs, as `jtq diagnose` does, without a file and a line.

    runs: of `read_runs`, or (name, table); joint: a joint or its file for every joint of the runs, or one for each number;
    the others: see `diagnose.diagnose`. What may not be used is in `channel_notes`.

    Raises ConfigError for a joint file, for a number without columns, and without scipy (extra analysis).
    """
    check_installed("analysis", "scipy")
    read = [r if isinstance(r, RunFile) else RunFile(r[0], Path(r[0]), "table", "", r[1]) for r in runs]
    joints = _joints(joint, read)
    known = scope.known_references.union(*(run.known_loads for run in read))
    scope = replace(scope, known_references=known)
    checked = usable(read, joints, scope)
    findings = findings_of(read, joints, checked, scope, relevance, trust)
    shown = {"joint_files": joints, "relevance": relevance, "trust": trust}
    return NotebookFindings(**vars(findings) | shown)


def _joints(given: JointOrFile | Mapping[int, JointOrFile], runs: Sequence[RunFile]) -> dict[int, Joint]:
    there = sorted({number for run in runs for number in run.table.joints})
    each = given if isinstance(given, Mapping) else dict.fromkeys(there, given)
    for number in each:
        if number not in there:
            have = ", ".join(f"j{n}" for n in there)
            raise ConfigError(f"joint {number}: found no columns of it in the runs, which have {have}")
    return {n: j if isinstance(j, Joint) else joint_for_runs(Path(j), runs, n) for n, j in each.items()}


def usable(runs: Sequence[RunFile], joints: Mapping[int, Joint], scope: Scope) -> CheckedRuns:
    """Return what may be used of the runs, and one line for each fault (`majority`)."""
    checked = check_runs([(run.name, run.table) for run in runs], joints, scope.known_references)
    return majority(checked, runs)


def majority(checked: CheckedRuns, runs: Sequence[RunFile]) -> CheckedRuns:
    """Return what may be used without the joints of which too many recordings are left out, and one line for all runs with
    the same fault: a joint is not judged by the few recordings in which a wrong load or column does not show.
    """
    same: dict[str, list[tuple[str, str]]] = {}
    for line in checked.refused:
        name = next((run.name for run in runs if line.startswith(f"{run.name}: ")), "")
        same.setdefault(_FIGURES.sub("", line.removeprefix(name)), []).append((name, line))
    refused = []
    for found in same.values():
        more = (
            f" (the same in {len(found)} runs: {', '.join(name for name, _ in found)})" if found[1:] else ""
        )
        refused.append(f"{found[0][1]}{more}")
    lacking = sum(note.startswith(LEFT_OUT) for run in runs for note in run.notes)
    minority: list[str] = []
    lost, usable = list(checked.lost), list(checked.runs)
    for number in sorted({n for _, table in usable for n in table.joints}):
        given = {_PIECE.sub("", run.name) for run in runs if number in run.table.joints}
        used = {_PIECE.sub("", name) for name, table in usable if number in table.joints}
        out, of = len(given - used) + lacking, len(given) + lacking
        if may_leave_out(out, of):
            continue
        text = f"found {out} of {of} recordings that cannot be used, expected fewer than half"
        minority.append(f"joint {number}: {text}: what is wrong there may be wrong in all")
        lost.append(number)
        rest = [(name, t.time_s, {n: c for n, c in t.joints.items() if n != number}) for name, t in usable]
        usable = [(name, RunTable(time_s, joints)) for name, time_s, joints in rest if joints]
    return replace(checked, runs=tuple(usable), refused=(*minority, *refused), lost=tuple(sorted(lost)))


def findings_of(  # noqa: PLR0917
    runs: Sequence[RunFile],
    joints: Mapping[int, Joint],
    checked: CheckedRuns,
    scope: Scope,
    relevance: float,
    trust: Mapping[str, float],
) -> Findings:
    """Return the findings of the runs that may be used, with what may not; relevance, trust: see `diagnose.diagnose`.

    No gap in the other joints is no proof for a joint that could not be judged.
    """
    reader = [f"{run.name}: {note}" for run in runs for note in run.notes]
    notes = (*checked.refused, *checked.notes, *reader)
    if not checked.runs:
        reasons = checked.refused or ("found no run with columns of a joint to diagnose",)
        names = tuple(run.name for run in runs)
        return Findings(INSUFFICIENT, reasons, names, tuple(joints), channel_notes=notes)
    with waiting(f"diagnosing {counted(len(checked.runs), 'run')}"):
        from jtqd.sysid.diagnosis.diagnose import diagnose

        left = {number: joint for number, joint in joints.items() if number not in checked.lost}
        findings = diagnose(checked.runs, left, scope, relevance=relevance, trust=trust)
    findings = replace(findings, channel_notes=notes + findings.channel_notes)
    if findings.verdict == NO_GAP and checked.lost:
        one = len(checked.lost) == 1
        lost = f"joint{'' if one else 's'} {', '.join(map(str, checked.lost))}"
        reason = f"{lost}: no run of {'it' if one else 'them'} can be used, the others have no gap"
        return replace(findings, verdict=INSUFFICIENT, reasons=(reason, *checked.refused))
    if findings.verdict == INSUFFICIENT:
        return replace(findings, reasons=(*findings.reasons, *checked.refused))
    return findings
