"""EMCY of the nodes: names, short messages, storms, and lines that are limited."""

import random
import tracemalloc

import pytest

from jtqd.daemon.bus.errors import DEPTH, EmcyLog
from jtqd.daemon.shared.log_lines import RateLimit
from jtqd.drivers.emcy import Emergency, describe, name_of, parse


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


def test_codes_have_names_and_groups() -> None:
    assert name_of(0x8130) == "life guard or heartbeat"
    assert name_of(0x2311) == "current, device output side"
    assert name_of(0x3F00) == "voltage"
    assert name_of(0xFFFF) == "device specific"
    assert name_of(0xA000) == "unknown group"
    assert describe(parse(frame("1023 03 0000000000"))) == (
        "EMCY 2310h (continuous overcurrent), register 03h (generic, current)"
    )


@pytest.mark.parametrize("length", range(9))
def test_a_short_message_is_told_as_far_as_it_goes(length: int) -> None:
    whole = frame("1023 03 0102030405")
    seen = EmcyLog([1])
    line = seen.receive(1, whole[:length], 0.0)
    assert line is not None
    assert seen.last(1) == Emergency(
        int.from_bytes(whole[: min(length, 2)], "little"),
        3 if length >= 3 else 0,
        whole[3:length].ljust(5, b"\0"),
        length,
    )
    assert (f"a frame of {length} bytes" in line) == (length < 8 and length >= 1) or "no error" in line


def test_a_storm_is_a_few_lines_and_bounded_memory() -> None:
    """5 kHz for 20 s of two nodes, codes at random; seed 7."""
    rng, seen, lines = random.Random(7), EmcyLog([1, 2]), []
    tracemalloc.start()
    for n in range(100_000):
        data = rng.randbytes(rng.randrange(9))
        line = seen.receive(1 + n % 2, data, n / 5000.0)
        if line is not None:
            lines.append(line)
        if n == 20_000:
            before = tracemalloc.get_traced_memory()[0] - sum(map(len, lines))
    grown = tracemalloc.get_traced_memory()[0] - sum(map(len, lines)) - before
    tracemalloc.stop()
    assert seen.count == 100_000
    assert len(seen.history(1)) == DEPTH
    assert len(lines) <= 2 * 6 * 5
    assert grown < 20_000
    assert any("more before" in line for line in lines[-6:])
    assert seen.receive(99, b"", 0.0) is None, "not of the configuration"


def test_lines_are_limited_by_kind_and_together() -> None:
    limit = RateLimit(quiet_s=5.0, burst=3)
    assert [limit.admit(kind, 0.0) for kind in ("a", "a", "b", "c", "d")] == [0, None, 1, 0, None]
    assert limit.admit("a", 5.0) == 1
    assert limit.admit("a", 9.9) is None
