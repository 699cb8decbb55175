"""Nodes that restart or stop in service: configured again before their data is used, one after the other."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from daemon.boot_request import boot_request
from daemon.children import Child
from daemon.config import Config
from daemon.snapshot import View

_RETRY_S = 0.5
_NOT_OPERATIONAL = (4, 127)
"""Heartbeat states stopped and pre-operational (CiA 301)."""


class ReturningNodes:
    """Boots nodes that the loop reports as restarted, each in a process of its own beside the running loop.

    A node that comes back with another scaling than at the start stays out: the loop's factors are those of the start.

    Args:
        config, bus: as for the first boot.
        report: report of the first boot.
        start_child: makes a child process from (module, arguments, name).
    """

    def __init__(
        self,
        config: Config,
        bus: str,
        report: dict[str, Any],
        start_child: Callable[[str, list[str], str], Child],
    ) -> None:
        self._config, self._bus, self._report = config, bus, report
        self._start_child = start_child
        self._child: Child | None = None
        self._node = 0
        self._not_before = 0.0

    def watch(self, view: View, note_configured: Callable[[int], None]) -> None:
        """Call often; `note_configured` tells the loop that a node may be believed again.

        A node that says by heartbeat that it is stopped or pre-operational is booted too: drives go there by themselves
        when they miss the master's heartbeat (1029h), for instance while the bus was down.
        """
        if self._child is not None:
            running = self._child.alive()  # asked first: what it said before its end is then there to be read
            answer = self._child.poll_answer()
            if answer is None and running:
                return
            self._child = None
            self._not_before = time.monotonic() + _RETRY_S
            if self._accepted(answer):
                note_configured(self._node)
            return
        idle = [
            int(node) for node in self._report["nodes"] if view.node_states[int(node)] in _NOT_OPERATIONAL
        ]
        waiting = [*view.unconfigured, *idle]
        if waiting and time.monotonic() >= self._not_before:
            self._node = waiting[0]
            self._child = self._start_child("drivers.boot", [], f"the boot of node {self._node}")
            self._child.tell(boot_request(self._config, self._bus, only=self._node))
            self._child.end_of_input()

    def _accepted(self, answer: dict[str, Any] | None) -> bool:
        if answer is None or not answer["ok"]:
            reason = "its boot ended without a word" if answer is None else answer["error"]["message"]
            print(f"jtqd: node {self._node} restarted: {reason}", file=sys.stderr)
            return False
        now, then = (report["nodes"][str(self._node)] for report in (answer, self._report))
        for key in ("scaling", "gear_ratio"):
            if now[key] != then[key]:
                print(
                    f"jtqd: node {self._node} restarted with another {key}: expected {then[key]}, found {now[key]}",
                    file=sys.stderr,
                )
                return False
        print(f"jtqd: node {self._node} was away and is configured again", file=sys.stderr)
        return True
