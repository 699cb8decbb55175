"""jtqd's logs as run files: columns, and notes of what is missing. Cheap to import: MCAP (`jtqd.sysid.runs.logs`) is
imported when a log is read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from jtqd.estimator.checked import counted
from jtqd.estimator.run import COLUMN_NAMES
from jtqd.sysid.runs.column_map import TIME
from jtqd.sysid.runs.content import Content, file_bytes
from jtqd.sysid.runs.run_file import RunError


def read_log(path: Path, *parts: Path, joints: Sequence[int] | None = None) -> Content:
    """Read a log, or all parts of one run; the hash is that of all files one after another."""
    from jtqd.daemon.logs import LogError
    from jtqd.sysid.runs.logs import log_to_run

    sha256 = file_bytes(path)[1]
    if parts:
        sha256 = hashlib.sha256(b"".join(file_bytes(each)[0] for each in (path, *parts))).hexdigest()
    try:
        logged = log_to_run((path, *parts) if parts else path, joints=joints)
    except LogError as error:
        text = str(error)
        raise RunError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    notes = [f"{len(parts) + 1} parts of one run: {path.name} to {parts[-1].name}"] if parts else []
    notes += [f"joint {number} left out: {why}" for number, why in logged.left_out.items()]
    one = [n for n, columns in logged.table.joints.items() if columns.link_position_rad is None]
    if one:
        which = f"joint{'s' * (len(one) > 1)} {', '.join(map(str, one))}"
        notes.append(f"{which}: one encoder, no link position: nothing is known of the torsion of the gear")
    if logged.missed or logged.incomplete:
        by = ", ".join(f"{count} of {name}" for name, count in logged.incomplete_by.items() if count)
        notes.append(
            f"{counted(logged.missed, 'cycle')} missed and {logged.incomplete} incomplete{f' ({by})' if by else ''}: "
            f"{logged.lost_share:.2%} of the slots have no row"
        )
    values = {TIME: logged.table.time_s}
    for number, columns in logged.table.joints.items():
        for name in COLUMN_NAMES:
            column = getattr(columns, name)
            if column is not None:
                values[f"j{number}.{name}"] = column
    return Content(path, "mcap", sha256, values, notes=tuple(notes))
