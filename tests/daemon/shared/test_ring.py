"""The ring of cycle records: order, laps, torn and stale copies, and a real writer against a real reader."""

import multiprocessing
import os
import random
import struct
import time

import pytest

from jtqd.daemon.shared.cycle_record import COUNT_WORD, Ring, RingReader
from jtqd.daemon.shared.runtime_dir import SharedMemoryError
from tests.daemon.ring_records import append

SIZE = 64


def fill(ring, index, tail=None):
    ends = (struct.pack("<Q", each) for each in (index, index if tail is None else tail))
    append(ring, (bytes([index * 37 % 251]) * (SIZE - 16)).join(ends))


def indexes(batch):
    return [int.from_bytes(record[:8], "little") for record in batch.records]


def test_records_come_in_order_once_and_whole(tmp_path):
    ring = Ring(tmp_path / "ring", 8, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    assert reader.read() == ([], 0)
    for n in range(5):
        fill(ring, n)
    batch = reader.read()
    assert (indexes(batch), batch.lost) == ([0, 1, 2, 3, 4], 0)
    assert batch.records[3] == struct.pack("<Q", 3) + bytes([111]) * 48 + struct.pack("<Q", 3)
    assert reader.read() == ([], 0)


def test_limit_leaves_the_rest_for_later(tmp_path):
    ring = Ring(tmp_path / "ring", 16, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    for n in range(10):
        fill(ring, n)
    assert indexes(reader.read(4)) == [0, 1, 2, 3]
    assert reader.backlog == 6
    assert indexes(reader.read(100)) == [4, 5, 6, 7, 8, 9]
    assert reader.backlog == 0


@pytest.mark.parametrize("written", [8, 9, 15, 16, 17, 1000])
def test_lapped_reader_counts_what_is_gone(tmp_path, written):
    """Of 8 slots 7 are sure: the writer may be filling the eighth at this moment."""
    ring = Ring(tmp_path / "ring", 8, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    for n in range(written):
        fill(ring, n)
    batch = reader.read()
    assert indexes(batch) == list(range(written - 7, written))
    assert batch.lost == written - 7


def test_reader_that_comes_late_starts_at_the_oldest(tmp_path):
    ring = Ring(tmp_path / "ring", 8, SIZE)
    for n in range(20):
        fill(ring, n)
    reader = RingReader(tmp_path / "ring", SIZE)
    assert reader.position == 12
    assert indexes(reader.read()) == list(range(13, 20))


def test_record_with_different_ends_is_lost(tmp_path):
    ring = Ring(tmp_path / "ring", 8, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    fill(ring, 0)
    fill(ring, 1, tail=0)
    fill(ring, 2)
    batch = reader.read()
    assert (indexes(batch), batch.lost) == ([0, 2], 1)


def test_record_of_the_lap_before_is_lost(tmp_path):
    """The count became visible before the record: the slot still holds record 1 when record 5 is read."""
    ring = Ring(tmp_path / "ring", 4, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    found = []
    for n in (0, 1, 2, 3, 4, 1, 6):
        fill(ring, n)
        batch = reader.read()
        found += indexes(batch)
        assert batch.lost == (n == 1 and ring.words[COUNT_WORD] == 6)
    assert found == [0, 1, 2, 3, 4, 6]


def test_new_ring_leaves_the_old_reader_its_memory(tmp_path):
    ring = Ring(tmp_path / "ring", 4, SIZE)
    reader = RingReader(tmp_path / "ring", SIZE)
    fill(ring, 7)
    Ring(tmp_path / "ring", 4, SIZE)
    assert indexes(reader.read()) == [7]
    assert RingReader(tmp_path / "ring", SIZE).read() == ([], 0)


@pytest.mark.parametrize("content", [b"", b"short", bytes(4096 + 8 * SIZE), None])
def test_what_is_no_ring_is_refused(tmp_path, content):
    path = tmp_path / "ring"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SharedMemoryError, match="ring"):
        RingReader(path, SIZE)


def test_other_record_size_is_refused(tmp_path):
    Ring(tmp_path / "ring", 8, SIZE)
    with pytest.raises(SharedMemoryError, match=f"record size {SIZE}"):
        RingReader(tmp_path / "ring", SIZE + 8)


def _write(path, total, seed, start):
    rng = random.Random(seed)
    ring = Ring(path, 32, SIZE)
    start.set()
    for n in range(total):
        fill(ring, n)
        if rng.random() < 0.02:
            time.sleep(rng.random() * 5e-4)
    os._exit(0)


@pytest.mark.native
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_writer_and_reader_in_two_processes(tmp_path, seed):
    """Every record is either read whole and in order or counted, whatever the two do to each other."""
    print(f"seed {seed}")
    total, rng = 20_000, random.Random(1000 + seed)
    context = multiprocessing.get_context("fork")
    start = context.Event()
    writer = context.Process(target=_write, args=(tmp_path / "ring", total, seed, start))
    writer.start()
    assert start.wait(10)
    reader = RingReader(tmp_path / "ring", SIZE)
    lost, good, newest, end = reader.position, 0, -1, time.monotonic() + 30
    while good + lost < total and time.monotonic() < end:
        batch = reader.read(rng.choice([1, 7, 1024]))
        lost += batch.lost
        for record in batch.records:
            index = int.from_bytes(record[:8], "little")
            assert index > newest
            assert record == struct.pack("<Q", index) + bytes([index * 37 % 251]) * 48 + record[:8]
            newest = index
            good += 1
        if rng.random() < 0.01:
            time.sleep(rng.random() * 2e-3)
    writer.join(10)
    assert good + lost == total
    assert newest == total - 1
    assert good > 0
    assert lost > 0, "the reader was never lapped: the test has not tested that"
