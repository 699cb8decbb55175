"""Runs of jtqd out of their logs: configuration and models, inputs and states cycle by cycle, where a state is known.

The attached files are written into a directory of the caller's, under names made here: nothing that a log contains can name
a place on this machine. Hashes are checked.

Two logs are parts of one run when their configuration, joint files and networks are the same and their cycles lie on one
grid: cycle numbers and the monotonic clock advance together. A long run comes in stretches, so that memory holds one of them
whatever the length of the log.

The time step that a joint used (`Steps`) is the time since its last inputs. A step of 0 is a start: from there on everything
about the joint is known. A step that is not the time since the last inputs *in the log* shows that inputs are missing from
the log: it begins in the middle of a run, or has lost cycles.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from jtqd.daemon.config import Config, as_booted, load_config
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, input_pdos, joint_inputs, joint_temperatures
from jtqd.daemon.logs import LogError, iter_messages, iter_topics, log_parts, read_attachments
from jtqd.daemon.recording.messages import CAN_FRAMES, JOINTS, SHADOWS, ZEROS
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_POSITION, FLAG_SENSOR, MOST_JOINTS
from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.estimator.arrays import BoolArray, FloatArray, IntegerArray, RecordArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.status import PAST_LAYOUT
from jtqd.models.files import load_yaml

# ---- fields of the messages that a replay reads: path -> type, each element's in an array ----

SAMPLE = np.dtype(
    [
        (name, "<f8" if code == "d" else "<u2")
        for name, code in zip(cr.JointRecord._fields, 16 * "d" + 4 * "H", strict=True)
    ]
)
"""What the loop records of a joint: the fields of `cycle_record.JointRecord`."""
SHADOW = np.dtype([(name, "<u2" if name.endswith("_status") else "<f8") for name in cr.SHADOW_FIELDS])
"""What it records of a joint's shadow methods; behind the fields of SAMPLE where there are any."""
ADDED = ("reference_nm", "age_ms", "torque_rate_nm_s", "contact_nm")
"""Of these, fields that older logs do not have; they follow from the others."""
STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
JOINT: dict[str, Any] = {
    "header.stamp": STAMP,
    "cycle": "<u8",
    "sync_monotonic_ns": "<i8",
    "sync_counter": "u1",
    "cycle_flags": "u1",
    **{name: SAMPLE[name] for name in SAMPLE.names or () if name not in ADDED},
}
"""Of /joint/N/state."""
FRAMES: dict[str, Any] = {
    "cycle": "<u8",
    "frame_count": "u1",
    "frames_left_out": "u1",
    "frames.id": "<u4",
    "frames.length": "u1",
    "frames.data": ("u1", 8),
}
"""Of /can/frames."""
_STATE_HEAD: dict[str, Any] = {"cycle": "<u8", "past_layout": "<u2", "past_bytes": "<u2"}
"""Of /joint/N/zeros."""
_STATE: dict[str, Any] = {"past": ("<u8", PAST_WORDS)}
"""The same, of this layout only: another one may have another length."""


def check_fields(records: npt.NDArray[np.void], needed: Mapping[str, Any], log: Path, topic: str) -> None:
    """Check the fields. Raises LogError for a missing field or another type."""
    for name, kind in needed.items():
        found: np.dtype[Any] = records.dtype
        for step in name.split("."):
            if step not in (found.base.names or ()):
                raise LogError(f"{log}: {topic}: found no field {name}, expected one as this jtqd writes it")
            found = found.base[step]
        if found != np.dtype(kind):
            raise LogError(f"{log}: {topic}: found {name} of type {found}, expected {np.dtype(kind)}")


# ---- configuration, joint files, networks ----

CONFIGURATION, PROVENANCE = "configuration.yaml", "provenance.json"


@dataclass(frozen=True)
class Setup:
    """Configuration, models and scaling of one log.

    Attributes:
        config: as it was in force; its paths lead into the private directory.
        inputs: indices of each joint's PDOs among `jtqd.daemon.core.input_pdos.input_pdos`, and the devices' scaling.
        hashes: of the configuration, then joint file and network of each joint.
    """

    config: Config
    inputs: tuple[JointInputs, ...]
    hashes: tuple[str, ...]


_T = TypeVar("_T")


class _Configuration(msgspec.Struct):
    sha256: str


class _JointFiles(msgspec.Struct):
    """Names of the attachments of one joint; network None: the method does not use it; shadow_networks: by method."""

    file: str
    file_sha256: str | None = None
    profile: str | None = None
    network: str | None = None
    shadow_networks: dict[str, str] = {}


class _Provenance(msgspec.Struct):
    """The keys of provenance.json that are read here; `nodes`: of the boot report."""

    configuration: _Configuration
    joints: dict[str, Any] = {}
    nodes: dict[str, Any] = {}


def read_setup(log: Path, attachments: Mapping[str, bytes], directory: Path) -> Setup:
    """Read the attachments of `log`; files go to `directory`, which must be empty and nobody else's.

    Raises:
        LogError: one line; something is missing, damaged, or does not have its hash.
    """
    attached = _Attachments(log, attachments, directory)
    text = attached.content(CONFIGURATION)
    provenance = attached.decoded(attached.content(PROVENANCE), _Provenance)
    sha256 = provenance.configuration.sha256
    attached.check(CONFIGURATION, sha256)
    original = directory / "as_logged.yaml"
    original.write_bytes(text)
    try:
        mapping = load_yaml(original)
        hashes = [sha256]
        for number in range(1, MOST_JOINTS + 1):
            section = mapping.get(f"joint_{number}")
            if isinstance(section, dict):  # anything else is load_config's to refuse
                found = provenance.joints.get(str(number), {})
                files = attached.decoded(found, _JointFiles, f"joints.{number}: ")
                hashes += attached.place(section, files, number)
        rewritten = directory / CONFIGURATION
        rewritten.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
        config = load_config(rewritten)
    except ConfigError as error:
        why = str(error).replace(f"{directory}/", "").replace(original.name, CONFIGURATION)
        raise LogError(f"{log}: its configuration: {why}") from None
    try:
        config = as_booted(config, provenance.nodes)
        inputs = tuple(joint_inputs(config, {"nodes": provenance.nodes}))
        for each in inputs:
            _check_scaling(each)
    except (KeyError, TypeError, ValueError) as error:
        why = str(error) or type(error).__name__
        raise LogError(f"{log}: {PROVENANCE}: nodes: no usable scaling ({why})") from None
    return Setup(config, inputs, tuple(hashes))


class _Attachments:
    """Attachments of a log, and the directory for those that must be files."""

    def __init__(self, log: Path, attachments: Mapping[str, bytes], directory: Path) -> None:
        self._log, self._found, self._directory = log, attachments, directory

    def content(self, name: str) -> bytes:
        """Return an attachment. Raises LogError."""
        if name not in self._found:
            raise LogError(
                f"{self._log}: found no attachment {name}, expected one: not a log of jtqd, or its beginning is missing"
            )
        return self._found[name]

    def decoded(self, content: Any, kind: type[_T], where: str = "") -> _T:
        """Return bytes of JSON, or an object out of it, as `kind`. Raises LogError."""
        try:
            if isinstance(content, bytes):
                return msgspec.json.decode(content, type=kind)
            return msgspec.convert(content, kind)
        except (msgspec.DecodeError, RecursionError) as error:
            raise LogError(f"{self._log}: {PROVENANCE}: {where}{error}") from None

    def check(self, name: str, expected: str) -> None:
        """Check a hash. Raises LogError."""
        found = hashlib.sha256(self.content(name)).hexdigest()
        if found != expected.lower():
            raise LogError(
                f"{self._log}: attachment {name}: found SHA-256 {found[:12]}..., "
                f"expected {expected[:12]}...: it was changed"
            )

    def place(self, section: dict[str, Any], files: _JointFiles, number: int) -> list[str]:
        """Write one joint's files and let its section of the configuration name them; returns their hashes."""
        if files.file_sha256 is not None:
            self.check(files.file, files.file_sha256)
        section["file"] = f"joint_{number}.yaml"
        hashes = [self._write(files.file, section["file"])]
        if files.profile is not None:  # as it was then, also where one of that name ships
            section["profile"] = f"joint_{number}.profile.yaml"
            self._write(files.profile, section["profile"])
        network = section.get("network")
        if isinstance(network, dict) and files.network is None:
            section.pop("network")
        elif isinstance(network, dict):
            network["file"] = (
                f"joint_{number}.onnx"  # its hash is in the configuration: load_config checks it
            )
            hashes.append(self._write(str(files.network), network["file"]))
        shadows: Any = section.get("shadow_networks")
        for n, method in enumerate([*shadows] if isinstance(shadows, dict) else ()):
            name, shadow = files.shadow_networks.get(method), shadows.pop(method)
            if name is not None and isinstance(shadow, dict):
                shadows[method] = {**shadow, "file": f"joint_{number}.shadow_{n}.onnx"}
                hashes.append(self._write(name, shadows[method]["file"]))
        return hashes

    def _write(self, name: str, file: str) -> str:
        data = self.content(name)
        (self._directory / file).write_bytes(data)
        return hashlib.sha256(data).hexdigest()


_QUANTITIES = {
    "motor_position": ("motor_position_rad", "motor_rad_per_count"),
    "motor_velocity": ("motor_velocity_rad_s", "motor_rad_s_per_unit"),
    "link_position": ("link_position_rad", "link_rad_per_count"),
    "current": ("current_a", "ampere_per_unit"),
}
"""Quantity of a drive -> its field in the log, and its factor in the scaling."""
_POSITIONS = ("motor_position", "link_position")


def _check_scaling(inputs: JointInputs) -> None:
    """ValueError unless all factors are numbers that are not 0 (the sensor's may be); a drive may count backwards."""
    for quantity, (_, name) in _QUANTITIES.items():
        factor = getattr(inputs, name)
        if quantity in inputs.places and (not isfinite(factor) or factor == 0.0):
            raise ValueError(f"{name} is {factor}: the drive was absent at the start of the log")
    if not inputs.sensor_nm_per_unit >= 0.0:
        raise ValueError("sensor_nm_per_unit is below 0")


# ---- inputs: raw frames as the integers of each cycle's input PDOs ----
#
# The frames of a record are in order of arrival, late ones of the cycle before first. Of an input that counted, the last
# frame with its identifier and length is therefore the one that was used (see `core.intake`); whether it counted is in the
# log's `input_flags`. Where a record had no room for all frames, the integers come from the SI values beside it.

_HALF, _FULL = 1 << 31, 1 << 32


@dataclass(frozen=True)
class Pdo:
    """One input PDO over n cycles: integers by the order of its mapping, and whether it counted."""

    values: tuple[IntegerArray, ...]
    fresh: BoolArray


@dataclass(frozen=True)
class Inputs:
    """Inputs of n cycles, and the estimate PDOs beside them.

    Attributes:
        pdos: in the order of `input_pdos`.
        temperatures: of each joint that has one: (cycle row, frame as `struct can_frame`) in order of arrival.
        estimate: estimate PDOs one after the other [n, 8 * PDOs]; recorded: they are in the record [n].
        from_si: inputs whose frame may not be in the record.
    """

    pdos: tuple[Pdo, ...]
    temperatures: tuple[tuple[tuple[int, bytes], ...], ...]
    estimate: npt.NDArray[np.uint8]
    recorded: BoolArray
    from_si: int


class _Table:
    """All frames of the records [n, capacity], those that are not there masked."""

    def __init__(self, records: RecordArray) -> None:
        frames = records["frames"]
        self.count, self.capacity = frames.shape
        there = np.arange(self.capacity) < records["frame_count"][:, None]
        self.ids = np.where(there, frames["id"], np.uint32(0xFFFF_FFFF))
        self.lengths, self.data = frames["length"], frames["data"]

    def last(self, cob_id: int, length: int) -> tuple[BoolArray, npt.NDArray[np.uint8]]:
        """Return whether a cycle has the frame [n], and the data of its last one [n, 8]."""
        match = (self.ids == cob_id) & (self.lengths == length)
        place = self.capacity - 1 - np.argmax(match[:, ::-1], axis=1)
        return match.any(axis=1), self.data[np.arange(self.count), place]

    def every(self, cob_id: int) -> tuple[tuple[int, bytes], ...]:
        """(row, frame) of each frame with this identifier, whatever its length."""
        rows, places = np.nonzero(self.ids == cob_id)
        return tuple(
            (row, cob_id.to_bytes(4, "little") + bytes((length, 0, 0, 0)) + data.tobytes())
            for row, length, data in zip(
                rows.tolist(), self.lengths[rows, places].tolist(), self.data[rows, places], strict=True
            )
        )


def decode(setup: Setup, records: RecordArray, joints: Sequence[RecordArray]) -> Inputs:
    """Return what the raw frames `records` (/can/frames) say, beside the joints' states of the same cycles."""
    table = _Table(records)
    left_out = records["frames_left_out"] > 0
    pdos, from_si = [], 0
    for index, pdo in enumerate(input_pdos(setup.config)):
        fresh = _fresh(index, setup.inputs, joints)
        there, data = table.last(pdo.cob_id, pdo.length)
        if pdo.age_ns:
            there, data = _held(there, left_out, data)
        values = [*_unpack(pdo, data)]
        absent = fresh & (~there | left_out)
        if absent.any():
            from_si += int(absent.sum())
            for entry, known in _counts(index, setup.inputs, joints).items():
                values[entry][absent] = known[absent]
        pdos.append(Pdo(tuple(values), fresh))
    pairs = [
        table.last(pdo.cob_id, pdo.length)
        for pdo in estimate_tpdos(len(setup.config.joints), setup.config.node_id)
    ]
    recorded: BoolArray = np.logical_and.reduce([there for there, _ in pairs])
    estimate = np.concatenate([data for _, data in pairs], axis=1)
    return Inputs(
        tuple(pdos),
        tuple(table.every(each.cob_id) for each in joint_temperatures(setup.config)),
        estimate,
        recorded,
        from_si,
    )


def _held(
    there: BoolArray, left_out: BoolArray, data: npt.NDArray[np.uint8]
) -> tuple[BoolArray, npt.NDArray[np.uint8]]:
    """Return whether the last frame up to each cycle is known [n], and its data: it counts until the next one."""
    last = np.maximum.accumulate(np.where(there | left_out, np.arange(len(there)), -1))
    known: BoolArray = (last >= 0) & ~left_out[last]
    return known, data[last]


def _fresh(index: int, inputs: Sequence[JointInputs], joints: Sequence[RecordArray]) -> BoolArray:
    """Return whether PDO `index` counted, by the flags of the joints that use it [n]."""
    fresh: BoolArray = np.zeros(len(joints[0]), np.bool_)
    for each, records in zip(inputs, joints, strict=True):
        for used, flag in (
            (each.positions, FLAG_POSITION),
            (each.motion, FLAG_MOTION),
            ({each.sensor}, FLAG_SENSOR),
        ):
            if index in used:
                fresh |= (records["input_flags"] & flag) != 0
    return fresh


def _unpack(pdo: InputPdo, data: npt.NDArray[np.uint8]) -> list[IntegerArray]:
    """Mapped integers of frames [n, 8], one array per object."""
    letters = pdo.layout.format.lstrip("<")
    layout = np.dtype([(f"f{n}", f"<{letter}") for n, letter in enumerate(letters)])
    rows = np.ascontiguousarray(data[:, : pdo.length]).view(layout)[:, 0]
    return [rows[name].astype(np.int64) for name in layout.names or ()]


def _counts(
    index: int, inputs: Sequence[JointInputs], joints: Sequence[RecordArray]
) -> dict[int, IntegerArray]:
    """Entries of PDO `index` by the SI values that the log has beside the frames; nobody reads the others."""
    found: dict[int, IntegerArray] = {}
    for each, records in zip(inputs, joints, strict=True):
        for name, place in each.places.items():
            if place.pdo == index:
                found[place.entry] = _counted(name, each, records)
        if index == each.sensor:
            found[0] = _whole(records["sensor_torque_nm"], each.sensor_nm_per_unit)
            found[1] = records["sensor_status"].astype(np.int64)
    return found


def _counted(name: str, each: JointInputs, records: RecordArray) -> IntegerArray:
    """Integers of a quantity of the drive; a position is 32 bits wide and rolls over."""
    if name not in _QUANTITIES:
        return records["statusword"].astype(np.int64)
    field, factor = _QUANTITIES[name]
    counts = _whole(records[field], getattr(each, factor))
    return (counts + _HALF) % _FULL - _HALF if name in _POSITIONS else counts


def _whole(values: FloatArray, unit: float) -> IntegerArray:
    """Counts of SI values; 0 for those that are not known."""
    with np.errstate(all="ignore"):
        counts = np.rint(values / unit)
    return np.where(np.isfinite(counts), counts, 0.0).astype(np.int64)


def offsets(pdos: Sequence[Pdo], records: RecordArray, each: JointInputs, row: int) -> tuple[int, int]:
    """Whole ranges [counts] that motor and link position had rolled over by `row`: from the log."""
    found = []
    for quantity in _POSITIONS:
        name, factor = _QUANTITIES[quantity]
        place, offset = each.places.get(quantity), 0
        if place is not None:
            counts = int(_whole(records[name][row : row + 1], getattr(each, factor))[0])
            offset = round((counts - int(pdos[place.pdo].values[place.entry][row])) / _FULL) * _FULL
        found.append(offset)
    return found[0], found[1]


# ---- states of the estimators ----


@dataclass(frozen=True)
class EstimatorStates:
    """States of one joint's estimator.

    Attributes:
        cycle: after which each holds [n].
        content: `FusedEstimator.past` of each [n].
    """

    cycle: npt.NDArray[np.uint64]
    content: tuple[bytes, ...]

    def rows(self, cycle: npt.NDArray[np.uint64]) -> dict[int, bytes]:
        """Return the states by the row of `cycle` [n] before which they hold: the one behind that of their cycle."""
        rows = np.searchsorted(cycle, self.cycle, side="right").tolist()
        return {
            row: content
            for row, after, content in zip(rows, self.cycle.tolist(), self.content, strict=True)
            if 0 < row < len(cycle) and int(cycle[row - 1]) == after
        }


NO_STATES = EstimatorStates(np.zeros(0, np.uint64), ())


def states_of(records: npt.NDArray[Any], log: Path, topic: str) -> EstimatorStates:
    """Return the states in the messages of /joint/N/zeros [n] that have this layout. Raises LogError."""
    check_fields(records, _STATE_HEAD, log, topic)
    records = records[records["past_layout"] == PAST_LAYOUT]
    if not len(records):
        return NO_STATES
    check_fields(records, _STATE, log, topic)
    sizes = records["past_bytes"].tolist()
    content = [each.tobytes()[:size] for each, size in zip(records["past"], sizes, strict=True)]
    return EstimatorStates(records["cycle"].astype(np.uint64), tuple(content))


# ---- where the state of an estimator is known ----

_BOTH = FLAG_POSITION | FLAG_MOTION
BEGINS, LOST = "the log begins in the middle of the run", "cycles are missing from the log"


@dataclass(frozen=True)
class Steps:
    """Time steps of one joint over n cycles.

    Attributes:
        used: cycles with both inputs [n].
        dt_ns: time since the last inputs, by the log [n]; 0: a start, or not used.
        begins: rows where it started.
        breaks: rows before which inputs are missing, with the reason.
    """

    used: npt.NDArray[np.bool_]
    dt_ns: npt.NDArray[np.int64]
    begins: npt.NDArray[np.intp]
    breaks: tuple[tuple[int, str], ...]

    def part(self, first: int, end: int) -> Steps:
        """Return the same of rows `first` to `end` only, counted from `first`."""
        begins = self.begins[(self.begins >= first) & (self.begins < end)] - first
        breaks = tuple((row - first, why) for row, why in self.breaks if first <= row < end)
        return Steps(self.used[first:end], self.dt_ns[first:end], begins, breaks)


def steps_of(records: RecordArray, config: Config) -> Steps:
    """Return the time steps of one joint's states (/joint/N/state), in the order of the cycles."""
    used = (records["input_flags"] & _BOTH) == _BOTH
    rows = np.flatnonzero(used)
    dt_ns = np.zeros(len(records), np.int64)
    dt = np.rint(records["dt_s"][rows] * 1e9)
    dt_ns[rows] = np.where(np.isfinite(dt), dt, 0.0).astype(np.int64)
    begins = rows[dt_ns[rows] == 0]
    if not len(rows):
        return Steps(used, dt_ns, begins, ())
    breaks: list[tuple[int, str]] = []
    if dt_ns[rows[0]] != 0:
        breaks.append((int(rows[0]), BEGINS))
        dt_ns[rows[0]] = 0
    # The call that sends a SYNC may be late, the other clock may be stepped: the step was measured by one of them.
    between = np.diff(records["sync_monotonic_ns"][rows])
    stamps = np.diff(stamps_ns(records)[rows])
    here = dt_ns[rows[1:]]
    apart = np.minimum(np.abs(between - here), np.abs(stamps - here)) > config.period_ns // 2
    holes = np.diff(np.cumsum(_holes(records, config))[rows]) > 0
    for at in np.flatnonzero((here != 0) & apart & holes).tolist():
        row = int(rows[at + 1])
        breaks.append((row, LOST))
        dt_ns[row] = max(int(between[at]), 0)
    return Steps(used, dt_ns, begins, tuple(breaks))


def stamps_ns(records: RecordArray) -> npt.NDArray[np.int64]:
    """Return the send time of each SYNC [ns], CLOCK_REALTIME [n]."""
    stamp = records["header"]["stamp"]
    seconds: npt.NDArray[np.int64] = stamp["sec"].astype(np.int64)
    return seconds * 1_000_000_000 + stamp["nanosec"].astype(np.int64)


def _holes(records: RecordArray, config: Config) -> npt.NDArray[np.int64]:
    """Cycles that are missing before each row [n].

    The cycle numbers count every slot, the SYNC counter only those with a SYNC, in rounds; the step `dt_s` of a row spans
    the slots without SYNC just before it. The missing cycles are as many as fit between both: exact while fewer slots than
    one round have passed without SYNC elsewhere in the hole. Where the step is not known (0), whole rounds do not show.
    """
    overflow = config.sequence_overflow
    counter: npt.NDArray[np.int64] = records["sync_counter"].astype(np.int64)
    cycle: npt.NDArray[np.int64] = records["cycle"].astype(np.int64)
    found = np.zeros(len(records), np.int64)
    slots = cycle[1:] - cycle[:-1]
    lost = np.remainder(counter[1:] - counter[:-1] - 1, overflow)
    step = np.rint(np.nan_to_num(records["dt_s"][1:]) * (1e9 / config.period_ns)).astype(np.int64)
    most = slots - np.maximum(step, 1)
    exact = most - np.remainder(most - lost, overflow)
    least = np.where(slots > overflow, np.maximum(lost, 1), np.minimum(lost, slots - 1))
    found[1:] = np.where((step > 0) & (exact >= 0), exact, least)
    return found


def lost_cycles(records: RecordArray, config: Config) -> int:
    """Return cycles that are missing between those in the log (joint states), by cycle number and SYNC counter."""
    return int(_holes(records, config).sum())


# ---- runs ----

STRETCH_CYCLES = 650_000
"""Longest stretch: one part of ten minutes at 1 kHz with something to spare."""
_KEPT_ROWS = 5_000
"""Of the stretch before: no time step depends on what was earlier."""
_FIRST_TOPIC = JOINTS[0].name
"""Of the joint that every log has."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much."""


@dataclass(frozen=True)
class Run:
    """States of one run, cycle by cycle; of a long run one stretch.

    Attributes:
        logs: all parts of the run, in their order.
        setup: of the first part; the others have the same.
        joints: states of each joint, of the same cycles.
        states: of each joint's estimator.
        number: the stretches of one run have the same.
        before: last states of the stretch before, none for the first one.
    """

    logs: tuple[Path, ...]
    setup: Setup
    joints: tuple[RecordArray, ...]
    states: tuple[EstimatorStates, ...]
    number: int = 0
    before: tuple[RecordArray, ...] | None = None

    @property
    def cycles(self) -> int:
        """Return the number of cycles."""
        return len(self.joints[0])

    def steps(self) -> tuple[Steps, ...]:
        """Return the time steps of all joints; the first ones follow from the stretch before."""
        config = self.setup.config
        if self.before is None:
            return tuple(steps_of(each, config) for each in self.joints)
        kept = len(self.before[0])
        every = [np.concatenate(each) for each in zip(self.before, self.joints, strict=True)]
        return tuple(steps_of(each, config).part(kept, len(each)) for each in every)


def read_runs(
    paths: Sequence[Path],
    directory: Path,
    progress: Progress = lambda *_: None,
    stretch: int = STRETCH_CYCLES,
) -> Iterator[tuple[Run, Inputs]]:
    """Yield the runs of the logs, in stretches of about `stretch` cycles, each with the inputs of its cycles.

    A directory stands for the logs in it. The files that the logs have attached go to `directory`, which must be empty and
    nobody else's. Cycles that two parts of a run have, after a crash of the recorder, are taken once.

    Raises:
        LogError: one line; a log cannot be used, is given twice, or differs from another one in a cycle.
        OSError: a file cannot be read.
    """
    logs = [log for path in paths for log in log_parts(path)]
    for number, (setup, parts) in enumerate(_runs(logs, directory, progress)):
        before = None
        for joints, inputs, states in _stretches(setup, parts, stretch):
            run = Run(tuple(parts), setup, joints, states, number, before)
            before = tuple(each[-_KEPT_ROWS:].copy() for each in joints)
            del joints  # most of the memory
            yield run, inputs
            del run, inputs


def _runs(logs: Sequence[Path], directory: Path, progress: Progress) -> list[tuple[Setup, list[Path]]]:
    """Return setup and parts of each run, in the order of their first cycles."""
    found: list[tuple[Setup, list[Path], int]] = []
    starts = [_start(log) if len(logs) > 1 else (0, 0) for log in logs]
    ordered = sorted(zip(starts, logs, strict=True), key=lambda each: each[0])
    for n, ((first_ns, cycle), log) in enumerate(ordered):
        if logs.count(log) > 1:
            raise LogError(f"{log}: found the log given twice, expected once")
        progress("reading", n, len(logs))
        place = directory / str(n)
        place.mkdir(mode=0o700)
        setup = read_setup(log, read_attachments(log), place)
        begin_ns = first_ns - cycle * setup.config.period_ns
        for other, parts, other_ns in found:
            same = other.hashes == setup.hashes and other.inputs == setup.inputs
            if same and abs(begin_ns - other_ns) <= setup.config.period_ns:
                parts.append(log)
                break
        else:
            found.append((setup, [log], begin_ns))
    return [(setup, parts) for setup, parts, _ in found]


def _start(log: Path) -> tuple[int, int]:
    """Return CLOCK_MONOTONIC [ns] and number of the first cycle of a log; 0, 0 for one without: reading it is an error."""
    for messages in iter_messages(log, _FIRST_TOPIC):
        check_fields(messages.records, JOINT, log, _FIRST_TOPIC)
        first = messages.records[0]
        return int(first["sync_monotonic_ns"]), int(first["cycle"])
    return 0, 0


def _stretches(
    setup: Setup, logs: Sequence[Path], least: int
) -> Iterator[tuple[tuple[RecordArray, ...], Inputs, tuple[EstimatorStates, ...]]]:
    """Yield joints, inputs and states of the estimators of a run, stretch by stretch. Raises LogError, OSError."""
    count = len(setup.config.joints)
    joints, zeros = [each.name for each in JOINTS[:count]], [each.name for each in ZEROS[:count]]
    shadows = [each.name for each in SHADOWS[:count]] if setup.config.shadow else []
    of_shadow = {"cycle": "<u8", **{name: SHADOW[name] for name in SHADOW.names or ()}}
    needed = {**dict.fromkeys(joints, JOINT), CAN_FRAMES.name: FRAMES}
    needed |= dict.fromkeys(shadows, of_shadow)
    pending: dict[str, list[RecordArray]] = {}
    last, made = -1, False
    spans = iter_topics(logs, [*needed, *zeros], least=least)
    while (found := next(spans, None)) is not None:
        for topic, kinds in needed.items():
            if topic in found:
                check_fields(found[topic].records, kinds, logs[0], topic)
                pending.setdefault(topic, []).append(found[topic].records)
        states = tuple(
            states_of(found[topic].records, logs[0], topic) if topic in found else NO_STATES
            for topic in zeros
        )
        del found  # most of the memory, as below
        if len(pending) < len(needed):
            continue
        last, tables = _complete(pending, last, logs[0])
        every = _common([tables[topic] for topic in (*joints, *shadows)])
        whole = tuple(map(_with_shadow, every, every[count:])) if shadows else every
        del every
        frames = _of_cycles(tables.pop(CAN_FRAMES.name), whole[0]["cycle"], logs[0])
        inputs = decode(setup, frames, whole)
        del tables, frames
        if len(whole[0]):
            made = True
            yield whole, inputs, states
        del whole, inputs
    missing = [topic for topic in needed if topic not in pending]
    if not made and missing:
        raise LogError(f"{logs[0]}: found no message on {missing[0]}, expected one per cycle")
    if not made:
        raise LogError(f"{logs[0]}: found no cycle with every joint, expected one at least")
    if missing == [CAN_FRAMES.name]:
        cycle = int(pending[joints[0]][0]["cycle"][0])
        raise LogError(f"{logs[-1]}: {CAN_FRAMES.name}: found none from cycle {cycle} on, expected all")


def _complete(
    pending: dict[str, list[RecordArray]], last: int, log: Path
) -> tuple[int, dict[str, RecordArray]]:
    """Take out of `pending` what follows cycle `last`, up to the last cycle of all topics; returns it and that cycle.

    A chunk may end within a cycle: what other topics have of it is in the next one, and the rest stays pending.
    """
    tables = {topic: each[0] if len(each) == 1 else np.concatenate(each) for topic, each in pending.items()}
    end = min(int(records["cycle"][-1]) for records in tables.values())
    pending.clear()
    for topic, records in tables.items():
        cycle = records["cycle"].astype(np.int64)
        wrong = np.flatnonzero(np.diff(cycle, prepend=last) <= 0)
        if len(wrong):
            raise LogError(
                f"{log}: {topic}: found cycle {cycle[wrong[0]]} after a later one or a second time, expected "
                "increasing cycles: is a log given twice, or do two differ?"
            )
        count = int(np.searchsorted(cycle, end, side="right"))
        tables[topic] = records[:count]
        if count < len(records):
            pending[topic] = [records[count:].copy()]
    return end, tables


def _common(joints: Sequence[RecordArray]) -> tuple[RecordArray, ...]:
    """Return the states of the cycles that every joint has."""
    first = joints[0]["cycle"]
    if all(np.array_equal(each["cycle"], first) for each in joints):
        return tuple(joints)
    shared = reduce(np.intersect1d, [each["cycle"] for each in joints])
    return tuple(each[np.isin(each["cycle"], shared)] for each in joints)


def _with_shadow(joint: RecordArray, shadow: RecordArray) -> RecordArray:
    """Return the states of a joint with the fields of its shadow methods of the same cycles behind."""
    kind = [(name, joint.dtype[name]) for name in joint.dtype.names or ()]
    out = np.empty(len(joint), [*kind, *SHADOW.descr])
    for source, names in ((joint, joint.dtype.names), (shadow, SHADOW.names)):
        for name in names or ():
            out[name] = source[name]
    return out


def _of_cycles(frames: RecordArray, cycles: npt.NDArray[np.uint64], log: Path) -> RecordArray:
    """Return the messages of /can/frames of these cycles. Raises LogError where one has none."""
    if not np.array_equal(frames["cycle"], cycles):
        frames = frames[np.isin(frames["cycle"], cycles)]
    if len(frames) != len(cycles):
        raise LogError(
            f"{log}: {CAN_FRAMES.name}: found {len(frames)} of the {len(cycles)} cycles, expected all"
        )
    return frames
