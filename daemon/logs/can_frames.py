"""CAN frames out of recorded messages, in arrays: `jtqd_msgs/CanFrames` (several a message), `can_msgs/Frame` (one)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import LogError
from jtqd.daemon.logs.read import Messages, Records, iter_messages, topics_of
from jtqd.daemon.recording.schemas import FRAMES_NAMES

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Bits of `can_id` as in Linux: 29-bit identifier, remote frame, error frame."""
_OURS = FRAMES_NAMES
_ROS = ("can_msgs/msg/Frame", "can_msgs/Frame")


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
    found = [topic for topic, schema in topics_of(path).items() if schema in _OURS or schema in _ROS]
    if not found:
        raise LogError(f"{path}: found no topic with CAN frames, expected {_OURS[0]} or {_ROS[0]}")
    return sorted(found)


def iter_frames(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Frames]:
    """Yield frames of one topic, chunk by chunk. Raises LogError, OSError."""
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        names = messages.records.dtype.names or ()
        if "frames" in names and "frame_count" in names and "stamps_ns" in names:
            yield _of_cycles(messages)
        elif "id" in names and "dlc" in names and "data" in names:
            yield _of_ros(messages)
        else:
            raise LogError(f"{path}: {topic}: found fields {', '.join(names)}, expected those of CAN frames")


def _of_cycles(messages: Messages) -> Frames:
    records = messages.records
    frames, stamps = records["frames"], records["stamps_ns"].astype(np.int64)
    there = np.arange(frames.shape[1]) < records["frame_count"][:, None]
    # A frame without a stamp of the kernel has that of its message.
    stamps = np.where(stamps == 0, messages.log_times.astype(np.int64)[:, None], stamps)
    return _frames(stamps[there], frames["id"][there], frames["length"][there], frames["data"][there])


def _of_ros(messages: Messages) -> Frames:
    records: Records = messages.records
    ids = records["id"].astype(np.uint32) & 0x1FFF_FFFF
    for name, bit in (("is_extended", EXTENDED), ("is_rtr", REMOTE), ("is_error", ERROR)):
        if name in (records.dtype.names or ()):
            ids = ids | np.where(records[name], np.uint32(bit), np.uint32(0))
    stamps = messages.log_times.astype(np.int64)
    return _frames(stamps, ids.astype(np.uint32), records["dlc"], records["data"])


def _frames(
    stamps: NDArray[np.int64], ids: NDArray[np.uint32], lengths: NDArray[np.uint8], data: NDArray[np.uint8]
) -> Frames:
    if data.ndim != 2 or data.shape[1] != 8:
        raise LogError(f"found {data.shape[1:]} bytes in a frame, expected 8")
    lengths = np.minimum(lengths, 8).astype(np.uint8)
    return Frames(stamps, ids, lengths, np.where(np.arange(8) < lengths[:, None], data, 0).astype(np.uint8))
