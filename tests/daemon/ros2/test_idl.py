"""The types on the wire against ROS 2's own definitions and the package jtqd_msgs, member for member and byte for byte."""

import math
import re
import tomllib
import typing

import pytest

import jtqd
from jtqd.daemon.recording import messages
from jtqd.daemon.ros2 import messages as idl
from jtqd.daemon.ros2.messages import header
from jtqd.daemon.shared import cycle_record, faults
from jtqd.estimator import status as st
from tests.daemon.ros2.ros_types import DISTRIBUTIONS, PACKAGE, dds_name, types_of
from tests.paths import ROOT

PUBLISHED = {
    "sensor_msgs/msg/JointState": idl.JointState,
    "diagnostic_msgs/msg/DiagnosticArray": idl.DiagnosticArray,
    "jtqd_msgs/msg/JointTorqueState": idl.JointTorqueState,
}
MEMBERS = PUBLISHED | {
    "builtin_interfaces/msg/Time": idl.Time,
    "std_msgs/msg/Header": idl.Header,
    "diagnostic_msgs/msg/DiagnosticStatus": idl.DiagnosticStatus,
    "diagnostic_msgs/msg/KeyValue": idl.KeyValue,
}
NAMES = {kind: name for name, kind in MEMBERS.items()}
JOINT_STATE = idl.JointState(
    header(1_700_000_000_123_456_789), ["a", "elbow"], [1.0, -2.0], [], [math.nan, 4.0]
)
DIAGNOSTICS = idl.DiagnosticArray(
    header(5),
    [
        idl.DiagnosticStatus(
            2, "jtqd can0: loop", "stopped", "can0", [idl.KeyValue("cycle", "12"), idl.KeyValue("a", "")]
        ),
        idl.DiagnosticStatus(0, "n", "", "", []),
    ],
)
TORQUES = idl.JointTorqueState(
    header=header(7_000_000_001),
    cycle=1 << 40,
    missed=3,
    sync_counter=240,
    age=0.00125,
    name=["a", "elbow"],
    status=[2, 15],
    torque=[1.5, math.nan],
    sigma=[0.25, math.nan],
    lower=[1.0, math.nan],
    upper=[2.0, math.nan],
    faults=[0, 128],
    latched=[False, True],
    withheld=[0, 10],
)


def notation(hint):
    """A member's type as a .msg file writes it."""
    if hint in NAMES:
        return NAMES[hint]
    if typing.get_origin(hint) is not typing.Annotated:
        return {str: "string", bool: "bool"}[hint]
    (meant,) = hint.__metadata__
    return meant if isinstance(meant, str) else f"{notation(meant.subtype)}[]"


def of_ros(kind, what):
    kind = kind.name
    if kind == "SEQUENCE":
        return f"{of_ros(*what[0])}[]"
    return what if kind == "NAME" else {"byte": "uint8"}.get(what[0], what[0])


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_members_are_those_of_the_definitions_in_their_order(distribution):
    store = types_of(distribution)
    for name, kind in MEMBERS.items():
        hints = typing.get_type_hints(kind, include_extras=True)
        ours = [(field, notation(hint)) for field, hint in hints.items()]
        assert ours == [(field, of_ros(*node)) for field, node in store.fielddefs[name][1]], name
        assert kind.__idl_typename__ == dds_name(name)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_hashes_are_those_that_ros_2_gives_the_definitions(distribution):
    store = types_of(distribution)
    assert {store.hash_rihs01(name): kind for name, kind in PUBLISHED.items()} == {
        text: kind for kind, text in idl.TYPE_HASHES.items()
    }


@pytest.mark.parametrize("message", [JOINT_STATE, DIAGNOSTICS, TORQUES], ids=lambda each: type(each).__name__)
def test_bytes_are_those_that_rosbags_writes_and_reads(message):
    store, name = types_of(), NAMES[type(message)]
    data = message.serialize(use_version_2=False)
    assert data[:4] == b"\x00\x01\x00\x00"  # plain CDR, little endian: XCDR1 of a final type
    theirs = store.deserialize_cdr(data, name)
    assert bytes(store.serialize_cdr(theirs, name)) == data
    assert_same(message, theirs)


def assert_same(ours, theirs):
    for field, value in vars(ours).items():
        other = getattr(theirs, field)
        if hasattr(value, "__idl__"):
            assert_same(value, other)
        elif isinstance(value, list):
            assert len(value) == len(other), field
            for one, two in zip(value, other, strict=True):
                if hasattr(one, "__idl__"):
                    assert_same(one, two)
                else:
                    assert one == two or (math.isnan(one) and math.isnan(two)), field
        else:
            assert value == other, field


def test_constants_of_the_torque_state_are_those_of_the_estimate():
    constants = {name: value for name, _, value in types_of().fielddefs["jtqd_msgs/msg/JointTorqueState"][0]}
    assert constants == {name.upper(): code for code, name in st.NAMES.items()} | {
        f"FAULT_{faults.NAMES[bit].upper()}": bit for bit in faults.COUNTED
    }


def test_the_package_has_the_messages_of_the_logs_as_they_are_there():
    texts = messages.schemas_of(2) | messages.schemas_of(cycle_record.MOST_JOINTS)
    expected = {}
    for name, text in (messages.schemas_of(cycle_record.MOST_JOINTS) | messages.schemas_of(2)).items():
        if name.startswith("jtqd_msgs/"):
            own, *nested = text.split("=" * 80 + "\n")
            expected[name.split("/")[-1]] = own
            for each in nested:
                head, _, body = each.partition("\n")
                if head.startswith("MSG: jtqd_msgs/"):
                    expected[head.split("/")[-1]] = body
    names = {"JointEstimate", "CanFrame", "CanFrames", "CanFrames32", "Event", "Zeros"}
    assert names == set(expected), texts.keys()
    found = {path.stem: path.read_text() for path in (PACKAGE / "msg").glob("*.msg")}
    assert set(found) - set(expected) == {"JointTorqueState"}
    for name, text in expected.items():
        assert found[name] == text, f"{name}.msg is another than in the log"


def test_the_package_builds_all_its_messages_and_has_the_version_of_jtqd():
    listed = re.findall(r'"msg/(\w+)\.msg"', (PACKAGE / "CMakeLists.txt").read_text())
    assert sorted(listed) == sorted(path.stem for path in (PACKAGE / "msg").glob("*.msg"))
    described = (PACKAGE / "package.xml").read_text()
    assert f"<version>{jtqd.__version__}</version>" in described
    used = {
        kind.split("/")[0]
        for kind in re.findall(
            r"^(\w+/\w+)[ \[]",
            "".join(path.read_text() for path in (PACKAGE / "msg").glob("*.msg")),
            re.MULTILINE,
        )
    } - {"jtqd_msgs"}
    for package in used:
        assert f"<depend>{package}</depend>" in described


def test_the_extra_has_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert any(each.startswith("cyclonedds") for each in extras["ros2"])
