"""`logs`: one joint of a log into arrays, by `jtqd.daemon.logs` and by the mcap library with its ROS 2 decoder.

The file is written by the recorder's own code, with noise in every measured quantity and seven frames a cycle. Both read it
in turns in one process; the figures are CPU times of this process, extrapolated to an hour. Beside them the least that any
reader must do: each chunk of the joint unpacked (zstd) and its CRC, from memory.
"""

from __future__ import annotations

import random
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk

from jtqd.daemon.logs import read_topic
from tests.benchmarks.measure import mark, table
from tests.daemon.logs.campaign_log import Cycle, Joint, write_log

RATIO_LIMIT = 10.0
HOUR_LIMIT_S = 2.0
TOPIC = "/joint/1/state"
_RATE_HZ = 1000
_SEED = 5
_IDS = (0x080, 0x181, 0x281, 0x182, 0x282, 0x183, 0x1A0)
_HOUR = 3600 * _RATE_HZ


def run(directory: Path, *, minutes: float = 5.0, rounds: int = 3) -> dict[str, Any]:
    """Write a log, read it both ways. Raises RuntimeError where the library's decoder is not installed."""
    try:
        import mcap_ros2.decoder  # noqa: F401
    except ImportError:
        raise RuntimeError("pip install mcap-ros2-support") from None
    path = directory / "log.mcap"
    cycles = int(minutes * 60 * _RATE_HZ)
    write_log(path, _cycles(cycles))
    ways: dict[str, Callable[[Path], np.ndarray[Any, Any]]] = {"ours": _ours, "library": _library}
    packed = _chunks(path)
    cpu_s: dict[str, list[float]] = {name: [] for name in (*ways, "floor")}
    sums = {}
    for _ in range(rounds):
        for name, read in ways.items():
            start = time.process_time()
            values = read(path)
            cpu_s[name].append(time.process_time() - start)
            sums[name] = float(np.nansum(values)), values.shape
        start = time.process_time()
        _unpack(packed)
        cpu_s["floor"].append(time.process_time() - start)
    if len(set(sums.values())) != 1:
        raise RuntimeError(f"the readers do not agree: {sums}")
    best = {name: min(times) for name, times in cpu_s.items()}
    return {
        "cycles": cycles,
        "bytes": path.stat().st_size,
        "seed": _SEED,
        "cpu_s": cpu_s,
        "us_per_message": {name: 1e6 * seconds / cycles for name, seconds in best.items()},
        "hour_s": {name: seconds * _HOUR / cycles for name, seconds in best.items()},
        "ratio": best["library"] / best["ours"],
        "python": sys.version.split()[0],
    }


def _cycles(count: int) -> Iterator[Cycle]:
    source = random.Random(_SEED)
    noise = source.random
    for n in range(count):
        joints = tuple(Joint(noise(), noise(), noise(), noise(), noise()) for _ in range(2))
        frames = [(can_id, struct.pack("<iI", n, source.getrandbits(12))) for can_id in _IDS]
        yield Cycle(n, 1_000_000 * n, joints, frames)  # type: ignore[arg-type]


_FIELDS = (
    "current_a",
    "motor_position_rad",
    "motor_velocity_rad_s",
    "link_position_rad",
    "sensor_torque_nm",
    "torque_nm",
    "sigma_nm",
)


def _ours(path: Path) -> np.ndarray[Any, Any]:
    records = read_topic(path, TOPIC)
    return np.stack([records[field] for field in _FIELDS], axis=1)


def _chunks(path: Path) -> list[Chunk]:
    """Return the chunks that hold the joint, packed, by the library."""
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        (wanted,) = (number for number, channel in summary.channels.items() if channel.topic == TOPIC)
        found = []
        for index in summary.chunk_indexes:
            if wanted not in index.message_index_offsets:
                continue
            file.seek(index.chunk_start_offset + 1 + 8)
            found.append(Chunk.read(ReadDataStream(file)))
    return found


def _unpack(chunks: list[Chunk]) -> None:
    unpack = zstandard.ZstdDecompressor().decompress
    for chunk in chunks:
        if zlib.crc32(unpack(chunk.data, max_output_size=chunk.uncompressed_size)) != chunk.uncompressed_crc:
            raise RuntimeError("a chunk's CRC does not match")


def _library(path: Path) -> np.ndarray[Any, Any]:
    """With what makes it fastest: no sorting, no CRC (ours checks it), the topic's messages only."""
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        rows = [
            [getattr(message, field) for field in _FIELDS]
            for *_, message in reader.iter_decoded_messages([TOPIC], log_time_order=False)
        ]
    return np.array(rows)


def text(result: dict[str, Any]) -> str:
    rows = [
        [name, f"{result['us_per_message'][key]:.2f}", f"{result['hour_s'][key]:.1f}"]
        for name, key in (
            ("jtqd.daemon.logs", "ours"),
            ("mcap + mcap-ros2-support", "library"),
            ("zstd and CRC of the joint's chunks", "floor"),
        )
    ]
    head = ["one joint into arrays", "us a message", "s for an hour"]
    size = result["bytes"] * _HOUR / result["cycles"] * 1e-9
    hour_s = result["hour_s"]["ours"]
    above = hour_s / result["hour_s"]["floor"]
    return (
        f"logs: {result['cycles']} cycles, {size:.2f} GB an hour, seed {result['seed']}, CPU time of the best round\n"
        f"{table(head, rows)}\n"
        f"ratio {result['ratio']:.1f}  {mark(result['ratio'], RATIO_LIMIT, at_least=True)}\n"
        f"an hour {hour_s:.1f} s  {mark(hour_s, HOUR_LIMIT_S)}, {above:.2f} times zstd and CRC alone"
    )
