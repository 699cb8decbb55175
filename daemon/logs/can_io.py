"""Reader and writer of `.mcap` for python-can (entry points `can.io.message_reader` and `can.io.message_writer`).

`can_logconvert run.mcap run.blf`, `can_player run.mcap` and `can_logger -f bus.mcap` work with them, and `can.LogReader` and
`can.Logger` in a program. What the writer leaves is read by the same reader, by `jtq export` and by Foxglove.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
from can.io.generic import MessageReader, SizedMessageWriter
from mcap.writer import CompressionType, Writer

from jtqd.daemon.logs.log_file import LogError
from jtqd.daemon.logs.read import ERROR, EXTENDED, REMOTE, can_topics, interface_of, iter_bus
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
        topic: where there are several with frames; default all, by their stamps.

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
        for topic, stamp, can_id, length, data in iter_bus(self._path, self._topics):
            remote = bool(can_id & REMOTE)
            yield can.Message(
                timestamp=stamp * 1e-9,
                arbitration_id=can_id & (0x1FFF_FFFF if can_id & (EXTENDED | ERROR) else 0x7FF),
                is_extended_id=bool(can_id & EXTENDED),
                is_remote_frame=remote,
                is_error_frame=bool(can_id & ERROR),
                channel=interface_of(topic) or None,
                dlc=length,
                data=None if remote else data,
            )

    def stop(self) -> None:
        """Nothing stays open between two frames."""


class McapCanWriter(SizedMessageWriter):  # type: ignore[misc]
    """Writes frames as jtqd does: up to 16 frames of one millisecond in a message, to the microsecond.

    Topic: /can/frames, and of frames with a channel that of the interface, /can1/frames.

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
        self._schema = self._writer.register_schema(
            CAN_FRAMES.schema, "ros2msg", SCHEMAS[CAN_FRAMES.schema].encode()
        )
        self._channels: dict[str, int] = {}
        self._stamps: dict[str, list[int]] = {}
        self._frames: dict[str, list[bytes]] = {}
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
        stamp = max(0, 1000 * round(msg.timestamp * 1e6))
        name = (
            f"can{msg.channel}"
            if isinstance(msg.channel, int)
            else re.sub(r"[^\w.-]", "_", msg.channel or "")
        )
        topic = f"/{name}/frames" if name else CAN_FRAMES.name
        stamps = self._stamps.get(topic, [])
        if stamps and (len(stamps) == _CAPACITY or not 0 <= stamp - stamps[0] < _SPAN_NS):
            self._put()
        can_id = msg.arbitration_id & 0x1FFF_FFFF
        can_id |= EXTENDED if msg.is_extended_id else 0
        can_id |= (REMOTE if msg.is_remote_frame else 0) | (ERROR if msg.is_error_frame else 0)
        data = b"" if msg.is_remote_frame else bytes(msg.data)
        self._stamps.setdefault(topic, []).append(stamp)
        self._frames.setdefault(topic, []).append(_FRAME.pack(can_id, min(msg.dlc, 8), data))

    def _put(self) -> None:
        """Write the frames that wait, of every interface."""
        for topic, stamps in self._stamps.items():
            self._put_message(topic, stamps, self._frames[topic])
        self._stamps, self._frames = {}, {}

    def _put_message(self, topic: str, stamps: list[int], frames: list[bytes]) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schema)
        first, count = stamps[0], len(stamps)
        seconds, nanoseconds = divmod(first, 1_000_000_000)
        head = _HEAD.pack(b"\0\1\0\0", seconds & 0xFFFF_FFFF, nanoseconds, _FRAME_ID, self._count, count)
        body = b"".join(frames).ljust(_FRAME.size * _CAPACITY, b"\0")
        times = struct.pack(f"<{_CAPACITY}q", *stamps, *([0] * (_CAPACITY - count)))
        self._writer.add_message(
            self._channels[topic],
            log_time=first,
            publish_time=first,
            data=head + body + times,
            sequence=self._count & 0xFFFF_FFFF,
        )
        self._count += 1
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
