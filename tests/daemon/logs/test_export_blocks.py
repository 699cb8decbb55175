"""Tables chunk by chunk: columns that change on the way, memory, and what must not be replaced by a table."""

import csv
import os
import struct
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import pytest
from mcap.writer import Writer

from jtqd.daemon.logs.export_command import main
from tests.daemon.logs.campaign_log import regular, write_log
from tests.daemon.logs.log_files import ours
from tests.daemon.logs.test_export import joints


@pytest.fixture
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    ours(path, 120)
    return path


def test_a_topic_whose_columns_change_on_the_way(tmp_path):
    """Sequences of one length in each chunk, of another in the next: one column of text, as in one piece."""
    path, out = tmp_path / "a.mcap", tmp_path / "a.csv"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100)
        writer.start("x", "lib")
        schema = writer.register_schema("a/B", "ros2msg", b"int32[] a\n")
        channel = writer.register_channel("/t", "cdr", schema)
        for n in range(12):
            numbers = range(n, n + 1 + n // 6)
            data = b"\0\1\0\0" + struct.pack(f"<I{len(numbers)}i", len(numbers), *numbers)
            writer.add_message(channel, n, data, n, n)
        writer.finish()
    assert main(["csv", str(path), "--topic", "/t", "--out", str(out)]) == 0
    rows = list(csv.DictReader(out.open()))
    assert [row["a"] for row in rows] == [*map(str, range(6)), *(f"{n} {n + 1}" for n in range(6, 12))]


def test_a_table_takes_no_more_memory_than_some_chunks(tmp_path):
    """Ten times the log, the same memory (bytes that Python and numpy hold at most while it is written)."""
    peaks = []
    for count in (4_000, 40_000):
        log = write_log(tmp_path / f"{count}.mcap", regular(count, joints))
        tracemalloc.start()
        assert main(["csv", str(log), "--out", str(tmp_path / "a.csv"), "--all-cycles"]) == 0
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    print(peaks)
    assert peaks[1] < 1.5 * peaks[0]


def test_what_is_no_file_is_written_to_and_never_replaced(log, tmp_path, capsys):
    """A pipe, as /dev/stdout may be; a link; the log itself."""
    pipe, link, target = tmp_path / "pipe", tmp_path / "link", tmp_path / "target.csv"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as pool:
        read = pool.submit(pipe.read_bytes)
        assert main(["csv", str(log), "--out", str(pipe), "--all-cycles"]) == 0
        lines = read.result(20).count(b"\n")
    assert lines == 121
    assert pipe.is_fifo()
    link.symlink_to(target)
    assert main(["csv", str(log), "--out", str(link), "--all-cycles"]) == 0
    assert link.is_symlink()
    assert target.read_bytes().count(b"\n") == lines
    assert sorted(each.name for each in tmp_path.iterdir()) == ["link", "pipe", "target.csv"]
    capsys.readouterr()
    assert main(["csv", str(log), "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"jtq export: {tmp_path}: Is a directory\n"
    assert main(["csv", str(log), "--out", str(tmp_path / "no" / "a.csv")]) == 1
    assert capsys.readouterr().err == f"jtq export: {tmp_path}/no/a.csv: No such file or directory\n"
    before = log.read_bytes()
    for wrong in (["--out", str(log)], ["--out", "a", "--start", "nan"], ["--out", "a", "--end", "1e300"]):
        with pytest.raises(SystemExit) as stop:
            main(["csv", str(log), *wrong])
        assert stop.value.code == 2
    assert log.read_bytes() == before
