"""Configuration of jtqd: read once into frozen, validated objects.

The keys of the file with their types, units, ranges and defaults are `SafetySettings`, `RecordingSettings`, `Realtime`,
`Ros2Settings`, `EstimatorSettings` and the sections from `_Sync` to `_File`. Unknown keys and wrong values are errors of one
line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final

from jtqd.daemon.profiles import path_of, with_profiles
from jtqd.daemon.shared import faults
from jtqd.drivers.devices import (
    CIA_402,
    DRIVE_SCALING_OBJECTS,
    SENSOR_SCALING_OBJECTS,
    DriveObject,
    DriveObjects,
    parse_key,
)
from jtqd.drivers.sdo import Key, label
from jtqd.estimator.checked import ConfigError, Section, Verbatim, range_text
from jtqd.estimator.decoder import FieldError, Text, check, choice, decode, limits
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings, PlausibilityLimits
from jtqd.estimator.sha256 import sha256_hex
from jtqd.models.files import read_regular, read_yaml, shipped

DEFAULT_CONFIG: Final = "bench.yaml"
MAX_NODE_ID: Final = 127
MAX_COUNTER: Final = 240
"""Of SYNC (CiA 301, 7.2.5.3)."""
LATCHED_BY_DEFAULT: Final = faults.NOT_FINITE | faults.BITS["motor_jump"] | faults.BITS["link_jump"]
"""What leaves numbers behind that look right and are not: a broken estimator, an encoder that has lost its zero."""
_ERROR_BEHAVIOURS: Final = ("pre_operational", "none", "stopped")
"""1029h:1 in the order of its values."""
_LARGEST_NETWORK: Final = 64_000_000
"""Bytes; ours have 50 000."""
_PDO_BITS: Final = 64
_NEEDED: Final = {"tob": (), "efficiency": ("efficiency",), "network": ("efficiency",), "fused": ("fused",)}
"""Sections of a joint file that a method cannot do without."""
LOOPBACK: Final = "lo"
"""Network interface that no other machine reaches."""
HIGHEST_DOMAIN: Final = 232
"""Of DDS: ports of a higher one are beyond 65535 (DDSI-RTPS, 9.6.1)."""
_INTERFACE: Final = re.compile(r"[\w.@-]{1,15}", re.ASCII)
_WITH_NETWORK: Final = ("network", "fused")
"""Methods that use one; `fused` is its physics alone without."""

NodeId = Annotated[int, limits(ge=1, le=MAX_NODE_ID)]
_SdoTimeout = Annotated[int, limits(ge=10, le=10_000)]
"""Silence of a node [ms] after which an SDO request is repeated."""
_Unsigned32 = Annotated[int, limits(ge=0, le=0xFFFF_FFFF)]
_Given = Mapping[str, Annotated[float, limits(ge=0.0)]]
"""Objects ("6091h:1") to their values; `_check_given` knows which."""


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """Section `safety`: how faults are found and which of them wait for a reset.

    latch: bits of `shared/cycle_record.py`, in the file a list of their names; stale_latch_cycles: so many cycles in a
    row without inputs, or without time, are the fault `stale` (None: never); deviation_sigmas, deviation_s: the fault
    `deviation`; plausibility: None (in the file: false) for no checks.
    """

    latch: int = LATCHED_BY_DEFAULT
    stale_latch_cycles: Annotated[int, limits(ge=1, le=1_000_000)] | None = None
    deviation_sigmas: Annotated[float, limits(ge=1.0, le=100.0)] = 3.0
    deviation_s: Annotated[float, limits("s", ge=0.01, le=60.0)] = 1.0
    plausibility: PlausibilityLimits | None = field(default_factory=PlausibilityLimits)

    def __post_init__(self) -> None:
        check(self, "safety")

    @classmethod
    def from_section(cls, section: Section) -> SafetySettings:
        """Read the section of a configuration file; every key is optional. Raises ConfigError."""
        given: dict[str, Any] = {"latch": _latch(section)}
        if section.raw("plausibility", None) is False:
            given["plausibility"] = None
        settings = decode(cls, section, **given)
        if settings.stale_latch_cycles is None:
            return settings
        return replace(settings, latch=settings.latch | faults.STALE)


def _latch(section: Section) -> int:
    names = [name for name in faults.BITS if name != "stale"]
    value: Any = section.raw("latch", None)
    if value is None:
        return LATCHED_BY_DEFAULT
    if not isinstance(value, list) or not all(isinstance(name, str) and name in names for name in value):
        raise section.error("latch", value, f"a list of {', '.join(names)}; [] for none")
    return sum({faults.BITS[name] for name in value})


@dataclass(frozen=True)
class RecordingSettings:
    """Section `recording`; megabytes are of 1 000 000 bytes.

    Attributes:
        ring_cycles: cycles that shared memory holds for the recorder: for so long it may be stopped.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        rotate_s, rotate_mb: a file is ended and the next one begun after this time, or at this size.
        budget_mb: all files of this bus in the directory; older ones are removed. None: nothing is removed.
        keep_run: the budget never removes a part of the run that is being written.
        reserve_mb: recording ends when less than this is free, and goes on when there is room again.
        flight_recorder_s: keep this time in memory and write it on a fault or on request. None: record all.
    """

    ring_cycles: Annotated[int, limits(ge=256, le=1 << 20)] = 4096
    chunk_s: Annotated[float, limits("s", ge=0.05, le=10.0)] = 0.5
    rotate_s: Annotated[float, limits("s", ge=1.0, le=86_400.0)] = 600.0
    rotate_mb: Annotated[float, limits("MB", ge=1.0, le=1e6)] = 1000.0
    budget_mb: Annotated[float, limits("MB", ge=10.0, le=1e9)] | None = None
    keep_run: bool = True
    reserve_mb: Annotated[float, limits("MB", ge=0.0, le=1e9)] = 256.0
    flight_recorder_s: Annotated[float, limits("s", ge=1.0, le=600.0)] | None = None

    def __post_init__(self) -> None:
        check(self, "recording")


@dataclass(frozen=True)
class Realtime:
    """Section `realtime`: what the loop asks of the kernel; what it does not get is logged."""

    priority: Annotated[int, limits(ge=0, le=98)] = 80
    cpu: Annotated[int, limits(ge=0, le=4095)] | None = None
    lock_memory: bool = True


@dataclass(frozen=True)
class Ros2Settings:
    """Section `ros2`: what is published for ROS 2 (docs/ros2.md).

    Attributes:
        domain_id: DDS domain; None: as ROS_DOMAIN_ID says, else 0.
        interface: network interface.
        rate_hz: of joint states and torque states.
        names: of the joints in ROS 2, by section (`joint_1`); left out: the section's name.
    """

    domain_id: Annotated[int, limits(ge=0, le=HIGHEST_DOMAIN)] | None = None
    interface: Text = LOOPBACK
    rate_hz: Annotated[float, limits("Hz", ge=1.0, le=500.0)] = 100.0
    names: Mapping[str, Text] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self, "ros2")
        if not _INTERFACE.fullmatch(self.interface):
            raise FieldError("ros2", "interface", self.interface, "a network interface such as lo or eth0")

    def names_of(self, joints: int) -> tuple[str, ...]:
        """Return the names of so many joints, joint 1 first."""
        sections = (f"joint_{number}" for number in range(1, joints + 1))
        return tuple(self.names.get(section, section) for section in sections)


@dataclass(frozen=True)
class Identity:
    """Expected 1018h entries and software; None where the bench accepts any value."""

    vendor: _Unsigned32 | None = None
    product: _Unsigned32 | None = None
    revision: _Unsigned32 | None = None
    serial: _Unsigned32 | None = None
    software: Text | None = None
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
    """The drive sends the joint's temperature (3001h by TPDO3)."""
    mandatory: bool
    """jtqd does not start without it."""
    sdo_timeout_ms: int
    """Silence of the drive after which an SDO request is repeated."""
    objects: DriveObjects
    """Which objects of the drive are mapped, with sign and factor."""
    joint_data: bytes = field(default=b"", repr=False)
    """The joint file as it was read, for the log."""
    profile: str | None = None
    """Of the drive's family."""
    profile_path: Path | None = None
    profile_data: bytes = field(default=b"", repr=False)
    """The profile as it was read, for the log."""

    @property
    def joint_sha256(self) -> str:
        """Hash of the joint file."""
        return sha256_hex(self.joint_data)


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
    sdo_timeout_ms: int
    """As of a joint."""


@dataclass(frozen=True)
class _Sync:
    """Section `sync`."""

    period_us: Annotated[int, limits(ge=500, le=100_000)] = 1000
    counter_overflow: Annotated[int, limits(ge=0, le=240)] = 0
    """1019h: 0 for SYNC without a counter byte; 1 is reserved. A drive that comes back from its power-up has 0 there."""

    def __post_init__(self) -> None:
        if self.counter_overflow == 1:
            raise FieldError("sync", "counter_overflow", 1, "0, or a whole number 2..240")


@dataclass(frozen=True)
class _Inputs:
    """Section `inputs`; ranges and defaults depend on the period of SYNC (see `_File`)."""

    wait_us: Annotated[float, limits("us")] | None = None
    deadline_us: Annotated[float, limits("us")] | None = None


@dataclass(frozen=True)
class _Nodes:
    """Section `nodes`."""

    heartbeat_ms: Annotated[int, limits(ge=10, le=10_000)] = 100
    heartbeat_timeout_ms: Annotated[int, limits(le=0xFFFF)] | None = None
    error_behaviour: Annotated[str, choice(_ERROR_BEHAVIOURS)] = "pre_operational"
    emcy_inhibit_ms: Annotated[int, limits(ge=0, le=6000)] = 10
    boot_timeout_s: Annotated[float, limits("s", ge=0.1, le=60.0)] = 2.0
    sdo_timeout_ms: _SdoTimeout = 600
    reset_communication: bool = True
    """NMT reset communication before the nodes are configured."""

    def __post_init__(self) -> None:
        least, timeout = 2 * self.heartbeat_ms, self.timeout_ms
        if timeout < least:
            expected = range_text("a whole number", least, 0xFFFF, None)
            raise FieldError("nodes", "heartbeat_timeout_ms", timeout, expected)

    @property
    def timeout_ms(self) -> int:
        """Time without a heartbeat after which a node counts as lost."""
        given = self.heartbeat_timeout_ms
        return max(3 * self.heartbeat_ms, 300) if given is None else given


@dataclass(frozen=True)
class _Network:
    """Section `joint_N.network`."""

    file: Text
    sha256: Text


def _check_given(where: str, given: Mapping[str, float], known: Mapping[Key, tuple[str, int]]) -> None:
    """Refuse objects that scale nothing, and values that they cannot have. Raises FieldError."""
    for name, value in given.items():
        try:
            key = parse_key(name)
        except ValueError:
            key = (0, 0)
        if key not in known:
            expected = "one of " + ", ".join(label(*each) for each in known)
            raise FieldError(where, f"given.{name}", Verbatim("that object"), expected)
        what, highest = known[key]
        if value != int(value) or not value <= highest:
            expected = f"{what}, {range_text('a whole number', 0, highest, None)}"
            raise FieldError(where, f"given.{name}", value, expected)


def _check_unit_words(words: Mapping[str, float]) -> None:
    for word in words:
        try:
            known = 0 <= int(word, 0) <= 0xFFFF_FFFF
        except ValueError:
            known = False
        if not known:
            expected = "a word of 32 bits as in 6131h, such as 0x00560000"
            raise FieldError("sensor", f"unit_words.{word}", Verbatim("that word"), expected)


_TYPES: Final = {"I16": (16, True), "I32": (32, True), "U16": (16, False), "U32": (32, False)}
_Index = Annotated[int, limits(ge=0x1000, le=0xFFFF)]
_SubIndex = Annotated[int, limits(ge=0, le=254)]


@dataclass(frozen=True)
class _Object:
    """One object in section `joint_N.objects`; what is left out is as in CiA 402."""

    index: _Index | None = None
    sub: _SubIndex | None = None
    type: Annotated[str, choice(_TYPES)] | None = None
    sign: Annotated[int, limits(ge=-1, le=1)] = 1
    factor: Annotated[float, limits(gt=0.0)] | None = None
    """SI units (rad, rad/s, A) per unit; without it the drive's scaling objects count."""

    def __post_init__(self) -> None:
        if self.sign == 0:
            raise FieldError("object", "sign", 0, "1 or -1")

    def of_drive(self, standard: DriveObject) -> DriveObject:
        """Return the object of the drive; `standard` is that of CiA 402."""
        bits, signed = _TYPES[self.type] if self.type else (standard.bits, standard.signed)
        return DriveObject(
            standard.index if self.index is None else self.index,
            (standard.subindex if self.index is None else 0) if self.sub is None else self.sub,
            bits,
            signed,
            self.sign,
            self.factor,
        )


@dataclass(frozen=True)
class _Objects:
    """Section `joint_N.objects`."""

    motor_position: _Object = _Object()
    link_position: _Object = _Object()
    motor_velocity: _Object = _Object()
    current: _Object = _Object()
    statusword: _Object = _Object()

    def of_drive(self, joint: str, path: Path) -> DriveObjects:
        """Return the objects of the drive. Raises ConfigError for what cannot be mapped or scaled."""
        where = f"{path}: key '{joint}.objects"
        found = {}
        for each in fields(self):
            standard: DriveObject = getattr(CIA_402, each.name)
            chosen = found[each.name] = getattr(self, each.name).of_drive(standard)
            another = (chosen.index, chosen.subindex) != (standard.index, standard.subindex)
            if each.name == "statusword":
                if chosen.bits != standard.bits or chosen.sign != 1 or chosen.factor is not None:
                    raise ConfigError(
                        f"{where}.statusword': expected an object of type U16, no sign, no factor"
                    )
            elif another and chosen.factor is None:
                unit = "A" if each.name == "current" else "rad/s" if "velocity" in each.name else "rad"
                raise ConfigError(
                    f"{where}.{each.name}.factor': missing, expected {unit} per unit: "
                    f"CiA 402 scales {label(standard.index, standard.subindex)} alone"
                )
            if "position" in each.name and (chosen.bits, chosen.signed) != (32, True):
                raise ConfigError(
                    f"{where}.{each.name}.type': expected I32: a position rolls over at 32 bits"
                )
        objects = DriveObjects(**found)
        bits = objects.motor_velocity.bits + objects.current.bits + objects.statusword.bits
        if bits > _PDO_BITS:
            raise ConfigError(
                f"{where}': found {bits} bits of velocity, current and statusword, expected at most {_PDO_BITS}: one PDO"
            )
        return objects


@dataclass(frozen=True)
class _JointSection:
    """Section `joint_N`; files lie beside the configuration."""

    node: NodeId
    file: Text
    identity: Identity = Identity()
    given: _Given = field(default_factory=dict)
    sensor_channel: Annotated[int, limits(ge=1, le=2)] | None = None
    temperature: bool = False
    mandatory: bool = True
    sdo_timeout_ms: _SdoTimeout | None = None
    objects: _Objects = _Objects()
    network: _Network | None = None
    profile: Text | None = None
    """Of the drive's family: its values have been put below those of the section (`with_profiles`)."""

    def __post_init__(self) -> None:
        _check_given("joint", self.given, DRIVE_SCALING_OBJECTS)


@dataclass(frozen=True)
class _SensorSection:
    """Section `sensor`."""

    node: NodeId
    channels: Annotated[int, limits(ge=1, le=2)] = 1
    identity: Identity = Identity()
    given: _Given = field(default_factory=dict)
    unit_words: _Given = field(default_factory=dict)
    mandatory: bool = False
    sdo_timeout_ms: _SdoTimeout | None = None

    def __post_init__(self) -> None:
        _check_given("sensor", self.given, SENSOR_SCALING_OBJECTS)
        _check_unit_words(self.unit_words)


@dataclass(frozen=True)
class _Metrics:
    """Section `metrics`."""

    file: Text


@dataclass(frozen=True)
class _File:
    """A configuration as it is written."""

    node_id: NodeId
    joint_1: _JointSection
    joint_2: _JointSection | None = None
    joint_3: _JointSection | None = None
    joint_4: _JointSection | None = None
    bitrate: Annotated[int, limits(ge=10_000, le=1_000_000)] = 1_000_000
    sync: _Sync = _Sync()
    inputs: _Inputs = _Inputs()
    nodes: _Nodes = _Nodes()
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    safety: SafetySettings = field(default_factory=SafetySettings)
    sensor: _SensorSection | None = None
    realtime: Realtime = Realtime()
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    metrics: _Metrics | None = None
    ros2: Ros2Settings | None = None

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_inputs()
        self._check_channels()
        self._check_node_ids()
        self._check_names()

    @property
    def joints(self) -> tuple[_JointSection, ...]:
        """Sections `joint_1`, `joint_2`, ... as far as there are any."""
        every = self.joint_1, self.joint_2, self.joint_3, self.joint_4
        return tuple(joint for joint in every if joint is not None)

    @property
    def wait_us(self) -> float:
        """Time after SYNC at which the loop first looks for its inputs."""
        return 0.5 * self.sync.period_us if self.inputs.wait_us is None else self.inputs.wait_us

    @property
    def deadline_us(self) -> float:
        """Time after SYNC at which missing inputs count as missing."""
        return 0.85 * self.sync.period_us if self.inputs.deadline_us is None else self.inputs.deadline_us

    def _check_numbers(self) -> None:
        """Joints are numbered without a gap: the numbers are those of the estimate PDOs and of the log's topics."""
        for number in range(1, len(self.joints) + 1):
            if getattr(self, f"joint_{number}") is None:
                expected = f"joint_1 to joint_{len(self.joints)} without a gap"
                raise FieldError("configuration", f"joint_{number}", "none", expected)

    def _check_inputs(self) -> None:
        period_us = self.sync.period_us
        for key, value, low, high in (
            ("wait_us", self.wait_us, 50, period_us),
            ("deadline_us", self.deadline_us, self.wait_us, 0.95 * period_us),
        ):
            if not low <= value <= high:
                raise FieldError(
                    "configuration", f"inputs.{key}", value, range_text("a number in us", low, high, None)
                )

    def _check_channels(self) -> None:
        channels = [] if self.sensor is None else list(range(1, self.sensor.channels + 1))
        for number, joint in enumerate(self.joints, start=1):
            channel = joint.sensor_channel
            if channel is not None and channel not in channels:
                expected = (
                    f"one of the sensor's channels {channels}" if channels else "no channel without a sensor"
                )
                raise FieldError("configuration", f"joint_{number}.sensor_channel", channel, expected)

    def _check_names(self) -> None:
        """Names of ROS 2: of joints that there are, and each once, as ROS 2 tells joints apart by nothing else."""
        if self.ros2 is None:
            return
        sections = [f"joint_{number}" for number in range(1, len(self.joints) + 1)]
        for section in self.ros2.names:
            if section not in sections:
                expected = "one of " + ", ".join(sections)
                raise FieldError("configuration", f"ros2.names.{section}", Verbatim("that joint"), expected)
        names = self.ros2.names_of(len(sections))
        for n, name in enumerate(names):
            if name in names[:n]:
                raise FieldError("configuration", f"ros2.names.{sections[n]}", name, "a name of its own")

    def _check_node_ids(self) -> None:
        users = {self.node_id: "node_id"}
        nodes = {f"joint_{number}.node": joint.node for number, joint in enumerate(self.joints, start=1)}
        if self.sensor is not None:
            nodes["sensor.node"] = self.sensor.node
        for key, node in nodes.items():
            if node in users:
                raise FieldError("configuration", key, node, f"a node-ID not used by {users[node]}")
            users[node] = key


@dataclass(frozen=True)
class Config:
    """Configuration of jtqd with its joint files and networks. `text`: the YAML as read, for the log; `sha256`: its hash."""

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
    reset_communication: bool
    estimator: EstimatorSettings
    safety: SafetySettings
    joints: tuple[JointConfig, ...]
    sensor: SensorConfig | None
    realtime: Realtime
    recording: RecordingSettings
    metrics_file: Path | None = None
    """Prometheus text file, written every 5 s; None for none."""
    ros2: Ros2Settings | None = None
    """What is published for ROS 2; None: nothing, unless the command line asks for it."""

    @property
    def files_sha256(self) -> str:
        """Hash of the configuration, its joint files and profiles together; networks are named in it by theirs."""
        parts = [self.sha256, *(joint.joint_sha256 for joint in self.joints)]
        parts += [sha256_hex(joint.profile_data) for joint in self.joints if joint.profile]
        return sha256_hex("".join(parts).encode())

    @property
    def sequence_overflow(self) -> int:
        """Last number of a cycle in estimate PDO and log; SYNC itself carries it only with a `counter_overflow`."""
        return self.counter_overflow or MAX_COUNTER

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
    file = decode(_File, Section(with_profiles(mapping, path), str(path)))
    joints = tuple(
        _joint(path, number, section, file.estimator.method, file.nodes.sdo_timeout_ms)
        for number, section in enumerate(file.joints, start=1)
    )
    return Config(
        path=path,
        text=_text(path, data),
        sha256=sha256_hex(data),
        node_id=file.node_id,
        bitrate=file.bitrate,
        period_ns=file.sync.period_us * 1000,
        counter_overflow=file.sync.counter_overflow,
        input_wait_ns=round(file.wait_us * 1000),
        input_deadline_ns=round(file.deadline_us * 1000),
        heartbeat_ms=file.nodes.heartbeat_ms,
        heartbeat_timeout_ms=file.nodes.timeout_ms,
        error_behaviour=_ERROR_BEHAVIOURS.index(file.nodes.error_behaviour),
        emcy_inhibit_ms=file.nodes.emcy_inhibit_ms,
        boot_timeout_s=file.nodes.boot_timeout_s,
        reset_communication=file.nodes.reset_communication,
        estimator=file.estimator,
        safety=file.safety,
        joints=joints,
        sensor=None if file.sensor is None else _sensor(file.sensor, file.nodes.sdo_timeout_ms),
        realtime=file.realtime,
        recording=file.recording,
        metrics_file=None if file.metrics is None else Path(file.metrics.file),
        ros2=file.ros2,
    )


def _sensor(section: _SensorSection, sdo_timeout_ms: int) -> SensorConfig:
    return SensorConfig(
        node_id=section.node,
        identity=section.identity,
        channels=tuple(range(1, section.channels + 1)),
        given=_whole(section.given),
        unit_words=dict(section.unit_words),
        mandatory=section.mandatory,
        sdo_timeout_ms=section.sdo_timeout_ms or sdo_timeout_ms,
    )


def _joint(path: Path, number: int, section: _JointSection, method: str, sdo_timeout_ms: int) -> JointConfig:
    """Read what a section `joint_N` names: the joint file and, where the method uses one, the network."""
    network = None if section.network is None else _network(section.network, path)
    joint_path = path.parent / section.file
    profile_path = None if section.profile is None else path_of(section.profile, path.parent)
    mapping, data = read_yaml(joint_path)
    joint = Joint.from_mapping(mapping, str(joint_path))
    if method == "network" and network is None:
        key = f"joint_{number}.network"
        raise ConfigError(
            f"{path}: key '{key}': missing, expected file and sha256 because estimator.method is network"
        )
    for needed in _NEEDED[method]:
        if getattr(joint, needed) is None:
            raise ConfigError(
                f"{joint_path}: key '{needed}': missing, expected because estimator.method is {method}"
            )
    return JointConfig(
        number=number,
        node_id=section.node,
        identity=section.identity,
        given=_whole(section.given),
        joint_path=joint_path,
        joint=joint,
        network=network if method in _WITH_NETWORK else None,
        sensor_channel=section.sensor_channel,
        temperature=section.temperature,
        mandatory=section.mandatory,
        sdo_timeout_ms=section.sdo_timeout_ms or sdo_timeout_ms,
        objects=section.objects.of_drive(f"joint_{number}", path),
        joint_data=data,
        profile=section.profile,
        profile_path=profile_path,
        profile_data=b"" if profile_path is None else read_yaml(profile_path)[1],
    )


def _whole(values: Mapping[str, float]) -> dict[str, int]:
    return {name: int(value) for name, value in values.items()}


def _network(section: _Network, path: Path) -> NetworkFile:
    file, expected = path.parent / section.file, section.sha256.lower()
    data = read_regular(file, _LARGEST_NETWORK, "a network")
    found = sha256_hex(data)
    if found != expected:
        raise ConfigError(f"{file}: sha256 of the network: found {found}, expected {expected} (from {path})")
    return NetworkFile(file, expected, data)


def _text(path: Path, data: bytes) -> str:
    """As it is, so that its hash is that of the text in the log."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8: byte {error.start + 1}") from None
