"""Reader and writer of `.mcap` for python-can (entry points `can.io.message_reader` and `can.io.message_writer`).

`can_logconvert run.mcap run.blf`, `can_player run.mcap` and `can_logger -f bus.mcap` work with them, and `can.LogReader` and
`can.Logger` in a program. What the writer leaves is read by the same reader, by `jtq export` and by Foxglove.
"""

from __future__ import annotations

import fcntl
import logging
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
from can.io.generic import MessageReader, SizedMessageWriter
from mcap.writer import CompressionType, Writer

from jtqd.daemon.logs.log_file import LogError
from jtqd.daemon.logs.read import ERROR, EXTENDED, REMOTE, can_topics, iter_frames
from jtqd.daemon.recording.messages import CAN_FRAMES, SCHEMAS

_LOG = logging.getLogger("can.io.mcap")
_CAPACITY = 16
_SPAN_NS = 1_000_000
"""Frames within this time go into one message, as jtqd's own do."""
_CHUNK_BYTES = 256 << 10
_FLUSH_NS = 500_000_000
"""A crash costs this much at most, in time of the frames."""
_HEAD = struct.Struct("<4sII8sQ8x16xxB6x")
"""Encapsulation, stamp, frame_id, cycle, number of frames; zeros: monotonic time and numbers of the loop."""
_FRAME = struct.Struct("<IB3x8s")
_FRAME_ID = struct.pack("<I4s", 4, b"can\0")


class McapCanReader(MessageReader):  # type: ignore[misc]
    """Frames of a log of jtqd or of `McapCanWriter`, in the order of the log.

    Args:
        file: path of the log, or of a directory with the parts of one run.
        topic: where there are several with frames; default all, one after the other.

    Raises:
        LogError (a ValueError): damaged, no frames in it, or none on that topic; also while it is read.
        OSError: it cannot be read.
    """

    def __init__(self, file: str | os.PathLike[str], topic: str | None = None, **_: Any) -> None:
        self._path = Path(file)
        self._topics = can_topics(self._path)
        if topic is not None and topic not in self._topics:
            raise LogError(f"{file}: found frames on {', '.join(self._topics)}, expected them on {topic}")
        self._topics = self._topics if topic is None else [topic]

    def __iter__(self) -> Iterator[can.Message]:
        for topic in self._topics:
            for frames in iter_frames(self._path, topic):
                for stamp, can_id, length, data in frames.rows():
                    remote = bool(can_id & REMOTE)
                    yield can.Message(
                        timestamp=stamp * 1e-9,
                        arbitration_id=can_id & (0x1FFF_FFFF if can_id & (EXTENDED | ERROR) else 0x7FF),
                        is_extended_id=bool(can_id & EXTENDED),
                        is_remote_frame=remote,
                        is_error_frame=bool(can_id & ERROR),
                        dlc=length,
                        data=None if remote else data,
                    )

    def stop(self) -> None:
        """Nothing stays open between two frames."""


class McapCanWriter(SizedMessageWriter):  # type: ignore[misc]
    """Writes frames as jtqd does: topic /can/frames, up to 16 frames of one millisecond in a message.

    The file is locked while it is open. One that a crash has left is repaired by `jtq recover`. Frames of CAN FD have no
    room in these messages: they are left out and counted, with a warning.

    Args:
        file: path; an existing file is replaced.
    """

    def __init__(self, file: str | os.PathLike[str], append: bool = False, **_: Any) -> None:
        if append:
            raise ValueError(f"{file}: an MCAP file cannot be continued; choose another name")
        self.file = open(file, "wb")  # noqa: SIM115 - closed by stop()
        with suppress(OSError):
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._writer = Writer(self.file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="jtqd")
        schema = self._writer.register_schema(
            CAN_FRAMES.schema, "ros2msg", SCHEMAS[CAN_FRAMES.schema].encode()
        )
        self._channel = self._writer.register_channel(CAN_FRAMES.name, "cdr", schema)
        self._stamps: list[int] = []
        self._frames: list[bytes] = []
        self._count = 0
        self._flushed_ns = 0
        self.left_out = 0

    def on_message_received(self, msg: can.Message) -> None:
        """Take one frame."""
        if msg.is_fd or len(msg.data) > 8:
            self.left_out += 1
            if self.left_out == 1:
                _LOG.warning("CAN FD frames are left out: logs of jtqd cannot store them")
            return
        stamp = max(0, round(msg.timestamp * 1e9))
        if self._stamps and (len(self._stamps) == _CAPACITY or not 0 <= stamp - self._stamps[0] < _SPAN_NS):
            self._put()
        can_id = msg.arbitration_id & 0x1FFF_FFFF
        can_id |= EXTENDED if msg.is_extended_id else 0
        can_id |= (REMOTE if msg.is_remote_frame else 0) | (ERROR if msg.is_error_frame else 0)
        self._stamps.append(stamp)
        data = b"" if msg.is_remote_frame else bytes(msg.data)
        self._frames.append(_FRAME.pack(can_id, min(msg.dlc, 8), data))

    def _put(self) -> None:
        if not self._stamps:
            return
        first, count = self._stamps[0], len(self._stamps)
        seconds, nanoseconds = divmod(first, 1_000_000_000)
        head = _HEAD.pack(b"\0\1\0\0", seconds & 0xFFFF_FFFF, nanoseconds, _FRAME_ID, self._count, count)
        frames = b"".join(self._frames).ljust(_FRAME.size * _CAPACITY, b"\0")
        stamps = struct.pack(f"<{_CAPACITY}q", *self._stamps, *([0] * (_CAPACITY - count)))
        self._writer.add_message(
            self._channel,
            log_time=first,
            publish_time=first,
            data=head + frames + stamps,
            sequence=self._count & 0xFFFF_FFFF,
        )
        self._count += 1
        self._stamps, self._frames = [], []
        if abs(first - self._flushed_ns) >= _FLUSH_NS:
            self._flushed_ns = first
            if hasattr(self._writer, "flush"):  # mcap 1.6 and later
                self._writer.flush()
            self.file.flush()

    def file_size(self) -> int:
        """Return bytes written so far."""
        return self.file.tell()

    def stop(self) -> None:
        """End the file."""
        if self.file.closed:
            return
        self._put()
        self._writer.finish()
        self.file.close()
        if self.left_out:
            _LOG.warning("%d CAN FD frames were left out", self.left_out)
