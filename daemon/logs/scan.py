"""Go through an MCAP file from its first byte to its last and say what is whole: nothing in it is believed unchecked.

Where a record does not hold together, the scan looks for the next place at which one does. A chunk proves itself
by its CRC, an attachment likewise; a record without a checksum must parse and be followed by another one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from mcap.opcode import Opcode
from mcap.records import Channel, Header, MessageIndex, Metadata, MetadataIndex, Schema

from jtqd.daemon.logs.candidates import other_records, packed_chunks
from jtqd.daemon.logs.chunk_finder import ChunkFinder
from jtqd.daemon.logs.chunks import HEAD_SIZE
from jtqd.daemon.logs.found import Gap, Scan
from jtqd.daemon.logs.records import (
    HEAD,
    MAX_SMALL,
    MESSAGE_BODY,
    PRIVATE,
    SUMMARY_OPCODES,
    Source,
    attachment_index,
    parse,
)
from jtqd.daemon.logs.tail import Summary
from jtqd.daemon.recording.mcap_file import MAGIC

_WINDOW = 1 << 20
_CHAIN = 3
"""Records in a row that must be plausible where one without a checksum is taken after damage."""
_LEAST_HEADER = len(MAGIC) + HEAD.size + 8
_ANY = range(256)
_DATA = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT)
_SMALL = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.MESSAGE_INDEX: MessageIndex,
}


def scan(source: Source, own: Summary | None = None) -> Scan:
    """Scan a file; see the module.

    Args:
        source: the file.
        own: its summary, where that holds together: it knows definitions, and where chunks should be.

    Raises:
        OSError: it cannot be read.
    """
    scanner = _Scanner(ChunkFinder(source, [] if own is None else own.chunks), source)
    for definition in [] if own is None else [*own.schemas.values(), *own.channels.values()]:
        scanner.result.definitions.add(definition, None, None, checked=True)
    return scanner.run()


class _Scanner:
    def __init__(self, finder: ChunkFinder, source: Source) -> None:
        self._source = source
        self._finder = finder
        self.result = Scan(source.size)
        self._before_gap_ns: int | None = None
        self._chunked = False
        self._looked_ahead = False

    def run(self) -> Scan:
        result = self.result
        at = self._start()
        while at < result.size:
            end = self._one(at)
            if end is None and self._ends_here(at):
                result.data_end = at
                break
            if end is None:
                end = self._next_good(at)
                self._leave_out(at, end)
            else:
                result.end = end
            at = end
        result.end = min(result.end, result.size)
        if result.data_end is not None:
            result.end = result.data_end
        return result

    def _start(self) -> int:
        """Magic and header; returns where the data begins."""
        source, result = self._source, self.result
        result.magic = source.read(0, len(MAGIC)) == MAGIC
        found = source.head(len(MAGIC))
        plain = found is not None and found[0] == Opcode.HEADER
        if found is not None and plain:
            body = source.read(len(MAGIC) + HEAD.size, min(found[1] - len(MAGIC) - HEAD.size, MAX_SMALL + 1))
            result.header = parse(Header, body)
            if result.header is not None:
                result.end = found[1]
                return found[1]
        if found is not None and plain and self._plausible(found[1], _CHAIN):
            at = found[1]
        else:
            self._look_ahead(len(MAGIC))
            place = self._search(_LEAST_HEADER)
            at = source.size if place is None else place
        self._leave_out(0, at)
        return at

    def _leave_out(self, start: int, end: int) -> None:
        chunk = self._source.read(start, 1) == bytes([Opcode.CHUNK])
        self._chunked |= chunk
        result = self.result
        result.gaps.append(Gap(start, end, "chunk" if chunk else "bytes", 0.0))
        # How long it is becomes known with the next message.
        self._before_gap_ns = result.end_ns if result.start_ns is not None else None

    # ---- one record ----

    def _one(self, at: int) -> int | None:
        """Take the record at `at` into the result; returns where it ends, None where it is not whole."""
        found = self._source.head(at)
        if found is None:
            return self._chunk(at)
        opcode, end = found
        if opcode >= PRIVATE:
            return self._chunk(at) or end
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            good = self._small(opcode, at, end)
        elif opcode == Opcode.MESSAGE:
            good = self._message(at, end)
        elif opcode == Opcode.ATTACHMENT:
            index = attachment_index(self._source, at, end)
            self.result.attachments += [] if index is None else [index]
            good = index is not None
        else:  # a message index that follows its chunk has been taken with it
            good = opcode == Opcode.MESSAGE_INDEX and self._parses(MessageIndex, at, end)
        return end if good else self._chunk(at)

    def _parses(
        self, kind: type[MessageIndex] | type[Schema] | type[Channel] | type[Metadata], at: int, end: int
    ) -> bool:
        body = self._source.read(at + HEAD.size, min(end - at - HEAD.size, MAX_SMALL + 1))
        return parse(kind, body) is not None

    def _chunk(self, at: int) -> int | None:
        """A whole chunk at `at` with its message indexes, whatever its opcode and lengths say."""
        result = self.result
        found = self._finder.whole(at, result.definitions)
        if found is None:
            return None
        chunk = found.chunk
        for definition in found.definitions:
            result.definitions.add(definition, at, None, checked=bool(chunk.head.crc))
        result.chunks.append(chunk)
        self._chunked = True
        self._count(chunk.counts, chunk.head.start_ns, chunk.head.end_ns, at)
        return chunk.index_end

    def _small(self, opcode: int, at: int, end: int) -> bool:
        body = self._source.read(at + HEAD.size, min(end - at - HEAD.size, MAX_SMALL + 1))
        result = self.result
        if opcode == Opcode.METADATA:
            record = parse(Metadata, body)
            if record is not None:
                result.metadata.append(MetadataIndex(offset=at, length=end - at, name=record.name))
            return record is not None
        kind = Schema if opcode == Opcode.SCHEMA else Channel
        definition = parse(kind, body)
        if definition is None:
            return False
        result.definitions.add(definition, at, end, checked=False)
        return True

    def _message(self, at: int, end: int) -> bool:
        if end - at < HEAD.size + MESSAGE_BODY:
            return False
        head = self._source.read(at, HEAD.size + 18)
        channel, log_time = int.from_bytes(head[9:11], "little"), int.from_bytes(head[15:23], "little")
        if not self.result.definitions.may_be(channel) or self._swallows(at, end):
            return False
        self._count(Counter({channel: 1}), log_time, log_time, at)
        return True

    def _swallows(self, at: int, end: int) -> bool:
        """The length of this record without a checksum is wrong: it ends nowhere, and there are records within it."""
        if end == self._source.size or self._plausible(end, 1):
            return False
        place = self._search(at + HEAD.size)
        return place is not None and place < end

    def _count(self, counts: Counter[int], start_ns: int, end_ns: int, at: int) -> None:
        result = self.result
        if counts:
            if self._before_gap_ns is not None:
                seconds = max(0, start_ns - self._before_gap_ns) * 1e-9
                result.gaps[-1] = result.gaps[-1]._replace(seconds=seconds)
                self._before_gap_ns = None
            result.start_ns = start_ns if result.start_ns is None else min(result.start_ns, start_ns)
            result.end_ns = max(result.end_ns, end_ns)
        result.counts.update(counts)
        for channel in counts:
            result.definitions.used(channel, at)

    # ---- where it goes on ----

    def _ends_here(self, at: int) -> bool:
        """The data end at `at`: there is DataEnd or the summary, and no data behind it."""
        found = self._source.head(at)
        if found is None:
            return False
        opcode, end = found
        if opcode != Opcode.DATA_END and opcode not in SUMMARY_OPCODES:
            return False
        if opcode == Opcode.DATA_END and end - at != HEAD.size + 4:
            return False
        return self._search(at + HEAD.size, _DATA) is None

    def _next_good(self, at: int) -> int:
        """Where the next whole record begins behind `at`; the end of the file where there is none."""
        found = self._source.head(at)
        if found is not None and found[1] < self._source.size:
            if self._finder.framed(found[1]):
                return found[1]  # only the content of this record is damaged
            self._look_ahead(at)
            if self._plausible(found[1], _CHAIN):
                return found[1]
        self._look_ahead(at)
        place = self._search(at + HEAD.size)  # so that a head fits into what is left out
        return self._source.size if place is None else place

    def _look_ahead(self, at: int) -> None:
        """In a file of chunks messages stand in chunks: others are the inside of a torn one, which no index can name."""
        if not self._chunked and not self._looked_ahead:
            self._looked_ahead = True
            self._chunked = self._search(at + HEAD.size, (Opcode.CHUNK,)) is not None

    def _search(self, at: int, kinds: Sequence[int] = _ANY) -> int | None:
        """Offset of the next record of one of these kinds that is whole, from `at` on."""
        source = self._source
        while at < source.size and self._finder.work > 0:
            window = source.read(at, _WINDOW + HEAD_SIZE)
            self._finder.work -= len(window)
            packed = packed_chunks(window)
            packed.update(place - at for place in self._finder.indexed_between(at, at + _WINDOW))
            for start in sorted({*packed, *other_records(window)}):
                if not 0 <= start < _WINDOW or (start not in packed and window[start] not in kinds):
                    continue
                if self._finder.work <= 0:
                    break
                if (start in packed and self._finder.proven(at + start)) or self._plausible(
                    at + start, _CHAIN
                ):
                    return at + start
            at += _WINDOW
        return None

    def _plausible(self, at: int, depth: int) -> bool:
        """A record begins here: it proves itself, or it and the `depth` - 1 behind it hold together."""
        source, left = self._source, depth
        while left > 0:
            self._finder.work -= 64
            found = source.head(at)
            if found is None:
                return at == source.size and left < depth
            opcode, end = found
            size = end - at - HEAD.size
            if opcode == Opcode.CHUNK:
                return self._finder.proven(at)
            if opcode == Opcode.ATTACHMENT:
                return attachment_index(source, at, end) is not None
            if opcode == Opcode.DATA_END:
                return size == 4
            if opcode == Opcode.MESSAGE:
                channel = int.from_bytes(source.read(at + HEAD.size, 2), "little")
                good = size >= MESSAGE_BODY and not self._chunked and self.result.definitions.may_be(channel)
            elif opcode in _SMALL:
                good = self._parses(_SMALL[opcode], at, end)
            else:
                good = (opcode in SUMMARY_OPCODES or opcode >= PRIVATE) and left < depth
            if not good:
                return False
            # Definitions and messages are the inside of a chunk as well: what follows them must tell.
            if not (self._chunked and opcode in (Opcode.SCHEMA, Opcode.CHANNEL)):
                left -= 1
            at = end
        return True
