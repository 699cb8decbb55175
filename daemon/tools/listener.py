"""The shell of `jtq check`: takes frames from a bus on an absolute time grid, and sends SYNC and heartbeat when it may."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from daemon.config import Config
from daemon.loop.grid import Grid
from daemon.tools.tally import Tally
from daemon.tools.traffic import SYNC, Traffic
from drivers.errors import BusDown
from drivers.frame import CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, FRAME_SIZE, pack
from drivers.frame_socket import FrameSocket

_OPERATIONAL = b"\x05"
_NMT_PRE_OPERATIONAL = 0x80


@dataclass
class Timing:
    """How punctual this process was woken, and how long a SYNC took from the call to its echo."""

    lateness: Tally = field(default_factory=Tally)
    missed: int = 0
    echo: Tally = field(default_factory=Tally)
    unsent: int = 0
    """SYNCs that a full queue, or a bus that is down, refused."""


def listen(
    socket: FrameSocket, traffic: Traffic, seconds: float, period_ns: int, *, timed: bool
) -> Timing | None:
    """Hear everything for `seconds`. Raises BusError.

    Args:
        socket: without filters.
        traffic: counts the frames.
        seconds: how long.
        period_ns: time grid of the wake-ups.
        timed: measure the wake-ups. Beside a daemon this is left out: its own loop is what counts, and a
            tenth as many wake-ups do.
    """
    timing = Timing()
    for _ in _slots(seconds, period_ns if timed else 10 * period_ns, timing):
        _take(socket, traffic)
    traffic.end(time.time_ns())
    return timing if timed else None


def drive(socket: FrameSocket, traffic: Traffic, seconds: float, config: Config) -> Timing:
    """Send SYNC and the own heartbeat for `seconds` and hear the answers; the nodes have been booted. Raises BusError.

    The socket must give back own frames, so that SYNC's own echo stands among the answers in the order of arrival.
    """
    timing = Timing()
    syncs = [pack(SYNC, bytes((n,))) for n in range(config.counter_overflow + 1)]
    heartbeat = pack(0x700 + config.node_id, _OPERATIONAL)
    every = max(1, config.heartbeat_ms * 1_000_000 // config.period_ns)
    counter, sent_ns = 0, 0
    for slot in _slots(seconds, config.period_ns, timing):
        _take(socket, traffic, timing.echo, sent_ns)
        counter = counter % config.counter_overflow + 1
        sent_ns = time.time_ns()
        timing.unsent += not _send(socket, syncs[counter])
        if slot % every == 0:
            _send(socket, heartbeat)
    time.sleep(config.period_ns * 1e-9)
    _take(socket, traffic, timing.echo, sent_ns)
    traffic.end(time.time_ns())
    return timing


def leave(socket: FrameSocket, config: Config) -> None:
    """Put the nodes back to pre-operational, as jtqd does at its end. Raises BusError."""
    nodes = [joint.node_id for joint in config.joints]
    nodes += [config.sensor.node_id] if config.sensor else []
    for node in nodes:
        socket.send(pack(0x000, bytes((_NMT_PRE_OPERATIONAL, node))))


def silent(socket: FrameSocket, seconds: float) -> bool:
    """True when nobody sends SYNC for so long. Raises BusError."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if not socket.wait(left):
            return True
        for n in range(socket.receive()):
            if int.from_bytes(socket.frames[FRAME_SIZE * n : FRAME_SIZE * n + 4], "little") == SYNC:
                return False
    return True


class _slots:  # noqa: N801 - a generator with a name of its own
    """Slots of an absolute grid, each when its time has come; those that are too late are counted and skipped."""

    def __init__(self, seconds: float, period_ns: int, timing: Timing) -> None:
        start_ns = time.monotonic_ns() + period_ns
        self._grid, self._end_ns = Grid(start_ns, period_ns), start_ns + round(seconds * 1e9)
        self._timing = timing
        self._number = -1

    def __iter__(self) -> _slots:
        return self

    def __next__(self) -> int:
        grid = self._grid
        if self._number >= 0:
            grid.advance(time.monotonic_ns())
        self._number += 1
        while grid.slot_ns < self._end_ns:
            pause_ns = grid.slot_ns - time.monotonic_ns()
            if pause_ns > 0:
                time.sleep(pause_ns * 1e-9)
            now_ns = time.monotonic_ns()
            self._timing.lateness.add(now_ns - grid.slot_ns)
            if not grid.too_late(now_ns):
                return self._number
            grid.missed += (
                1  # as the loop does: a SYNC that late would leave its successor less than half a cycle
            )
            grid.advance(now_ns)
        self._timing.missed = grid.missed
        raise StopIteration


def _send(socket: FrameSocket, frame: bytes) -> bool:
    try:
        return socket.send(frame)
    except BusDown:
        return False


def _take(socket: FrameSocket, traffic: Traffic, echo: Tally | None = None, sent_ns: int = 0) -> None:
    """Everything that has arrived."""
    while True:
        try:
            count = socket.receive()
        except BusDown:
            return
        if not count:
            return
        unpack, frames, stamps, own = FRAME.unpack_from, socket.frames, socket.stamps_ns, socket.own
        for n in range(count):
            can_id, length, data = unpack(frames, FRAME_SIZE * n)
            if can_id & CAN_RTR_FLAG and not can_id & CAN_ERR_FLAG:
                data = b""
            if echo is not None and own[n] and can_id == SYNC:
                echo.add(stamps[n] - sent_ns)
            traffic.feed(can_id, data[:length], stamps[n])
