"""Recorded runs: files to run tables and back, checks of their channels, and the joint file of each joint.

In: CSV, gzipped CSV, Parquet, MCAP logs of jtqd, with an optional column map. Out: `RunFile` and `CheckedRun`, frozen.
Imports estimator and models; logs (`jtqd.sysid.runs.logs`) and Parquet are imported when such a file is read.

    >>> import tempfile
    >>> from pathlib import Path
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = (folder / "a.csv").write_text("time_s,j1.current_a\\n0.000,1.5\\n0.001,1.6\\n0.002,1.6\\n")
    >>> [run] = read_runs([folder])
    >>> run.name, run.source, run.table.joints[1].current_a
    ('a.csv', 'csv', array([1.5, 1.6, 1.6]))
    >>> write_run(folder / "b.csv.gz", run.table) == read_run(folder / "b.csv.gz").sha256
    True
"""

from jtqd.sysid.runs.channels import RunIssue
from jtqd.sysid.runs.checks import CheckedRun, CheckedRuns, check_run, check_runs
from jtqd.sysid.runs.column_map import Column, ColumnMap
from jtqd.sysid.runs.files import read_run, read_runs, run_paths
from jtqd.sysid.runs.options import joint_files, joint_number, joints_of, named_joints, only
from jtqd.sysid.runs.run_file import RunError, RunFile
from jtqd.sysid.runs.tables import write_run

__all__ = [
    "CheckedRun",
    "CheckedRuns",
    "Column",
    "ColumnMap",
    "RunError",
    "RunFile",
    "RunIssue",
    "check_run",
    "check_runs",
    "joint_files",
    "joint_number",
    "joints_of",
    "named_joints",
    "only",
    "read_run",
    "read_runs",
    "run_paths",
    "write_run",
]
