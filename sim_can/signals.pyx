"""What the instruments of all benches read, and their normal noise."""

from libc.math cimport M_PI, NAN, cos, log, sin, sqrt


cdef class Noise:
    """Normal noise of standard deviation 1 from uniform numbers in [0, 1), two at a time (Box and Muller 1958).

    uniform: `random` of a `random.Random`; the numbers are those of its `gauss`. Not numpy's, which would be 7 MB in a
    process that has to stay small.
    """

    def __init__(self, uniform):
        self.uniform = uniform

    cdef double normal(self) except? -1.0:
        cdef double angle, radius
        if self.one_left:
            self.one_left = False
            return self.left
        angle = self.uniform() * (2.0 * M_PI)
        radius = sqrt(-2.0 * log(1.0 - <double>self.uniform()))
        self.left, self.one_left = sin(angle) * radius, True
        return cos(angle) * radius


cdef class DriveSignals:
    """Measured quantities of one drive; mutable, read once per SYNC.

    motor_position_rad: motor side, multi-turn; motor_velocity_rad_s: motor side; link_position_rad: joint side; temperature_c:
    of the joint, nan where it is not measured. `enabled`: the source itself has the drive in operation (a recorded run); the
    node then reports "operation enabled" although no master sent a controlword. The plant leaves it False: its drives are
    enabled by a master or by the demo profile.
    """

    def __init__(self):
        self.temperature_c = NAN


cdef class ChannelSignal:
    """Measured torque of one sensor channel; `valid` False sets bit 0 of 6150h."""

    def __init__(self):
        self.valid = True
