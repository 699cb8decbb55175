"""Messages of ROS 2: their types as its middleware names them on the wire, and how they follow from cycle records.

`sensor_msgs::msg::dds_::JointState_`: members and their order are those of the .msg files; XCDR1 writes them one after the
other, so the order is the format. A `byte` of a .msg file is `uint8` here, as in rmw_cyclonedds, which offers its types for
comparison. jtqd_msgs is defined by the files in ros2/jtqd_msgs/msg.

A quantity without a value is NaN; with a status that permits no torque neither torque nor sigma is a number.
"""

# No `from __future__ import annotations`: cyclonedds evaluates the annotations where the module's names are not known.

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32, uint64

from jtqd.daemon.recording.messages import Status
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.snapshot import JointView, View
from jtqd.estimator import status as st

# ---- types ----

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


# ---- contents ----

INTERVAL_SIGMAS = 1.96
"""95 % of a normal distribution."""
_NS = 1_000_000_000
_NS_TO_S = 1e-9


def header(time_ns: int) -> Header:
    """Return a header without a frame; `time_ns`: CLOCK_REALTIME."""
    seconds, nanoseconds = divmod(time_ns, _NS)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id="")


class JointMessages:
    """Messages of the newest cycle; gear_ratios: motor revolutions per joint revolution."""

    def __init__(self, names: Sequence[str], gear_ratios: Sequence[float]) -> None:
        self._names, self._ratios = [*names], [*gear_ratios]
        self._statuses = cycle.selection((), ("status",), len(names)).unpack_from
        self._withheld = [0] * len(names)
        self._last: bytes | None = None

    def take(self, records: Sequence[bytes]) -> None:
        """Take the cycle records since the last call, oldest first; the messages are of the newest."""
        for record in records:
            for n, status in enumerate(self._statuses(record)):
                self._withheld[n] += status not in st.PUBLISHED
        if records:
            self._last = records[-1]

    def joint_state(self) -> JointState | None:
        """Return the measured motion and the estimate of the newest cycle; None before the first."""
        if self._last is None:
            return None
        joints = self._joints(self._last)
        return JointState(
            header=header(cycle.header_of(self._last).sync_realtime_ns),
            name=self._names,
            position=[joint.link_position_rad for joint in joints],
            velocity=[each.motor_velocity_rad_s / g for each, g in zip(joints, self._ratios, strict=True)],
            effort=[_number(joint.torque_nm, joint.status) for joint in joints],
        )

    def torque_state(self, now_ns: int, *, stalled: bool = False) -> JointTorqueState | None:
        """Return the torque state of the newest cycle at now_ns (CLOCK_MONOTONIC); None before the first.

        stalled: the loop stands still: nothing of that cycle is true any more.
        """
        if self._last is None:
            return None
        of, joints = cycle.header_of(self._last), self._joints(self._last)
        statuses = [st.STALE if stalled else joint.status for joint in joints]
        pairs = list(zip(joints, statuses, strict=True))
        torque = [_number(joint.torque_nm, status) for joint, status in pairs]
        sigma = [_number(joint.sigma_nm, status) for joint, status in pairs]
        widths = (1.0 if status == st.STANDSTILL else INTERVAL_SIGMAS for status in statuses)
        reach = [width * value for width, value in zip(widths, sigma, strict=True)]
        withheld, self._withheld = self._withheld, [0] * len(joints)
        return JointTorqueState(
            header=header(of.sync_realtime_ns),
            cycle=of.cycle,
            missed=of.missed,
            sync_counter=of.sync_counter,
            age=(now_ns - of.sync_monotonic_ns) * _NS_TO_S,
            name=self._names,
            status=statuses,
            torque=torque,
            sigma=sigma,
            lower=[value - half for value, half in zip(torque, reach, strict=True)],
            upper=[value + half for value, half in zip(torque, reach, strict=True)],
            faults=[joint.input_flags >> 8 for joint in joints],
            latched=[bool(joint.input_flags & cycle.FLAG_LATCHED) for joint in joints],
            withheld=withheld,
        )

    def _joints(self, record: bytes) -> list[cycle.JointRecord]:
        return [cycle.joint_of(record, number) for number in range(1, len(self._names) + 1)]


def _number(value: float, status: int) -> float:
    return value if status in st.PUBLISHED else math.nan


def diagnostic_array(
    time_ns: int, bus: str, statuses: Sequence[Status], view: View, age_s: float
) -> DiagnosticArray:
    """Return the `statuses` of /diagnostics, made of `view`, with the faults and the age of each joint.

    time_ns: CLOCK_REALTIME; bus: stands in their names, by which alone aggregators tell them apart; age_s: of the newest
    cycle.
    """
    joints = {f"jtqd: joint {number}": joint for number, joint in enumerate(view.joints, start=1)}
    shown = []
    for status in statuses:
        values = dict(status.values) | _faults(joints.get(status.name), age_s)
        texts = {k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in values.items()}
        name = status.name.replace("jtqd:", f"jtqd {bus}:", 1)
        rows = [KeyValue(key=key, value=text) for key, text in texts.items()]
        shown.append(DiagnosticStatus(status.level, name, status.text, status.hardware_id, rows))
    return DiagnosticArray(header=header(time_ns), status=shown)


def _faults(joint: JointView | None, age_s: float) -> dict[str, float | str]:
    if joint is None:
        return {}
    return {
        "faults": ", ".join(faults.names_of(joint.input_flags >> 8)) or "none",
        "latched": ", ".join(faults.names_of(joint.latched)) or "none",
        "age_s": age_s,
    }
