"""The nodes of a configuration: joints with their files and networks, and the sensor. Read once into frozen objects.

Wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from estimator.checked import ConfigError, Section
from estimator.parameters import Joint
from models.files import read_yaml

MAX_NODE_ID = 127
_NEEDED = {"tob": (), "efficiency": ("efficiency",), "network": ("efficiency",), "fused": ("fused",)}
"""Sections of a joint file that a method cannot do without."""
_WITH_NETWORK = ("network", "fused")
"""Methods that use one; `fused` is its physics alone without."""


@dataclass(frozen=True)
class Identity:
    """Expected 1018h entries and software; None where the bench accepts any value."""

    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None
    software: str | None
    """100Ah, the software version."""


@dataclass(frozen=True)
class NetworkFile:
    """An ONNX file and the hash under which the configuration trusts it."""

    path: Path
    sha256: str
    data: bytes = field(default=b"", repr=False)
    """The file as it was read, for the log."""


@dataclass(frozen=True)
class JointConfig:
    """One joint: its drive, its parameters, its network and the sensor channel that serves as reference."""

    number: int
    node_id: int
    identity: Identity
    given: dict[str, int]
    """Objects that the drive lacks and the boot shall take as read, e.g. {"6091h:1": 100}."""
    joint_path: Path
    joint: Joint
    network: NetworkFile | None
    sensor_channel: int | None
    temperature: bool
    """The drive tells the joint's temperature (3001h by TPDO3)."""
    mandatory: bool
    """jtqd does not start without it."""
    joint_data: bytes = field(default=b"", repr=False)
    """The joint file as it was read, for the log."""


@dataclass(frozen=True)
class SensorConfig:
    """The optional torque sensor (CiA 404)."""

    node_id: int
    identity: Identity
    channels: tuple[int, ...]
    given: dict[str, int]
    unit_words: dict[str, float]
    """Values of 6131h that mean a torque, in Nm per unit, e.g. {"0x00560000": 1.0}: CiA 303-2 names none for Nm."""
    mandatory: bool
    """jtqd does not start without it. By default it does, and configures the sensor when it appears."""


def section_of(parent: Section, key: str) -> Section:
    """A section that may be left out: then every key takes its default (and a key without one says that it is missing)."""
    return parent.section(key, optional=True) or Section({}, parent.where, key)


def _numbers(parent: Section, key: str) -> dict[str, float]:
    """A mapping of free names to numbers; what the names may be is checked by the boot."""
    section = section_of(parent, key)
    values = {name: section.number(name, low=0.0) for name in section.names()}
    section.finish()
    return values


def _whole(values: dict[str, float]) -> dict[str, int]:
    return {name: int(value) for name, value in values.items()}


def _identity(parent: Section) -> Identity:
    section = section_of(parent, "identity")
    keys = ("vendor", "product", "revision", "serial")
    values = {key: section.integer(key, low=0, high=0xFFFF_FFFF, default=None) for key in keys}
    software = section.text("software", default=None)
    section.finish()
    return Identity(**values, software=software)


def read_sensor(top: Section) -> SensorConfig | None:
    """Section `sensor`; None without it. Raises ConfigError."""
    section = top.section("sensor", optional=True)
    if section is None:
        return None
    node = section.integer("node", low=1, high=MAX_NODE_ID)
    channels = section.integer("channels", low=1, high=2, default=1)
    identity = _identity(section)
    given = _numbers(section, "given")
    unit_words = _numbers(section, "unit_words")
    mandatory = section.boolean("mandatory", default=False)
    section.finish()
    channel_numbers = tuple(range(1, channels + 1))
    return SensorConfig(node, identity, channel_numbers, _whole(given), unit_words, mandatory)


def read_joint(
    top: Section, path: Path, number: int, method: str, sensor: SensorConfig | None
) -> JointConfig:
    """Section `joint_NUMBER` with its joint file and network, which lie beside the configuration. Raises ConfigError."""
    key = f"joint_{number}"
    section = top.section(key)
    assert section is not None
    node = section.integer("node", low=1, high=MAX_NODE_ID)
    identity = _identity(section)
    given = _whole(_numbers(section, "given"))
    joint_path = _beside(path, section.text("file"))
    channel = section.integer("sensor_channel", low=1, high=2, default=None)
    if channel is not None and (sensor is None or channel not in sensor.channels):
        expected = (
            f"one of the sensor's channels {list(sensor.channels)}"
            if sensor
            else "no channel without a sensor"
        )
        raise section.error("sensor_channel", channel, expected)
    temperature = section.boolean("temperature", default=False)
    mandatory = section.boolean("mandatory", default=True)
    network = _network(section.section("network", optional=True), path)
    section.finish()
    mapping, data = read_yaml(joint_path)
    joint = Joint.from_mapping(mapping, str(joint_path))
    if method == "network" and network is None:
        raise ConfigError(
            f"{path}: key '{key}.network': missing, expected file and sha256 because estimator.method is network"
        )
    for needed in _NEEDED[method]:
        if getattr(joint, needed) is None:
            raise ConfigError(
                f"{joint_path}: key '{needed}': missing, expected because estimator.method is {method}"
            )
    if method not in _WITH_NETWORK:
        network = None
    return JointConfig(
        number, node, identity, given, joint_path, joint, network, channel, temperature, mandatory, data
    )


def _network(section: Section | None, path: Path) -> NetworkFile | None:
    if section is None:
        return None
    file = _beside(path, section.text("file"))
    expected = section.text("sha256").lower()
    section.finish()
    try:
        data = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise ConfigError(f"{file}: sha256 of the network: found {found}, expected {expected} (from {path})")
    return NetworkFile(file, expected, data)


def _beside(path: Path, name: str) -> Path:
    """File names in a configuration are relative to the configuration itself."""
    return path.parent / name


def check_node_ids(
    path: Path, own: int, joints: tuple[JointConfig, ...], sensor: SensorConfig | None
) -> None:
    """Raises ConfigError when two nodes share a node-ID, or one has jtqd's own."""
    users: dict[int, str] = {own: "node_id"}
    named = [(f"joint_{joint.number}.node", joint.node_id) for joint in joints]
    if sensor is not None:
        named.append(("sensor.node", sensor.node_id))
    for key, node in named:
        if node in users:
            raise ConfigError(
                f"{path}: key '{key}': found {node}, expected a node-ID not used by {users[node]}"
            )
        users[node] = key
