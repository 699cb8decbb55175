"""Runs through a recorder, into files, and from the files to findings: what `jtq diagnose` would read, nothing else."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.run import RunTableError
from jtqd.sysid.diagnosis.command import diagnosed
from jtqd.sysid.diagnosis.findings import Findings
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.joints import joints_of
from jtqd.sysid.runs.run_file import RunError
from validation.worlds.recorder import Recorder, csv_text, record
from validation.worlds.sets import Columns

REFUSED: Final = "refused"
"""Verdict of runs that the reader does not take, or that end in a traceback."""


def write(
    folder: Path,
    runs: Sequence[Columns],
    joints: Mapping[int, Mapping[str, Any]],
    recorder: Recorder,
    seed: int,
) -> tuple[list[Path], dict[int, Path]]:
    """Write run1.csv.. and joint1.yaml.. and return their paths; nothing in them tells what is hidden."""
    paths = []
    for k, table in enumerate(record(runs, recorder, seed)):
        paths.append(folder / f"run{k + 1}.csv")
        paths[-1].write_text(csv_text(table, recorder), encoding="utf-8")
    files = {}
    for number, joint in joints.items():
        files[number] = folder / f"joint{number}.yaml"
        files[number].write_text(yaml.safe_dump(dict(joint), sort_keys=False), encoding="utf-8")
    return paths, files


def judged(
    runs: Sequence[Columns],
    joints: Mapping[int, Mapping[str, Any]],
    recorder: Recorder,
    seed: int,
) -> Findings:
    """Return the findings on the recorded files; verdict `REFUSED` with the error where there are none."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        paths, files = write(Path(folder), runs, joints, recorder, seed)
        try:
            read = read_runs(paths, segments=True)  # as the command does
            return diagnosed(read, joints_of(files, read))
        except (ConfigError, RunError, RunTableError) as error:
            text = str(error).replace(folder, "")
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
    return Findings(REFUSED, (text,), (), tuple(joints))
