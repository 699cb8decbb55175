"""Live view: sparklines, histograms, maxima of the last seconds, pages."""

import io
from math import nan

import pytest
from rich.console import Console, Group
from rich.text import Text

from jtqd.daemon.cli.status import WINDOW_S, Moment, Recent, histogram, paged, sparkline


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


def test_another_daemon_clears_the_window():
    recent = Recent()
    recent.add(moment(0.0, [500, 1, 0], torque=3.0))
    recent.add(moment(1.0, [2, 0, 0], torque=4.0))
    assert recent.torques(0) == [4.0]
    assert recent.torques(2) == []
    assert recent.largest_us(1.0, late=False) is None


@pytest.mark.parametrize("count", [1, 5, 6, 11])
def test_pages_hold_every_line_once(count):
    console = Console(file=io.StringIO(), width=80, height=7, force_terminal=True)
    view = Group(*(f"line {n}" for n in range(count)))

    def lines(number):
        console.file = io.StringIO()
        shown, place = paged(console, view, number)
        console.print(shown)
        text = Text.from_ansi(console.file.getvalue()).plain
        return [each.rstrip() for each in text.splitlines() if each.startswith("line")], place

    pages = -(-count // 5)
    assert [each for n in range(pages) for each in lines(n)[0]] == [f"line {n}" for n in range(count)]
    assert lines(pages)[1] == 0, "after the last page comes the first"
    assert lines(-1)[1] == pages - 1


def test_a_histogram_shows_one_cycle_in_a_million():
    bins = [0] * 100
    bins[10], bins[11], bins[30] = 1_000_000, 500, 1
    line = histogram(bins, 4.0, 60)
    assert line.startswith("40 █▄")
    assert line.endswith("▁ 124 us")
    assert line.count(" ") == 18 + 3, "bins without a cycle are empty"
    assert len(histogram(bins, 4.0, 10)) <= 10 + len("40  136 us")
    assert histogram([0] * 9 + [1], 4.0, 10).endswith("us and more")
    assert histogram([0] * 10, 4.0, 10) == ""
