"""Repair under random damage, with fixed seeds: never a traceback, never fewer messages than a reader got before."""

import random
from collections import Counter

import pytest

from jtqd.daemon.logs.recover import RecoverError, recover
from tests.daemon.logs.log_files import by_index, foreign, in_order, ours, record_starts

WRITERS = {
    "ours": None,
    "plain": lambda: foreign(""),
    "lz4": lambda: foreign("lz4"),
    "zstd": lambda: foreign("zstd"),
    "unchunked": lambda: foreign("", chunked=False),
}


@pytest.fixture(scope="module", params=WRITERS)
def whole(request, tmp_path_factory):
    make = WRITERS[request.param]
    data = ours(tmp_path_factory.mktemp("log") / "a.mcap") if make is None else make()
    assert by_index(data)[1] is None
    return data


def judge(path, damaged, what):
    """Recover, and compare with what the library could read before."""
    path.write_bytes(damaged)
    before = max(by_index(damaged)[0], in_order(damaged)[0])
    try:
        result = recover(path)
    except RecoverError:
        assert path.read_bytes() == damaged, what
        assert before == 0, what
        return "refused"
    now = path.read_bytes()
    assert by_index(now) == in_order(now) == (result.messages, None), what
    assert result.messages >= before, what
    assert result.changed or now == damaged, what
    again = recover(path)
    assert (again.changed, again.lossy, again.messages) == (False, False, result.messages), what
    return "lossy" if result.lossy else "repaired" if result.changed else "whole"


def test_cut_at_every_interesting_offset(whole, tmp_path):
    """At each record, within its head, and one byte around."""
    offsets = {at + shift for at in record_starts(whole) for shift in (-1, 0, 1, 5, 9, 30)}
    places = sorted(at for at in offsets if 8 <= at < len(whole))
    places = places[:: max(1, len(places) // 120)]
    found = Counter(judge(tmp_path / "a.mcap", whole[:at], f"cut at {at}") for at in places)
    assert found["repaired"] + found["lossy"] > 0.9 * len(places), found


@pytest.mark.parametrize("seed", [11, 12])
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
        judge(tmp_path / "a.mcap", bytes(data), f"seed {seed}, case {n}, kind {kind}, byte {at}")
