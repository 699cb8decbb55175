"""An arm of two joints that turn in a vertical plane, 0.3 m and 2 kg per link, as URDF and ARM.yaml."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from jtqd.daemon.shared.cycle_record import HEADER, JOINT, TAIL, Header, JointRecord, layout_of

_LINK = """
  <link name="{name}">
    <inertial>
      <origin xyz="0.15 0 0"/><mass value="2.0"/>
      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.015" iyz="0" izz="0.015"/>
    </inertial>
  </link>"""
_JOINT = """
  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/>
    <origin xyz="{x} 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="-3" upper="3" effort="100" velocity="3"/>
  </joint>"""
URDF = (
    '<robot name="small"><link name="base"/>'
    + _LINK.format(name="upper")
    + _LINK.format(name="fore")
    + '<link name="flange"/>'
    + _JOINT.format(name="shoulder", kind="revolute", parent="base", child="upper", x=0)
    + _JOINT.format(name="elbow", kind="revolute", parent="upper", child="fore", x=0.3)
    + _JOINT.format(name="mount", kind="fixed", parent="fore", child="flange", x=0.3)
    + "</robot>"
)


def content(**sections: Any) -> dict[str, Any]:
    """ARM.yaml as a mapping; sections: those that are replaced."""
    joints = {
        "shoulder": {"bus": "vcan0", "joint": 1, "direction": 1, "zero_rad": 0.25},
        "elbow": {"bus": "vcan1", "joint": 1, "direction": -1, "zero_rad": -0.5},
    }
    return {"urdf": "arm.urdf", "tool": "flange", "joints": joints, **sections}


def write(folder: Path, mapping: dict[str, Any] | None = None, urdf: str = URDF) -> Path:
    """Write both files; return the path of ARM.yaml."""
    (folder / "arm.urdf").write_text(urdf)
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(content() if mapping is None else mapping, sort_keys=False))
    return path


NOTHING = JointRecord(*[math.nan] * 16, 0, 0, 0, 0)
REALTIME_OFFSET_NS = 1_700_000_000_000_000_000


def record_of(sync_ns: int, *joints: JointRecord, cycle: int = 0) -> bytes:
    """A whole cycle record, byte by byte as the loop leaves it."""
    layout = layout_of(len(joints))
    made = bytearray(layout.size)
    header = Header(*[0] * len(Header._fields))._replace(
        cycle=cycle, sync_monotonic_ns=sync_ns, sync_realtime_ns=sync_ns + REALTIME_OFFSET_NS
    )
    HEADER.pack_into(made, 0, *header)
    for n, joint in enumerate(joints):
        JOINT.pack_into(made, HEADER.size + n * JOINT.size, *joint)
    TAIL.pack_into(made, layout.tail_offset, cycle)
    return bytes(made)
