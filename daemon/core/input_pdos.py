"""Input PDOs of a configuration: those that the loop waits for, and temperatures that come in between."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jtqd.daemon.config import Config
from jtqd.daemon.shared.cycle_record import TEMPERATURE_LIFE_S
from jtqd.drivers.drive import (
    CIA_402,
    TEMPERATURE_C_PER_UNIT,
    DriveObjects,
    Place,
    drive_layout,
    drive_tpdo3,
    places,
)
from jtqd.drivers.pdo import ACYCLIC, PdoMap
from jtqd.drivers.sensor import sensor_tpdo1, sensor_tpdo2

DRIVE_FACTORS = ("motor_rad_per_count", "motor_rad_s_per_unit", "link_rad_per_count", "ampere_per_unit")
POSITIONS = ("motor_position", "link_position")
"""Quantities whose PDOs are FLAG_POSITION of a record; the others are FLAG_MOTION."""


@dataclass(frozen=True)
class InputPdo:
    """One TPDO that is an input: the loop waits for it, unless it has an age."""

    cob_id: int
    length: int
    """Bytes of its mapping; any other length is rejected (CiA 301: 8210h)."""
    layout: struct.Struct
    node_id: int
    name: str
    """As it appears in counters and events, e.g. "181h drive 1 TPDO1"."""
    age_ns: int = 0
    """0 for one that is sent at each SYNC; of another one, for how long its last frame counts."""


@dataclass(frozen=True)
class TemperaturePdo:
    """TPDO3 of a drive: the temperature of its joint, at any time; a value is forgotten after `life_cycles` slots."""

    cob_id: int
    node_id: int
    name: str
    life_cycles: int
    c_per_unit: float = TEMPERATURE_C_PER_UNIT


@dataclass(frozen=True)
class JointInputs:
    """Where one joint's inputs lie among the intake's PDOs, and their scaling (SI)."""

    places: Mapping[str, Place]
    """Of each quantity of the drive (`drive.DriveObjects`), its PDO and its entry there."""
    sensor: int | None
    """Index of the sensor's PDO, None without reference."""
    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float
    sensor_nm_per_unit: float
    temperature: int | None = None
    """Index among the intake's temperatures, None where the drive sends none."""

    @property
    def positions(self) -> frozenset[int]:
        """Return the PDOs that carry a position (FLAG_POSITION)."""
        return frozenset(place.pdo for name, place in self.places.items() if name in POSITIONS)

    @property
    def motion(self) -> frozenset[int]:
        """Return the PDOs that carry velocity, current or statusword (FLAG_MOTION)."""
        return frozenset(place.pdo for name, place in self.places.items() if name not in POSITIONS)


def drive_places(
    first: int, tpdos: tuple[PdoMap, ...] = (), objects: DriveObjects = CIA_402
) -> dict[str, Place]:
    """Return where the quantities of a drive lie whose first PDO has index `first`; without `tpdos` as jtqd maps them."""
    found = places(objects, tpdos or drive_layout(1, objects))
    return {name: Place(first + place.pdo, place.entry) for name, place in found.items()}


def first_inputs(config: Config) -> list[int]:
    """Return the index of each joint's first PDO among `input_pdos`, and then that of the sensor's."""
    firsts = [0]
    for joint in config.joints:
        firsts.append(firsts[-1] + len(joint.tpdos))
    return firsts


def names_of_inputs(config: Config, number: int) -> tuple[str, str]:
    """Return the names of the PDOs with the positions of joint `number` (from 0), and of those with its other quantities."""
    joint, pdos = config.joints[number], input_pdos(config)
    found = drive_places(first_inputs(config)[number], joint.tpdos, joint.objects)
    positions = {place.pdo for name, place in found.items() if name in POSITIONS}
    others = {place.pdo for name, place in found.items() if name not in POSITIONS}
    return _joined(pdos, positions), _joined(pdos, others)


def _joined(pdos: list[InputPdo], numbers: set[int]) -> str:
    return " and ".join(pdos[n].name for n in sorted(numbers))


def input_pdos(config: Config) -> list[InputPdo]:
    """Return the expected PDOs: the TPDOs of each drive, then one per sensor channel in use."""

    def pdo(pdo_map: PdoMap, node: int, what: str, age_ns: int = 0) -> InputPdo:
        name = f"{pdo_map.cob_id:03X}h {what}"
        return InputPdo(pdo_map.cob_id, pdo_map.length, pdo_map.layout, node, name, age_ns)

    pdos = [
        pdo(
            each,
            joint.node_id,
            f"drive {joint.node_id} TPDO{each.number}",
            round(joint.max_age_ms * 1e6) if each.transmission_type in ACYCLIC else 0,
        )
        for joint in config.joints
        for each in joint.tpdos
    ]
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
    return first_inputs(config)[-1] + config.sensor.channels.index(channel)


def joint_temperatures(config: Config) -> list[TemperaturePdo]:
    """Return the temperatures of the joints whose drive sends one, in joint order."""
    life = round(TEMPERATURE_LIFE_S * 1e9 / config.period_ns)
    return [
        TemperaturePdo(
            cob_id := drive_tpdo3(joint.node_id).cob_id,
            joint.node_id,
            f"{cob_id:03X}h drive {joint.node_id} TPDO3",
            life,
            joint.temperature.c_per_unit,
        )
        for joint in config.joints
        if joint.temperature is not None
    ]


def joint_inputs(config: Config, report: dict[str, Any]) -> list[JointInputs]:
    """Return the inputs of each joint: places in `input_pdos`, and the scaling of the boot report.

    An absent node has zeros: its factors come with its configuration.
    """
    scalings = {int(node): booted["scaling"] for node, booted in report["nodes"].items()}
    result, firsts = [], first_inputs(config)
    measured = [joint.number for joint in config.joints if joint.temperature]
    for number, joint in enumerate(config.joints):
        drive = scalings.get(joint.node_id, dict.fromkeys(DRIVE_FACTORS, 0.0))
        sensor_nm = 0.0
        if joint.sensor_channel is not None and config.sensor is not None:
            channels = scalings.get(config.sensor.node_id, {}).get("nm_per_unit")
            sensor_nm = channels[str(joint.sensor_channel)] if channels else 0.0
        result.append(
            JointInputs(
                places=drive_places(firsts[number], joint.tpdos, joint.objects),
                sensor=sensor_index(config, joint.sensor_channel),
                **drive,
                sensor_nm_per_unit=sensor_nm,
                temperature=measured.index(joint.number) if joint.temperature else None,
            )
        )
    return result
