"""The snapshot: what the loop writes is what a reader sees, and a reader cannot write."""

import math
import struct
from pathlib import Path

import pytest

from daemon.snapshot import COUNTERS, SIZE, Snapshot, SnapshotError, SnapshotReader

ONE = (1.0, 0.1, 1.1, 1.2, math.nan, 0.9, 0x27, 2, 0, 7)
TWO = (-2.0, 0.2, -2.1, -2.2, -2.3, math.nan, 0x0F, 5, 1, 3)


def test_round_trip(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.848)
    snapshot.write(41, 17, 1_700_000_000_123_456_789, (ONE, TWO))
    for n in range(len(COUNTERS)):
        snapshot.counters[n] = n + 100
    snapshot.errors[0], snapshot.errors[1] = 8.0, 2.0
    view = SnapshotReader(tmp_path / "s").read()
    assert (view.cycle, view.sync_counter, view.sync_realtime_ns) == (41, 17, 1_700_000_000_123_456_789)
    assert view.joints[0][:4] == ONE[:4]
    assert math.isnan(view.joints[0].network_nm)
    assert tuple(view.joints[1])[6:] == (0x0F, 5, 1, 3)
    assert view.counters == {name: n + 100 for n, name in enumerate(COUNTERS)}
    assert view.rmse_nm[0] == 2.0
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
    snapshot.write(1, 1, 2, (ONE, TWO))
    assert snapshot._sequence[0] == 2


def test_the_supervisor_tells_the_loop_what_it_configured(tmp_path: Path) -> None:
    snapshot = Snapshot(tmp_path / "s", 1e-3, 0.5)
    SnapshotReader(tmp_path / "s", supervisor=True).note_configured(2)
    assert snapshot.configured[2] == 1
    with pytest.raises(TypeError):
        SnapshotReader(tmp_path / "s").note_configured(2)


@pytest.mark.parametrize("content", [b"", b"x" * 10, bytes(SIZE), struct.pack("<Q", 1) + bytes(SIZE)])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s"
    path.write_bytes(content)
    with pytest.raises(SnapshotError):
        SnapshotReader(path)
    with pytest.raises(SnapshotError):
        SnapshotReader(tmp_path / "none")
