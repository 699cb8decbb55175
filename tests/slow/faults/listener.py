"""An independent listener with a socket of its own, and proofs that a fault took place, from what it has heard.

A proof takes everything heard (`Heard`) and gives what was seen of the fault and whether that is enough. On a healthy bus it
must not be.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Seen:
    """What was seen, in words, and whether it proves the fault."""

    ok: bool
    text: str


Proof = Callable[[Heard], Seen]


def all_of(*proofs: Proof) -> Proof:
    """Each of them."""

    def proof(heard: Heard) -> Seen:
        seen = [each(heard) for each in proofs]
        return Seen(all(each.ok for each in seen), ", ".join(each.text for each in seen))

    return proof


def frames(least: int, can_id: int, *starts: bytes) -> Proof:
    """So many frames with this identifier (flags included); `starts`: whose data begin with one of these."""

    def proof(heard: Heard) -> Seen:
        found = heard.count(can_id, *starts)
        kind = f" {starts[0].hex()}" if len(starts) == 1 else " of the kind" if starts else ""
        return Seen(found >= least, f"{found} x {can_id:03X}h{kind}")

    return proof


def of_length(least: int, can_id: int, length: int) -> Proof:
    """So many frames of this length."""

    def proof(heard: Heard) -> Seen:
        found = int(np.count_nonzero(heard.lengths[heard.at(can_id)] == length))
        return Seen(found >= least, f"{found} x {can_id:03X}h of {length} bytes")

    return proof


def withheld(least: int, *ids: int) -> Proof:
    """So many cycles in which this did not come within the deadline, for each identifier."""

    def proof(heard: Heard) -> Seen:
        found = min(heard.without(each) for each in ids)
        return Seen(
            found >= least, f"{found} cycles without {' '.join(f'{each:03X}h' for each in ids)} in time"
        )

    return proof


def later(least: int, can_id: int, delay_us: float) -> Proof:
    """So many frames that came later than this after SYNC."""

    def proof(heard: Heard) -> Seen:
        found = int(np.count_nonzero(heard.delays_ns(can_id) >= delay_us * 1000))
        return Seen(found >= least, f"{found} x {can_id:03X}h later than {delay_us:g} us")

    return proof


def after(least: int, can_id: int, other: int) -> Proof:
    """So many cycles in which this frame came after the other one."""

    def proof(heard: Heard) -> Seen:
        one, two = (np.searchsorted(heard.syncs, heard.at(each)) for each in (can_id, other))
        cycles = np.intersect1d(one, two)
        first, second = (
            heard.at(each)[np.searchsorted(of, cycles)] for each, of in ((can_id, one), (other, two))
        )
        found = int(np.count_nonzero(first > second))
        return Seen(found >= least, f"{found} cycles with {can_id:03X}h after {other:03X}h")

    return proof


def doubled(least: int, can_id: int) -> Proof:
    """So many cycles with two of these frames."""

    def proof(heard: Heard) -> Seen:
        _, counts = np.unique(np.searchsorted(heard.syncs, heard.at(can_id)), return_counts=True)
        found = int(np.count_nonzero(counts > 1))
        return Seen(found >= least, f"{found} cycles with two {can_id:03X}h")

    return proof


def silent(least_s: float, *ids: int) -> Proof:
    """None of these for so long, within what was heard."""

    def proof(heard: Heard) -> Seen:
        ends = [0, len(heard.ids) - 1] if len(heard.ids) else []
        at = np.unique([*heard.at(*ids), *ends]).astype(int)
        longest_s = float(np.diff(heard.stamps_ns[at]).max(initial=0)) * 1e-9
        return Seen(
            longest_s >= least_s, f"no {' '.join(f'{each:03X}h' for each in ids)} for {longest_s:.2f} s"
        )

    return proof


def counter_jumps(least: int) -> Proof:
    """So many SYNCs whose counter does not follow on the one before."""

    def proof(heard: Heard) -> Seen:
        counters = heard.data[heard.syncs, 0].astype(int)
        found = int(np.count_nonzero((counters[1:] - counters[:-1]) % 240 != 1))
        return Seen(found >= least, f"{found} jumps of the SYNC counter")

    return proof


def clock_stepped(seconds: float) -> Proof:
    """The kernel's stamps jumped by at least this."""

    def proof(heard: Heard) -> Seen:
        found = float(np.abs(np.diff(heard.stamps_ns)).max(initial=0)) * 1e-9
        return Seen(found >= seconds, f"stamps jumped by {found:.0f} s")

    return proof


def statuswords(least: int, node: int, mask: int, value: int) -> Proof:
    """So many statuswords (6041h in TPDO2) of the node with these bits."""

    def proof(heard: Heard) -> Seen:
        words = np.ascontiguousarray(heard.data[heard.at(0x280 + node)][:, 6:8]).view("<u2")
        found = int(np.count_nonzero(words & mask == value))
        return Seen(found >= least, f"{found} statuswords {value:02X}h of node {node}")

    return proof


def sensor_status(least: int, bits: int) -> Proof:
    """So many PDOs of the torque sensor with all of these bits of 6150h."""

    def proof(heard: Heard) -> Seen:
        found = int(np.count_nonzero(heard.data[heard.at(0x183), 4] & bits == bits))
        return Seen(found >= least, f"{found} x 183h with {bits:02X}h in 6150h")

    return proof


def position_jump(counts: int) -> Proof:
    """The motor position of node 1 jumped by at least this."""

    def proof(heard: Heard) -> Seen:
        found = int(np.abs(np.diff(heard.positions(1)[:, 0])).max(initial=0))
        return Seen(found >= counts, f"motor position jumped by {found} counts")

    return proof


def stuck(least: int, column: int) -> Proof:
    """Node 1's motor (0) or link (1) position kept its value so many times in a row while its drive said that it turns."""

    def proof(heard: Heard) -> Seen:
        column_of = heard.positions(1)[:, column]
        changes = np.flatnonzero(np.diff(column_of))
        longest = int(np.diff(np.concatenate([[-1], changes, [len(column_of) - 1]])).max(initial=0))
        turning = bool(np.any(heard.velocities(1) != 0))
        what = ("motor", "link")[column]
        return Seen(longest >= least and turning, f"{what} position the same in {longest} frames in a row")

    return proof


def velocity_against_position(least: int) -> Proof:
    """So many cycles in which node 1's motor velocity has the other sign than the change of its position."""

    def proof(heard: Heard) -> Seen:
        steps, velocities = np.diff(heard.positions(1)[:, 0]), heard.velocities(1)[1:]
        count = min(len(steps), len(velocities))
        found = int(np.count_nonzero(steps[:count] * velocities[:count] < 0))
        return Seen(found >= least, f"{found} velocities against the position")

    return proof


def two_answers(can_id: int, index: int, subindex: int) -> Proof:
    """SDO answers on this object held two different values."""
    multiplexer = index.to_bytes(2, "little") + bytes([subindex])

    def proof(heard: Heard) -> Seen:
        data = [heard.bytes(n) for n in heard.at(can_id)]
        answers = {each for each in data if each[:1] and each[0] & 0xE0 == 0x40 and each[1:4] == multiplexer}
        return Seen(len(answers) > 1, f"{len(answers)} values of {index:04X}h:{subindex} read")

    return proof
