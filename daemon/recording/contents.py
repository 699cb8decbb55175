"""Request for the recorder: what a log must carry to be understood without the machine that wrote it."""

from __future__ import annotations

import base64
import hashlib
import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from daemon.config import Config
from daemon.recording.dbc import dbc_text

_EDS_DIRECTORY = Path(__file__).resolve().parents[2] / "drivers" / "eds"
_PACKAGES = ("jtqd", "numpy", "onnxruntime", "python-can", "canopen", "mcap")


def recording_request(
    config: Config,
    report: dict[str, Any],
    *,
    directory: Path,
    ring: Path,
    progress: Path,
    snapshot: Path,
    notices: Path,
    instance: str,
) -> dict[str, Any]:
    """Request for the recorder process: configuration, joint files, EDS, DBC, networks and versions attached.

    Args:
        config: configuration in force.
        report: boot report with the scaling read from the devices.
        directory: where logs go.
        ring: the loop's ring of cycle records.
        progress: file in which the recorder says how far it is.
        snapshot: the loop's counters.
        notices: what the supervisor says.
        instance: name of the bus as it can stand in a file name.
    """
    attachments: list[dict[str, str]] = [
        {"name": "configuration.yaml", "media_type": "application/yaml", "text": config.text},
        {"name": "bus.dbc", "media_type": "text/plain", "text": dbc_text(config, report)},
        {
            "name": "provenance.json",
            "media_type": "application/json",
            "text": json.dumps(_provenance(config, report)),
        },
    ]
    # By their content: what is in force, whatever becomes of the files, even if the recorder must be started again.
    for name, kind, data in _attached_files(config):
        attachments.append(
            {"name": name, "media_type": kind, "base64": base64.b64encode(data).decode("ascii")}
        )
    attachments += [
        {"name": path.name, "media_type": "text/plain", "path": str(path)}
        for path in sorted(_EDS_DIRECTORY.glob("*.eds"))
    ]
    settings = config.recording
    return {
        "ring": str(ring),
        "progress": str(progress),
        "snapshot": str(snapshot),
        "notices": str(notices),
        "bus": instance,
        "nodes": nodes_of(config),
        "chunk_s": settings.chunk_s,
        "rotate_s": settings.rotate_s,
        "rotate_mb": settings.rotate_mb,
        "budget_mb": settings.budget_mb,
        "keep_run": settings.keep_run,
        "reserve_mb": settings.reserve_mb,
        "flight_recorder_s": settings.flight_recorder_s,
        "directory": str(directory),
        "prefix": f"jtqd-{instance}",
        "attachments": attachments,
        "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
    }


def nodes_of(config: Config) -> list[tuple[int, str]]:
    """(node-ID, name) of the nodes whose heartbeats /diagnostics shows."""
    nodes = [(joint.node_id, f"drive {joint.number}") for joint in config.joints]
    return nodes if config.sensor is None else [*nodes, (config.sensor.node_id, "torque sensor")]


def _attachment_names(config: Config) -> dict[Path, str]:
    """Names of joint files and networks in the log: their own, unless two of them are called the same."""
    names: dict[Path, str] = {}
    for joint in config.joints:
        for path in (joint.joint_path, *([joint.network.path] if joint.network else [])):
            if path not in names:
                taken = path.name in names.values()
                names[path] = f"joint_{joint.number}.{path.name}" if taken else path.name
    return names


def _attached_files(config: Config) -> list[tuple[str, str, bytes]]:
    """(name, media type, content) of joint files and networks."""
    names = _attachment_names(config)
    found: dict[str, tuple[str, bytes]] = {}
    for joint in config.joints:
        found.setdefault(names[joint.joint_path], ("application/yaml", joint.joint_data))
        if joint.network:
            found.setdefault(names[joint.network.path], ("application/octet-stream", joint.network.data))
    return [(name, kind, data) for name, (kind, data) in found.items()]


def _provenance(config: Config, report: dict[str, Any]) -> dict[str, Any]:
    names = _attachment_names(config)
    return {
        "configuration": {"path": str(config.path), "sha256": config.sha256},
        "method": config.estimator.method,
        "joints": {
            str(joint.number): {
                "file": names[joint.joint_path],
                "file_sha256": hashlib.sha256(joint.joint_data).hexdigest(),
                "network": names[joint.network.path] if joint.network else None,
                "network_sha256": joint.network.sha256 if joint.network else None,
            }
            for joint in config.joints
        },
        "nodes": report["nodes"],
        "versions": {name: _version(name) for name in _PACKAGES} | {"python": platform.python_version()},
        "kernel": platform.release(),
        "machine": platform.machine(),
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except ImportError:
        return "not installed"
