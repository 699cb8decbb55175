"""For the tests of replay: logs cut, thinned out and spoilt, by the library's writer; states of cycles."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from jtqd.daemon.config import load_config
from jtqd.daemon.logs import read_topic
from jtqd.daemon.replay.logged import SAMPLE

MS = 1_000_000
CONFIG = load_config(None)
_LOGGED = np.dtype(
    [
        ("header", [("stamp", [("sec", "<i4"), ("nanosec", "<u4")])]),
        ("cycle", "<u8"),
        ("sync_monotonic_ns", "<i8"),
        ("sync_counter", "u1"),
        ("cycle_flags", "u1"),
        *((name, SAMPLE[name]) for name in SAMPLE.names or ()),
    ]
)


def records(cycles: list[int], period_ns: int = MS) -> np.ndarray:
    """States of a run that began with cycle 0 and has these cycles in its log."""
    out = np.zeros(len(cycles), _LOGGED)
    out["cycle"] = cycles
    out["sync_monotonic_ns"] = np.array(cycles) * period_ns
    out["header"]["stamp"]["nanosec"] = np.array(cycles) * period_ns + 77
    out["sync_counter"] = np.array(cycles) % 240 + 1
    out["input_flags"] = 7
    out["dt_s"] = np.where(out["cycle"] == 0, 0.0, period_ns * 1e-9)
    return out


def cut(
    log: Path,
    target: Path,
    keep: Callable[[int], bool] = lambda cycle: True,
    *,
    attachments: Callable[[dict[str, bytes]], dict[str, bytes]] = lambda found: found,
    payload: Callable[[str, int, bytes], bytes] = lambda topic, cycle, data: data,
    schema: Callable[[bytes], bytes] = lambda text: text,
    topics: Callable[[str, int], bool] = lambda topic, cycle: True,
) -> Path:
    """Copy of `log` with the cycles that are kept and other attachments.

    `payload(topic, cycle, data)` may spoil a message, `schema(text)` the definitions, `topics(topic, cycle)` leave one out.
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
            if cyclic and not (keep(message.sequence) and topics(topic, message.sequence)):
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
