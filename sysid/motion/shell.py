"""Play set-points on a bus: socket, clock and signals around `commander.Commander`.

One wake-up per cycle: it sleeps until the frames of the cycle should have crossed the wire, takes them by one system call,
and sends one frame. It sleeps in select when none came, and never polls a clock.
"""

from __future__ import annotations

import ctypes
import gc
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from types import FrameType
from typing import Final

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.drive import DriveProfile
from jtqd.drivers.frame import FRAME, FRAME_SIZE
from jtqd.drivers.frame_socket import CAPACITY, BusError, FrameSocket, open_frame_socket
from jtqd.drivers.sensor import SensorProfile
from jtqd.sysid.motion.commander import Commander, Frame
from jtqd.sysid.motion.drives import BenchSetup
from jtqd.sysid.motion.setpoints import (
    Limits,
    MotionError,
    MotionResult,
    OutOfPlaceError,
    Setpoints,
    Surroundings,
    Timing,
    check_setpoints,
)

Progress = Callable[[float, float], None]
"""Called with (played, total) seconds a few times per second, between two cycles: it must return at once."""

DRIVES: Final = (DriveProfile(1), DriveProfile(2))
SENSOR: Final = SensorProfile(3)
PROGRESS_NS: Final = 250_000_000
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


def play(
    bus: str,
    setpoints: Setpoints,
    limits: Limits,
    *,
    on_progress: Progress | None = None,
    drives: Sequence[DriveProfile] = DRIVES,
    sensor: SensorProfile | None = SENSOR,
    timing: Timing | None = None,
    around: Surroundings | None = None,
) -> MotionResult:
    """Move joints along `setpoints`, within `limits`, on a bus on which jtqd runs; all are disabled afterwards.

    SIGINT and SIGTERM stop the joints, a second one makes them brake at once. drives: joints 1, 2, ..; those that the
    set-points do not name are held. Without `sensor` the torque is not supervised. Raises MotionError (OutOfPlaceError),
    one line, when the motion was refused and nothing has moved.
    """
    timing = timing or Timing()
    check_setpoints(setpoints, limits)
    with stop_signals() as taken, _on_time():
        try:
            setup = BenchSetup(bus, drives, sensor, timing)
        except BusError as refused:
            raise MotionError(str(refused)) from None
        with closing(setup):
            units = setup.prepare(setpoints, limits)
            error = left = ""
            beating = False
            try:
                commander = Commander(
                    setpoints, limits, *units, now_ns=time.monotonic_ns(), timing=timing, around=around
                )
                beating = True
                error = _run(bus, commander, taken, on_progress)
                beating = not commander.silent
            finally:
                left = setup.release(beating=beating)
    if commander.refusal is not None:
        refusal = "; ".join(reason for reason in (commander.refusal, left) if reason)
        if commander.out_of_place is not None and not left:
            raise OutOfPlaceError(refusal, commander.out_of_place)
        raise MotionError(refusal)
    result = commander.result
    reasons = [reason for reason in (result.reason, error, left) if reason]
    return result._replace(status="stopped" if reasons else "done", reason="; ".join(reasons))


def _run(bus: str, commander: Commander, taken: list[str], on_progress: Progress | None) -> str:
    """Run the commander to its end; return "", or why the bus failed. Raises MotionError when it could not be opened."""
    try:
        socket = open_frame_socket(bus, [exact(can_id) for can_id in commander.inputs.identifiers])
    except BusError as refused:
        raise MotionError(str(refused)) from None
    with closing(socket):
        try:
            _loop(socket, commander, taken, on_progress)
        except BusError as error:
            timeout = commander.timing.drive_timeout_s
            return f"{error}; the drives stop by themselves {timeout:g} s after our last heartbeat (1016h:2)"
    return ""


def _loop(socket: FrameSocket, commander: Commander, taken: list[str], on_progress: Progress | None) -> None:
    monotonic_ns, sleep = time.monotonic_ns, time.sleep
    asked = 0
    progress_ns = monotonic_ns()
    while not commander.over:
        pause_ns = commander.wake_ns - monotonic_ns()
        if pause_ns > 0:
            sleep(pause_ns * 1e-9)
        frames = _take(socket)
        if not frames:
            socket.wait((commander.due_ns - monotonic_ns()) * 1e-9)
            frames = _take(socket)
        while asked < len(taken):
            commander.stop(taken[asked])
            asked += 1
        now_ns = monotonic_ns()
        for frame in commander.on_frames(frames, now_ns):
            commander.frame_refused(not socket.send(frame))
        if on_progress is not None and now_ns >= progress_ns:
            progress_ns = now_ns + PROGRESS_NS
            on_progress(commander.played_s, commander.total_s)


def _take(socket: FrameSocket) -> list[Frame]:
    """Return all frames that have arrived, their stamps (CLOCK_REALTIME) on CLOCK_MONOTONIC.

    A frame waits for a millisecond at most: only a clock that is stepped in that moment makes one wrong, which looks like
    lateness.
    """
    frames: list[Frame] = []
    count = CAPACITY
    while count == CAPACITY:
        count = socket.receive()
        now_ns = time.monotonic_ns()
        offset_ns = now_ns - time.time_ns()
        content = FRAME.iter_unpack(bytes(socket.frames[: count * FRAME_SIZE]))
        for (can_id, length, data), stamp_ns in zip(content, socket.stamps_ns, strict=False):
            received_ns = min(stamp_ns + offset_ns, now_ns) if stamp_ns else now_ns
            frames.append((can_id, data[:length], received_ns))
    return frames


@contextmanager
def stop_signals() -> Iterator[list[str]]:
    """Collect SIGINT and SIGTERM by name in a list, where this is the main thread."""
    taken: list[str] = []

    def take(number: int, frame: FrameType | None) -> None:
        taken.append(signal.Signals(number).name)

    if threading.current_thread() is not threading.main_thread():
        yield taken
        return
    before = {number: signal.signal(number, take) for number in _SIGNALS}
    try:
        yield taken
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _on_time() -> Iterator[None]:
    """Switch garbage collection and the timers' usual slack of 50 us off while this lasts."""
    prctl = ctypes.CDLL(None).prctl
    slack = prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    try:
        yield
    finally:
        prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack), 0, 0, 0)
        if collecting:
            gc.enable()
