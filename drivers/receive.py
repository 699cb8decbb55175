"""One system call for all frames that have arrived: recvmmsg(2) through ctypes with preallocated memory.

Measured on six frames with time stamps: 6 us, against 12 us for six calls of `socket.recvmsg_into`.
"""

import ctypes
import errno
import struct
from collections.abc import Sequence

from jtqd.drivers.frame import FRAME_SIZE

SO_TIMESTAMPNS = 35  # asm-generic/socket.h; SCM_TIMESTAMPNS is the same number
SO_RXQ_OVFL = 40
NOTHING_YET = frozenset({errno.EAGAIN, errno.EINTR, errno.ECONNRESET})
"""Errors after which the next call gives more. A unix peer that ends with unread data makes ECONNRESET come
before what it had sent; its frames and then the end follow."""
_SOL_SOCKET = 1
_MSG_TRUNC = 0x20
_MSG_DONTWAIT = 0x40
_CONTROL_SIZE = 64  # stamp 32 bytes + overflow counter 24 bytes
_STAMP_ONLY = 32
_STAMP_AND_OVERFLOW = 56

# struct cmsghdr is (size_t length, int level, int type); level and type are read as one 64-bit word.
_STAMP_WORD = SO_TIMESTAMPNS << 32 | _SOL_SOCKET
_OVERFLOW_WORD = SO_RXQ_OVFL << 32 | _SOL_SOCKET
_CMSG = struct.Struct("=QQ")
_OVERFLOW = struct.Struct("=I")
_STAMP_SLOT = struct.Struct("=16xqq32x")  # one control slot whose first message is the stamp
_HEADER_RESULT = struct.Struct("=QI4xI4x")  # control_length, flags, length of mmsghdr, from byte 40
_TIMESPEC = struct.Struct("=qq")
_NS_PER_S = 1_000_000_000


class _IoVec(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MsgHdr(ctypes.Structure):
    """`struct msghdr`."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("iov", ctypes.POINTER(_IoVec)),
        ("iov_length", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _MMsgHdr(ctypes.Structure):
    """`struct mmsghdr`; 64 bytes on 64-bit Linux."""

    _fields_ = (("header", _MsgHdr), ("length", ctypes.c_uint))


_libc = ctypes.CDLL(None, use_errno=True)


_HEADER_SIZE = ctypes.sizeof(_MMsgHdr)
_HEADER_WORDS = _HEADER_SIZE // 8


class FrameReceiver:
    """Receive up to `capacity` messages of 16 bytes per call; not bound to one socket.

    After `receive` returned n > 0:

    - `frames`: bytearray, 16 bytes per message, filled for the first n;
    - `lengths[i]`: bytes the message had (a longer one is cut to 16);
    - `flags[i]`: msg_flags (on AF_CAN MSG_CONFIRM = own echo, MSG_DONTROUTE = sent on this host);
    - `stamps_ns[i]`: the kernel's receive time stamp, CLOCK_REALTIME in ns; 0 where it gave none;
    - `overflow`: last value of the kernel's SO_RXQ_OVFL counter seen on the socket.

    `closed` is set when the peer of a unix socket has ended. Zero bytes with a time stamp are an empty
    message, zero bytes without are the end.
    """

    def __init__(self, capacity: int = 32) -> None:
        self.frames = bytearray(FRAME_SIZE * capacity)
        self.lengths: Sequence[int] = ()
        self.flags: Sequence[int] = ()
        self.stamps_ns: Sequence[int] = ()
        self.overflow = 0
        self.closed = False
        self._capacity = capacity
        self._control = bytearray(_CONTROL_SIZE * capacity)
        self._headers_memory = (_MMsgHdr * capacity)()
        self._iovecs = (_IoVec * capacity)()
        frames_at = ctypes.addressof((ctypes.c_char * len(self.frames)).from_buffer(self.frames))
        control_at = ctypes.addressof((ctypes.c_char * len(self._control)).from_buffer(self._control))
        for i in range(capacity):
            self._iovecs[i] = _IoVec(frames_at + FRAME_SIZE * i, FRAME_SIZE)
            self._headers_memory[i].header = _MsgHdr(
                None,
                0,
                ctypes.pointer(self._iovecs[i]),
                1,
                control_at + _CONTROL_SIZE * i,
                _CONTROL_SIZE,
                0,
            )
        self._headers = memoryview(self._headers_memory).cast("B")
        self._template = bytes(self._headers)
        self._address = ctypes.c_void_p(ctypes.addressof(self._headers_memory))
        self._recvmmsg = _libc.recvmmsg
        self._recvmmsg.argtypes = (
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.c_void_p,
        )
        sizes = range(capacity + 1)
        self._head_struct = [struct.Struct("=" + "40xQI4xI4x" * n) for n in sizes]
        self._control_views = [memoryview(self._control)[: _CONTROL_SIZE * n] for n in sizes]
        self._full = [(FRAME_SIZE,) * n for n in sizes]
        self._no_flags = [(0,) * n for n in sizes]
        self._stamp_only = [(_STAMP_ONLY,) * n for n in sizes]
        self._stamp_and_overflow = [(_STAMP_AND_OVERFLOW,) * n for n in sizes]
        # Headers as the kernel leaves them in the usual case; compared as 64-bit words: 0.1 us.
        words = self._headers.cast("Q")
        usual = memoryview(self._usual_headers(capacity)).cast("Q")
        self._header_words = [words[: _HEADER_WORDS * n] for n in sizes]
        self._usual_words = [usual[: _HEADER_WORDS * n] for n in sizes]

    def receive(self, fd: int) -> int:
        """Take what has arrived on `fd` without waiting; return the number of messages, or -errno.

        An error after some messages is kept by the kernel and comes with the next call.
        """
        self._headers[:] = self._template  # control_length and flags are overwritten by each call
        n = int(self._recvmmsg(fd, self._address, self._capacity, _MSG_DONTWAIT | _MSG_TRUNC, None))
        if n < 0:
            return -ctypes.get_errno()
        if self._header_words[n] == self._usual_words[n]:
            self.flags = self._no_flags[n]
            self.lengths = self._full[n]
            self.stamps_ns = [s * _NS_PER_S + ns for s, ns in _STAMP_SLOT.iter_unpack(self._control_views[n])]
            return n
        head = self._head_struct[n].unpack_from(self._headers)
        self.flags = head[1::3]
        self.lengths = head[2::3]
        sizes = head[0::3]
        if sizes in (self._stamp_only[n], self._stamp_and_overflow[n]):  # the kernel puts the stamp first
            self.stamps_ns = [s * _NS_PER_S + ns for s, ns in _STAMP_SLOT.iter_unpack(self._control_views[n])]
            if sizes[0] == _STAMP_AND_OVERFLOW:
                (self.overflow,) = _OVERFLOW.unpack_from(self._control, _CONTROL_SIZE * (n - 1) + 48)
            return n
        return self._walk(n, sizes)

    def _usual_headers(self, capacity: int) -> bytes:
        """Return the headers of `capacity` full frames with a stamp, no flags and nothing else."""
        image = bytearray(self._template)
        for i in range(capacity):
            _HEADER_RESULT.pack_into(image, _HEADER_SIZE * i + 40, _STAMP_ONLY, 0, FRAME_SIZE)
        return bytes(image)

    def _walk(self, n: int, sizes: Sequence[int]) -> int:
        """Read control messages of any layout; return the number of messages before the end of the stream."""
        stamps = [0] * n
        for i in range(n):  # the end of the stream fills every slot that is left
            if sizes[i] == 0 and self.lengths[i] == 0:
                self.closed = True
                n = i
                break
            at = _CONTROL_SIZE * i
            end = at + sizes[i]
            while at + _CMSG.size <= end:
                size, word = _CMSG.unpack_from(self._control, at)
                if size < _CMSG.size:
                    break
                if word == _STAMP_WORD:
                    seconds, nanoseconds = _TIMESPEC.unpack_from(self._control, at + _CMSG.size)
                    stamps[i] = seconds * _NS_PER_S + nanoseconds
                elif word == _OVERFLOW_WORD:
                    (self.overflow,) = _OVERFLOW.unpack_from(self._control, at + _CMSG.size)
                at += (size + 7) & ~7
        self.stamps_ns = stamps
        return n
