"""The table of counters: fixed sub-indices, a row for each fault, and the table of docs/bus.md."""

from __future__ import annotations

import pytest

from jtqd.daemon.shared import faults
from jtqd.daemon.shared.counters import COUNTERS, OBJECT_2200, RECORDER_LOST, TABLE, Counter, Shown, shown_in
from tests.paths import ROOT

FIXED = {
    "cycles": 1,
    "recorder_lost": 11,
    "sync_gaps": 17,
    "network_no_time": 23,
    "fault_deviation": 34,
    "contacts": 37,
}
"""Sub-indices of object 2200h that receivers know."""


def test_names_and_sub_indices_are_unique() -> None:
    assert len(set(COUNTERS)) == len(COUNTERS)
    assert sorted(each.sub for each in (*TABLE, RECORDER_LOST) if each.sub) == [
        *range(1, len(OBJECT_2200) + 1)
    ]
    assert {name: OBJECT_2200.index(name) + 1 for name in FIXED} == FIXED


def test_every_fault_of_a_cycle_is_counted() -> None:
    assert {f"fault_{faults.NAMES[bit]}" for bit in faults.COUNTED} <= {*shown_in(Shown.SUMMARY_TORQUE)}
    assert set(faults.MEANINGS) == set(faults.NAMES)


@pytest.mark.parametrize("row", [*TABLE, RECORDER_LOST], ids=lambda row: row.name)
def test_the_page_has_the_row(row: Counter) -> None:
    page = (ROOT / "docs" / "bus.md").read_text().splitlines()
    assert f"| `{row.name}` | {row.sub or '-'} | {row.text} |" in page
