"""Normal noise."""

cimport cython

@cython.final
cdef class Noise:
    cdef object uniform
    cdef double left
    cdef bint one_left
    cdef double normal(self) except? -1.0
