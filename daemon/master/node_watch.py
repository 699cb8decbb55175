"""Heartbeat consumers of all nodes (CiA 301, 7.2.8.3.2.2), with the boot timeout that the standard lacks. Pure.

A node is watched from the moment it is configured. One that is not heard within the timeout from then on is reported as well
as one that was heard and is not any more: a consumer that waits for the first heartbeat would never miss it. What is not
one byte, or says a state that does not exist, is counted and does not count as a heartbeat. Two producers with one node-ID
show by a rate of nearly twice what was configured.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf
from typing import NamedTuple

from daemon.supervisor.rate_limit import RateLimit

NOT_WATCHED, WAITING, ACTIVE, LOST = 0, 1, 2, 3
"""States of a watch, as in CANopenNode: unconfigured, unknown, active, timeout."""
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
_WINDOW = 20
"""Heartbeats over which the rate is taken."""
_TWICE = 0.65
"""Share of the regular time in which a window may pass before there are two producers: with two it is a half."""
_LATE = 5.0
"""Heartbeats after which a reader was away for too long: what has queued up meanwhile says nothing about the rate."""
_OTHERS = 16
"""Foreign nodes that are told."""


class NodeEvent(NamedTuple):
    """Something to tell. `kind`: lost, never, back, restarted, state, doubled, malformed, foreign; `line` may be None."""

    kind: str
    node: int
    line: str | None


class _Watch:
    def __init__(self, limit: RateLimit) -> None:
        self.state = NOT_WATCHED
        self.heard_s = -inf
        self.since_s = 0.0
        self.lost_s = 0.0
        self.said: int | None = None
        self.window: list[float] = []
        self.doubled = False
        self.limit = limit


class NodeWatch:
    """Watches the heartbeats of the nodes of the configuration.

    Args:
        nodes: their node-IDs.
        known: other node-IDs that may be heard without a word (jtqd's own, the commander's).
        heartbeat_s: what was written to 1017h.
        timeout_s: silence after which a node is lost; also how long it may take for its first heartbeat.

    Attributes:
        lost_count: how often nodes were lost.
        malformed: heartbeats with a wrong length or an impossible state.
    """

    def __init__(
        self, nodes: tuple[int, ...], known: tuple[int, ...], heartbeat_s: float, timeout_s: float
    ) -> None:
        self._watches = {node: _Watch(RateLimit()) for node in nodes}
        self._known = set(known)
        self._heartbeat_s, self._timeout_s = heartbeat_s, timeout_s
        self._ticked_s = inf
        self.lost_count = self.malformed = 0

    def watch(self, node: int, now_s: float) -> None:
        """The node has been configured and started."""
        watch = self._watches[node]
        if watch.state == NOT_WATCHED:
            watch.state = WAITING
        watch.since_s = now_s
        watch.window.clear()

    def state(self, node: int) -> int:
        """NOT_WATCHED, WAITING, ACTIVE or LOST."""
        return self._watches[node].state

    def states(self) -> dict[int, int]:
        """The same of all nodes."""
        return {node: watch.state for node, watch in self._watches.items()}

    def heard_within(self, node: int, span_s: float, now_s: float) -> bool:
        """A heartbeat or boot-up message came in the last `span_s` seconds."""
        return now_s - self._watches[node].heard_s <= span_s

    def receive(self, node: int, data: bytes, now_s: float) -> list[NodeEvent]:
        """A frame 700h + node; what it changes."""
        watch = self._watches.get(node)
        if watch is None:
            return self._foreign(node, data)
        if len(data) != 1 or data[0] not in _STATES:
            self.malformed += 1
            found = f"{len(data)} bytes" if len(data) != 1 else f"state {data[0]:02X}h"
            return [
                self._event("malformed", node, watch, now_s, lambda: f"a heartbeat that is none ({found})")
            ]
        events = []
        watch.heard_s = now_s
        if data[0] == 0:
            watch.window.clear()
            events.append(
                self._event("restarted", node, watch, now_s, lambda: "it has restarted (boot-up message)")
            )
        elif watch.state == LOST:
            away = now_s - watch.lost_s
            events.append(
                self._event("back", node, watch, now_s, lambda: f"heartbeat is back after {away:.1f} s")
            )
        if watch.state in (WAITING, LOST):
            watch.state = ACTIVE
        if data[0] and watch.said is not None and data[0] != watch.said:
            said = _STATES[data[0]]
            events.append(self._event("state", node, watch, now_s, lambda: f"it is {said} now"))
        watch.said = data[0] or None
        if data[0]:
            events += self._rate(node, watch, now_s)
        return events

    def tick(self, now_s: float) -> list[NodeEvent]:
        """Call after all frames that have arrived were given: a reader that was late must not miss what was there."""
        self._ticked_s = now_s
        events = []
        for node, watch in self._watches.items():
            if (
                watch.state not in (WAITING, ACTIVE)
                or now_s - max(watch.heard_s, watch.since_s) <= self._timeout_s
            ):
                continue
            never = watch.state == WAITING
            watch.state, watch.lost_s = LOST, max(watch.heard_s, watch.since_s)
            watch.window.clear()
            self.lost_count += 1
            what = "no heartbeat at all" if never else "no heartbeat"
            text = f"{what} for {self._timeout_s:g} s"
            events.append(self._event("never" if never else "lost", node, watch, now_s, partial(str, text)))
        return events

    def _rate(self, node: int, watch: _Watch, now_s: float) -> list[NodeEvent]:
        if now_s - self._ticked_s > _LATE * self._heartbeat_s:
            watch.window.clear()
            return []
        watch.window.append(now_s)
        if len(watch.window) <= _WINDOW:
            return []
        passed = watch.window[-1] - watch.window[0]
        watch.window = [now_s]
        doubled = passed < _TWICE * _WINDOW * self._heartbeat_s
        if doubled == watch.doubled:
            return []
        watch.doubled = doubled
        if not doubled:
            return [NodeEvent("single", node, None)]
        text = f"{_WINDOW} heartbeats in {passed:.1f} s: are there two nodes with this node-ID?"
        return [self._event("doubled", node, watch, now_s, lambda: text)]

    def _foreign(self, node: int, data: bytes) -> list[NodeEvent]:
        """CiA 302-2, status A: not in the network list. Said once."""
        if node in self._known or len(self._known) > _OTHERS or len(data) != 1:
            return []
        self._known.add(node)
        line = f"node {node}: it is on the bus and not in the configuration (status A)"
        return [NodeEvent("foreign", node, line)]

    @staticmethod
    def _event(kind: str, node: int, watch: _Watch, now_s: float, text: Callable[[], str]) -> NodeEvent:
        unsaid = watch.limit.may_say(kind, now_s)
        if unsaid is None:
            return NodeEvent(kind, node, None)
        return NodeEvent(
            kind, node, f"node {node}: {text()}" + (f" ({unsaid} more before)" if unsaid else "")
        )
