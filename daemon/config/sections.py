"""A configuration as it is written: each section is a dataclass, its keys the fields with type, unit, range and default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final

from jtqd.daemon.config.drive import ObjectsSection, TpdoSection, check_given
from jtqd.daemon.config.settings import (
    ContactSettings,
    Realtime,
    RecordingSettings,
    Ros2Settings,
    SafetySettings,
)
from jtqd.drivers.drive import EVERY_SCALING_OBJECT
from jtqd.drivers.sensor import SENSOR_SCALING_OBJECTS
from jtqd.estimator.checked import Verbatim, range_text
from jtqd.estimator.decoder import FieldError, Text, choice, limits
from jtqd.estimator.settings import METHODS, EstimatorSettings

MAX_NODE_ID: Final = 127
LONGEST_CONTACT_PERIOD_US: Final = 5000
ERROR_BEHAVIOURS: Final = ("pre_operational", "none", "stopped")
"""1029h:1 in the order of its values."""

NodeId = Annotated[int, limits(ge=1, le=MAX_NODE_ID)]
_SdoTimeout = Annotated[int, limits(ge=10, le=10_000)]
"""Silence of a node [ms] after which an SDO request is repeated."""
_Unsigned32 = Annotated[int, limits(ge=0, le=0xFFFF_FFFF)]
_Given = Mapping[str, Annotated[float, limits(ge=0.0)]]
"""Objects ("6091h:1") to their values; `check_given` knows which."""


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
    """Section `inputs`; ranges and defaults depend on the period of SYNC (see `ConfigFile`)."""

    wait_us: Annotated[float, limits("us")] | None = None
    deadline_us: Annotated[float, limits("us")] | None = None


@dataclass(frozen=True)
class _Nodes:
    """Section `nodes`."""

    heartbeat_ms: Annotated[int, limits(ge=10, le=10_000)] = 100
    heartbeat_timeout_ms: Annotated[int, limits(le=0xFFFF)] | None = None
    error_behaviour: Annotated[str, choice(ERROR_BEHAVIOURS)] = "pre_operational"
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
class NetworkSection:
    """Section `joint_N.network`."""

    file: Text
    sha256: Text


@dataclass(frozen=True)
class JointSection:
    """Section `joint_N`; files lie beside the configuration."""

    node: NodeId
    file: Text
    identity: Identity = Identity()
    given: _Given = field(default_factory=dict)
    sensor_channel: Annotated[int, limits(ge=1, le=2)] | None = None
    temperature: bool = False
    mandatory: bool = True
    sdo_timeout_ms: _SdoTimeout | None = None
    objects: ObjectsSection = field(default_factory=ObjectsSection)
    tpdos: tuple[TpdoSection, ...] = ()
    max_age_ms: Annotated[float, limits("ms", ge=0.1, le=1000.0)] | None = None
    """For how long a frame of a TPDO that the drive sends by itself counts."""
    network: NetworkSection | None = None
    profile: Text | None = None
    """Of the drive's family: its values have been put below those of the section (`with_profiles`)."""

    def __post_init__(self) -> None:
        check_given("joint", self.given, EVERY_SCALING_OBJECT)
        if self.objects.temperature is not None and not self.temperature:
            raise FieldError("joint", "temperature", False, "true because of objects.temperature")


def _check_unit_words(words: Mapping[str, float]) -> None:
    for word in words:
        try:
            known = 0 <= int(word, 0) <= 0xFFFF_FFFF
        except ValueError:
            known = False
        if not known:
            expected = "a word of 32 bits as in 6131h, such as 0x00560000"
            raise FieldError("sensor", f"unit_words.{word}", Verbatim("that word"), expected)


@dataclass(frozen=True)
class SensorSection:
    """Section `sensor`."""

    node: NodeId
    channels: Annotated[int, limits(ge=1, le=2)] = 1
    identity: Identity = Identity()
    given: _Given = field(default_factory=dict)
    unit_words: _Given = field(default_factory=dict)
    mandatory: bool = False
    sdo_timeout_ms: _SdoTimeout | None = None

    def __post_init__(self) -> None:
        check_given("sensor", self.given, SENSOR_SCALING_OBJECTS)
        _check_unit_words(self.unit_words)


@dataclass(frozen=True)
class _Metrics:
    """Section `metrics`."""

    file: Text


@dataclass(frozen=True)
class ConfigFile:
    """A configuration as it is written."""

    node_id: NodeId
    joint_1: JointSection
    joint_2: JointSection | None = None
    joint_3: JointSection | None = None
    joint_4: JointSection | None = None
    bitrate: Annotated[int, limits(ge=10_000, le=1_000_000)] = 1_000_000
    sync: _Sync = _Sync()
    inputs: _Inputs = _Inputs()
    nodes: _Nodes = _Nodes()
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    safety: SafetySettings = field(default_factory=SafetySettings)
    sensor: SensorSection | None = None
    realtime: Realtime = field(default_factory=Realtime)
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    metrics: _Metrics | None = None
    ros2: Ros2Settings | None = None
    contact: ContactSettings | None = None

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_inputs()
        self._check_channels()
        self._check_node_ids()
        self._check_names()
        self._check_contact()

    @property
    def joints(self) -> tuple[JointSection, ...]:
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

    def _check_contact(self) -> None:
        if self.contact is None:
            return
        if not METHODS[self.estimator.method].with_torsion:
            expected = "fused, whose torsion contacts are told by (section contact)"
            raise FieldError("configuration", "estimator.method", self.estimator.method, expected)
        if self.sync.period_us > LONGEST_CONTACT_PERIOD_US:
            expected = f"at most {LONGEST_CONTACT_PERIOD_US} us with section contact: a slower cycle sees no contact in time"
            raise FieldError("configuration", "sync.period_us", self.sync.period_us, expected)
        if self.contact.opposed and len(self.joints) % 2:
            expected = f"false with {len(self.joints)} joints: opposed are joints 1 and 2, 3 and 4"
            raise FieldError("configuration", "contact.opposed", True, expected)

    def _check_node_ids(self) -> None:
        users = {self.node_id: "node_id"}
        nodes = {f"joint_{number}.node": joint.node for number, joint in enumerate(self.joints, start=1)}
        if self.sensor is not None:
            nodes["sensor.node"] = self.sensor.node
        for key, node in nodes.items():
            if node in users:
                raise FieldError("configuration", key, node, f"a node-ID not used by {users[node]}")
            users[node] = key
