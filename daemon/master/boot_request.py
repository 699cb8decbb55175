"""What the boot process is asked to do: `python -m drivers.boot` gets this as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from daemon.config import Config

_OWN_EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds" / "jtqd.eds"


def boot_request(config: Config, bus: str, only: int | None = None) -> dict[str, Any]:
    """Request for all nodes, or for the one that came back while our own SYNC is running."""
    nodes: list[dict[str, Any]] = [
        {
            "node": joint.node_id,
            "kind": "drive",
            "identity": asdict(joint.identity),
            "given": joint.given,
            "temperature": joint.temperature,
            "mandatory": joint.mandatory or only is not None,
        }
        for joint in config.joints
    ]
    if config.sensor is not None:
        sensor = config.sensor
        nodes.append(
            {
                "node": sensor.node_id,
                "kind": "sensor",
                "identity": asdict(sensor.identity),
                "channels": list(sensor.channels),
                "given": sensor.given,
                "unit_words": sensor.unit_words,
                "mandatory": sensor.mandatory or only is not None,
            }
        )
    return {
        "bus": bus,
        "nodes": [node for node in nodes if only in (None, node["node"])],
        "master_node": config.node_id,
        "own_eds": str(_OWN_EDS),
        "heartbeat_ms": config.heartbeat_ms,
        "error_behaviour": config.error_behaviour,
        # Drives that watch our heartbeat allow two to be lost.
        "master_timeout_ms": min(max(500, 3 * config.heartbeat_ms), 0xFFFF),
        # In service the node has just been heard.
        "answer_timeout_s": config.boot_timeout_s if only is None else min(config.boot_timeout_s, 0.5),
        "sync": {"counter_overflow": config.counter_overflow, "check_foreign": only is None},
    }
