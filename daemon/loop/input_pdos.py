"""Input PDOs of a configuration: those that the loop waits for, and temperatures that come in between.

What a cycle keeps of them is in `daemon/core/intake.pyx`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from jtqd.daemon.config import Config
from jtqd.daemon.core.intake import JointTemperature
from jtqd.daemon.shared.cycle_record import TEMPERATURE_LIFE_S
from jtqd.drivers.devices import drive_tpdo1, drive_tpdo2, drive_tpdo3, sensor_tpdo1, sensor_tpdo2
from jtqd.drivers.pdo import PdoMap


@dataclass(frozen=True)
class InputPdo:
    """One synchronous TPDO that the loop waits for.

    Attributes:
        cob_id: 11-bit identifier.
        length: bytes of its mapping; any other length is rejected (CiA 301: 8210h).
        layout: precompiled unpacking of the mapped objects.
        node_id: its producer.
        name: as it appears in counters and events, e.g. "181h drive 1 TPDO1".
    """

    cob_id: int
    length: int
    layout: struct.Struct
    node_id: int
    name: str


@dataclass(frozen=True)
class JointInputs:
    """Indices of one joint's inputs among the intake's PDOs, and their scaling.

    Attributes:
        position: index of TPDO1 (motor position, link position).
        motion: index of TPDO2 (motor velocity, current, statusword).
        sensor: index of the sensor's PDO, None without reference.
        temperature: index among the intake's temperatures, None where the drive sends none.
        motor_rad_per_count, motor_rad_s_per_unit, link_rad_per_count, ampere_per_unit, sensor_nm_per_unit: scaling, SI.
    """

    position: int
    motion: int
    sensor: int | None
    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float
    sensor_nm_per_unit: float
    temperature: int | None = None


def input_pdos(config: Config) -> list[InputPdo]:
    """Return the expected PDOs: both TPDOs of each drive, then one per sensor channel in use."""

    def pdo(pdo_map: PdoMap, node: int, what: str) -> InputPdo:
        return InputPdo(pdo_map.cob_id, pdo_map.length, pdo_map.layout, node, f"{pdo_map.cob_id:03X}h {what}")

    pdos = []
    for joint in config.joints:
        pdos.append(
            pdo(drive_tpdo1(joint.node_id, joint.objects), joint.node_id, f"drive {joint.node_id} TPDO1")
        )
        pdos.append(
            pdo(drive_tpdo2(joint.node_id, joint.objects), joint.node_id, f"drive {joint.node_id} TPDO2")
        )
    if config.sensor is not None:
        node = config.sensor.node_id
        for channel in config.sensor.channels:
            pdo_map = sensor_tpdo1(node) if channel == 1 else sensor_tpdo2(node)
            pdos.append(pdo(pdo_map, node, f"sensor {node} channel {channel}"))
    return pdos


def sensor_index(config: Config, channel: int | None) -> int | None:
    """Return the index of a sensor channel's PDO; None without channel or sensor."""
    if channel is None or config.sensor is None:
        return None
    return 2 * len(config.joints) + config.sensor.channels.index(channel)


def joint_temperatures(config: Config) -> list[JointTemperature]:
    """Return the temperatures of the joints whose drive sends one, in joint order; all unknown at first."""
    life = round(TEMPERATURE_LIFE_S * 1e9 / config.period_ns)
    return [
        JointTemperature(cob_id, node, f"{cob_id:03X}h drive {node} TPDO3", life)
        for node, cob_id in (
            (j.node_id, drive_tpdo3(j.node_id).cob_id) for j in config.joints if j.temperature
        )
    ]
