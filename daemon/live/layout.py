"""Layout of Foxglove and Lichtblick for jtqd's topics: what their "Import from file..." takes. Pure.

The messages hold torque, sigma and sensor torque; a viewer's message path cannot add two fields. So the layout
brings user scripts (`daemon.live.layout_scripts`), which the viewer runs itself, on a file as on the live view:
they make the sigma band, the residual to the sensor and the cycle time, and cost no byte in the log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from daemon.live.layout_scripts import CYCLE_TOPIC, JOINT_TOPICS, scripts
from daemon.recording import schemas

_JOINTS = {1: schemas.JOINT_1.name, 2: schemas.JOINT_2.name}
_FRAMES = schemas.CAN_FRAMES.name

_BLUE, _PALE_BLUE, _ORANGE, _GREEN, _RED, _PURPLE = (
    "#4e98e2",
    "#a8cdf2",
    "#f5774d",
    "#5cd6a9",
    "#e25a5a",
    "#a395e2",
)

Node = str | dict[str, Any]
"""A panel's identifier, or a split with `first` and `second`."""


def _series(path: str, label: str, color: str, width: float = 1.0) -> dict[str, Any]:
    return {
        "value": path,
        "label": label,
        "color": color,
        "enabled": True,
        "timestampMethod": "receiveTime",
        "lineSize": width,
        "showLine": True,
    }


def _plot(title: str, *series: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": list(series),
        "isSynced": True,
        "xAxisVal": "timestamp",
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "sidebarDimension": 240,
    }


def _transitions(title: str, paths: Mapping[str, str]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "isSynced": True,
        "paths": [
            {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
            for label, path in paths.items()
        ],
    }


def _torque_panels(joint: int) -> dict[str, dict[str, Any]]:
    state, made = _JOINTS[joint], JOINT_TOPICS[joint]
    return {
        f"Plot!torque{joint}": _plot(
            f"Joint {joint}: torque, Nm",
            # Drawn from the last to the first: the estimate lies on top.
            _series(f"{state}.torque_nm", "estimate", _BLUE, 1.5),
            _series(f"{state}.sensor_torque_nm", "sensor", _ORANGE),
            _series(f"{made}.upper_nm", "estimate + sigma", _PALE_BLUE),
            _series(f"{made}.lower_nm", "estimate - sigma", _PALE_BLUE),
        ),
        f"Plot!residual{joint}": _plot(
            f"Joint {joint}: estimate - sensor, Nm",
            _series(f"{made}.residual_nm", "residual", _RED),
            _series(f"{state}.sigma_nm", "sigma", _PALE_BLUE),
            _series(f"{made}.minus_sigma_nm", "- sigma", _PALE_BLUE),
        ),
    }


def _stage_panels(joint: int) -> dict[str, dict[str, Any]]:
    state = _JOINTS[joint]
    return {
        f"Plot!stages{joint}": _plot(
            f"Joint {joint}: stages of the estimate, Nm",
            _series(f"{state}.torque_nm", "published", _BLUE, 1.5),
            _series(f"{state}.physics_nm", "with losses", _GREEN),
            _series(f"{state}.tob_nm", "observer alone", _PURPLE),
            _series(f"{state}.network_nm", "network", _PALE_BLUE),
        ),
        f"Plot!inputs{joint}": _plot(
            f"Joint {joint}: current, velocity, temperature",
            _series(f"{state}.current_a", "current, A", _ORANGE),
            _series(f"{state}.motor_velocity_rad_s", "motor velocity, rad/s", _BLUE),
            _series(f"{state}.temperature_c", "temperature, degC", _RED),
        ),
    }


def _cycle_panels() -> dict[str, dict[str, Any]]:
    return {
        "Plot!cycle": _plot(
            "Time from SYNC to SYNC, us", _series(f"{CYCLE_TOPIC}.period_us", "cycle time", _BLUE)
        ),
        "Plot!work": _plot(
            "Work and lateness of each cycle, us",
            _series(f"{CYCLE_TOPIC}.work_us", "work", _GREEN),
            _series(f"{CYCLE_TOPIC}.late_us", "SYNC late", _ORANGE),
        ),
        "Plot!counts": _plot(
            "Frames and inputs",
            _series(f"{_FRAMES}.frame_count", "frames in the cycle", _BLUE),
            _series(f"{_FRAMES}.stale_inputs", "stale inputs", _RED),
            _series(f"{_FRAMES}.late_frames", "late frames", _ORANGE),
            _series(f"{_FRAMES}.missed", "slots missed so far", _PURPLE),
        ),
    }


def _side_panels() -> dict[str, dict[str, Any]]:
    topic = schemas.DIAGNOSTICS.name
    return {
        "DiagnosticSummary!summary": {
            "foxglovePanelTitle": "Diagnostics",
            "minLevel": 0,
            "pinnedIds": [],
            "hardwareIdFilter": "",
            "sortByLevel": True,
            "topicToRender": topic,
        },
        "RosOut!log": {
            "foxglovePanelTitle": "Log",
            "searchTerms": [],
            "minLogLevel": 1,
            "topicToRender": schemas.LOG.name,
        },
        "RawMessages!event": {
            "foxglovePanelTitle": "Last event",
            "topicPath": schemas.EVENTS.name,
            "diffEnabled": False,
            "diffMethod": "custom",
            "diffTopicPath": "",
            "showFullMessageForDiff": False,
        },
    }


def _split(direction: str, nodes: Sequence[Node]) -> Node:
    """Nodes of equal size side by side ("row") or one above the other ("column")."""
    if len(nodes) == 1:
        return nodes[0]
    return {
        "direction": direction,
        "first": nodes[0],
        "second": _split(direction, nodes[1:]),
        "splitPercentage": 100.0 / len(nodes),
    }


def _joint_columns(upper: str, lower: str) -> Node:
    return _split(
        "row", [_split("column", [f"Plot!{upper}{joint}", f"Plot!{lower}{joint}"]) for joint in _JOINTS]
    )


def layout(follow_s: float | None = None) -> dict[str, Any]:
    """The layout as a tree for `json.dumps`: panels by identifier, user scripts, and how they are arranged.

    Args:
        follow_s: plots show this many seconds up to the newest message; None: everything there is.
    """
    panels: dict[str, dict[str, Any]] = {}
    for joint in _JOINTS:
        panels |= _torque_panels(joint) | _stage_panels(joint)
    panels |= _cycle_panels() | _side_panels()
    panels["StateTransitions!status"] = _transitions(
        "Status", {f"joint {joint}": f"{topic}.status" for joint, topic in _JOINTS.items()}
    )
    panels["StateTransitions!drives"] = _transitions(
        "Drives and sensor",
        {f"statusword {joint}": f"{topic}.statusword" for joint, topic in _JOINTS.items()}
        | {"sensor": f"{_JOINTS[1]}.sensor_status", "event": f"{schemas.EVENTS.name}.kind"},
    )
    if follow_s is not None:
        for name, panel in panels.items():
            if name.startswith("Plot!"):
                panel["followingViewWidth"] = follow_s
    torque: Node = {
        "direction": "column",
        "first": _joint_columns("torque", "residual"),
        "second": "StateTransitions!status",
        "splitPercentage": 78.0,
    }
    inputs: Node = {
        "direction": "column",
        "first": _joint_columns("stages", "inputs"),
        "second": "StateTransitions!drives",
        "splitPercentage": 68.0,
    }
    panels["Tab!main"] = {
        "activeTabIdx": 0,
        "tabs": [
            {"title": "Torque", "layout": torque},
            {"title": "Inputs", "layout": inputs},
            {"title": "Cycle", "layout": _split("column", ["Plot!cycle", "Plot!work", "Plot!counts"])},
        ],
    }
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": scripts(),
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": "Tab!main",
            "second": _split("column", list(_side_panels())),
            "splitPercentage": 72.0,
        },
    }
