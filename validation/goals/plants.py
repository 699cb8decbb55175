"""The plants of the table, and one thing changed in a plant after its joints were identified.

A change of the plant is one of its file's numbers; a change of what is measured acts on the link encoder's position, which
no drive is controlled by: the joint moves as before.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Effect, Joint
from jtqd.models.files import load_joint, load_yaml, shipped
from jtqd.sim_can.plant_file import plant_from_mapping
from jtqd.sim_can.plants import AnyPlant
from jtqd.sim_can.towing import bench_file

SIDES: Final = ("joint_1", "joint_2")
Mapped = dict[str, Any]


class PlantFile(NamedTuple):
    """A plant of the table: its column's name and its file as a mapping; `directory` has the joint files."""

    name: str
    mapping: Mapping[str, Any]
    directory: Path

    @property
    def has_own_laws(self) -> bool:
        """Whether it is a bench of docs/testing.md, which shares no equation with the estimator."""
        return bench_file.KEY in self.mapping

    def bench(self, effects: tuple[Effect, ...] = ()) -> AnyPlant:
        """Return the plant, its joints with these effects. Raises ConfigError."""

        def joint_of(name: str) -> Joint:
            joint = load_joint(self.directory / name)
            return replace(joint, effects=effects) if effects else joint

        if self.has_own_laws:
            return bench_file.bench_from_mapping(self.mapping, self.name, joint_of)
        return plant_from_mapping(self.mapping, self.name, joint_of)

    def changed(self, change: Callable[[Mapped], None]) -> PlantFile:
        """Return the plant with a change of its file."""
        mapping = copy.deepcopy(dict(self.mapping))  # YAML anchors: joints may share a section
        for side in SIDES:
            mapping[side] = copy.deepcopy(mapping[side])
        change(mapping)
        return self._replace(mapping=mapping)


def plant_file(name: str, path: Path) -> PlantFile:
    """Return the plant of a file. Raises ConfigError."""
    return PlantFile(name, load_yaml(path), path.parent)


def the_three() -> tuple[PlantFile, PlantFile, PlantFile]:
    """Return the columns of the table: the paper's Table I, an ordinary joint, a bad day."""
    return (
        plant_file("Table I", shipped("campaign_plant.yaml")),
        plant_file("typical", shipped("plants/typical.yaml")),
        plant_file("bad day", shipped("plants/bad_day.yaml")),
    )


class Change(NamedTuple):
    """One thing changed: in the plant's file, by an effect of its joints, or in the link position (angle, motor's share
    motor/G). A kind of plant that has no such thing has None in its place.
    """

    name: str
    table_i: Callable[[Mapped], None] | Effect | None = None
    own_laws: Callable[[Mapped], None] | None = None
    link: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def possible(self, plant: PlantFile) -> bool:
        """Whether the plant has what is changed."""
        return self.link is not None or (self.own_laws if plant.has_own_laws else self.table_i) is not None

    def bench(self, plant: PlantFile) -> AnyPlant:
        """Return the changed plant; the plant itself for a change of what is measured."""
        how = None if self.link is not None else self.own_laws if plant.has_own_laws else self.table_i
        if isinstance(how, Effect):
            return plant.bench((how,))
        return (plant if how is None else plant.changed(how)).bench()


def _scaled(part: str, keys: tuple[str, ...], factor: float) -> Callable[[Mapped], None]:
    def change(mapping: Mapped) -> None:
        for side in SIDES:
            for key in keys:
                value = mapping[side][part].get(key, 1.0)
                scaled = [factor * each for each in value] if isinstance(value, list) else factor * value
                mapping[side][part][key] = scaled

    return change


def _harder(mapping: Mapped) -> None:
    for side in SIDES:
        k1, k2, k3 = mapping[side]["gear"]["stiffness_nm_per_rad"]
        mapping[side]["gear"]["stiffness_nm_per_rad"] = [k1, 1.1 * k2, 1.2 * k3]


def _wider(mapping: Mapped) -> None:
    for side in SIDES:
        mapping[side]["gear"]["slips"].append({"torque_nm": 0.6, "travel_rad": 3.0e-4})


def _wider_table_i(mapping: Mapped) -> None:
    for side in SIDES:
        mapping[side]["deviations"]["hysteresis"] = {"torque_nm": 1.0, "travel_rad": 2.5e-4}


def _wavier(mapping: Mapped) -> None:
    for side in SIDES:
        mapping[side]["gear"]["errors"][0]["amplitude_rad"] += 1.1e-4


def _wavier_table_i(mapping: Mapped) -> None:
    for side in SIDES:
        mapping[side]["deviations"]["kinematic_error"]["amplitude_rad"] += 1.1e-4


def _steeper_load(mapping: Mapped) -> None:
    for side in SIDES:
        mapping[side]["friction"]["load_exponent"] += 0.15


CHANGES: Final = (
    Change("nothing", link=lambda link, motor: link),
    Change(
        "stiffness -5 %",
        _scaled("deviations", ("stiffness_scale",), 0.95),
        _scaled("gear", ("stiffness_nm_per_rad",), 0.95),
    ),
    Change(
        "spring hardens more",
        Effect("nonlinear_stiffness", {"cubic_nm_per_rad3": 2.5e8}),  # 1.67 times as stiff at rated torque
        _harder,
    ),
    Change("hysteresis 1.2 Nm wider", _wider_table_i, _wider),
    Change("kinematic error +110 urad", _wavier_table_i, _wavier),
    Change(
        "friction +30 %",
        _scaled("deviations", ("friction_scale",), 1.3),
        _scaled("friction", ("coulomb_nm", "viscous_nm", "load_nm"), 1.3),
    ),
    Change("friction by load, exponent +0.15", None, _steeper_load),
    Change("link eccentricity 60 urad", link=lambda link, motor: link + 60e-6 * np.sin(link + 1.0)),
    Change("link zero 100 urad", link=lambda link, motor: link + 100e-6),
    Change("gear ratio +0.02 %", link=lambda link, motor: link - 2e-4 * motor),
)
"""What was measured to break the estimate: `nothing` stands beside, on the same days."""
