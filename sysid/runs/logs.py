"""Logs of jtqd as run tables: the inputs of the estimator cycle by cycle, and an account of the missing cycles.

A log has one to four joints, and a reference for those with a channel of the torque sensor. Drive temperatures are taken
from the recorded frames chunk by chunk, so that the frames, which are most of a log, are not kept in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs import LogError, LogFile, Records, iter_topics, log_parts, topics_of
from jtqd.drivers.drive import NOT_MEASURED, STATE_MASK, STATES, TEMPERATURE_C_PER_UNIT, State, drive_tpdo3
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.estimator.text import counted
from jtqd.models.files import parse_yaml
from jtqd.sysid.runs.column_map import TIME
from jtqd.sysid.runs.run_file import Content, RunError, file_bytes

DRIVE_INPUTS: Final = 3
"""input_flags of the log: both PDOs of the drive are of this cycle."""
_ENABLED: Final = np.array([state is State.OPERATION_ENABLED for state in STATES])
_NO_POWER: Final = np.array(
    [state in (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON) for state in STATES]
)
_LINK: Final = "link_position_rad"
"""Absent in the log of a joint with one encoder."""
_INPUTS: Final = ("current_a", "motor_position_rad", "motor_velocity_rad_s", _LINK)
_STATE: Final = np.dtype(
    [
        ("cycle", "<u8"),
        ("sync_monotonic_ns", "<i8"),
        *((name, "<f8") for name in (*_INPUTS, "sensor_torque_nm")),
        ("statusword", "<u2"),
        ("input_flags", "<u2"),
    ]
)
"""Fields of a joint's messages that are read."""
_TOPIC: Final = re.compile(r"/joint/(\d+)/state")
_FRAMES: Final = "/can/frames"
_CONFIGURATION: Final = "configuration.yaml"
_NS: Final = 1e-9

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class LoggedRun:
    """Run table of a log with an account of its cycles: rows + incomplete + missed are all slots of SYNC.

    missed: slots without a cycle. incomplete: cycles left out because an input was not fresh, and by input, e.g. {"joint
    2": 3, "sensor": 1}; a cycle may miss several. longest_gap_s: between two rows. left_out: joints of the log that are not
    in the table, and why.
    """

    table: RunTable
    missed: int
    incomplete: int
    incomplete_by: Mapping[str, int]
    longest_gap_s: float
    left_out: Mapping[int, str] = field(default_factory=dict)

    @property
    def lost_share(self) -> float:
        """Part of the slots that are no rows."""
        lost = self.missed + self.incomplete
        return lost / (lost + len(self.table.time_s))


def log_to_run(
    log: Path | Sequence[Path],
    *,
    joints: Sequence[int] | None = None,
    all_needed: bool = False,
    nodes: Sequence[int] | None = None,
    sensor: bool = True,
    enabled: Sequence[int] = (),
    last_motion: bool = False,
) -> LoggedRun:
    """Read joints of a log (a file, the parts of one run, or their directory) from the first to the last cycle in which all
    their drives are in "operation enabled"; a joint that is read alone has its own first and last cycle.

    joints: numbers; None: all. Those whose drive was never enabled, or that lack an input in the whole motion, are left out
    and reported, as long as one remains; all_needed: refused instead. nodes: node-IDs of the drives, for their
    temperatures; None: by the configuration attached to the log, else 1, 2, ... sensor: a row needs the sensor's value
    where a joint has a channel of it. enabled: further joints whose drives must be enabled at both ends. last_motion: begin
    after the last time without power.

    Raises LogError: no such joint or cycle, an input that never came, or topics that do not belong together; OSError.
    """
    name = log if isinstance(log, Path) else log[0]  # names the run in messages
    there = _joints_of(log, name)
    wanted = list(dict.fromkeys(there if joints is None else joints))
    left_out: dict[int, str] = {}

    def leave_out(reasons: Mapping[int, str]) -> None:
        left_out.update(reasons)
        if left_out and (all_needed or len(left_out) == len(wanted)):
            raise LogError(f"{name}: {'; '.join(left_out.values())}")

    have = ", ".join(map(str, there))
    leave_out({n: f"found no joint {n}, the log has {have}" for n in wanted if n not in there})
    sources = _temperatures_of(log, there)
    for number, node in zip(there, nodes or (), strict=False):
        sources[number] = node, sources[number][1]
    read = dict.fromkeys(number for number in (*wanted, *enabled) if number in there)
    states, readings = _read(log, name, {number: sources[number] for number in read})
    others = {number: states.pop(number) for number in list(states) if number not in wanted}
    leave_out({number: why for number, state in states.items() if (why := _unusable(number, state))})
    states = {number: state for number, state in states.items() if number not in left_out}
    span = _span(states | others, name, last_motion=last_motion)
    temperatures = {number: _temperature(readings[number], span) for number in states}
    states = {number: state[span] for number, state in states.items()}
    return _run_of(name, states, temperatures, sensor=sensor, left_out=left_out)


def _run_of(
    log: Path,
    states: Mapping[int, Records],
    temperatures: Mapping[int, FloatArray | None],
    *,
    sensor: bool,
    left_out: Mapping[int, str],
) -> LoggedRun:
    """Return the complete cycles of a motion as a table, with an account of the others; LogError where there are none."""
    present = {f"joint {number}": _complete(number, state, log) for number, state in states.items()}
    with_sensor = _with_sensor(states.values()) if sensor else None
    if with_sensor is not None:  # with a dead sensor the drives' columns remain
        present["sensor"] = with_sensor
    used: Flags = np.logical_and.reduce(list(present.values()))
    complete = int(np.count_nonzero(used))
    if complete < 2:
        raise LogError(f"{log}: found {counted(complete, 'complete cycle')}, expected at least 2")
    one = next(iter(states.values()))
    stamps, cycles = one["sync_monotonic_ns"][used], one["cycle"].astype(np.int64)
    columns = {}
    for number, state in states.items():
        celsius = temperatures[number]
        columns[number] = _columns(
            state[used], with_sensor is not None, None if celsius is None else celsius[used]
        )
    table = RunTable((stamps - stamps[0]) * _NS, columns)
    return LoggedRun(
        table=table,
        missed=int(cycles[-1] - cycles[0]) + 1 - len(cycles),
        incomplete=len(used) - complete,
        incomplete_by={each: int(np.count_nonzero(~flags)) for each, flags in present.items()},
        longest_gap_s=float(np.diff(table.time_s).max()),
        left_out=left_out,
    )


def _joints_of(log: Path | Sequence[Path], name: Path) -> list[int]:
    """Return the numbers of the joints of a log; LogError where there is none."""
    there = sorted(int(found[1]) for found in map(_TOPIC.fullmatch, topics_of(log)) if found)
    if not there:
        others = f" ({', '.join(sorted(topics_of(log)))}: `jtq export csv --topic` makes a table of one)"
        raise LogError(f"{name}: found no message on /joint/1/state, expected one per cycle{others}")
    return there


TemperatureOf = tuple[int, float]
"""Node-ID of a drive, and degrees Celsius per unit of what its TPDO3 carries."""


def _temperatures_of(log: Path | Sequence[Path], there: Sequence[int]) -> dict[int, TemperatureOf]:
    """Return those of the joints by the attached configuration; where it cannot be read, their numbers and 3001h."""
    mapping: Mapping[str, Any] = {}
    with LogFile(log_parts(log)[0]) as file:
        for index in file.attachments:
            if index.name == _CONFIGURATION:
                with contextlib.suppress(ConfigError, LogError):
                    mapping = parse_yaml(file.attachment(index), _CONFIGURATION)
    found = {}
    for number in there:
        section = mapping.get(f"joint_{number}")  # not checked yet
        keys = section if isinstance(section, dict) else {}
        node, objects = keys.get("node"), keys.get("objects")
        own = objects.get("temperature") if isinstance(objects, dict) else None
        scale = own.get("factor") if isinstance(own, dict) else None
        found[number] = (
            node if isinstance(node, int) else number,
            float(scale) if isinstance(scale, int | float) else TEMPERATURE_C_PER_UNIT,
        )
    return found


Readings = tuple[NDArray[np.int64], FloatArray]
"""Temperatures [degC] of a drive, and the cycles they came in, counted from the first one of the log [n]."""


def _read(
    log: Path | Sequence[Path], name: Path, nodes: Mapping[int, TemperatureOf]
) -> tuple[dict[int, Records], dict[int, Readings]]:
    """Return states and temperatures of the joints, in one pass; all have the same cycles."""
    topics = {number: f"/joint/{number}/state" for number in nodes}
    states: dict[int, list[Records]] = {number: [] for number in nodes}
    readings: dict[int, list[Readings]] = {number: [] for number in nodes}
    cycles: list[NDArray[Any]] = []
    count = 0
    for found in iter_topics(log, (*topics.values(), _FRAMES)):
        for number, topic in topics.items():
            if topic in found:
                records = found[topic].records
                kept = np.empty(len(records), _STATE)
                for field_name in _STATE.names or ():
                    kept[field_name] = records[field_name]
                states[number].append(kept)
        if _FRAMES in found:
            frames = found[_FRAMES].records
            for number, (rows, values) in _temperatures(frames, nodes).items():
                readings[number].append((rows + count, values))
            cycles.append(frames["cycle"].copy())
            count += len(frames)
    for topic, parts in ((_FRAMES, cycles), *((topics[n], parts) for n, parts in states.items())):
        if not parts:
            raise LogError(f"{name}: found no message on {topic}, expected one per cycle")
    counted_cycles = np.concatenate(cycles)
    whole = {number: np.concatenate(parts) for number, parts in states.items()}
    for state in whole.values():
        if not np.array_equal(state["cycle"], counted_cycles):
            raise LogError(f"{name}: found cycles in one topic that are not in the other, expected the same")
    empty = (np.empty(0, np.int64), np.empty(0))
    joined = {
        number: (np.concatenate([rows for rows, _ in parts]), np.concatenate([each for _, each in parts]))
        if parts
        else empty
        for number, parts in readings.items()
    }
    return whole, joined


def _temperatures(frames: Records, nodes: Mapping[int, TemperatureOf]) -> dict[int, Readings]:
    """Return the temperatures of the drives' TPDO3 in these cycles: rows and values [degC] by joint."""
    raw = frames["frames"]
    stored = np.arange(raw.shape[1]) < frames["frame_count"][:, None]
    stored &= raw["length"] >= 2
    found = {}
    for number, (node, c_per_unit) in nodes.items():
        rows, places = np.nonzero(stored & (raw["id"] == drive_tpdo3(node).cob_id))
        if not len(rows):
            continue
        counts = np.ascontiguousarray(raw["data"][rows, places][:, :2]).view("<i2")[:, 0]
        good = counts != NOT_MEASURED
        found[number] = rows[good], counts[good] * c_per_unit
    return found


def _enabled(state: Records) -> Flags:
    """Return cycles [n] in which the drive is in "operation enabled", by a fresh statusword."""
    found: Flags = _ENABLED[state["statusword"] & STATE_MASK]
    return found & _fresh(state)


def _fresh(state: Records) -> Flags:
    found: Flags = (state["input_flags"] & DRIVE_INPUTS) == DRIVE_INPUTS
    return found


def _unusable(number: int, state: Records) -> str:
    """Return why a joint has no run in this log; "" where it has one."""
    enabled = np.flatnonzero(_enabled(state))
    if len(enabled) < 2:
        cycles = counted(len(enabled), "cycle")
        return f"found {cycles} of joint {number} in 'operation enabled', expected at least 2"
    there = state[enabled[0] : enabled[-1] + 1]
    for name in _inputs_of(there):
        if not np.isfinite(there[name]).any():
            return f"j{number}.{name}: found no value in {counted(len(there), 'cycle')}, expected one in each"
    return ""


def _inputs_of(state: Records) -> tuple[str, ...]:
    """Return the names of the inputs that the joint's drive sends: with one encoder no link position."""
    return _INPUTS if np.isfinite(state[_LINK]).any() else tuple(name for name in _INPUTS if name != _LINK)


def _span(states: Mapping[int, Records], log: Path, *, last_motion: bool) -> slice:
    """Return the cycles from the first to the last in which all drives are enabled; stale ones in between are included."""
    rows = np.flatnonzero(np.logical_and.reduce([_enabled(state) for state in states.values()]))
    if last_motion and len(rows):
        off: Flags = np.logical_or.reduce(
            [_unpowered(state["statusword"]) & _fresh(state) for state in states.values()]
        )
        before = np.flatnonzero(off[: rows[-1]])
        rows = rows[rows > before[-1]] if len(before) else rows
    if len(rows) < 2:
        raise LogError(
            f"{log}: found {counted(len(rows), 'cycle')} of the motion with all drives (joints "
            f"{', '.join(map(str, states))}) in 'operation enabled', expected at least 2; each joint alone has more"
        )
    return slice(int(rows[0]), int(rows[-1]) + 1)


def _complete(number: int, state: Records, log: Path) -> Flags:
    """Return cycles [n] with all inputs of a joint; LogError for one that never came."""
    there = _fresh(state)
    for name in _inputs_of(state):
        finite = np.isfinite(state[name])
        if not finite.any():
            raise LogError(
                f"{log}: j{number}.{name}: found no value in {counted(len(state), 'cycle')}, expected one in each"
            )
        there = there & finite
    return there


def _with_sensor(states: Iterable[Records]) -> Flags | None:
    """Return cycles [n] in which every joint that has the sensor at all has it; None where none has."""
    flags = [np.isfinite(state["sensor_torque_nm"]) for state in states]
    have = [each for each in flags if each.any()]
    if not have:
        return None
    result: Flags = np.logical_and.reduce(have)
    return result


def _columns(state: Records, sensor: bool, temperature: FloatArray | None) -> JointColumns:
    def column(name: str) -> Any:
        return np.asarray(state[name], np.float64)

    torque = column("sensor_torque_nm") if sensor else None
    return JointColumns(
        **{name: column(name) for name in _inputs_of(state)},
        torque_nm=torque if torque is not None and np.isfinite(torque).all() else None,
        temperature_c=temperature,
        enabled=_powered(state["statusword"]),
    )


def _unpowered(statusword: NDArray[Any]) -> Flags:
    found: Flags = _NO_POWER[statusword & STATE_MASK]
    return found


def _powered(statusword: NDArray[Any]) -> FloatArray | None:
    """Return the column `enabled` [n]; None for a run in which the power was never off."""
    off = _unpowered(statusword)
    return np.where(off, 0.0, 1.0) if off.any() else None


def _temperature(readings: Readings, span: slice) -> FloatArray | None:
    """Return the temperature [n] over the cycles of `span` [degC], held between two TPDO3; None without any.

    Before the first frame of the span that frame's value holds: an earlier one was sent while the drive was off. Where the
    span has no frame, the last one before it counts.
    """
    rows, values = readings
    if not len(rows):
        return None
    cycles = np.arange(span.start, span.stop)
    last = np.searchsorted(rows, cycles, side="right") - 1
    first = min(int(np.searchsorted(rows, cycles[0])), int(last[-1]))
    return np.asarray(values[np.maximum(last, max(first, 0))], np.float64)


def read_log(path: Path, *parts: Path, joints: Sequence[int] | None = None) -> Content:
    """Read a log, or all parts of one run; the hash is that of all files one after another."""
    sha256 = file_bytes(path)[1]
    if parts:
        sha256 = hashlib.sha256(b"".join(file_bytes(each)[0] for each in (path, *parts))).hexdigest()
    try:
        logged = log_to_run((path, *parts) if parts else path, joints=joints)
    except LogError as error:
        text = str(error)
        raise RunError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from None
    notes = [f"{len(parts) + 1} parts of one run: {path.name} to {parts[-1].name}"] if parts else []
    notes += [f"joint {number} left out: {why}" for number, why in logged.left_out.items()]
    one = [n for n, columns in logged.table.joints.items() if columns.link_position_rad is None]
    if one:
        which = f"joint{'s' * (len(one) > 1)} {', '.join(map(str, one))}"
        notes.append(f"{which}: one encoder, no link position: nothing is known of the torsion of the gear")
    if logged.missed or logged.incomplete:
        by = ", ".join(f"{count} of {name}" for name, count in logged.incomplete_by.items() if count)
        notes.append(
            f"{counted(logged.missed, 'cycle')} missed and {logged.incomplete} incomplete{f' ({by})' if by else ''}: "
            f"{logged.lost_share:.2%} of the slots have no row"
        )
    values = {TIME: logged.table.time_s}
    for number, columns in logged.table.joints.items():
        for name in COLUMN_NAMES:
            column = getattr(columns, name)
            if column is not None:
                values[f"j{number}.{name}"] = column
    return Content(path, "mcap", sha256, values, notes=tuple(notes))
