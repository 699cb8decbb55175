"""Whose turn it is: one drive gets a set-point in each cycle, so that the bus carries one more frame and never two. Pure."""

from __future__ import annotations

from collections.abc import Sequence


def turns(moved: Sequence[int], drives: int) -> tuple[tuple[int, ...], int]:
    """Return the drives (0, 1, ..) in the order of their set-points, and the cycles from one of a moved drive to its next.

    moved: numbers (1, 2, ..) of the joints that are moved, among so many drives; the others are held. Those moved take
    turns, and after each round comes one of those held:

        two of two 0 1          one of one 0          one of three 0 1, 0 2          two of three 0 1 2
    """
    own = tuple(number - 1 for number in moved)
    held = [drive for drive in range(drives) if drive not in own]
    if not held:
        return own, len(own)
    return tuple(turn for drive in held for turn in (*own, drive)), len(own) + 1
