"""Configuration of jtqd as frozen values: `load_config` reads a file.

sections    the whole file, section by section; objects and TPDOs of a joint's drive
load        with joint files, networks and profiles: `Config`
"""

from jtqd.daemon.config.load import Config, JointConfig, NetworkFile, SensorConfig, as_booted, load_config
from jtqd.daemon.config.sections import (
    HIGHEST_DOMAIN,
    LATCHED_BY_DEFAULT,
    LOOPBACK,
    MAX_NODE_ID,
    ContactSettings,
    Identity,
    ObjectsSection,
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
