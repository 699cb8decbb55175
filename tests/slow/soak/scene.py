"""What a fault of the soak acts with: the bus, the bench that takes orders, and the processes."""

from __future__ import annotations

import json
import os
import random
import select
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import BusDown, FrameSocket
from tests.slow.soak.rig import Rig

_ANSWER_S = 5.0
_KILLED_S = 1.0


class NotInjectedError(Exception):
    """A fault could not be done; the text says why."""


@dataclass
class Scene:
    """Bench, daemon and bus of a soak; `socket` is one more member of the bus."""

    rig: Rig
    socket: FrameSocket
    source: random.Random

    def send(self, can_id: int, data: bytes = b"") -> None:
        """A frame of somebody who is not on the bench. Raises NotInjectedError."""
        try:
            sent = self.socket.send(pack(can_id, data))
        except BusDown as error:
            raise NotInjectedError(str(error)) from None
        if not sent:
            raise NotInjectedError(f"{can_id:03X}h: the bus took no frame")

    def order(self, kind: str, **more: Any) -> dict[str, Any]:
        """An order to the bench (`tests/slow/soak/bench.py`); returns its answer. Raises NotInjectedError."""
        writing, reading = self.rig.bench.stdin, self.rig.bench.stdout
        assert writing is not None
        assert reading is not None
        writing.write(json.dumps({"kind": kind, **more}) + "\n")
        writing.flush()
        if not select.select([reading], [], [], _ANSWER_S)[0]:
            raise NotInjectedError(f"the bench did not answer within {_ANSWER_S:g} s")
        answer: dict[str, Any] = json.loads(reading.readline())
        if answer["kind"] != kind:
            raise NotInjectedError(f"the bench answered {answer['kind']!r}")
        return answer

    def pid(self, name: str) -> int:
        """Of a process of the daemon, or of the bench. Raises NotInjectedError where there is none."""
        pid = self.rig.processes().get(name)
        if pid is None:
            raise NotInjectedError(f"there is no {name}")
        return pid

    def stop(self, name: str, seconds: float) -> None:
        """SIGSTOP, a pause, SIGCONT. Raises NotInjectedError where the kernel does not say that it stood still."""
        pid = self.pid(name)
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(seconds)
            state = state_of(pid)
        finally:
            os.kill(pid, signal.SIGCONT)
        if state != "T":
            raise NotInjectedError(f"{name} was not stopped but {state}")

    def kill(self, name: str) -> None:
        """SIGKILL. Raises NotInjectedError where it lives on."""
        pid = self.pid(name)
        os.kill(pid, signal.SIGKILL)
        end = time.monotonic() + _KILLED_S
        while state_of(pid) not in ("", "Z"):
            if time.monotonic() > end:
                raise NotInjectedError(f"{name} lives on")
            time.sleep(0.002)


def state_of(pid: int) -> str:
    """State letter of a process; "" where there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""
