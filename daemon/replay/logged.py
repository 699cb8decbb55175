"""What a replay takes from a log beside its messages: configuration, models, scaling, and states of the estimators.

The attached files are written into a directory of the caller's, under names made here: nothing that a log contains can name
a place on this machine. Hashes are checked.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from jtqd.daemon.config import Config, as_booted, load_config
from jtqd.daemon.core.input_pdos import JointInputs, joint_inputs
from jtqd.daemon.logs import LogError, LogFile, iter_messages
from jtqd.daemon.recording.schemas import ZEROS
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import MOST_JOINTS
from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.status import PAST_LAYOUT
from jtqd.models.files import load_yaml

# ---- names and types that a replay needs of a log's messages; another version may have others ----

SAMPLE = np.dtype(
    [
        (name, "<f8" if code == "d" else "<u2")
        for name, code in zip(cr.JointRecord._fields, 16 * "d" + 4 * "H", strict=True)
    ]
)
"""What the loop records of a joint: the fields of `cycle_record.JointRecord`."""

ADDED = ("reference_nm", "age_ms", "torque_rate_nm_s", "contact_nm")
"""Fields that logs of before do not have; a replay makes them anew."""

STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
JOINT: dict[str, np.dtype[Any]] = {
    "header.stamp": STAMP,
    "cycle": np.dtype("<u8"),
    "sync_monotonic_ns": np.dtype("<i8"),
    "sync_counter": np.dtype("u1"),
    "cycle_flags": np.dtype("u1"),
    **{name: SAMPLE[name] for name in SAMPLE.names or () if name not in ADDED},
}
"""Of /joint/N/state: path -> type."""
FRAMES: dict[str, np.dtype[Any]] = {
    "cycle": np.dtype("<u8"),
    "frame_count": np.dtype("u1"),
    "frames_left_out": np.dtype("u1"),
    "frames.id": np.dtype("<u4"),
    "frames.length": np.dtype("u1"),
    "frames.data": np.dtype(("u1", 8)),
}
"""Of /can/frames: path -> type of each element."""
PAST: dict[str, np.dtype[Any]] = {
    "cycle": np.dtype("<u8"),
    "past_layout": np.dtype("<u2"),
    "past_bytes": np.dtype("<u2"),
}
"""Of /joint/N/zeros: path -> type of each element."""
STATE: dict[str, np.dtype[Any]] = {"past": np.dtype(("<u8", PAST_WORDS))}
"""The same, of this layout: another one may have another length."""


def check_fields(
    records: npt.NDArray[np.void], needed: Mapping[str, np.dtype[Any]], path: Path, topic: str
) -> None:
    """Check the fields. Raises LogError for a missing field or another type."""
    for name, expected in needed.items():
        found: np.dtype[Any] = records.dtype
        for step in name.split("."):
            if step not in (found.base.names or ()):
                raise LogError(f"{path}: {topic}: found no field {name}, expected one as this jtqd writes it")
            found = found.base[step]
        if found != expected:
            raise LogError(f"{path}: {topic}: found {name} of type {found}, expected {expected}")


CONFIGURATION, PROVENANCE = "configuration.yaml", "provenance.json"


@dataclass(frozen=True)
class Setup:
    """Configuration, models and scaling of one log.

    Attributes:
        config: as it was in force; its paths lead into the private directory.
        inputs: indices of each joint's PDOs among `jtqd.daemon.core.input_pdos.input_pdos`, and the devices' scaling.
        hashes: of the configuration, then joint file and network of each joint.
        versions: of the programs that made the log, e.g. {"numpy": "2.4.6"}.
        machine: kind of processor, e.g. "x86_64"; empty where the log does not say.
    """

    config: Config
    inputs: tuple[JointInputs, ...]
    hashes: tuple[str, ...]
    versions: Mapping[str, str]
    machine: str


def read_setup(log: Path, attachments: Mapping[str, bytes], directory: Path) -> Setup:
    """Read the attachments of `log`; files go to `directory`, which must be empty and nobody else's.

    Raises:
        LogError: one line; something is missing, damaged, or not what its hash says.
    """
    text = _attachment(log, attachments, CONFIGURATION)
    provenance = _provenance(log, _attachment(log, attachments, PROVENANCE))
    sha256 = _text(log, provenance, "configuration", "sha256")
    _check_hash(log, CONFIGURATION, text, sha256)
    original = directory / "as_logged.yaml"
    original.write_bytes(text)
    try:
        mapping = load_yaml(original)
        files = [
            each
            for number in range(1, MOST_JOINTS + 1)
            if number == 1 or f"joint_{number}" in mapping
            for each in _place(log, attachments, provenance, mapping, number, directory)
        ]
        rewritten = directory / CONFIGURATION
        rewritten.write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
        config = load_config(rewritten)
    except ConfigError as error:
        raise LogError(f"{log}: its configuration: {_without(str(error), directory)}") from None
    try:
        config = as_booted(config, provenance["nodes"])
        inputs = tuple(joint_inputs(config, provenance))
        for each in inputs:
            _check_scaling(each)
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(
            f"{log}: {PROVENANCE}: nodes: no usable scaling ({str(error) or type(error).__name__})"
        ) from None
    versions = provenance.get("versions")
    return Setup(
        config,
        inputs,
        (sha256, *files),
        {str(k): str(v) for k, v in versions.items()} if isinstance(versions, dict) else {},
        str(provenance.get("machine", "")),
    )


def _without(text: str, directory: Path) -> str:
    """Return the message without the private directory, which is gone when somebody reads it."""
    return text.replace(f"{directory}/", "").replace("as_logged.yaml", CONFIGURATION)


def _attachment(log: Path, attachments: Mapping[str, bytes], name: str) -> bytes:
    if name not in attachments:
        raise LogError(
            f"{log}: found no attachment {name}, expected one: not a log of jtqd, or its beginning is missing"
        )
    return attachments[name]


def _provenance(log: Path, data: bytes) -> dict[str, Any]:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        raise LogError(f"{log}: {PROVENANCE}: found no JSON") from None
    if not isinstance(content, dict):
        raise LogError(f"{log}: {PROVENANCE}: found {type(content).__name__}, expected an object")
    return content


def _text(log: Path, content: Any, *keys: str) -> str:
    """Return a text of the provenance by its path of keys."""
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    if not isinstance(content, str):
        raise LogError(f"{log}: {PROVENANCE}: {'.'.join(keys)}: missing")
    return content


def _check_hash(log: Path, name: str, data: bytes, expected: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != expected.lower():
        raise LogError(
            f"{log}: attachment {name}: found SHA-256 {found[:12]}..., expected {expected[:12]}...: it was changed"
        )


def _place(  # noqa: PLR0917
    log: Path,
    attachments: Mapping[str, bytes],
    provenance: dict[str, Any],
    mapping: dict[str, Any],
    number: int,
    directory: Path,
) -> list[str]:
    """Write one joint's files and let the configuration name them; returns their hashes.

    A wrong configuration is load_config's to refuse.
    """
    key = f"joint_{number}"
    section = mapping.get(key)
    if not isinstance(section, dict):
        return []
    name = _text(log, provenance, "joints", str(number), "file")
    data = _attachment(log, attachments, name)
    said = provenance["joints"][str(number)].get("file_sha256")
    if isinstance(said, str):
        _check_hash(log, name, data, said)
    file = f"{key}.yaml"
    (directory / file).write_bytes(data)
    section["file"] = file
    hashes = [hashlib.sha256(data).hexdigest()]
    profile = provenance["joints"][str(number)].get("profile")
    if isinstance(profile, str):  # as it was then, also where one of that name ships
        section["profile"] = f"{key}.profile.yaml"
        (directory / section["profile"]).write_bytes(_attachment(log, attachments, profile))
    network = section.get("network")
    if not isinstance(network, dict):
        return hashes
    name = provenance["joints"][str(number)].get("network")
    if name is None:  # the method has no use for it: it was not read
        section.pop("network")
        return hashes
    data = _attachment(log, attachments, str(name))
    (directory / f"{key}.onnx").write_bytes(data)
    network["file"] = f"{key}.onnx"  # its hash is in the configuration, and load_config checks it
    return [*hashes, hashlib.sha256(data).hexdigest()]


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


# ---- states of the estimators ----


@dataclass(frozen=True)
class EstimatorStates:
    """States of one joint's estimator.

    Attributes:
        cycle: after which each holds, increasing [n].
        content: `FusedEstimator.past` of each [n].
    """

    cycle: npt.NDArray[np.uint64]
    content: tuple[bytes, ...]

    def within(self, first: int, last: int) -> EstimatorStates:
        """Return those of the cycles `first` to `last`."""
        here = (self.cycle >= first) & (self.cycle <= last)
        return EstimatorStates(self.cycle[here], tuple(self.content[n] for n in np.flatnonzero(here)))

    def rows(self, cycle: npt.NDArray[np.uint64]) -> dict[int, bytes]:
        """Return the states by the row of `cycle` [n] before which they hold: the one behind that of their cycle."""
        rows = np.searchsorted(cycle, self.cycle, side="right").tolist()
        return {
            row: content
            for row, after, content in zip(rows, self.cycle.tolist(), self.content, strict=True)
            if 0 < row < len(cycle) and int(cycle[row - 1]) == after
        }


NO_STATES = EstimatorStates(np.zeros(0, np.uint64), ())


def joined(every: Sequence[EstimatorStates]) -> EstimatorStates:
    """Return the states of several parts in the order of their cycles, each once."""
    cycle, first = np.unique(np.concatenate([each.cycle for each in every]), return_index=True)
    content = [state for each in every for state in each.content]
    return EstimatorStates(cycle, tuple(content[n] for n in first.tolist()))


def read_states(path: Path, joints: int) -> tuple[EstimatorStates, ...]:
    """Return the states of each joint in a log. Raises LogError, OSError."""
    with LogFile(path) as log:
        there = {each.topic for n, each in log.channels.items() if not log.counts or log.counts.get(n)}
    return tuple(_read(path, each.name) if each.name in there else NO_STATES for each in ZEROS[:joints])


def _read(path: Path, topic: str) -> EstimatorStates:
    cycles: list[int] = []
    content: list[bytes] = []
    for messages in iter_messages(path, topic):
        records = messages.records
        check_fields(records, PAST, path, topic)
        records = records[records["past_layout"] == PAST_LAYOUT]
        if len(records):
            check_fields(records, STATE, path, topic)
        for record in records:
            cycles.append(int(record["cycle"]))
            content.append(record["past"].tobytes()[: int(record["past_bytes"])])
    order = np.argsort(np.array(cycles, np.uint64), kind="stable").tolist()
    return EstimatorStates(np.array([cycles[n] for n in order], np.uint64), tuple(content[n] for n in order))
