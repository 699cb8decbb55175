"""Recorded messages as structured arrays: those of a topic of one file, or of the parts of one run.

The layout of a message follows from the ros2msg schema in the file and CDR's alignment, not from jtqd's code. Messages of
equal form are copied as rows, without a loop. Messages whose texts or sequences change in length are decoded one by one by
the `mcap` project's ROS 2 decoder (extra `ros2`).
"""

from __future__ import annotations

import re
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import MESSAGE_HEAD, Batch, LogError, LogFile, pieces
from jtqd.daemon.recording.run_files import ACTIVE, PART_PATTERN

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
            is read as far as it is intact. Messages that two parts have come once.
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
    tables = {topic: _Table(topic) for topic in topics}
    for piece in _pieces(parts, topics, start_ns, end_ns):
        tables[piece.topic].add(piece)
    span = "" if start_ns is None and end_ns is None else " in that time"
    for topic, table in tables.items():
        if not table.count:
            raise LogError(f"{parts[0]}: found no message on {topic}{span}, expected one per cycle")
    return {topic: table.messages() for topic, table in tables.items()}


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
    for piece in _pieces(log_parts(path), topics, start_ns, end_ns):
        if piece.topic in found:
            yield found
            found = {}
        table = _Table(piece.topic)
        table.add(piece._replace(expected=0))
        if table.count:
            found[piece.topic] = table.messages()
    if found:
        yield found


class _Piece(NamedTuple):
    """Messages of one topic out of one chunk, with their file and schema.

    expected: messages of the topic in the file, as its summary says.
    """

    path: Path
    topic: str
    schema: Schema
    batch: Batch
    expected: int


def _pieces(
    parts: Sequence[Path], topics: Sequence[str], start_ns: int | None, end_ns: int | None
) -> Iterator[_Piece]:
    """Yield messages of the parts in their order; those that two parts have come once."""
    filtered = _DuplicateFilter() if len(parts) > 1 else None
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
                fresh = batch if filtered is None else filtered.new(topic, batch)
                if len(fresh.offsets):
                    yield _Piece(path, topic, schema, fresh, count)
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
    named = [found for each in given if (found := PART_PATTERN.fullmatch(each.name))]
    if len(named) == len(given) and len({found.group("prefix", "run") for found in named}) == 1:
        return [path for _, path in sorted(zip([int(n["part"]) for n in named], given, strict=True))]
    starts = []
    for n, path in enumerate(given):
        with LogFile(path) as log:
            starts.append((log.start_ns, n, path))
    return [path for *_, path in sorted(starts)]


# ---- schemas ----

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
_FIELD = re.compile(
    r"(?P<kind>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)(?:\s+[^\s=].*)?$"
)
"""Type, array, name, default value."""
_CONSTANT = re.compile(r"[\w<=/]+\s+[A-Z]\w*\s*=")
_NESTED = re.compile(r"^=+\s*\nMSG: (\S+)[^\n]*\n", re.MULTILINE)
_TIME = "int32 sec\nuint32 nanosec\n"


class _Field(NamedTuple):
    """One field. `elements`: of a fixed array; `sequence`: as many as the message says."""

    name: str
    kind: str
    elements: int | None
    sequence: bool


class _Types:
    """Fields of the message ("") and of every type nested in it.

    Raises:
        LogError: a line that is no field, two fields of one name, or a type without a definition.
    """

    def __init__(self, text: str) -> None:
        first, *rest = _NESTED.split(text.replace("\r\n", "\n"))
        # Some writers leave the texts of builtin_interfaces out.
        texts = {"builtin_interfaces/Time": _TIME, "builtin_interfaces/Duration": _TIME, "": first}
        texts |= {name.replace("/msg/", "/"): body for name, body in zip(rest[::2], rest[1::2], strict=True)}
        self._fields = {name: _fields(body) for name, body in texts.items()}
        self._by_last = {name.rsplit("/", 1)[-1]: fields for name, fields in self._fields.items()}

    def fields(self, name: str) -> list[_Field]:
        """Return the fields of a type."""
        bare = name.replace("/msg/", "/")
        found = self._fields.get(bare) or (None if "/" in bare else self._by_last.get(bare))
        if found is None:
            raise LogError(f"found type {name!r} in a schema, expected its definition")
        return found


def _fields(text: str) -> list[_Field]:
    fields = []
    for line in (line.partition("#")[0].strip() for line in text.splitlines()):
        if not line or _CONSTANT.match(line):
            continue
        found = _FIELD.match(line)
        if found is None:
            raise LogError(f"found {line!r} in a schema, expected a field")
        sequence = bool(found["array"]) and (found["bound"] is not None or not found["count"])
        count = int(found["count"]) if found["array"] and not sequence else None
        fields.append(_Field(found["name"], found["kind"], count, sequence))
    if len({field.name for field in fields}) != len(fields):
        raise LogError("found two fields of one name in a schema")
    return fields or [_Field("structure_needs_at_least_one_member", "uint8", None, False)]


@lru_cache(maxsize=16)
def _types_of(text: str) -> _Types:
    return _Types(text)


class _VariableError(LogError):
    """Messages of this type have no fixed rows."""


class _Layout:
    """Layout of messages of one form: their rows, and where the lengths of their texts stand.

    Every primitive lies at a multiple of its own size, counted from the first byte behind the encapsulation. The lengths of
    texts are those of an example; a message with others has another form.

    Args:
        types: of the schema.
        example: payload of one message.

    Raises:
        _VariableError: a sequence, or texts in an array.
        LogError: the example does not fit the schema.
    """

    def __init__(self, types: _Types, example: bytes) -> None:
        self._types, self._example = types, example
        self.size = len(example)
        self.lengths: list[tuple[int, int]] = [(0, 0x0000_0100)]
        """(offset, value) in every payload, unsigned 32 bit: the encapsulation is plain CDR, little endian."""
        if example[:4] != b"\x00\x01\x00\x00":
            raise _VariableError("found another encapsulation, expected little endian CDR")
        names, formats, offsets, end = self._members("", 4, 0)
        if not 0 <= self.size - end < 8:  # what is left can only be padding
            raise LogError(f"found {self.size - 4} bytes, expected {end - 4} by the schema")
        self.dtype = _struct(names, formats, offsets, self.size)

    def _members(self, name: str, at: int, depth: int) -> tuple[list[str], list[Any], list[int], int]:
        if depth > _MAX_DEPTH:
            raise LogError(f"found types nested deeper than {_MAX_DEPTH} in a schema")
        names, formats, offsets = [], [], []
        for field in self._types.fields(name):
            begin, kind = self._field(field, at, depth)
            names.append(field.name)
            formats.append(kind)
            offsets.append(begin)
            at = begin + kind.itemsize
        return names, formats, offsets, at

    def _field(self, field: _Field, at: int, depth: int) -> tuple[int, np.dtype[Any]]:
        if field.sequence or (field.elements is not None and field.kind == "string"):
            raise _VariableError(f"found {field.name}, a sequence or an array of texts")
        begin, kind = self._one(field.kind, at, depth)
        if field.elements is None:
            return begin, kind
        if field.elements * max(kind.itemsize, 1) > self.size:
            raise LogError(
                f"found an array of {field.elements} {field.kind} in a message of {self.size - 4} bytes"
            )
        known = len(self.lengths)
        again = self._one(field.kind, begin + kind.itemsize, depth)
        if again != (begin + kind.itemsize, kind) or len(self.lengths) != known:
            raise _VariableError(f"found an array of {field.kind} whose elements differ in form")
        return begin, np.dtype((kind, (field.elements,)))

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


# ---- rows ----

_PAYLOAD = MESSAGE_HEAD.itemsize
_FIRST_ROWS = 4096


class _Table:
    """Messages of one topic, of one file after the other."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._first: _Piece | None = None
        self._layout: _Layout | None = None
        self._decoder: _Decoder | None = None
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
                if self._decoder is None:
                    self._decode_singly(first.schema)
                assert self._decoder is not None
                rows = self._decoder.rows(_payloads(piece.batch))
        except LogError as error:
            raise LogError(f"{piece.path}: {self._topic}: {error}") from None
        self._put(rows, piece.batch.log_times, self.count + piece.expected)

    def _begin(self, piece: _Piece) -> None:
        batch, self._first = piece.batch, piece
        begin = int(batch.offsets[0]) + _PAYLOAD
        try:
            text = piece.schema.data.decode()
            self._layout = _Layout(_types_of(text), batch.data[begin : begin + int(batch.lengths[0])])
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
        for place, value in layout.lengths:
            found = rows.view(_struct(["it"], ["<u4"], [place], layout.size))["it"]
            if ((found & 0xFFFF if place == 0 else found) != value).any():
                return None
        return rows

    def _decode_singly(self, schema: Schema) -> None:
        """Decode the messages so far, and all that follow, one by one: they differ in form."""
        self._decoder = _Decoder(schema)
        rows = self._decoder.rows([row.tobytes() for row in self._rows[: self.count]])
        self._rows, self._layout = rows, None

    def _put(self, rows: NDArray[Any], times: NDArray[np.uint64], expected: int) -> None:
        end = self.count + len(rows)
        if end > len(self._rows):
            self._rows = _grown(self._rows, rows.dtype, max(end, expected, _FIRST_ROWS), self.count)
        if end > len(self._times):
            self._times = _grown(self._times, self._times.dtype, len(self._rows), self.count)
        self._rows[self.count : end] = rows
        self._times[self.count : end] = times
        self.count = end


def _grown(old: NDArray[Any], kind: np.dtype[Any], least: int, used: int) -> NDArray[Any]:
    """Return a longer array; what is not written yet takes no memory."""
    new = np.empty(max(least, 2 * len(old)), kind)
    new[:used] = old[:used]
    return new


def _payloads(batch: Batch) -> list[bytes]:
    begins = (batch.offsets + _PAYLOAD).tolist()
    return [batch.data[at : at + size] for at, size in zip(begins, batch.lengths.tolist(), strict=True)]


class _Decoder:
    """Messages of one type as rows, each decoded on its own by the library.

    Numbers, and fixed arrays of them, are columns of their type; texts, and sequences, are objects (str, numpy array, list).
    Nested messages are nested fields; within an array they are dictionaries.

    Raises:
        LogError: the library is not installed, or does not take the schema.
    """

    def __init__(self, schema: Schema) -> None:
        try:
            from mcap_ros2.decoder import DecoderFactory
        except ImportError:
            raise LogError(
                "found messages of changing length, expected a decoder for them: pip install 'jtqd[ros2]'"
            ) from None
        self._types = _types_of(schema.data.decode())
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
            if field.kind in _PRIMITIVES and not field.sequence:
                code = _PRIMITIVES[field.kind]
                kind = code if field.elements is None else (code, (field.elements,))
            elif field.kind not in {*_PRIMITIVES, "string"} and not field.sequence and field.elements is None:
                kind = self._columns(field.kind)
            columns.append((field.name, kind))
        return np.dtype(columns)

    def _row(self, name: str, message: Any) -> tuple[Any, ...]:
        return tuple(self._value(field, getattr(message, field.name)) for field in self._types.fields(name))

    def _value(self, field: _Field, value: Any) -> Any:
        several = field.sequence or field.elements is not None
        if field.kind in _PRIMITIVES and several:
            code = _PRIMITIVES[field.kind]
            is_bytes = isinstance(value, bytes | bytearray | memoryview)
            return np.frombuffer(value, code) if is_bytes else np.asarray(value, code)
        if field.kind == "char":  # the library reads it with a sign
            return value % 256
        if field.kind in {*_PRIMITIVES, "string"}:
            return value
        return _mapping(value) if several else self._row(field.kind, value)


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
