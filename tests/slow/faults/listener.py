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
        return self._socket.rx_dropped

    def run(self) -> None:
        with suppress(PermissionError):  # of this thread: it must not wait for other programs
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
        while not self._ended:
            time.sleep(_EVERY_S)
            self.listen()

    def listen(self) -> None:
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
    frames = np.concatenate([np.empty(0, FRAME), *(each.frames for each in parts)])
    stamps_ns = np.concatenate([np.empty(0, np.int64), *(each.stamps_ns for each in parts)])
    return Heard(frames, stamps_ns, parts[0].sync_length if parts else 1)


@dataclass(frozen=True)
class Seen:
    """What was seen, in words, and whether it proves the fault."""

    ok: bool
    text: str


Proof = Callable[[Heard], Seen]


def at_least(least: float, count: Callable[[Heard], float], text: str) -> Proof:
    """So many, or so much; text: with a place for what was found."""

    def proof(heard: Heard) -> Seen:
        found = count(heard)
        return Seen(found >= least, text.format(found))

    return proof


def all_of(*proofs: Proof) -> Proof:
    def proof(heard: Heard) -> Seen:
        seen = [each(heard) for each in proofs]
        return Seen(all(each.ok for each in seen), ", ".join(each.text for each in seen))

    return proof


def _names(ids: tuple[int, ...]) -> str:
    return " ".join(f"{each:03X}h" for each in ids)


def frames(least: int, can_id: int, *starts: bytes) -> Proof:
    """So many frames with this identifier (flags included); `starts`: whose data begin with one of these."""
    kind = f" {starts[0].hex()}" if len(starts) == 1 else " of the kind" if starts else ""
    return at_least(least, lambda heard: heard.count(can_id, *starts), f"{{}} x {can_id:03X}h{kind}")


def of_length(least: int, can_id: int, length: int) -> Proof:
    return at_least(
        least,
        lambda heard: np.count_nonzero(heard.lengths[heard.at(can_id)] == length),
        f"{{}} x {can_id:03X}h of {length} bytes",
    )


def withheld(least: int, *ids: int) -> Proof:
    """So many cycles in which this did not come within the deadline, for each identifier."""
    text = f"{{}} cycles without {_names(ids)} in time"
    return at_least(least, lambda heard: min(heard.without(each) for each in ids), text)


def later(least: int, can_id: int, delay_us: float) -> Proof:
    return at_least(
        least,
        lambda heard: np.count_nonzero(heard.delays_ns(can_id) >= delay_us * 1000),
        f"{{}} x {can_id:03X}h later than {delay_us:g} us",
    )


def after(least: int, can_id: int, other: int) -> Proof:
    """So many cycles in which this frame came after the other one."""

    def count(heard: Heard) -> int:
        one, two = (np.searchsorted(heard.syncs, heard.at(each)) for each in (can_id, other))
        cycles = np.intersect1d(one, two)
        first = heard.at(can_id)[np.searchsorted(one, cycles)]
        second = heard.at(other)[np.searchsorted(two, cycles)]
        return np.count_nonzero(first > second)

    return at_least(least, count, f"{{}} cycles with {can_id:03X}h after {other:03X}h")


def doubled(least: int, can_id: int) -> Proof:
    def count(heard: Heard) -> int:
        _, counts = np.unique(np.searchsorted(heard.syncs, heard.at(can_id)), return_counts=True)
        return np.count_nonzero(counts > 1)

    return at_least(least, count, f"{{}} cycles with two {can_id:03X}h")


def silent(least_s: float, *ids: int) -> Proof:
    """None of these for so long, within what was heard."""

    def longest_s(heard: Heard) -> float:
        ends = [0, len(heard.ids) - 1] if len(heard.ids) else []
        at = np.unique([*heard.at(*ids), *ends]).astype(int)
        return float(np.diff(heard.stamps_ns[at]).max(initial=0)) * 1e-9

    return at_least(least_s, longest_s, f"no {_names(ids)} for {{:.2f}} s")


def counter_jumps(least: int) -> Proof:
    """So many SYNCs whose counter does not follow on the one before."""

    def count(heard: Heard) -> int:
        counters = heard.data[heard.syncs, 0].astype(int)
        return np.count_nonzero((counters[1:] - counters[:-1]) % 240 != 1)

    return at_least(least, count, "{} jumps of the SYNC counter")


def clock_stepped(seconds: float) -> Proof:
    return at_least(
        seconds,
        lambda heard: float(np.abs(np.diff(heard.stamps_ns)).max(initial=0)) * 1e-9,
        "stamps jumped by {:.0f} s",
    )


def statuswords(least: int, node: int, mask: int, value: int) -> Proof:
    """So many statuswords (6041h in TPDO2) of the node with these bits."""

    def count(heard: Heard) -> int:
        words = np.ascontiguousarray(heard.data[heard.at(0x280 + node)][:, 6:8]).view("<u2")
        return np.count_nonzero(words & mask == value)

    return at_least(least, count, f"{{}} statuswords {value:02X}h of node {node}")


def sensor_status(least: int, bits: int) -> Proof:
    """So many PDOs of the torque sensor with all of these bits of 6150h."""
    return at_least(
        least,
        lambda heard: np.count_nonzero(heard.data[heard.at(0x183), 4] & bits == bits),
        f"{{}} x 183h with {bits:02X}h in 6150h",
    )


def position_jump(counts: int) -> Proof:
    """The motor position of node 1 jumped by at least this."""
    return at_least(
        counts,
        lambda heard: int(np.abs(np.diff(heard.positions(1)[:, 0])).max(initial=0)),
        "motor position jumped by {} counts",
    )


def stuck(least: int, column: int) -> Proof:
    """Node 1's motor (0) or link (1) position kept its value so many times in a row while its drive reported motion."""

    def longest(heard: Heard) -> int:
        values = heard.positions(1)[:, column]
        ends = np.concatenate([[-1], np.flatnonzero(np.diff(values)), [len(values) - 1]])
        turning = bool(np.any(heard.velocities(1) != 0))
        return int(np.diff(ends).max(initial=0)) if turning else 0

    what = ("motor", "link")[column]
    return at_least(least, longest, f"{what} position the same in {{}} frames in a row, turning")


def velocity_against_position(least: int) -> Proof:
    """So many cycles in which node 1's motor velocity has the other sign than the change of its position."""

    def count(heard: Heard) -> int:
        steps, velocities = np.diff(heard.positions(1)[:, 0]), heard.velocities(1)[1:]
        size = min(len(steps), len(velocities))
        return np.count_nonzero(steps[:size] * velocities[:size] < 0)

    return at_least(least, count, "{} velocities against the position")


def two_answers(can_id: int, index: int, subindex: int) -> Proof:
    """SDO answers on this object held two different values."""
    multiplexer = index.to_bytes(2, "little") + bytes([subindex])

    def count(heard: Heard) -> int:
        data = {heard.bytes(n) for n in heard.at(can_id)}
        return sum(each[:1] != b"" and each[0] & 0xE0 == 0x40 and each[1:4] == multiplexer for each in data)

    return at_least(2, count, f"{{}} values of {index:04X}h:{subindex} read")
