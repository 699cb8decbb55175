"""What must be written into a damaged MCAP file so that every reader takes it: worked out before a byte is changed.

Nothing that could be read is moved or removed. A stretch that cannot be read becomes a private record, which every
reader skips: only its first nine bytes change. Where definitions or a message index were lost, they go there again.
"""

from __future__ import annotations

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Statistics

from jtqd.daemon.logs.chunk_finder import FoundChunk, index_entries
from jtqd.daemon.logs.chunks import unpack, walk
from jtqd.daemon.logs.definitions import Definition
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.found import Gap, Scan
from jtqd.daemon.logs.records import HEAD, Source, private
from jtqd.daemon.logs.repair_plan import Plan, torn_seconds
from jtqd.daemon.logs.tail import FOOTER_SIZE, Summary, agrees, footer_of
from jtqd.daemon.recording.mcap_file import MAGIC, bytes_of


def plan_repair(source: Source, found: Scan, own: Summary | None) -> Plan:
    """Changes that a scanned file needs.

    Args:
        source: the file.
        found: the scan of it, with the definitions of its summary taken in.
        own: its summary, None where it has none that holds together.

    Raises:
        LogError: there is nothing in it to be read, or no room for what must stand at its beginning.
        OSError: it cannot be read.
    """
    return _Planner(source, found).make(own)


class _Planner:
    def __init__(self, source: Source, found: Scan) -> None:
        self._source, self._found = source, found
        self._plan = Plan(end=found.end)
        self._channels = found.definitions.channels()
        self._schemas = found.definitions.schemas()
        self._with_indexes = any(chunk.index or chunk.wrong_index for chunk in found.chunks)

    def make(self, own: Summary | None) -> Plan:
        plan, found = self._plan, self._found
        if not found.messages and not found.attachments and not found.metadata and not found.chunks:
            raise LogError("found nothing in it that can be read, expected an MCAP file")
        self._beginning()
        self._definitions()
        self._chunks()
        for gap in found.gaps:
            if gap.end < found.size or found.data_end is not None:
                self._fill(gap)
        extra = b""
        if found.data_end is None:
            extra = self._torn_end()
        summary = self._summary()
        sound = own is not None and self._ends_well(own, summary)
        if own is not None and sound and own.data_crc and own.data_crc != self._source.crc(0, found.end):
            sound, plan.damaged = False, True
            plan.findings.append(
                "the CRC of the data does not match: bytes are wrong that no other CRC covers"
            )
        plan.clean = sound and not plan.patches
        if not plan.clean:
            if found.data_end is not None and not sound and not plan.damaged:
                plan.findings.append("the summary is missing or wrong: made anew")
            plan.tail = extra + summary.to_bytes(plan.end + len(extra))
        return plan

    # ---- head and definitions ----

    def _beginning(self) -> None:
        found, plan = self._found, self._plan
        if found.header is not None:
            if not found.magic:
                plan.patches.append((0, MAGIC))
                plan.findings.append("the magic bytes at the beginning are wrong: written again")
            return
        room = found.gaps[0].end - len(MAGIC)
        encodings = {schema.encoding for schema in self._schemas.values()}
        profile = "ros2" if encodings and encodings <= {"ros2msg", "ros2idl"} else ""
        if room - len(bytes_of(Header(profile, ""))) < 0:
            profile = ""
        filler = room - len(bytes_of(Header(profile, "")))
        if filler < 0:
            raise LogError(
                f"found {room} bytes before the first record that can be read, expected room for a header"
            )
        # All of the room if nothing else has to go there, else the header alone.
        head = bytes_of(Header(profile, "recovered"))
        if filler < 1 << 10 or room < len(head) + HEAD.size:
            head = bytes_of(Header(profile, " " * filler))
        plan.patches.append((0, MAGIC + head))
        plan.findings.append("the header is damaged: written again")
        found.gaps[0] = found.gaps[0]._replace(start=len(MAGIC) + len(head))

    def _definitions(self) -> None:
        """Definitions outside chunks that contradict those under a CRC are written again."""
        for start, end, record in self._found.definitions.loose:
            is_channel = isinstance(record, Channel)
            right: Definition | None = (self._channels if is_channel else self._schemas).get(record.id)
            if right == record:
                continue
            data = b"" if right is None else bytes_of(right)
            kind = "channel" if is_channel else "schema"
            self._plan.findings.append(f"{kind} {record.id} at byte {start} is damaged")
            self._plan.patches.append((start, data if len(data) == end - start else private(end - start)))
            if len(data) != end - start:
                self._plan.damaged = True

    def _needed(self, gap: Gap) -> list[list[Definition]]:
        """Definitions used behind the gap that stand nowhere before their use: a channel with its schema before it."""
        groups: list[list[Definition]] = []
        definitions = self._found.definitions
        for number, used in sorted(definitions.first_use.items()):
            channel = self._channels[number]
            defined = definitions.place(channel)
            needed: list[Definition] = [] if defined is not None and defined <= used else [channel]
            schema = self._schemas.get(channel.schema_id)
            if schema is not None:
                place = definitions.place(schema)
                if place is None or place > (used if needed else min(used, defined or 0)):
                    needed.insert(0, schema)
            if needed and gap.start < used:
                groups.append(needed)
        return groups

    # ---- chunks and gaps ----

    def _chunks(self) -> None:
        plan = self._plan
        for chunk in self._found.chunks:
            if chunk.healed:
                plan.patches.append((chunk.offset, chunk.head.packed()))
                plan.findings.append(
                    f"chunk at byte {chunk.offset}: its head was wrong, its content is right"
                )
            for start, end, channel in chunk.wrong_index:
                record = b"" if channel in chunk.index else self._index_record(chunk, channel)
                if len(record) == end - start:
                    chunk.index[channel] = (start, end - start)
                    plan.patches.append((start, record))
                else:
                    plan.patches.append((start, private(end - start)))
                plan.findings.append(
                    f"message index at byte {start} is wrong: {'made anew' if record else 'left out'}"
                )

    def _index_record(self, chunk: FoundChunk, channel: int) -> bytes:
        if channel not in chunk.counts:
            return b""
        begin = chunk.offset + chunk.head.data_start
        records = walk(unpack(chunk.head, self._source.read(begin, chunk.end - begin)))
        entries = index_entries(records, channel)
        return (
            HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries))
            + channel.to_bytes(2, "little")
            + len(entries).to_bytes(4, "little")
            + entries
        )

    def _missing_indexes(self, chunk: FoundChunk | None) -> list[tuple[int, bytes]]:
        if chunk is None or not self._with_indexes:
            return []
        return [
            (channel, self._index_record(chunk, channel))
            for channel in chunk.counts
            if channel not in chunk.index
        ]

    def _fill(self, gap: Gap) -> None:
        """Make a gap of the data into records."""
        plan = self._plan
        at = gap.start
        if at >= gap.end:
            return
        put = bytearray()
        placed: list[Definition] = []

        def fits(data: bytes) -> bool:
            left = gap.end - at - len(data)
            return left == 0 or left >= HEAD.size

        chunk = next((each for each in self._found.chunks if each.index_end == gap.start), None)
        for channel, record in self._missing_indexes(chunk):
            if chunk is not None and fits(record):
                chunk.index[channel] = (at, len(record))
                put += record
                at += len(record)
                chunk.index_end = at
        for group in self._needed(gap):
            missing = [each for each in group if each not in placed]
            record = bytes_of(*missing)
            if fits(record):
                placed += missing
                put += record
                at += len(record)
                for each in missing:
                    self._found.definitions.add(each, gap.start, None, checked=False)
        left = gap.end - at
        what = "written again from what is known elsewhere"
        if left:
            put += private(left)
            what = f"{left} bytes left out"
            plan.lost_bytes += left
            plan.lost_chunks += gap.what == "chunk"
            plan.lost_s += gap.seconds
            plan.damaged = True
        plan.findings.append(f"{gap.what} at byte {gap.start} cannot be read: {what}")
        plan.patches.append((gap.start, bytes(put)))

    # ---- end ----

    def _torn_end(self) -> bytes:
        """The file stops within its data; returns message indexes that its last chunk lacks."""
        plan, found, source = self._plan, self._found, self._source
        torn = found.size - found.end
        chunk = found.chunks[-1] if found.chunks and found.chunks[-1].index_end == found.end else None
        extra = b""
        for channel, record in self._missing_indexes(chunk):
            if chunk is not None:
                chunk.index[channel] = (found.end + len(extra), len(record))
                extra += record
                chunk.index_end = found.end + len(extra)
        first = source.read(found.end, 1)
        if not torn or (first == b"\x07" and extra) or (first == b"\x0f" and torn < HEAD.size + 4):
            plan.findings.append("the file ends without a summary: made anew")
            return extra
        zeros = all(not any(block) for block in source.blocks(found.end, found.size))
        seconds = 0.0 if zeros else torn_seconds(source, found)
        plan.lost_bytes += torn
        plan.lost_s += seconds
        plan.lost_chunks += first == bytes([Opcode.CHUNK])
        plan.damaged = True
        plan.findings.append(f"{torn} bytes at the end {'are zeros' if zeros else 'cannot be read'}: cut off")
        return extra

    def _ends_well(self, own: Summary, expected: Summary) -> bool:
        found = self._found
        if found.data_end is None:
            return False
        if own.data_end == 0:  # without a summary: the footer follows DataEnd
            footer = footer_of(self._source)
            return (
                footer is not None and found.data_end + HEAD.size + 4 == found.size - len(MAGIC) - FOOTER_SIZE
            )
        return own.data_end == found.data_end and agrees(own, expected)

    def _summary(self) -> Summary:
        found = self._found
        chunks = []
        for chunk in found.chunks:
            complete = set(chunk.counts) <= set(chunk.index)
            chunks.append(
                ChunkIndex(
                    chunk_length=chunk.end - chunk.offset,
                    chunk_start_offset=chunk.offset,
                    compression=chunk.head.compression,
                    compressed_size=chunk.head.packed_size,
                    message_end_time=chunk.head.end_ns,
                    # Without all of them readers go through the whole chunk, with some they would leave messages out.
                    message_index_length=chunk.index_end - chunk.end if complete else 0,
                    message_index_offsets={c: at for c, (at, _) in chunk.index.items()} if complete else {},
                    message_start_time=chunk.head.start_ns,
                    uncompressed_size=chunk.head.unpacked_size,
                )
            )
        counts = {number: found.counts.get(number, 0) for number in self._channels}
        return Summary(
            schemas=dict(sorted(self._schemas.items())),
            channels=self._channels,
            statistics=Statistics(
                attachment_count=len(found.attachments),
                channel_count=len(self._channels),
                channel_message_counts={number: count for number, count in counts.items() if count},
                chunk_count=len(chunks),
                message_count=found.messages,
                metadata_count=len(found.metadata),
                message_start_time=found.start_ns or 0,
                message_end_time=found.end_ns,
                schema_count=len(self._schemas),
            ),
            chunks=chunks,
            attachments=found.attachments,
            metadata=found.metadata,
        )
