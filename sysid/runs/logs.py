"""jtqd's log of a run as a run table: what the estimator was given, cycle by cycle, and what is missing of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs import LogError, Records, read_topics
from jtqd.drivers.devices import NOT_MEASURED, TEMPERATURE_C_PER_UNIT, drive_tpdo3
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.run import JointColumns, RunTable

ALL_INPUTS: Final = 7
"""input_flags of the log: both PDOs of the drive and the sensor's are of this cycle."""
DRIVE_INPUTS: Final = 3
_ENABLED_MASK, _ENABLED = 0x6F, 0x27  # 6041h: "operation enabled" of CiA 402
_NO_POWER: Final = ((0x4F, 0x40), (0x6F, 0x21), (0x6F, 0x23))
"""Mask and value of 6041h: switch on disabled, ready to switch on, switched on."""
_INPUTS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad")
_TOPICS: Final = ("/joint/1/state", "/joint/2/state", "/can/frames")
_NS: Final = 1e-9

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class LoggedRun:
    """The run table of a log and the account of its cycles: rows + incomplete + missed are all slots of SYNC.

    Attributes:
        table: joints 1 and 2; torque_nm is None where the log has no value of the sensor at all, temperature_c where
            the drive sent none.
        missed: slots without a cycle (missed by the loop, or left silent on purpose).
        incomplete: cycles left out because an input was not fresh.
        incomplete_by: the same by input, e.g. {"joint 2": 3, "sensor": 1}; a cycle may miss several.
        longest_gap_s: longest time between two rows.
    """

    table: RunTable
    missed: int
    incomplete: int
    incomplete_by: Mapping[str, int]
    longest_gap_s: float

    @property
    def lost_share(self) -> float:
        """Part of the slots that are no rows."""
        lost = self.missed + self.incomplete
        return lost / (lost + len(self.table.time_s))


def log_to_run(
    log: Path | Sequence[Path], *, nodes: tuple[int, int] = (1, 2), sensor: bool = True
) -> LoggedRun:
    """Read both joints of a log from the first to the last cycle in which both drives are in "operation enabled".

    The commander sends its first set-point in the cycle after the first of these, and ends with a quick stop: no other
    clock is needed to know when the motion was.

    Args:
        log: MCAP of jtqd, or the parts of one run, or their directory.
        nodes: node-IDs of drive 1 and 2, for their temperatures.
        sensor: a row needs the sensor's value; False: the bench has none, torque_nm is None.

    Raises:
        LogError: no such cycle, an input that never came, or topics that do not belong together.
        OSError: the file cannot be read.
    """
    *states, frames = read_topics(log, _TOPICS).values()
    log = log if isinstance(log, Path) else log[0]  # names the run where something is wrong
    for state in states:
        if not np.array_equal(state["cycle"], frames["cycle"]):
            raise LogError(f"{log}: found cycles in one topic that are not in the other, expected the same")
    span = _span(states, log)
    temperatures = [_temperature(frames, node, span) for node in nodes]
    one, two = (state[span] for state in states)
    present = {f"joint {n}": _complete(state, n, log) for n, state in ((1, one), (2, two))}
    if sensor:
        present["sensor"] = _with_sensor(one, two)
    if not present.get("sensor", np.ones(1)).any():
        del present["sensor"]  # a dead sensor must not take the drives' columns with it
        sensor = False
    used: Flags = np.logical_and.reduce(list(present.values()))
    if np.count_nonzero(used) < 2:
        raise LogError(
            f"{log}: found {counted(int(np.count_nonzero(used)), 'complete cycle')}, expected at least 2"
        )
    stamps = one["sync_monotonic_ns"][used].astype(np.int64)
    cycles = one["cycle"].astype(np.int64)
    table = RunTable(
        (stamps - stamps[0]) * _NS,
        {
            n: _columns(state[used], sensor, temperature if temperature is None else temperature[used])
            for n, state, temperature in zip((1, 2), (one, two), temperatures, strict=True)
        },
    )
    return LoggedRun(
        table=table,
        missed=int(cycles[-1] - cycles[0]) + 1 - len(cycles),
        incomplete=int(np.count_nonzero(~used)),
        incomplete_by={name: int(np.count_nonzero(~flags)) for name, flags in present.items()},
        longest_gap_s=float(np.diff(table.time_s).max()),
    )


def _span(states: list[Records], log: Path) -> slice:
    """From the first to the last cycle that counts; what is stale in between is looked at later."""
    counts = np.ones(len(states[0]), np.bool_)
    for state in states:
        counts &= (state["statusword"] & _ENABLED_MASK) == _ENABLED
        counts &= (state["input_flags"] & DRIVE_INPUTS) == DRIVE_INPUTS
    rows = np.flatnonzero(counts)
    if len(rows) < 2:
        raise LogError(
            f"{log}: found {counted(len(rows), 'cycle')} of the motion with both drives in 'operation enabled', "
            "expected at least 2"
        )
    return slice(int(rows[0]), int(rows[-1]) + 1)


def _complete(state: Records, number: int, log: Path) -> Flags:
    """Return cycles [n] with all four inputs of a joint; LogError for one that never came."""
    there: Flags = (state["input_flags"] & DRIVE_INPUTS) == DRIVE_INPUTS
    for name in _INPUTS:
        finite = np.isfinite(state[name])
        if not finite.any():
            raise LogError(
                f"{log}: j{number}.{name}: found no value in {counted(len(state), 'cycle')}, expected one in each"
            )
        there = there & finite
    return there


def _with_sensor(one: Records, two: Records) -> Flags:
    """Return cycles [n] in which every joint that has the sensor at all has it."""
    flags = [np.isfinite(state["sensor_torque_nm"]) for state in (one, two)]
    have = [each for each in flags if each.any()] or flags
    result: Flags = np.logical_and.reduce(have)
    return result


def _columns(state: Records, sensor: bool, temperature: FloatArray | None) -> JointColumns:
    def column(name: str) -> Any:
        return np.asarray(state[name], np.float64)

    torque = column("sensor_torque_nm") if sensor else None
    return JointColumns(
        **{name: column(name) for name in _INPUTS},
        torque_nm=torque if torque is not None and np.isfinite(torque).all() else None,
        temperature_c=temperature,
        enabled=_powered(state["statusword"]),
    )


def _powered(statusword: NDArray[Any]) -> FloatArray | None:
    """Column `enabled` [n]; None for a run in which the power was never off, which is most of them."""
    off = np.logical_or.reduce([(statusword & mask) == value for mask, value in _NO_POWER])
    return np.where(off, 0.0, 1.0) if off.any() else None


def _temperature(frames: Records, node: int, span: slice) -> FloatArray | None:
    """Temperature [n] of a drive's joint over the cycles of `span` [degC] by its TPDO3, held between two; None without any.

    Before the first frame of the span that frame's value holds: the one before it was sent while the drive was off, and an
    emulated day begins when the drives are enabled. Where the span has no frame, the last one before it counts.
    """
    raw = frames["frames"]
    stored = np.arange(raw.shape[1]) < frames["frame_count"][:, None]
    at = stored & (raw["id"] == drive_tpdo3(node).cob_id) & (raw["length"] >= 2)
    rows, places = np.nonzero(at)
    counts = np.ascontiguousarray(raw["data"][rows, places][:, :2]).view("<i2")[:, 0]
    rows, values = rows[counts != NOT_MEASURED], counts[counts != NOT_MEASURED] * TEMPERATURE_C_PER_UNIT
    if not len(rows):
        return None
    cycles = np.arange(len(frames))[span]
    last = np.searchsorted(rows, cycles, side="right") - 1
    first = min(int(np.searchsorted(rows, cycles[0])), int(last[-1]))
    return np.asarray(values[np.maximum(last, max(first, 0))], np.float64)
