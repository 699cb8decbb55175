"""What the live view sends of the cycles: the log's messages, fewer of them. Pure.

One set of the cycle's messages per 20 ms; a change of status and a missed slot are seen in every cycle and sent
as events, so that nothing that lasts less than 20 ms stays unseen. Bytes as in the log (`daemon.recording.messages`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from daemon.recording import schemas
from daemon.recording.diagnostics import Diagnostics, Node
from daemon.recording.messages import (
    BLOCK_PARTS,
    JointStateMessage,
    cycle_block,
    diagnostics,
    event,
    log,
)
from daemon.shared import cycle_record as cycle
from daemon.shared.notices import Notice
from daemon.shared.snapshot import View

PERIOD_NS = 20_000_000
"""50 Hz."""
_RECORD_HEAD = 31
"""Bytes before the payload of an MCAP Message record, as `cycle_block` makes it."""
_INFO, _WARN = 20, 30
_QUIET_STATUSES = (1, 2, 6)
"""Starting, valid and standstill are what a healthy joint goes through."""

_SCAN = cycle.selection(
    ("cycle", "sync_monotonic_ns", "sync_realtime_ns", "flags", "missed", "sync_counter", "frame_count"),
    ("status",),
)


class Message(NamedTuple):
    """One message on its way to the viewers. `topic` is the channel number of `daemon.recording.schemas`."""

    topic: int
    time_ns: int
    payload: bytes


class LiveStream:
    """Thins out the cycles of one run.

    Args:
        bus: name of the bus, for /diagnostics.
        nodes: whose heartbeats /diagnostics shows.
        names: of joint 1 and 2.
        gear_ratios: motor revolutions per joint revolution; None where not known.
        period_ns: one set of messages in each such stretch of CLOCK_MONOTONIC [ns].
    """

    def __init__(
        self,
        bus: str,
        nodes: Sequence[Node],
        names: Sequence[str],
        gear_ratios: Sequence[float | None],
        period_ns: int = PERIOD_NS,
    ) -> None:
        self._diagnostics = Diagnostics(bus, names, nodes)
        self._overview = JointStateMessage(names, gear_ratios)
        self._period_ns = period_ns
        self._newest = (0, 0)
        self.forget()

    def forget(self) -> None:
        """Nobody has looked for a while: what was before must not show as a change."""
        self._slot = -1
        self._statuses: tuple[int, int] | None = None
        self._missed: int | None = None

    def take(self, records: Iterable[bytes]) -> list[Message]:
        """Messages that these cycle records give, in the order of time."""
        made: list[Message] = []
        for record in records:
            index, monotonic, realtime, flags, missed, counter, count, *statuses = _SCAN.unpack_from(record)
            realtime = max(realtime, 0)
            self._newest = (index, realtime)
            made += self._changes((statuses[0], statuses[1]), missed)
            slot = monotonic // self._period_ns
            if slot == self._slot:
                continue
            self._slot = slot
            frames = min(count, cycle.FRAME_CAPACITY)
            block = cycle_block(record, index, realtime, flags=flags, sync_counter=counter, frames=frames)
            starts = [start for _, start in BLOCK_PARTS]
            for (topic, start), end in zip(BLOCK_PARTS, [*starts[1:], len(block)], strict=True):
                made.append(Message(topic, realtime, block[start + _RECORD_HEAD : end]))
            overview = self._overview.payload(record, realtime)
            made.append(Message(schemas.JOINT_STATES.number, realtime, overview))
        return made

    def _changes(self, statuses: tuple[int, int], missed: int) -> list[Message]:
        made: list[Message] = []
        before, self._statuses = self._statuses, statuses
        for joint, (old, new) in enumerate(zip(before or statuses, statuses, strict=True), start=1):
            if old != new:
                names = [schemas.STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                text = f"joint {joint}: {names[0]} -> {names[1]}"
                level = _INFO if new in _QUIET_STATUSES else _WARN
                made += self.note(schemas.STATUS_CHANGED, text, level, joint=joint, change=(old, new))
        slots = missed - (missed if self._missed is None else self._missed)
        self._missed = missed
        if slots > 0:
            made += self.note(schemas.SLOTS_MISSED, f"the loop missed {slots} slots", _WARN, count=slots)
        return made

    def notices(self, news: Iterable[Notice]) -> list[Message]:
        """What the supervisor had to say."""
        made: list[Message] = []
        for notice in news:
            made += self.note(
                schemas.NOTICE, notice.text, notice.level, time_ns=notice.realtime_ns, count=notice.node
            )
        return made

    def note(
        self,
        kind: int,
        text: str,
        level: int,
        *,
        time_ns: int | None = None,
        count: int = 0,
        joint: int = 0,
        change: tuple[int, int] = (0, 0),
    ) -> list[Message]:
        """One occurrence as a message on /events and one on /log, at the time of the newest cycle unless one is given."""
        index, newest = self._newest
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        return [
            Message(schemas.EVENTS.number, when, payload),
            Message(schemas.LOG.number, when, log(when, level, text)),
        ]

    def diagnose(
        self, view: View, work_us: Sequence[float], late_us: Sequence[float], now_ns: int
    ) -> Message:
        """The once-per-second /diagnostics of loop, bus, joints and nodes; what the recorder does is in the log only.

        Args:
            view: of the loop's counters.
            work_us, late_us: p50, p99 and maximum of the work per cycle and of the SYNC's lateness [us].
            now_ns: CLOCK_REALTIME.
        """
        statuses = self._diagnostics.of_the_loop(view, work_us=work_us, late_us=late_us, now_ns=now_ns)
        return Message(schemas.DIAGNOSTICS.number, now_ns, diagnostics(now_ns, statuses))
