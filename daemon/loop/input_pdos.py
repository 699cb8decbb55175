"""The PDOs that the loop waits for, and those that it takes when they come, by configuration."""

from __future__ import annotations

from daemon.config import Config
from daemon.loop.input_state import InputPdo
from daemon.loop.temperature import LIFE_S, JointTemperature
from daemon.master.pdo_watch import WatchedPdo
from drivers.devices import drive_tpdo1, drive_tpdo2, drive_tpdo3, sensor_tpdo1, sensor_tpdo2
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


def watched_pdos(config: Config) -> list[WatchedPdo]:
    """The same PDOs as `input_pdos`, in the same order, with the joints that cannot do without."""
    joints = {joint.node_id: 1 << n for n, joint in enumerate(config.joints)}
    return [
        WatchedPdo(pdo.cob_id, pdo.node_id, pdo.name, joints.get(pdo.node_id, 0))
        for pdo in input_pdos(config)
    ]


def sensor_index(config: Config, channel: int | None) -> int | None:
    """Index of a sensor channel's PDO among them; None without channel or sensor."""
    if channel is None or config.sensor is None:
        return None
    return 2 * len(config.joints) + config.sensor.channels.index(channel)


def joint_temperatures(config: Config) -> list[JointTemperature]:
    """Temperature of each joint whose drive tells one, in the order of the joints; all unknown yet."""
    life = round(LIFE_S * 1e9 / config.period_ns)
    return [
        JointTemperature(cob_id, node, f"{cob_id:03X}h drive {node} TPDO3", life)
        for node, cob_id in (
            (j.node_id, drive_tpdo3(j.node_id).cob_id) for j in config.joints if j.temperature
        )
    ]
