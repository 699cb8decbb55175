"""What stands behind the data of an MCAP file: the summary of what a scan found, and whether a file's own is right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)

from jtqd.daemon.logs.records import HEAD, MAX_SMALL, Source, parse
from jtqd.daemon.recording.mcap_file import MAGIC, bytes_of, tail_bytes

FOOTER_SIZE = HEAD.size + 20
_KINDS: dict[int, type[McapRecord]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}


@dataclass
class Summary:
    """Content of a summary section."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    data_end: int = 0
    """Offset of the DataEnd record."""
    data_crc: int = 0
    """As DataEnd gives it; 0: it says nothing."""

    def to_bytes(self, data_end: int) -> bytes:
        """DataEnd, summary, footer and magic of a file whose data end at `data_end`."""
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [] if self.statistics is None else [self.statistics]),
            (Opcode.CHUNK_INDEX, list(self.chunks)),
            (Opcode.ATTACHMENT_INDEX, list(self.attachments)),
            (Opcode.METADATA_INDEX, list(self.metadata)),
        )
        return tail_bytes(((opcode, bytes_of(*records)) for opcode, records in groups), data_end)


def footer_of(source: Source) -> Footer | None:
    """The footer where the file ends as it should."""
    at = source.size - len(MAGIC) - FOOTER_SIZE
    if at < len(MAGIC) or source.read(at + FOOTER_SIZE, len(MAGIC)) != MAGIC:
        return None
    if source.head(at) != (Opcode.FOOTER, at + FOOTER_SIZE):
        return None
    footer = parse(Footer, source.read(at + HEAD.size, 20))
    return None if footer is None or footer.summary_start > at else footer


def read_summary(source: Source) -> Summary | None:
    """The summary at the end of the file, checked against its CRC; None where it does not hold together.

    A file that ends properly without any summary gives an empty one with `data_end` 0.
    """
    footer = footer_of(source)
    if footer is None:
        return None
    end = source.size - len(MAGIC) - FOOTER_SIZE
    found = Summary()
    if footer.summary_start == 0:
        return found
    if footer.summary_crc and footer.summary_crc != source.crc(
        footer.summary_start, source.size - len(MAGIC) - 4
    ):
        return None
    data_end = footer.summary_start - HEAD.size - 4
    if data_end < 0 or source.head(data_end) != (Opcode.DATA_END, footer.summary_start):
        return None
    for opcode, body in _records(source, footer.summary_start, end):
        record = parse(_KINDS[opcode], body) if opcode in _KINDS else None
        if record is not None:
            _put(found, record)
        elif opcode == -1 or opcode in _KINDS:
            return None
    found.data_end = data_end
    found.data_crc = int.from_bytes(source.read(data_end + HEAD.size, 4), "little")
    return found


def _put(summary: Summary, record: McapRecord) -> None:
    if isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, ChunkIndex):
        summary.chunks.append(record)
    elif isinstance(record, AttachmentIndex):
        summary.attachments.append(record)
    elif isinstance(record, MetadataIndex):
        summary.metadata.append(record)


def _records(source: Source, at: int, end: int) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of the records between two offsets; opcode -1 where they do not fill them."""
    while at < end:
        found = source.head(at)
        if found is None or found[1] > end or found[1] - at > MAX_SMALL:
            yield -1, b""
            return
        yield found[0], source.read(at + HEAD.size, found[1] - at - HEAD.size)
        at = found[1]


def agrees(own: Summary, expected: Summary) -> bool:
    """A file's own summary says what a scan found; what it leaves out, as some writers do, is no contradiction."""
    if own.statistics is not None and expected.statistics is not None:
        counts = (own.statistics.message_count, own.statistics.chunk_count)
        if counts != (expected.statistics.message_count, expected.statistics.chunk_count):
            return False
    used = set() if expected.statistics is None else set(expected.statistics.channel_message_counts)
    if own.channels and any(own.channels.get(number) != expected.channels[number] for number in used):
        return False
    if own.schemas and any(
        expected.schemas.get(number, schema) != schema for number, schema in own.schemas.items()
    ):
        return False
    if own.attachments and own.attachments != expected.attachments:
        return False
    if own.metadata and own.metadata != expected.metadata:
        return False
    return not own.chunks or (
        len(own.chunks) == len(expected.chunks)
        and all(map(_same_chunk, sorted(own.chunks, key=lambda c: c.chunk_start_offset), expected.chunks))
    )


def _same_chunk(own: ChunkIndex, found: ChunkIndex) -> bool:
    offsets = own.message_index_offsets
    return (
        (own.chunk_start_offset, own.chunk_length, own.message_start_time, own.message_end_time)
        == (found.chunk_start_offset, found.chunk_length, found.message_start_time, found.message_end_time)
        and (own.compressed_size, own.uncompressed_size) == (found.compressed_size, found.uncompressed_size)
        and (not offsets or offsets == found.message_index_offsets)
    )
