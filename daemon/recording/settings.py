"""Section `recording` of the configuration: how long files are, how much disk they may take, or the flight recorder."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.checked import Section


@dataclass(frozen=True)
class RecordingSettings:
    """Megabytes are of 1 000 000 bytes.

    Attributes:
        ring_cycles: cycles that shared memory holds for the recorder: for so long it may be stopped.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        rotate_s, rotate_mb: a file is ended and the next one begun after this time, or at this size.
        budget_mb: all files of this bus in the directory; older ones are removed. None: nothing is removed.
        keep_run: the budget never removes a part of the run that is being written.
        reserve_mb: recording ends when less than this is free, and goes on when there is room again.
        flight_recorder_s: keep this time in memory and write it on a fault or on request. None: record all.
    """

    ring_cycles: int = 4096
    chunk_s: float = 0.5
    rotate_s: float = 600.0
    rotate_mb: float = 1000.0
    budget_mb: float | None = None
    keep_run: bool = True
    reserve_mb: float = 256.0
    flight_recorder_s: float | None = None

    @classmethod
    def from_section(cls, section: Section | None) -> RecordingSettings:
        """Read and finish the section; without one everything takes its default. Raises ConfigError."""
        if section is None:
            return cls()
        result = cls(
            ring_cycles=section.integer("ring_cycles", low=256, high=1 << 20, default=cls.ring_cycles),
            chunk_s=section.number("chunk_s", unit="s", low=0.05, high=10.0, default=cls.chunk_s),
            rotate_s=section.number("rotate_s", unit="s", low=1.0, high=86_400.0, default=cls.rotate_s),
            rotate_mb=section.number("rotate_mb", unit="MB", low=1.0, high=1e6, default=cls.rotate_mb),
            budget_mb=section.number("budget_mb", unit="MB", low=10.0, high=1e9, default=None),
            keep_run=section.boolean("keep_run", default=cls.keep_run),
            reserve_mb=section.number("reserve_mb", unit="MB", low=0.0, high=1e9, default=cls.reserve_mb),
            flight_recorder_s=section.number(
                "flight_recorder_s", unit="s", low=1.0, high=600.0, default=None
            ),
        )
        section.finish()
        return result
