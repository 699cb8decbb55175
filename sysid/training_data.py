"""Training data from emulated runs: the estimator's own features beside the sensor, one block per run.

A run is the smallest unit that is ever split off: neighbouring samples of one run tell each other's torque.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from estimator.parameters import Joint
from estimator.run import JointColumns
from estimator.settings import EstimatorSettings
from estimator.status import VALID
from estimator.whole_run import estimate_run
from sim_can.emulated_run import JointCommand, emulate_run
from sim_can.plant_parameters import JointPlant, PlantParameters
from sysid.excitation import Excitation, random_current, random_velocity

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RunBlock:
    """Samples of one run of one joint: features [n, 6], sensor torque [n] and physics estimate [n], Nm."""

    seed: int
    features: FloatArray
    sensor_nm: FloatArray
    physics_nm: FloatArray


def drifted(plant: PlantParameters, rng: np.random.Generator, viscous: float) -> PlantParameters:
    """The bench on another day: viscous friction of each joint off by a normal share of `viscous`."""
    one, two = plant.joints
    return replace(plant, joints=(_drifted(one, rng, viscous), _drifted(two, rng, viscous)))


def _drifted(side: JointPlant, rng: np.random.Generator, viscous: float) -> JointPlant:
    scale = side.deviations.viscous_scale * (1.0 + viscous * float(rng.normal()))
    return replace(side, deviations=replace(side.deviations, viscous_scale=scale))


def emulated_blocks(
    plant: PlantParameters,
    joints: tuple[Joint, Joint],
    seeds: range,
    duration_s: float,
    *,
    viscous_drift: float,
) -> Iterator[tuple[RunBlock, RunBlock]]:
    """One pair of blocks (joint 1, joint 2) per seed; even seeds drive joint 1 by velocity, odd ones joint 2."""
    limits = Excitation()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        velocity = JointCommand.velocity(random_velocity(limits, duration_s, rng))
        current = JointCommand.current(random_current(limits, rng))
        commands = (velocity, current) if seed % 2 == 0 else (current, velocity)
        table = emulate_run(drifted(plant, rng, viscous_drift), commands, duration_s, seed)
        dt = np.diff(table.time_s, prepend=table.time_s[0])
        yield _block(seed, joints[0], dt, table.joints[1]), _block(seed, joints[1], dt, table.joints[2])


def _block(seed: int, joint: Joint, dt: FloatArray, one: JointColumns) -> RunBlock:
    columns = (
        one.current_a,
        one.motor_position_rad,
        one.motor_velocity_rad_s,
        one.link_position_rad,
        one.torque_nm,
    )
    known = [column for column in columns if column is not None]
    if len(known) != len(columns):
        raise ValueError(f"run {seed}: a column is missing")
    current, position, velocity, link, torque = known
    run = estimate_run(
        joint, EstimatorSettings(method="efficiency"), None, dt, current, position, velocity, link
    )
    moving = run.status == VALID
    return RunBlock(seed, run.features[moving], torque[moving], run.physics_nm[moving])


def data_hash(blocks: list[RunBlock]) -> str:
    """sha256 over features and targets of all blocks, in order."""
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(np.ascontiguousarray(block.features).tobytes())
        digest.update(np.ascontiguousarray(block.sensor_nm).tobytes())
    return digest.hexdigest()
