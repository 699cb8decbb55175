"""The PDOs that the loop waits for, by configuration."""

from __future__ import annotations

from daemon.config import Config
from daemon.intake import InputPdo
from drivers.devices import drive_tpdo1, drive_tpdo2, sensor_tpdo1, sensor_tpdo2
from drivers.pdo import PdoMap


def input_pdos(config: Config) -> list[InputPdo]:
    """Expected PDOs: both TPDOs of each drive, then one per sensor channel in use."""

    def pdo(pdo_map: PdoMap, node: int, what: str) -> InputPdo:
        return InputPdo(pdo_map.cob_id, pdo_map.length, pdo_map.layout, node, f"{pdo_map.cob_id:03X}h {what}")

    pdos = []
    for joint in config.joints:
        pdos.append(pdo(drive_tpdo1(joint.node_id), joint.node_id, f"drive {joint.node_id} TPDO1"))
        pdos.append(pdo(drive_tpdo2(joint.node_id), joint.node_id, f"drive {joint.node_id} TPDO2"))
    if config.sensor is not None:
        node = config.sensor.node_id
        for channel in config.sensor.channels:
            pdo_map = sensor_tpdo1(node) if channel == 1 else sensor_tpdo2(node)
            pdos.append(pdo(pdo_map, node, f"sensor {node} channel {channel}"))
    return pdos


def sensor_index(config: Config, channel: int | None) -> int | None:
    """Index of a sensor channel's PDO among them; None without channel or sensor."""
    if channel is None or config.sensor is None:
        return None
    return 2 * len(config.joints) + config.sensor.channels.index(channel)
