"""Recorded messages as structured arrays: those of a topic of one file, or of the parts of one run.

The layout of a message follows from the ros2msg schema in the file and CDR's alignment, not from jtqd's code. Messages of
equal form are copied as rows, without a loop. Messages with sequences, or texts of changing length, are objects of the
`mcap` project's ROS 2 decoder (extra `ros2`), at its speed.
"""

from __future__ import annotations

import heapq
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import MESSAGE_HEAD, Batch, LogError, LogFile, pieces
from jtqd.daemon.logs.table import Table
from jtqd.daemon.recording.messages import CAN_FRAMES, FRAMES_NAMES
from jtqd.daemon.recording.run_files import ACTIVE, PART_PATTERN
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.status import DEGRADED, VALID

Records = NDArray[Any]
"""Messages as rows of a structured array [n]; as an array of the decoder's objects where they have no fixed form."""
_ENDINGS = (".mcap", f".mcap{ACTIVE}")


class Messages(NamedTuple):
    """Messages of a topic: log time [ns] and record of each [n]."""

    log_times: NDArray[np.uint64]
    records: Records


Logs = Path | str | Sequence[Path | str]
"""A log, a directory with the parts of one run, or the parts themselves."""


def read_topic(path: Logs, topic: str, *, start_ns: int | None = None, end_ns: int | None = None) -> Table:
    """Read all messages of a topic in the order of the files, one field per field of the schema [n].

    Nested messages are nested fields, `header.stamp.sec` is ["header"]["stamp"]["sec"]; `Table.columns` and
    `Table.to_pandas` flatten them. See `read_topics`.
    """
    return read_topics(path, (topic,), start_ns=start_ns, end_ns=end_ns)[topic]


def read_topics(
    path: Logs, topics: Sequence[str], *, start_ns: int | None = None, end_ns: int | None = None
) -> dict[str, Table]:
    """Messages of several topics as `read_topic` returns them, in one pass: unpacking the file is what takes the time.

    Args:
        path: a log, a directory with the parts of one run, or the parts themselves. A file that ends in `.active`
            is read as far as it is intact. Messages that two parts have come once.
        topics: names.
        start_ns, end_ns: log times from the first on, up to but without the second; None: no bound.

    Raises:
        LogError: no message on a topic in that time, a damaged file, or one whose messages cannot be decoded.
        OSError: a file cannot be read.
    """
    found = read_messages(path, topics, start_ns=start_ns, end_ns=end_ns)
    return {topic: messages.records.view(Table) for topic, messages in found.items()}


def read_messages(
    path: Logs, topics: Sequence[str], *, start_ns: int | None = None, end_ns: int | None = None
) -> dict[str, Messages]:
    """Read like `read_topics`, with the log time of every message."""
    parts = log_parts(path)
    tables = {topic: _Table(topic) for topic in topics}
    for piece in _pieces(parts, topics, start_ns, end_ns):
        tables[piece.topic].add(piece)
    for topic, table in tables.items():
        if not table.count:
            raise _no_message(parts, topic, start_ns, end_ns)
    return {topic: table.messages() for topic, table in tables.items()}


def _no_message(path: Logs, topic: str, start_ns: int | None, end_ns: int | None) -> LogError:
    span = "" if start_ns is None and end_ns is None else " in that time"
    there = ", ".join(sorted(topics_of(path)))
    return LogError(f"{log_parts(path)[0]}: found no message on {topic}{span}, expected one of {there}")


def iter_messages(
    path: Logs, topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Messages]:
    """Read one topic chunk by chunk, for logs larger than memory. Raises as `read_topics` does."""
    found = None
    for found in iter_topics(path, (topic,), start_ns=start_ns, end_ns=end_ns):
        yield found[topic]
    if found is None:
        raise _no_message(path, topic, start_ns, end_ns)


def iter_topics(
    path: Logs,
    topics: Sequence[str],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
    least: int = 1,
) -> Iterator[dict[str, Messages]]:
    """Messages of several topics, span by span: a span ends before a chunk with a topic that has `least` messages in it.

    Raises as `read_topics` does, but for a topic without a message, which is in no span.
    """
    tables: dict[str, _Table] = {}
    for piece in _pieces(log_parts(path), topics, start_ns, end_ns):
        if piece.topic in tables and tables[piece.topic].count >= least:
            yield _taken(tables)
        expected = 0 if least == 1 else min(piece.expected, least + _FIRST_ROWS)
        tables.setdefault(piece.topic, _Table(piece.topic)).add(piece._replace(expected=expected))
    if tables:
        yield _taken(tables)


def _taken(tables: dict[str, _Table]) -> dict[str, Messages]:
    """Return the messages of the tables, which are forgotten: they are freed when the caller drops them."""
    return {topic: tables.pop(topic).messages() for topic in list(tables)}


class _Piece(NamedTuple):
    """Messages of one topic out of one chunk; `expected`: those of the topic in the file, by its summary."""

    path: Path
    topic: str
    schema: Schema
    batch: Batch
    expected: int


def _pieces(
    parts: Sequence[Path], topics: Sequence[str], start_ns: int | None, end_ns: int | None
) -> Iterator[_Piece]:
    """Yield messages of the parts in their order; those that two parts have come once."""
    duplicates = _DuplicateFilter()
    for path in parts:
        with LogFile(path) as log:
            expected = log.expected if start_ns is None and end_ns is None else {}
            wanted = {
                number: (channel.topic, _schema(log, channel), expected.get(number, 0))
                for number, channel in log.channels.items()
                if channel.topic in topics
            }
            for batch in log.batches(wanted, start_ns, end_ns):
                topic, schema, count = wanted[batch.channel]
                fresh = duplicates.new(topic, batch) if len(parts) > 1 else batch
                if len(fresh.offsets):
                    yield _Piece(path, topic, schema, fresh, count)
        duplicates.next_part()


def topics_of(path: Logs) -> dict[str, str]:
    """Return the topics of a log and the names of their schemas. Raises LogError, OSError."""
    found = {}
    for part in log_parts(path):
        with LogFile(part) as log:
            for channel in log.channels.values():
                schema = log.schemas.get(channel.schema_id)
                found[channel.topic] = "" if schema is None else schema.name
    return found


def rmse(error: FloatArray) -> float:
    """Return the root of the mean square of the known values; NaN without any."""
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else float("nan")


def shadow_errors(state: Records, shadow: Records) -> dict[str, FloatArray]:
    """Return the error of each shadow method that was computed, by name: its torque less the sensor as old as it [n].

    state, shadow: /joint/N/state and /joint/N/shadow of the same cycles [n]. NaN but in motion, where the joint published a
    torque: these are the cycles of its own RMSE.
    """
    moving = np.isin(state["status"], (VALID, DEGRADED))
    names = [name.removesuffix("_age_ms") for name in shadow.dtype.names or () if name.endswith("_age_ms")]
    return {
        name: np.where(moving, shadow[f"{name}_torque_nm"] - shadow[f"{name}_reference_nm"], np.nan)
        for name in names
        if np.isfinite(shadow[f"{name}_age_ms"]).any()
    }


def _schema(log: LogFile, channel: Channel) -> Schema:
    """Schema of a channel whose messages can be decoded."""
    schema: Schema | None = log.schemas.get(channel.schema_id)
    where = f"{log.path}: {channel.topic}"
    if schema is None or schema.encoding != "ros2msg":
        found = "no" if schema is None else schema.encoding or "no"
        raise LogError(f"{where}: found {found} schema, expected ros2msg")
    if channel.message_encoding != "cdr":
        raise LogError(f"{where}: found messages in {channel.message_encoding}, expected cdr")
    return schema


def read_attachments(path: Logs) -> dict[str, bytes]:
    """Return attachments by name: those of the first part; of several with one name the last.

    Raises:
        LogError: the file, or an attachment, is damaged.
        OSError: it cannot be read.
    """
    with LogFile(log_parts(path)[0]) as log:
        return {index.name: log.attachment(index) for index in log.attachments}


def log_parts(path: Logs) -> list[Path]:
    """Return the files of one run in the order of writing.

    A directory may hold one run of jtqd, or any MCAP files that follow one another. Raises LogError for one with several
    runs, or none; OSError.
    """
    if not isinstance(path, Path | str):
        if not path:
            raise LogError("found no log, expected at least one")
        return _in_order([Path(each) for each in path])
    if not (path := Path(path)).is_dir():
        return [path]
    files = sorted(each for each in path.iterdir() if each.name.endswith(_ENDINGS) and each.is_file())
    if not files:
        raise LogError(f"{path}: found no *.mcap, expected the parts of one run")
    named = [PART_PATTERN.fullmatch(each.name) for each in files]
    runs = {found.group("prefix", "run") for found in named if found}
    if len(runs) > 1 or (runs and not all(named)):
        raise LogError(
            f"{path}: found {len(runs)} runs and other files, expected one run: name its files instead"
        )
    return _in_order(files)


def _in_order(paths: Sequence[Path]) -> list[Path]:
    """By part number where the names have one, else by the first log time, else as given."""
    named = [found for each in paths if (found := PART_PATTERN.fullmatch(each.name))]
    if len(named) == len(paths) and len({found.group("prefix", "run") for found in named}) == 1:
        return [path for _, path in sorted(zip([int(n["part"]) for n in named], paths, strict=True))]
    return list(paths) if len(paths) == 1 else sorted(paths, key=_start_ns)


def _start_ns(path: Path) -> int:
    with LogFile(path) as log:
        return log.start_ns


# ---- fixed rows ----

_PRIMITIVES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    **{f"{sign}int{8 * size}": f"<{sign or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)},
    "float32": "<f4",
    "float64": "<f8",
}
"""Type -> numpy's code."""
_MAX_DEPTH = 32
"""Levels of nested types."""
_FIELD = re.compile(r"(?P<kind>[\w/]+)(?:\[(?P<elements>\d+)\])?\s+(?P<name>[a-z]\w*)")
_CONSTANT = re.compile(r"[\w<=/]+\s+[A-Z]\w*\s*=")
_NESTED = re.compile(r"^=+\s*\nMSG: (\S+)[^\n]*\n", re.MULTILINE)
_Fields = list[tuple[str, int | None, str]]
"""Type, elements of a fixed array, name."""


class _VariableError(LogError):
    """Messages of this type have no fixed rows: sequences, texts in arrays, or what only the library's parser knows."""


@lru_cache(maxsize=16)
def _types_of(text: str) -> dict[str, _Fields | None]:
    """Fields of the message ("") and of every nested type; None where a line is not a plain field."""
    first, *rest = _NESTED.split(text.replace("\r\n", "\n"))
    nested = {name.replace("/msg/", "/"): body for name, body in zip(rest[::2], rest[1::2], strict=True)}
    return {name: _fields(body) for name, body in {"": first, **nested}.items()}


def _fields(text: str) -> _Fields | None:
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    found = [_FIELD.fullmatch(line) for line in lines if line and not _CONSTANT.match(line)]
    fields = [(f["kind"], int(f["elements"]) if f["elements"] else None, f["name"]) for f in found if f]
    names = {name for *_, name in fields}
    return fields if fields and len(names) == len(found) else None


class _Layout:
    """Layout of messages of one form: their rows, and where the lengths of their texts stand.

    Every primitive lies at a multiple of its own size, counted from the first byte behind the encapsulation. The lengths of
    texts are those of an example; a message with others has another form.

    Args:
        types: of the schema.
        example: payload of one message.

    Raises:
        _VariableError: messages of this schema have no fixed form.
        LogError: the example does not fit the schema.
    """

    def __init__(self, types: Mapping[str, _Fields | None], example: bytes) -> None:
        self._types, self._example = types, example
        self.size = len(example)
        self.lengths: list[tuple[int, int]] = []
        """(offset, value) of every length in a payload, unsigned 32 bit."""
        if example[:2] != _LITTLE_ENDIAN:
            raise _VariableError("found another encapsulation, expected little endian CDR")
        names, formats, offsets, end = self._members("", 4, 0)
        if not 0 <= self.size - end < 8:  # what is left can only be padding
            raise LogError(f"found {self.size - 4} bytes, expected {end - 4} by the schema")
        self.dtype = _struct(names, formats, offsets, self.size)

    def _members(self, name: str, at: int, depth: int) -> tuple[list[str], list[Any], list[int], int]:
        fields = self._types.get(name.replace("/msg/", "/"))
        if fields is None or depth > _MAX_DEPTH:
            raise _VariableError(f"found {name!r}, expected plain fields")
        names, formats, offsets = [], [], []
        for kind, elements, field in fields:
            begin, layout = self._one(kind, at, depth)
            if elements is not None:
                layout = self._array(kind, begin, layout, elements, depth)
            names.append(field)
            formats.append(layout)
            offsets.append(begin)
            at = begin + layout.itemsize
        return names, formats, offsets, at

    def _array(
        self, kind: str, begin: int, layout: np.dtype[Any], elements: int, depth: int
    ) -> np.dtype[Any]:
        if elements * max(layout.itemsize, 1) > self.size:
            raise LogError(f"found an array of {elements} {kind} in a message of {self.size - 4} bytes")
        known = len(self.lengths)
        again = self._one(kind, begin + layout.itemsize, depth)
        if kind == "string" or again != (begin + layout.itemsize, layout) or len(self.lengths) != known:
            raise _VariableError(f"found an array of {kind} whose elements differ in form")
        return np.dtype((layout, (elements,)))

    def _one(self, kind: str, at: int, depth: int) -> tuple[int, np.dtype[Any]]:
        """Return where a value that follows byte `at` begins, and its type."""
        if kind in _PRIMITIVES:
            layout: np.dtype[Any] = np.dtype(_PRIMITIVES[kind])
            return at + -(at - 4) % layout.itemsize, layout
        if kind == "string":
            at += -at % 4
            length = int.from_bytes(self._example[at : at + 4], "little")  # with the closing zero
            if not 0 < length <= self.size - at - 4:
                raise LogError(f"found a length of {length} in a message of {self.size - 4} bytes")
            self.lengths.append((at, length))
            return at + 4, np.dtype(f"S{length}")
        names, formats, offsets, end = self._members(kind, at, depth + 1)
        return at, _struct(names, formats, [offset - at for offset in offsets], end - at)


def _struct(names: list[str], formats: list[Any], offsets: list[int], size: int) -> np.dtype[Any]:
    made = {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    return np.dtype(made)  # type: ignore[call-overload,no-any-return]


_LITTLE_ENDIAN = b"\0\1"
"""First bytes of a payload in plain CDR."""
_PAYLOAD = MESSAGE_HEAD.itemsize
_FIRST_ROWS = 4096


class _Table:
    """Messages of one topic, of one file after the other."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._first: _Piece | None = None
        self._layout: _Layout | None = None
        self._decode: Callable[[bytes], Any] | None = None
        self._rows: NDArray[Any] = np.empty(0, "V1")
        self._times = np.empty(0, np.uint64)
        self.count = 0

    def add(self, piece: _Piece) -> None:
        """Take messages in. Raises LogError, also for another schema than the first one's."""
        first = self._first or piece
        if piece.schema.data != first.schema.data:
            raise LogError(
                f"{piece.path}: {self._topic}: found another schema than in {first.path}, expected the same"
            )
        try:
            if self._first is None:
                self._begin(piece)
            rows = None if self._layout is None else self._rows_of(piece.batch, self._layout)
            if rows is None:
                self._decode_singly(first.schema)
                rows = self._decoded(_payloads(piece.batch))
        except LogError as error:
            raise LogError(f"{piece.path}: {self._topic}: {error}") from None
        self._put(rows, piece.batch.log_times, self.count + piece.expected)

    def _begin(self, piece: _Piece) -> None:
        batch, self._first = piece.batch, piece
        begin = int(batch.offsets[0]) + _PAYLOAD
        try:
            types = _types_of(piece.schema.data.decode())
            self._layout = _Layout(types, batch.data[begin : begin + int(batch.lengths[0])])
        except UnicodeDecodeError:
            raise LogError("found a schema that is no text") from None
        except _VariableError:
            self._layout = None

    def messages(self) -> Messages:
        """Return all messages so far."""
        rows = self._rows[: self.count]
        return Messages(
            self._times[: self.count], rows if self._layout is None else rows.view(self._layout.dtype)
        )

    def _rows_of(self, batch: Batch, layout: _Layout) -> NDArray[np.void] | None:
        """Return the payloads as rows of plain bytes; None where they are not all of the layout's form."""
        if (batch.lengths != layout.size).any():
            return None
        if batch.step:
            begin, count = int(batch.offsets[0]) + _PAYLOAD, len(batch.offsets)
            rows: NDArray[np.void] = np.ndarray((count,), f"V{layout.size}", batch.data, begin, (batch.step,))
        else:
            rows = pieces(batch.data, batch.offsets + _PAYLOAD, layout.size)
        expected = [(0, "<u2", 0x0100), *((place, "<u4", length) for place, length in layout.lengths)]
        for place, kind, value in expected:
            if (rows.view(_struct(["it"], [kind], [place], layout.size))["it"] != value).any():
                return None
        return rows

    def _decode_singly(self, schema: Schema) -> None:
        """Decode the messages so far, and all that follow, one by one: they differ in form."""
        if self._decode is None:
            self._decode = _decoder(schema)
            self._rows = self._decoded([row.tobytes() for row in self._rows[: self.count]])
            self._layout = None

    def _decoded(self, payloads: list[bytes]) -> NDArray[Any]:
        assert self._decode is not None
        found = np.empty(len(payloads), object)
        try:
            for n, payload in enumerate(payloads):
                found[n] = self._decode(payload)
        except Exception as error:  # of the library's decoder: whatever bytes can do to it
            what = str(error) or type(error).__name__
            raise LogError(f"found a message that cannot be decoded: {what}") from None
        return found

    def _put(self, rows: NDArray[Any], times: NDArray[np.uint64], expected: int) -> None:
        end = self.count + len(rows)
        if end > len(self._rows):
            self._rows = _grown(self._rows, rows.dtype, max(end, expected, _FIRST_ROWS), self.count)
        if end > len(self._times):
            self._times = _grown(self._times, self._times.dtype, len(self._rows), self.count)
        self._rows[self.count : end] = rows
        self._times[self.count : end] = times
        self.count = end


def _decoder(schema: Schema) -> Callable[[bytes], Any]:
    """Return the library's decoder of one message. Raises LogError: it is not installed, or does not take the schema."""
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise LogError(
            "found messages of changing length, expected a decoder for them: pip install 'jtqd[ros2]'"
        ) from None
    try:
        decode = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # of the library's parser: whatever a text can do to it
        raise LogError(f"found a schema that cannot be decoded: {error}") from None
    assert decode is not None, "the schema is ros2msg, the messages are CDR"
    return decode


def _grown(old: NDArray[Any], kind: np.dtype[Any], least: int, used: int) -> NDArray[Any]:
    """Return a longer array; what is not written yet takes no memory."""
    new = np.empty(max(least, 2 * len(old)), kind)
    new[:used] = old[:used]
    return new


def _payloads(batch: Batch) -> list[bytes]:
    begins = (batch.offsets + _PAYLOAD).tolist()
    return [batch.data[at : at + size] for at, size in zip(begins, batch.lengths.tolist(), strict=True)]


# ---- parts ----

_SEQUENCE = 11
"""[byte] offset of a record's sequence number, behind opcode, length and channel."""
_TAIL_BATCHES, _TAIL_BYTES = 16, 64 << 20
"""What is kept of a part's end: the recorder may be some chunks ahead of its report, never more than the ring holds."""


class _DuplicateFilter:
    """Takes the batches of one part after the other, and gives back what is new in each.

    A killed recorder may have written a chunk that it had not reported: the next recorder writes its cycles again, into the
    next part. Duplicates are recognised by their bytes: clocks are set, and a run may count its cycles from 0 again.
    """

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
        """Return the messages that the part before does not have. They can only be at the beginning of a part."""
        tail = self._tails[topic]
        tail.append(batch)
        while len(tail) > _TAIL_BATCHES or (len(tail) > 1 and sum(len(b.data) for b in tail) > _TAIL_BYTES):
            tail.popleft()
        before = self._before.get(topic)
        if not before:
            return batch
        fresh = np.array([record not in before for record in _records(batch)], np.bool_)
        if fresh.all():
            del self._before[topic]  # no more of it is looked at: what follows costs nothing
            return batch
        return batch.only(fresh)


def _records(batch: Batch) -> list[bytes]:
    """The records of a batch from their sequence numbers and times on; the channel's number is the file's own."""
    begins = (batch.offsets + _SEQUENCE).tolist()
    ends = (batch.offsets + _PAYLOAD + batch.lengths.astype(np.int64)).tolist()
    return [batch.data[begin:end] for begin, end in zip(begins, ends, strict=True)]


# ---- CAN frames (`jtqd_msgs/CanFrames`) ----

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Bits of `can_id` as in Linux: 29-bit identifier, remote frame, error frame."""


class Frames(NamedTuple):
    """n frames in the order of the log."""

    stamps_ns: NDArray[np.int64]
    """CLOCK_REALTIME; receive time by the kernel, where it is known."""
    ids: NDArray[np.uint32]
    """With the bits of Linux."""
    lengths: NDArray[np.uint8]
    data: NDArray[np.uint8]
    """[n, 8], zeros behind the length."""

    def rows(self) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield stamp, identifier, length and data of each frame."""
        numbers = self.stamps_ns.tolist(), self.ids.tolist(), self.lengths.tolist()
        for stamp, can_id, length, data in zip(*numbers, self.data, strict=True):
            yield stamp, can_id, length, data[:length].tobytes()


def can_topics(path: Logs) -> list[str]:
    """Topics that carry CAN frames. Raises LogError where there is none, OSError."""
    found = [topic for topic, schema in topics_of(path).items() if schema in FRAMES_NAMES]
    if not found:
        raise LogError(f"{path}: found no topic with CAN frames, expected {FRAMES_NAMES[0]}")
    return sorted(found)


def iter_frames(
    path: Logs, topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Frames]:
    """Yield frames of one topic, chunk by chunk. Raises LogError, OSError."""
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        records = messages.records
        names = ", ".join(records.dtype.names or ())
        if not all(each in names for each in ("frames", "frame_count", "stamps_ns")):
            raise LogError(f"{path}: {topic}: found fields {names}, expected those of CAN frames")
        frames, stamps = records["frames"], records["stamps_ns"].astype(np.int64)
        present = np.arange(frames.shape[1]) < records["frame_count"][:, None]
        # A frame without a stamp of the kernel has that of its message.
        stamps = np.where(stamps == 0, messages.log_times.astype(np.int64)[:, None], stamps)
        lengths = np.minimum(frames["length"][present], 8).astype(np.uint8)
        data = np.where(np.arange(8) < lengths[:, None], frames["data"][present], 0).astype(np.uint8)
        yield Frames(stamps[present], frames["id"][present], lengths, data)


def iter_bus(
    path: Logs, topics: Sequence[str], *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[tuple[str, int, int, int, bytes]]:
    """Yield topic, stamp [ns], identifier, length and data of each frame of these topics by their stamps.

    Raises LogError, OSError.
    """

    def frames_of(topic: str) -> Iterator[tuple[str, int, int, int, bytes]]:
        for frames in iter_frames(path, topic, start_ns=start_ns, end_ns=end_ns):
            for row in frames.rows():
                yield topic, *row

    return heapq.merge(*map(frames_of, topics), key=itemgetter(1))


def interface_of(topic: str) -> str:
    """Return the name of the interface whose frames a topic has: can1 of /can1/frames; "" for that of jtqd's own frames."""
    return "" if topic == CAN_FRAMES.name else topic.removesuffix("/frames").strip("/")


# ---- the estimate on the bus, and the torque sensor ----

_ESTIMATE_COB_ID = 0x1A0
_NO_TORQUE = -0x8000
_TORQUE_UNIT_NM = 0.01
_NS = 1e-9


def published_torque(frames: Records, joint: int) -> FloatArray:
    """Return the torque [Nm] of joint 0 or 1 in the estimate PDO of each cycle [n]; NaN: no PDO, or one without a torque."""
    raw = frames["frames"]
    at = (raw["id"] == _ESTIMATE_COB_ID) & (np.arange(raw.shape[1]) < frames["frame_count"][:, None])
    data = raw["data"][np.arange(len(raw)), np.argmax(at, axis=1)]
    counts = np.ascontiguousarray(data[:, 2 * joint : 2 * joint + 2]).view("<i2")[:, 0]
    return np.where(at.any(axis=1) & (counts != _NO_TORQUE), counts * _TORQUE_UNIT_NM, np.nan)


def sync_time(stamp: Records) -> FloatArray:
    """Return the time of each SYNC since the first [s]."""
    whole = (stamp["sec"].astype(np.int64) - int(stamp["sec"][0])) * 1_000_000_000
    return np.asarray((whole + stamp["nanosec"] - int(stamp["nanosec"][0])) * _NS)


def reference_torque(state: Records, time_s: FloatArray, bandwidth_rad_s: float) -> FloatArray:
    """Return the sensor torque [Nm] as received through the observer's low-pass; NaN where no sensor value came."""
    from jtqd.estimator.observer import low_pass  # a third of the time that importing this module takes

    sensor = state["sensor_torque_nm"]
    there = np.isfinite(sensor)
    result = np.full(len(sensor), np.nan)
    if there.any():
        dt_s = np.diff(time_s[there], prepend=time_s[there][0])
        result[there] = low_pass(sensor[there], dt_s, bandwidth_rad_s)
    return result
