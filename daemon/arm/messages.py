"""Topics of an arm, recorded and live: definitions (ros2msg) and CDR bytes of what is known after a cycle. Pure.

/arm/external and /arm/wrench come every cycle, /arm/contact and /arm/joint_states at 50 Hz, /arm/payload at 10 Hz; a contact
that begins or ends at once. /events and /log are those of jtqd's log. Stamps are the instant of which the numbers are.

Doubles stand before everything smaller: behind a header that ends at a multiple of eight no field needs padding.
"""

from __future__ import annotations

import math
import struct
from typing import Final

import numpy as np

from jtqd.daemon.arm.alignment import Aligned
from jtqd.daemon.arm.estimator import ArmEstimate
from jtqd.daemon.arm.model import ArmModel, Array
from jtqd.daemon.live.process import Message
from jtqd.daemon.recording.messages import (
    CDR_HEADER,
    EVENTS,
    LOG,
    NESTED_HEADER,
    STATUS_NAMES,
    CdrBuilder,
    Topic,
    complete,
    schemas_of,
)
from jtqd.estimator.status import STARTING

_CODES = "".join(f"uint8 {name}={code}\n" for code, name in STATUS_NAMES.items())
_EXTERNAL = """\
# What each joint of the arm feels at one instant, in the order of the URDF, and what went into the estimate.
# Torques act on the link side, positive along the joint's angle. NaN: not known.
std_msgs/Header header          # instant of the numbers, CLOCK_REALTIME
string joints                   # their names in this order, a space between
uint64 cycle                    # of the estimator
int64 monotonic_ns              # [ns] instant of the numbers, CLOCK_MONOTONIC, as sync_monotonic_ns of jtqd's log
float64[{n}] position_rad         # [rad] by the link encoder, from the URDF's zero
float64[{n}] torque_nm            # [Nm] drive-side torque
float64[{n}] torque_sigma_nm      # [Nm] its standard deviation; half the interval at standstill
float64[{n}] external_nm          # [Nm] what pushes from outside
float64[{n}] sigma_nm             # [Nm] its standard deviation
float64[6] wrench_sigma         # [N, Nm] of /arm/wrench: force x, y, z, torque x, y, z
float64 conditioning            # of the pose, for the wrench
# Of torque_nm, as jtqd publishes it. OFF: its jtqd was not there yet; STARTING: the torque is there, external_nm is not
# yet; STALE: its jtqd has stopped or is late; DEGRADED: also across a gap of up to three cycles
{codes}uint8[{n}] status
"""
_WRENCH = """\
# On the arm, about the tool's origin, in the axes of frame_id (the base).
std_msgs/Header header
geometry_msgs/Wrench wrench
"""
_CONTACT = """\
std_msgs/Header header          # frame_id: the link that is touched, the base without contact
float64 strength_n              # [N]
float64[3] point_m              # [m] in the frame of the link's joint; NaN: not known
float64 point_sigma_m           # [m]
builtin_interfaces/Time since
uint8 link                      # that of joint 1..n; 0: no contact
"""
_PAYLOAD = """\
std_msgs/Header header          # frame_id: the tool
float64 mass_kg
float64 mass_sigma_kg
float64[3] centre_m             # [m] in the tool's frame
"""
_JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position              # [rad] link position from the URDF's zero
float64[] velocity              # none
float64[] effort                # [Nm] external torque
"""
_WRENCH_PARTS = (
    ("geometry_msgs/Wrench", "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
)
WRENCH: Final = Topic(2, "/arm/wrench", "geometry_msgs/msg/WrenchStamped")
CONTACT: Final = Topic(3, "/arm/contact", "jtqd_msgs/msg/ArmContact")
PAYLOAD: Final = Topic(4, "/arm/payload", "jtqd_msgs/msg/ArmPayload")
JOINT_STATES: Final = Topic(5, "/arm/joint_states", "sensor_msgs/msg/JointState")


def external_of(joints: int) -> Topic:
    """Return the topic /arm/external: with another number of joints it is another type."""
    return Topic(1, "/arm/external", f"jtqd_msgs/msg/ArmExternal{joints}")


def texts_of(joints: int) -> dict[Topic, str]:
    """Return the topics of an arm of so many joints, /arm/external first, with their definitions."""
    return {
        external_of(joints): complete(_EXTERNAL.format(n=joints, codes=_CODES), *NESTED_HEADER),
        WRENCH: complete(_WRENCH, *NESTED_HEADER, *_WRENCH_PARTS),
        CONTACT: complete(_CONTACT, *NESTED_HEADER),
        PAYLOAD: complete(_PAYLOAD, *NESTED_HEADER),
        JOINT_STATES: complete(_JOINT_STATE, *NESTED_HEADER),
        **{topic: schemas_of(1)[topic.schema] for topic in (EVENTS, LOG)},
    }


_SAMPLE_NS, _SLOW_NS = 20_000_000, 100_000_000
_double = struct.Struct("<d").pack
_index = struct.Struct("<Qq").pack
_time = struct.Struct("<II").pack


class ArmMessages:
    """Messages of an arm. tool: frame; period_ns: of the estimator."""

    def __init__(self, model: ArmModel, tool: str, period_ns: int) -> None:
        self._period_ns = period_ns
        self._every = external_of(model.n)
        self._names = _head("").text(" ".join(model.joints)).align(8).body()[8:]
        self._state = _head("", *model.joints).put("I", model.n).align(8).body()[8:], _time(0, model.n)
        self._links = [_head(each).align(8).body()[8:] for each in links_of(model)]
        self._tool = _head(tool).align(8).body()[8:]
        self._sample = self._slow = -1
        self._touched = 0

    def of(
        self, aligned: Aligned, estimate: ArmEstimate, cycle: int, time_ns: int
    ) -> tuple[list[Message], bool]:
        """Return the messages of a cycle, that of /arm/external first, and whether viewers get them.

        time_ns: CLOCK_REALTIME of the instant.
        """
        made: list[Message] = []
        begin = CDR_HEADER + _stamp(time_ns)

        def add(topic: Topic, *parts: bytes) -> None:
            made.append(Message(topic.number, time_ns, b"".join((begin, *parts))))

        position, external = aligned.position_rad.tobytes(), estimate.external_nm.tobytes()
        torques = aligned.torque_nm.tobytes() + aligned.sigma_nm.tobytes()
        sigmas = (
            estimate.sigma_nm.tobytes() + estimate.wrench_sigma.tobytes() + _double(estimate.conditioning)
        )
        status = shown_status(aligned, estimate).tobytes()
        index = _index(cycle, aligned.instant_ns)
        add(self._every, self._names, index, position, torques, external, sigmas, status)
        add(WRENCH, self._links[0], estimate.wrench.tobytes())
        sample, slow = aligned.instant_ns // _SAMPLE_NS, aligned.instant_ns // _SLOW_NS
        sampled, self._sample = sample != self._sample, sample
        shown = sampled or estimate.contact != self._touched
        if shown:
            link = self._touched = estimate.contact
            since_ns = time_ns - (cycle - estimate.since_cycle) * self._period_ns if link else 0
            strength, off = _double(estimate.strength_n), _double(estimate.point_sigma_m)
            numbers = strength, estimate.point_m.tobytes(), off
            add(CONTACT, self._links[link], *numbers, _stamp(since_ns), bytes([link]))
        if sampled:
            add(JOINT_STATES, self._state[0], position, self._state[1], external)
        if slow != self._slow:
            self._slow = slow
            mass = _double(estimate.payload_kg) + _double(estimate.payload_sigma_kg)
            add(PAYLOAD, self._tool, mass, estimate.centre_m.tobytes())
        return made, shown


def _stamp(time_ns: int) -> bytes:
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return _time(seconds & 0xFFFF_FFFF, nanoseconds)


def _head(frame_id: str, *names: str) -> CdrBuilder:
    """Return a header, and a list of names where there are any."""
    builder = CdrBuilder().put("I", 0, 0).text(frame_id)
    if names:
        builder.put("I", len(names))
    for name in names:
        builder.text(name)
    return builder


def links_of(model: ArmModel) -> list[str]:
    """Return the names of the base and of the link that each joint moves."""
    joints = [*model.root.iter("joint")]
    below = {joint.get("name"): each.get("link", "") for joint in joints for each in joint.iter("child")}
    every = (link.get("name", "") for link in model.root.iter("link"))
    return [next(name for name in every if name not in below.values()), *(below[k] for k in model.joints)]


def shown_status(aligned: Aligned, estimate: ArmEstimate) -> Array:
    """Return the status of each joint [n]: of its torque; STARTING where that is there and the external one is not."""
    if math.isfinite(estimate.external_nm.sum()):
        return aligned.status
    waits = np.isfinite(aligned.torque_nm) & ~np.isfinite(estimate.external_nm)
    return np.where(waits, np.uint8(STARTING), aligned.status)
