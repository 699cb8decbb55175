"""The record of one cycle, written straight into the ring's memory.

The layout is that of `jtqd.daemon.shared.cycle_record`, little endian; where the structs of record.pxd differ from it, this
module cannot be imported.
"""

from libc.stdint cimport int64_t, uint8_t, uint64_t
from libc.string cimport memcpy

import sys

from jtqd.drivers.frame_socket cimport Frame
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator.settings import METHODS

cdef extern from *:
    """
    static inline void publish(uint64_t *word, uint64_t value) {
        __atomic_store_n(word, value, __ATOMIC_RELEASE);
    }
    """
    void publish(uint64_t *word, uint64_t value) noexcept nogil

if sys.byteorder != "little":
    raise ImportError("the cycle record is little endian, this machine is not")


def _check_layout():
    """Raise ImportError where C lays the record out in another way than `cycle_record` does."""
    found = sizeof(Header), sizeof(JointBlock), sizeof(ShadowBlock), sizeof(Frame), MOST_JOINTS, MOST_FRAMES
    most = cr.layout_of(cr.MOST_JOINTS)
    expected = cr.HEADER.size, cr.JOINT.size, cr.SHADOW.size, 16, cr.MOST_JOINTS, most.frame_capacity
    if found != expected:
        raise ImportError(f"found a cycle record with {found}, expected {expected}")
    fields = Header(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), JointBlock(
        1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17, 18, 19, 20
    )
    named = cr.Header(**fields[0]), cr.JointRecord(**fields[1])
    if named != (tuple(range(1, 16)), tuple(range(1, 21))):
        raise ImportError(f"found a cycle record with the fields {named}")
    if cr.SHADOW_METHODS != tuple(METHODS) or len(METHODS) != MOST_METHODS:
        raise ImportError(f"found a cycle record with the methods {cr.SHADOW_METHODS}, expected {tuple(METHODS)}")


_check_layout()


cdef class RecordRing:
    """The record of the current cycle in the ring's memory (`jtqd.daemon.shared.cycle_record.Ring`), and its frames.

    Frames are copied unchanged: `count` are stored in the record, `left_out` found no room.
    """

    def __init__(self, ring, int joints=2, bint shadow=False):
        cdef Py_ssize_t word = cr.COUNT_WORD
        found = cr.layout_of(joints, shadow)
        self.layout = Layout(
            joints, found.frame_capacity, found.frames_offset, found.stamps_offset, found.shadow_offset,
            found.tail_offset, found.size
        )
        self.memory = ring
        self.head, self.records, self.slots = ring.words, ring.records, ring.size
        self.written = &self.head[word]
        if <uint64_t> self.records.shape[0] != self.slots * self.layout.size:
            raise ValueError(f"found a ring of {self.records.shape[0]} bytes for {self.slots} cycles of {joints} joints")
        self.begin()

    cdef void begin(self) noexcept nogil:
        """Begin the record that the next `commit` publishes."""
        cdef uint8_t *start = &self.records[(self.written[0] % self.slots) * self.layout.size]
        cdef int stored = min(self.kept.count, self.layout.frame_capacity)
        self.record = Record(
            <Header *> start,
            <JointBlock *> (start + sizeof(Header)),
            <Frame *> (start + self.layout.frames_offset),
            <int64_t *> (start + self.layout.stamps_offset),
            <ShadowBlock *> (start + self.layout.shadow_offset),
            <uint64_t *> (start + self.layout.tail_offset),
        )
        self.count = self.left_out = 0
        self.keep(self.kept.frames, self.kept.stamps_ns, stored)
        self.left_out = self.kept.count - stored
        self.kept.count = 0

    cdef void commit(self) noexcept nogil:
        """Publish the record: one 8-byte store, after all others."""
        publish(self.written, self.written[0] + 1)

    cdef void keep_for_next(self, const Frame *frame, int64_t stamp_ns) noexcept nogil:
        """Keep a frame of a slot without a record for the next record."""
        if self.kept.count < self.layout.frame_capacity:
            self.kept.frames[self.kept.count] = frame[0]
            self.kept.stamps_ns[self.kept.count] = stamp_ns
        self.kept.count += 1

    cdef void keep(self, const Frame *frames, const int64_t *stamps_ns, int count) noexcept nogil:
        """Copy `count` frames; `stamps_ns` are CLOCK_REALTIME, of our own when they were handed to the socket."""
        cdef int stored = min(count, self.layout.frame_capacity - self.count)
        memcpy(&self.record.frames[self.count], frames, stored * sizeof(Frame))
        memcpy(&self.record.stamps_ns[self.count], stamps_ns, stored * sizeof(int64_t))
        self.count += stored
        self.left_out += count - stored
