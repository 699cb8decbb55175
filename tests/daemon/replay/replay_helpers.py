"""Logs cut, thinned out and spoilt, for the tests of replay: made from the golden ones with the library's own writer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from jtqd.daemon.logs import read_topic


def cut(
    log: Path,
    target: Path,
    keep: Callable[[int], bool] = lambda cycle: True,
    *,
    attachments: Callable[[dict[str, bytes]], dict[str, bytes]] = lambda found: found,
    payload: Callable[[str, int, bytes], bytes] = lambda topic, cycle, data: data,
    schema: Callable[[bytes], bytes] = lambda text: text,
) -> Path:
    """Copy of `log` with the cycles that are kept and other attachments.

    `payload(topic, cycle, data)` may spoil a message, `schema(text)` the definitions.
    """
    with log.open("rb") as source, target.open("wb") as file:
        reader = make_reader(source)
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        found = {each.name: each.data for each in reader.iter_attachments()}
        for name, data in attachments(found).items():
            writer.add_attachment(0, 0, name, "text/plain", data)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for definition, channel, message in reader.iter_messages(log_time_order=False):
            assert definition is not None
            topic = channel.topic  # states of the estimators, once a second, are numbered by themselves
            cyclic = topic.startswith(("/joint/", "/can/")) and not topic.endswith("/zeros")
            if cyclic and not keep(message.sequence):
                continue
            if channel.topic not in channels:
                name = definition.name
                if name not in schemas:
                    schemas[name] = writer.register_schema(name, definition.encoding, schema(definition.data))
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", schemas[name])
            data = payload(channel.topic, message.sequence, message.data)
            writer.add_message(
                channels[channel.topic], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()
    return target


def cycles(log: Path) -> list[int]:
    """Cycle numbers of a log."""
    return [int(each) for each in read_topic(log, "/joint/1/state")["cycle"]]


def provenance(change: Callable[[dict], None]) -> Callable[[dict[str, bytes]], dict[str, bytes]]:  # type: ignore[type-arg]
    """Attachments with another provenance.json."""

    def changed(found: dict[str, bytes]) -> dict[str, bytes]:
        content = json.loads(found["provenance.json"])
        change(content)
        return {**found, "provenance.json": json.dumps(content).encode()}

    return changed
