"""The snapshot: what the loop writes is what a reader sees, and a reader cannot write."""

import math
import struct
import sys
import threading
import time
from pathlib import Path

import pytest

from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.runtime_dir import SharedMemoryError
from jtqd.daemon.shared.snapshot import INPUT, SIZE, Snapshot, SnapshotReader
from jtqd.estimator.status import STALE
from tests.daemon.loop.cycle_helpers import frame, inputs, make, turn
from tests.daemon.snapshots import EstimateWriter

ONE = (1.0, 0.1, 1.1, 1.2, math.nan, 0.9, 0x27, 2, 0, 7, 0, 0.8, 1.25, 40.0, math.nan, 0, 0)
TWO = (-2.0, 0.2, -2.1, -2.2, -2.3, math.nan, 0x0F, 5, 1, 0x2403, 0x104, math.nan, 5.0, math.nan, 0.3, 3, 0x4)


def test_round_trip(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.848)
    estimate = EstimateWriter(snapshot)
    estimate.write(41, 17, 1_700_000_000_123_456_789, (ONE, TWO))
    for n in range(len(COUNTERS)):
        snapshot.counters[n] = n + 100
    snapshot.errors[0], snapshot.errors[1], snapshot.errors[2] = 8.0, 18.0, 2.0
    view = SnapshotReader(tmp_path / "s").read()
    assert (view.cycle, view.sync_counter, view.sync_realtime_ns) == (41, 17, 1_700_000_000_123_456_789)
    assert view.joints[0][:4] == ONE[:4]
    assert math.isnan(view.joints[0].network_nm)
    assert tuple(view.joints[1])[6:11] == (0x0F, 5, 1, 0x2403, 0x104)
    assert view.joints[0][11:14] == (0.8, 1.25, 40.0)
    assert math.isnan(view.joints[0].contact_nm)
    assert (view.joints[1].age_ms, view.joints[1].contact_nm) == (5.0, 0.3)
    assert view.counters == {name: n + 100 for n, name in enumerate(COUNTERS)}
    assert (view.rmse_nm[0], view.rmse_now_nm[0]) == (2.0, 3.0)
    assert math.isnan(view.rmse_nm[1])
    assert (view.period_s, view.worst_load) == (1e-3, 0.848)


def test_quantiles_are_upper_edges_of_their_bins(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    reader = SnapshotReader(tmp_path / "s")
    assert math.isnan(reader.work_us(0.5)[0])
    snapshot.work[10] += 99  # 40..44 us
    snapshot.work[100] += 1  # 400..404 us
    snapshot.counters[COUNTERS.index("work_max_ns")] = 401_234
    assert reader.work_us(0.5, 0.99, 1.0) == [44.0, 44.0, 401.234]


def test_an_odd_sequence_is_not_taken_for_a_whole_reading(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    estimate = EstimateWriter(snapshot)
    estimate.write(1, 1, 2, (ONE, TWO))
    assert snapshot.sequence[0] == 2


def test_the_supervisor_tells_the_loop_what_it_configured(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    SnapshotReader(tmp_path / "s", supervisor=True).note_configured(2, 7)
    assert (snapshot.configured[2], snapshot.configured_for[2]) == (1, 7)
    with pytest.raises(TypeError):
        SnapshotReader(tmp_path / "s").note_configured(2, 7)


@pytest.mark.parametrize("content", [b"", b"x" * 10, bytes(SIZE), struct.pack("<Q", 1) + bytes(SIZE)])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s"
    path.write_bytes(content)
    with pytest.raises(SharedMemoryError):
        SnapshotReader(path)
    with pytest.raises(SharedMemoryError):
        SnapshotReader(tmp_path / "none")


def test_inputs_and_since_when_a_status_holds(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    estimate = EstimateWriter(snapshot)
    assert SnapshotReader(tmp_path / "s").read().sync_monotonic_ns == 0
    measured = ((3.2, 100.0, -5.0, 1.0, 0.9, 31.0, "more", "of the sample"), (math.nan,) * 12)
    estimate.write(8, 8, 1, (ONE, TWO), sync_monotonic_ns=123, measured=measured)  # type: ignore[arg-type]
    estimate.write(16, 16, 2, (ONE, TWO), sync_monotonic_ns=456, measured=measured)  # type: ignore[arg-type]
    estimate.write(24, 24, 3, (ONE, ONE), sync_monotonic_ns=789, measured=measured)  # type: ignore[arg-type]
    view = SnapshotReader(tmp_path / "s").read()
    assert view.sync_monotonic_ns == 789
    assert view.status_since == (8, 24)
    assert tuple(view.measured[0]) == (3.2, 100.0, -5.0, 1.0, 0.9, 31.0)
    assert math.isnan(view.measured[1].current_a)


def test_only_user_and_group_may_read_and_only_the_user_may_write(tmp_path: Path) -> None:
    Snapshot(tmp_path / "s", 1e-3, 0.5)
    assert (tmp_path / "s").stat().st_mode & 0o777 == 0o640


def test_the_loop_tells_the_age_of_each_input_its_nodes_and_its_statuses(tmp_path: Path) -> None:
    """Drive 2's TPDO2 comes for 40 cycles and then no more; drive 1's heartbeat comes once."""

    def script(n: int) -> list[bytes]:
        frames = [each for each in inputs() if n <= 40 or each[:2] != b"\x82\x02"]
        return [*frames, frame(0x701, b"\x05")] if n == 30 else frames

    cycle, _, _ = make(tmp_path, script)
    cycle.grid.period_ns = 1_000_000_000_000  # however slow the machine: no estimate is late for its cycle
    turn(cycle, 81)
    view = SnapshotReader(tmp_path / "snapshot").read()
    assert view.cycle == 80
    ages = [view.sync_monotonic_ns - each.used_ns for each in view.inputs]
    assert [age == 0 for age in ages] == [True, True, True, False, True]
    assert view.inputs[3].used_ns > 0
    assert [each.lost + each.missed > 0 for each in view.inputs] == [False, False, False, True, False]
    assert all(0 <= each.delay_ns < 1000 for each in view.inputs), "the script's stamps are ns apart"
    heard = {node: stamp for node, stamp in enumerate(view.node_heard_ns) if stamp}
    assert heard.keys() == {1}
    assert 0 < view.sync_realtime_ns - heard[1] < 60_000_000_000
    assert sum(view.status_cycles[0]) == sum(view.status_cycles[1]) == 81
    assert view.status_cycles[1][STALE] == 41
    assert view.status_cycles[0][STALE] == 0
    assert view.joints[1].status == STALE
    assert view.status_since[1] in (40, 48), "seen every 8th cycle"
    bits = view.counters["bits_worst_case"]
    assert bits == 40 * (65 + 135 + 4 * 135 + 105) + 41 * (65 + 135 + 3 * 135 + 105), "up to the same cycle"


@pytest.mark.native
def test_a_reading_is_of_one_moment_while_the_loop_writes(tmp_path: Path) -> None:
    """Counters, inputs and estimate of the same cycle, however a writer in another thread interrupts the reader."""
    snapshot, bits = Snapshot(tmp_path / "s", 1e-3, 0.5), COUNTERS.index("bits_worst_case")
    estimate = EstimateWriter(snapshot)
    reader, stop = SnapshotReader(tmp_path / "s"), threading.Event()

    def write() -> None:
        n = 0
        while not stop.is_set():
            n += 1
            estimate.begin()
            snapshot.counters[bits] = n
            INPUT.pack_into(snapshot.inputs, 0, n, *(1,) * 11)
            estimate.write(n, 1, n, (ONE, TWO), sync_monotonic_ns=n)
            time.sleep(1e-3)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    writer = threading.Thread(target=write)
    writer.start()
    try:
        while reader.read().cycle < 10:
            assert writer.is_alive()
        for _ in range(2000):
            view = reader.read()
            assert (
                view.cycle
                == view.sync_monotonic_ns
                == view.counters["bits_worst_case"]
                == view.inputs[0].used_ns
            )
    finally:
        stop.set()
        writer.join()
        sys.setswitchinterval(before)


@pytest.mark.native
def test_a_reader_waits_for_a_loop_that_was_preempted_in_its_write(tmp_path: Path) -> None:
    snapshot, bits = Snapshot(tmp_path / "s", 1e-3, 0.5), COUNTERS.index("bits_worst_case")
    estimate = EstimateWriter(snapshot)
    estimate.write(1, 1, 1, (ONE, TWO))
    estimate.begin()
    snapshot.counters[bits] = 2
    rest = threading.Timer(0.005, estimate.write, (2, 2, 2, (ONE, TWO)))
    rest.start()
    view = SnapshotReader(tmp_path / "s").read()
    rest.join()
    assert (view.cycle, view.counters["bits_worst_case"]) == (2, 2)


def test_a_loop_that_stays_in_its_write_gives_no_view_of_two_moments(tmp_path: Path) -> None:
    """It died between counters and estimate: what was read before is as old as it says, a new reader has nothing."""
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    estimate = EstimateWriter(snapshot)
    estimate.write(7, 1, 1, (ONE, TWO))
    reader = SnapshotReader(tmp_path / "s")
    whole = reader.read()
    estimate.begin()
    snapshot.counters[COUNTERS.index("cycles")] = 15
    assert reader.read() == whole
    assert (whole.cycle, whole.counters["cycles"], reader.count("cycles")) == (7, 0, 15)
    with pytest.raises(SharedMemoryError, match="in one write for 1 s"):
        SnapshotReader(tmp_path / "s").read()
    estimate.write(15, 1, 1, (ONE, TWO))
    view = reader.read()
    assert (view.cycle, view.counters["cycles"]) == (15, 15)
