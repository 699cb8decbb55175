"""Configuration of jtqd: read once into frozen, validated objects.

    YAML -> values of profiles added -> `sections` (types, units, ranges) -> joint files, networks -> `Config`

Unknown keys and wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.config.sections import (
    ERROR_BEHAVIOURS,
    ConfigFile,
    ContactSettings,
    Identity,
    NetworkSection,
    Realtime,
    RecordingSettings,
    Ros2Settings,
    SafetySettings,
    SensorSection,
    tpdos_of,
)
from jtqd.daemon.profiles import path_of, with_profiles
from jtqd.drivers.drive import DriveObjects, Temperature, maps_of_json, select_tpdos
from jtqd.drivers.pdo import PdoMap
from jtqd.estimator.decoder import FieldError, below, in_file, read
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import METHODS, EstimatorSettings
from jtqd.estimator.sha256 import sha256_hex
from jtqd.models.files import read_regular, read_yaml, shipped

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


def load_config(path: Path | None) -> Config:
    """Read and check a configuration; None is the shipped bench configuration.

    Raises:
        ConfigError: one line naming file, key, what was found and what was expected.
    """
    if path is None:
        path = shipped(DEFAULT_CONFIG)
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
        estimator=file.estimator,
        safety=file.safety,
        joints=joints,
        sensor=None if file.sensor is None else _sensor(file.sensor, file.nodes.sdo_timeout_ms),
        realtime=file.realtime,
        recording=file.recording,
        metrics_file=None if file.metrics is None else Path(file.metrics.file),
        ros2=file.ros2,
        contact=file.contact,
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


def _sensor(section: SensorSection, sdo_timeout_ms: int) -> SensorConfig:
    return SensorConfig(
        node_id=section.node,
        identity=section.identity,
        channels=tuple(range(1, section.channels + 1)),
        given=_whole(section.given),
        unit_words=dict(section.unit_words),
        mandatory=section.mandatory,
        sdo_timeout_ms=section.sdo_timeout_ms or sdo_timeout_ms,
    )


def _joint(path: Path, number: int, file: ConfigFile) -> JointConfig:
    """Read the files of a section `joint_N`: the joint file and, where the method uses one, the network.

    Raises FieldError for the section, ConfigError for the files.
    """
    section, method = file.joints[number - 1], METHODS[file.estimator.method]
    joint_path = path.parent / section.file
    profile_path = None if section.profile is None else path_of(section.profile, path.parent)
    with below(f"joint_{number}"):
        objects = section.objects.of_drive()
        network = None if section.network is None else _network(section.network, path)
        mapping, data = read_yaml(joint_path)
        joint = Joint.from_mapping(mapping, str(joint_path))
        because = f"because estimator.method is {file.estimator.method}"
        if method.network_required and network is None:
            raise FieldError("joint", "network", MISSING, f"file and sha256 {because}")
        for needed in method.sections:
            if getattr(joint, needed) is None:
                raise ConfigError(f"{joint_path}: key '{needed}': missing, expected {because}")
        network = network if method.network else None
        _check_encoders(file.estimator.method, objects, joint, network)
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
        joint_data=data,
        profile=section.profile,
        profile_path=profile_path,
        profile_data=b"" if profile_path is None else read_yaml(profile_path)[1],
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


def _check_encoders(method: str, objects: DriveObjects, joint: Joint, network: NetworkFile | None) -> None:
    """Refuse a method that needs the link position of a drive without one. Raises FieldError."""
    torsion = METHODS[method].torsion_of(joint) is not None
    if objects.link_position is None and (torsion or network is not None):
        use = "estimates from the torsion of the gear" if torsion else "uses a network with the link position"
        expected = f"a link position because estimator.method {method} {use}; tob and efficiency do without"
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
