"""Configuration of jtqd: read once into frozen, validated objects.

Unknown keys and wrong values are errors of one line that name the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from daemon.config_nodes import (
    MAX_NODE_ID,
    Identity,
    JointConfig,
    NetworkFile,
    SensorConfig,
    check_node_ids,
    read_joint,
    read_sensor,
    section_of,
)
from daemon.recording.settings import RecordingSettings
from daemon.safety_settings import SafetySettings
from estimator.checked import ConfigError, Section
from estimator.settings import EstimatorSettings
from models.files import read_yaml, shipped

__all__ = ["Config", "Identity", "JointConfig", "NetworkFile", "Realtime", "SensorConfig", "load_config"]

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
