"""CAN frames of recorded messages (`jtqd_msgs/CanFrames`) in arrays, and as lines of candump."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import LogError
from jtqd.daemon.logs.read import iter_messages, topics_of
from jtqd.daemon.recording.schemas import FRAMES_NAMES

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Bits of `can_id` as in Linux: 29-bit identifier, remote frame, error frame."""


class Frames(NamedTuple):
    """n frames in the order of the log."""

    stamps_ns: NDArray[np.int64]
    """CLOCK_REALTIME; receive time by the kernel, where it is known."""
    ids: NDArray[np.uint32]
    """With the bits of Linux."""
    lengths: NDArray[np.uint8]
    data: NDArray[np.uint8]
    """[n, 8], zeros behind the length."""


def can_topics(path: Path | Sequence[Path]) -> list[str]:
    """Topics that carry CAN frames. Raises LogError where there is none, OSError."""
    found = [topic for topic, schema in topics_of(path).items() if schema in FRAMES_NAMES]
    if not found:
        raise LogError(f"{path}: found no topic with CAN frames, expected {FRAMES_NAMES[0]}")
    return sorted(found)


def iter_frames(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Frames]:
    """Yield frames of one topic, chunk by chunk. Raises LogError, OSError."""
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        records = messages.records
        names = ", ".join(records.dtype.names or ())
        if not all(each in names for each in ("frames", "frame_count", "stamps_ns")):
            raise LogError(f"{path}: {topic}: found fields {names}, expected those of CAN frames")
        frames, stamps = records["frames"], records["stamps_ns"].astype(np.int64)
        present = np.arange(frames.shape[1]) < records["frame_count"][:, None]
        # A frame without a stamp of the kernel has that of its message.
        stamps = np.where(stamps == 0, messages.log_times.astype(np.int64)[:, None], stamps)
        lengths = np.minimum(frames["length"][present], 8).astype(np.uint8)
        data = np.where(np.arange(8) < lengths[:, None], frames["data"][present], 0).astype(np.uint8)
        yield Frames(stamps[present], frames["id"][present], lengths, data)


def candump_lines(frames: Frames, interface: str) -> Iterator[str]:
    """Yield frames as lines of `candump -L`, without their ends: `(1700000000.000000) can0 181#0011223344556677`."""
    rows = zip(
        frames.stamps_ns.tolist(), frames.ids.tolist(), frames.lengths.tolist(), frames.data, strict=True
    )
    for stamp, can_id, length, data in rows:
        seconds, rest = divmod(stamp, 1_000_000_000)
        number = f"{can_id & 0x3FFFFFFF:08X}" if can_id & (EXTENDED | ERROR) else f"{can_id & 0x7FF:03X}"
        content = f"R{length or ''}" if can_id & REMOTE else data[:length].tobytes().hex().upper()
        yield f"({seconds}.{rest // 1000:06d}) {interface} {number}#{content}"
