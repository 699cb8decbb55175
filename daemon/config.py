"""Configuration of jtqd: read once into frozen, validated objects.

Unknown keys and wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.shared import cycle_record as faults
from jtqd.estimator.checked import ConfigError, Section
from jtqd.estimator.joint import Joint
from jtqd.estimator.plausibility import PlausibilityLimits
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import read_yaml, shipped

# Section `safety` of the configuration: which faults are latched, and the thresholds of the checks.


LATCHED_BY_DEFAULT: Final = faults.NOT_FINITE | faults.BITS["motor_jump"] | faults.BITS["link_jump"]
"""What leaves numbers behind that look right and are not: a broken estimator, an encoder that has lost its zero."""
_LIMITS: Final = PlausibilityLimits()


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """How faults are found and which of them wait for a reset.

    latch: bits of `shared/cycle_record.py`; stale_latch_cycles: so many cycles in a row without inputs, or without time,
    are the fault `stale` (None: never); deviation_sigmas, deviation_s: the fault `deviation`; plausibility: None for no
    checks.
    """

    latch: int = LATCHED_BY_DEFAULT
    stale_latch_cycles: int | None = None
    deviation_sigmas: float = 3.0
    deviation_s: float = 1.0
    plausibility: PlausibilityLimits | None = _LIMITS

    @classmethod
    def from_section(cls, section: Section | None) -> SafetySettings:
        """Read the mapping of a configuration file; every key is optional. Raises ConfigError."""
        if section is None:
            return cls()
        latch = _latch(section)
        stale = section.raw("stale_latch_cycles", None)
        if stale is not None:
            stale = section.integer("stale_latch_cycles", low=1, high=1_000_000)
            latch |= faults.STALE
        sigmas = section.number("deviation_sigmas", low=1.0, high=100.0, default=3.0)
        seconds = section.number("deviation_s", unit="s", low=0.01, high=60.0, default=1.0)
        limits: PlausibilityLimits | None = _LIMITS
        if section.raw("plausibility", None) is False:
            limits = None
        else:
            inner = section.section("plausibility", optional=True)
            limits = limits if inner is None else PlausibilityLimits.from_section(inner)
        section.finish()
        return cls(latch, stale, sigmas, seconds, limits)


def _latch(section: Section) -> int:
    names = [name for name in faults.BITS if name != "stale"]
    value: Any = section.raw("latch", None)
    if value is None:
        return LATCHED_BY_DEFAULT
    if not isinstance(value, list) or not all(isinstance(name, str) and name in names for name in value):
        raise section.error("latch", value, f"a list of {', '.join(names)}; [] for none")
    return sum({faults.BITS[name] for name in value})


# Section `recording` of the configuration: how long files are, how much disk they may take, or the flight recorder.


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


# The nodes of a configuration: joints with their files and networks, and the sensor. Read once into frozen objects.
#
# Wrong values are errors of one line that name the file, the key, what was found and what was expected.


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


DEFAULT_CONFIG = "bench.yaml"
_ERROR_BEHAVIOURS = ("pre_operational", "none", "stopped")
"""1029h:1 in the order of its values."""


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
    heartbeat_timeout_ms: int
    """A node that was not heard for so long is lost (1016h of jtqd)."""
    error_behaviour: int
    """1029h:1 of every node that has it: 0 pre-operational, 1 no change, 2 stopped."""
    emcy_inhibit_ms: int
    """Time between two EMCY of jtqd (1015h)."""
    boot_timeout_s: float
    estimator: EstimatorSettings
    safety: SafetySettings
    joints: tuple[JointConfig, ...]
    sensor: SensorConfig | None
    realtime: Realtime
    recording: RecordingSettings
    metrics_file: Path | None = None
    """Prometheus text file, written every 5 s; None for none."""

    @property
    def files_sha256(self) -> str:
        """Hash of the configuration and its joint files together; networks are named in it by theirs."""
        parts = [self.sha256, *(hashlib.sha256(joint.joint_data).hexdigest() for joint in self.joints)]
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    @property
    def ring_cycles(self) -> int:
        """Cycles that the ring in shared memory holds."""
        return self.recording.ring_cycles


def load_config(path: Path | None) -> Config:
    """Read and check a configuration; None is the shipped bench configuration.

    Raises:
        ConfigError: one line naming file, key, what was found and what was expected.
    """
    if path is None:
        path = shipped(DEFAULT_CONFIG)
    mapping, data = read_yaml(path)
    top = Section(mapping, str(path))
    node_id = top.integer("node_id", low=1, high=MAX_NODE_ID)
    bitrate = top.integer("bitrate", low=10_000, high=1_000_000, default=1_000_000)
    sync = section_of(top, "sync")
    period_us = sync.integer("period_us", low=500, high=100_000, default=1000)
    overflow = sync.integer("counter_overflow", low=2, high=240, default=240)  # 1019h: 1 is reserved
    sync.finish()
    inputs = section_of(top, "inputs")
    wait_us = inputs.number("wait_us", unit="us", low=50, high=period_us, default=0.5 * period_us)
    deadline_us = inputs.number(
        "deadline_us", unit="us", low=wait_us, high=0.95 * period_us, default=0.85 * period_us
    )
    inputs.finish()
    nodes = section_of(top, "nodes")
    heartbeat_ms = nodes.integer("heartbeat_ms", low=10, high=10_000, default=100)
    heartbeat_timeout_ms = nodes.integer(
        "heartbeat_timeout_ms", low=2 * heartbeat_ms, high=0xFFFF, default=max(3 * heartbeat_ms, 300)
    )
    behaviour = nodes.text("error_behaviour", default="pre_operational")
    if behaviour not in _ERROR_BEHAVIOURS:
        raise nodes.error("error_behaviour", behaviour, f"one of {', '.join(_ERROR_BEHAVIOURS)}")
    emcy_inhibit_ms = nodes.integer("emcy_inhibit_ms", low=0, high=6000, default=10)
    boot_timeout_s = nodes.number("boot_timeout_s", unit="s", low=0.1, high=60, default=2.0)
    nodes.finish()
    settings = EstimatorSettings.from_section(section_of(top, "estimator"))
    safety = SafetySettings.from_section(top.section("safety", optional=True))
    sensor = read_sensor(top)
    joints = tuple(read_joint(top, path, number, settings.method, sensor) for number in (1, 2))
    realtime = _realtime(top)
    recording = RecordingSettings.from_section(top.section("recording", optional=True))
    metrics = top.section("metrics", optional=True)
    metrics_file = None if metrics is None else Path(metrics.text("file"))
    if metrics is not None:
        metrics.finish()
    top.finish()
    check_node_ids(path, node_id, joints, sensor)
    return Config(
        path=path,
        text=_text(path, data),
        sha256=hashlib.sha256(data).hexdigest(),
        node_id=node_id,
        bitrate=bitrate,
        period_ns=period_us * 1000,
        counter_overflow=overflow,
        input_wait_ns=round(wait_us * 1000),
        input_deadline_ns=round(deadline_us * 1000),
        heartbeat_ms=heartbeat_ms,
        heartbeat_timeout_ms=heartbeat_timeout_ms,
        error_behaviour=_ERROR_BEHAVIOURS.index(behaviour),
        emcy_inhibit_ms=emcy_inhibit_ms,
        boot_timeout_s=boot_timeout_s,
        estimator=settings,
        safety=safety,
        joints=joints,
        sensor=sensor,
        realtime=realtime,
        recording=recording,
        metrics_file=metrics_file,
    )


def _realtime(top: Section) -> Realtime:
    section = section_of(top, "realtime")
    priority = section.integer("priority", low=0, high=98, default=80)
    cpu = section.integer("cpu", low=0, high=4095, default=None)
    lock = section.boolean("lock_memory", default=True)
    section.finish()
    return Realtime(priority, cpu, lock)


def _text(path: Path, data: bytes) -> str:
    """As it is, so that its hash is that of the text in the log."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8: byte {error.start + 1}") from None
