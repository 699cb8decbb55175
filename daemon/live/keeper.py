"""The supervisor's side of the live view: start its process, restart it when it dies, report where it listens."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jtqd.daemon.config import Config
from jtqd.daemon.live.address import Address
from jtqd.daemon.recording.keeper import nodes_of
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.daemon.shared.notices import FILE as NOTICES

_STARTS = 5
"""A live view that dies more often than this in a minute is not started again."""
_PAUSE_S = 1.0


class LiveKeeper:
    """Live view of one run of jtqd; its failures do not affect the loop.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        address: where it listens.
    """

    def __init__(self, start_child: Callable[[str, list[str], str], Child], address: Address) -> None:
        self._start_child = start_child
        self._address = address
        self._request: dict[str, Any] = {}
        self._child: Child | None = None
        self._starts: list[float] = []

    def start(self, config: Config, directory: Path, bus: str) -> None:
        """Start the live view of the daemon's runtime directory.

        Args:
            config: in force.
            directory: holds `ring`, `snapshot` and `notices`.
            bus: name of the bus.
        """
        self._request = {
            "ring": str(directory / "ring"),
            "snapshot": str(directory / "snapshot"),
            "notices": str(directory / NOTICES),
            "host": self._address.host,
            "port": self._address.port,
            "bus": bus,
            "nodes": nodes_of(config),
            "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
        }
        if not self._address.loopback:
            _say(
                f"the live view accepts connections from every host that can reach {self._address.host}; it is read-only"
            )
        self._run()

    @property
    def pid(self) -> int | None:
        """Return the process-ID of the live view, or None."""
        return self._child.pid if self._child is not None and self._child.alive() else None

    def watch(self) -> None:
        """Report its output; restart it when it died, at most once a second and five times a minute."""
        if self._child is None:
            return
        ended = not self._child.alive()  # asked first: what it said before its end is then in the pipe
        try:
            answer = self._child.poll_answer() or {}
        except (ChildError, ValueError) as error:
            answer = {"failed": str(error)}
        if "listening" in answer:
            _say(f"live view: {answer['listening']}")
        if "failed" in answer:
            _say(f"no live view: {answer['failed']}; the loop continues")
            self._child = None
        elif ended and time.monotonic() - self._starts[-1] > _PAUSE_S:
            code = self._child.process.returncode
            if len(self._starts) > _STARTS:
                _say(f"the live view ended with exit status {code}, too often; the loop continues without it")
                self._child = None
                return
            _say(f"the live view ended with exit status {code}; restarted, the loop continues")
            self._run()

    def _run(self) -> None:
        now = time.monotonic()
        self._starts = [*(start for start in self._starts if now - start < 60.0), now]
        self._child = self._start_child(
            "jtqd.daemon.live.process", [json.dumps(self._request)], "the live view"
        )


def _say(text: str) -> None:
    print(f"jtqd: {text}", file=sys.stderr, flush=True)
