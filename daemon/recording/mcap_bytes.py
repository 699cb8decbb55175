"""Bytes of MCAP records by the mcap library, and of what stands behind the data of a file. Pure."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, McapRecord, SummaryOffset

MAGIC = b"\x89MCAP0\r\n"


def bytes_of(*records: McapRecord) -> bytes:
    """The records one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def tail_bytes(groups: Iterable[tuple[int, bytes]], data_end: int) -> bytes:
    """DataEnd, summary, footer and magic of a file whose data end at byte `data_end`.

    `groups`: (opcode, records of that kind) of the summary, in their order; empty ones are left out.
    """
    end = bytes_of(DataEnd(0))
    start = data_end + len(end)
    summary, offsets = b"", []
    for opcode, records in groups:
        if records:
            offsets.append(SummaryOffset(opcode, start + len(summary), len(records)))
            summary += records
    if not summary:
        start = offsets_at = 0
    else:
        offsets_at = start + len(summary)
        summary += bytes_of(*offsets)
    # The CRC covers the footer up to its own field.
    beginning = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_at)
    return end + summary + bytes_of(Footer(start, offsets_at, zlib.crc32(summary + beginning))) + MAGIC
