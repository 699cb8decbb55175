"""Joint files, networks and estimator settings anew, in a running daemon, without a late or missing cycle.

The supervisor checks the configuration, has a child prepare the estimators (`daemon/reload/prepare.py`), and then orders the
loop to swap its own for them (`daemon/reload/swap.py`). Whatever is wrong until then is said, and nothing has changed.
What the bus, the nodes or the shared memory depend on needs a restart.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.reload.order import FILE, Order
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.estimator.checked import ConfigError

PREPARED_S = 60.0
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
            made = {"node_id", "objects"} & {
                *names
            }  # of which the TPDOs are made, unless the file names them
            keys += [f"joint_{before.number}.{name}" for name in names if not (made and name == "tpdos")]
    return keys


class Reload:
    """One reload at a time; `poll` carries it on.

    Args:
        request: the running loop's, see `daemon/loop/process.py`.
        start_child: makes a child process from (module, arguments, name).
        check: further checks of a configuration; raises ReloadError.
    """

    def __init__(
        self,
        request: dict[str, Any],
        start_child: Callable[[str, list[str], str], Child],
        check: Callable[[Config], None],
    ) -> None:
        self._path = Path(request["ring"]).with_name(FILE)
        self._request = request | {"swap": str(self._path)}
        self._start_child, self._check = start_child, check
        self._child: Child | None = None
        self._config: Config | None = None
        self._until_s = 0.0
        self._prepared: dict[str, Any] = {}

    @property
    def running(self) -> bool:
        """Return whether a reload is running."""
        return self._config is not None

    def start(self, config: Config, path: Path | None) -> None:
        """Check the files and start to prepare the estimators. Raises ReloadError."""
        if self.running:
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
        request = self._request | {"config_sha256": new.files_sha256}
        self._child = self._start_child(
            "jtqd.daemon.reload.prepare", [json.dumps(request)], "the preparation of estimators"
        )
        self._until_s = time.monotonic() + PREPARED_S

    @property
    def outputs(self) -> list[int]:
        """Return the descriptors for select."""
        return self._child.outputs if self._child is not None else []

    def poll(self, loop: Child) -> None:
        """Continue the reload: when the estimators are prepared, give `loop` its order.

        Raises:
            ReloadError: nothing came of it.
        """
        child = self._child
        if child is None:
            return
        alive = child.alive()
        answer = child.poll_answer()
        if answer is None:
            if not alive:
                raise self._failed(f"{child.name} ended with exit status {child.process.returncode}")
            if time.monotonic() > self._until_s:
                raise self._failed(f"{child.name} took longer than {PREPARED_S:g} s")
        elif "failed" in answer:
            raise self._failed(str(answer["failed"]))
        else:
            self._child, self._prepared = None, answer
            loop.tell(Order(self._path, answer["bytes"], answer["sha256"]).to_mapping())
            loop.process.send_signal(signal.SIGUSR2)

    def answered(self, answer: dict[str, Any]) -> tuple[Config, dict[str, Any]]:
        """Take the loop's answer to the order; return the configuration in force and what has changed.

        Raises:
            ReloadError: it goes on with the old estimators.
        """
        config = self._config
        if config is None or "not_swapped" in answer:
            raise self._failed(str(answer.get("not_swapped")))
        self._end()
        return config, self._prepared | answer

    def abandon(self) -> None:
        """Abandon the reload at the end of the daemon."""
        self._end()

    def _failed(self, why: str) -> ReloadError:
        self._end()
        return ReloadError(why)

    def _end(self) -> None:
        child, self._child, self._config = self._child, None, None
        if child is not None and child.alive():
            child.process.kill()
            with suppress(ChildError):
                child.answer(1.0)
        with suppress(OSError):
            self._path.unlink(missing_ok=True)
