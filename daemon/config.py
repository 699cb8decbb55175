"""Configuration of jtqd: read once into frozen, validated objects.

    YAML -> values of profiles added -> sections (types, units, ranges) -> joint files, networks -> `Config`

Each section is a dataclass, its keys the fields. Unknown keys and wrong values are errors of one line that name the file,
the key, what was found and what was expected.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final

from jtqd.daemon.profiles import path_of, with_profiles
from jtqd.daemon.shared import faults
from jtqd.drivers.drive import (
    AT_JOINT,
    BY_TORQUE,
    CIA_402,
    EVERY_SCALING_OBJECT,
    SCALES,
    SHAFTS,
    DriveObject,
    DriveObjects,
    LayoutError,
    Temperature,
    drive_layout,
    map_of,
    maps_of_json,
    select_tpdos,
)
from jtqd.drivers.pdo import ACYCLIC, PdoError, PdoMap, Tpdo
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.drivers.sensor import SENSOR_SCALING_OBJECTS
from jtqd.estimator.decoder import FieldError, Text, below, check, choice, in_file, limits, parsed, read
from jtqd.estimator.errors import ConfigError, Verbatim, range_text
from jtqd.estimator.files import read_regular
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import CONTACT_THRESHOLD, METHODS, EstimatorSettings, PlausibilityLimits
from jtqd.estimator.text import sha256_hex
from jtqd.models.files import read_yaml, shipped

_PDO_BITS: Final = 64
_TYPES: Final = {"I16": (16, True), "I32": (32, True), "U16": (16, False), "U32": (32, False)}
_TORQUE: Final = 0x6077
"""In 1/1000 of 6076h."""
_Index = Annotated[int, limits(ge=0x1000, le=0xFFFF)]
_SubIndex = Annotated[int, limits(ge=0, le=254)]


@dataclass(frozen=True)
class _Object:
    """One object in section `joint_N.objects`; a key left out is as in CiA 402."""

    index: _Index | None = None
    sub: _SubIndex | None = None
    type: Annotated[str, choice(_TYPES)] | None = None
    sign: Annotated[int, limits(ge=-1, le=1)] = 1
    factor: Annotated[float, limits(gt=0.0)] | None = None
    """SI units (rad, rad/s, A) per unit; without it the drive's scaling objects count."""
    by: Text | None = None
    """Which scaling object; `drivers/drive.py` has those of each quantity."""
    shaft: Annotated[str, choice(SHAFTS)] | None = None
    """Where the drive counts by 6092h, 60A8h, 60A9h."""

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
            BY_TORQUE if self.by is None and self.factor is None and self.index == _TORQUE else self.by or "",
            self.shaft or AT_JOINT,
        )

    def check(self, name: str, standard: DriveObject) -> None:
        """Raise FieldError for an object that cannot be mapped or scaled."""
        chosen = self.of_drive(standard)

        def wrong(key: str, problem: str) -> FieldError:
            return FieldError("object", key, None, "", problem)

        if name == "statusword":
            if chosen.bits != standard.bits or self.sign != 1 or self.factor or self.by or self.shaft:
                raise wrong("", "expected an object of type U16, no sign, no factor")
            return
        scales = SCALES[name]
        another = (chosen.index, chosen.subindex) != (standard.index, standard.subindex)
        if self.by is not None and self.by not in scales:
            raise FieldError("object", "by", self.by, f"one of {', '.join(scales)}")
        if self.by is not None and self.factor is not None:
            raise wrong("by", "found both by and factor, expected one of them")
        if another and chosen.factor is None and not chosen.by:
            unit = "A" if name == "current" else "rad/s" if "velocity" in name else "rad"
            alone = f"CiA 402 scales {label(standard.index, standard.subindex)} alone"
            raise FieldError("object", "factor", MISSING, f"{unit} per unit, or 'by': {alone}")
        if self.shaft is not None and not (self.by and scales[self.by].at_shaft and name.startswith("motor")):
            raise wrong("shaft", "expected only for the motor by 6092h, 60A8h or 60A9h")
        if "position" in name and (chosen.bits, chosen.signed) != (32, True):
            raise wrong("type", "expected I32: a position rolls over at 32 bits")


@dataclass(frozen=True)
class _Temperature:
    """The joint's temperature in section `joint_N.objects`: another object than 3001h, 16 bits, signed."""

    index: _Index
    factor: Annotated[float, limits(gt=0.0, le=1000.0)]
    """Degrees Celsius per unit."""
    sub: _SubIndex = 0


@dataclass(frozen=True)
class ObjectsSection:
    """Section `joint_N.objects`; None (in the file: `false`) for a quantity that the drive does not have."""

    motor_position: _Object = _Object()
    link_position: _Object | None = _Object()
    motor_velocity: _Object | None = _Object()
    current: _Object = _Object()
    statusword: _Object = _Object()
    temperature: _Temperature | None = None

    def of_drive(self) -> DriveObjects:
        """Return the objects of the drive. Raises FieldError for an object that cannot be mapped or scaled."""
        found: dict[str, Any] = {}
        for each in fields(CIA_402):
            written: _Object | None = getattr(self, each.name)
            found[each.name] = None
            if written is not None:
                standard: DriveObject = getattr(CIA_402, each.name)
                with below(f"objects.{each.name}"):
                    written.check(each.name, standard)
                found[each.name] = written.of_drive(standard)
        return DriveObjects(**found)

    @property
    def of_joint(self) -> Temperature:
        """Return the object of the joint's temperature."""
        own = self.temperature
        return Temperature() if own is None else Temperature(own.index, own.sub, own.factor)


@dataclass(frozen=True)
class TpdoSection:
    """One TPDO in section `joint_N.tpdos`: parameters 1800h and 1A00h, 1801h and 1A01h, ..."""

    number: Annotated[int, limits(ge=1, le=4)]
    cob_id: Annotated[int, limits(ge=0x181, le=0x4FF)]
    objects: tuple[Annotated[int, limits(ge=0, le=0xFFFF_FFFF)], ...]
    """Mapping entries 0xIIIISSLL."""
    type: Annotated[int, limits(ge=0, le=255)] = 1
    """Transmission type: 1, or 0, 254, 255 with `max_age_ms`."""


def check_given(where: str, given: Mapping[str, float], known: Mapping[Key, tuple[str, int]]) -> None:
    """Raise FieldError for objects that scale nothing, and for values that they cannot have."""
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


def tpdos_of(
    node: int, objects: DriveObjects, tpdos: Sequence[TpdoSection], *, acyclic: bool, temperature: bool
) -> tuple[PdoMap, ...]:
    """Return the TPDOs that carry the objects.

    acyclic: `max_age_ms` is given, so TPDOs of transmission type 0, 254 or 255 may be among them; temperature: TPDO3
    carries the temperature. Raises FieldError for TPDOs that are incomplete or contradict each other.
    """
    if not tpdos:
        second = (objects.motor_velocity, objects.current, objects.statusword)
        bits = sum(each.bits for each in second if each is not None)
        if bits > _PDO_BITS:
            found = Verbatim(f"{bits} bits of velocity, current and statusword")
            raise FieldError("joint", "objects", found, f"at most {_PDO_BITS}: one PDO")
        return drive_layout(node, objects)
    for each in tpdos:
        if each.type != 1 and each.type not in ACYCLIC:
            raise FieldError("joint", "tpdos", Verbatim(f"type {each.type}"), "1, 0, 254 or 255")
        if each.type in ACYCLIC and not acyclic:
            expected = f"ms because TPDO{each.number} has type {each.type}"
            raise FieldError("joint", "max_age_ms", MISSING, expected)
    try:
        maps = tuple(
            map_of(node, Tpdo(each.number, each.cob_id, each.objects, each.type), objects) for each in tpdos
        )
        used = select_tpdos(objects, maps)
    except (PdoError, LayoutError) as error:
        raise FieldError("joint", "tpdos", None, "", str(error)) from None
    for name, of_temperature in (("number", 3), ("cob_id", 0x380 + node)):
        values = [getattr(pdo, name) for pdo in maps]
        reserved = [of_temperature] if temperature else []
        if len({*values, *reserved}) != len(values) + len(reserved):
            shown = ", ".join(str(value) if name == "number" else f"{value:03X}h" for value in values)
            rule = ", TPDO3 is that of the temperature" if reserved else ""
            raise FieldError("joint", "tpdos", Verbatim(f"{name} {shown}"), f"each once{rule}")
    return used


LATCHED_BY_DEFAULT: Final = sum(faults.BITS[a] for a in ("not_finite", "motor_jump", "link_jump", "repeated"))
"""Faults after which numbers look right and are not: a broken estimator, an encoder that has lost its zero, old inputs."""
LOOPBACK: Final = "lo"
"""Network interface that no other machine reaches."""
HIGHEST_DOMAIN: Final = 232
"""Of DDS: ports of a higher one are beyond 65535 (DDSI-RTPS, 9.6.1)."""
_INTERFACE: Final = re.compile(r"[\w.@-]{1,15}", re.ASCII)
MAX_NODE_ID: Final = 127
LONGEST_CONTACT_PERIOD_US: Final = 5000
ERROR_BEHAVIOURS: Final = ("pre_operational", "none", "stopped")
"""1029h:1 in the order of its values."""

MASTER, GUEST, LISTENER = "master", "guest", "listener"
ROLES: Final = (MASTER, GUEST, LISTENER)
"""Who sends SYNC and configures the nodes: jtqd, or another node, to which jtqd is an NMT slave, or not there at all."""

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
    """Longest age of a frame of an acyclic TPDO."""
    network: NetworkSection | None = None
    shadow_networks: Mapping[str, NetworkSection] = field(default_factory=dict)
    """Of shadow methods, by method."""
    profile: Text | None = None
    """Of the drive's family: gives the values that the section does not have (`with_profiles`)."""
    eds: Text | None = None
    """Its EDS or DCF, beside the configuration: layout and scaling for a guest."""

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
    eds: Text | None = None
    """As of a joint."""

    def __post_init__(self) -> None:
        check_given("sensor", self.given, SENSOR_SCALING_OBJECTS)
        _check_unit_words(self.unit_words)


@dataclass(frozen=True, slots=True)
class _Estimator(EstimatorSettings):
    """Section `estimator`; shadow: further methods of every joint, computed every cycle and never sent."""

    shadow: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Metrics:
    """Section `metrics`."""

    file: Text


_LATCHABLE: Final = tuple(name for name in faults.BITS if name != "stale")


def _latch(names: Any) -> int:
    """Return the bits of a list of names in the file."""
    if names is None:
        return LATCHED_BY_DEFAULT
    if not isinstance(names, list) or not all(isinstance(name, str) and name in _LATCHABLE for name in names):
        raise ValueError("found other names")
    return sum({faults.BITS[name] for name in names})


@dataclass(frozen=True, slots=True)
class SafetySettings:
    """Section `safety`: limits of the faults, and faults that are latched until a reset.

    latch: bits of `shared/cycle_record.py`, in the file a list of their names; stale_latch_cycles: so many cycles in a
    row without inputs, or without time, are the fault `stale` (None: never); deviation_sigmas, deviation_s: the fault
    `deviation`; plausibility: None (in the file: false) for no checks.
    """

    latch: Annotated[int, parsed(_latch, f"a list of {', '.join(_LATCHABLE)}; [] for none")] = (
        LATCHED_BY_DEFAULT
    )
    stale_latch_cycles: Annotated[int, limits(ge=1, le=1_000_000)] | None = None
    deviation_sigmas: Annotated[float, limits(ge=1.0, le=100.0)] = 3.0
    deviation_s: Annotated[float, limits("s", ge=0.01, le=60.0)] = 1.0
    plausibility: PlausibilityLimits | None = field(default_factory=PlausibilityLimits)

    def __post_init__(self) -> None:
        check(self, "safety")
        if self.stale_latch_cycles is not None:
            object.__setattr__(self, "latch", self.latch | faults.STALE)


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
    """Section `realtime`: real-time settings of the loop; those that the kernel refuses are logged."""

    priority: Annotated[int, limits(ge=0, le=98)] = 80
    cpu: Annotated[int, limits(ge=0, le=4095)] | None = None
    lock_memory: bool = True


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """Section `contact`: torque rate and contact of every joint (docs/estimator.md); without the section none is detected.

    Attributes:
        threshold_nm: external torque of a contact; None: 5 % of the joint's rated torque.
        opposed: joints 1 and 2, and 3 and 4, turn one link against each other, as on a towing bench.
        pdo: send 380h and 480h + node_id; without, contacts are in the log only.
    """

    threshold_nm: Annotated[float, limits("Nm", gt=0.0, le=1e4)] | None = None
    opposed: bool = False
    pdo: bool = True

    def __post_init__(self) -> None:
        check(self, "contact")

    def threshold_of(self, rated_torque_nm: float) -> float:
        """Return the threshold of a joint [Nm]."""
        return CONTACT_THRESHOLD * rated_torque_nm if self.threshold_nm is None else self.threshold_nm


@dataclass(frozen=True)
class Ros2Settings:
    """Section `ros2`: publisher for ROS 2 (docs/ros2.md).

    Attributes:
        domain_id: DDS domain; None: that of ROS_DOMAIN_ID, else 0.
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
class ConfigFile:
    """A whole configuration file."""

    node_id: NodeId
    joint_1: JointSection
    joint_2: JointSection | None = None
    joint_3: JointSection | None = None
    joint_4: JointSection | None = None
    role: Annotated[str, choice(ROLES)] = MASTER
    bitrate: Annotated[int, limits(ge=10_000, le=1_000_000)] = 1_000_000
    sync: _Sync = _Sync()
    inputs: _Inputs = _Inputs()
    nodes: _Nodes = _Nodes()
    estimator: _Estimator = field(default_factory=_Estimator)
    safety: SafetySettings = field(default_factory=SafetySettings)
    sensor: SensorSection | None = None
    realtime: Realtime = field(default_factory=Realtime)
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    metrics: _Metrics | None = None
    ros2: Ros2Settings | None = None
    contact: ContactSettings | None = None

    def __post_init__(self) -> None:
        for key, found, expected in chain(self._wrong_numbers(), self._wrong_nodes(), self._wrong_features()):
            raise FieldError("configuration", key, found, expected)

    @property
    def joints(self) -> tuple[JointSection, ...]:
        """Sections `joint_1`, `joint_2`, ... as far as there are any."""
        every = self.joint_1, self.joint_2, self.joint_3, self.joint_4
        return tuple(joint for joint in every if joint is not None)

    @property
    def wait_us(self) -> float:
        """Time after SYNC at which the loop first reads its inputs."""
        return 0.5 * self.sync.period_us if self.inputs.wait_us is None else self.inputs.wait_us

    @property
    def deadline_us(self) -> float:
        """Time after SYNC at which missing inputs count as missing."""
        return 0.85 * self.sync.period_us if self.inputs.deadline_us is None else self.inputs.deadline_us

    def _wrong_numbers(self) -> Iterator[tuple[str, object, str]]:
        """Yield key, value and expectation of each mistake; the others of this name as well.

        Joints are numbered without a gap: the numbers are those of the estimate PDOs and of the log's topics.
        """
        for number in range(1, len(self.joints) + 1):
            if getattr(self, f"joint_{number}") is None:
                yield f"joint_{number}", "none", f"joint_1 to joint_{len(self.joints)} without a gap"
        period_us = self.sync.period_us
        for key, value, low, high in (
            ("wait_us", self.wait_us, 50, period_us),
            ("deadline_us", self.deadline_us, self.wait_us, 0.95 * period_us),
        ):
            if not low <= value <= high:
                yield f"inputs.{key}", value, range_text("a number in us", low, high, None)

    def _wrong_nodes(self) -> Iterator[tuple[str, object, str]]:
        channels = [] if self.sensor is None else list(range(1, self.sensor.channels + 1))
        nodes = {}
        for number, joint in enumerate(self.joints, start=1):
            nodes[f"joint_{number}.node"] = joint.node
            if joint.sensor_channel not in (None, *channels):
                of_sensor = f"one of the sensor's channels {channels}"
                expected = of_sensor if channels else "no channel without a sensor"
                yield f"joint_{number}.sensor_channel", joint.sensor_channel, expected
        if self.sensor is not None:
            nodes["sensor.node"] = self.sensor.node
        users = {self.node_id: "node_id"}
        for key, node in nodes.items():
            if node in users:
                yield key, node, f"a node-ID not used by {users[node]}"
            users[node] = key

    def _wrong_features(self) -> Iterator[tuple[str, object, str]]:
        sent, shadow = self.estimator.method, self.estimator.shadow
        others = [name for name in METHODS if name != sent]
        if not set(shadow) <= set(others) or len(set(shadow)) != len(shadow):
            expected = f"a list of {', '.join(others)}, each at most once: {sent} is the method that is sent"
            yield "estimator.shadow", list(shadow), expected
        if self.ros2 is not None:
            sections = [f"joint_{number}" for number in range(1, len(self.joints) + 1)]
            for section in self.ros2.names:
                if section not in sections:
                    yield f"ros2.names.{section}", Verbatim("that joint"), "one of " + ", ".join(sections)
            names = self.ros2.names_of(len(sections))
            for n, name in enumerate(names):
                if name in names[:n]:
                    yield f"ros2.names.{sections[n]}", name, "a name of its own"
        if self.contact is not None:
            method, period_us, count = self.estimator.method, self.sync.period_us, len(self.joints)
            if not METHODS[method].with_torsion:
                yield "estimator.method", method, "fused, because section contact needs its torsion"
            if period_us > LONGEST_CONTACT_PERIOD_US:
                bound = f"at most {LONGEST_CONTACT_PERIOD_US} us with section contact"
                yield "sync.period_us", period_us, f"{bound}: a slower cycle sees no contact in time"
            if self.contact.opposed and count % 2:
                expected = f"false with {count} joints: opposed are joints 1 and 2, 3 and 4"
                yield "contact.opposed", True, expected


DEFAULT_CONFIG: Final = "bench.yaml"
MAX_COUNTER: Final = 240
"""Of SYNC (CiA 301, 7.2.5.3)."""
_LARGEST_NETWORK: Final = 64_000_000
"""Bytes; ours have 50 000."""


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
    """Values of objects that the drive lacks, for the boot, e.g. {"6091h:1": 100}."""
    joint_path: Path
    joint: Joint
    network: NetworkFile | None
    sensor_channel: int | None
    temperature: Temperature | None
    """Object of the joint's temperature, which the drive sends by TPDO3; None: it sends none."""
    mandatory: bool
    """jtqd does not start without it."""
    sdo_timeout_ms: int
    """Silence of the drive after which an SDO request is repeated."""
    objects: DriveObjects
    """Which objects of the drive are mapped, with sign and factor."""
    tpdos: tuple[PdoMap, ...]
    """TPDOs that carry them: configured ones, and after the boot those in force (`as_booted`)."""
    max_age_ms: float
    """Longest age of a frame of a TPDO with transmission type 0, 254 or 255; 0: such a TPDO is not used."""
    shadow_networks: Mapping[str, NetworkFile] = field(default_factory=dict)
    joint_data: bytes = field(default=b"", repr=False)
    """The joint file as it was read, for the log."""
    profile: str | None = None
    """Of the drive's family."""
    profile_path: Path | None = None
    profile_data: bytes = field(default=b"", repr=False)
    """The profile as it was read, for the log."""
    eds: Path | None = None
    pinned: bool = False
    """The configuration names its TPDOs."""

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
    eds: Path | None = None


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
    """Silence after which a node is lost (1016h of jtqd)."""
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
    """None: no ROS 2, unless the command line asks for it."""
    contact: ContactSettings | None = None
    """None: contacts are not detected."""
    shadow: tuple[str, ...] = ()
    """Methods of every joint that are computed and never sent."""
    role: str = MASTER

    @property
    def shadows(self) -> tuple[Config, ...]:
        """Return for each shadow method the configuration that would send it."""
        return tuple(
            replace(
                self,
                estimator=replace(self.estimator, method=name),
                joints=tuple(replace(each, network=each.shadow_networks.get(name)) for each in self.joints),
                shadow=(),
            )
            for name in self.shadow
        )

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


def as_booted(config: Config, nodes: Mapping[str, Mapping[str, Any]]) -> Config:
    """Return the configuration with the TPDOs that the drives have.

    nodes: of the boot report, or of a log's provenance, by node-ID; a drive that is not in it keeps the configured ones.
    Raises PdoError, LayoutError, KeyError or TypeError for anything but such a report.
    """

    def of(joint: JointConfig) -> JointConfig:
        booted = nodes.get(str(joint.node_id))
        if booted is None or "tpdos" not in booted:
            return joint
        maps = maps_of_json(joint.node_id, booted["tpdos"], joint.objects)
        return replace(joint, tpdos=select_tpdos(joint.objects, maps))

    return replace(config, joints=tuple(of(joint) for joint in config.joints))


def load_config(path: Path | str | None, role: str | None = None) -> Config:
    """Read and check a configuration; None is the shipped bench configuration. role: in place of the file's.

    Raises:
        ConfigError: one line naming file, key, what was found and what was expected.
    """
    path = shipped(DEFAULT_CONFIG) if path is None else Path(path)
    mapping, data = read_yaml(path)
    with in_file(str(path)):
        _check_one_sensor(mapping)
        file = read(ConfigFile, with_profiles(mapping, path))
        joints = tuple(_joint(path, number, file) for number in range(1, len(file.joints) + 1))
    _check_contact(path, file.contact, joints)
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
        error_behaviour=ERROR_BEHAVIOURS.index(file.nodes.error_behaviour),
        emcy_inhibit_ms=file.nodes.emcy_inhibit_ms,
        boot_timeout_s=file.nodes.boot_timeout_s,
        reset_communication=file.nodes.reset_communication,
        estimator=EstimatorSettings(
            **{each.name: getattr(file.estimator, each.name) for each in fields(EstimatorSettings)}
        ),
        safety=file.safety,
        joints=joints,
        sensor=None if file.sensor is None else _sensor(file.sensor, file.nodes.sdo_timeout_ms, path),
        realtime=file.realtime,
        recording=file.recording,
        metrics_file=None if file.metrics is None else Path(file.metrics.file),
        ros2=file.ros2,
        contact=file.contact,
        shadow=file.estimator.shadow,
        role=role or file.role,
    )


def _check_one_sensor(mapping: Mapping[str, object]) -> None:
    """Refuse a second sensor node by what it is, not as an unknown key. Raises FieldError."""
    for key, value in mapping.items():
        more = (
            isinstance(key, str) and key.startswith(("sensor_", "sensors")) and isinstance(value, dict | list)
        )
        if more or (key == "sensor" and isinstance(value, list)):
            found = Verbatim("a second sensor or a list")
            expected = (
                "one section 'sensor': a bus has one sensor node with 1 or 2 channels (docs/deployment.md)"
            )
            raise FieldError("configuration", key, found, expected)


def _sensor(section: SensorSection, sdo_timeout_ms: int, path: Path) -> SensorConfig:
    return SensorConfig(
        node_id=section.node,
        identity=section.identity,
        channels=tuple(range(1, section.channels + 1)),
        given=_whole(section.given),
        unit_words=dict(section.unit_words),
        mandatory=section.mandatory,
        sdo_timeout_ms=section.sdo_timeout_ms or sdo_timeout_ms,
        eds=path.parent / section.eds if section.eds else None,
    )


def _joint(path: Path, number: int, file: ConfigFile) -> JointConfig:
    """Read the files of a section `joint_N`: the joint file and the networks of the methods that use one.

    Raises FieldError for the section, ConfigError for the files.
    """
    section, sent = file.joints[number - 1], file.estimator.method
    joint_path = path.parent / section.file
    profile_path = None if section.profile is None else path_of(section.profile, path.parent)
    with below(f"joint_{number}"):
        objects = section.objects.of_drive()
        network = None if section.network is None else _network(section.network, path)
        mapping, data = read_yaml(joint_path)
        joint = Joint.from_mapping(mapping, str(joint_path))
        network = network if METHODS[sent].network else None
        shadows = _shadow_networks(section, file.estimator.shadow, path)
        for name in (sent, *file.estimator.shadow):
            used = network if name == sent else shadows.get(name)
            key = "network" if name == sent else f"shadow_networks.{name}"
            where, verb = ("estimator.method", "is") if name == sent else ("estimator.shadow", "has")
            because = f"because {where} {verb} {name}"
            if METHODS[name].network_required and used is None:
                raise FieldError("joint", key, MISSING, f"file and sha256 {because}")
            for needed in METHODS[name].sections:
                if getattr(joint, needed) is None:
                    raise ConfigError(f"{joint_path}: key '{needed}': missing, expected {because}")
            _check_encoders(where, name, objects, joint, used)
        tpdos = tpdos_of(
            section.node,
            objects,
            section.tpdos,
            acyclic=section.max_age_ms is not None,
            temperature=section.temperature,
        )
    return JointConfig(
        number=number,
        node_id=section.node,
        identity=section.identity,
        given=_whole(section.given),
        joint_path=joint_path,
        joint=joint,
        network=network,
        sensor_channel=section.sensor_channel,
        temperature=section.objects.of_joint if section.temperature else None,
        mandatory=section.mandatory,
        sdo_timeout_ms=section.sdo_timeout_ms or file.nodes.sdo_timeout_ms,
        objects=objects,
        tpdos=tpdos,
        max_age_ms=section.max_age_ms or 0.0,
        shadow_networks=shadows,
        joint_data=data,
        profile=section.profile,
        profile_path=profile_path,
        profile_data=b"" if profile_path is None else read_yaml(profile_path)[1],
        eds=path.parent / section.eds if section.eds else None,
        pinned=bool(section.tpdos),
    )


def _check_contact(path: Path, contact: ContactSettings | None, joints: tuple[JointConfig, ...]) -> None:
    """Refuse section `contact` for a joint without a torsion. Raises ConfigError."""
    for joint in joints if contact is not None else ():
        if joint.joint.fused is None or joint.joint.fused.torsion is None:
            raise ConfigError(
                f"{joint.joint_path}: key 'fused.torsion': missing, expected because of section contact of {path}"
            )


def _whole(values: Mapping[str, float]) -> dict[str, int]:
    return {name: int(value) for name, value in values.items()}


def _shadow_networks(section: JointSection, shadow: tuple[str, ...], path: Path) -> dict[str, NetworkFile]:
    """Return the networks of a joint's shadow methods. Raises FieldError for one of a method that uses none."""
    users = [name for name, method in METHODS.items() if method.network]
    for name in {*section.shadow_networks} - {*users}:
        key, expected = f"shadow_networks.{name}", f"one of {', '.join(users)}"
        raise FieldError("joint", key, Verbatim("a network"), expected)
    return {name: _network(each, path) for name, each in section.shadow_networks.items() if name in shadow}


def _check_encoders(
    where: str, method: str, objects: DriveObjects, joint: Joint, network: NetworkFile | None
) -> None:
    """Refuse a method that needs the link position of a drive without one. Raises FieldError."""
    torsion, needs = METHODS[method].torsion_of(joint) is not None, METHODS[method].network_required
    if objects.link_position is None and (torsion or (network is not None and needs)):
        use = "estimates from the torsion of the gear" if torsion else "uses a network with the link position"
        expected = f"a link position because {where} {method} {use}; tob and efficiency do without"
        raise FieldError("joint", "objects.link_position", Verbatim("false"), expected)


def _network(section: NetworkSection, path: Path) -> NetworkFile:
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
