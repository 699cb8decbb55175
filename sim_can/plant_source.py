"""The plant seen through its encoders, current measurement and torque sensor: the default
`sim_can.source.Source`. Pure.
"""

import math
import random
from collections.abc import Callable

from sim_can.effect_plant import EffectPlant
from sim_can.plant import Plant
from sim_can.plant_parameters import JointPlant, PlantParameters
from sim_can.plant_readings import Readings
from sim_can.run_to_run import NOMINAL_DAY, Day, day
from sim_can.source import OFF, ChannelSignal, DriveRatings, DriveSignals

_TWO_PI = 2.0 * math.pi


def ratings_of(side: JointPlant) -> DriveRatings:
    """What the drive of this joint says about itself: nominal values, as a drive knows no others."""
    return DriveRatings(
        gear_ratio=side.joint.gear_ratio,
        rated_current_a=side.drive.rated_current_a,
        rated_torque_nm=side.joint.torque_constant_nm_per_a * side.drive.rated_current_a,
        trip_current_a=side.drive.trip_current_a,
        motor_counts_per_rev=side.measurement.motor_counts_per_rev,
        link_counts_per_rev=side.measurement.link_counts_per_rev,
    )


class _Encoders:
    """Motor encoder, velocity from it, link encoder and current of one drive.

    The motor angle is rounded to counts. Its velocity is the difference of two samples through a first-order
    low pass of `velocity_filter_s`, so it lags by half a sample period plus that time. Noise is added to link
    angle and current. `link_zero_rad` is the link encoder's zero error.
    """

    def __init__(self, side: JointPlant, normal: Callable[[], float]) -> None:
        measurement = side.measurement
        self._count_rad = _TWO_PI / measurement.motor_counts_per_rev
        self._filter_s = measurement.velocity_filter_s
        self._link_noise = measurement.link_noise_rad
        self._current_noise = measurement.current_noise_a
        self._current_offset = measurement.current_offset_a
        self._normal = normal
        self._count = 0
        self._share_dt = -1.0
        self._share = 1.0
        self.link_zero_rad = 0.0

    def sample(
        self, signals: DriveSignals, dt_s: float, motor_rad: float, link_rad: float, current_a: float
    ) -> None:
        count = round(motor_rad / self._count_rad)
        signals.motor_position_rad = count * self._count_rad
        if dt_s > 0.0:
            if dt_s != self._share_dt:
                self._share_dt = dt_s
                self._share = 1.0 - math.exp(-dt_s / self._filter_s) if self._filter_s > 0.0 else 1.0
            difference = (count - self._count) * self._count_rad / dt_s
            signals.motor_velocity_rad_s += self._share * (difference - signals.motor_velocity_rad_s)
        self._count = count
        signals.link_position_rad = link_rad + self._link_noise * self._normal()
        if self.link_zero_rad:
            signals.link_position_rad += self.link_zero_rad
        signals.current_a = current_a + self._current_offset + self._current_noise * self._normal()


def _plant_of(parameters: PlantParameters) -> tuple[Plant, Readings | None]:
    """The plant for these joints, and what its instruments read beside the truth.

    Raises ConfigError for effects that cannot be.
    """
    if not parameters.has_effects:
        return Plant(parameters), None
    plant = EffectPlant(parameters)
    return plant, Readings(plant)


class PlantSource:
    """`Source` of the emulated bench; the same seed and the same calls give the same signals bit by bit.

    Where the plant file has `run_to_run`, the source begins in day 0 of its seed, and each time a drive is
    enabled after both were off again it is another day, unless the run goes on (`resume`). `noise_seed`: of
    the noise, where it is not `seed`.
    """

    def __init__(self, parameters: PlantParameters, seed: int = 0, noise_seed: str | None = None) -> None:
        self.plant, self._readings = _plant_of(parameters)
        self.ratings = tuple(ratings_of(side) for side in parameters.joints)
        self.drives = (DriveSignals(), DriveSignals())
        self.channels = (ChannelSignal(),)
        # random, not numpy.random: five numbers per step cost 1 us, numpy.random 7 MB in a process that has
        # to stay small
        normal = random.Random(seed if noise_seed is None else noise_seed).gauss
        self._normal = normal
        self._encoders = tuple(_Encoders(side, normal) for side in parameters.joints)
        self._sensor = parameters.sensor
        self._offset_nm = 0.0
        self._widths = parameters.run_to_run
        self._seed = seed
        self._modes = [OFF, OFF]
        self._ran = self._resumed = False
        self.day_number = 0
        self.begin_day(day(self._widths, seed, 0))

    def begin_day(self, values: Day = NOMINAL_DAY) -> None:
        """Another day: friction, temperature and zeros as given. The joints stay where they are."""
        self.plant.begin_day(values)
        for encoders, zero in zip(self._encoders, values.link_zero_rad, strict=True):
            encoders.link_zero_rad = zero
        self._offset_nm = self._sensor.offset_nm + values.sensor_zero_nm

    def advance(self, dt_s: float) -> bool:
        """Integrate by dt_s and sample everything. An emulated run has no end: always True."""
        plant = self.plant
        plant.step(dt_s)
        one, two = plant.drives
        link = plant.link_position
        motor_1, motor_2 = plant.motor_position
        drive_1, drive_2 = self.drives
        link_1, link_2, current_1, current_2 = link, -link, one.current_a, two.current_a
        torque_nm = plant.sensor_torque()
        if self._readings is not None:
            (more_1, more_2), torque_nm = self._readings.read(torque_nm, dt_s)
            motor_1, link_1, current_1 = motor_1 + more_1[0], link_1 + more_1[1], current_1 + more_1[2]
            motor_2, link_2, current_2 = motor_2 + more_2[0], link_2 + more_2[1], current_2 + more_2[2]
        self._encoders[0].sample(drive_1, dt_s, motor_1, link_1, current_1)
        self._encoders[1].sample(drive_2, dt_s, motor_2, link_2, current_2)
        warmth_1, warmth_2 = plant.temperatures
        drive_1.temperature_c = warmth_1.celsius
        drive_2.temperature_c = warmth_2.celsius
        sensor = self._sensor
        self.channels[0].torque_nm = (
            sensor.gain * torque_nm + self._offset_nm + sensor.noise_nm * self._normal()
        )
        return True

    def command(self, drive: int, mode: int, target: float) -> None:
        """Mode and target for the control loops of drive 0 or 1."""
        modes = self._modes
        if mode != modes[drive]:
            if modes == [OFF, OFF] and not self._resumed:
                self.plant.begin_run()
                if self._ran and any(self._widths):
                    self.day_number += 1
                    self.begin_day(day(self._widths, self._seed, self.day_number))
            modes[drive] = mode
            self._ran, self._resumed = True, False
        self.plant.command(drive, mode, target)

    def resume(self) -> None:
        """What is enabled next goes on with the run, also after both drives were off."""
        self._resumed = True

    def interpolate(self, drive: int, period_s: float) -> None:
        """Time between two velocity targets of drive 0 or 1 [s]."""
        self.plant.drives[drive].interpolation_s = period_s
