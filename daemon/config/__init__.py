"""Configuration of jtqd as frozen values: `load_config` reads a file.

settings    sections that other modules take as they are: safety, recording, real time, ROS 2, contact
drive       what a joint's section says of its drive: objects, TPDOs
sections    the whole file as it is written
load        with joint files, networks and profiles: `Config`
"""

from jtqd.daemon.config.drive import ObjectsSection
from jtqd.daemon.config.load import Config, JointConfig, NetworkFile, SensorConfig, as_booted, load_config
from jtqd.daemon.config.sections import MAX_NODE_ID, Identity
from jtqd.daemon.config.settings import (
    HIGHEST_DOMAIN,
    LATCHED_BY_DEFAULT,
    LOOPBACK,
    ContactSettings,
    Realtime,
    RecordingSettings,
    Ros2Settings,
    SafetySettings,
)

__all__ = [
    "HIGHEST_DOMAIN",
    "LATCHED_BY_DEFAULT",
    "LOOPBACK",
    "MAX_NODE_ID",
    "Config",
    "ContactSettings",
    "Identity",
    "JointConfig",
    "NetworkFile",
    "ObjectsSection",
    "Realtime",
    "RecordingSettings",
    "Ros2Settings",
    "SafetySettings",
    "SensorConfig",
    "as_booted",
    "load_config",
]
