"""Flat blocks of parameters or state: copied out of an object as bytes, and back into one of the same layout."""

from libc.string cimport memcpy

cdef inline bytes copied(const void *block, size_t size):
    return (<const char *> block)[:size]


cdef inline int put_back(void *block, size_t size, const unsigned char[::1] content) except -1:
    """Raises ValueError for a block of another layout."""
    if <size_t> content.shape[0] != size:
        raise ValueError(f"found a block of {content.shape[0]} bytes, expected {size}")
    memcpy(block, &content[0], size)
    return 0
