"""Read recorded messages: those of a topic of one or several MCAP files as one structured array.

The layout comes from the schema text in the file (ros2msg) and CDR's alignment rules, not from jtqd's code. Messages of
jtqd's topics have one length each (`docs/recording.md`), so that a chunk is read as an array of rows, without a loop over
messages. Where lengths change, as in other writers' files and in texts, every message is decoded on its own by the `mcap`
project's ROS 2 decoder (extra `ros2`).
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.container import MESSAGE_HEAD, LogError, pieces
from jtqd.daemon.logs.layout import PRIMITIVES, Layout, Types, VariableLayoutError, message_layout, types_of
from jtqd.daemon.logs.log_file import Batch, LogFile
from jtqd.daemon.recording.own_files import ACTIVE, PART_PATTERN

Records = NDArray[np.void]
"""Messages as rows of a structured array [n]."""
_ENDINGS = (".mcap", f".mcap{ACTIVE}")


class Messages(NamedTuple):
    """Messages of a topic: log time [ns] and record of each [n]."""

    log_times: NDArray[np.uint64]
    records: Records


def read_topic(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Records:
    """Read all messages of a topic in the order of the files, one field per field of the schema [n].

    Nested messages are nested fields, `header.stamp.sec` is ["header"]["stamp"]["sec"]. See `read_topics`.
    """
    return read_topics(path, (topic,), start_ns=start_ns, end_ns=end_ns)[topic]


def read_topics(
    path: Path | Sequence[Path],
    topics: Sequence[str],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> dict[str, Records]:
    """Messages of several topics as `read_topic` returns them, in one pass: unpacking the file is what takes the time.

    Args:
        path: a log, a directory with the parts of one run, or the parts themselves. A file that ends in `.active`
            is read as far as it is there. Messages that two parts have come once.
        topics: names.
        start_ns, end_ns: log times from the first on, up to but without the second; None: no bound.

    Raises:
        LogError: no message on a topic in that time, a damaged file, or one whose messages cannot be decoded.
        OSError: a file cannot be read.
    """
    found = read_messages(path, topics, start_ns=start_ns, end_ns=end_ns)
    return {topic: messages.records for topic, messages in found.items()}


def read_messages(
    path: Path | Sequence[Path],
    topics: Sequence[str],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> dict[str, Messages]:
    """Read like `read_topics`, with the log time of every message."""
    parts = log_parts(path)
    collectors = {topic: _Collector(topic, parts[0]) for topic in topics}
    for part in _pieces(parts, topics, start_ns, end_ns):
        collector = collectors[part.topic]
        collector.begin(part.path, part.schema, part.expected)
        collector.add(part.batch)
    span = "" if start_ns is None and end_ns is None else " in that time"
    for topic, collector in collectors.items():
        if not collector.count:
            raise LogError(f"{parts[0]}: found no message on {topic}{span}, expected one per cycle")
    return {topic: Messages(*collector.result()) for topic, collector in collectors.items()}


def iter_messages(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Messages]:
    """Read one topic chunk by chunk, for logs larger than memory. Raises as `read_topics` does."""
    for found in iter_topics(path, (topic,), start_ns=start_ns, end_ns=end_ns):
        yield found[topic]


def iter_topics(
    path: Path | Sequence[Path],
    topics: Sequence[str],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[dict[str, Messages]]:
    """Messages of several topics, span by span: of each topic those of one chunk, until the next chunk has that topic too.

    Raises as `read_topics` does.
    """
    found: dict[str, Messages] = {}
    for part in _pieces(log_parts(path), topics, start_ns, end_ns):
        if part.topic in found:
            yield found
            found = {}
        collector = _Collector(part.topic, part.path)
        collector.begin(part.path, part.schema)
        collector.add(part.batch)
        if collector.count:
            found[part.topic] = Messages(*collector.result())
    if found:
        yield found


class _Piece(NamedTuple):
    """Messages of one topic out of one chunk, with their file and schema."""

    path: Path
    topic: str
    schema: Schema
    batch: Batch
    expected: int
    """Messages of the topic in the file, as it says."""


def _pieces(
    parts: Sequence[Path], topics: Sequence[str], start_ns: int | None, end_ns: int | None
) -> Iterator[_Piece]:
    """Yield messages of the parts in their order; those that two parts have come once."""
    filtered = _DuplicateFilter() if len(parts) > 1 else None
    for path in parts:
        with LogFile(path) as log:
            expected = log.expected if start_ns is None and end_ns is None else {}
            wanted = {
                number: (channel.topic, _schema(log, path, channel), expected.get(number, 0))
                for number, channel in log.channels.items()
                if channel.topic in topics
            }
            for batch in log.batches(list(wanted), start_ns, end_ns):
                topic, schema, promised = wanted[batch.channel]
                fresh = batch if filtered is None else filtered.new(topic, batch)
                yield _Piece(path, topic, schema, fresh, promised)
        if filtered is not None:
            filtered.next_part()


def topics_of(path: Path | Sequence[Path]) -> dict[str, str]:
    """Return the topics of a log and the names of their schemas. Raises LogError, OSError."""
    found = {}
    for part in log_parts(path):
        with LogFile(part) as log:
            for channel in log.channels.values():
                schema = log.schemas.get(channel.schema_id)
                found[channel.topic] = "" if schema is None else schema.name
    return found


def _schema(log: LogFile, path: Path, channel: Channel) -> Schema:
    """Schema of a channel whose messages can be decoded."""
    schema: Schema | None = log.schemas.get(channel.schema_id)
    if schema is None or schema.encoding != "ros2msg":
        found = "no" if schema is None else schema.encoding or "no"
        raise LogError(f"{path}: {channel.topic}: found {found} schema, expected ros2msg")
    if channel.message_encoding != "cdr":
        raise LogError(f"{path}: {channel.topic}: found messages in {channel.message_encoding}, expected cdr")
    return schema


def read_attachments(path: Path | Sequence[Path]) -> dict[str, bytes]:
    """Return attachments by name: those of the first part; of several with one name the last.

    Raises:
        LogError: the file, or an attachment, is damaged.
        OSError: it cannot be read.
    """
    with LogFile(log_parts(path)[0]) as log:
        return {index.name: log.attachment(index) for index in log.attachments}


def log_parts(path: Path | Sequence[Path]) -> list[Path]:
    """Return the files of one run in the order of writing.

    A directory may hold one run of jtqd, or any MCAP files that follow one another. Raises LogError for one with several
    runs, or none; OSError.
    """
    if not isinstance(path, Path):
        if not path:
            raise LogError("found no log, expected at least one")
        return _in_order(path)
    if not path.is_dir():
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


def _in_order(paths: Iterable[Path]) -> list[Path]:
    """By part number where the names have one, else by the first log time, else as given."""
    given = list(paths)
    if len(given) == 1:
        return given
    named = [PART_PATTERN.fullmatch(each.name) for each in given]
    if all(named) and len({found.group("prefix", "run") for found in named if found}) == 1:
        numbers = [int(found["part"]) for found in named if found]
        return [path for _, path in sorted(zip(numbers, given, strict=True))]
    starts = []
    for n, path in enumerate(given):
        with LogFile(path) as log:
            starts.append((log.start_ns, n, path))
    return [path for *_, path in sorted(starts)]


# ---- rows ----


_ENCAPSULATION = 0x0100
"""Plain CDR, little endian, as an unsigned 16 bit number."""
_PAYLOAD = MESSAGE_HEAD.itemsize
_FIRST_ROWS = 4096


class _Collector:
    """Takes batches of one topic, of one file after the other."""

    def __init__(self, topic: str, path: Path) -> None:
        self._topic, self._path = topic, path
        self._file: Path | None = None
        self._promised = _FIRST_ROWS
        self._schema: Schema | None = None
        self._types = Types("")
        self._layout: Layout | None = None
        self._length = 0
        self._decoder: _Decoder | None = None
        self._rows: NDArray[Any] | None = None
        self._times = np.empty(0, np.uint64)
        self.count = 0

    def begin(self, path: Path, schema: Schema, expected: int = 0) -> None:
        """The next batches are from this file and of this schema. Raises LogError where it differs from that before.

        expected: messages in the file, to make room for them at once.
        """
        if path != self._file:
            self._file, self._promised = path, max(_FIRST_ROWS, self.count + expected)
        if self._schema is not None:
            if schema.data != self._schema.data:
                raise LogError(
                    f"{path}: {self._topic}: found another schema than in {self._path}, expected the same"
                )
            return
        try:
            self._types = types_of(schema.data.decode())
        except UnicodeDecodeError:
            raise LogError(f"{path}: {self._topic}: found a schema that is no text") from None
        self._path, self._schema = path, schema

    def add(self, batch: Batch) -> None:
        """Take messages in. Raises LogError."""
        if not len(batch.offsets):
            return
        try:
            if self._decoder is None and not self._take_rows(batch):
                self._decode_singly()
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
        if batch.step:
            begin = int(batch.offsets[0]) + _PAYLOAD
            rows = np.ndarray((len(batch.offsets),), f"V{self._length}", batch.data, begin, (batch.step,))
        else:
            rows = pieces(batch.data, batch.offsets + _PAYLOAD, self._length)
        if (_column(rows, 0, "<u2") != _ENCAPSULATION).any():
            return False
        for place, length in self._layout.lengths:
            if (_column(rows, 4 + place, "<u4") != length).any():
                return False
        self._put(rows, batch.log_times)
        return True

    def _decode_singly(self) -> None:
        """Messages turn out to differ in form: decode these, those that are there and all that follow one by one."""
        assert self._schema is not None
        self._decoder = _Decoder(self._schema, self._types)
        if self._rows is not None:
            kept = np.empty(max(self.count, _FIRST_ROWS), self._decoder.dtype)
            kept[: self.count] = self._decoder.rows([row.tobytes() for row in self._rows[: self.count]])
            self._rows = kept

    def _put(self, rows: NDArray[Any], times: NDArray[np.uint64]) -> None:
        end = self.count + len(rows)
        if self._rows is None:
            self._rows = np.empty(max(self._promised, end), rows.dtype)
        if end > len(self._rows):
            self._rows = _grown(self._rows, max(end, self._promised), self.count)
        if end > len(self._times):
            self._times = _grown(self._times, max(end, self._promised), self.count)
        self._rows[self.count : end] = rows
        self._times[self.count : end] = times
        self.count = end


def _grown(old: NDArray[Any], least: int, used: int) -> NDArray[Any]:
    """Return a longer array; what is not written yet takes no memory."""
    new = np.empty(max(least, 2 * len(old)), old.dtype)
    new[:used] = old[:used]
    return new


def _column(rows: NDArray[np.void], offset: int, kind: str) -> NDArray[Any]:
    """Return one number of each row [n]."""
    return rows.view(
        np.dtype({"names": ["it"], "formats": [kind], "offsets": [offset], "itemsize": rows.itemsize})
    )["it"]


def _payload_dtype(fields: np.dtype[Any], length: int) -> np.dtype[Any]:
    """Return a payload of that length whose fields lie behind the encapsulation."""
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


class _Decoder:
    """Messages of one type as rows, each decoded on its own by the library.

    Numbers, and fixed arrays of them, are columns of their type; texts, and sequences, are objects (str, numpy array, list).
    Nested messages are nested fields; within a sequence they are dictionaries.

    Raises:
        LogError: the library is not installed, or does not take the schema.
    """

    def __init__(self, schema: Schema, types: Types) -> None:
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError:
            raise LogError(
                "found messages of changing length, expected a decoder for them: pip install 'jtqd[ros2]'"
            ) from None
        self._types = types
        self.dtype = self._columns("")
        try:
            self._decode: Any = DecoderFactory().decoder_for("cdr", schema)
        except Exception as error:  # of the library's parser: whatever a text can do to it
            raise LogError(f"found a schema that cannot be decoded: {error}") from None

    def rows(self, payloads: list[bytes]) -> NDArray[np.void]:
        """Return the messages [n]. Raises LogError."""
        found = np.empty(len(payloads), self.dtype)
        try:
            for n, payload in enumerate(payloads):
                found[n] = self._row("", self._decode(payload))
        except Exception as error:  # of the library's decoder: whatever bytes can do to it
            what = str(error) or type(error).__name__
            raise LogError(f"found a message that cannot be decoded: {what}") from None
        return found

    def _columns(self, name: str) -> np.dtype[Any]:
        columns: list[tuple[str, Any]] = []
        for field in self._types.fields(name):
            kind: Any = object
            if field.kind in PRIMITIVES and not field.sequence:
                code = PRIMITIVES[field.kind]
                kind = code if field.elements is None else (code, (field.elements,))
            elif field.kind not in PRIMITIVES and field.kind != "string" and not field.is_array:
                kind = self._columns(field.kind)
            columns.append((field.name, kind))
        return np.dtype(columns)

    def _row(self, name: str, message: Any) -> tuple[Any, ...]:
        values: list[Any] = []
        for field in self._types.fields(name):
            value = getattr(message, field.name)
            if field.kind in PRIMITIVES:
                values.append(
                    _numbers(value, PRIMITIVES[field.kind]) if field.is_array else _number(value, field.kind)
                )
            elif field.kind == "string":
                values.append(value)
            elif field.is_array:
                values.append([_mapping(each) for each in value])
            else:
                values.append(self._row(field.kind, value))
        return tuple(values)


def _number(value: Any, kind: str) -> Any:
    return value % 256 if kind == "char" else value  # the library reads it with a sign


def _numbers(value: Any, code: str) -> NDArray[Any]:
    if isinstance(value, bytes | bytearray | memoryview):
        return np.frombuffer(value, code)
    return np.asarray(value, code)


def _mapping(message: Any) -> Any:
    """Return a message of the library as nested dictionaries."""
    if isinstance(message, list):
        return [_mapping(each) for each in message]
    names = getattr(message, "__slots__", None)
    return message if names is None else {name: _mapping(getattr(message, name)) for name in names}


# ---- parts ----


_SEQUENCE = 11
"""[byte] offset of a record's sequence number, behind opcode, length and channel."""
_TAIL_BATCHES, _TAIL_BYTES = 16, 64 << 20
"""What is kept of a part's end: the recorder may be some chunks ahead of its report, never more than the ring holds."""


class _DuplicateFilter:
    """Takes the batches of one part after the other, and gives back what is new in each.

    After a crash of the recorder the next one goes on where the last one said that it was: a chunk that was written but not
    yet reported is in two parts. Duplicates are recognised by their bytes, not by their time: clocks are set, and a run may
    count its cycles anew.
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
        return Batch(
            batch.channel, batch.data, batch.offsets[fresh], batch.log_times[fresh], batch.lengths[fresh]
        )


def _records(batch: Batch) -> list[bytes]:
    """The records of a batch from their sequence numbers and times on; the channel's number is the file's own."""
    begins = batch.offsets + _SEQUENCE
    ends = (batch.offsets + MESSAGE_HEAD.itemsize + batch.lengths.astype(np.int64)).tolist()
    return [batch.data[begin:end] for begin, end in zip(begins.tolist(), ends, strict=True)]
