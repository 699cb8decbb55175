"""Event loop of the bench: the bus, the clocks and the signals around `jtqd.sim_can.bench.Bench`."""

from __future__ import annotations

import ctypes
import gc
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Protocol

from jtqd.drivers.bus_socket import PREFIX
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, FRAME_SIZE, MAX_LENGTH
from jtqd.drivers.frame_socket import BusDown, BusError, open_frame_socket
from jtqd.drivers.hub import Hub
from jtqd.sim_can.bench import Bench, bench_filters

_PR_SET_TIMERSLACK = 29
_RETRY_S = 0.2  # between two looks at an interface that is down
_NOT_DATA = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG
_LONGEST_WAIT_S = 1.0
_LINGER_STEP_S = 0.05


class _StopError(Exception):
    """SIGINT or SIGTERM."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise _StopError


def _log(text: str) -> None:
    print(f"bench: {text}", file=sys.stderr, flush=True)


class _Bus(Protocol):
    """Bus as the loop uses it."""

    def send(self, frame16: bytes) -> bool:
        """Send a frame; False: the queue is full and the frame is lost."""

    def serve(self, timeout_s: float) -> None:
        """Wait up to timeout_s for frames, give them to the bench, send its answers."""

    def linger(self, end_ns: int | None) -> None:
        """Stay silent until no other member needs the bus, or until end_ns."""

    def close(self) -> None:
        """Leave the bus."""


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


def _open(bus: str, bitrate: int | None, bench: Bench) -> _Bus:
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
    before = {number: signal.signal(number, _stop) for number in (signal.SIGTERM, signal.SIGINT)}
    # the default slack of 50 us on every timeout is a frame on the wire at 1 Mbit/s
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    line: _Bus | None = None
    try:
        line = _open(bus, bitrate, bench)
        gc.collect()
        gc.freeze()
        end_ns = None if duration_s is None else time.monotonic_ns() + round(duration_s * 1e9)
        _tick(line, bench)
        print(f"bench ready on {bus}", file=sys.stderr, flush=True)  # other processes wait for this line
        _loop(line, bench, end_ns)
    except _StopError:
        pass
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # leaving takes a moment and happens once
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if line is not None:
            line.close()
        for number, handler in before.items():
            signal.signal(number, handler)
    return 0


def _tick(line: _Bus, bench: Bench) -> None:
    for frame in bench.tick(time.monotonic_ns()):
        line.send(frame)


def _loop(line: _Bus, bench: Bench, end_ns: int | None) -> None:
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
