"""Normal noise of the instruments of all benches."""

from libc.math cimport M_PI, cos, log, sin, sqrt


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
