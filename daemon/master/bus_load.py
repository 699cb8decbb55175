"""Bus load of a configuration."""

from __future__ import annotations

from daemon.config import Config
from drivers.bus_load import BusLoad, configured_load


def bus_load_of(config: Config) -> BusLoad:
    """Load of everything that the configuration puts on the bus; nothing is checked here."""
    return configured_load(
        [joint.node_id for joint in config.joints],
        {config.sensor.node_id: config.sensor.channels} if config.sensor else {},
        temperatures=[joint.node_id for joint in config.joints if joint.temperature],
        heartbeat_ms=config.heartbeat_ms,
        master=config.node_id,
        bitrate=config.bitrate,
        period_s=config.period_ns * 1e-9,
    )
