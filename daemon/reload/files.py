"""Joint files, networks and estimator settings anew, in a running daemon, without a late or missing cycle.

The supervisor checks the configuration, starts a successor of the loop (`daemon/reload/successor.py`), and when that stands
by, has the running loop hand over (`daemon/reload/handover.py`). Whatever is wrong until then is said, and nothing has
changed. What the bus, the nodes or the shared memory depend on needs a restart.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.estimator.checked import ConfigError

SOCKET = "handover"
"""Name of the successor's socket in the runtime directory."""
READY_S, HAND_OVER_S = 60.0, 30.0
_FREE = ("path", "text", "sha256", "estimator", "joints")
"""Of a configuration; of its joints, see `_FREE_OF_JOINT`."""
_FREE_OF_JOINT = ("joint_path", "joint", "joint_data", "network")


class ReloadError(Exception):
    """The old files remain in force; the message is one line with the reason."""


def needs_restart(old: Config, new: Config) -> list[str]:
    """Return the changed keys that need a restart."""
    keys = [
        field.name
        for field in fields(Config)
        if field.name not in _FREE and getattr(old, field.name) != getattr(new, field.name)
    ]
    fewer, more = sorted((len(old.joints), len(new.joints)))
    keys += [f"joint_{number}" for number in range(fewer + 1, more + 1)]
    for before, after in zip(old.joints, new.joints, strict=False):
        kept = {name: getattr(before, name) for name in _FREE_OF_JOINT}
        if replace(after, **kept) != before:
            names = [
                field.name
                for field in fields(before)
                if field.name not in _FREE_OF_JOINT
                and getattr(before, field.name) != getattr(after, field.name)
            ]
            keys += [f"joint_{before.number}.{name}" for name in names]
    return keys


class Reload:
    """One reload at a time; `poll` carries it on.

    Args:
        request: the running loop's, see `daemon/loop/process.py`.
        report: of the boot, with the scaling of the devices.
        start_child: makes a child process from (module, arguments, name).
        check: further checks of a configuration; raises ReloadError.
    """

    def __init__(
        self,
        request: dict[str, Any],
        report: dict[str, Any],
        start_child: Callable[[str, list[str], str], Child],
        check: Callable[[Config], None],
    ) -> None:
        self._request, self._report = request, report
        self._start_child, self._check = start_child, check
        self._child: Child | None = None
        self._config: Config | None = None
        self._stage = ""
        self._until_s = 0.0
        self._stands: dict[str, Any] = {}

    @property
    def running(self) -> bool:
        """Return whether a reload is running."""
        return self._child is not None

    def start(self, config: Config, path: Path | None) -> None:
        """Check the files and start the successor. Raises ReloadError."""
        if self._child is not None:
            raise ReloadError("another reload is under way")
        try:
            new = load_config(path)
            self._check(new)
        except ConfigError as error:
            raise ReloadError(str(error)) from None
        fixed = needs_restart(config, new)
        if fixed:
            raise ReloadError(f"{new.path}: changed: {', '.join(fixed)}: needs a restart")
        self._config = new
        request = self._request | {
            "config_sha256": new.files_sha256,
            "handover": str(Path(self._request["ring"]).with_name(SOCKET)),
        }
        self._child = self._start_child("jtqd.daemon.reload.successor", [json.dumps(request)], "the new loop")
        self._stage, self._until_s = "to be built", time.monotonic() + READY_S

    @property
    def outputs(self) -> list[int]:
        """Return the descriptors for select."""
        return self._child.outputs if self._child is not None else []

    def poll(self, loop: Child) -> tuple[Child, Config, dict[str, Any]] | None:
        """Continue the reload; return the new loop, its configuration and the change after the hand-over.

        Raises:
            ReloadError: nothing came of it, and `loop` goes on.
        """
        child = self._child
        if child is None:
            return None
        alive = child.alive()
        answer = child.poll_answer()
        if answer is None:
            if not alive:
                raise self._failed(f"the new loop ended with exit status {child.process.returncode}")
            if time.monotonic() > self._until_s:
                raise self._failed(f"the new loop took too long {self._stage}")
            return None
        if "failed" in answer:
            raise self._failed(str(answer["failed"]))
        if answer.get("ready"):
            child.tell(self._report)
        elif answer.get("standing_by"):
            self._stands = answer
            self._stage, self._until_s = "to take over", time.monotonic() + HAND_OVER_S
            loop.process.send_signal(signal.SIGUSR2)
        elif "took_over" in answer:
            assert self._config is not None
            self._child = None
            return child, self._config, self._stands | answer
        return None

    def refused(self, why: str) -> ReloadError:
        """Handle a refusal of the running loop."""
        return self._failed(why)

    def abandon(self) -> None:
        """Abandon the reload at the end of the daemon."""
        if self._child is not None:
            self._failed("jtqd is ending")

    def _failed(self, why: str) -> ReloadError:
        child, self._child = self._child, None
        if child is not None and child.alive():
            child.process.kill()  # it has sent nothing on the bus; the running loop sees its socket close
            try:
                child.answer(1.0)
            except ChildError:
                pass
        return ReloadError(why)
