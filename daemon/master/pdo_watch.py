"""Deadline and length of each input PDO, from the loop's counts: errors 8250h, 8210h and 8220h, each by itself. Pure.

The loop decides per cycle; this says what lasts. A PDO has timed out (8250h) when it brought no valid input for
`TIMEOUT_CYCLES` cycles in a row, and is back with the next valid one. A frame of a wrong length is never used: a short one
cannot be (8210h), and of a longer one CiA 301 allows to take the first bytes (8220h), but a node that sends another length
than was configured has lost its mapping, and then the first bytes are not what we think they are. These errors are over when
none came for `LENGTH_S`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from daemon.shared.snapshot_view import InputView
from drivers.emcy import PDO_LONG, PDO_SHORT, PDO_TIMEOUT

TIMEOUT_CYCLES = 20
LENGTH_S = 1.0


class WatchedPdo(NamedTuple):
    """One input PDO: identifier, producer, name for people, and the joints that need it (bit 0 joint 1, bit 1 joint 2)."""

    cob_id: int
    node: int
    name: str
    joints: int


class PdoEvent(NamedTuple):
    """An error has come (`present`) or gone."""

    code: int
    pdo: WatchedPdo
    present: bool


class _State:
    def __init__(self) -> None:
        self.missed = -1  # nothing has been read yet
        self.in_a_row = 0
        self.short = self.long = 0
        self.timed_out = False
        self.until = {PDO_SHORT: 0.0, PDO_LONG: 0.0}
        self.present = {PDO_SHORT: False, PDO_LONG: False}


class PdoWatch:
    """Call `events` with each reading of the snapshot; `pdos` in the order of the snapshot's inputs."""

    def __init__(self, pdos: Sequence[WatchedPdo]) -> None:
        self._pdos = [(pdo, _State()) for pdo in pdos]

    def events(self, inputs: Sequence[InputView], absent: Collection[int], now_s: float) -> list[PdoEvent]:
        """What has come or gone; PDOs of `absent` nodes (optional ones) are not missed."""
        told: list[PdoEvent] = []
        for (pdo, state), seen in zip(self._pdos, inputs, strict=False):
            # A loss between two readings, over by now, counts too, with what the last reading saw of it.
            missed = 0 if state.missed < 0 else seen.missed - state.missed
            if missed:
                missed += state.in_a_row
            state.missed, state.in_a_row = seen.missed, seen.in_a_row
            expected = pdo.node not in absent
            timed_out = seen.in_a_row >= TIMEOUT_CYCLES and expected
            if timed_out != state.timed_out:
                told.append(PdoEvent(PDO_TIMEOUT, pdo, timed_out))
            elif not timed_out and missed - seen.in_a_row >= TIMEOUT_CYCLES and expected:
                told += [PdoEvent(PDO_TIMEOUT, pdo, True), PdoEvent(PDO_TIMEOUT, pdo, False)]
            state.timed_out = timed_out
            for code, count, before in (
                (PDO_SHORT, seen.short, state.short),
                (PDO_LONG, seen.long, state.long),
            ):
                if count != before:
                    state.until[code] = now_s + LENGTH_S
                present = now_s < state.until[code]
                if present != state.present[code]:
                    told.append(PdoEvent(code, pdo, present))
                    state.present[code] = present
            state.short, state.long = seen.short, seen.long
        return told
