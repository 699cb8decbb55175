"""The successor of a running loop: built and warmed up beside it with new files, it takes over between two cycles.

build        estimators from the new files; whatever is wrong with them ends here, and the running loop never hears of it
shadow       step them through the ring of cycles, at a priority below the running loop's
stand by     `answer(standing_by=...)`; the supervisor then tells the running loop to hand over (SIGUSR2)
take over    see `daemon/reload/handover.py`; the cycle that follows is ours

Started by the supervisor as `python -m jtqd.daemon.reload.successor` with the request of the loop as its only argument, and
`handover` in it: the socket of the running loop.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.estimate_pdo import PUBLISHED_STATUSES
from jtqd.daemon.loop import realtime
from jtqd.daemon.loop.process import (
    Stop,
    answer,
    build_cycle,
    build_estimators,
    finish,
    loop_filters,
    main,
    make_duties,
    read_line,
    run,
)
from jtqd.daemon.reload.handover import Refused, Taker
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_NETWORK_SKIPPED, FLAG_POSITION
from jtqd.daemon.shared.ring import RingError, RingReader
from jtqd.daemon.shared.snapshot import SnapshotError
from jtqd.drivers.frame_socket import BusDown, open_frame_socket
from jtqd.estimator.methods import AnyEstimator
from jtqd.estimator.status import INVALID

_INPUTS = FLAG_POSITION | FLAG_MOTION
_SETTLED_S = 0.5
"""After the first cycle seen: from here on the two estimates are compared."""
_INVALID_SHARE = 0.5


class _Joint:
    """One joint's new estimator and how far it is from the running one."""

    def __init__(self, estimator: AnyEstimator) -> None:
        self.estimator = estimator
        self.seen_s = 0.0
        self.compared = self.published = self.invalid = 0
        self.square = self.largest = 0.0

    def step(self, record: cr.JointRecord) -> None:
        if record.input_flags & _INPUTS != _INPUTS:
            return  # the running loop has not stepped either
        given = (
            record.dt_s,
            record.current_a,
            record.motor_position_rad,
            record.motor_velocity_rad_s,
            record.link_position_rad,
            record.temperature_c,
        )
        found = self.estimator.step(*given, not record.input_flags & FLAG_NETWORK_SKIPPED)
        self.seen_s += record.dt_s
        if self.seen_s < _SETTLED_S or record.status not in PUBLISHED_STATUSES:
            return
        self.published += 1
        self.invalid += found.status == INVALID
        change = found.torque_nm - record.torque_nm
        if isfinite(change):
            self.compared += 1
            self.square += change * change
            self.largest = max(self.largest, abs(change))

    def content(self) -> dict[str, Any]:
        rms = (self.square / self.compared) ** 0.5 if self.compared else None
        return {
            "cycles": self.compared,
            "rms_change_nm": rms,
            "max_change_nm": self.largest if self.compared else None,
        }


class Shadow:
    """Steps the estimators of joint 1 and 2 through what the ring at `path` holds, from its oldest record on.

    Raises:
        jtqd.daemon.shared.ring.RingError: there is no such ring.
    """

    def __init__(self, path: Path, estimators: Sequence[AnyEstimator]) -> None:
        self._reader = RingReader(path, cr.layout_of(len(estimators)).size)
        self._joints = [_Joint(estimator) for estimator in estimators]
        self.cycles = 0

    def follow(self, limit: int = 64) -> int:
        """Step through at most `limit` records; returns how many are left."""
        batch = self._reader.read(limit)
        for record in batch.records:
            for number, joint in enumerate(self._joints, start=1):
                joint.step(cr.joint_of(record, number))
        self.cycles += len(batch.records)
        return self._reader.backlog

    def catch_up(self) -> None:
        """Step through all records."""
        while self.follow():
            pass

    def objection(self) -> str | None:
        """Return why these estimators must not take over: most estimates that are valid now would be invalid."""
        for number, joint in enumerate(self._joints, start=1):
            if joint.published and joint.invalid > _INVALID_SHARE * joint.published:
                return (
                    f"joint {number}: {joint.invalid} of {joint.published} estimates that are published now "
                    "would be invalid with the new files"
                )
        return None

    def changes(self) -> dict[str, dict[str, Any]]:
        """Return the RMS and the largest difference of the new estimates of each joint [Nm]."""
        return {f"joint_{number}": joint.content() for number, joint in enumerate(self._joints, start=1)}


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
        lambda: run(
            cycle,
            grid,
            lambda: stop.requested,
            giver.end_ns,
            after=duties,
            after_sync=catch_up,
            slots=duties.slots,
        ),
    )


class _Overheard:
    """Frames received while the other loop owned the bus; that loop has processed all but the last ones."""

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
        """Give the cycle the frames stamped from this time on (CLOCK_REALTIME), as frames between two cycles."""
        self.listen()
        late = [each for each in self._last if each[1] >= from_ns]
        if late:
            frames, stamps_ns, own = zip(*late, strict=True)
            self._cycle.between(bytearray(b"".join(frames)), stamps_ns, own, len(late))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], succeed))
