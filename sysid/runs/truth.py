"""True torques of an emulated run, which no instrument knows: NAME.truth.npz beside the run's table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np

from jtqd.estimator.arrays import FloatArray

ENDING: Final = ".truth.npz"


def truth_path(run: Path) -> Path:
    """Return where the true torques of a run file lie: NAME.truth.npz beside NAME.csv.gz."""
    return run.with_name(run.name.removesuffix(".gz").removesuffix(".csv") + ENDING)


def write_truth(run: Path, torque_nm: Mapping[int, FloatArray]) -> None:
    """Write the true torque [n] of each joint of a run. Raises OSError."""
    arrays = {f"j{number}": values for number, values in torque_nm.items()}
    np.savez_compressed(truth_path(run), **arrays)  # type: ignore[arg-type]


def read_truth(run: Path) -> dict[int, FloatArray]:
    """Return the true torque [n] by joint; empty where the run has none. Raises ValueError for a file that is none."""
    path = truth_path(run)
    if not path.is_file():
        return {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {
                int(name.removeprefix("j")): np.asarray(arrays[name], np.float64) for name in arrays.files
            }
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ValueError(f"{path}: found no arrays j1, j2, ... ({error}), expected true torques") from None
