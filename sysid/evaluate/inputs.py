"""Runs of an evaluation: one that a model was made from is refused with all others, a broken one is named and left out.

Which joint of a run was in velocity mode (the paper's tested joint) comes from the campaign's marks, else from the data: a
velocity loop turns its current over by twice the friction within milliseconds wherever the joint reverses, and follows
every ripple; a current drive follows a smooth command. The second difference of the current over cells of 10 ms is 10 to
50 times larger in velocity mode on the emulated bench.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.evaluate.methods import JointModels, run_hashes
from jtqd.sysid.progress import progress
from jtqd.sysid.runs.channels import Channels, RunIssue, check_channels
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run, run_paths
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.runs.tables import read_truth

_CELL_S: Final = 0.01
_CLEAR: Final = 3.0
"""Ratio of the two joints' roughness from which on the rougher one is called the velocity joint."""


def by_marks(path: Path) -> int | None:
    """Return the velocity joint that the campaign's NAME.json beside NAME.csv.gz names, None where it does not."""
    stem = path.name.removesuffix(".gz").removesuffix(".csv")
    try:
        marks = json.loads(path.with_name(f"{stem}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    number = marks.get("velocity_joint") if isinstance(marks, dict) else None
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def by_data(table: RunTable) -> int | None:
    """Return the velocity joint of a run of two joints by their currents, None where the data are ambiguous."""
    rough = {
        number: _roughness(table.time_s, columns.current_a)
        for number, columns in table.joints.items()
        if columns.current_a is not None
    }
    if len(rough) != 2:
        return None
    (_, low), (number, high) = sorted(rough.items(), key=lambda item: item[1])
    return number if high > _CLEAR * low else None


def _roughness(time_s: FloatArray, current_a: FloatArray) -> float:
    """Root mean square [A] of the second difference of the current's means over cells of 10 ms."""
    size = max(1, round(_CELL_S / float(np.median(np.diff(time_s)))))
    cells = current_a[: len(current_a) // size * size].reshape(-1, size).mean(axis=1)
    if len(cells) < 3:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(cells, n=2) ** 2)))


_NEEDED = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
"""Columns of a joint that must have been measured; the motor's velocity may be derived."""


class EvaluatedRun(NamedTuple):
    """One run: columns by joint number, complete and checked; velocity_joint None: not known; `by`: marks or data.

    truth: true torque [n] by joint, empty where the run has none.
    """

    name: str
    sha256: str
    table: RunTable
    columns: Mapping[int, JointColumns]
    velocity_joint: int | None
    by: str
    truth: Mapping[int, FloatArray] = MappingProxyType({})


class Inputs(NamedTuple):
    """runs: at least one joint of each can be scored; findings: what was left out; notes: of the reader."""

    runs: tuple[EvaluatedRun, ...]
    findings: tuple[RunIssue, ...]
    notes: tuple[str, ...]


def read_inputs(
    arguments: Sequence[Path], models: Sequence[JointModels], columns: Path | None = None
) -> Inputs:
    """Read and check all runs; a progress bar on a terminal.

    Raises:
        ConfigError: models were fitted to, or trained on, one of them, one line per run; the column map.
        RunError: a path that does not exist, or a directory without a run.
    """
    paths = run_paths(arguments)
    mapping = None if columns is None else ColumnMap.load(columns)
    _refuse_trained_on(paths, models)
    runs: list[EvaluatedRun] = []
    findings: list[RunIssue] = []
    notes: list[str] = []
    for path in progress(paths, "reading runs"):
        name = path.name if all(path.name != run.name for run in runs) else str(path)
        try:
            file = read_run(path, mapping, joints=[each.number for each in models])
        except RunError as error:
            findings.append(RunIssue("unreadable", f"{error}: run left out"))
            continue
        twin = next((run.name for run in runs if run.sha256 == file.sha256), None)
        if twin is not None:
            findings.append(
                RunIssue("twice", f"{name}: found the same data as in {twin}: left out, scored once")
            )
            continue
        run, found = _evaluated(name, file, models, path)
        findings += found
        notes += [f"{name}: {note}" for note in file.notes]
        if run.columns:
            runs.append(run)
    return Inputs(tuple(runs), tuple(findings), tuple(notes))


def _refuse_trained_on(paths: Sequence[Path], models: Sequence[JointModels]) -> None:
    """Raise ConfigError when a file holds the data of a run that a model was made from."""
    leaks = []
    for path in filter(Path.is_file, paths):
        hashes = set(run_hashes(path))
        names = [name for each in models for name, runs in each.training.items() if hashes & runs]
        if names:
            leaks.append(f"{path}: found a run that {', '.join(dict.fromkeys(names))} was trained on")
    if leaks:
        raise ConfigError("\n".join(leaks) + "\nexpected held-out runs: nothing was scored")


def _evaluated(
    name: str, file: RunFile, models: Sequence[JointModels], path: Path
) -> tuple[EvaluatedRun, list[RunIssue]]:
    usable: dict[int, JointColumns] = {}
    findings: list[RunIssue] = []
    for each in models:
        found = _check(name, file, each.number, each.joint)
        findings += found
        if not found:
            usable[each.number] = file.table.joint(each.number, each.joint.gear_ratio)
    marked = by_marks(path)
    number = marked if marked is not None else by_data(file.table)
    by = "unknown" if number is None else "data" if marked is None else "marks"
    truth: Mapping[int, FloatArray] = {}
    try:
        truth = read_truth(path)
        if any(len(values) != len(file.table.time_s) for values in truth.values()):
            raise ValueError(
                f"{path}: found true torques of another length than the run's {len(file.table.time_s)} rows"
            )
    except ValueError as error:
        findings.append(RunIssue("truth", f"{error}: not scored against the true torque"))
        truth = {}
    return EvaluatedRun(name, file.sha256, file.table, usable, number, by, truth), findings


def _check(name: str, file: RunFile, number: int, joint: Joint) -> list[RunIssue]:
    """Return the reasons to leave out a joint of a run."""
    where = f"{name}: j{number}"
    if number not in file.table.joints:
        return [RunIssue("missing_joint", f"{where}: found no columns of this joint: not scored")]
    columns = file.table.joints[number]
    dead = [note for note in file.notes if note.startswith(f"j{number}.")]
    missing = [key for key in _NEEDED if getattr(columns, key) is None]
    if dead:
        return [RunIssue("dead_channel", f"{name}: {note}: j{number} not scored") for note in dead]
    if missing:
        return [RunIssue("missing_columns", f"{where}: found no {', '.join(missing)}: not scored")]
    found = check_channels(Channels(file.table.time_s, columns, joint, where))
    return [RunIssue(item.kind, f"{item.text}: j{number} not scored") for item in found]
