"""The grid skips missed slots and never bursts."""

from jtqd.daemon.core.schedule import Grid

MS = 1_000_000


def test_on_time_cycles_stay_on_the_grid() -> None:
    grid = Grid(10 * MS, MS)
    for n in range(1, 5):
        assert grid.advance(10 * MS + (n - 1) * MS + 300_000) == 0
        assert grid.slot_ns == (10 + n) * MS
    assert grid.missed == 0


def test_a_stall_is_skipped_counted_and_not_made_up() -> None:
    grid = Grid(0, MS)
    assert grid.advance(200 * MS + 100_000) == 199
    assert grid.slot_ns == 200 * MS  # 0.1 ms ago: can still be begun
    assert grid.missed == 199
    assert grid.advance(200 * MS + 200_000) == 0
    assert grid.slot_ns == 201 * MS


def test_half_a_period_decides() -> None:
    late = Grid(0, MS)
    assert late.advance(MS + MS // 2) == 0
    assert late.slot_ns == MS
    too_late = Grid(0, MS)
    assert too_late.advance(MS + MS // 2 + 1) == 1
    assert too_late.slot_ns == 2 * MS
    assert not too_late.too_late(2 * MS + MS // 2)
    assert too_late.too_late(2 * MS + MS // 2 + 1)
