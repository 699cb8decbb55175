"""A file that only grows by whole pieces, with room kept on the disk for what must still come."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os

_STEP = 256 * 1024
"""Room is taken in steps of this many bytes: the disk is asked for it about once a second."""
_KEEP_SIZE = 1
_WITHOUT = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
_LIBC = ctypes.CDLL(None, use_errno=True)


def _fallocate(descriptor: int, start: int, length: int) -> None:
    """Blocks for a range behind the end of the file, whose length stays as it is. Raises OSError."""
    call = getattr(_LIBC, "fallocate64", None) or _LIBC.fallocate
    offsets = ctypes.c_int64(start), ctypes.c_int64(length)
    if call(ctypes.c_int(descriptor), ctypes.c_int(_KEEP_SIZE), *offsets):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


class Appender:
    """One new file, open for writing. What raises OSError leaves in it what it held before.

    It is locked (`flock`) as long as it is open: whoever finds it unlocked may take it for left behind.

    Args:
        name: of the file, which must not exist.
        directory: descriptor of its directory, which may be moved meanwhile.
    """

    def __init__(self, name: str, directory: int) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._file = os.open(name, flags, 0o644, dir_fd=directory)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.offset = 0
        self._reserved = 0
        self._can_reserve = True

    def append(self, data: bytes, room: int = 0) -> None:
        """Have `data` on the disk, and blocks for `room` bytes more behind it."""
        if self.removed:
            raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")
        end = self.offset + len(data)
        self._reserve(end + room)
        try:
            view, at = memoryview(data), self.offset
            while view:
                written = os.pwrite(self._file, view, at)
                view, at = view[written:], at + written
            os.fdatasync(self._file)
        except OSError:
            self._take_back()
            raise
        self.offset = end

    def _reserve(self, end: int) -> None:
        if end <= self._reserved or not self._can_reserve:
            return
        length = -(-(end - self._reserved) // _STEP) * _STEP
        try:
            _fallocate(self._file, self._reserved, length)
        except OSError as error:
            if error.errno not in _WITHOUT:
                raise
            self._can_reserve = False
        self._reserved += length

    def _take_back(self) -> None:
        """Cut off a piece that was half written; this gives the room away, so take it again."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, self.offset)
            if self._can_reserve and self._reserved > self.offset:
                _fallocate(self._file, self.offset, self._reserved - self.offset)

    @property
    def removed(self) -> bool:
        """It has no name any more: nothing of it will be found."""
        return os.fstat(self._file).st_nlink == 0

    @property
    def free_bytes(self) -> int:
        """Free space of its file system, without what is for root only."""
        found = os.fstatvfs(self._file)
        return found.f_bavail * found.f_frsize

    def close(self) -> None:
        """Give back the room that was not used, and close."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file, self.offset)
        os.close(self._file)
