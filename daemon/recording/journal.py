"""Events of a recording: each occurrence once as a message on /events and once on /log, some also for the operator."""

from __future__ import annotations

from collections.abc import Callable

from jtqd.daemon.recording import schemas
from jtqd.daemon.recording.mcap_file import ChunkBuilder
from jtqd.daemon.recording.messages import event, log

_PER_SPAN = 50
"""A status that flaps every cycle must not fill the disk; what is left out is counted."""
_BOUNDED = (schemas.STATUS_CHANGED, schemas.SLOTS_MISSED, schemas.NOTICE)
INFO, WARN, ERROR = 20, 30, 40


class Journal:
    """Adds events to the span that is being collected.

    Args:
        builder: of the spans.
        warn: called with one line for the operator.

    Attributes:
        newest: index and CLOCK_REALTIME of the newest cycle.
        left_out: events for which there was no room.
    """

    def __init__(self, builder: ChunkBuilder, warn: Callable[[str], None]) -> None:
        self.builder = builder
        self.warn = warn
        self.newest = (0, 0)
        self.left_out = 0
        self._in_span = 0

    def new_span(self) -> None:
        """Reset the number of events for a new span."""
        self._in_span = 0

    def note(
        self,
        kind: int,
        text: str,
        *,
        level: int,
        time_ns: int | None = None,
        count: int = 0,
        joint: int = 0,
        change: tuple[int, int] = (0, 0),
    ) -> None:
        """Write an event, and its text to /log; the time is the newest cycle's unless one is given."""
        self._in_span += 1
        if self._in_span > _PER_SPAN and kind in _BOUNDED:
            self.left_out += 1
            return
        index, newest = self.newest
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        self.builder.add(schemas.EVENTS.number, when, payload)
        self.builder.add(schemas.LOG.number, when, log(when, level, text))

    def report(self, kind: int, text: str, *, level: int, count: int = 0) -> None:
        """Note an event and report its text to the operator."""
        self.warn(text)
        self.note(kind, text, level=level, count=count)
