"""An independent listener: every frame on the bus with its kernel stamp, taken by a thread with a socket of its own."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from jtqd.drivers.frame_socket import BusDown, BusGone, open_frame_socket

FRAME = np.dtype([("id", "<u4"), ("length", "u1"), ("marks", "3u1"), ("data", "8u1")])
_EVERY_S = 0.004
_CAPACITY = 256
_TAIL = 16
"""Frames of two cycles."""
SYNC = 0x080


class Heard:
    """Frames in the order of the bus.

    Args:
        frames: [n] of `id`, `length`, `data` [8].
        stamps_ns: [n] kernel receive stamps, CLOCK_REALTIME.
        sync_length: bytes of jtqd's SYNC.
    """

    def __init__(self, frames: NDArray[np.void], stamps_ns: NDArray[np.int64], sync_length: int = 1) -> None:
        self.sync_length = sync_length
        self.frames = frames
        self.ids, self.lengths, self.data = frames["id"], frames["length"], frames["data"]
        self.stamps_ns = stamps_ns
        self._syncs = (self.ids == SYNC) & (self.lengths == sync_length)

    def tail(self) -> Heard:
        """The last frames: what follows is then seen to follow, or to be missing."""
        return Heard(self.frames[-_TAIL:], self.stamps_ns[-_TAIL:], self.sync_length)

    def at(self, *ids: int) -> NDArray[np.intp]:
        """Indices of the frames with one of these identifiers [m]."""
        return np.flatnonzero(np.isin(self.ids, ids))

    def count(self, can_id: int, *starts: bytes) -> int:
        """How many frames with this identifier there were; `starts`: those that begin with one of these bytes."""
        at = self.at(can_id)
        if not starts:
            return len(at)
        return sum(self.bytes(n).startswith(starts) for n in at)

    def bytes(self, n: int) -> bytes:
        """Data of a frame."""
        return bytes(self.data[n, : self.lengths[n]])

    @property
    def syncs(self) -> NDArray[np.intp]:
        """Indices of jtqd's SYNCs, by their length [m]."""
        return np.flatnonzero(self._syncs)

    def delays_ns(self, can_id: int) -> NDArray[np.int64]:
        """Time of each of these frames after the SYNC before it [m]."""
        syncs, at = self.syncs, self.at(can_id)
        before = np.searchsorted(syncs, at) - 1
        known = before >= 0
        return np.asarray(self.stamps_ns[at[known]] - self.stamps_ns[syncs[before[known]]])

    def without(self, can_id: int, within_ns: int = 850_000) -> int:
        """Cycles, from one SYNC to the next, in which no such frame came within that time."""
        syncs, at = self.syncs, self.at(can_id)
        before = np.searchsorted(syncs, at) - 1
        at, before = at[before >= 0], before[before >= 0]
        in_time = before[self.stamps_ns[at] - self.stamps_ns[syncs[before]] <= within_ns]
        return max(len(syncs) - 1, 0) - len(np.unique(in_time[in_time < len(syncs) - 1]))

    def positions(self, node: int) -> NDArray[np.int64]:
        """Motor and link position in the node's TPDO1 [m, 2], counts."""
        return self._numbers(0x180 + node, "<i4").reshape(-1, 2)

    def velocities(self, node: int) -> NDArray[np.int64]:
        """Motor velocity in its TPDO2 [m], counts/s."""
        return self._numbers(0x280 + node, "<i4").reshape(-1, 2)[:, 0]

    def _numbers(self, can_id: int, layout: str) -> NDArray[np.int64]:
        at = self.at(can_id)
        return np.ascontiguousarray(self.data[at[self.lengths[at] == 8]]).view(layout).astype(np.int64)


class Ears(threading.Thread):
    """Listens from the moment it is made.

    Attributes:
        dropped: frames that the listener itself has lost, as the kernel counts them.
    """

    def __init__(self, bus: str, sync_length: int = 1) -> None:
        super().__init__(daemon=True)
        self._sync_length = sync_length
        self._socket = open_frame_socket(bus, None, error_frames=True, capacity=_CAPACITY)
        self._chunks: deque[tuple[bytes, NDArray[np.int64]]] = deque()
        self._ended, self._lock = False, threading.Lock()
        self.start()

    @property
    def dropped(self) -> int:
        """See the class."""
        return self._socket.rx_dropped

    def run(self) -> None:
        """Take what has come, again and again."""
        with suppress(PermissionError):  # of this thread: it must not wait for other programs
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
        while not self._ended:
            time.sleep(_EVERY_S)
            self.listen()

    def listen(self) -> None:
        """Take what has come by now."""
        with self._lock:
            self._take()

    def _take(self) -> None:
        socket, count = self._socket, _CAPACITY
        while count == _CAPACITY:
            try:
                count = socket.receive()
            except BusDown:
                return
            except BusGone:
                self._ended = True
                return
            if count:
                stamps_ns = np.array(socket.stamps_ns[:count], np.int64)
                self._chunks.append((bytes(socket.frames[: 16 * count]), stamps_ns))

    def heard(self) -> Heard:
        """Everything since the last call."""
        chunks = [self._chunks.popleft() for _ in range(len(self._chunks))]
        frames = np.frombuffer(b"".join(data for data, _ in chunks), FRAME)
        stamps_ns = np.concatenate([np.empty(0, np.int64), *(stamps for _, stamps in chunks)])
        return Heard(frames, stamps_ns, self._sync_length)

    def end(self) -> None:
        """Stop listening; `heard` still gives what has come."""
        self._ended = True
        self.join()
        self.listen()
        self._socket.close()


def joined(parts: list[Heard]) -> Heard:
    """Several in a row as one."""
    frames = np.concatenate([np.empty(0, FRAME), *(each.frames for each in parts)])
    stamps_ns = np.concatenate([np.empty(0, np.int64), *(each.stamps_ns for each in parts)])
    return Heard(frames, stamps_ns, parts[0].sync_length if parts else 1)
