"""Kinds of fault: what is suppressed, changed, delayed or added while a case lasts; what cases do with the bench."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.sim_can.canopen_node import CURRENT, CanopenNode
from jtqd.sim_can.devices import OVERCURRENT
from tests.slow.faults.listener import Seen

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


# What the cases do with the bench.

_FAST_RAD_S = 40.0
"""Motor side; 0.4 rad/s of the bench's joints."""


def foreign_sync(rig: Rig, data: bytes) -> None:
    """A SYNC of somebody else just after ours."""
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
    return Changed(lambda can_id, data: [(can_id, data[: next(lengths)])], 0x181)


def node(rig: Rig, number: int) -> CanopenNode:
    """A node of the bench."""
    return rig.bench.nodes[number - 1]


def restart(rig: Rig, number: int = 1) -> None:
    """The node restarts by itself, as after a dip of its supply."""
    node(rig, number).on_frame(0x000, bytes([129, number]), time.monotonic_ns())
    node(rig, number).due_ns = 0
    node(rig, number)._bootup_pending = True


def set_state(rig: Rig, number: int, state: int) -> None:
    """The node is in another NMT state, and says nothing."""
    node(rig, number).state = state


def store(rig: Rig, number: int) -> ObjectStore:
    """Its object dictionary."""
    return node(rig, number).store


def link(rig: Rig, state: str) -> None:
    """The interface goes up or down."""
    subprocess.run(["ip", "link", "set", rig.bus, state], check=True)


def step_clock(seconds: float) -> None:
    """CLOCK_REALTIME jumps."""
    time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + seconds)


def stop_supervisor(rig: Rig) -> None:
    """SIGSTOP to the supervisor."""
    os.kill(rig.process.pid, signal.SIGSTOP)


def go_on_supervisor(rig: Rig) -> None:
    """SIGCONT."""
    os.kill(rig.process.pid, signal.SIGCONT)


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

    return Added(first=first, last=lambda rig: _set(rig, was[0]))


class _Mute(Fault):
    """Node 1 restarts and hears no SDO."""

    def begin(self, rig: Rig) -> None:
        """The restart."""
        restart(rig, 1)

    def hears(self, can_id: int) -> bool:
        """All but its requests."""
        return can_id != 0x601


def mute_restart() -> Fault:
    """Node 1 restarts and does not answer."""
    return _Mute()


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

    return Added(first=first, last=lambda rig: store(rig, number).set_number(index, subindex, was[0]))


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


def _stands_still(name: str, pid: int) -> Seen:
    state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return Seen(state == "T", f"{name} in state {state}")


def loop_stands_still(rig: Rig) -> Seen:
    """The kernel says that it is stopped."""
    return _stands_still("loop", rig.loop_pid)


def supervisor_stands_still(rig: Rig) -> Seen:
    """The same of the process beside the loop."""
    return _stands_still("supervisor", rig.process.pid)


def link_is_down(rig: Rig) -> Seen:
    """The kernel says that the interface is not up."""
    up = int(Path(f"/sys/class/net/{rig.bus}/flags").read_text(), 16) & 1
    return Seen(not up, f"{rig.bus} is {'up' if up else 'down'}")
