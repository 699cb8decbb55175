"""Sources of the bench's measurements from plants: one pair of joints, and any number of joints side by side.

Each pair is a plant of its own. A last joint without a partner turns a passive load: the second joint of its pair, without
current and without a node on the bus.
"""

from __future__ import annotations

import random
from pathlib import Path

from jtqd.models.files import load_joint, load_yaml
from jtqd.sim_can.drives import Instruments, Noise, TwoJoints
from jtqd.sim_can.effect_plant import EffectPlant, Readings
from jtqd.sim_can.plant import Plant
from jtqd.sim_can.plant_file import JointPlant, PlantParameters, load_plant
from jtqd.sim_can.source import OFF, Day, DriveRatings, Source
from jtqd.sim_can.towing import bench_file
from jtqd.sim_can.towing.bench_file import TowedJoint, TowingBench
from jtqd.sim_can.towing.plant import TowingPlant

AnyPlant = PlantParameters | TowingBench


def load_any_plant(path: Path) -> AnyPlant:
    """Read a bench file, known by its key `towing`, or what `load_plant` reads.

    Joint files named in it are looked up beside it.

    Raises:
        ConfigError: unreadable file, unknown or missing key, value out of range; the message names file and key.
    """
    mapping = load_yaml(path)
    if bench_file.KEY not in mapping:
        return load_plant(path)
    return bench_file.bench_from_mapping(mapping, str(path), lambda name: load_joint(path.parent / name))


def ratings_of(side: JointPlant | TowedJoint) -> DriveRatings:
    """Return the ratings in the drive's own objects: nominal values, as a drive knows no others."""
    return DriveRatings(
        gear_ratio=side.joint.gear_ratio,
        rated_current_a=side.drive.rated_current_a,
        rated_torque_nm=side.joint.torque_constant_nm_per_a * side.drive.rated_current_a,
        trip_current_a=side.drive.trip_current_a,
        motor_counts_per_rev=side.measurement.motor_counts_per_rev,
        link_counts_per_rev=side.measurement.link_counts_per_rev,
    )


class PlantSource(Source):
    """`Source` of the emulated bench; the same seed and the same calls give the same signals bit by bit.

    Where the plant file has `run_to_run`, the source starts in day 0 of its seed, and each time a drive is enabled after
    both were off it is the next day, unless the run goes on (`resume`).

    Args:
        noise_seed: of the noise, where it is not `seed`.
        nodes: 1: the second joint has no node; it is the passive load of the first one.
    """

    def __init__(
        self, parameters: AnyPlant, seed: int = 0, noise_seed: str | None = None, nodes: int = 2
    ) -> None:
        self.ratings = [ratings_of(side) for side in parameters.joints[:nodes]]
        noise = Noise(random.Random(seed if noise_seed is None else noise_seed).random)
        self.plant: TwoJoints
        self._readings: Readings | None = None
        if isinstance(parameters, TowingBench):
            self.plant = TowingPlant(parameters)
        elif parameters.has_effects:
            self.plant = EffectPlant(parameters)
            self._readings = Readings(self.plant)
        else:
            self.plant = Plant(parameters)
        self._instruments = Instruments(parameters, noise)
        self.drives = self._instruments.drives[:nodes]
        self.channels = (self._instruments.channel,)
        self._widths = parameters.run_to_run
        self._seed = seed
        self._modes = [OFF, OFF]
        self._ran = self._resumed = False
        self.day_number = 0
        self.begin_day(self._widths.day(seed, 0))

    def begin_day(self, day: Day) -> None:
        """Set what another day brings; the joints stay where they are."""
        self.plant.begin_day(day)
        self._instruments.begin_day(day)

    def advance(self, dt_s: float) -> bool:
        """Integrate by dt_s and sample everything. An emulated run has no end: always True."""
        self.plant.step(dt_s)
        torque_nm, errors = self.plant.sensor_torque(), None
        if self._readings is not None:
            errors, torque_nm = self._readings.read(torque_nm, dt_s)
        self._instruments.read(self.plant, dt_s, torque_nm, errors)
        return True

    def command(self, drive: int, mode: int, target: float) -> None:
        """Set mode and target of the control loops of drive 0 or 1."""
        modes = self._modes
        if mode != modes[drive]:
            if modes == [OFF, OFF] and not self._resumed:
                self.plant.begin_run()
                if self._ran and self._widths.varies:
                    self.day_number += 1
                    self.begin_day(self._widths.day(self._seed, self.day_number))
            modes[drive] = mode
            self._ran, self._resumed = True, False
        self.plant.command(drive, mode, target)

    def resume(self) -> None:
        """Continue the run with what is enabled next, also after both drives were off."""
        self._resumed = True

    def interpolate(self, drive: int, period_s: float) -> None:
        """Set the time between two velocity targets of drive 0 or 1 [s]."""
        self.plant.drives[drive].interpolation_s = period_s


_SEEDS_APART = 1_000_003
"""Between the seeds of two pairs: noise and days of each are its own."""


def sources_of(parameters: AnyPlant, seed: int, joints: int) -> list[Source]:
    """Return the plants of a bench with so many joints; with two it is the one pair of this seed."""
    return [
        PlantSource(parameters, seed + number * _SEEDS_APART, nodes=min(2, joints - 2 * number))
        for number in range((joints + 1) // 2)
    ]
