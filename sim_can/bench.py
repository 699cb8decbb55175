"""The emulated bench: drives and a torque sensor around their sources, its event loop on a bus, and what a cycle costs.

`Bench` has no socket and no clock: frames and times in, frames out. While no master commands the drives it moves them itself
(`jtqd.sim_can.drives`). `run` is the bus, the clocks and the signals around it.
"""

from __future__ import annotations

import gc
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jtqd.drivers.bus_socket import PREFIX, CanFilter, exact
from jtqd.drivers.drive import drive_layout
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, FRAME_SIZE, MAX_LENGTH
from jtqd.drivers.frame_socket import BusDown, BusError, open_frame_socket
from jtqd.drivers.hub import Hub, StopError, until_stopped
from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.own_objects import COMMANDER_NODE, JTQD_NODE
from jtqd.drivers.pdo import SYNC_COB_ID, tpdo_parameters
from jtqd.drivers.sdo import REQUEST_ID, Transfer
from jtqd.drivers.sensor import sensor_tpdo1
from jtqd.sim_can.canopen_node import CanopenNode
from jtqd.sim_can.devices import DEFAULT_INTERPOLATION_S, OPERATION_ENABLED, DriveNode, SensorNode
from jtqd.sim_can.drives import demo_current, demo_velocity
from jtqd.sim_can.eds_entries import sensor_node
from jtqd.sim_can.plant_source import AnyPlant, PlantSource
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY, DriveSignals, Source

CLOCK_STEP_NS = 100_000_000  # stamps and steady clock never differ by this from SYNC to SYNC, unless CLOCK_REALTIME was set
LONGEST_STEP_NS = 50_000_000  # a source never jumps further than this, however long SYNC was away
# a software stamp is no better; the plant then gets an exact grid wherever SYNC keeps one
RESOLUTION_NS = 10_000
IDLE_STEP_NS = 10_000_000  # step of powered drives once SYNC has been away for LONGEST_STEP_NS


def bench_filters(drives: int = 2) -> tuple[CanFilter, ...]:
    """Return filters for what the bench receives.

    NMT, SYNC, SDO requests, RPDOs 1 and 2 of so many drives, heartbeats of jtqd and of the node that commands.
    """
    ids = [0x000, SYNC_COB_ID, HEARTBEAT_BASE + JTQD_NODE, HEARTBEAT_BASE + COMMANDER_NODE]
    nodes = range(1, drives + 1)
    ids += [REQUEST_ID + node for node in (*nodes, sensor_node(drives))]
    ids += [base + node for base in (0x200, 0x300) for node in nodes]
    return tuple(exact(can_id) for can_id in ids)


def _rounded(time_ns: int) -> int:
    return (time_ns + RESOLUTION_NS // 2) // RESOLUTION_NS * RESOLUTION_NS


class Bench:
    """Nodes 1, 2, ... (drives) and 3 or 5 (sensor) of the bench. `over` turns True when a recorded run has ended.

    Args:
        source: of the first drives; its torque channels are those of the sensor.
        profile: "demo": while no master commands the drives, the first one of each source follows the built-in motion, the
            second one its load.
        more: sources of further drives, with the next channels.
        with_sensor: there is a sensor node.

    A source's time is the measured time since the first SYNC, in steps of RESOLUTION_NS: equal stamps give
    equal values, and so do stamps that differ by their own inaccuracy.
    """

    def __init__(
        self, source: Source, profile: str = "demo", more: Sequence[Source] = (), *, with_sensor: bool = True
    ) -> None:
        self.source = source
        self._sources = (source, *more)
        self.over = False
        drives: list[DriveNode] = []
        for each in self._sources:
            first = len(drives) + 1
            drives += [DriveNode(each, n, self._hand_over, first + n) for n in range(len(each.drives))]
        self.drives = tuple(drives)
        self.nodes: tuple[CanopenNode, ...] = self.drives
        if with_sensor:
            channels = [channel for each in self._sources for channel in each.channels]
            self.sensor = SensorNode(channels, sensor_node(len(drives)))
            self.nodes += (self.sensor,)
        self.sync_count = 0
        self._profile = profile
        self._profile_s = 0.0
        self._target_period_s = DEFAULT_INTERPOLATION_S  # of the built-in motion: as a master sets 60C2h
        self._first_stamp_ns = 0
        self._last_time_ns = 0  # of the last SYNC, since the first one
        self._last_steady_ns = 0  # steady clock at the last step, for idle steps
        self._sync_steady_ns = 0  # steady clock at the last SYNC
        self._idle_ns = 0  # source time spent in idle steps since the last SYNC

    @property
    def due_ns(self) -> int:
        """Steady time at which `tick` has something to do next."""
        due = min(node.due_ns for node in self.nodes)
        return min(due, self._idle_due_ns()) if self._moving() else due

    def on_frame(self, can_id: int, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        """Handle a frame from the bus; return frames to send. stamp_ns: of its reception (kernel); now_ns: steady clock."""
        if can_id == SYNC_COB_ID:
            return self._on_sync(data, stamp_ns, now_ns)
        frames: list[bytes] = []
        for node in self.nodes:
            frames += node.on_frame(can_id, data, now_ns)
        return frames

    def tick(self, now_ns: int) -> list[bytes]:
        """Serve heartbeats and timers; advance powered drives when there is no SYNC."""
        frames: list[bytes] = []
        for node in self.nodes:
            if now_ns >= node.due_ns:
                frames += node.tick(now_ns)
        if self._moving() and now_ns >= self._idle_due_ns():
            step_ns = min(now_ns - self._last_steady_ns, LONGEST_STEP_NS)
            self._last_steady_ns = now_ns
            self._idle_ns += step_ns
            frames += self._advance(step_ns * 1e-9)
        return frames

    def _on_sync(self, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        step_ns = 0
        if self.sync_count:
            time_ns = _rounded(stamp_ns - self._first_stamp_ns)
            since_ns, steady_ns = time_ns - self._last_time_ns, now_ns - self._sync_steady_ns
            if abs(since_ns - steady_ns) > CLOCK_STEP_NS:
                since_ns = _rounded(
                    steady_ns
                )  # a clock that was set must neither stop the bench nor hurry it
            # time that idle steps covered does not count twice
            step_ns = min(max(since_ns - self._idle_ns, 0), LONGEST_STEP_NS)
            self._last_time_ns = time_ns
        else:
            self._first_stamp_ns = stamp_ns
        self.sync_count += 1
        self._last_steady_ns = self._sync_steady_ns = now_ns
        self._idle_ns = 0
        self._target_period_s = max(round(step_ns * 1e-9, 3), DEFAULT_INTERPOLATION_S)
        frames = self._advance(step_ns * 1e-9)
        if self.over:
            return frames
        for node in self.nodes:
            frames += node.on_sync(data)
        return frames

    def _advance(self, dt_s: float) -> list[bytes]:
        for source in self._sources:
            if not source.advance(dt_s):
                self.over = True
                return []
        frames: list[bytes] = []
        for drive in self.drives:
            frames += drive.watch()
        if not self.drives[0].commanded:
            frames += self._by_itself(dt_s)
        return frames

    def _by_itself(self, dt_s: float) -> list[bytes]:
        """Run drives that no master commands: enabled by a recorded run, or by the built-in motion."""
        frames: list[bytes] = []
        if self._played():
            for drive, signal in zip(self.drives, self._signals(), strict=True):
                if signal.enabled:
                    frames += drive.run_by_itself(OFF, 0.0)
            return frames
        if all(drive.machine.state == OPERATION_ENABLED for drive in self.drives):
            self._profile_s += dt_s
        else:
            self._profile_s = 0.0  # start, or start again after a stop, from rest
        if self._profile != "demo":
            return []
        velocity, current = demo_velocity(self._profile_s), demo_current(self._profile_s)
        drives = iter(self.drives)
        for source in self._sources:
            gear = source.ratings[0].gear_ratio
            frames += next(drives).run_by_itself(VELOCITY, velocity * gear, self._target_period_s)
            if len(source.drives) > 1:
                frames += next(drives).run_by_itself(CURRENT, current)
        return frames

    def _signals(self) -> list[DriveSignals]:
        return [signals for source in self._sources for signals in source.drives]

    def _played(self) -> bool:
        """Return whether a recorded run is played."""
        return any(signals.enabled for signals in self._signals())

    def _hand_over(self) -> None:
        for drive in self.drives:
            drive.hand_over()

    def _idle_due_ns(self) -> int:
        return self._last_steady_ns + (IDLE_STEP_NS if self._idle_ns else LONGEST_STEP_NS)

    def _moving(self) -> bool:
        """Return whether drives go on without SYNC: powered ones of a plant do, a recorded run does not."""
        if not self.sync_count or self._played():
            return False
        return any(drive.machine.powered for drive in self.drives)


# The bench on a bus

_RETRY_S = 0.2  # between two looks at an interface that is down
_NOT_DATA = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG
_LONGEST_WAIT_S = 1.0
_LINGER_STEP_S = 0.05


def _log(text: str) -> None:
    print(f"bench: {text}", file=sys.stderr, flush=True)


class _EmbeddedHub:
    """Unix bus whose hub is in this process; the bench is a local port of it."""

    def __init__(self, path: str, bitrate: int | None, bench: Bench) -> None:
        self._hub = Hub(path, bitrate)
        self._bench = bench
        self._port = self._hub.attach(
            self._on_frame, [each.can_id for each in bench_filters(len(bench.drives))]
        )
        self.send = self._port.send
        self.serve = self._hub.serve
        self.close = self._hub.close

    def linger(self, end_ns: int | None) -> None:
        """Keep the hub for its other members, as a wire stays when a node goes silent."""
        self._port.detach()
        if self._hub.clients:
            _log("the nodes have stopped; the bus closes when its last client disconnects")
        while self._hub.clients and (end_ns is None or time.monotonic_ns() < end_ns):
            self._hub.run_once(_LONGEST_WAIT_S if end_ns is None else _LINGER_STEP_S)

    def _on_frame(self, frame16: bytes, stamp_ns: int) -> None:
        can_id, length, data = FRAME.unpack(frame16)
        for frame in self._bench.on_frame(can_id, data[:length], stamp_ns, time.monotonic_ns()):
            self.send(frame)


class _Socket:
    """Bus of which the bench is one member: SocketCAN, or a unix bus whose hub runs elsewhere."""

    def __init__(self, bus: str, bench: Bench) -> None:
        self._socket = open_frame_socket(bus, bench_filters(len(bench.drives)))
        self._bench = bench
        self._down = False
        self.close = self._socket.close

    def linger(self, end_ns: int | None) -> None:
        """Return at once: the bus does not depend on the bench."""

    def send(self, frame16: bytes) -> bool:
        try:
            return self._socket.send(frame16)
        except BusDown:
            self._log_down()
            return False

    def serve(self, timeout_s: float) -> None:
        socket = self._socket
        if not socket.wait(timeout_s):
            return
        try:
            count = socket.receive()
        except BusDown:
            self._log_down()
            time.sleep(
                _RETRY_S
            )  # the kernel reports it once; the same socket works again when the link is up
            return
        if count and self._down:
            self._down = False
            _log("the interface is up again")
        now_ns = time.monotonic_ns()
        frames, stamps, lengths = bytes(socket.frames[: count * FRAME_SIZE]), socket.stamps_ns, socket.lengths
        for i in range(count):
            if lengths[i] != FRAME_SIZE:
                continue
            can_id, length, data = FRAME.unpack_from(frames, i * FRAME_SIZE)
            if can_id & _NOT_DATA or length > MAX_LENGTH:
                continue
            for frame in self._bench.on_frame(can_id, data[:length], stamps[i], now_ns):
                self.send(frame)

    def _log_down(self) -> None:
        if not self._down:
            self._down = True
            _log("the interface is down, waiting for it")


def _open(bus: str, bitrate: int | None, bench: Bench) -> _Socket | _EmbeddedHub:
    """Open the bus; a unix bus without a hub gets one here."""
    if not bus.startswith(PREFIX):
        return _Socket(bus, bench)
    path = bus[len(PREFIX) :]
    try:
        joined = _Socket(bus, bench)
    except BusError:
        if not path or not Path(path).parent.is_dir():
            raise
        return _EmbeddedHub(path, bitrate, bench)
    if bitrate is not None:
        _log(f"{bus} already has a hub, --bitrate is ignored")
    return joined


def run(bus: str, bench: Bench, bitrate: int | None = None, duration_s: float | None = None) -> int:
    """Run the bench until SIGINT, SIGTERM, the end of a played run or `duration_s`. Returns 0.

    Raises:
        BusError: the bus cannot be opened or has gone.
    """
    before = until_stopped()
    line: _Socket | _EmbeddedHub | None = None
    try:
        line = _open(bus, bitrate, bench)
        gc.collect()
        gc.freeze()
        end_ns = None if duration_s is None else time.monotonic_ns() + round(duration_s * 1e9)
        _tick(line, bench)
        print(f"bench ready on {bus}", file=sys.stderr, flush=True)  # other processes wait for this line
        _loop(line, bench, end_ns)
    except StopError:
        pass
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # leaving takes a moment and happens once
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if line is not None:
            line.close()
        for number, handler in before.items():
            signal.signal(number, handler)
    return 0


def _tick(line: _Socket | _EmbeddedHub, bench: Bench) -> None:
    for frame in bench.tick(time.monotonic_ns()):
        line.send(frame)


def _loop(line: _Socket | _EmbeddedHub, bench: Bench, end_ns: int | None) -> None:
    """Serve frames as they come and timers when they are due; sleep in between."""
    while not bench.over:
        now_ns = time.monotonic_ns()
        if end_ns is not None and now_ns >= end_ns:
            return
        due_ns = bench.due_ns
        if now_ns >= due_ns:
            _tick(line, bench)
            due_ns = bench.due_ns
        wake_ns = due_ns if end_ns is None else min(due_ns, end_ns)
        line.serve(min(max(wake_ns - now_ns, 0) * 1e-9, _LONGEST_WAIT_S))
    _log("the run has ended")
    line.linger(end_ns)


# CPU time of a cycle

CYCLE_NS = 1_000_000
BLOCK = 50


@dataclass(frozen=True)
class Cost:
    """CPU time in microseconds per 1 ms cycle: medians over blocks of BLOCK cycles."""

    plant_step_us: float  # both joints with their drives' control loops
    source_us: float  # plant step with encoders, noise and sensor
    sync_us: float  # everything a SYNC does: source, state machines, five TPDOs packed
    substeps: int
    cycles: int


def map_pdos(bench: Bench) -> None:
    """Write the PDO mapping that jtqd writes at boot by SDO, and start the nodes."""
    pdos = [(node, pdo) for node in (1, 2) for pdo in drive_layout(node)]
    for node, pdo in (*pdos, (3, sensor_tpdo1(3))):
        communication, mapping = tpdo_parameters(pdo.number)
        for key, value, size in (
            ((communication, 1), 0xC000_0000 | pdo.cob_id, 4),
            ((mapping, 0), 0, 1),
            *(((mapping, entry), word, 4) for entry, word in enumerate(pdo.words, 1)),
            ((mapping, 0), len(pdo.words), 1),
            ((communication, 2), pdo.transmission_type, 1),
            ((communication, 1), 0x4000_0000 | pdo.cob_id, 4),
        ):
            request = Transfer(*key, value.to_bytes(size, "little")).request
            bench.on_frame(REQUEST_ID + node, request, 0, 0)
    bench.on_frame(0x000, b"\x01\x00", 0, 0)


def measure(parameters: AnyPlant, cycles: int = 4000) -> Cost:
    """Run the demo motion for `cycles` SYNCs and measure; three benches, so that no part is a difference of
    two others.
    """
    full = Bench(PlantSource(parameters))
    map_pdos(full)
    stamps = [0]

    def sync() -> None:
        stamps[0] += CYCLE_NS
        full.on_frame(SYNC_COB_ID, b"\x01", stamps[0], stamps[0])

    whole = _median_us(sync, cycles)
    source = PlantSource(parameters)
    for drive, moving in enumerate(full.drives):
        source.command(drive, *moving.source_command())
    reading = _median_us(lambda: source.advance(0.001), cycles)
    plant = source.plant
    stepping = _median_us(lambda: plant.step(0.001), cycles)
    return Cost(stepping, reading, whole, round(0.001 / plant.substep_s), cycles)


def _median_us(call: Callable[[], object], cycles: int) -> float:
    """Return the median CPU time of a call in microseconds, over blocks of BLOCK calls."""
    blocks = []
    for _ in range(max(1, cycles // BLOCK)):
        start = time.process_time_ns()
        for _ in range(BLOCK):
            call()
        blocks.append((time.process_time_ns() - start) / (BLOCK * 1000.0))
    return sorted(blocks)[len(blocks) // 2]
