"""`jtq layout`: layout of Foxglove and Lichtblick for jtqd's topics, as their "Import from file..." takes it.

The messages hold torque, sigma and sensor torque; a viewer's message path cannot add two fields. So the layout
brings user scripts, which the viewer compiles and runs itself, on a file as on the live view: they make the sigma band, the
residual to the sensor, whether there is a contact, and the cycle time, and cost no byte in the log. They are TypeScript:
`inputs`, `output` (a topic below /studio_script/) and a default export that turns one message into one message.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from jtqd.daemon.recording import schemas
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN, MOST_JOINTS
from jtqd.estimator.checked import seconds

# ---- user scripts ----

_PREFIX = "/studio_script/"
JOINT_TOPICS = {joint: f"{_PREFIX}joint_{joint}" for joint in range(1, MOST_JOINTS + 1)}
"""Joint -> topic with upper_nm, lower_nm, minus_sigma_nm, residual_nm [Nm], contact (1, 0; NaN: not known)."""
CYCLE_TOPIC = f"{_PREFIX}cycle"
"""Topic with period_us, work_us, late_us [us]."""

_JOINT_SCRIPT = """\
// Sigma band of the estimate, its residual to the torque sensor of the same age, and whether there is a contact. NaN where
// one is not known.
import { Input } from "./types";

type Output = { upper_nm: number; lower_nm: number; minus_sigma_nm: number; residual_nm: number; contact: number };

export const inputs = ["%(state)s"];
export const output = "%(output)s";

export default function script(event: Input<"%(state)s">): Output {
  const message = event.message;
  return {
    upper_nm: message.torque_nm + message.sigma_nm,
    lower_nm: message.torque_nm - message.sigma_nm,
    minus_sigma_nm: -message.sigma_nm,
    residual_nm: message.torque_nm - message.reference_nm,
    contact: (message.input_flags & %(known)d) === 0 ? NaN : (message.input_flags & %(there)d) === 0 ? 0 : 1,
  };
}
"""

_CYCLE_SCRIPT = """\
// Time since the SYNC before, and the cycle's work and lateness, all in us.
import { Input } from "./types";

type Output = { period_us: number; work_us: number; late_us: number };

export const inputs = ["%(frames)s"];
export const output = "%(output)s";

let before_s = 0;
let before_ns = 0;
let before_cycle = 0;

export default function script(event: Input<"%(frames)s">): Output {
  const message = event.message;
  const { sec, nsec } = message.header.stamp;
  const cycle = Number(message.cycle);
  const cycles = cycle - before_cycle;
  const passed_us = (sec - before_s) * 1e6 + (nsec - before_ns) / 1e3;
  before_s = sec;
  before_ns = nsec;
  before_cycle = cycle;
  // After a jump in the file there is nothing to compare with. Missed slots show as a long cycle; the live view
  // leaves out so many cycles that the mean of those between stands for them.
  const known = cycles > 0 && cycles < 1000 && passed_us > 0;
  return {
    period_us: known ? (cycles < 10 ? passed_us : passed_us / cycles) : NaN,
    work_us: message.work_ns / 1e3,
    late_us: message.late_ns / 1e3,
  };
}
"""


def scripts(joints: int = 2) -> dict[str, dict[str, str]]:
    """Identifier -> name and source code, as a layout's `userNodes` holds them."""
    made = {
        f"jtqd-joint-{joint}": {
            "name": f"joint_{joint}",
            "sourceCode": _JOINT_SCRIPT
            % {
                "state": topic.name,
                "output": JOINT_TOPICS[joint],
                "known": FLAG_CONTACT_KNOWN,
                "there": FLAG_CONTACT,
            },
        }
        for joint, topic in enumerate(schemas.joint_topics(joints), start=1)
    }
    cycle = _CYCLE_SCRIPT % {"frames": schemas.CAN_FRAMES.name, "output": CYCLE_TOPIC}
    return made | {"jtqd-cycle": {"name": "cycle", "sourceCode": cycle}}


_JOINTS = {joint: topic.name for joint, topic in enumerate(schemas.joint_topics(MOST_JOINTS), start=1)}
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
            _series(f"{state}.reference_nm", "sensor, as old as the estimate", _ORANGE),
            _series(f"{made}.upper_nm", "estimate + sigma", _PALE_BLUE),
            _series(f"{made}.lower_nm", "estimate - sigma", _PALE_BLUE),
        ),
        f"Plot!residual{joint}": _plot(
            f"Joint {joint}: estimate - sensor of the same age, Nm",
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


def _contact_panels(joint: int) -> dict[str, dict[str, Any]]:
    state, made = _JOINTS[joint], JOINT_TOPICS[joint]
    return {
        f"Plot!contact{joint}": _plot(
            f"Joint {joint}: torque from outside, Nm",
            _series(f"{made}.contact", "contact (1)", _RED, 1.5),
            _series(f"{state}.contact_nm", "from outside", _BLUE),
        ),
        f"Plot!rate{joint}": _plot(
            f"Joint {joint}: torque rate, Nm/s", _series(f"{state}.torque_rate_nm_s", "torque rate", _GREEN)
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


def _joint_columns(upper: str, lower: str, joints: int) -> Node:
    return _split(
        "row",
        [
            _split("column", [f"Plot!{upper}{joint}", f"Plot!{lower}{joint}"])
            for joint in range(1, joints + 1)
        ],
    )


def layout(follow_s: float | None = None, joints: int = 2) -> dict[str, Any]:
    """Return the layout as a tree for `json.dumps`: panels by identifier, user scripts, and how they are arranged.

    Args:
        follow_s: plots show this many seconds up to the newest message; None: everything there is.
        joints: number of them, 1 to 4.
    """
    topics = {joint: _JOINTS[joint] for joint in range(1, joints + 1)}
    panels: dict[str, dict[str, Any]] = {}
    for joint in topics:
        panels |= _torque_panels(joint) | _stage_panels(joint) | _contact_panels(joint)
    panels |= _cycle_panels() | _side_panels()
    panels["StateTransitions!status"] = _transitions(
        "Status", {f"joint {joint}": f"{topic}.status" for joint, topic in topics.items()}
    )
    panels["StateTransitions!drives"] = _transitions(
        "Drives and sensor",
        {f"statusword {joint}": f"{topic}.statusword" for joint, topic in topics.items()}
        | {"sensor": f"{_JOINTS[1]}.sensor_status", "event": f"{schemas.EVENTS.name}.kind"},
    )
    if follow_s is not None:
        for name, panel in panels.items():
            if name.startswith("Plot!"):
                panel["followingViewWidth"] = follow_s
    torque: Node = {
        "direction": "column",
        "first": _joint_columns("torque", "residual", joints),
        "second": "StateTransitions!status",
        "splitPercentage": 78.0,
    }
    inputs: Node = {
        "direction": "column",
        "first": _joint_columns("stages", "inputs", joints),
        "second": "StateTransitions!drives",
        "splitPercentage": 68.0,
    }
    panels["Tab!main"] = {
        "activeTabIdx": 0,
        "tabs": [
            {"title": "Torque", "layout": torque},
            {"title": "Inputs", "layout": inputs},
            {"title": "Contact", "layout": _joint_columns("contact", "rate", joints)},
            {"title": "Cycle", "layout": _split("column", ["Plot!cycle", "Plot!work", "Plot!counts"])},
        ],
    }
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": scripts(joints),
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": "Tab!main",
            "second": _split("column", list(_side_panels())),
            "splitPercentage": 72.0,
        },
    }


# ---- command ----

_EXAMPLES = """examples:
  jtq layout --out jtqd.layout.json     then "Import from file..." in the layouts menu of Foxglove or Lichtblick
  jtq layout --follow 10 > live.layout.json     plots that show the last 10 s, for the live view

The layout works for a recorded file and for the live view of `jtqd --live`."""


def parser() -> argparse.ArgumentParser:
    """Arguments of `jtq layout`."""
    result = argparse.ArgumentParser(
        prog="jtq layout",
        description="Write the layout file for Foxglove and Lichtblick: torque with its sigma band, residual to the "
        "sensor, status, stages, inputs, contacts, cycle time, diagnostics and log.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--out", type=Path, metavar="FILE", help="output file (default: standard output)")
    result.add_argument(
        "--follow", type=seconds, metavar="S", help="plots show the last S seconds (default: everything)"
    )
    result.add_argument(
        "--joints",
        type=int,
        choices=range(1, MOST_JOINTS + 1),
        default=2,
        metavar="N",
        help="joints of the bus, 1 to 4 (default: 2)",
    )
    return result


def main(argv: list[str] | None = None) -> int:
    """Write the layout; returns the exit status."""
    arguments = parser().parse_args(argv)
    text = json.dumps(layout(arguments.follow, arguments.joints), indent=2) + "\n"
    if arguments.out is None:
        sys.stdout.write(text)
        return 0
    temporary = arguments.out.with_name(f".{arguments.out.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, arguments.out)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        print(f"jtq layout: {arguments.out}: {error.strerror}", file=sys.stderr)
        return 1
    return 0
