"""Encoders, current measurement and torque sensor of the bench: what they make of the truth. Pure."""

from libc.math cimport M_PI, exp, rint

from jtqd.sim_can.signals cimport Noise
from jtqd.sim_can.plant cimport Plant
from jtqd.sim_can.signals cimport ChannelSignal, DriveSignals


cdef class Encoders:
    """Motor encoder, velocity from it, link encoder and current of one drive.

    The motor angle is rounded to counts. Its velocity is the difference of two samples through a first-order
    low pass of `velocity_filter_s`, so it lags by half a sample period plus that time. Noise is added to link
    angle and current. `link_zero_rad` is the link encoder's zero error.
    """

    def __init__(self, side, Noise noise not None):
        measurement = side.measurement
        self.count_rad = 2.0 * M_PI / measurement.motor_counts_per_rev
        self.filter_s = measurement.velocity_filter_s
        self.link_noise = measurement.link_noise_rad
        self.current_noise = measurement.current_noise_a
        self.current_offset = measurement.current_offset_a
        self.noise = noise
        self.share_dt, self.share = -1.0, 1.0

    cpdef sample(self, DriveSignals signals, double dt_s, double motor_rad, double link_rad, double current_a):
        """Set the signals to what is read at these true values, dt_s after the last sample."""
        cdef double count = rint(motor_rad / self.count_rad) + 0.0  # a count is a whole number: no minus zero
        cdef double difference
        signals.motor_position_rad = count * self.count_rad
        if dt_s > 0.0:
            if dt_s != self.share_dt:
                self.share_dt = dt_s
                self.share = 1.0 - exp(-dt_s / self.filter_s) if self.filter_s > 0.0 else 1.0
            difference = (count - self.count) * self.count_rad / dt_s
            signals.motor_velocity_rad_s += self.share * (difference - signals.motor_velocity_rad_s)
        self.count = count
        signals.link_position_rad = link_rad + self.link_noise * self.noise.normal()
        if self.link_zero_rad:
            signals.link_position_rad += self.link_zero_rad
        signals.current_a = current_a + self.current_offset + self.current_noise * self.noise.normal()


cdef class TorqueSensor:
    """The torque sensor: measured = gain * true + offset + noise; `offset_nm` is the present day's."""

    def __init__(self, sensor, Noise noise not None):
        self.gain, self.offset_nm, self.noise_nm = sensor.gain, sensor.offset_nm, sensor.noise_nm
        self.noise = noise

    cpdef sample(self, ChannelSignal signal, double torque_nm):
        """Set the signal to what is read at this true torque."""
        signal.torque_nm = self.gain * torque_nm + self.offset_nm + self.noise_nm * self.noise.normal()


cdef class Instruments:
    """All instruments of the bench: `encoders` of both drives, `sensor`; `drives` and `channel` are what they read."""

    def __init__(self, parameters, Noise noise not None):
        self.encoders_1, self.encoders_2 = (Encoders(side, noise) for side in parameters.joints)
        self.encoders = (self.encoders_1, self.encoders_2)
        self.sensor = TorqueSensor(parameters.sensor, noise)
        self.drive_1, self.drive_2, self.channel = DriveSignals(), DriveSignals(), ChannelSignal()
        self.drives = (self.drive_1, self.drive_2)
        self.zero_nm = parameters.sensor.offset_nm

    def begin_day(self, day):
        """Set the zeros of another day (`days.Day`)."""
        self.encoders_1.link_zero_rad, self.encoders_2.link_zero_rad = day.link_zero_rad
        self.sensor.offset_nm = self.zero_nm + day.sensor_zero_nm

    def read(self, Plant plant not None, double dt_s, double torque_nm, errors):
        """Sample everything, dt_s after the last time.

        torque_nm: at the sensor; errors: what motor encoder, link encoder and current of both joints read above the truth,
        None for nothing.
        """
        cdef double motor_1 = plant.state[0].angle, motor_2 = plant.state[1].angle
        cdef double link_1 = plant.link_position, link_2 = -plant.link_position
        cdef double current_1 = plant.drive_1.current_a, current_2 = plant.drive_2.current_a
        if errors is not None:
            (more_1, more_2) = errors
            motor_1, link_1, current_1 = motor_1 + more_1[0], link_1 + more_1[1], current_1 + more_1[2]
            motor_2, link_2, current_2 = motor_2 + more_2[0], link_2 + more_2[1], current_2 + more_2[2]
        self.encoders_1.sample(self.drive_1, dt_s, motor_1, link_1, current_1)
        self.encoders_2.sample(self.drive_2, dt_s, motor_2, link_2, current_2)
        self.drive_1.temperature_c = plant.temperature_1.celsius
        self.drive_2.temperature_c = plant.temperature_2.celsius
        self.sensor.sample(self.channel, torque_nm)
