"""Kinds of fault: what is suppressed, changed, delayed or added while a case lasts; what cases do with the bench."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.sim_can.canopen_node import CURRENT, CanopenNode
from jtqd.sim_can.devices import OVERCURRENT
from tests.processes import state
from tests.slow.faults.listener import Seen

if TYPE_CHECKING:
    from tests.slow.faults.rig import Rig

Passed = Iterable[tuple[int, int, bytes]]
"""(delay in ns, identifier, data) of each frame that goes out instead of one."""
Act = Callable[["Rig"], object]


def _nothing(_rig: Rig) -> None:
    pass


def _as_it_is(can_id: int, data: bytes) -> Passed:
    return ((0, can_id, data),)


@dataclass(frozen=True)
class Fault:
    """Between the nodes and the bus; this one changes nothing.

    Attributes:
        begin, end: done after an estimate, before the next SYNC.
        each_cycle: done after the nodes have answered a SYNC.
        hears: whether the nodes hear a frame of jtqd.
        passes: what goes out for a frame that a node sends.
    """

    begin: Act = _nothing
    end: Act = _nothing
    each_cycle: Act = _nothing
    hears: Callable[[int], bool] = lambda can_id: True
    passes: Callable[[int, bytes], Passed] = _as_it_is


def changed(change: Callable[[int, bytes], Iterable[tuple[int, bytes]]], *ids: int) -> Fault:
    """Frames with these identifiers are replaced by what `change` makes of them: (identifier, data) each."""
    return Fault(
        passes=lambda can_id, data: (
            [(0, *each) for each in change(can_id, data)] if can_id in ids else _as_it_is(can_id, data)
        )
    )


def lost(*ids: int) -> Fault:
    return changed(lambda can_id, data: (), *ids)


def deaf(*ids: int) -> Fault:
    return Fault(hears=lambda can_id: can_id not in ids)


def cut(begins: tuple[int, bytes], ends: tuple[int, bytes]) -> Fault:
    """Nothing gets through in either direction; error messages of the driver report its begin and its end."""
    return Fault(
        begin=lambda rig: rig.send(*begins),
        end=lambda rig: rig.send(*ends),
        hears=lambda can_id: False,
        passes=lambda can_id, data: (),
    )


def late(delay_us: float, *ids: int) -> Fault:
    """Frames with these identifiers (without any: all) come later."""
    delay_ns = round(delay_us * 1000)
    return Fault(passes=lambda can_id, data: ((delay_ns if not ids or can_id in ids else 0, can_id, data),))


def frozen(*ids: int) -> Fault:
    """Frames with these identifiers keep the data of their first one."""
    kept: dict[int, bytes] = {}
    return changed(lambda can_id, data: [(can_id, kept.setdefault(can_id, data))], *ids)


def stopped(flood: Act = _nothing) -> Fault:
    """The loop process is stopped (SIGSTOP); `flood` is sent meanwhile."""

    def begin(rig: Rig) -> None:
        os.kill(rig.loop_pid, signal.SIGSTOP)
        flood(rig)

    return Fault(begin, lambda rig: os.kill(rig.loop_pid, signal.SIGCONT))


# What the cases do with the bench.

_FAST_RAD_S = 40.0
"""Motor side; 0.4 rad/s of the bench's joints."""


def foreign_sync(rig: Rig, data: bytes) -> None:
    rig.watcher.spoil()
    rig.inject(0x080, data)


def moving(rig: Rig) -> bool:
    """Joint 1 moves."""
    return abs(rig.bench.source.drives[0].motor_velocity_rad_s) > _FAST_RAD_S


def reset(rig: Rig) -> None:
    """Release the latches: 1 to 2110h of node 20h."""
    rig.send(0x620, b"\x2f\x10\x21\x00\x01\0\0\0")


def shorter() -> Fault:
    """181h with 0, 1, ... 7 bytes."""
    lengths = itertools.cycle(range(8))
    return changed(lambda can_id, data: [(can_id, data[: next(lengths)])], 0x181)


def node(rig: Rig, number: int) -> CanopenNode:
    return rig.bench.nodes[number - 1]


def restart(rig: Rig, number: int = 1) -> None:
    """The node restarts by itself, as after a dip of its supply."""
    node(rig, number).on_frame(0x000, bytes([129, number]), time.monotonic_ns())
    node(rig, number).due_ns = 0
    node(rig, number)._bootup_pending = True


def set_state(rig: Rig, number: int, state: int) -> None:
    node(rig, number).state = state


def store(rig: Rig, number: int) -> ObjectStore:
    return node(rig, number).store


def link(rig: Rig, state: str) -> None:
    subprocess.run(["ip", "link", "set", rig.bus, state], check=True)


def step_clock(seconds: float) -> None:
    time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + seconds)


def returns_with(number: int, index: int, subindex: int, value: int | None) -> Fault:
    """The node restarts with another value of an object (None: half of what it is); then it restarts as it was."""
    was: list[int] = []

    def first(rig: Rig) -> None:
        was.append(store(rig, number).number(index, subindex))
        _set(rig, was[0] // 2 if value is None else value)

    def _set(rig: Rig, number_: int) -> None:
        store(rig, number).set_number(index, subindex, number_)
        store(rig, number).keep_as_default(index, subindex)
        restart(rig, number)

    return Fault(first, lambda rig: _set(rig, was[0]))


def mute_restart() -> Fault:
    """Node 1 restarts and hears no SDO request."""
    return Fault(restart, hears=lambda can_id: can_id != 0x601)


def reconfigure(rig: Rig) -> None:
    """Another master: pre-operational, transmission type 10 for TPDO1 of node 1, operational."""
    rig.inject(0x000, b"\x80\x01")
    rig.inject(0x601, b"\x2f\x00\x18\x02\x0a\0\0\0")
    rig.inject(0x000, b"\x01\x01")


def reconfigure_by_the_rules(rig: Rig) -> None:
    """The same, of a node that lets a TPDO be changed only while it is not valid."""
    cob_id = store(rig, 1).number(0x1800, 1)
    rig.inject(0x000, b"\x80\x01")
    rig.inject(0x601, b"\x23\x00\x18\x01" + (cob_id | 0x8000_0000).to_bytes(4, "little"))
    rig.inject(0x601, b"\x2f\x00\x18\x02\x0a\0\0\0")
    rig.inject(0x601, b"\x23\x00\x18\x01" + cob_id.to_bytes(4, "little"))
    rig.inject(0x000, b"\x01\x01")


def reconfigure_signed(rig: Rig) -> None:
    """The same, and 1020h holds the signature all the while."""
    words = [store(rig, 1).number(0x1020, subindex) for subindex in (1, 2)]
    reconfigure(rig)
    for subindex, word in enumerate(words, 1):
        store(rig, 1).set_number(0x1020, subindex, word)


def changes(number: int, index: int, subindex: int, factor: float) -> Fault:
    """An object of a node that runs is another for a while, and nothing else shows it."""

    was: list[int] = []

    def first(rig: Rig) -> None:
        was.append(store(rig, number).number(index, subindex))
        store(rig, number).set_number(index, subindex, round(was[0] * factor))

    return Fault(first, lambda rig: store(rig, number).set_number(index, subindex, was[0]))


def sdo_reads(rig: Rig) -> None:
    """Two questions in a cycle: 1018h:1 of jtqd, and of node 1 by another client."""
    rig.send(0x620, b"\x40\x18\x10\x01\0\0\0\0")
    rig.inject(0x601, b"\x40\x18\x10\x01\0\0\0\0")


def drive_fault(rig: Rig, number: int) -> None:
    """The power stage is off, 6041h says fault, an EMCY tells why; PDOs and heartbeat go on."""
    drive = rig.bench.drives[number - 1]
    drive.machine.fault()
    drive.machine.stopped()
    rig.emit(drive.raise_error(OVERCURRENT, CURRENT) + drive.event())


def release(rig: Rig, number: int) -> None:
    """Its fault is reset, which an EMCY 0000h tells."""
    drive = rig.bench.drives[number - 1]
    drive.machine.release()
    rig.emit(drive.clear_error(OVERCURRENT) + drive.event())


def forget(rig: Rig, number: int) -> None:
    """The node loses its configuration (1000h to 1FFFh are as delivered), stays operational and says nothing."""
    store(rig, number).restore(0x1000, 0x1FFF)
    node(rig, number)._generation = -1


# What shows that a fault is there.


def stands_still(name: str, pid: int) -> Seen:
    return Seen(state(pid) == "T", f"{name} in state {state(pid)}")


def loop_stands_still(rig: Rig) -> Seen:
    return stands_still("loop", rig.loop_pid)


def link_is_down(rig: Rig) -> Seen:
    up = int(Path(f"/sys/class/net/{rig.bus}/flags").read_text(), 16) & 1
    return Seen(not up, f"{rig.bus} is {'up' if up else 'down'}")
