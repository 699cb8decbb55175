"""Configuration of jtqd: read once into frozen, validated objects.

Unknown keys and wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from estimator.checked import ConfigError, Section
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings
from models.files import load_joint, load_yaml, shipped

DEFAULT_CONFIG = "bench.yaml"
_MAX_NODE_ID = 127
_NEEDED = {"tob": (), "efficiency": ("efficiency",), "network": ("efficiency",), "fused": ("fused",)}
"""Sections of a joint file that a method cannot do without."""
_WITH_NETWORK = ("network", "fused")
"""Methods that use one; `fused` is its physics alone without."""


@dataclass(frozen=True)
class Identity:
    """Expected 1018h entries; None where the bench accepts any value."""

    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None


@dataclass(frozen=True)
class NetworkFile:
    """An ONNX file and the hash under which the configuration trusts it."""

    path: Path
    sha256: str


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


@dataclass(frozen=True)
class SensorConfig:
    """The optional torque sensor (CiA 404)."""

    node_id: int
    identity: Identity
    channels: tuple[int, ...]
    given: dict[str, int]
    unit_words: dict[str, float]
    """Values of 6131h that mean a torque, in Nm per unit, e.g. {"0x00560000": 1.0}: CiA 303-2 names none for Nm."""


@dataclass(frozen=True)
class Realtime:
    """What the loop asks of the kernel; what it does not get it says."""

    priority: int
    cpu: int | None
    lock_memory: bool


@dataclass(frozen=True)
class Config:
    """Everything jtqd was told. `text` is the YAML as read, for the log; `sha256` its hash."""

    path: Path
    text: str
    sha256: str
    node_id: int
    bitrate: int
    period_ns: int
    counter_overflow: int
    input_wait_ns: int
    input_deadline_ns: int
    heartbeat_ms: int
    boot_timeout_s: float
    estimator: EstimatorSettings
    joints: tuple[JointConfig, ...]
    sensor: SensorConfig | None
    realtime: Realtime
    ring_cycles: int


def load_config(path: Path | None) -> Config:
    """Read and check a configuration; None is the shipped bench configuration.

    Raises:
        ConfigError: one line naming file, key, what was found and what was expected.
    """
    if path is None:
        path = shipped(DEFAULT_CONFIG)
    mapping, sha256 = load_yaml(path)
    top = Section(mapping, str(path))
    node_id = top.integer("node_id", low=1, high=_MAX_NODE_ID)
    bitrate = top.integer("bitrate", low=10_000, high=1_000_000, default=1_000_000)
    sync = _section(top, "sync")
    period_us = sync.integer("period_us", low=500, high=100_000, default=1000)
    overflow = sync.integer("counter_overflow", low=2, high=240, default=240)  # 1019h: 1 is reserved
    sync.finish()
    inputs = _section(top, "inputs")
    wait_us = inputs.number("wait_us", unit="us", low=50, high=period_us, default=0.5 * period_us)
    deadline_us = inputs.number(
        "deadline_us", unit="us", low=wait_us, high=0.95 * period_us, default=0.85 * period_us
    )
    inputs.finish()
    nodes = _section(top, "nodes")
    heartbeat_ms = nodes.integer("heartbeat_ms", low=10, high=10_000, default=100)
    boot_timeout_s = nodes.number("boot_timeout_s", unit="s", low=0.1, high=60, default=2.0)
    nodes.finish()
    settings = EstimatorSettings.from_section(_section(top, "estimator"))
    sensor = _sensor(top)
    joints = tuple(_joint(top, path, number, settings.method, sensor) for number in (1, 2))
    realtime = _realtime(top)
    recording = top.section("recording", optional=True)
    ring_cycles = 4096
    if recording is not None:
        ring_cycles = recording.integer("ring_cycles", low=256, high=1 << 20, default=4096)
        recording.finish()
    top.finish()
    _check_node_ids(path, node_id, joints, sensor)
    return Config(
        path=path,
        text=path.read_text(encoding="utf-8"),
        sha256=sha256,
        node_id=node_id,
        bitrate=bitrate,
        period_ns=period_us * 1000,
        counter_overflow=overflow,
        input_wait_ns=round(wait_us * 1000),
        input_deadline_ns=round(deadline_us * 1000),
        heartbeat_ms=heartbeat_ms,
        boot_timeout_s=boot_timeout_s,
        estimator=settings,
        joints=joints,
        sensor=sensor,
        realtime=realtime,
        ring_cycles=ring_cycles,
    )


def _section(parent: Section, key: str) -> Section:
    """A section that may be left out: then every key takes its default (and a key without one says that it is missing)."""
    return parent.section(key, optional=True) or Section({}, parent.where, key)


def _numbers(parent: Section, key: str) -> dict[str, float]:
    """A mapping of free names to numbers; what the names may be is checked by the boot."""
    section = _section(parent, key)
    values = {name: section.number(name, low=0.0) for name in section.names()}
    section.finish()
    return values


def _whole(values: dict[str, float]) -> dict[str, int]:
    return {name: int(value) for name, value in values.items()}


def _identity(parent: Section) -> Identity:
    section = _section(parent, "identity")
    keys = ("vendor", "product", "revision", "serial")
    values = {key: section.integer(key, low=0, high=0xFFFF_FFFF, default=None) for key in keys}
    section.finish()
    return Identity(**values)


def _sensor(top: Section) -> SensorConfig | None:
    section = top.section("sensor", optional=True)
    if section is None:
        return None
    node = section.integer("node", low=1, high=_MAX_NODE_ID)
    channels = section.integer("channels", low=1, high=2, default=1)
    identity = _identity(section)
    given = _numbers(section, "given")
    unit_words = _numbers(section, "unit_words")
    section.finish()
    return SensorConfig(node, identity, tuple(range(1, channels + 1)), _whole(given), unit_words)


def _joint(top: Section, path: Path, number: int, method: str, sensor: SensorConfig | None) -> JointConfig:
    key = f"joint_{number}"
    section = top.section(key)
    assert section is not None
    node = section.integer("node", low=1, high=_MAX_NODE_ID)
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
    network = _network(section.section("network", optional=True), path)
    section.finish()
    joint = load_joint(joint_path)
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
    return JointConfig(number, node, identity, given, joint_path, joint, network, channel, temperature)


def _network(section: Section | None, path: Path) -> NetworkFile | None:
    if section is None:
        return None
    file = _beside(path, section.text("file"))
    expected = section.text("sha256").lower()
    section.finish()
    try:
        found = hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from None
    if found != expected:
        raise ConfigError(f"{file}: sha256 of the network: found {found}, expected {expected} (from {path})")
    return NetworkFile(file, expected)


def _realtime(top: Section) -> Realtime:
    section = _section(top, "realtime")
    priority = section.integer("priority", low=0, high=98, default=80)
    cpu = section.integer("cpu", low=0, high=4095, default=None)
    lock = section.boolean("lock_memory", default=True)
    section.finish()
    return Realtime(priority, cpu, lock)


def _beside(path: Path, name: str) -> Path:
    """File names in a configuration are relative to the configuration itself."""
    return path.parent / name


def _check_node_ids(
    path: Path, own: int, joints: tuple[JointConfig, ...], sensor: SensorConfig | None
) -> None:
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
