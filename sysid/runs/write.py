"""A run table as a CSV file, gzipped or not."""

from __future__ import annotations

import gzip
import hashlib
import os
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.run import COLUMN_NAMES, RunTable

DECIMALS: Final = 10
_COMPRESSION: Final = 6
_ROWS_AT_A_TIME: Final = 8192


def write_run(path: Path | str, table: RunTable) -> str:
    """Write `table` as .csv or .csv.gz, whole or not at all: an earlier file stays until the new one is complete.

    Returns the SHA-256 of the file (hex), as `read_run` does. The same table gives the same bytes.

    Columns: time_s, then those that each joint has, in the order of the joints' numbers and of COLUMN_NAMES. Numbers are
    written to 1e-10 of their unit, less than what any encoder, current or torque channel resolves and a third of the size
    that all 17 digits would take: reading gives every value back to 5e-11 (values above 1e5 to 1e-15 of themselves).

    Raises:
        ValueError: the name ends in neither .csv nor .csv.gz.
        OSError: it cannot be written.
    """
    path = Path(path)
    if not path.name.endswith((".csv", ".csv.gz")):
        raise ValueError(f"{path}: found a name ending in '{path.suffix}', expected .csv or .csv.gz")
    names, columns = ["time_s"], [table.time_s]
    for number in sorted(table.joints):
        for name in COLUMN_NAMES:
            column = getattr(table.joints[number], name)
            if column is not None:
                names.append(f"j{number}.{name}")
                columns.append(column)
    values = np.round(np.column_stack(columns), DECIMALS) + 0.0  # + 0.0: no "-0.0"
    lines = [",".join(names)]
    for start in range(0, len(values), _ROWS_AT_A_TIME):
        lines += [",".join(map(repr, row)) for row in values[start : start + _ROWS_AT_A_TIME].tolist()]
    data = ("\n".join(lines) + "\n").encode()
    if path.suffix == ".gz":
        data = gzip.compress(data, _COMPRESSION, mtime=0)
    temporary = path.with_name(f".{path.name}.part")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return hashlib.sha256(data).hexdigest()
