"""Model of a classic CAN wire: one frame at a time, the highest priority first, exact length with stuff bits. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from jtqd.drivers.frame import FRAME, arbitration_key, stuffed_bits

_NS_PER_S = 1_000_000_000


class _Waiting(NamedTuple):
    """A frame in a transmit queue."""

    key: int
    submitted_ns: int
    order: int
    bits: int
    frame: bytes
    sender: Hashable


class WireModel:
    """A classic CAN wire of `bitrate` bit/s. Times are integer nanoseconds on any one clock, and arguments.

    Each sender is a controller with a first-in first-out queue of `queue_limit` frames; the head of its queue takes part in
    arbitration. A frame starts when the wire is free and somebody has one; whatever had been submitted by then arbitrates.
    Submissions may come late (a hub reads its sockets late, with the kernel's stamp of the send): only a frame already
    started by an earlier `advance` keeps the wire.

    Attributes:
        bits, frames: transmitted so far.
    """

    def __init__(self, bitrate: int, queue_limit: int = 128) -> None:
        if bitrate <= 0:
            raise ValueError(f"bit rate must be positive, not {bitrate}")
        self.bitrate = bitrate
        self.bits = 0
        self.frames = 0
        self._queue_limit = queue_limit
        self._queues: dict[Hashable, deque[_Waiting]] = {}
        self._free_ns = 0
        self._on_wire: tuple[_Waiting, int] | None = None
        self._order = 0

    def duration_ns(self, bits: int) -> int:
        """Return the time of `bits` on the wire, rounded up to ns."""
        return -(-bits * _NS_PER_S // self.bitrate)

    def pending(self, sender: Hashable) -> int:
        """Return how many frames of `sender` wait for the wire."""
        queue = self._queues.get(sender)
        return len(queue) if queue else 0

    def submit(self, sender: Hashable, frame: bytes, t_ns: int) -> bool:
        """Queue the 16-byte `frame` of `sender` at time t_ns; False when its queue is full.

        Times of one sender must not decrease; one that does counts as the time before it.
        """
        queue = self._queues.get(sender)
        if queue is None:
            queue = self._queues[sender] = deque()
        elif len(queue) >= self._queue_limit:
            return False
        elif queue:
            t_ns = max(t_ns, queue[-1].submitted_ns)
        can_id, length, data = FRAME.unpack(frame)
        bits = stuffed_bits(can_id, data[:length])
        self._order += 1
        queue.append(_Waiting(arbitration_key(can_id), t_ns, self._order, bits, frame, sender))
        return True

    def next_end(self) -> int | None:
        """Return when the next transmission ends if nothing else is submitted; None for an idle wire."""
        if self._on_wire is not None:
            return self._on_wire[1]
        following = self._following()
        if following is None:
            return None
        start, winner = following
        return start + self.duration_ns(winner.bits)

    def advance(self, t_ns: int) -> list[tuple[Hashable, bytes, int]]:
        """Let time pass to t_ns; return (sender, frame, end_ns) of each transmission that ended by then.

        A frame that starts before t_ns is on the wire for good. One that would start at t_ns itself still
        arbitrates against what is submitted for that moment afterwards.
        """
        ended: list[tuple[Hashable, bytes, int]] = []
        while True:
            if self._on_wire is None:
                following = self._following()
                if following is None or following[0] >= t_ns:
                    return ended
                start, winner = following
                queue = self._queues[winner.sender]
                queue.popleft()
                if not queue:
                    del self._queues[winner.sender]
                self._on_wire = (winner, start + self.duration_ns(winner.bits))
            sent, end = self._on_wire
            if end > t_ns:
                return ended
            self._on_wire = None
            self._free_ns = end
            self.bits += sent.bits
            self.frames += 1
            ended.append((sent.sender, sent.frame, end))

    def _following(self) -> tuple[int, _Waiting] | None:
        """Return (start, winner) of the next arbitration; equal fields go in order of submission."""
        if not self._queues:
            return None
        heads = [queue[0] for queue in self._queues.values()]
        start = max(self._free_ns, min(head.submitted_ns for head in heads))
        return start, min(head for head in heads if head.submitted_ns <= start)
