"""What a replay needs of a log's messages: names and types. A log of another version may have others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.logs.errors import LogError
from daemon.shared import cycle_record as cr

SAMPLE = np.dtype(
    [
        (name, "<f8" if code == "d" else "<u2")
        for name, code in zip(cr.JointRecord._fields, 12 * "d" + 4 * "H", strict=True)
    ]
)
"""What the loop records of a joint: the fields of `cycle_record.JointRecord`."""

STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
JOINT: dict[str, np.dtype[Any]] = {
    "header.stamp": STAMP,
    "cycle": np.dtype("<u8"),
    "sync_monotonic_ns": np.dtype("<i8"),
    "sync_counter": np.dtype("u1"),
    "cycle_flags": np.dtype("u1"),
    **{name: SAMPLE[name] for name in SAMPLE.names or ()},
}
"""Of /joint/N/state: path -> type."""
FRAMES: dict[str, np.dtype[Any]] = {
    "cycle": np.dtype("<u8"),
    "frame_count": np.dtype("u1"),
    "frames_left_out": np.dtype("u1"),
    "frames.id": np.dtype("<u4"),
    "frames.length": np.dtype("u1"),
    "frames.data": np.dtype(("u1", 8)),
}
"""Of /can/frames: path -> type of each element."""


def check_fields(
    records: npt.NDArray[np.void], needed: Mapping[str, np.dtype[Any]], path: Path, topic: str
) -> None:
    """Raises LogError where a field is missing or is of another type."""
    for name, expected in needed.items():
        found: np.dtype[Any] = records.dtype
        for step in name.split("."):
            if step not in (found.base.names or ()):
                raise LogError(f"{path}: {topic}: found no field {name}, expected one as this jtqd writes it")
            found = found.base[step]
        if found != expected:
            raise LogError(f"{path}: {topic}: found {name} of type {found}, expected {expected}")
