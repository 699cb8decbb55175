"""What a live view remembers: sparkline, maxima of the last seconds, pages."""

from math import nan

import pytest

from jtqd.daemon.cli.status import WINDOW_S, Moment, Recent
from jtqd.daemon.cli.terminal import page, sparkline


def test_a_sparkline_spans_its_values_and_leaves_gaps():
    assert sparkline([0, 7], 10) == "▁█"
    assert sparkline([-1, nan, 1], 10) == "▁ █"
    assert sparkline([5, 5, 5], 10) == "▁▁▁"
    assert sparkline([nan, nan], 10) == "  "
    assert sparkline([], 10) == ""
    assert sparkline(range(100), 8) == "▁▂▃▄▅▆▇█", "the newest"


def moment(time_s, work, late=(0, 0, 0), torque=0.0):
    return Moment(time_s, (torque, torque), tuple(work), tuple(late))


def test_a_slow_cycle_of_long_ago_is_forgotten():
    recent = Recent()
    recent.add(moment(0.0, [5, 0, 0]))
    recent.add(moment(1.0, [9, 0, 1]))
    assert recent.largest_us(2.0, late=False) == 6.0
    recent.add(moment(1.0 + WINDOW_S, [20, 0, 1]))
    recent.add(moment(2.0 + WINDOW_S, [30, 1, 1]))
    assert recent.largest_us(2.0, late=False) == 4.0
    assert recent.largest_us(2.0, late=True) is None, "nothing was late"


def test_another_daemon_begins_anew():
    recent = Recent()
    recent.add(moment(0.0, [500, 1, 0], torque=3.0))
    recent.add(moment(1.0, [2, 0, 0], torque=4.0))
    assert recent.torques(0) == [4.0]
    assert recent.torques(2) == []
    assert recent.largest_us(1.0, late=False) is None


@pytest.mark.parametrize("count", [0, 1, 5, 6, 11])
def test_pages_hold_every_line_once(count):
    lines = [str(n) for n in range(count)]
    _, _, pages = page(lines, 5, 0)
    assert [line for n in range(pages) for line in page(lines, 5, n)[0]] == lines
    assert page(lines, 5, pages)[1] == 0, "after the last page comes the first"
    assert page(lines, 5, -1)[1] == pages - 1
