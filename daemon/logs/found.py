"""What a scan of an MCAP file finds: whole chunks, definitions, attachments, and the gaps between them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.records import AttachmentIndex, Header, MetadataIndex

from jtqd.daemon.logs.chunk_finder import FoundChunk
from jtqd.daemon.logs.definitions import Definitions


class Gap(NamedTuple):
    """Bytes that hold nothing readable, what they seem to have been, and the time they stood for [s]."""

    start: int
    end: int
    what: str
    seconds: float


@dataclass
class Scan:
    """What a file holds."""

    size: int
    header: Header | None = None
    definitions: Definitions = field(default_factory=Definitions)
    chunks: list[FoundChunk] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int = 0
    gaps: list[Gap] = field(default_factory=list)
    end: int = 0
    """Behind the last whole record of the data."""
    data_end: int | None = None
    """Offset of the DataEnd record, or of the first record of the summary."""
    magic: bool = True
    """The file begins as it should."""

    @property
    def messages(self) -> int:
        """Messages that can be read."""
        return sum(self.counts.values())
