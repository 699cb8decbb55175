"""What a replay takes from a log: configuration, joint files and scaling, inputs of each cycle, states of the estimators.

The attached files are written into a directory of the caller's, under names made here: nothing that a log contains can name
a place on this machine. Hashes are checked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from jtqd.daemon.config import Config, as_booted, load_config
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, input_pdos, joint_inputs, joint_temperatures
from jtqd.daemon.logs import LogError
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
    """Names of the attachments of one joint; network None: the method does not use it."""

    file: str
    file_sha256: str | None = None
    profile: str | None = None
    network: str | None = None


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
        return hashes

    def _write(self, name: str, file: str) -> str:
        data = self.content(name)
        (self._directory / file).write_bytes(data)
        return hashlib.sha256(data).hexdigest()


def _check_scaling(inputs: JointInputs) -> None:
    """ValueError unless all factors are numbers that are not 0 (the sensor's may be); a drive may count backwards."""
    for quantity, name in (
        ("motor_position", "motor_rad_per_count"),
        ("motor_velocity", "motor_rad_s_per_unit"),
        ("link_position", "link_rad_per_count"),
        ("current", "ampere_per_unit"),
    ):
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
    """Integers of a quantity of the drive."""
    if name == "motor_position":
        return _rolled(_whole(records["motor_position_rad"], each.motor_rad_per_count))
    if name == "link_position":
        return _rolled(_whole(records["link_position_rad"], each.link_rad_per_count))
    if name == "motor_velocity":
        return _whole(records["motor_velocity_rad_s"], each.motor_rad_s_per_unit)
    if name == "current":
        return _whole(records["current_a"], each.ampere_per_unit)
    return records["statusword"].astype(np.int64)


def _whole(values: FloatArray, unit: float) -> IntegerArray:
    """Counts of SI values; 0 for those that are not known."""
    with np.errstate(all="ignore"):
        counts = np.rint(values / unit)
    return np.where(np.isfinite(counts), counts, 0.0).astype(np.int64)


def _rolled(counts: IntegerArray) -> IntegerArray:
    """Convert to a 32-bit position with roll-over."""
    return (counts + _HALF) % _FULL - _HALF


def offsets(pdos: Sequence[Pdo], records: RecordArray, each: JointInputs, row: int) -> tuple[int, int]:
    """Whole ranges [counts] that motor and link position had rolled over by `row`: from the log."""
    found = []
    for quantity, name, unit in (
        ("motor_position", "motor_position_rad", each.motor_rad_per_count),
        ("link_position", "link_position_rad", each.link_rad_per_count),
    ):
        place = each.places.get(quantity)
        if place is None:
            found.append(0)
            continue
        column = pdos[place.pdo].values[place.entry]
        counts = int(_whole(records[name][row : row + 1], unit)[0])
        found.append(round((counts - int(column[row])) / _FULL) * _FULL)
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
