"""Between two parts of a run: messages that both of them have, after a crash of the recorder, are taken once.

The next recorder goes on where the last one said that it was. A chunk that was written but not yet reported is then in two
parts. What comes twice is told by its bytes, not by its time: clocks are set, and a run may count its cycles anew.
"""

from __future__ import annotations

from collections import defaultdict, deque

import numpy as np

from jtqd.daemon.logs.batch import Batch
from jtqd.daemon.logs.chunks import MESSAGE_HEAD

_SEQUENCE = 11
"""[byte] offset of a record's sequence number, behind opcode, length and channel."""
_TAIL_BATCHES, _TAIL_BYTES = 16, 64 << 20
"""What is kept of a part's end: the recorder may be some chunks ahead of its report, never more than the ring holds."""


class Seam:
    """Takes the batches of one part after the other, and gives back what is new in each."""

    def __init__(self) -> None:
        self._tails: defaultdict[str, deque[Batch]] = defaultdict(deque)
        self._before: dict[str, set[bytes]] = {}

    def next_part(self) -> None:
        """The next batches are of another part."""
        self._before = {
            topic: {record for batch in tail for record in _records(batch)}
            for topic, tail in self._tails.items()
        }
        self._tails.clear()

    def new(self, topic: str, batch: Batch) -> Batch:
        """The messages that the part before does not have. They can only be at the beginning of a part."""
        tail = self._tails[topic]
        tail.append(batch)
        while len(tail) > _TAIL_BATCHES or (len(tail) > 1 and sum(len(b.data) for b in tail) > _TAIL_BYTES):
            tail.popleft()
        before = self._before.get(topic)
        if not before:
            return batch
        fresh = np.array([record not in before for record in _records(batch)], np.bool_)
        if fresh.all():
            del self._before[topic]  # no more of it is looked at: a seam costs nothing behind it
            return batch
        return Batch(
            batch.channel, batch.data, batch.offsets[fresh], batch.log_times[fresh], batch.lengths[fresh]
        )


def _records(batch: Batch) -> list[bytes]:
    """The records of a batch from their sequence numbers and times on; the channel's number is the file's own."""
    begins = batch.offsets + _SEQUENCE
    ends = (batch.offsets + MESSAGE_HEAD.itemsize + batch.lengths.astype(np.int64)).tolist()
    return [batch.data[begin:end] for begin, end in zip(begins.tolist(), ends, strict=True)]
