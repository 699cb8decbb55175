"""Where a record may begin, in bytes of every kind: the fast search beside the definition, written as patterns."""

import random
import re

import pytest

from jtqd.daemon.logs.candidates import other_records, packed_chunks
from tests.daemon.logs.log_files import foreign

OTHERS = re.compile(rb"(?=\x06.{36}\x00{4}|[\x03-\x05\x07\x09\x0c\x0f].{4}\x00{4})", re.DOTALL)
PACKED = re.compile(rb"\x03\x00{3}lz4|\x04\x00{3}zstd")


@pytest.mark.parametrize("seed", range(30))
def test_the_same_places(seed):
    print("seed", seed)
    source = random.Random(seed)
    common = bytes([0, 0, 0, 0, 3, 4, 5, 6, 7, 9, 12, 15, 1, 255])
    data = bytes(source.choice(common) for _ in range(source.randrange(4000)))
    data += source.choice((b"", foreign("zstd", count=50), foreign("lz4", count=50), foreign("", count=50)))
    data = data[: len(data) - source.randrange(60)]
    assert sorted(other_records(data)) == [match.start() for match in OTHERS.finditer(data)]
    assert sorted(packed_chunks(data)) == [match.start() - 37 for match in PACKED.finditer(data)]


@pytest.mark.parametrize("length", range(50))
def test_at_the_end(length):
    data = b"\x06" + bytes(length)
    assert other_records(data) == [match.start() for match in OTHERS.finditer(data)]
