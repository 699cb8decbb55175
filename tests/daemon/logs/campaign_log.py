"""Logs of jtqd with known content, for the tests of campaigns: written by the recorder's own code, cycle by cycle."""

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

from mcap.records import Channel, Schema

from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData
from jtqd.daemon.recording.messages import CycleMessages, EventLog, JointStateMessage, definitions
from jtqd.daemon.recording.recorder import Recording
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared import cycle_record as cr

START_NS = 1_700_000_000_000_000_000
ENABLED, OFF = 0x1237, 0x1250


class Joint(NamedTuple):
    """What one joint's block of a cycle holds."""

    current_a: float = 1.0
    motor_position_rad: float = 2.0
    motor_velocity_rad_s: float = 3.0
    link_position_rad: float = 4.0
    sensor_nm: float = 5.0
    statusword: int = ENABLED
    input_flags: int = 7


class Cycle(NamedTuple):
    """One cycle: its number, when its SYNC was sent, the joints, and what came as (COB-ID, data)."""

    index: int
    time_ns: int
    joints: tuple[Joint, ...]
    frames: Sequence[tuple[int, bytes]] = ()


class _Together(ChunkBuilder):
    """All topics in one chunk, as the recorder wrote them before 0.2."""

    def __init__(self, schemas: Sequence[Schema], channels: Sequence[Channel], joints: int) -> None:
        super().__init__(schemas, channels, [], 60)
        self._messages = CycleMessages(joints)

    def add_block(self, block: bytes, time_ns: int) -> None:
        """Add the messages one by one."""
        (sequence,) = struct.unpack_from("<I", block, 11)
        for channel, payload in self._messages.payloads(block):
            self.add(channel, time_ns, payload, sequence)


def write_log(
    path: Path,
    cycles: Iterable[Cycle],
    joints: int = 2,
    configuration: str = "",
    *,
    together: bool = False,
    attachments: Sequence[NamedData] = (),
    chunk_ns: int = 500_000_000,
) -> Path:
    """An MCAP file of these cycles, each of so many joints; `configuration` is attached to it.

    together: all topics in one chunk, as before 0.2.
    """
    schemas, channels = definitions(joints)
    if configuration:
        attachments = [NamedData("configuration.yaml", "application/yaml", configuration.encode())]
    file = McapFile(path, Head(schemas, channels, attachments), {"run": "test", "part": "1"}, 1)
    if together:
        builder: ChunkBuilder = _Together(schemas, channels, joints)
    else:
        builder = ChunkBuilder(schemas, channels, CycleMessages(joints).parts, 60)
    sink = SimpleNamespace(write=lambda span, at_ns: file.append(span))
    overview = JointStateMessage("abcd"[:joints], (1.0,) * joints)
    events = EventLog(builder.add)
    recording = Recording(builder, events, sink, overview, chunk_ns=chunk_ns, account=Account())
    for cycle in cycles:
        recording.add(_record(cycle))
    recording.flush()
    file.finish(path.name)
    return path


def regular(count: int, joints: Callable[[int], tuple[Joint, ...]], start: int = 100) -> list[Cycle]:
    """`count` cycles, 1 ms apart, the first numbered `start`."""
    return [Cycle(start + n, 7_000_000_000 + n * 1_000_000, joints(n)) for n in range(count)]


def temperature(node: int, celsius: float) -> tuple[int, bytes]:
    """TPDO3 of a drive."""
    return 0x380 + node, struct.pack("<h", round(10 * celsius))


def _record(cycle: Cycle) -> bytes:
    layout = cr.layout_of(len(cycle.joints))
    record = bytearray(layout.size)
    blocks: list[float] = []
    for joint in cycle.joints:
        # no temperature, no estimate
        numbers = [*joint[:5], *[math.nan] * 6, 1e-3, *[math.nan] * 4]
        blocks += [*numbers, joint.statusword, 0, 0, joint.input_flags]
    counts = (cycle.index % 240 + 1, len(cycle.frames), 0, 0, 0, 0, 0, 0)
    layout.head.pack_into(
        record, 0, cycle.index, cycle.time_ns, START_NS + cycle.time_ns, 15, 0, 0, 0, *counts, *blocks
    )
    for n, (can_id, data) in enumerate(cycle.frames):
        struct.pack_into("<IB3x8s", record, layout.frames_offset + 16 * n, can_id, len(data), data)
    cr.TAIL.pack_into(record, layout.tail_offset, cycle.index)
    return bytes(record)
