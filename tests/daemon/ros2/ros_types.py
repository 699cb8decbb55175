"""ROS 2's own definitions, which rosbags carries for every distribution, and those of ros2/jtqd_msgs; nothing of jtqd."""

from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

PACKAGE = Path(__file__).resolve().parents[3] / "ros2" / "jtqd_msgs"
DISTRIBUTIONS = (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.LATEST)


def types_of(distribution=Stores.ROS2_HUMBLE):
    """The typestore of a distribution with the package jtqd_msgs."""
    store = get_typestore(distribution)
    ours = {}
    for path in sorted((PACKAGE / "msg").glob("*.msg")):
        ours |= get_types_from_msg(path.read_text(), f"jtqd_msgs/msg/{path.stem}")
    store.register(ours)
    return store


def dds_name(name):
    """sensor_msgs/msg/JointState -> sensor_msgs::msg::dds_::JointState_"""
    package, _, message = name.split("/")
    return f"{package}::msg::dds_::{message}_"
