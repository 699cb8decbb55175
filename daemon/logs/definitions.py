"""Schemas and channels of a damaged file: which text is the right one, and where it stands."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TypeAlias

from mcap.records import Channel, Schema

Definition: TypeAlias = Schema | Channel
Key = tuple[bool, int]
"""(it is a channel, identifier)."""


@dataclass
class _Seen:
    record: Definition
    at: int | None
    checked: bool


@dataclass
class Definitions:
    """Every text seen for each identifier; one under a CRC beats one without, an earlier one a later one."""

    _seen: dict[Key, list[_Seen]] = field(default_factory=dict)
    loose: list[tuple[int, int, Definition]] = field(default_factory=list)
    """(start, end, record) of those outside chunks, which no CRC covers."""
    first_use: dict[int, int] = field(default_factory=dict)
    """Channel -> offset of the chunk or message that uses it first."""

    def add(self, record: Definition, at: int | None, end: int | None, *, checked: bool) -> None:
        """Take one in.

        Args:
            record: the definition.
            at: its offset, or that of its chunk; None: it stands in the summary.
            end: behind it, where it is outside chunks.
            checked: a CRC covers it.
        """
        if at is not None and end is not None:
            self.loose.append((at, end, record))
        seen = self._seen.setdefault((isinstance(record, Channel), record.id), [])
        for each in seen:
            if each.record == record:
                each.checked |= checked
                if at is not None:
                    each.at = at if each.at is None else min(each.at, at)
                return
        seen.append(_Seen(record, at, checked))

    def knows(self, channel: int) -> bool:
        """There is a channel of that number."""
        return (True, channel) in self._seen

    def may_be(self, channel: int) -> bool:
        """A message outside chunks can be of this channel: it is known, or none is."""
        return self.knows(channel) or not any(is_channel for is_channel, _ in self._seen)

    def used(self, channel: int, at: int) -> None:
        """A message of this channel stands at `at`."""
        self.first_use.setdefault(channel, at)

    def _best(self, key: Key) -> _Seen:
        seen = self._seen[key]
        return next((each for each in seen if each.checked), seen[0])

    def schemas(self) -> dict[int, Schema]:
        """The schema of each identifier."""
        records = {
            number: self._best((False, number)).record for is_channel, number in self._seen if not is_channel
        }
        return {number: record for number, record in records.items() if isinstance(record, Schema) and number}

    def channels(self) -> dict[int, Channel]:
        """The channel of each identifier whose schema is known; one is made up where it is used and nowhere defined."""
        schemas = self.schemas()
        records = {
            number: self._best((True, number)).record for is_channel, number in self._seen if is_channel
        }
        found = {
            number: record
            for number, record in records.items()
            if isinstance(record, Channel) and (record.schema_id == 0 or record.schema_id in schemas)
        }
        for number in self.first_use:
            if number not in found:
                known = records.get(number)
                if isinstance(known, Channel):  # without its schema
                    found[number] = dataclasses.replace(known, schema_id=0)
                else:
                    topic = f"/recovered/channel_{number}"
                    found[number] = Channel(
                        id=number, topic=topic, message_encoding="", metadata={}, schema_id=0
                    )
        return dict(sorted(found.items()))

    def place(self, record: Definition) -> int | None:
        """Offset of the first occurrence of exactly this record in the data; None: in the summary only, or nowhere."""
        seen = self._seen.get((isinstance(record, Channel), record.id), [])
        return next((each.at for each in seen if each.record == record), None)
