"""From slot to slot in exact time: records however often the interpreter looks in, missed slots, the end, duties."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core.cycle import CYCLE_ENDED, RUN_ENDED, SLOT_PASSED, Cycle
from jtqd.daemon.loop import process
from jtqd.daemon.shared import cycle_record as cr
from tests.daemon.loop.cycle_helpers import ExactTime, inputs, make

PERIOD_NS = 10_000_000


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    clock = ExactTime().install(monkeypatch)
    monkeypatch.setattr(process, "time", clock)
    return clock


def made(tmp_path: Path, clock: ExactTime, late: dict[int, int] | None = None) -> tuple[Any, Any, Any]:
    """A cycle whose inputs change; before SYNC number n + 1 the machine stands still for late[n] ns."""

    def script(sync: int) -> list[bytes]:
        clock.now_ns += (late or {}).get(sync, 0)
        return inputs(velocity=5000 + 7 * sync, current=200 + sync % 5)

    cycle, socket, reader = make(tmp_path, script)
    cycle.grid.slot_ns = clock.now_ns + PERIOD_NS
    return cycle, socket, reader


def test_the_records_do_not_depend_on_how_many_slots_pass_at_once(tmp_path: Path, clock: ExactTime) -> None:
    start_ns, found = clock.now_ns, []
    for number, sizes in enumerate(([1] * 48, [8] * 6, [3, 13, 1, 31])):
        clock.now_ns = start_ns
        (tmp_path / str(number)).mkdir()
        cycle, _, reader = made(tmp_path / str(number), clock, {11: 3 * PERIOD_NS, 30: PERIOD_NS // 4})
        for slots in sizes:
            outcome = cycle.go_on(slots, 0)
            if outcome == CYCLE_ENDED:
                cycle.skip(cycle.grid.advance(clock.now_ns))
        found.append((reader.read().records, cycle.index, cycle.grid.missed, cycle.grid.slot_ns))
        assert cycle.grid.missed == 2
    assert found[0] == found[1] == found[2]
    records, index, missed, _ = found[0]
    numbers = [cr.header_of(record).cycle for record in records]
    assert numbers == sorted(set(numbers))
    assert len({*range(index)} - {*numbers}) == missed, "missed slots leave a gap in the numbers"


def test_each_sync_is_in_its_slot(tmp_path: Path, clock: ExactTime) -> None:
    cycle, _, reader = made(tmp_path, clock)
    first_ns = cycle.grid.slot_ns
    assert cycle.go_on(20, 0) == CYCLE_ENDED
    sent = [cr.header_of(record).sync_monotonic_ns for record in reader.read().records]
    assert sent == [first_ns + n * PERIOD_NS for n in range(20)]
    assert cycle.grid.slot_ns == sent[-1], "the last one's pause is the caller's"
    assert cycle.sent_ns >= cycle.sync_ns == sent[-1]


def test_no_cycle_begins_at_the_end(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, _ = made(tmp_path, clock)
    assert cycle.go_on(20, cycle.grid.slot_ns + 5 * PERIOD_NS) == RUN_ENDED
    assert socket.syncs == cycle.index == 5
    assert cycle.go_on(1, clock.now_ns) == RUN_ENDED
    assert socket.syncs == 5


def test_a_slot_that_comes_too_late_passes(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, _ = made(tmp_path, clock)
    clock.now_ns = cycle.grid.slot_ns + PERIOD_NS // 2 + 1
    assert cycle.go_on(1, 0) == SLOT_PASSED
    assert (socket.syncs, cycle.index, cycle.grid.missed) == (0, 1, 1)
    assert cycle.grid.slot_ns - clock.now_ns == PERIOD_NS // 2 - 1
    assert cycle.go_on(1, 0) == CYCLE_ENDED
    assert (socket.syncs, cycle.index) == (1, 2)


class Duties:
    """In place of the loop's."""

    def __init__(self, cycle: Cycle) -> None:
        self.cycle = cycle
        self.asked: list[int] = []

    def __call__(self) -> None:
        self.asked.append(self.cycle.index)


def test_duties_are_called_after_some_slots_and_soon_after_one_that_passed(
    tmp_path: Path, clock: ExactTime
) -> None:
    """The eighth slot is missed: the ninth cycle is followed at once."""
    cycle, _, _ = made(tmp_path, clock, {7: PERIOD_NS + PERIOD_NS * 3 // 5})
    duties: Any = Duties(cycle)
    process.run(cycle, cycle.grid, lambda: len(duties.asked) == 4, duties=duties)
    gaps = [b - a for a, b in itertools.pairwise(duties.asked)]
    assert max(gaps) <= process.SLOTS + 1
    assert duties.asked != [8, 16, 24, 32], "the missed slot has moved them"


def test_a_stop_is_heard_before_the_next_slots(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, _ = made(tmp_path, clock)
    duties: Any = Duties(cycle)
    process.run(cycle, cycle.grid, lambda: socket.syncs >= 16, duties=duties)
    assert socket.syncs == 16
    assert duties.asked == [8, 16]
