"""What the instruments of the bench read: signals of the drives and of the torque sensor's channels."""

from libc.math cimport NAN


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
