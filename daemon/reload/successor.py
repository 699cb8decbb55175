"""The successor of a running loop: built and warmed up beside it with new files, it takes over between two cycles.

build        estimators from the new files; whatever is wrong with them ends here, and the running loop never hears of it
shadow       step them through the ring of cycles (`daemon/reload/shadow.py`), at a priority below the running loop's
stand by     `answer(standing_by=...)`; the supervisor then tells the running loop to hand over (SIGUSR2)
take over    see `daemon/reload/handover.py`; the cycle that follows is ours
"""

from __future__ import annotations

import json
import os
import select
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

from daemon.loop import realtime
from daemon.loop.cycle import Cycle
from daemon.loop.process import (
    Stop,
    answer,
    build_cycle,
    build_estimators,
    finish,
    loop_filters,
    make_duties,
    read_line,
    run,
)
from daemon.reload.handover import Refused
from daemon.reload.shadow import Shadow
from daemon.reload.taker import Taker
from daemon.shared.ring import RingError
from daemon.shared.snapshot import SnapshotError
from drivers.errors import BusDown
from drivers.frame_socket import open_frame_socket

_KEPT_FRAMES = 64
_DOWN_READINGS = 3
_BELOW = 1
"""Priorities below the running loop's: on a CPU that both share, it comes first."""


def succeed(request: dict[str, Any]) -> int:
    """Take over from the running loop and be the loop. Returns the exit status; what is wrong goes to the supervisor."""
    try:
        return _succeed(request)
    except (Refused, RingError, SnapshotError) as error:
        answer(failed=str(error))
        return 1


def _succeed(request: dict[str, Any]) -> int:
    stop = Stop()
    config, estimators = build_estimators(request)
    shadow = Shadow(Path(request["ring"]), estimators)
    shadow.catch_up()
    objection = shadow.objection()
    if objection is not None:
        raise Refused(objection)
    answer(ready=True)
    line = read_line(stop)
    if line is None:
        return 0
    socket = open_frame_socket(request["bus"], loop_filters(config), receive_own=True)
    cycle, grid = build_cycle(config, request, json.loads(line), socket, estimators, attach=True)
    wanted = config.realtime
    refused = realtime.prepare(max(0, wanted.priority - _BELOW), wanted.cpu, wanted.lock_memory)
    duties, giver = make_duties(cycle, request)
    overheard = _Overheard(cycle)
    taker = Taker(cycle, Path(request["handover"]))
    realtime.freeze()
    shadow.catch_up()
    answer(standing_by=True, refused=refused, cycles=shadow.cycles, changes=shadow.changes())
    try:
        while not taker.step():
            if stop.requested:
                return 0
            shadow.follow()
            overheard.listen()
            select.select(taker.descriptors, [], [], config.period_ns * 1e-9)
        with suppress(OSError):
            if wanted.priority:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority))
        overheard.hand_in(taker.before_ns)
        cycle.snapshot.own()
        taker.taken()
    finally:
        taker.close()
    giver.end_ns = taker.end_ns
    cycle.skip(grid.advance(time.monotonic_ns()))
    first, missed = cycle.index, grid.missed

    def catch_up() -> None:
        shadow.catch_up()
        answer(took_over=first, missed_before=missed)

    return finish(
        cycle,
        lambda: run(cycle, grid, lambda: stop.requested, giver.end_ns, after=duties, after_sync=catch_up),
    )


class _Overheard:
    """Frames that came while the other loop had the bus; it has taken all but the last ones."""

    def __init__(self, cycle: Cycle) -> None:
        self._cycle = cycle
        self._last: deque[tuple[bytes, int, bool]] = deque(maxlen=_KEPT_FRAMES)

    def listen(self) -> None:
        """Empty the socket, so that it never overflows."""
        socket, down = self._cycle.socket, 0
        while down < _DOWN_READINGS:
            try:
                count = socket.receive()
            except BusDown:
                down += 1
                continue
            if not count:
                return
            for n in range(count):
                frame = bytes(socket.frames[16 * n : 16 * n + 16])
                self._last.append((frame, socket.stamps_ns[n], socket.own[n]))

    def hand_in(self, from_ns: int) -> None:
        """Give the cycle what is stamped from this time on (CLOCK_REALTIME), as frames between two cycles."""
        self.listen()
        late = [each for each in self._last if each[1] >= from_ns]
        if late:
            frames, stamps_ns, own = zip(*late, strict=True)
            self._cycle.between(bytearray(b"".join(frames)), stamps_ns, own, len(late))
