"""Flat blocks of state: copied out of an object as bytes, and back into one of the same layout."""

cdef inline bytes copied(const void *block, size_t size):
    return (<const char *> block)[:size]


cdef inline int put_back(void *block, size_t size, bytes content) except -1:
    """Raises ValueError for a block of another layout."""
    cdef const char *source = content
    cdef size_t n
    if <size_t> len(content) != size:
        raise ValueError(f"found a block of {len(content)} bytes, expected {size}")
    for n in range(size):
        (<char *> block)[n] = source[n]
    return 0
