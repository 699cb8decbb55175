"""Motions on a bus as a campaign plays them: real jtqd, real bench, real time. Outcomes are checked, not lateness.

The times of the supervision are wide here, because a test machine may stand still for longer than a bench may.
"""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest
import yaml

from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import FRAME
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.sysid.motion.setpoints import Limits, MotionError, Timing
from jtqd.sysid.motion.shell import play
from tests.shipped_bench import shipped_bench
from tests.sysid.motion.lock_step import plateau

pytestmark = pytest.mark.native

LIMITS = Limits(current_a=20.0, velocity_rad_s=3.3, torque_nm=100.0, travel_rad=60.0, temperature_c=70.0)
PATIENT = Timing(
    sync_lost_s=1.0, late_s=1.0, stale_cycles=500, heartbeats_missing=20, drive_timeout_s=1.5, ready_s=10.0
)


def patient_config(directory: Path) -> Path:
    """The shipped bench without networks, whose nodes wait 1.5 s for jtqd before they leave operational."""
    content = shipped_bench()
    content["nodes"]["heartbeat_ms"] = 500
    content["estimator"] |= {"method": "tob", "shadow": []}
    path = directory / "bench.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="module")
def bus(tmp_path_factory):
    """The bench and jtqd as processes of their own; jtqd publishes."""
    directory = tmp_path_factory.mktemp("motion")
    address = f"unix:{directory / 'bus'}"
    bench = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", address, "--seed", "1"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert bench.stderr is not None
    assert "ready" in bench.stderr.readline()
    jtqd = subprocess.Popen(
        [
            *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", address, "--record", "none", "--json"),
            *("--config", str(patient_config(directory))),
        ],
        env={**os.environ, "RUNTIME_DIRECTORY": str(directory)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    socket = open_frame_socket(address, [exact(0x1A0)])
    deadline = time.monotonic() + 30
    while not socket.wait(0.1):
        assert jtqd.poll() is None, jtqd.stderr
        assert time.monotonic() < deadline
    socket.close()
    yield address
    jtqd.terminate()
    out, err = jtqd.communicate(timeout=20)
    bench.terminate()
    bench.wait(10)
    assert jtqd.returncode == 0, err
    assert json.loads(out)["counters"]["foreign_sync"] == 0


class Listener:
    """Collects the frames of some COB-IDs; a thread reads, because a full queue loses the last frames."""

    def __init__(self, bus: str, *identifiers: int) -> None:
        self.socket = open_frame_socket(bus, [exact(can_id) for can_id in identifiers])
        self._found: queue.SimpleQueue[tuple[int, bytes]] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with suppress(BusError):  # the bus ends
            while True:
                self.socket.wait(1.0)
                for n in range(self.socket.receive()):
                    can_id, length, data = FRAME.unpack_from(self.socket.frames, 16 * n)
                    self._found.put((can_id, data[:length]))

    def frames(self) -> list[tuple[int, bytes]]:
        """Frames since the last call."""
        time.sleep(0.3)
        return [self._found.get() for _ in range(self._found.qsize())]


def test_a_motion_is_played_and_leaves_both_drives_off_and_unwatched(bus):
    """The drives may turn by themselves before (demo motion). What they measured follows the plan; then all is quiet."""
    listener = Listener(bus, 0x281, 0x301, 0x202, 0x081, 0x082)
    progress: list[tuple[float, float]] = []
    result = play(
        bus,
        plateau(1.0, 2.0, hold_ms=1400),
        LIMITS,
        on_progress=lambda *s: progress.append(s),
        timing=PATIENT,
    )
    assert result.reason == ""
    assert result == ("done", "", 2.0)
    assert progress[0] == (0.0, 2.0)
    assert [played for played, _ in progress] == sorted(played for played, _ in progress)
    frames = listener.frames()
    speeds = [int.from_bytes(data[:4], "little", signed=True) for can_id, data in frames if can_id == 0x281]
    assert max(speeds) == pytest.approx(1043038, rel=0.15), "1 rad/s of the joint"
    assert speeds[-1] == pytest.approx(0, abs=0.02 * 1043038)
    time.sleep(1.7)  # beyond 1016h:2: nobody watches any more
    later = listener.frames()
    assert not [each for each in later if each[0] != 0x281], "no EMCY, no RPDO"
    states = {int.from_bytes(data[6:8], "little") & 0x6F for can_id, data in later if can_id == 0x281}
    assert states == {0x40}, "switch on disabled, and operational"


def test_a_limit_stops_it_and_the_next_motion_begins(bus):
    slow = Limits(current_a=9.0, velocity_rad_s=3.3, torque_nm=8.0, travel_rad=60.0)
    result = play(bus, plateau(0.5, 3.0, hold_ms=2000), slow, timing=PATIENT)
    assert result.status == "stopped"
    assert "torque at the sensor" in result.reason
    assert "limit 8 Nm" in result.reason
    assert result.played_s < 1.0
    assert play(bus, plateau(-0.5, 1.0, hold_ms=50, joint=2), LIMITS, timing=PATIENT).status == "done"


SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def replaced_handlers(handler: Callable[[int, object], None]) -> Iterator[None]:
    saved = {each: signal.signal(each, handler) for each in SIGNALS}
    try:
        yield
    finally:
        for each, old in saved.items():
            signal.signal(each, old)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_it_and_the_handlers_are_back(bus, number):
    caught: list[int] = []

    def before(
        caught_number: int, frame: object
    ) -> None:  # a signal that comes after the motion must not end pytest
        caught.append(caught_number)

    with replaced_handlers(before):
        timer = threading.Timer(1.5, os.kill, (os.getpid(), number))
        timer.start()
        result = play(bus, plateau(1.0, 2.0, hold_ms=6000), LIMITS, timing=PATIENT)
        timer.join()
        assert [signal.getsignal(each) for each in SIGNALS] == [before, before]
    assert not caught
    assert (result.status, result.reason) == ("stopped", number.name)
    assert 0.0 <= result.played_s < 6.0


def test_what_cannot_be_begun_is_refused_in_one_line(bus):
    with pytest.raises(MotionError, match=r"plan: velocity of joint 1 3.303 rad/s at .* limit 3\.3 rad/s"):
        play(bus, plateau(4.5, 1.0, ramp_ms=600), LIMITS)
    with pytest.raises(MotionError, match="nocan7"):
        play("nocan7", plateau(1.0, 1.0), LIMITS)
    with pytest.raises(MotionError, match="no bus at unix:/nonexistent"):
        play("unix:/nonexistent", plateau(1.0, 1.0), LIMITS)


def test_a_second_commander_is_refused_before_it_touches_anything(bus):
    """Both in this process: the second one is refused while the first one plays on to its end."""
    results: list[object] = []
    first = threading.Thread(
        target=lambda: results.append(play(bus, plateau(0.8, 1.0, hold_ms=1500), LIMITS, timing=PATIENT))
    )
    first.start()
    with closing(open_frame_socket(bus, [exact(0x301)])) as commands:
        commands.wait(20.0)
    with pytest.raises(MotionError, match=r"another commander is on the bus \(node 21h\)"):
        play(bus, plateau(1.0, 1.0), LIMITS, timing=PATIENT)
    first.join()
    assert results == [("done", "", 2.1)]


def test_a_progress_callback_that_raises_leaves_both_drives_off(bus):
    def broken(played_s: float, total_s: float) -> None:
        if played_s > 0.5:
            raise RuntimeError("screen on fire")

    listener = Listener(bus, 0x281)
    with pytest.raises(RuntimeError, match="screen on fire"):
        play(bus, plateau(1.0, 2.0, hold_ms=3000), LIMITS, on_progress=broken, timing=PATIENT)
    listener.frames()
    time.sleep(0.1)
    last = listener.frames()[-1][1]
    assert int.from_bytes(last[6:8], "little") & 0x6F == 0x40
    assert int.from_bytes(last[:4], "little", signed=True) == pytest.approx(0, abs=20000)


def test_without_jtqd_there_is_no_sync_and_no_motion(tmp_path):
    bench = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", f"unix:{tmp_path / 'bus'}"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert bench.stderr is not None
    assert "ready" in bench.stderr.readline()
    try:
        with pytest.raises(MotionError, match=r"no SYNC on unix:.*: jtqd must run on this bus"):
            play(f"unix:{tmp_path / 'bus'}", plateau(1.0, 1.0), LIMITS)
    finally:
        bench.terminate()
        bench.wait(10)
