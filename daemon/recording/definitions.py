"""MCAP schema and channel records of every topic."""

from __future__ import annotations

from collections.abc import Mapping

from mcap.records import Channel, Schema

from daemon.recording import schemas


def definitions(metadata: Mapping[str, Mapping[str, str]] | None) -> tuple[list[Schema], list[Channel]]:
    """Schema and channel records of every topic; `metadata` adds to a topic's own."""
    numbers = {name: number for number, name in enumerate(schemas.SCHEMAS, start=1)}
    channels = [
        Channel(
            id=topic.number,
            topic=topic.name,
            message_encoding="cdr",
            metadata={str(key): str(text) for key, text in (metadata or {}).get(topic.name, {}).items()},
            schema_id=numbers[topic.schema],
        )
        for topic in schemas.TOPICS
    ]
    return [
        Schema(id=numbers[name], name=name, encoding="ros2msg", data=text.encode())
        for name, text in schemas.SCHEMAS.items()
    ], channels
