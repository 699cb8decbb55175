"""Identity of a log and its replay: bits, cycles whose state is not known, contacts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.replay.command import _contacts
from jtqd.daemon.replay.compare import SETTLED_CYCLES, bits_equal, contacts, identity
from jtqd.daemon.replay.logged import BEGINS, SAMPLE, Steps, steps_of
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.estimator.arrays import RecordArray
from tests.daemon.replay.replay_helpers import CONFIG, records

CYCLES = 1000
KNOWN, THERE = FLAG_CONTACT_KNOWN, FLAG_CONTACT_KNOWN | FLAG_CONTACT
STEPS = Steps(np.ones(CYCLES, bool), np.full(CYCLES, 1_000_000), np.array([0]), ())
MIDDLE = replace(STEPS, begins=np.array([], int), breaks=((0, BEGINS),))


def test_bits_are_compared_and_not_values() -> None:
    a = np.array([0.0, np.nan, 1.0, 1.0])
    b = np.array([-0.0, -np.nan, 1.0, np.nextafter(1.0, 2.0)])
    assert bits_equal(a, b).tolist() == [False, True, True, False]


def test_a_difference_is_excused_only_while_the_state_was_not_known() -> None:
    """In the middle of a run the first cycles differ; one that differs long after is a finding."""
    logged = records(list(range(1000, 3000)))
    made = np.zeros(len(logged), SAMPLE)
    for name in SAMPLE.names or ():
        made[name] = logged[name]
    steps = [steps_of(logged, CONFIG)] * 2
    made["torque_nm"][:150] += 1e-12
    made["torque_nm"][150] = -made["torque_nm"][150]  # -0.0
    logged["torque_nm"][151] = made["torque_nm"][151] = np.nan
    same = identity((logged, logged), (made, made), steps)
    assert same.explained
    assert (same.identical, same.from_cycle) == (2000 - 151, 1151)
    assert {each.cycles for each in same.unknown} == {151}
    late = 1151 + SETTLED_CYCLES + 5
    made["torque_nm"][late - 1000] += 0.5
    states = [(2, 1151 + SETTLED_CYCLES), (2, late), (2, 1151)]
    same = identity((logged, logged), (made, made), steps, states=states)
    assert not same.explained
    found = [(each.joint, each.cycle, each.cycles, each.field, each.largest_nm) for each in same.differences]
    assert found == [
        (1, late, 1, "torque_nm", 0.5),
        (2, late, 1, "torque_nm", 0.5),
        (2, 1151 + SETTLED_CYCLES, 2, "state", 0.0),
    ]
    made["torque_nm"][:] += 1.0
    same = identity((logged, logged), (made, made), steps)
    assert not same.explained
    assert same.from_cycle is None


# ---- contacts ----


@pytest.fixture
def log() -> RecordArray:
    """Cycles 50 to 1049; two contacts, one of them with a cycle in its midst in which nothing is known."""
    made = np.zeros(CYCLES, [("cycle", "<u8"), *((name, SAMPLE[name]) for name in SAMPLE.names or ())])
    made["cycle"] = np.arange(50, 50 + CYCLES)
    made["input_flags"], made["contact_nm"] = 7 | KNOWN, 0.1
    for rows in (slice(300, 350), slice(600, 620), slice(621, 650)):
        made["input_flags"][rows], made["contact_nm"][rows] = 7 | THERE, 2.9
    made["input_flags"][[0, 620]], made["contact_nm"][[0, 620]] = 7, np.nan
    return made


def test_the_same_contacts_are_counted(log: RecordArray) -> None:
    same = identity([log], [log.copy()], [STEPS])
    (found,) = same.contacts
    assert (found.logged, found.replayed, found.different, found.known) == (3, 3, 0, CYCLES - 2)
    assert same.explained
    assert same.whole
    assert _contacts(found).startswith("  joint 1: 3 contacts in the log, the same replayed")


@pytest.mark.parametrize(
    ("rows", "flags", "residual", "expected"),
    [
        (slice(300, 350), KNOWN, 2.9, (2, 50, 350)),
        (slice(40, 41), KNOWN, float(np.nextafter(0.1, 1.0)), (3, 1, 90)),
        (slice(620, 621), KNOWN, 0.1, (3, 1, 670)),
    ],
    ids=["missing", "one bit of the residual", "known where it was not"],
)
def test_another_contact_is_a_finding_and_nothing_else_is_wrong(
    log: RecordArray, rows: slice, flags: int, residual: float, expected: tuple[int, int, int]
) -> None:
    other = log.copy()
    other["input_flags"][rows], other["contact_nm"][rows] = 7 | flags, residual
    same = identity([log], [other], [STEPS])
    assert not same.explained
    assert same.differences == ()
    (found,) = same.contacts
    assert (found.replayed, found.different, found.first_cycle) == expected
    assert f"other in {found.different} cycles, first in {found.first_cycle}" in _contacts(found)
    middle = identity([log], [other], [MIDDLE])
    assert middle.explained
    assert middle.contacts[0].excused
    assert "its state was not known at the beginning" in _contacts(middle.contacts[0])


def test_other_flags_count_as_differences_and_a_log_may_have_no_contacts(log: RecordArray) -> None:
    other = log.copy()
    other["input_flags"][40] ^= 8
    assert [each.field for each in identity([log], [other], [STEPS]).differences] == ["input_flags"]
    log["input_flags"] = 7
    assert contacts([log], [log], excused=False) == ()
