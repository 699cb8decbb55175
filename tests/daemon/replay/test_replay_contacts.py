"""Contacts of a log beside those of its replay: another one is a finding, but where their past is not in the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.replay.command import _contacts
from jtqd.daemon.replay.compare import contacts, identity
from jtqd.daemon.replay.logged import SAMPLE
from jtqd.daemon.replay.runs import BEGINS, Steps
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.estimator.arrays import RecordArray

CYCLES = 1000
KNOWN, THERE = FLAG_CONTACT_KNOWN, FLAG_CONTACT_KNOWN | FLAG_CONTACT
STEPS = Steps(np.ones(CYCLES, bool), np.full(CYCLES, 1_000_000), np.array([0]), ())


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


def test_the_same_contacts_are_told_with_their_number(log: RecordArray) -> None:
    same = identity([log], [log.copy()], [STEPS])
    (found,) = same.contacts
    assert (found.logged, found.replayed, found.different, found.known) == (3, 3, 0, CYCLES - 2)
    assert same.explained
    assert same.whole
    assert _contacts(found).startswith("  joint 1: 3 contacts in the log, told again in the same cycles")


@pytest.mark.parametrize("change", ["missing", "one bit of the residual", "known where it was not"])
def test_another_contact_is_a_finding_and_nothing_else_is_wrong(log: RecordArray, change: str) -> None:
    again = log.copy()
    if change == "missing":
        again["input_flags"][300:350] = 7 | KNOWN
    elif change == "known where it was not":
        again["input_flags"][620], again["contact_nm"][620] = 7 | KNOWN, 0.1
    else:
        again["contact_nm"][40] = np.nextafter(0.1, 1.0)
    same = identity([log], [again], [STEPS])
    assert not same.explained
    assert same.differences == ()
    (found,) = same.contacts
    counted = {"missing": (2, 50, 350), "one bit of the residual": (3, 1, 90)}
    expected = counted.get(change, (3, 1, 670))
    assert (found.replayed, found.different, found.first_cycle) == expected
    assert f"other in {found.different} cycles, first in {found.first_cycle}" in _contacts(found)


def test_it_is_none_where_the_log_begins_in_the_middle_of_a_run(log: RecordArray) -> None:
    again = log.copy()
    again["torque_nm"][:20] = 1.0
    again["input_flags"][500] = 7 | THERE
    middle = replace(STEPS, begins=np.array([], int), breaks=((0, BEGINS),))
    same = identity([log], [again], [middle])
    assert same.explained
    assert same.contacts[0].excused
    assert "its state was not known at the beginning" in _contacts(same.contacts[0])


def test_other_flags_still_count(log: RecordArray) -> None:
    again = log.copy()
    again["input_flags"][40] ^= 8
    same = identity([log], [again], [STEPS])
    assert [each.field for each in same.differences] == ["input_flags"]


def test_a_log_without_contacts_has_none(log: RecordArray) -> None:
    log["input_flags"] = 7
    assert contacts([log], [log], excused=False) == ()
    whole = log[["cycle", "torque_nm"]]
    assert contacts([log], [whole], excused=False) == (), "a replay in arrays"
