"""A repair that is worked out but not done yet."""

from __future__ import annotations

from dataclasses import dataclass, field

from mcap.opcode import Opcode

from jtqd.daemon.logs.chunks import HEAD_SIZE, chunk_head
from jtqd.daemon.logs.found import Scan
from jtqd.daemon.logs.records import Source
from jtqd.daemon.recording.mcap_file import MAGIC

_GUESS_LIMIT_S = 600.0
"""A torn chunk whose head says that it is longer than this is not believed."""


@dataclass
class Plan:
    """Changes to a file, and what was lost."""

    patches: list[tuple[int, bytes]] = field(default_factory=list)
    end: int = 0
    """Where the data end; `tail` follows, and nothing else."""
    tail: bytes = b""
    clean: bool = False
    """Nothing needs to be written."""
    findings: list[str] = field(default_factory=list)
    """One line each."""
    lost_bytes: int = 0
    lost_chunks: int = 0
    lost_s: float = 0.0
    damaged: bool = False
    """Something was lost, or cannot be trusted."""


def torn_seconds(source: Source, found: Scan) -> float:
    """Time for which the torn end of a file stood [s]: what the head of its chunk says, else by the rate so far."""
    if found.start_ns is None:
        return 0.0
    head = chunk_head(source.read(found.end, HEAD_SIZE))
    if head is not None and source.read(found.end, 1) == bytes([Opcode.CHUNK]):
        seconds = (head.end_ns - found.end_ns) * 1e-9
        if 0.0 <= seconds < _GUESS_LIMIT_S:
            return seconds
    data = found.end - (found.chunks[0].offset if found.chunks else len(MAGIC))
    return (found.end_ns - found.start_ns) * 1e-9 * (found.size - found.end) / max(data, 1)
