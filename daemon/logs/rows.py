"""From batches of messages to one structured array: rows copied as they lie, or decoded one by one where they do not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.batch import Batch
from jtqd.daemon.logs.cdr import Decoder
from jtqd.daemon.logs.chunks import MESSAGE_HEAD, pieces
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.layout import Layout, VariableLayoutError, message_layout
from jtqd.daemon.logs.ros2msg import Types, types_of

Records = NDArray[np.void]

_ENCAPSULATION = 0x0100
"""Plain CDR, little endian, as an unsigned 16 bit number."""
_PAYLOAD = MESSAGE_HEAD.itemsize
_FIRST_ROWS = 4096


class Collector:
    """Takes batches of one topic, of one file after the other."""

    def __init__(self, topic: str, path: Path) -> None:
        self._topic, self._path = topic, path
        self._text: str | None = None
        self._types = Types("")
        self._layout: Layout | None = None
        self._length = 0
        self._decoder: Decoder | None = None
        self._rows: NDArray[Any] | None = None
        self._times = np.empty(_FIRST_ROWS, np.uint64)
        self.count = 0

    def begin(self, path: Path, schema: str) -> None:
        """The next batches are from this file and of this schema. Raises LogError where it differs from that before."""
        if self._text is not None and schema != self._text:
            raise LogError(
                f"{path}: {self._topic}: found another schema than in {self._path}, expected the same"
            )
        if self._text is None:
            self._path, self._text, self._types = path, schema, types_of(schema)

    def add(self, batch: Batch) -> None:
        """Take messages in. Raises LogError."""
        if not len(batch.offsets):
            return
        try:
            if self._decoder is None and not self._take_rows(batch):
                self._change_over()
            if self._decoder is not None:
                self._put(self._decoder.rows(_payloads(batch)), batch.log_times)
        except LogError as error:
            raise LogError(f"{self._path}: {self._topic}: {error}") from None

    def result(self) -> tuple[NDArray[np.uint64], Records]:
        """Log times [n] and records [n]."""
        rows: Records = np.empty(0, [("none", "u1")]) if self._rows is None else self._rows[: self.count]
        if self._decoder is None and self._layout is not None:
            rows = rows.view(_payload_dtype(self._layout.dtype, self._length))
        return self._times[: self.count], rows

    def _take_rows(self, batch: Batch) -> bool:
        """Copy the messages as rows; False where they are not of one form."""
        if self._layout is None:
            example = batch.data[int(batch.offsets[0]) + _PAYLOAD :][: int(batch.lengths[0])]
            if len(example) < 4 or example[0] or example[1] != 1:
                return False
            try:
                self._layout = message_layout(self._types, example[4:])
            except VariableLayoutError:
                return False
            self._length = len(example)
            left = len(example) - 4 - self._layout.dtype.itemsize
            if not 0 <= left < 8:  # what is left can only be padding
                raise LogError(
                    f"found {len(example) - 4} bytes, expected {self._layout.dtype.itemsize} by the schema"
                )
        if (batch.lengths != self._length).any():
            return False
        # The row is the whole payload: its fields begin behind the encapsulation.
        rows = pieces(batch.data, batch.offsets + _PAYLOAD, self._length)
        if (_column(rows, 0, "<u2") != _ENCAPSULATION).any():
            return False
        for place, length in self._layout.lengths:
            if (_column(rows, 4 + place, "<u4") != length).any():
                return False
        self._put(rows, batch.log_times)
        return True

    def _change_over(self) -> None:
        """Messages turn out to differ in form: from here on, and for those that are there, the generic decoder."""
        self._decoder = Decoder(self._types)
        if self._rows is not None:
            kept = np.empty(max(self.count, _FIRST_ROWS), self._decoder.dtype)
            kept[: self.count] = self._decoder.rows([row.tobytes() for row in self._rows[: self.count]])
            self._rows = kept

    def _put(self, rows: NDArray[Any], times: NDArray[np.uint64]) -> None:
        end = self.count + len(rows)
        if self._rows is None:
            self._rows = np.empty(max(_FIRST_ROWS, len(rows)), rows.dtype)
        if end > len(self._rows):
            self._rows = _grown(self._rows, end, self.count)
        if end > len(self._times):
            self._times = _grown(self._times, end, self.count)
        self._rows[self.count : end] = rows
        self._times[self.count : end] = times
        self.count = end


def _grown(old: NDArray[Any], least: int, used: int) -> NDArray[Any]:
    """A longer array; what is not written yet takes no memory."""
    new = np.empty(max(least, 2 * len(old)), old.dtype)
    new[:used] = old[:used]
    return new


def _column(rows: NDArray[np.void], offset: int, kind: str) -> NDArray[Any]:
    """One number of each row [n]."""
    return np.ndarray((len(rows),), np.dtype(kind), rows, offset, (rows.dtype.itemsize,))


def _payload_dtype(fields: np.dtype[Any], length: int) -> np.dtype[Any]:
    """A payload of that length whose fields lie behind the encapsulation."""
    names, places = fields.names or (), dict(fields.fields or {})
    made = {
        "names": list(names),
        "formats": [fields[name] for name in names],
        "offsets": [4 + places[name][1] for name in names],
        "itemsize": length,
    }
    return np.dtype(made)  # type: ignore[call-overload,no-any-return]


def _payloads(batch: Batch) -> list[bytes]:
    data = batch.data
    begins = (batch.offsets + _PAYLOAD).tolist()
    return [
        data[begin : begin + length] for begin, length in zip(begins, batch.lengths.tolist(), strict=True)
    ]
