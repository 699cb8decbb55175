"""A motion on real SocketCAN with exact time in the bench kernel: nothing is late, a cycle carries one more frame."""

import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from jtqd.drivers.frame import worst_case_bits
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.motion.shell import play
from tests.paths import ROOT
from tests.sysid.motion.lock_step import plateau

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
LIMITS = Limits(current_a=9.0, velocity_rad_s=3.3, torque_nm=100.0, travel_rad=60.0, temperature_c=70.0)
EXACT = bool(os.environ.get("JTQD_IN_BENCH_KERNEL"))


@pytest.fixture
def jtqd(tmp_path):
    """The bench and jtqd, which publishes."""
    bench = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", INTERFACE, "--seed", "1"],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert bench.stderr is not None
    assert "ready" in bench.stderr.readline()
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", INTERFACE, "--record", "none", "--json"],
        env={**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    subprocess.run(
        ["candump", "-n", "1", f"{INTERFACE},1A0:7FF"], stdout=subprocess.DEVNULL, timeout=120, check=True
    )
    yield process
    process.terminate()
    process.communicate(timeout=60)
    bench.terminate()
    bench.wait(20)


class Dump:
    """candump in the background; `frames()` ends it: (time in s, COB-ID, data)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open(path, "w") as file:
            self.process = subprocess.Popen(["candump", "-L", f"{INTERFACE},0:0"], stdout=file)

    def frames(self) -> list[tuple[float, int, bytes]]:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20)
        found = []
        for line in self.path.read_text().splitlines():
            stamp, _, frame = line.split()
            can_id, _, data = frame.partition("#")
            found.append((float(stamp.strip("()")), int(can_id, 16), bytes.fromhex(data)))
        return found


@pytest.mark.socketcan
def test_a_motion_in_exact_time(tmp_path, jtqd):
    dump = Dump(tmp_path / "dump.log")
    result = play(INTERFACE, plateau(1.0, 2.0, hold_ms=900), LIMITS)
    frames = dump.frames()
    assert result == ("done", "", 1.5)
    assert jtqd.poll() is None
    rpdos = [n for n, (_, can_id, _) in enumerate(frames) if can_id in (0x201, 0x202, 0x301, 0x302)]
    first, last = rpdos[0], rpdos[-1]
    moving = frames[first : last + 1]
    by_cycle: list[Counter[int]] = []
    delays = []
    previous = sync_s = 0.0
    for time_s, can_id, _ in moving:
        if can_id == 0x080:
            by_cycle.append(Counter())
            previous, sync_s = sync_s, time_s
            if EXACT and previous:
                assert time_s - previous == pytest.approx(1e-3, abs=20e-6), "SYNC is not disturbed"
        elif by_cycle:
            by_cycle[-1][can_id] += 1
            if can_id in (0x201, 0x202, 0x301, 0x302):
                delays.append(time_s - sync_s)
    commands = [sum(cycle[i] for i in (0x201, 0x202, 0x301, 0x302)) for cycle in by_cycle]
    assert max(commands) == 1
    if EXACT:
        assert commands.count(0) <= 3, "from enabling to disabling, without a gap"
        assert all(0.69e-3 < delay < 0.8e-3 for delay in delays), (min(delays), max(delays))
        inputs = [cycle[i] for cycle in by_cycle[:-1] for i in (0x181, 0x182, 0x281, 0x282, 0x183, 0x1A0)]
        assert set(inputs) == {1}
    cyclic = [0x080, 0x181, 0x182, 0x281, 0x282, 0x183, 0x1A0, 0x201]
    lengths = {can_id: len(data) for _, can_id, data in moving if can_id in cyclic}
    assert sum(worst_case_bits(length) for length in lengths.values()) <= 950, "95 % of 1 Mbit/s"


PLAY = """
from jtqd.sysid.motion.setpoints import Limits
from jtqd.sysid.motion.shell import play
from tests.sysid.motion.lock_step import plateau
play({interface!r}, plateau(1.0, 2.0, hold_ms=60_000), Limits(9.0, 3.3, 100.0, 100.0))
"""


@pytest.mark.socketcan
@pytest.mark.usefixtures("jtqd")
def test_a_commander_that_is_killed_is_noticed_by_both_drives(tmp_path):
    """1016h:2: each drive sends EMCY 8130h and stands, 300 ms after the last heartbeat of node 21h."""
    root = ROOT
    commander = subprocess.Popen([sys.executable, "-c", PLAY.format(interface=INTERFACE)], cwd=root)
    subprocess.run(
        ["candump", "-n", "300", f"{INTERFACE},301:7FF"], stdout=subprocess.DEVNULL, timeout=120, check=True
    )
    dump = Dump(tmp_path / "dump.log")
    subprocess.run(
        ["candump", "-n", "1", f"{INTERFACE},721:7FF"], stdout=subprocess.DEVNULL, timeout=120, check=True
    )
    commander.kill()
    commander.wait(20)
    subprocess.run(
        ["candump", "-n", "4", f"{INTERFACE},701:7FF"], stdout=subprocess.DEVNULL, timeout=120, check=True
    )
    frames = dump.frames()
    beat_s = max(time_s for time_s, can_id, _ in frames if can_id == 0x721)
    lost = [
        (time_s - beat_s, can_id)
        for time_s, can_id, data in frames
        if can_id in (0x081, 0x082) and data[:2] == b"\x30\x81"
    ]
    assert sorted(can_id for _, can_id in lost) == [0x081, 0x082]
    if EXACT:
        assert all(delay == pytest.approx(0.3, abs=2e-3) for delay, _ in lost), lost
    speeds = [
        int.from_bytes(data[:4], "little", signed=True) for _, can_id, data in frames if can_id == 0x281
    ]
    assert max(map(abs, speeds)) > 500_000
    # the drive leaves operational with its fault (1029h), so the rest is seen by its heartbeat
    states = [data[0] for time_s, can_id, data in frames if can_id == 0x701 and time_s > beat_s + 0.3]
    assert 0x7F in states
