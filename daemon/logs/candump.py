"""Frames as lines of `candump -L`: `(1700000000.000000) can0 181#0011223344556677`."""

from __future__ import annotations

from collections.abc import Iterator

from jtqd.daemon.logs.can_frames import ERROR, EXTENDED, REMOTE, Frames


def candump_lines(frames: Frames, interface: str) -> Iterator[str]:
    """One line a frame, without its end; the time to the microsecond."""
    rows = zip(
        frames.stamps_ns.tolist(), frames.ids.tolist(), frames.lengths.tolist(), frames.data, strict=True
    )
    for stamp, can_id, length, data in rows:
        seconds, rest = divmod(stamp, 1_000_000_000)
        number = f"{can_id & 0x3FFFFFFF:08X}" if can_id & (EXTENDED | ERROR) else f"{can_id & 0x7FF:03X}"
        content = f"R{length or ''}" if can_id & REMOTE else data[:length].tobytes().hex().upper()
        yield f"({seconds}.{rest // 1000:06d}) {interface} {number}#{content}"
