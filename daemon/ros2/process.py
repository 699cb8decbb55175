"""The ROS 2 publisher's process: `python -m jtqd.daemon.ros2.process REQUEST` reads the loop's shared memory and publishes.

Topics, all reliable, volatile, keep last 10, in XCDR1:

    rt/joint_states          sensor_msgs/JointState        `rate_hz`
    rt/joint_torque_states   jtqd_msgs/JointTorqueState    `rate_hz`
    rt/diagnostics           diagnostic_msgs/DiagnosticArray   1 Hz

A joint state is sent once per new cycle at most: while the loop stands still there is none. The torque state goes on as
STALE, without torque, with a growing age. Nothing that the network sends reaches the loop: ring and snapshot are mapped
read-only.

REQUEST is the JSON of `recording.launch.loop_request` with "domain_id", "interface" and "rate_hz". The answer is
{"publishing": what} or {"failed": why} (`shared.processes`).
"""

from __future__ import annotations

import fcntl
import math
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from jtqd.daemon.config import LOOPBACK
from jtqd.daemon.recording.diagnostics import LoopReader
from jtqd.daemon.ros2.messages import (
    TYPE_HASHES,
    DiagnosticArray,
    JointMessages,
    JointState,
    JointTorqueState,
    Message,
    diagnostic_array,
)
from jtqd.daemon.shared.processes import CannotBegin, Stop, run_side_process
from jtqd.daemon.shared.runtime_dir import SharedMemoryError

TOPICS: Final[dict[type[Message], str]] = {
    JointState: "joint_states",
    JointTorqueState: "joint_torque_states",
    DiagnosticArray: "diagnostics",
}
"""Names in ROS 2; on the wire they begin with rt/."""
DEPTH = 10
STALLED_S = 0.1
"""A loop without a new cycle for so long stands still."""
_SIOCGIFADDR = 0x8915


def own_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine, one per interface that has any."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # it has none
                request = struct.pack("256s", name.encode()[:15])
                found.append(socket.inet_ntoa(fcntl.ioctl(asked, _SIOCGIFADDR, request)[20:24]))
    return found


_ANNOUNCED_S = 2.0
"""Between two announcements to the nodes of this machine: for so long a new node may have to wait."""


def domain_xml(interface: str, addresses: Sequence[str]) -> str:
    """Return Cyclone DDS's configuration for one network interface. CYCLONEDDS_URI, meant for other programs, is not read.

    Each participant of a machine has a number, and so ports, of its own (`auto`), as in ROS 2, so that others find it
    without multicast; 32 is rmw_cyclonedds's limit. On loopback nodes that use other interfaces are found by announcements
    to this machine's own `addresses` (IPv4), which never leave it: Cyclone DDS 11.0 ignores announcements to 127.0.0.1
    where it does not use that interface itself (its pull request 2457).
    """
    discovery = (
        "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    )
    if interface == LOOPBACK:
        peers = "".join(f'<Peer address="{address}" PruneDelay="inf"/>' for address in addresses)
        discovery += f"<SPDPInterval>{_ANNOUNCED_S:g}s</SPDPInterval><Peers>{peers}</Peers>"
    return (
        '<CycloneDDS><Domain Id="any">'
        f'<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces></General>'
        f"<Discovery>{discovery}</Discovery>"
        "</Domain></CycloneDDS>"
    )


class Writers:
    """One DDS writer per topic. Raises DDSException where it cannot take part in that domain."""

    def __init__(self, domain_id: int, interface: str) -> None:
        self._domain = Domain(domain_id, domain_xml(interface, own_addresses()))
        # rmw takes a participant without an enclave for none of ROS
        participant = DomainParticipant(domain_id, Qos(Policy.Userdata(b"enclave=/;")))
        self._writers: dict[type[Message], DataWriter[Any]] = {
            kind: DataWriter(participant, Topic(participant, f"rt/{name}", kind), qos_of(kind))
            for kind, name in TOPICS.items()
        }

    def write(self, message: Message) -> None:
        """Write a message; one that a reader holds up for too long is left out. Raises DDSException."""
        try:
            self._writers[type(message)].write(message)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise


def qos_of(kind: type[Message]) -> Qos:
    """Return the quality of service of a topic: the default of ROS 2."""
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(DEPTH),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={TYPE_HASHES[kind]};".encode()),
    )


class Source:
    """What the daemon leaves in shared memory, as messages. Raises SharedMemoryError where it is not there."""

    def __init__(self, request: dict[str, Any]) -> None:
        self._bus = request["bus"]
        self._loop = LoopReader(request)
        self._joints = JointMessages(self._loop.joints, request["gear_ratios"])
        self._newest_ns: int | None = None

    def read(self, now_ns: int, realtime_ns: int) -> Iterator[Message]:
        """Return the messages that are due at now_ns (CLOCK_MONOTONIC), which is realtime_ns (CLOCK_REALTIME)."""
        ring = self._loop.ring
        records = ring.read(ring.backlog).records
        self._joints.take(records)
        if records:
            self._newest_ns = now_ns
        stalled = self._newest_ns is not None and now_ns - self._newest_ns > STALLED_S * 1e9
        made = self._joints.joint_state() if records else None
        state = self._joints.torque_state(now_ns, stalled=stalled) if records or stalled else None
        yield from (message for message in (made, state) if message is not None)
        found = self._loop.diagnosis(now_ns, realtime_ns)
        if found is not None:
            view, statuses = found
            age_s = (now_ns - view.sync_monotonic_ns) * 1e-9 if view.sync_monotonic_ns else math.nan
            yield diagnostic_array(realtime_ns, self._bus, statuses, view, age_s)


def publish(source: Source, writers: Writers, rate_hz: float, stop: Stop) -> int:
    """Publish until stopped; returns the exit status. Turns follow a grid; one that is missed is not made up."""
    period_s = 1.0 / rate_hz
    due = time.monotonic()
    try:
        while not stop.requested:
            for message in source.read(time.monotonic_ns(), time.time_ns()):
                writers.write(message)
            left = (due := due + period_s) - time.monotonic()
            if left < 0.0:
                due += math.ceil(-left / period_s) * period_s
            time.sleep(max(0.0, due - time.monotonic()))
    except DDSException as error:
        print(f"jtqd: ROS 2 publisher: {error.msg or error}", file=sys.stderr, flush=True)
        return 1
    return 0


def begin(request: dict[str, Any]) -> tuple[str, Callable[[Stop], int]]:
    """Open memory and domain; returns what is published, and what publishes it. Raises CannotBegin."""
    number, interface, rate_hz = request["domain_id"], request["interface"], request["rate_hz"]
    where = f"domain {number}, interface {interface}"
    try:
        source = Source(request)
        if interface not in (name for _, name in socket.if_nameindex()):
            raise CannotBegin(f"{where}: there is no such network interface")
        writers = Writers(number, interface)
    except SharedMemoryError as error:
        raise CannotBegin(str(error)) from None
    except OSError as error:  # a service whose unit forbids them
        raise CannotBegin(f"{where}: no network sockets: {error.strerror or error}") from None
    except DDSException as error:
        raise CannotBegin(f"{where}: Cyclone DDS: {error.msg or error}") from None
    text = f"/{', /'.join(TOPICS.values())} at {rate_hz:g} Hz, {where}"
    return text, partial(publish, source, writers, rate_hz)


if __name__ == "__main__":
    sys.exit(run_side_process(None, "publishing", begin))
