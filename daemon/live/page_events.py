"""What the page in the browser gets, as server-sent events: `samples` 20 times a second, `state` five times.

`samples` has one cycle in 20 ms, which viewers get as well, with the numbers and names of the log's fields. `state` is
`jtq.status/1` with the histograms of the cycle.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.live.reading import Daemon, Watch, content
from jtqd.daemon.shared.cycle_record import (
    SHADOW,
    SHADOW_FIELDS,
    SHADOW_METHODS,
    header_of,
    joint_of,
    layout_of,
)
from jtqd.daemon.shared.runtime_dir import FILE, AboutError, read_about
from jtqd.daemon.shared.snapshot import WORK_BIN_NS
from jtqd.estimator.text import finite

SAMPLE_NS: Final = 20_000_000
"""50 Hz."""
_PERIOD_NS: Final = 50_000_000
_STATE_EVERY: Final = 4
_FIELDS: Final = ("torque_nm", "sigma_nm", "reference_nm", "status")
_SHADOW_FIELDS: Final = tuple(
    f"{method}_{name}" for method in SHADOW_METHODS for name in ("torque_nm", "sigma_nm", "reference_nm")
)


class Samples:
    """Columns of the cycles since the last event: `time_s` (SYNC, CLOCK_REALTIME), `cycle`, and fields of each joint."""

    def __init__(self, joints: int, *, shadow: bool) -> None:
        self._joints = range(joints)
        self._shadow_offset = layout_of(joints, shadow).shadow_offset if shadow else None
        self._slot = -1
        self._forget()

    def _forget(self) -> None:
        names = _FIELDS if self._shadow_offset is None else (*_FIELDS, *_SHADOW_FIELDS)
        self._times: list[float] = []
        self._cycles: list[int] = []
        self._columns: list[dict[str, list[Any]]] = [{name: [] for name in names} for _ in self._joints]

    def take(self, records: Iterable[bytes]) -> None:
        """Take the cycles that viewers get."""
        for record in records:
            header = header_of(record)
            slot = header.sync_monotonic_ns // SAMPLE_NS
            if slot == self._slot:
                continue
            self._slot = slot
            self._times.append(header.sync_realtime_ns * 1e-9)
            self._cycles.append(header.cycle)
            for n in self._joints:
                self._take_joint(record, n)

    def _take_joint(self, record: bytes, n: int) -> None:
        columns, joint = self._columns[n], joint_of(record, n + 1)
        for name in _FIELDS:
            columns[name].append(finite(getattr(joint, name)))
        if self._shadow_offset is not None:
            values = SHADOW.unpack_from(record, self._shadow_offset + n * SHADOW.size)
            shadow = dict(zip(SHADOW_FIELDS, values, strict=True))
            for name in _SHADOW_FIELDS:
                columns[name].append(finite(shadow[name]))

    def content(self) -> dict[str, Any]:
        """Return the columns and begin new ones."""
        made = {"time_s": self._times, "cycle": self._cycles, "joints": self._columns}
        self._forget()
        return made


class PageEvents:
    """Events for all pages of one daemon. directory: its runtime directory; times are CLOCK_MONOTONIC [ns]."""

    def __init__(self, directory: Path, joints: int, *, shadow: bool) -> None:
        self._directory = directory
        self._samples = Samples(joints, shadow=shadow)
        self._watch: Watch | None = None
        self._due_ns = self._count = 0

    def take(self, records: Iterable[bytes], now_ns: int) -> bytes:
        """Take cycles; return the events that are due."""
        self._samples.take(records)
        if now_ns < self._due_ns:
            return b""
        late = now_ns - self._due_ns > _PERIOD_NS
        self._due_ns = (now_ns if late else self._due_ns) + _PERIOD_NS
        made = _event("samples", self._samples.content())
        if self._count % _STATE_EVERY == 0 and (state := self._state()) is not None:
            made += _event("state", state)
        self._count += 1
        return made

    def _state(self) -> dict[str, Any] | None:
        """Return the state; None before the daemon has described itself."""
        if self._watch is None:
            try:
                about = read_about(self._directory / FILE)
            except (AboutError, PermissionError):
                return None
            self._watch = Watch(Daemon(self._directory, about))
        reading = self._watch.read()
        about = reading.daemon.about
        page = {
            "period_us": about.period_us,
            "bin_us": WORK_BIN_NS / 1000,
            "work": _until_the_last(reading.work),
            "late": _until_the_last(reading.late),
        }
        return content(reading) | {"page": page}


def _until_the_last(bins: tuple[int, ...]) -> list[int]:
    """Return the bins of a histogram without the empty ones at its end."""
    return list(bins[: max((n + 1 for n, count in enumerate(bins) if count), default=0)])


def _event(name: str, content: dict[str, Any]) -> bytes:
    return f"event: {name}\ndata: {json.dumps(content, separators=(',', ':'))}\n\n".encode()
