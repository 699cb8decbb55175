"""A new MCAP with both for one picture: what was logged on /joint/N/state, the replay on /joint/N/replay."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, Schema

from daemon.logs.errors import LogError
from daemon.logs.reader import read_attachments
from daemon.recording.chunk import ChunkBuilder
from daemon.recording.mcap_file import Head, McapFile, NamedData
from daemon.recording.messages import CDR_HEADER, JOINT_ESTIMATE_SIZE
from daemon.recording.naming import ACTIVE
from daemon.recording.schemas import SCHEMAS
from daemon.replay.fields import SAMPLE
from daemon.replay.session import Result

Records = npt.NDArray[np.void]

_SCHEMA = "jtqd_msgs/msg/JointEstimate"
TOPICS = ("/joint/1/state", "/joint/1/replay", "/joint/2/state", "/joint/2/replay")
_CHUNK_CYCLES = 500
_REPEAT_EVERY = 60
_OPCODE_MESSAGE, _RECORD_REST = 0x05, 22
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("rest", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("cdr", "S4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("frame_id", "V16"),
        ("cycle", "<u8"),
        ("sync_monotonic_ns", "<i8"),
        *((name, SAMPLE[name]) for name in SAMPLE.names or ()),
        ("sync_counter", "u1"),
        ("cycle_flags", "u1"),
    ]
)
"""One MCAP Message record with a JointEstimate as `daemon.recording.messages` makes it."""


def write(path: Path, results: list[Result]) -> None:
    """Write one run, all stretches of it, to a new file. Raises LogError for several runs, OSError for a disk that fails."""
    runs = len({each.run.number for each in results})
    if runs != 1:
        raise LogError(f"{path}: found logs of {runs} runs, expected those of one for --out")
    schema = Schema(id=1, name=_SCHEMA, encoding="ros2msg", data=SCHEMAS[_SCHEMA].encode())
    channels = [
        Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=1)
        for number, topic in enumerate(TOPICS, start=1)
    ]
    head = Head([schema], channels, _attachments(results))
    parts = [(number, (number - 1) * _MESSAGE.itemsize) for number in range(1, len(TOPICS) + 1)]
    file = McapFile(
        path.with_name(path.name + ACTIVE), head, {"made by": "jtq replay"}, _first_ns(results[0])
    )
    builder = ChunkBuilder([schema], channels, parts, _REPEAT_EVERY)
    try:
        for result in results:
            _add(file, builder, np.concatenate([_messages(result, n) for n in (0, 1)], axis=1))
        file.finish(path.name)
    except OSError:
        file.abandon(remove=True)
        raise


def _add(file: McapFile, builder: ChunkBuilder, blocks: Records) -> None:
    """Append the messages of n cycles [n, topics]."""
    data, size = blocks.tobytes(), _MESSAGE.itemsize * len(TOPICS)
    for row, time_ns in enumerate(blocks["log_time"][:, 0].tolist()):
        builder.add_block(data[row * size : (row + 1) * size], time_ns)
        if row % _CHUNK_CYCLES == _CHUNK_CYCLES - 1:
            _flush(file, builder)
    _flush(file, builder)


def _first_ns(result: Result) -> int:
    """Send time of the first SYNC, CLOCK_REALTIME."""
    stamp = result.run.joints[0]["header"]["stamp"][0]
    return int(stamp["sec"]) * 1_000_000_000 + int(stamp["nanosec"])


def _flush(file: McapFile, builder: ChunkBuilder) -> None:
    sealed = builder.seal()
    if sealed is not None:
        file.append(sealed)


def _attachments(results: list[Result]) -> list[NamedData]:
    """Those of the first log, and what was done."""
    kept = read_attachments(results[0].run.parts[0].path)
    made = json.dumps({"schema": "jtq.replay/1", "runs": [each.to_mapping() for each in results]}).encode()
    return [
        *(NamedData(name, _media_type(name), data) for name, data in kept.items()),
        NamedData("replay.json", "application/json", made),
    ]


def _media_type(name: str) -> str:
    suffixes: Iterable[tuple[str, str]] = (
        (".yaml", "application/yaml"),
        (".json", "application/json"),
        (".onnx", "application/octet-stream"),
    )
    return next((kind for suffix, kind in suffixes if name.endswith(suffix)), "text/plain")


def _messages(result: Result, number: int) -> Records:
    """Message records of joint `number` (0 or 1): logged and replayed [n, 2]."""
    logged, replayed = result.run.joints[number], result.joints[number]
    assert _MESSAGE.itemsize == 31 + JOINT_ESTIMATE_SIZE
    out = np.zeros((len(logged), 2), _MESSAGE)
    stamp = logged["header"]["stamp"]
    seconds, nanoseconds = stamp["sec"].astype(np.uint32), stamp["nanosec"]
    time_ns = seconds.astype(np.uint64) * np.uint64(1_000_000_000) + nanoseconds.astype(np.uint64)
    name = f"joint_{number + 1}\0".encode()
    constants = {
        "opcode": _OPCODE_MESSAGE,
        "rest": _RECORD_REST + JOINT_ESTIMATE_SIZE,
        "cdr": CDR_HEADER,
        "frame_id": np.void(len(name).to_bytes(4, "little") + name + bytes(4)),
    }
    for field, value in constants.items():
        out[field] = value
    out["channel"] = [[2 * number + 1, 2 * number + 2]]
    columns = {
        "sequence": logged["cycle"] & 0xFFFF_FFFF,
        "log_time": time_ns,
        "publish_time": time_ns,
        "sec": seconds.view(np.int32),
        "nanosec": nanoseconds,
        **{name: logged[name] for name in ("cycle", "sync_monotonic_ns", "sync_counter", "cycle_flags")},
        **{name: logged[name] for name in SAMPLE.names or ()},
    }
    for field, values in columns.items():
        out[field] = values[:, np.newaxis]
    for field in replayed.dtype.names or ():
        out[field][:, 1] = replayed[field]
    return out
