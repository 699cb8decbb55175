"""Read recorded messages: those of a topic of one or several MCAP files as one structured array.

The layout comes from the schema text in the file (ros2msg) and CDR's alignment rules, not from jtqd's code. Messages of
jtqd's topics have one length each (`docs/recording.md`), so that a chunk is read as an array of rows, without a loop over
messages. Where lengths change, as in other writers' files, every message is decoded on its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.batch import Batch
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.log_file import LogFile
from jtqd.daemon.logs.rows import Collector, Records
from jtqd.daemon.logs.seam import Seam
from jtqd.daemon.recording.parts import ACTIVE, PART_PATTERN

_ENDINGS = (".mcap", f".mcap{ACTIVE}")


class Messages(NamedTuple):
    """Messages of a topic: log time [ns] and record of each [n]."""

    log_times: NDArray[np.uint64]
    records: Records


def read_topic(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Records:
    """All messages of a topic in the order of the files, one field per field of the schema [n].

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
    """As `read_topics`, with the log time of every message."""
    parts = log_parts(path)
    collectors = {topic: Collector(topic, parts[0]) for topic in topics}
    for part in _in_parts(parts, topics, start_ns, end_ns):
        collector = collectors[part.topic]
        collector.begin(part.path, part.schema)
        collector.add(part.batch)
    span = "" if start_ns is None and end_ns is None else " in that time"
    for topic, collector in collectors.items():
        if not collector.count:
            raise LogError(f"{parts[0]}: found no message on {topic}{span}, expected one per cycle")
    return {topic: Messages(*collector.result()) for topic, collector in collectors.items()}


def iter_messages(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Messages]:
    """Messages of one topic, chunk by chunk: for logs that are larger than the memory. Raises as `read_topics` does."""
    for found in iter_topics(path, (topic,), start_ns=start_ns, end_ns=end_ns):
        yield found[topic]


def iter_topics(
    path: Path | Sequence[Path],
    topics: Sequence[str],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[dict[str, Messages]]:
    """Messages of several topics, chunk by chunk; of each chunk those that it has. Raises as `read_topics` does."""
    chunk: bytes | None = None
    found: dict[str, Messages] = {}
    for part in _in_parts(log_parts(path), topics, start_ns, end_ns):
        if found and (part.batch.data is not chunk or part.topic in found):
            yield found
            found = {}
        chunk = part.batch.data
        collector = Collector(part.topic, part.path)
        collector.begin(part.path, part.schema)
        collector.add(part.batch)
        if collector.count:
            found[part.topic] = Messages(*collector.result())
    if found:
        yield found


class _Piece(NamedTuple):
    """Messages of one topic out of one chunk, with the file and the schema that they are of."""

    path: Path
    topic: str
    schema: str
    batch: Batch


def _in_parts(
    parts: Sequence[Path], topics: Sequence[str], start_ns: int | None, end_ns: int | None
) -> Iterator[_Piece]:
    """Batches of the parts in their order; what two of them have comes once."""
    seam = Seam() if len(parts) > 1 else None
    for path in parts:
        with LogFile(path) as log:
            wanted = {
                number: (channel.topic, _schema(log, path, channel))
                for number, channel in log.channels.items()
                if channel.topic in topics
            }
            for batch in log.batches(list(wanted), start_ns, end_ns):
                topic, schema = wanted[batch.channel]
                yield _Piece(path, topic, schema, batch if seam is None else seam.new(topic, batch))
        if seam is not None:
            seam.next_part()


def topics_of(path: Path | Sequence[Path]) -> dict[str, str]:
    """Topics of a log and the names of their schemas. Raises LogError, OSError."""
    found = {}
    for part in log_parts(path):
        with LogFile(part) as log:
            for channel in log.channels.values():
                schema = log.schemas.get(channel.schema_id)
                found[channel.topic] = "" if schema is None else schema.name
    return found


def _schema(log: LogFile, path: Path, channel: Channel) -> str:
    """Schema text of a channel whose messages can be decoded."""
    schema: Schema | None = log.schemas.get(channel.schema_id)
    if schema is None or schema.encoding != "ros2msg":
        found = "no" if schema is None else schema.encoding or "no"
        raise LogError(f"{path}: {channel.topic}: found {found} schema, expected ros2msg")
    if channel.message_encoding != "cdr":
        raise LogError(f"{path}: {channel.topic}: found messages in {channel.message_encoding}, expected cdr")
    try:
        text: str = schema.data.decode()
    except UnicodeDecodeError:
        raise LogError(f"{path}: {channel.topic}: found a schema that is no text") from None
    return text


def read_attachments(path: Path | Sequence[Path]) -> dict[str, bytes]:
    """Attachments by name; of several parts the first one's, and of several of one name the last.

    Raises:
        LogError: the file, or an attachment, is damaged.
        OSError: it cannot be read.
    """
    with LogFile(log_parts(path)[0]) as log:
        return {index.name: log.attachment(index) for index in log.attachments}


def log_parts(path: Path | Sequence[Path]) -> list[Path]:
    """Files of one run in the order of their writing.

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
