"""Request for the recorder: what a log must carry to be understood without the machine that wrote it."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from daemon.config import Config
from daemon.dbc import dbc_text

_EDS_DIRECTORY = Path(__file__).resolve().parent.parent / "drivers" / "eds"
_PACKAGES = ("jtqd", "numpy", "onnxruntime", "python-can", "canopen", "mcap")


def recording_request(
    config: Config,
    report: dict[str, Any],
    *,
    directory: Path,
    ring: Path,
    progress: Path,
    snapshot: Path,
    instance: str,
) -> dict[str, Any]:
    """Request for `python -m daemon.recorder`: configuration, joint files, EDS, DBC, networks and versions attached.

    Args:
        config: configuration in force.
        directory: where logs go.
        ring: the loop's ring of cycle records.
        snapshot: the loop's counters.
        progress: file in which the recorder says how far it is.
        instance: name of the bus as it can stand in a file name.
        report: boot report with the scaling read from the devices.
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
    attachments += [
        _file(path, "application/yaml") for path in dict.fromkeys(j.joint_path for j in config.joints)
    ]
    networks = dict.fromkeys(joint.network.path for joint in config.joints if joint.network)
    attachments += [_file(path, "application/octet-stream") for path in networks]
    attachments += [_file(path, "text/plain") for path in sorted(_EDS_DIRECTORY.glob("*.eds"))]
    return {
        "ring": str(ring),
        "progress": str(progress),
        "snapshot": str(snapshot),
        "directory": str(directory),
        "prefix": f"jtqd-{instance}",
        "attachments": attachments,
        "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
    }


def _file(path: Path, media_type: str) -> dict[str, str]:
    return {"name": path.name, "media_type": media_type, "path": str(path)}


def _provenance(config: Config, report: dict[str, Any]) -> dict[str, Any]:
    return {
        "configuration": {"path": str(config.path), "sha256": config.sha256},
        "method": config.estimator.method,
        "joints": {
            str(joint.number): {
                "file": joint.joint_path.name,
                "network": joint.network.path.name if joint.network else None,
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
