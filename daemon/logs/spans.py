"""Which chunks of our logs belong together, and which of them lack their others.

The recorder writes a stretch of time as one chunk for each topic of the cycles and one for the rest. After a power cut, or
where a chunk is damaged, some of them may be there without the others. A cycle counts when all of its messages are there:
readers take the arrays of two joints for arrays of the same cycles.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from mcap.records import Channel, Header

from jtqd.daemon.recording.schemas import CAN_FRAMES, JOINTS

_CYCLE_TOPICS = {CAN_FRAMES.name, *(topic.name for topic in JOINTS)}


def cycle_channels(header: Header | None, channels: Mapping[int, Channel]) -> frozenset[int]:
    """Return the channels on which every cycle has a message; none for a log of another writer."""
    if header is not None and not header.library.startswith("jtqd"):
        return frozenset()
    return frozenset(number for number, channel in channels.items() if channel.topic in _CYCLE_TOPICS)


def torn(chunks: Iterable[Mapping[int, object]], cycles: frozenset[int]) -> list[int]:
    """Return the places of the chunks with cycles whose span is not whole.

    Args:
        chunks: in the order of the file; of each its channels, and a mark of its messages' cycles, equal throughout a span.
        cycles: channels of the cycles.
    """
    found: list[int] = []
    span: dict[int, object] = {}
    places: list[int] = []
    for place, chunk in enumerate(chunks):
        mine = {channel: mark for channel, mark in chunk.items() if channel in cycles}
        if not mine:
            continue
        # Logs of before have all topics in one chunk.
        if not mine.keys().isdisjoint(span) or not {*mine.values()} <= {*(span or mine).values()}:
            found += places
            span, places = {}, []
        span |= mine
        places.append(place)
        if span.keys() == cycles:
            span, places = {}, []
    return found + places
