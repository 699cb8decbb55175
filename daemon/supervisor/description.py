"""Description of the running daemon for `about.json`, from its configuration."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

from jtqd.daemon.config import Config, JointConfig
from jtqd.daemon.core.input_pdos import input_pdos, names_of_inputs, sensor_index
from jtqd.daemon.shared.runtime_dir import About, AboutJoint, start_ticks, versions
from jtqd.drivers.drive import tpdos_as_json


def about(config: Config, *, bus: str, instance: str, log_directory: Path | None) -> About:
    """Describe this process: a daemon on `bus` that logs to `log_directory` (None: nowhere)."""
    names = tuple(pdo.name for pdo in input_pdos(config))
    return About(
        bus=bus,
        instance=instance,
        pid=os.getpid(),
        started=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        started_ticks=start_ticks(os.getpid()) or 0,
        configuration=str(config.path.resolve()),
        configuration_sha256=config.sha256,
        method=config.estimator.method,
        node=config.node_id,
        bitrate=config.bitrate,
        period_us=config.period_ns // 1000,
        deadline_us=config.input_deadline_ns / 1000,
        heartbeat_ms=config.heartbeat_ms,
        joints=tuple(_joint(config, number, joint, names) for number, joint in enumerate(config.joints)),
        sensor_node=config.sensor.node_id if config.sensor else None,
        inputs=names,
        log_directory=str(log_directory.resolve()) if log_directory else None,
        log_prefix=f"jtqd-{instance}-",
        versions=versions() | {"kernel": platform.release()},
        tpdos={str(joint.node_id): tpdos_as_json(joint.tpdos) for joint in config.joints},
    )


def _joint(config: Config, number: int, joint: JointConfig, names: tuple[str, ...]) -> AboutJoint:
    sensor = sensor_index(config, joint.sensor_channel)
    rated = joint.joint.rated_torque_nm
    return AboutJoint(
        number=joint.number,
        name=joint.joint.name,
        node=joint.node_id,
        rated_torque_nm=rated,
        torque_limit_nm=config.estimator.torque_limit * rated,
        network=joint.network.path.name if joint.network else None,
        network_limit_nm=config.estimator.network_limit * rated,
        inputs=names_of_inputs(config, number),
        sensor=None if sensor is None else names[sensor],
        temperature=joint.temperature is not None,
        contact_threshold_nm=None if config.contact is None else config.contact.threshold_of(rated),
    )
