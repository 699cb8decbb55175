"""Contacts of a log beside those of its replay (docs/estimator.md). Pure, in arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.estimator.arrays import BoolArray, RecordArray

BITS = FLAG_CONTACT | FLAG_CONTACT_KNOWN
"""Of `input_flags`: what a cycle says of a contact."""


@dataclass(frozen=True)
class Contacts:
    """One joint over n cycles.

    Attributes:
        joint: from 1 on.
        known: cycles of the log in which it is known whether there is a contact.
        logged, replayed: contacts that begin.
        different: cycles that say something else, or of whose residual a bit differs.
        first_cycle: of them; None without any.
        largest_nm: difference of the residuals where both are known; 0 without any.
        excused: the state of a detector was not known at the beginning: its waves remember seconds.
    """

    joint: int
    known: int
    logged: int
    replayed: int
    different: int
    first_cycle: int | None
    largest_nm: float
    excused: bool

    @property
    def explained(self) -> bool:
        """Return whether the replay says what the log says, or what it had to know is not in the log."""
        return self.excused or not self.different


def contacts(
    logged: Sequence[RecordArray], replayed: Sequence[RecordArray], *, excused: bool
) -> tuple[Contacts, ...]:
    """Compare the joints [n each]; nothing where contacts were not known, or the replay is one in arrays."""
    found = []
    for number, (one, two) in enumerate(zip(logged, replayed, strict=True), start=1):
        if "input_flags" not in (two.dtype.names or ()):
            continue
        said, again = one["input_flags"] & BITS, two["input_flags"] & BITS
        if not (said | again).any():
            continue
        different: BoolArray = said != again
        largest = 0.0
        if "contact_nm" in (one.dtype.names or ()):
            both = ((said & again) & FLAG_CONTACT_KNOWN) != 0
            apart = np.abs(np.where(both, one["contact_nm"] - two["contact_nm"], 0.0))
            different |= ~(apart == 0.0)
            largest = float(apart.max(initial=0.0))
        rows = np.flatnonzero(different)
        found.append(
            Contacts(
                number,
                int(((said & FLAG_CONTACT_KNOWN) != 0).sum()),
                _begun(said),
                _begun(again),
                len(rows),
                int(one["cycle"][rows[0]]) if len(rows) else None,
                largest,
                excused,
            )
        )
    return tuple(found)


def _begun(bits: npt.NDArray[np.integer[Any]]) -> int:
    there = (bits & FLAG_CONTACT) != 0
    return int((there & ~np.concatenate(([False], there[:-1]))).sum())
