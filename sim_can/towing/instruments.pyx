"""What encoders, current measurement and torque sensor of a towing bench make of the truth. Pure.

    motor = counts(θ + zero + Σ e_k cos(k θ + φ_k))          link = φ + zero + Σ e_k cos(k φ + φ_k) + noise
    current = (i + ripple(θ)) (1 + gain) + zero + noise          sensor = gain τ + zero + noise

The motor's velocity is the difference of two counts through a first-order low pass, made in the drive: it has the encoder's errors, too.
"""

from libc.math cimport M_PI, exp, rint

from jtqd.sim_can.signals cimport Noise
from jtqd.sim_can.signals cimport ChannelSignal, DriveSignals
from jtqd.sim_can.towing.plant cimport TowingPlant
from jtqd.sim_can.towing.plant cimport waves_at, waves_of


cdef class Readings:
    """Encoders and current measurement of one drive; `law`: `bench_file.Measurement`. signals: what is read."""

    def __init__(self, law, Noise noise not None):
        self.count_rad = 2.0 * M_PI / law.motor_counts_per_rev
        self.filter_s, self.link_noise, self.current_noise = law.velocity_filter_s, law.link_noise_rad, law.current_noise_a
        self.motor_errors = waves_of(law.motor_errors)
        self.link_errors = waves_of(law.link_errors)
        self.current_ripple = waves_of(law.current_ripple)
        self.noise, self.signals = noise, DriveSignals()
        self.share_dt, self.share = -1.0, 1.0
        self.begin_day(0.0, 0.0, 0.0, 0.0)

    cpdef begin_day(self, double motor_zero_rad, double link_zero_rad, double current_zero_a, double current_gain):
        """Set zeros and gain of another day."""
        self.motor_zero, self.link_zero = motor_zero_rad, link_zero_rad
        self.current_zero, self.current_gain = current_zero_a, 1.0 + current_gain

    cpdef sample(self, double motor_rad, double link_rad, double current_a, double housing_c, double dt_s):
        """Set the signals to what is read at these true values, dt_s after the last sample."""
        cdef double read = motor_rad + self.motor_zero + waves_at(&self.motor_errors, motor_rad)
        cdef double count = rint(read / self.count_rad) + 0.0  # no minus zero
        cdef double ripple = waves_at(&self.current_ripple, motor_rad)
        if dt_s > 0.0:
            if dt_s != self.share_dt:
                self.share_dt = dt_s
                self.share = 1.0 - exp(-dt_s / self.filter_s) if self.filter_s > 0.0 else 1.0
            self.signals.motor_velocity_rad_s += self.share * (
                (count - self.last_count) * self.count_rad / dt_s - self.signals.motor_velocity_rad_s
            )
        self.last_count = count
        self.signals.motor_position_rad = count * self.count_rad
        self.signals.link_position_rad = (
            link_rad + self.link_zero + waves_at(&self.link_errors, link_rad) + self.link_noise * self.noise.normal()
        )
        self.signals.current_a = (
            self.current_gain * (current_a + ripple) + self.current_zero + self.current_noise * self.noise.normal()
        )
        self.signals.temperature_c = housing_c


cdef class Instruments:
    """All instruments of a bench: `drives` and `channel` are what they read; `parameters`: `bench_file.TowingBench`."""

    def __init__(self, parameters, Noise noise not None):
        self.readings = tuple(Readings(side.measurement, noise) for side in parameters.joints)
        self.drives = tuple(each.signals for each in self.readings)
        self.channel, self.noise = ChannelSignal(), noise
        self.gain, self.zero_nm, self.noise_nm = parameters.sensor.gain, parameters.sensor.offset_nm, parameters.sensor.noise_nm
        self.day_zero_nm = 0.0

    def begin_day(self, day):
        """Set zeros and gains of another day (`days.Day`)."""
        self.day_zero_nm = day.sensor_zero_nm
        for reading, values in zip(self.readings, day.joints, strict=True):
            reading.begin_day(values.motor_zero_rad, values.link_zero_rad, values.current_zero_a, values.current_gain)

    def read(self, TowingPlant plant not None, double dt_s, double torque_nm):
        """Sample everything, dt_s after the last time; torque_nm: at the sensor."""
        self.readings[0].sample(
            plant.one.angle, plant.link_position, plant.one.drive.current_a, plant.one.warmth.housing_c, dt_s
        )
        self.readings[1].sample(
            plant.two.angle, -plant.link_position, plant.two.drive.current_a, plant.two.warmth.housing_c, dt_s
        )
        self.channel.torque_nm = (
            self.gain * torque_nm + self.zero_nm + self.day_zero_nm + self.noise_nm * self.noise.normal()
        )
