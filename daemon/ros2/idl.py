"""Types of the published messages, as ROS 2's middleware names them on the wire: `sensor_msgs::msg::dds_::JointState_`.

Members and their order are those of the .msg files; XCDR1 writes them one after the other, so the order is the format. A
`byte` of a .msg file is `uint8` here, as in rmw_cyclonedds, which offers its types for comparison. jtqd_msgs is defined by
the files in ros2/jtqd_msgs/msg; `tests/daemon/ros2/test_idl.py` compares every type with its file, and with ROS 2's own.
"""

# No `from __future__ import annotations`: cyclonedds evaluates the annotations where the module's names are not known.

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32, uint64

Texts = Annotated[Sequence[str], sequence(str)]
Numbers = Annotated[Sequence[float], sequence(float64)]
Bytes = Annotated[Sequence[int], sequence(uint8)]
Counts = Annotated[Sequence[int], sequence(uint32)]
Flags = Annotated[Sequence[bool], sequence(bool)]
"""As `sequence[bool]`, which a type checker does not understand."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """builtin_interfaces/msg/Time."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """std_msgs/msg/Header."""

    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """sensor_msgs/msg/JointState."""

    header: Header
    name: Texts
    position: Numbers
    velocity: Numbers
    effort: Numbers


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    """diagnostic_msgs/msg/KeyValue."""

    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    """diagnostic_msgs/msg/DiagnosticStatus."""

    level: uint8
    name: str
    message: str
    hardware_id: str
    values: Annotated[Sequence[KeyValue], sequence(KeyValue)]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    """diagnostic_msgs/msg/DiagnosticArray."""

    header: Header
    status: Annotated[Sequence[DiagnosticStatus], sequence(DiagnosticStatus)]


@dataclass
class JointTorqueState(IdlStruct, typename="jtqd_msgs::msg::dds_::JointTorqueState_"):
    """jtqd_msgs/msg/JointTorqueState: what the fields mean is in ros2/jtqd_msgs/msg/JointTorqueState.msg."""

    header: Header
    cycle: uint64
    missed: uint32
    sync_counter: uint8
    age: float64
    name: Texts
    status: Bytes
    torque: Numbers
    sigma: Numbers
    lower: Numbers
    upper: Numbers
    faults: Bytes
    latched: Flags
    withheld: Counts


Message = JointState | DiagnosticArray | JointTorqueState

TYPE_HASHES: dict[type[Message], str] = {
    JointState: "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    DiagnosticArray: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    JointTorqueState: "RIHS01_7ad6af710d4da706192674c5d0533caa0b437059bae7266e74aa02197e2f19d3",
}
"""Hashes of REP 2016, by which ROS 2 from Iron on shows and records which definition a type has."""
