"""A DDS reader of its own: `python dds_reader.py DOMAIN [SECONDS] [XML]`. Imports nothing of jtqd.

Its types come from the .msg files and ROS 2's definitions, made as rmw_cyclonedds makes them: XTypes, final, `byte` as
uint8. By default it looks for others as that middleware does with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST. It prints one
line of JSON for each writer that it discovers and for each message, as they come. XML may be the name of another of
`DISCOVERY`.
"""

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from tests.daemon.ros2.ros_types import dds_name, types_of

_AUTO = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
DISCOVERY = {
    "LOCALHOST": "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General><Discovery>"
    f'{_AUTO}<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>',
    "SUBNET": f"<CycloneDDS><Domain><Discovery>{_AUTO}</Discovery></Domain></CycloneDDS>",
    "ROS_LOCALHOST_ONLY": '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "</General></Domain></CycloneDDS>",
}
"""As rmw_cyclonedds configures ROS_AUTOMATIC_DISCOVERY_RANGE (SUBNET is the default), and before it ROS_LOCALHOST_ONLY=1."""
TOPICS = {
    "rt/joint_states": "sensor_msgs/msg/JointState",
    "rt/joint_torque_states": "jtqd_msgs/msg/JointTorqueState",
    "rt/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
STORE, MADE = types_of(), {}


def idl_of(kind, what):
    if kind == Nodetype.BASE:
        return {"string": str, "bool": bool, "byte": types.uint8}.get(what[0]) or getattr(types, what[0])
    if kind == Nodetype.NAME:
        return struct_of(what)
    assert kind == Nodetype.SEQUENCE
    return types.sequence[idl_of(*what[0])]


def struct_of(name):
    if name not in MADE:
        members = {field: idl_of(*node) for field, node in STORE.fielddefs[name][1]}
        MADE[name] = make_idl_struct(name.split("/")[-1], dds_name(name), members)
    return MADE[name]


def plain(value):
    if hasattr(value, "__idl__"):
        return {key: plain(each) for key, each in vars(value).items() if key != "sample_info"}
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def say(**content):
    print(json.dumps(content), flush=True)


def main(domain, seconds=3600.0, xml="LOCALHOST"):
    domain, end = int(domain), time.monotonic() + float(seconds)
    own = Domain(domain, DISCOVERY.get(xml, xml))
    participant = DomainParticipant(domain)
    best_effort = Qos(Policy.Reliability.BestEffort)
    reliable = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(1000))
    readers = {
        name: DataReader(
            participant,
            Topic(participant, name, struct_of(kind)),
            best_effort if "diagnostics" in name else reliable,
        )
        for name, kind in TOPICS.items()
    }
    found = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    say(ready=True)
    while time.monotonic() < end:
        for each in found.take(20):
            if each.topic_name in TOPICS:
                policies = [repr(policy) for policy in each.qos]
                data = bytes(each.qos[Policy.Userdata].data).decode()
                say(writer=each.topic_name, type=each.type_name, qos=policies, data=data)
        for name, reader in readers.items():
            for message in reader.take(100):
                if hasattr(message, "__idl__"):  # else the last writer is gone
                    say(topic=name, message=plain(message))
        time.sleep(0.005)
    del own


if __name__ == "__main__":
    main(*sys.argv[1:])
