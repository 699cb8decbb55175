"""Kinds of fault: what is suppressed, changed, delayed or added while a case lasts."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.slow.faults.rig import Rig

Passed = Iterable[tuple[int, int, bytes]]
"""(delay in ns, identifier, data) of each frame that goes out instead of one."""
Act = Callable[["Rig"], object]


class Fault:
    """Between the nodes and the bus. This one changes nothing."""

    def begin(self, rig: Rig) -> None:
        """Its time begins: after an estimate, before the next SYNC."""

    def end(self, rig: Rig) -> None:
        """Its time is over."""

    def hears(self, can_id: int) -> bool:
        """Whether the nodes hear a frame of jtqd."""
        return True

    def each_cycle(self, rig: Rig) -> None:
        """After the nodes have answered a SYNC."""

    def passes(self, can_id: int, data: bytes) -> Passed:
        """What goes out for a frame that a node sends now."""
        return ((0, can_id, data),)


class Lost(Fault):
    """Frames with these identifiers do not reach the bus."""

    def __init__(self, *ids: int) -> None:
        self._ids = frozenset(ids)

    def passes(self, can_id: int, data: bytes) -> Passed:
        """Nothing for those."""
        return () if can_id in self._ids else ((0, can_id, data),)


class Deaf(Fault):
    """The nodes do not hear these identifiers."""

    def __init__(self, *ids: int) -> None:
        self._ids = frozenset(ids)

    def hears(self, can_id: int) -> bool:
        """Not those."""
        return can_id not in self._ids


class Cut(Fault):
    """Nothing gets through in either direction; error messages tell it when it begins and ends."""

    def __init__(self, begins: tuple[int, bytes], ends: tuple[int, bytes]) -> None:
        self._begins, self._ends = begins, ends

    def begin(self, rig: Rig) -> None:
        """The driver's first message."""
        rig.send(*self._begins)

    def end(self, rig: Rig) -> None:
        """Its last one."""
        rig.send(*self._ends)

    def hears(self, can_id: int) -> bool:
        """Nothing."""
        return False

    def passes(self, can_id: int, data: bytes) -> Passed:
        """Nothing."""
        return ()


class Late(Fault):
    """Frames with these identifiers (none named: all) come later."""

    def __init__(self, delay_us: float, *ids: int) -> None:
        self._delay_ns, self._ids = round(delay_us * 1000), frozenset(ids)

    def passes(self, can_id: int, data: bytes) -> Passed:
        """The same, later."""
        late = not self._ids or can_id in self._ids
        return ((self._delay_ns if late else 0, can_id, data),)


class Changed(Fault):
    """Frames with these identifiers are replaced by what `change` makes of them: a list of (identifier, data)."""

    def __init__(self, change: Callable[[int, bytes], list[tuple[int, bytes]]], *ids: int) -> None:
        self._change, self._ids = change, frozenset(ids)

    def passes(self, can_id: int, data: bytes) -> Passed:
        """What the change makes of it."""
        if can_id not in self._ids:
            return ((0, can_id, data),)
        return [(0, *each) for each in self._change(can_id, data)]


class Frozen(Fault):
    """Frames with these identifiers keep the data of their first one."""

    def __init__(self, *ids: int) -> None:
        self._ids = frozenset(ids)
        self._kept: dict[int, bytes] = {}

    def passes(self, can_id: int, data: bytes) -> Passed:
        """The first data again."""
        return ((0, can_id, self._kept.setdefault(can_id, data) if can_id in self._ids else data),)


class Added(Fault):
    """Something is done when it begins, in each cycle, and when it ends."""

    def __init__(self, each: Act | None = None, *, first: Act | None = None, last: Act | None = None) -> None:
        self._each, self._first, self._last = each, first, last

    def begin(self, rig: Rig) -> None:
        """The first thing."""
        if self._first is not None:
            self._first(rig)

    def each_cycle(self, rig: Rig) -> None:
        """The repeated thing."""
        if self._each is not None:
            self._each(rig)

    def end(self, rig: Rig) -> None:
        """The last thing."""
        if self._last is not None:
            self._last(rig)


class AndThen(Fault):
    """A filter with something that is done when it begins and ends."""

    def __init__(self, inner: Fault, *, first: Act | None = None, last: Act | None = None) -> None:
        self._inner, self._first, self._last = inner, first, last
        self.hears, self.passes, self.each_cycle = inner.hears, inner.passes, inner.each_cycle  # type: ignore[method-assign]

    def begin(self, rig: Rig) -> None:
        """The first thing."""
        if self._first is not None:
            self._first(rig)

    def end(self, rig: Rig) -> None:
        """The last thing."""
        if self._last is not None:
            self._last(rig)


class Stopped(Fault):
    """The loop process is stopped (SIGSTOP); `flood` is sent meanwhile."""

    def __init__(self, flood: Act | None = None) -> None:
        self._flood = flood

    def begin(self, rig: Rig) -> None:
        """SIGSTOP, and the flood."""
        os.kill(rig.loop_pid, signal.SIGSTOP)
        if self._flood is not None:
            self._flood(rig)

    def end(self, rig: Rig) -> None:
        """SIGCONT."""
        os.kill(rig.loop_pid, signal.SIGCONT)
