"""Traffic of a bus, counted frame by frame against a configuration; loops that listen to the bus or send SYNC.

A cycle runs from one SYNC to the next. It is complete when every input PDO arrived in it exactly once, before the deadline.
The cycles that are cut off by begin and end of listening do not count.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.bus.service import nodes_of
from jtqd.daemon.config import Config
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.input_pdos import input_pdos
from jtqd.daemon.core.schedule import Grid
from jtqd.drivers import nmt
from jtqd.drivers.emcy import EMCY_BASE
from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    FRAME,
    FRAME_SIZE,
    pack,
    stuffed_bits,
)
from jtqd.drivers.frame_socket import BusDown, FrameSocket
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.drivers.sdo import REQUEST_ID, RESPONSE_ID

_BIN_NS = 2_000
_SERVICES = (0x000, 0x100, 0x7E4, 0x7E5)
"""NMT, TIME, LSS: belong to no node."""
_LATE = 1000
"""Added to the frames of a cycle for each that is late: more than a cycle has room for."""


class TimeHistogram:
    """Histogram of times in ns: bins of 2 us, exact maximum; below zero counts as zero."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()
        self.count = self.largest_ns = 0

    def add(self, ns: int, count: int = 1) -> None:
        """Count a value so many times."""
        if count:
            self.count += count
            self.largest_ns = max(self.largest_ns, ns)
            self._bins[max(ns, 0) // _BIN_NS] += count

    def quantile_us(self, share: float) -> float:
        """Return the upper edge of this quantile's bin [us], at most the maximum; NaN without data."""
        seen = 0
        for n in sorted(self._bins):
            seen += self._bins[n]
            if seen >= share * self.count:
                return min((n + 1) * _BIN_NS, self.largest_ns) / 1000.0
        return float("nan")

    def __str__(self) -> str:
        """Return median, 99th percentile and maximum."""
        p50, p99, largest = (self.quantile_us(share) for share in (0.5, 0.99, 1.0))
        return f"p50 {p50:.0f}, p99 {p99:.0f}, max {largest:.0f} us"


@dataclass
class PdoCount:
    """One PDO: sent at each SYNC, or by its node itself.

    Attributes:
        is_input: jtqd waits for it in each cycle.
        frames, counted: received, in whole cycles; in_cycle: in this cycle.
        missing, late: cycles without it, cycles in which it arrived after the deadline.
        delays: arrival after SYNC; of an acyclic PDO its age at SYNC.
        age_ns: longest age at which a frame of an acyclic PDO counts; 0: it is sent at each SYNC.
        last_ns: stamp of its last frame, where it is acyclic.
    """

    name: str
    length: int
    is_input: bool = True
    age_ns: int = 0
    frames: int = 0
    in_cycle: int = 0
    counted: int = 0
    missing: int = 0
    late: int = 0
    twice: int = 0
    wrong_length: int = 0
    delays: TimeHistogram = field(default_factory=TimeHistogram)
    last_ns: int = 0


@dataclass
class NodeCount:
    """One node's heartbeat and emergencies."""

    name: str
    heartbeats: int = 0
    last_ns: int = 0
    longest_gap_ns: int = 0
    state: int | None = None
    boot_ups: int = 0
    emergencies: int = 0
    last_emergency: int = 0


class Traffic:
    """Counts of one bus.

    Attributes:
        inputs, estimates: the input PDOs and jtqd's own PDOs (one for two joints), by COB-ID.
        statuses: of each joint, how often each status was published.
        nodes: by node-ID, jtqd's own included.
        sync_jitter: distance of two SYNCs from the period, absolute.
        foreign: frames by identifier that no configured node sends.
        errors: error messages of the driver, by class bit.
    """

    def __init__(self, config: Config) -> None:
        self._period_ns, self._deadline_ns = config.period_ns, config.input_deadline_ns
        self._overflow = config.sequence_overflow
        self.inputs = {
            pdo.cob_id: PdoCount(pdo.name, pdo.length, age_ns=pdo.age_ns) for pdo in input_pdos(config)
        }
        self.estimates = {
            pdo.cob_id: PdoCount(f"{pdo.cob_id:03X}h jtqd estimate", pdo.length, is_input=False)
            for pdo in estimate_tpdos(len(config.joints), config.node_id)
        }
        self._pdos = self.inputs | self.estimates
        self.nodes = {joint.node_id: NodeCount(f"drive {joint.node_id}") for joint in config.joints}
        if config.sensor is not None:
            self.nodes[config.sensor.node_id] = NodeCount(f"sensor {config.sensor.node_id}")
        self.nodes[config.node_id] = NodeCount("jtqd")
        known = {row.cob_id for row in bus_load_of(config).rows}
        services = {base + node for node in self.nodes for base in (EMCY_BASE, RESPONSE_ID, REQUEST_ID)}
        self._known = known | services | {*_SERVICES, SYNC_COB_ID}
        self.frames = self.bits = self.cycles = self.complete = self.syncs = self.counter_jumps = 0
        self.first_ns = self.last_ns = self._first_sync_ns = self._sync_ns = 0
        self._counter: int | None = None
        self.sync_jitter = TimeHistogram()
        self.foreign: Counter[int] = Counter()
        self.errors: Counter[int] = Counter()
        self.statuses: tuple[Counter[int], ...] = tuple(Counter() for _ in config.joints)

    def statuses_in(self, cob_id: int) -> dict[int, Counter[int]]:
        """Return `statuses` of the joints whose estimates this PDO carries, by their numbers."""
        first = 2 * list(self.estimates).index(cob_id)
        return dict(enumerate(self.statuses[first : first + 2], start=first + 1))

    @property
    def seconds(self) -> float:
        """Return the time from the first frame to the last."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def sync_rate(self) -> float:
        """Return the number of SYNCs per second."""
        span_ns = self._sync_ns - self._first_sync_ns
        return self.cycles / span_ns * 1e9 if span_ns else 0.0

    @property
    def slots(self) -> int:
        """Return the number of periods from the first SYNC to the last: the expected number of cycles."""
        return round((self._sync_ns - self._first_sync_ns) / self._period_ns)

    def feed(self, can_id: int, data: bytes, stamp_ns: int) -> None:
        """Count one frame, in the order of arrival; can_id: with its flags; stamp_ns: by the kernel."""
        if can_id & CAN_ERR_FLAG:
            for bit in range(29):
                if can_id >> bit & 1:
                    self.errors[1 << bit] += 1
            return
        self.frames += 1
        self.bits += stuffed_bits(can_id, data)
        self.first_ns = self.first_ns or stamp_ns
        self.last_ns = stamp_ns
        if can_id in self._pdos:
            self._pdo(self._pdos[can_id], data, stamp_ns)
            if can_id in self.estimates and len(data) == 8:
                codes = estimate_pdo.decode(data).status
                for count, status in zip(self.statuses_in(can_id).values(), codes, strict=False):
                    count[status] += 1
        elif can_id == SYNC_COB_ID:
            self._sync(data, stamp_ns)
        elif can_id not in self._known:
            self.foreign[can_id] += 1
        else:
            self._node(can_id, data, stamp_ns)

    def end(self, now_ns: int) -> None:
        """End the count at this time (clock of the stamps); silence until then counts."""
        for node in self.nodes.values():
            if node.last_ns:
                node.longest_gap_ns = max(node.longest_gap_ns, now_ns - node.last_ns)

    def _pdo(self, pdo: PdoCount, data: bytes, stamp_ns: int) -> None:
        pdo.frames += 1
        if len(data) != pdo.length:
            pdo.wrong_length += 1
            return
        if pdo.age_ns:
            pdo.last_ns = stamp_ns
        if not self._sync_ns:
            return
        pdo.in_cycle += 1
        if pdo.age_ns:
            return
        delay_ns = stamp_ns - self._sync_ns
        pdo.delays.add(delay_ns)
        if pdo.is_input and delay_ns > self._deadline_ns:
            pdo.late += 1
            pdo.in_cycle += _LATE  # not complete, whatever else comes

    def _sync(self, data: bytes, stamp_ns: int) -> None:
        self.syncs += 1
        if self._sync_ns:
            self._close()
            self.sync_jitter.add(abs(stamp_ns - self._sync_ns - self._period_ns))
        for pdo in self._pdos.values():
            pdo.in_cycle = 0
        counter = data[0] if data else None
        if counter is not None and self._counter is not None:
            self.counter_jumps += counter != self._counter % self._overflow + 1
        self._counter = counter
        self._first_sync_ns = self._first_sync_ns or stamp_ns
        self._sync_ns = stamp_ns

    def _close(self) -> None:
        self.cycles += 1
        complete = True
        for pdo in self._pdos.values():
            if pdo.age_ns:
                complete &= self._fresh(pdo)
            elif pdo.in_cycle != 1:
                complete &= not pdo.is_input
                pdo.missing += pdo.in_cycle == 0
                pdo.twice += pdo.in_cycle % _LATE > 1
            pdo.counted += pdo.in_cycle % _LATE
        self.complete += complete

    def _fresh(self, pdo: PdoCount) -> bool:
        """Count the age of an acyclic PDO at this cycle's SYNC; return whether it still counts."""
        age_ns = max(0, self._sync_ns - pdo.last_ns)
        if pdo.last_ns:
            pdo.delays.add(age_ns)
        fresh = pdo.last_ns > 0 and age_ns <= pdo.age_ns
        pdo.missing += not fresh
        return fresh

    def _node(self, can_id: int, data: bytes, stamp_ns: int) -> None:
        node = self.nodes.get(can_id & 0x7F)
        if node is None:
            return
        function = can_id & 0x780
        if function == nmt.HEARTBEAT_BASE and len(data) == 1:
            if node.last_ns:
                node.longest_gap_ns = max(node.longest_gap_ns, stamp_ns - node.last_ns)
            node.heartbeats += 1
            node.last_ns, node.state = stamp_ns, data[0]
            node.boot_ups += data[0] == 0
        elif function == EMCY_BASE and len(data) == 8:
            node.emergencies += 1
            node.last_emergency = int.from_bytes(data[:2], "little")


def identifier_text(can_id: int) -> str:
    """Return an identifier as text: "181h", "18FF00A0h (29 bit)", "181h (remote)"."""
    extended = bool(can_id & CAN_EFF_FLAG)
    identifier = can_id & (CAN_EFF_MASK if extended else CAN_SFF_MASK)
    marks = [word for word, applies in (("29 bit", extended), ("remote", can_id & CAN_RTR_FLAG)) if applies]
    return f"{identifier:0{8 if extended else 3}X}h" + (f" ({', '.join(marks)})" if marks else "")


@dataclass
class Timing:
    """Wake-up lateness of this process, and times from sending a SYNC to its echo."""

    lateness: TimeHistogram = field(default_factory=TimeHistogram)
    missed: int = 0
    echo: TimeHistogram = field(default_factory=TimeHistogram)
    unsent: int = 0
    """SYNCs that a full queue, or a bus that is down, refused."""


def listen(socket: FrameSocket, traffic: Traffic, seconds: float, every_ns: int) -> Timing:
    """Count everything on the bus for `seconds`, waking up in a grid of `every_ns`. Raises BusError."""
    timing = Timing()
    for _ in _slots(seconds, every_ns, timing):
        _take(socket, traffic)
    traffic.end(time.time_ns())
    return timing


def drive(socket: FrameSocket, traffic: Traffic, seconds: float, config: Config) -> Timing:
    """Send SYNC and the own heartbeat for `seconds` and count the answers of booted nodes. Raises BusError.

    The socket must return own frames, so that SYNC's echo and the answers are in the order of arrival.
    """
    timing = Timing()
    overflow = config.counter_overflow
    syncs = [pack(SYNC_COB_ID, bytes((n,)) if overflow else b"") for n in range(max(overflow, 1) + 1)]
    heartbeat = nmt.heartbeat(config.node_id, nmt.OPERATIONAL)
    every = max(1, config.heartbeat_ms * 1_000_000 // config.period_ns)
    counter, sent_ns = 0, 0
    for slot in _slots(seconds, config.period_ns, timing):
        _take(socket, traffic, timing.echo, sent_ns)
        counter = counter % max(overflow, 1) + 1
        sent_ns = time.time_ns()
        timing.unsent += not _send(socket, syncs[counter])
        if slot % every == 0:
            _send(socket, heartbeat)
    time.sleep(config.period_ns * 1e-9)
    _take(socket, traffic, timing.echo, sent_ns)
    traffic.end(time.time_ns())
    return timing


def leave(socket: FrameSocket, config: Config) -> None:
    """Reset the nodes to pre-operational, as jtqd does at its end. Raises BusError."""
    for node in nodes_of(config):
        socket.send(nmt.command(nmt.ENTER_PRE_OPERATIONAL, node))


def silent(socket: FrameSocket, seconds: float) -> bool:
    """Return whether no SYNC arrives in this time. Raises BusError."""
    until = time.monotonic() + seconds
    while (rest_s := until - time.monotonic()) > 0:
        if not socket.wait(rest_s):
            return True
        for n in range(socket.receive()):
            if int.from_bytes(socket.frames[FRAME_SIZE * n : FRAME_SIZE * n + 4], "little") == SYNC_COB_ID:
                return False
    return True


def _slots(seconds: float, period_ns: int, timing: Timing) -> Iterator[int]:
    """Yield the slots of an absolute grid at their times; late ones are counted and skipped, as in the loop."""
    start_ns = time.monotonic_ns() + period_ns
    grid, end_ns, number = Grid(start_ns, period_ns), start_ns + round(seconds * 1e9), 0
    while grid.slot_ns < end_ns:
        pause_ns = grid.slot_ns - time.monotonic_ns()
        if pause_ns > 0:
            time.sleep(pause_ns * 1e-9)
        now_ns = time.monotonic_ns()
        timing.lateness.add(now_ns - grid.slot_ns)
        if grid.too_late(now_ns):
            grid.missed += 1
        else:
            yield number
            number += 1
            now_ns = time.monotonic_ns()
        grid.advance(now_ns)
    timing.missed = grid.missed


def _send(socket: FrameSocket, frame: bytes) -> bool:
    try:
        return socket.send(frame)
    except BusDown:
        return False


def _take(socket: FrameSocket, traffic: Traffic, echo: TimeHistogram | None = None, sent_ns: int = 0) -> None:
    """Process all received frames."""
    while True:
        try:
            count = socket.receive()
        except BusDown:
            return
        if not count:
            return
        unpack, frames, stamps, own = FRAME.unpack_from, socket.frames, socket.stamps_ns, socket.own
        for n in range(count):
            can_id, length, data = unpack(frames, FRAME_SIZE * n)
            if can_id & CAN_RTR_FLAG and not can_id & CAN_ERR_FLAG:
                data = b""
            if echo is not None and own[n] and can_id == SYNC_COB_ID:
                echo.add(stamps[n] - sent_ns)
            traffic.feed(can_id, data[:length], stamps[n])
