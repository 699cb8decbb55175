"""Runs of four plants as their nodes send them, cycle by cycle, beside the true torque of each SYNC.

    python -m tests.slow.faults.runs          identifies the joints of the plants anew: joints/

jtqd moves nothing, so a run is driven once and then played to it as often as there are faults.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.planner.plan import Plateau, Rest, Run, Segment
from validation.goals.identify import FULL, SIDES, Driven, PlantFile, drive, identify_physics, the_four

PLANTS: Final = ("bench", "typical", "bad day", "coarse")
STATES: Final = ("rest, loaded", "rest, unloaded", "creeping", "moving", "reversing")
RUN_S: Final = 7.0
STATE_S: Final = (2.6, 6.0)
"""The state of a run lasts from to; before it the joint has moved both ways, after it it moves again."""
JOINTS: Final = Path(__file__).with_name("joints")
CAMPAIGN_RUNS: Final = 48
FIT_SEED: Final = 1
ENABLED: Final = 0x0027
"""Statusword of CiA 402: operation enabled."""
_SENSOR_NM: Final = 0.001
_CELSIUS: Final = 0.1
_TEMPERATURE_CYCLES: Final = 500
_HEARTBEAT_CYCLES: Final = 100
_AT_US: Final = (200.0, 335.0, 470.0, 605.0, 720.0)
"""When the frames of a cycle end on a wire of 1 Mbit/s."""


@dataclass(frozen=True)
class Units:
    """Of a drive's numbers: rad, rad/s, rad and A per count; the rated torque of its joint [Nm] and its gear ratio."""

    motor_rad: float
    link_rad: float
    ampere: float
    rated_nm: float
    gear_ratio: float

    @property
    def scaling(self) -> dict[str, float]:
        """Return the factors as the boot reports them."""
        return {
            "motor_rad_per_count": self.motor_rad,
            "motor_rad_s_per_unit": self.motor_rad,
            "link_rad_per_count": self.link_rad,
            "ampere_per_unit": self.ampere,
        }


@dataclass(frozen=True)
class Played:
    """A run: frames of each cycle (delay [us], COB-ID, data), true torque [n, 2] in Nm, units of both drives.

    moving: where each joint turns [n, 2].
    """

    plant: str
    state: str
    frames: Sequence[Sequence[tuple[float, int, bytes]]]
    true_nm: FloatArray
    moving: FloatArray
    units: tuple[Units, Units]

    def at(self, cycle: int) -> Sequence[tuple[float, int, bytes]]:
        return self.frames[min(cycle, len(self.frames) - 1)]


def joint_files(plant: str) -> tuple[Path, Path]:
    """Return the files of both joints as they were identified on the plant."""
    if plant == "bench":
        return shipped("trained/joint1.yaml"), shipped("trained/joint2.yaml")
    name = plant.replace(" ", "_")
    return JOINTS / f"{name}_1.yaml", JOINTS / f"{name}_2.yaml"


def _plant(name: str) -> PlantFile:
    return dict(zip(PLANTS, the_four(), strict=True))[name]


def identified(plant: str) -> None:
    """Write the joint files of a plant."""
    models, _ = identify_physics(
        _plant(plant), FULL._replace(fit_runs=CAMPAIGN_RUNS, evaluations=100), FIT_SEED
    )
    for model, path in zip(models, joint_files(plant), strict=True):
        title = f"Joint {model.number} of the plant {plant}, from {CAMPAIGN_RUNS} runs: python -m tests.slow.faults.runs"
        write_joint(path, model.joint, title)


# Motions ---------------------------------------------------------------------------------------------------------------


def _until(segments: list[Segment], end_s: float, made: Sequence[Segment]) -> list[Segment]:
    """Return segments, followed by those of `made` until the next one would end after `end_s`."""
    used = sum(each.duration_s for each in segments)
    for each in made:
        if used + each.duration_s > end_s + 1e-9:
            break
        segments.append(each)
        used += each.duration_s
    return segments


def _state(state: str, rng: random.Random) -> list[Segment]:
    """Return more segments of a state than a run has room for."""

    def load(least: float = 1.0) -> float:
        return rng.choice((-1.0, 1.0)) * rng.uniform(least, 4.0)

    if state == "rest, loaded":
        return [Plateau(0.0, load(), rng.uniform(0.2, 0.5), 0.05) for _ in range(30)]
    if state == "rest, unloaded":
        return [Rest(0.25, 0.1) for _ in range(30)]
    if state == "creeping":
        return [
            Plateau((1 if k % 2 else -1) * rng.uniform(0.012, 0.045), load(0.3), rng.uniform(0.3, 0.7), 0.1)
            for k in range(30)
        ]
    sign = rng.choice((-1.0, 1.0))
    if state == "moving":
        return [
            Plateau(sign * rng.uniform(0.4, 1.6), load(0.3), rng.uniform(0.2, 0.5), 0.1) for _ in range(30)
        ]
    return [
        Plateau((sign if k % 2 else -sign) * rng.uniform(0.3, 1.4), load(0.3), rng.uniform(0.1, 0.4), 0.08)
        for k in range(40)
    ]


def motion(state: str, rng: random.Random) -> Run:
    """Return the motion of a run: both ways, then the state, then both ways again."""
    way = rng.choice((-1.0, 1.0))
    segments: list[Segment] = [Rest(0.3, 0.0)]
    for velocity, current in ((0.8, 1.5), (-0.8, -1.5), (1.2, -2.0)):
        segments.append(Plateau(way * velocity, way * current, 0.5, 0.2))
    segments = _until(segments, STATE_S[1], _state(state, rng))
    segments += [Plateau(-way * 0.7, 1.0, 0.25, 0.1), Plateau(way * 0.7, -1.0, 0.25, 0.1)]
    spare = RUN_S - sum(each.duration_s for each in segments)
    return Run(state, rng.choice((1, 2)), (*segments, Rest(round(spare - 0.1, 3), 0.1)))


# Frames ----------------------------------------------------------------------------------------------------------------


def _units(plant: PlantFile, side: str) -> Units:
    given: Mapping[str, Mapping[str, float]] = plant.mapping[side]
    measured, driven = given.get("measurement", {}), given.get("drive", {})
    joint = load_joint(plant.directory / plant.mapping[side]["joint"])
    return Units(
        2.0 * math.pi / measured.get("motor_counts_per_rev", 65536),
        2.0 * math.pi / measured.get("link_counts_per_rev", 524288),
        driven.get("rated_current_a", 8.0) / 1000.0,
        joint.rated_torque_nm,
        joint.gear_ratio,
    )


def _counted(column: FloatArray | None, unit: float) -> list[int]:
    assert column is not None
    counts: list[int] = np.round(column / unit).astype(np.int64).tolist()
    return counts


def _played(plant: PlantFile, name: str, run: Driven) -> Played:
    units = (_units(plant, SIDES[0]), _units(plant, SIDES[1]))
    table = run.table
    count = len(table.time_s)
    frames: list[list[tuple[float, int, bytes]]] = [[] for _ in range(count)]
    for node, unit in zip((1, 2), units, strict=True):
        columns = table.joints[node]
        motor = _counted(columns.motor_position_rad, unit.motor_rad)
        link = _counted(columns.link_position_rad, unit.link_rad)
        speed = _counted(columns.motor_velocity_rad_s, unit.motor_rad)
        current = _counted(columns.current_a, unit.ampere)
        celsius = _counted(columns.temperature_c, _CELSIUS)
        first, second = _AT_US[2 * node - 2 : 2 * node]
        for k in range(count):
            frames[k].append((first, 0x180 + node, struct.pack("<ii", motor[k], link[k])))
            frames[k].append((second, 0x280 + node, struct.pack("<ihH", speed[k], current[k], ENABLED)))
        for k in range(node, count, _TEMPERATURE_CYCLES):
            frames[k].append((780.0, 0x380 + node, struct.pack("<h", celsius[k])))
        for k in range(10 * node, count, _HEARTBEAT_CYCLES):
            frames[k].append((790.0, 0x700 + node, b"\x05"))
    torque = _counted(table.joints[1].torque_nm, _SENSOR_NM)
    for k in range(count):
        frames[k].append((_AT_US[4], 0x183, struct.pack("<iB", torque[k], 0)))
    for k in range(30, count, _HEARTBEAT_CYCLES):
        frames[k].append((790.0, 0x703, b"\x05"))
    speeds = np.column_stack(
        [
            np.abs(np.asarray(table.joints[node].motor_velocity_rad_s)) / units[node - 1].gear_ratio
            for node in (1, 2)
        ]
    )
    return Played(name, run.name, frames, run.true_nm, speeds > 0.01, units)


@cache
def runs_of(plant: str, seed: int) -> dict[str, Played]:
    """Return a run of each state on a plant, each on a day of its own of the seed."""
    rng = random.Random(f"{seed} {plant}")
    file = _plant(plant)
    motions = [motion(state, rng) for state in STATES]
    return {run.name: _played(file, plant, run) for run in drive(file.bench(), motions, seed)}


if __name__ == "__main__":
    for each in PLANTS[1:]:
        identified(each)
