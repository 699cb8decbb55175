"""What a crash costs, by the real recorder at 1 kHz: at most 1 s, said, and every file opens after the next start."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor

import pytest

from jtqd.daemon.recording.run_files import part_files
from tests.daemon.recording.crash_table import CASES, NEED_ROOT, Bench
from tests.daemon.recording.recorder_bench import RecorderProcess, cycles_of, put, record_of, session_on

pytestmark = pytest.mark.native

SAID = {
    "killed_recorder": ["repaired"],
    "killed_everything": [],
    "torn_chunk": [],
    "zeros_at_the_end": [],
    "full_disk": ["recording pauses", "recording continues"],
    "full_to_the_last_byte": ["recording fails", "recording continues"],
    "read_only": ["cannot record", "recording continues"],
    "removed_directory": ["was removed"],
    "removed_file": ["was removed"],
    "clock_back": [],
    "clock_forward": [],
}
"""Lines of the recorder that met the case; the next one's about the repair come behind them."""
REPAIRED = {"killed_everything", "torn_chunk", "zeros_at_the_end"}
NOTHING_LOST = {
    "killed_recorder",
    "clock_back",
    "clock_forward",
    "removed_directory",
    "removed_file",
    "full_disk",
}


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """{case: its row, to be waited for}: four processes, because each case mostly waits and starts processes of its own."""
    with ProcessPoolExecutor(4, mp_context=multiprocessing.get_context("fork")) as pool:
        yield {
            name: pool.submit(case, tmp_path_factory.mktemp(name))
            for name, case in CASES.items()
            if name not in NEED_ROOT or not os.geteuid()
        }


@pytest.mark.parametrize("name", CASES)
def test_case(rows, name):
    if name not in rows:
        pytest.skip("needs root to mount a file system")
    row = rows[name].result()
    print(row)
    assert row.cycles > 1000
    assert 0.0 <= row.lost_s <= 1.0
    if name in NOTHING_LOST:
        assert row.lost_s <= 0.01
    assert row.files >= 2, "what was recorded before, and the next start"
    expected = [*SAID[name], *(["repaired"] if name in REPAIRED else [])]
    assert len(row.said) == len(expected), row.said
    for line, words in zip(row.said, expected, strict=True):
        assert words in line
    if "removed" in name:
        assert row.lasted >= 500, "at least a chunk was there to be removed"
    if name in ("torn_chunk", "zeros_at_the_end"):
        assert "unreadable" in row.said[-1]
        assert row.lost >= 400, "the chunk that was on its way"


def test_cases_and_their_lines_agree():
    assert set(CASES) == set(SAID)


def test_repair_leaves_alone_what_is_written_or_not_ours(tmp_path):
    """Beside a living recorder of the same prefix, a foreign `.active` and an empty one of ours."""
    bench = Bench(tmp_path)
    bench.start(run="20260102T030405Z")
    bench.run(0.7)
    living = bench.active()
    (bench.logs / "test-20250102T030405Z-0001.mcap.active").touch()
    foreign = bench.logs / "other-20250102T030405Z-0001.mcap.active"
    foreign.write_bytes(b"\x89MCAP0\r\nnonsense")
    ours = bench.logs / "test-20250102T030406Z-0001.mcap.active"
    ours.write_bytes(b"nonsense")
    second = RecorderProcess(tmp_path / "logs", output=bench.logs, prefix="test")
    second.wait_until_ready()
    for n in range(600):
        put(second.ring, record_of(n))
    second.wait_for(lambda: len(part_files(bench.logs, "test")) == 3)
    second.end()
    assert living.exists()
    assert foreign.read_bytes() == b"\x89MCAP0\r\nnonsense"
    assert ours.read_bytes() == b"nonsense", "there is nothing in it that could be read"
    bench.run(0.7)
    bench.end()
    assert cycles_of(living.with_suffix("")) == list(range(1400))


def test_repair_does_not_delay_the_recording(tmp_path):
    """The first chunk of the new run is on the disk before the repair of a large file begins."""
    session = session_on(tmp_path, run="20250102T030405Z")
    for n in range(20_000):
        session.recording.add(record_of(n))
    session.recording.flush()
    left = tmp_path / "logs" / "test-20250102T030405Z-0001.mcap.active"
    assert left.exists()
    session.parts._file._file.close()  # as after a crash: no summary, no lock
    process = RecorderProcess(tmp_path, run="20260102T030405Z")
    process.wait_for_file()
    assert left.exists()
    for n in range(1200):
        put(process.ring, record_of(n))
    process.wait_for(lambda: not left.exists())
    assert sum(path.stat().st_size for path in process.files("test-2026*.active")) > 40_000
    status, summary, errors = process.end()
    assert (status, summary["written"]) == (0, 1200)
    assert errors == "recorder: test-20250102T030405Z-0001.mcap repaired: 160 chunks kept\n"
    assert cycles_of(left.with_suffix("")) == list(range(20_000))
