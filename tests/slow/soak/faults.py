"""Faults of a soak: each acts on the bus, the bench that takes orders or the processes, and names what must report it."""

from __future__ import annotations

import json
import os
import random
import select
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import BusDown, FrameSocket
from tests.processes import state
from tests.slow.faults import listener as proofs
from tests.slow.faults.listener import Heard, Proof, Seen
from tests.slow.soak.bench import BUS_OFF, RESTARTED
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
            stood = state(pid)
        finally:
            os.kill(pid, signal.SIGCONT)
        if stood != "T":
            raise NotInjectedError(f"{name} was not stopped but {stood}")

    def kill(self, name: str) -> None:
        """SIGKILL. Raises NotInjectedError where it lives on."""
        pid = self.pid(name)
        os.kill(pid, signal.SIGKILL)
        end = time.monotonic() + _KILLED_S
        while state(pid) not in ("", "Z"):
            if time.monotonic() > end:
                raise NotInjectedError(f"{name} lives on")
            time.sleep(0.002)


_STOP, _RESET = 2, 129
INPUTS = (0x181, 0x281, 0x182, 0x282)


@dataclass(frozen=True)
class Fault:
    """One kind.

    Attributes:
        name: in the table.
        act: does it, leaves the bench as it was within some two seconds, and returns how the bus proves it. Raises
            NotInjectedError.
        words: one of them must be in the daemon's standard error afterwards; empty: nothing is to be said.
        counters: one of them must have grown; empty: nothing is to be counted.
        statuses: one of them a joint must have had; empty: nothing.
        recorder: all is well only when the recorder has written cycles of after the fault.
    """

    name: str
    act: Callable[[Scene], Proof]
    words: tuple[str, ...] = ()
    counters: tuple[str, ...] = ()
    statuses: tuple[int, ...] = ()
    recorder: bool = False


def _burst(can_id: int, length: int, count: int = 5) -> Callable[[Scene], Proof]:
    def act(scene: Scene) -> Proof:
        sent = [scene.source.randbytes(length) for _ in range(count)]
        for data in sent:
            scene.send(can_id, data)
            time.sleep(0.003)
        return proofs.frames(count, can_id, *sent)

    return act


def _nmt(command: int) -> Callable[[Scene], Proof]:
    def act(scene: Scene) -> Proof:
        node = scene.source.choice((1, 2, 3))
        data = bytes((command, node))
        scene.send(0x000, data)
        stopped, restarted = proofs.withheld(20, 0x180 + node), proofs.frames(1, 0x700 + node, b"\0")
        return proofs.all_of(proofs.frames(1, 0x000, data), stopped if command == _STOP else restarted)

    return act


def _emcy(scene: Scene) -> Proof:
    data = bytes((scene.source.randrange(256), 0x23, 1)) + scene.source.randbytes(5)
    can_id = 0x080 + scene.source.choice((1, 2, 3))
    scene.send(can_id, data)
    return proofs.frames(1, can_id, data)


def _sdo_load(scene: Scene) -> Proof:
    for _ in range(200):
        index = scene.source.choice((0x1000, 0x1018, 0x1001, 0x2200, 0x5000))
        data = bytes((0x40, index & 0xFF, index >> 8, scene.source.randrange(4), 0, 0, 0, 0))
        scene.send(0x620, data)
        time.sleep(0.001)
    return proofs.all_of(proofs.frames(200, 0x620), proofs.frames(150, 0x5A0))


def _babble(scene: Scene) -> Proof:
    for _ in range(100):
        for _ in range(6):
            scene.send(scene.source.randrange(0x500, 0x57F), scene.source.randbytes(8))
        time.sleep(0.002)

    def proof(heard: Heard) -> Seen:
        found = len(heard.at(*range(0x500, 0x57F)))
        return Seen(found >= 600, f"{found} frames of the babbler")

    return proof


def _foreign_sync(scene: Scene) -> Proof:
    scene.send(0x080)
    return proofs.of_length(1, 0x080, 0)


def _lost(scene: Scene) -> Proof:
    can_id = scene.source.choice(INPUTS)
    scene.order("lost", ids=[can_id], frames=1)
    return proofs.withheld(1, can_id)


def _late(scene: Scene) -> Proof:
    # Later than any SYNC: the next one may itself be late by up to half a period, and would then come after the frame.
    can_id, delay_us = scene.source.choice(INPUTS), scene.source.choice((1600, 2500))
    scene.order("late", ids=[can_id], frames=1, delay_us=delay_us)
    return proofs.withheld(1, can_id)


def _sensor_invalid(scene: Scene) -> Proof:
    scene.order("sensor invalid", ms=400)
    return proofs.sensor_status(300, 1)


def _sensor_gone(scene: Scene) -> Proof:
    scene.order("lost", ids=[0x183], ms=400)
    return proofs.withheld(300, 0x183)


def _drive_fault(scene: Scene) -> Proof:
    node = scene.source.choice((1, 2))
    scene.order("drive fault", node=node, ms=300)

    def beats(heard: Heard) -> Seen:
        at = heard.at(0x700 + node)
        longest_s = float(np.diff(heard.stamps_ns[at]).max(initial=0)) * 1e-9
        going = len(at) > 2 and longest_s < 0.3 and set(heard.data[at, 0].tolist()) == {5}
        return Seen(going, f"heartbeat operational, longest pause {longest_s:.2f} s")

    emcys = proofs.frames(1, 0x080 + node, b"\x10\x23"), proofs.frames(1, 0x080 + node, b"\0\0")
    return proofs.all_of(proofs.statuswords(200, node, 0x4F, 0x08), *emcys, beats)


def _restart(scene: Scene) -> Proof:
    node = scene.source.choice((1, 2, 3))
    scene.order("restart", node=node, ms=1)
    return proofs.frames(1, 0x700 + node, b"\0")


def _forget(scene: Scene) -> Proof:
    node = scene.source.choice((1, 2))
    scene.order("forget", node=node, ms=1)

    def silent(heard: Heard) -> Seen:
        boots, resets = heard.count(0x700 + node, b"\0"), heard.count(0x000, bytes((_RESET, node)))
        return Seen(boots <= resets, f"{boots} boot-ups, {resets} resets by the master")

    return proofs.all_of(proofs.withheld(20, 0x180 + node), silent)


def _stopped(name: str, seconds: float) -> Callable[[Scene], Proof]:
    def act(scene: Scene) -> Proof:
        scene.stop(name, seconds)
        # A unix bus stands still altogether, as its hub is in the bench.
        return proofs.silent(0.8 * seconds, *INPUTS) if name == "bench" else _by_the_kernel

    return act


def _by_the_kernel(_heard: Heard) -> Seen:
    return Seen(True, "the kernel says so")


def _kill_recorder(scene: Scene) -> Proof:
    scene.kill("recorder")
    return _by_the_kernel


def _link_down(seconds: float) -> Callable[[Scene], Proof]:
    def act(scene: Scene) -> Proof:
        _link(scene.rig.bus, "down")
        time.sleep(seconds)
        up = _is_up(scene.rig.bus)
        _link(scene.rig.bus, "up")
        if up:
            raise NotInjectedError(f"{scene.rig.bus} was not down")

        return proofs.silent(0.9 * seconds, *INPUTS)

    return act


def _is_up(name: str) -> bool:
    return bool(int(Path(f"/sys/class/net/{name}/flags").read_text(), 16) & 1)


def _link(name: str, state: str) -> None:
    subprocess.run(["ip", "link", "set", name, state], check=True)


def _bus_off(scene: Scene) -> Proof:
    scene.order("bus-off", ms=100)
    return proofs.all_of(proofs.frames(1, BUS_OFF), proofs.withheld(80, 0x181), proofs.frames(1, RESTARTED))


COMMON = (
    Fault("wrong length", _burst(0x181, 4), counters=("rejected_frames",)),
    Fault("second sender", _burst(0x281, 8), counters=("duplicate_frames", "late_frames", "stale_inputs")),
    Fault("foreign SYNC", _foreign_sync, counters=("foreign_sync",)),
    Fault("node reset", _nmt(_RESET), ("restarted", "was away"), ("boot_ups",)),
    Fault("node stopped", _nmt(_STOP), ("NMT command", "was away", "more before")),
    Fault("node restarts", _restart, ("restarted", "was away"), ("boot_ups",)),
    Fault("configuration lost", _forget, ("is configured again",), ("stale_inputs",)),
    Fault("drive in fault", _drive_fault, ("EMCY 2310h", "more before"), statuses=(5,)),
    Fault("sensor invalid", _sensor_invalid, ("torque sensor",)),
    Fault("sensor gone", _sensor_gone, ("torque sensor",)),
    Fault("input lost once", _lost, counters=("stale_inputs",)),
    Fault("input late once", _late, counters=("stale_inputs", "late_frames")),
    Fault("EMCY", _emcy, ("EMCY",)),
    Fault("SDO load", _sdo_load),
    Fault("babbling", _babble),
    Fault("recorder stopped", _stopped("recorder", 1.5), recorder=True),
    Fault("recorder killed", _kill_recorder, ("recorder",), recorder=True),
    Fault("supervisor stopped", _stopped("supervisor", 0.5)),
    Fault("bench stopped", _stopped("bench", 0.05), counters=("stale_inputs",)),
)
ON_INTERFACE = (
    Fault("link down", _link_down(0.3), counters=("bus_errors",)),
    Fault("link down for long", _link_down(1.5), counters=("bus_errors",)),
    Fault("bus-off", _bus_off, ("bus-off",), ("stale_inputs",)),
)
