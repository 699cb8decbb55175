"""States of the estimators in a log (/joint/N/zeros): from them a replay goes on where it does not know its own.

One comes about once a second, of an estimator that tracks zeros. It is the state just after a cycle, so it belongs before
the next row. Those of another layout than this jtqd's say nothing here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from jtqd.daemon.logs import LogFile, iter_messages
from jtqd.daemon.recording.schemas import ZEROS
from jtqd.daemon.replay.origin import PAST, STATE, check_fields
from jtqd.estimator.learned import PAST_LAYOUT


@dataclass(frozen=True)
class Pasts:
    """States of one joint's estimator.

    Attributes:
        cycle: after which each holds, increasing [n].
        content: `FusedEstimator.past` of each [n].
    """

    cycle: npt.NDArray[np.uint64]
    content: tuple[bytes, ...]

    def within(self, first: int, last: int) -> Pasts:
        """Return those of the cycles `first` to `last`."""
        here = (self.cycle >= first) & (self.cycle <= last)
        return Pasts(self.cycle[here], tuple(self.content[n] for n in np.flatnonzero(here)))

    def rows(self, cycle: npt.NDArray[np.uint64]) -> dict[int, bytes]:
        """Return the states by the row of `cycle` [n] before which they hold: the one behind that of their cycle."""
        rows = np.searchsorted(cycle, self.cycle, side="right").tolist()
        return {
            row: content
            for row, after, content in zip(rows, self.cycle.tolist(), self.content, strict=True)
            if 0 < row < len(cycle) and int(cycle[row - 1]) == after
        }


NO_PASTS = Pasts(np.zeros(0, np.uint64), ())


def joined(every: Sequence[Pasts]) -> Pasts:
    """Return the states of several parts in the order of their cycles, each once."""
    cycle, first = np.unique(np.concatenate([each.cycle for each in every]), return_index=True)
    content = [state for each in every for state in each.content]
    return Pasts(cycle, tuple(content[n] for n in first.tolist()))


def read_pasts(path: Path, joints: int) -> tuple[Pasts, ...]:
    """Return the states of each joint in a log. Raises LogError, OSError."""
    with LogFile(path) as log:
        there = {each.topic for n, each in log.channels.items() if not log.counts or log.counts.get(n)}
    return tuple(_read(path, each.name) if each.name in there else NO_PASTS for each in ZEROS[:joints])


def _read(path: Path, topic: str) -> Pasts:
    cycles: list[int] = []
    content: list[bytes] = []
    for messages in iter_messages(path, topic):
        records = messages.records
        check_fields(records, PAST, path, topic)
        records = records[records["past_layout"] == PAST_LAYOUT]
        if len(records):
            check_fields(records, STATE, path, topic)
        for record in records:
            cycles.append(int(record["cycle"]))
            content.append(record["past"].tobytes()[: int(record["past_bytes"])])
    order = np.argsort(np.array(cycles, np.uint64), kind="stable").tolist()
    return Pasts(np.array([cycles[n] for n in order], np.uint64), tuple(content[n] for n in order))
