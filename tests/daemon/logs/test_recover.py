"""Recovery of damaged logs: named cases, each with what must still be there, and random damage with fixed seeds."""

import io
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time
from collections import Counter

import pytest
from mcap.reader import make_reader

from jtqd.daemon.logs.recover import RecoverError, main, recover
from tests.daemon.logs.log_files import ATTACHMENTS, by_index, foreign, in_order, logger, ours, record_starts
from tests.paths import GOLDEN, ROOT

CHUNK, INDEX, DATA_END, ATTACHMENT, SCHEMA = 0x06, 0x07, 0x0F, 0x09, 0x03


@pytest.fixture(autouse=True)
def unsynced(monkeypatch):
    """Nothing here pulls a plug: waiting for the disk is most of the time."""
    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, lambda _: None)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A whole log of 120 cycles in 6 spans of 4 chunks (the last of 3), and the offset of every record in it."""
    data = ours(tmp_path_factory.mktemp("log") / "whole.mcap")
    return data, record_starts(data)


def starts_of(log, opcode):
    data, starts = log
    return [(at, end) for at, end in zip(starts, starts[1:]) if data[at] == opcode and end <= len(data) - 8]  # noqa: B905, RUF007


def spoiled(log, *chunks):
    """The log with these of its chunks damaged, under its own footer."""
    data = bytearray(log[0])
    for number in chunks or range(len(starts_of(log, CHUNK))):
        data[starts_of(log, CHUNK)[number][1] - 30] ^= 0x10
    return bytes(data)


def repaired(path, data):
    """Recover these bytes; both of the library's readers must then get every message without an error."""
    path.write_bytes(data)
    result = recover(path)
    now = result.path.read_bytes()
    assert by_index(now) == in_order(now) == (result.messages, None)
    again = recover(result.path)
    assert (again.changed, again.lossy, again.messages) == (False, False, result.messages)
    assert result.path.read_bytes() == now
    return result, now


def contents(data):
    """Topic, time and bytes of every message, in order, as the library reads them."""
    messages = make_reader(io.BytesIO(data)).iter_messages(log_time_order=False)
    return [(channel.topic, message.log_time, message.data) for _, channel, message in messages]


def cycles_of(data):
    """Numbers of the cycles on each of their topics, as the library reads them."""
    found = {topic: [] for topic in ("/joint/1/state", "/joint/2/state", "/can/frames")}
    for _, channel, message in make_reader(io.BytesIO(data)).iter_messages(list(found), log_time_order=False):
        found[channel.topic].append(message.sequence)
    return list(found.values())


def test_whole_file_is_not_touched(log, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(log[0])
    os.utime(path, ns=(1, 1))
    result = recover(path)
    assert (result.changed, result.renamed, result.lossy) == (False, False, False)
    assert (result.messages, result.chunks, result.attachments) == (by_index(log[0])[0], 23, 2)
    assert path.read_bytes() == log[0]
    assert path.stat().st_mtime_ns == 1


def test_whole_file_with_the_name_of_an_active_one_is_renamed_only(log, tmp_path):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0])
    result = recover(path)
    assert (result.changed, result.renamed, result.lossy) == (False, True, False)
    assert result.path == tmp_path / "a.mcap"
    assert result.path.read_bytes() == log[0]
    assert not path.exists()


def test_killed_between_two_chunks_loses_nothing(log, tmp_path):
    data_end = starts_of(log, DATA_END)[0][0]
    result, now = repaired(tmp_path / "a.mcap.active", log[0][:data_end])
    assert not result.lossy
    assert result.messages == by_index(log[0])[0]
    assert now[:data_end] == log[0][:data_end]
    attached = make_reader(open(result.path, "rb")).iter_attachments()  # noqa: SIM115
    assert [(a.name, a.data) for a in attached] == [(a.name, a.data) for a in ATTACHMENTS]


def test_spans_of_half_a_second_are_whole_without_a_summary(tmp_path):
    data = ours(tmp_path / "whole.mcap", count=1200, chunk_ns=500_000_000)
    data_end = starts_of((data, record_starts(data)), DATA_END)[0][0]
    result, now = repaired(tmp_path / "a.mcap.active", data[:data_end])
    assert (result.lossy, result.chunks) == (False, 3 * 4)
    assert cycles_of(now) == [list(range(100, 1300))] * 3


@pytest.mark.parametrize("chunk", [-3, -2, -1], ids=["joint 1", "joint 2", "frames"])
def test_torn_last_span_costs_that_span_and_says_its_time(log, tmp_path, chunk):
    """Spans of 21 cycles; the last one, of 15 cycles, torn within one of its chunks: no joint ends later than another."""
    chunks = starts_of(log, CHUNK)
    at, end = chunks[chunk]
    begin = chunks[-3][0]
    result, now = repaired(tmp_path / "a.mcap.active", log[0][: (at + end) // 2])
    assert result.lossy
    assert (result.chunks, result.lost_chunks, result.lost_bytes) == (20, 4 + chunk, (at + end) // 2 - begin)
    assert by_index(log[0])[0] - result.messages == 3 * 15
    assert result.lost_s == pytest.approx(0.015, abs=0.001)
    assert now[:begin] == log[0][:begin]
    assert cycles_of(now) == [list(range(100, 205))] * 3


@pytest.mark.parametrize("chunk", [-2, -1])
def test_killed_between_the_chunks_of_a_span(log, tmp_path, chunk):
    """Every record is whole, but not every joint is there."""
    begin, at = starts_of(log, CHUNK)[-3][0], starts_of(log, CHUNK)[chunk][0]
    result, now = repaired(tmp_path / "a.mcap.active", log[0][:at])
    assert (result.lossy, result.chunks, result.lost_bytes) == (True, 20, at - begin)
    assert result.lost_s == pytest.approx(0.015, abs=0.001)
    assert cycles_of(now) == [list(range(100, 205))] * 3


def test_torn_message_index_is_made_anew(log, tmp_path):
    data_end = starts_of(log, DATA_END)[0][0]
    last_index = starts_of(log, INDEX)[-1][0]
    result, now = repaired(tmp_path / "a.mcap.active", log[0][: last_index + 20])
    assert not result.lossy
    assert result.messages == by_index(log[0])[0]
    assert now[:last_index] == log[0][:last_index]
    assert len(now[:data_end]) == data_end


def test_zeros_at_the_end_are_cut_off(log, tmp_path):
    at = starts_of(log, CHUNK)[-3][0]
    result, _ = repaired(tmp_path / "a.mcap.active", log[0][:at] + bytes(1 << 20))
    assert result.chunks == 20
    assert result.lost_bytes == 1 << 20
    assert "zeros" in result.findings[0]


def test_zeros_within_a_span_cost_that_span(log, tmp_path):
    """What a disk has left of a write that a power cut met: one joint, and zeros."""
    begin, at = starts_of(log, CHUNK)[-3][0], starts_of(log, CHUNK)[-2][0]
    result, now = repaired(tmp_path / "a.mcap.active", log[0][:at] + bytes(5000))
    assert (result.chunks, result.lost_bytes) == (20, at + 5000 - begin)
    assert cycles_of(now) == [list(range(100, 205))] * 3


@pytest.mark.parametrize("chunk", [8, 9, 10], ids=["joint 1", "joint 2", "frames"])
def test_bad_chunk_in_the_middle_is_left_out_with_those_of_its_cycles(log, tmp_path, chunk):
    """The rest of its span (/joint_states, events) stays."""
    chunks = starts_of(log, CHUNK)
    result, now = repaired(tmp_path / "a.mcap", spoiled(log, chunk))
    lost = [(chunks[n][1] if n == chunk else chunks[n + 1][0]) - chunks[n][0] for n in (8, 9, 10)]
    assert (result.chunks, result.lost_chunks, result.lost_bytes) == (20, 3, sum(lost))
    assert result.lost_s == pytest.approx(0.022, abs=0.001)
    assert log[0][slice(*chunks[11])] in now
    assert set(contents(now)) < set(contents(log[0]))
    assert cycles_of(now) == [[*range(100, 142), *range(163, 220)]] * 3


def test_bad_chunk_of_the_rest_costs_no_cycle(log, tmp_path):
    at, end = starts_of(log, CHUNK)[11]
    result, now = repaired(tmp_path / "a.mcap", spoiled(log, 11))
    assert (result.chunks, result.lost_chunks, result.lost_bytes) == (22, 1, end - at)
    assert cycles_of(now) == [list(range(100, 220))] * 3


def test_two_damaged_spans_do_not_make_one(log, tmp_path):
    """Of one the joints are intact, of the next the frames: together they have every topic, but not of the same cycles."""
    _, now = repaired(tmp_path / "a.mcap", spoiled(log, 6, 8, 9))
    assert cycles_of(now) == [[*range(100, 121), *range(163, 220)]] * 3


def test_a_log_of_before_loses_a_chunk_as_it_did(tmp_path):
    """All topics in one chunk."""
    data = ours(tmp_path / "whole.mcap", together=True)
    at, end = starts_of((data, record_starts(data)), CHUNK)[2]
    damaged = bytearray(data)
    damaged[end - 30] ^= 0x10
    result, now = repaired(tmp_path / "a.mcap", bytes(damaged))
    assert (result.chunks, result.lost_chunks, result.lost_bytes) == (5, 1, end - at)
    assert result.lost_s == pytest.approx(0.022, abs=0.001)
    assert cycles_of(now) == [[*range(100, 142), *range(163, 220)]] * 3


@pytest.mark.parametrize("byte", [9, 17, 25], ids=lambda b: f"head byte {b}")
def test_times_and_size_of_a_chunk_are_restored(log, tmp_path, byte):
    """They are those of its content, which its CRC proves. Nothing is lost."""
    at = starts_of(log, CHUNK)[3][0]
    data = bytearray(log[0])
    data[at + byte] ^= 0x40
    result, now = repaired(tmp_path / "a.mcap", bytes(data))
    assert not result.lossy
    assert contents(now) == contents(log[0])


@pytest.mark.parametrize("byte", [0, 1, 2, 8, 33, 37, 41, 45], ids=lambda b: f"head byte {b}")
@pytest.mark.parametrize("ended", [True, False], ids=["ended", "no summary"])
def test_wrong_head_of_a_chunk_costs_its_cycles_only(log, tmp_path, byte, ended):
    """Opcode, length, CRC, compression, packed length: the next chunk is found in the summary, or by its mark."""
    at, end = starts_of(log, CHUNK)[13]
    data = bytearray(log[0][: None if ended else starts_of(log, DATA_END)[0][0]])
    data[at + byte] ^= 0x40
    result, now = repaired(tmp_path / "a.mcap", bytes(data))
    assert result.lossy
    assert (result.chunks, result.attachments) == (20, 2)
    assert result.lost_bytes >= end - at
    assert cycles_of(now) == [[*range(100, 163), *range(184, 220)]] * 3
    assert set(contents(now)) < set(contents(log[0]))


def test_damaged_definitions_at_the_head_are_those_of_the_chunks(log, tmp_path):
    """One letter of a topic, before a crash: no CRC covers it there."""
    data = bytearray(log[0][: starts_of(log, DATA_END)[0][0]])
    data[data.index(b"/joint/1/state") + 7] ^= 1
    result, now = repaired(tmp_path / "a.mcap.active", bytes(data))
    assert not result.lossy
    assert any("at the head" in finding for finding in result.findings)
    assert contents(now) == contents(log[0])


def test_a_definition_that_cannot_be_read_is_written_anew(log, tmp_path):
    """Its text is no UTF-8: an orderly reader stops there, although summary and chunks are whole."""
    data = bytearray(log[0])
    data[data.index(b"sensor_msgs/msg/JointState") + 3] = 0xFE
    result, now = repaired(tmp_path / "a.mcap", bytes(data))
    assert result.changed
    assert not result.lossy
    assert contents(now) == contents(log[0])


@pytest.mark.parametrize("name", ["network", "faults"])
def test_a_recorded_log_cut_at_two_thirds(tmp_path, name):
    """What is before the torn chunk comes back as it was, with every attachment, and a clean end."""
    whole = (GOLDEN / f"{name}.mcap").read_bytes()
    result, now = repaired(tmp_path / "a.mcap.active", whole[: 2 * len(whole) // 3])
    before = contents(whole)
    assert result.lossy
    assert result.messages > 0.3 * len(before)
    assert contents(now) == before[: result.messages]
    names = [
        sorted(a.name for a in make_reader(io.BytesIO(data)).iter_attachments()) for data in (whole, now)
    ]
    assert names[0] == names[1]


def test_first_chunk_and_all_definitions_before_it_gone(log, tmp_path):
    """They stand in the summary too, and go where there is room for them again."""
    first = starts_of(log, SCHEMA)[0][0]
    end = starts_of(log, CHUNK)[0][1]
    data = bytearray(log[0])
    data[first:end] = bytes(end - first)
    result, _ = repaired(tmp_path / "a.mcap", bytes(data))
    assert (result.chunks, result.attachments) == (20, 2)
    assert result.messages > 0.75 * by_index(log[0])[0]


def test_torn_within_the_attachments(log, tmp_path):
    second, end = starts_of(log, ATTACHMENT)[1]
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0][: end - 10])
    result = recover(path, attachments_are_enough=True)
    assert by_index(result.path.read_bytes()) == (0, None)
    assert (result.attachments, result.messages, result.lost_bytes) == (1, 0, end - 10 - second)
    assert result.lost_s is None


def test_file_of_which_no_message_can_be_read_stays(log, tmp_path, capsys):
    data = spoiled(log)
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    assert main([str(path)]) == main([str(tmp_path)]) == main(["--dry-run", str(path)]) == 1
    out, error = capsys.readouterr()
    assert out == ""
    assert len(set(error.splitlines())) == 1
    assert "found no message that can be read" in error
    assert path.read_bytes() == data
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param((0, True, "about 0.02 s"), id="first, by the summary"),
        pytest.param((-1, True, "about 0.01 s"), id="last, by the summary"),
        pytest.param((0, False, "unknown time"), id="first, no summary"),
    ],
)
def test_time_that_is_lost_is_told_or_unknown(log, tmp_path, capsys, case):
    chunk, ended, lost = case
    path = tmp_path / "a.mcap"
    path.write_bytes(spoiled(log, chunk)[: None if ended else starts_of(log, DATA_END)[0][0]])
    assert main(["--dry-run", str(path)]) == 3
    assert lost in capsys.readouterr().out.splitlines()[-1]
    assert main(["--json", str(path)]) == 3
    seconds = json.loads(capsys.readouterr().out)["files"][0]["lost_s"]
    assert seconds is None if lost.startswith("unknown") else seconds > 0


def test_magic_and_header_are_written_again(log, tmp_path):
    data = bytearray(log[0])
    data[:40] = bytes(40)
    result, now = repaired(tmp_path / "a.mcap", bytes(data))
    assert result.messages == by_index(log[0])[0]
    assert make_reader(open(result.path, "rb")).get_header().profile == "ros2"  # noqa: SIM115
    assert result.attachments == 2
    assert contents(now) == contents(log[0])


def test_wrong_summary_is_made_anew(log, tmp_path):
    data = bytearray(log[0])
    data[-40] ^= 1
    result, now = repaired(tmp_path / "a.mcap", bytes(data))
    assert not result.lossy
    assert result.messages == by_index(log[0])[0]
    assert len(now) <= len(log[0]) + 100


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"precious text\n" * 100, bytes(5000)])
def test_files_with_nothing_to_read_are_refused_and_stay(tmp_path, content, capsys):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(content)
    with pytest.raises(RecoverError, match="found no readable content"):
        recover(path)
    assert path.read_bytes() == content
    assert main([str(path)]) == 1
    assert capsys.readouterr().err.startswith("jtq recover: ")


def test_taken_name_is_refused(log, tmp_path):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0][:-100])
    (tmp_path / "a.mcap").write_bytes(b"other")
    with pytest.raises(RecoverError, match="to be free"):
        recover(path)
    assert path.read_bytes() == log[0][:-100]


def test_dry_run_changes_nothing(log, tmp_path, capsys):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0][:-20000])
    assert main(["--dry-run", "--json", str(path)]) == 3
    result = json.loads(capsys.readouterr().out)["files"][0]
    assert result["lossy"]
    assert path.read_bytes() == log[0][:-20000]
    assert os.listdir(tmp_path) == [path.name]


WRITER = """
import sys, time
from mcap.writer import Writer, CompressionType
import fcntl
file = open(sys.argv[1], "wb")
if sys.argv[2] == "lock":
    fcntl.flock(file, fcntl.LOCK_EX)
writer = Writer(file, chunk_size=2000, compression=CompressionType.ZSTD)
writer.start("x", "jtqd")
channel = writer.register_channel("/a", "json", 0)
n = 0
while True:
    writer.add_message(channel, n * 1_000_000, b'{"n": %d}' % n, n * 1_000_000, n)
    n += 1
    if n % 100 == 0:
        file.flush()
    if n == 1000:
        print(n, flush=True)
        time.sleep(60)
"""


def test_file_of_a_living_writer_is_refused_and_repaired_when_it_was_killed(tmp_path):
    path = tmp_path / "a.mcap.active"
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path), "lock"], stdout=subprocess.PIPE)
    try:
        writer.stdout.readline()
        before = path.read_bytes()
        for dry_run in (False, True):
            with pytest.raises(RecoverError, match="a recorder is writing it"):
                recover(path, dry_run=dry_run)
        assert path.read_bytes() == before
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    result = recover(path)
    assert 900 <= result.messages <= 1000
    now = result.path.read_bytes()
    assert by_index(now) == in_order(now) == (result.messages, None)


def test_full_disk_leaves_the_file_as_it_was(log, tmp_path):
    """No file may grow: the summary has no room, and not even the bad chunk is touched."""
    path = tmp_path / "a.mcap.active"
    data = bytearray(log[0][: starts_of(log, DATA_END)[0][0]])
    data[starts_of(log, CHUNK)[1][1] - 20] ^= 1
    path.write_bytes(data)

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(data) + 50, len(data) + 50))

    done = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "recover", str(path)],
        cwd=ROOT,
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == f"jtq recover: {path}: File too large\n"
    assert path.read_bytes() == bytes(data)
    assert os.listdir(tmp_path) == [path.name]


def test_room_that_must_stay_free(log, tmp_path):
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0][:-100])
    with pytest.raises(OSError, match="No space left"):
        recover(path, keep_free=1 << 60)
    assert os.listdir(tmp_path) == [path.name]
    assert path.read_bytes() == log[0][:-100]


def test_an_interrupted_recovery_is_repeated(log, tmp_path):
    """What it left beside the file is written anew; the copy has the rights of the file."""
    path = tmp_path / "a.mcap.active"
    path.write_bytes(log[0][:-100])
    path.chmod(0o640)
    (tmp_path / "a.mcap.active.recovering").write_bytes(b"half")
    result = recover(path)
    assert os.listdir(tmp_path) == ["a.mcap"]
    assert result.path.stat().st_mode & 0o777 == 0o640
    assert contents(result.path.read_bytes()) == contents(log[0])


@pytest.mark.parametrize("chunked", [True, False])
def test_a_log_of_another_program_is_refused(tmp_path, capsys, chunked):
    path = tmp_path / "a.mcap"
    data = foreign("", chunked=chunked)[:-50]
    path.write_bytes(data)
    with pytest.raises(RecoverError, match="found a log of 'lib'"):
        recover(path)
    assert (main([str(path)]), main([str(tmp_path)])) == (1, 0)
    assert "left out: " in capsys.readouterr().err
    assert path.read_bytes() == data


def test_lies_about_sizes_take_no_memory(tmp_path):
    """A chunk that says 1 TB, one of 64 kB that unpacks to 2 GB, a message of 8 EB: within 400 MB of address space."""
    import zstandard

    whole = logger(tmp_path / "whole.mcap")
    starts = record_starts(whole)
    chunk = next(at for at in starts if whole[at] == CHUNK)
    bomb = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 28)) * 8
    said = struct.pack("<QQQI", 1, 2, 1 << 40, 0) + struct.pack("<I4sQ", 4, b"zstd", len(bomb)) + bomb
    small = struct.pack("<QQQI", 1, 2, 1 << 33, 5) + struct.pack("<I4sQ", 4, b"zstd", len(bomb)) + bomb
    lies = whole[:chunk]
    for body in (said, small):
        lies += struct.pack("<BQ", CHUNK, len(body)) + body
    lies += whole[chunk : starts[-2]] + struct.pack("<BQ", 5, 1 << 62)
    path = tmp_path / "a.mcap"
    path.write_bytes(lies)
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "recover", "--json", str(path)],
        cwd=ROOT,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (700 << 20, 700 << 20)),
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3, done.stderr
    result = json.loads(done.stdout)["files"][0]
    assert result["messages"] == by_index(whole)[0]
    assert result["lost_chunks"] >= 2
    assert time.monotonic() - start < 20


def test_command_on_a_directory(log, tmp_path, capsys):
    """What a crash has left, what has no end, and what is damaged in its middle; whole files are not listed."""
    (tmp_path / "a.mcap.active").write_bytes(log[0][:-20000])
    (tmp_path / "b.mcap").write_bytes(log[0])
    (tmp_path / "c.mcap").write_bytes(log[0][:-3])
    (tmp_path / "d.mcap").write_bytes(spoiled(log, 1))
    (tmp_path / "e.mcap").write_bytes(foreign("", chunked=False))
    (tmp_path / "note.txt").write_text("x")
    assert main([str(tmp_path)]) == 3
    said = capsys.readouterr().out
    assert "a.mcap: repaired" in said
    assert "c.mcap: repaired" in said
    assert "d.mcap: repaired" in said
    assert "b.mcap" not in said
    assert "lost: " in said
    assert sorted(os.listdir(tmp_path)) == [*(f"{name}.mcap" for name in "abcde"), "note.txt"]
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == "nothing to recover\n"


def test_wrong_use(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path / "a.txt")])
    assert stop.value.code == 2
    assert main([str(tmp_path / "none.mcap")]) == 1
    assert capsys.readouterr().err.endswith("none.mcap: No such file or directory\n")


# ---- random damage ----


MESSAGES = {}


@pytest.fixture(scope="module", params=[ours, logger])
def whole(request, tmp_path_factory):
    data = request.param(tmp_path_factory.mktemp("log") / "a.mcap")
    assert by_index(data)[1] is None
    MESSAGES[data] = Counter(contents(data))
    return data


def of_no_cycle(whole):
    """Messages of a span that lacks a chunk: readers get them, but of no cycle all."""
    return 2 * 21 if b"/joint/1/state" in whole else 0


def judge(path, whole, damaged, what):
    """Recover: only messages of the whole file, all that an orderly reader gets, and no loss that is not reported."""
    path.write_bytes(damaged)
    try:
        result = recover(path)
    except RecoverError:
        assert path.read_bytes() == damaged, what
        assert in_order(damaged)[0] <= of_no_cycle(whole), what
        return "refused"
    now = path.read_bytes()
    assert by_index(now) == in_order(now) == (result.messages, None), what
    before, after = MESSAGES[whole], Counter(contents(now))
    assert not after - before, what
    assert result.messages >= in_order(damaged)[0] - of_no_cycle(whole), what
    if b"/joint/1/state" in whole:
        one, *others = cycles_of(now)
        assert all(each == one for each in others), what
    assert result.lossy or len(damaged) < len(whole) or after == before, what
    assert result.changed or now == damaged, what
    again = recover(path)
    assert (again.changed, again.lossy, again.messages) == (False, False, result.messages), what
    return "lossy" if result.lossy else "repaired" if result.changed else "whole"


def test_cut_at_every_interesting_offset(whole, tmp_path):
    """At each record, within its head, and one byte around."""
    offsets = {at + shift for at in record_starts(whole) for shift in (-1, 0, 1, 5, 9, 30)}
    places = sorted(at for at in offsets if 8 <= at < len(whole))
    places = places[:: max(1, len(places) // 60)]
    found = Counter(judge(tmp_path / "a.mcap", whole, whole[:at], f"cut at {at}") for at in places)
    # a file without any message, or without one whole cycle, is not replaced
    empty = sum(in_order(whole[:at])[0] <= of_no_cycle(whole) for at in places)
    assert found["refused"] <= empty, found
    assert found["repaired"] + found["lossy"] > 0.9 * (len(places) - empty), found


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.campaign)])
def test_random_damage(whole, tmp_path, seed):
    source = random.Random(seed)
    print(f"seed {seed}")
    for n in range(60):
        data = bytearray(whole)
        at = source.randrange(len(data))
        kind = source.randrange(4)
        if kind == 0:
            data[at] ^= 1 << source.randrange(8)
        elif kind == 1:
            length = source.randrange(1, 3000)
            data[at : at + length] = bytes(len(data[at : at + length]))
        elif kind == 2:
            for _ in range(source.randrange(2, 6)):
                data[source.randrange(len(data))] = source.randrange(256)
        else:
            data = data[:at] + bytes(source.randrange(1, 5000))
        judge(tmp_path / "a.mcap", whole, bytes(data), f"seed {seed}, case {n}, kind {kind}, byte {at}")
