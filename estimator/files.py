"""Files of other people and programs: opened without waiting, read up to a bound; outputs that are whole or not there.

What another user of the machine has made is not believed where `owners` are given: `trusted_users`.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
import struct
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final

from jtqd.estimator.errors import ConfigError

_SERVICES: Final = Path("/run/jtqd")
"""Runtime directories of the services; only root makes entries in it."""
_Name = str | os.PathLike[str]


def trusted_users() -> frozenset[int]:
    """Return the user-IDs whose files and sockets are believed: root, this process's user, and the users of services."""
    users = {0, os.getuid()}
    with suppress(OSError):
        if _SERVICES.lstat().st_uid == 0:
            users |= {each.stat(follow_symlinks=False).st_uid for each in os.scandir(_SERVICES)}
    return frozenset(users)


def peer_user(sock: socket.socket) -> int:
    """Return the user-ID of the process at the other end of a connected unix socket."""
    return int(struct.unpack("3i", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[1])


def open_regular(path: _Name, flags: int = os.O_RDONLY, *, owners: Container[int] | None = None) -> int:
    """Return the descriptor of a regular file; a pipe, a device or a directory is neither waited for nor read.

    owners: users one of whom must own the file, which not everybody may write; a link is then not followed. Raises OSError.
    """
    flags |= os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC | (0 if owners is None else os.O_NOFOLLOW)
    try:
        descriptor = os.open(path, flags)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error), os.fspath(path)) from None
    found = os.fstat(descriptor)
    if stat.S_ISDIR(found.st_mode):
        problem = os.strerror(errno.EISDIR)
    elif not stat.S_ISREG(found.st_mode):
        problem = "found no regular file"
    elif owners is not None and found.st_uid not in owners:
        problem = f"it belongs to user {found.st_uid}"
    elif owners is not None and found.st_mode & stat.S_IWOTH:
        problem = "every user may write it"
    else:
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, problem, os.fspath(path))


def read_file(path: _Name, largest: int | None = None, *, owners: Container[int] | None = None) -> bytes:
    """Return the content of a file as `open_regular` opens it. Raises OSError, also for more than `largest` bytes."""
    with open(open_regular(path, owners=owners), "rb") as file:
        data = file.read() if largest is None else file.read(largest + 1)
    if largest is not None and len(data) > largest:
        raise OSError(errno.EFBIG, f"found more than {largest} bytes", os.fspath(path))
    return data


def read_regular(path: _Name, largest: int, expected: str) -> bytes:
    """Return the content of a file of the operator, as `read_file`.

    Raises ConfigError; `expected` names in its message what the file should be.
    """
    try:
        return read_file(path, largest)
    except OSError as error:
        reason = error.strerror or str(error)
        what = f"{reason}, expected {expected}" if reason.startswith("found") else f"cannot be read: {reason}"
        name = os.fspath(path)
        raise ConfigError(f"{name if name.isprintable() else repr(name)}: {what}") from None


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Open an output that is there when it is complete, or as it was before.

    A link is followed. Only a regular file is replaced, by one of the same mode; a pipe, a device and what is standard
    output are written to as they are. Raises OSError.
    """
    found = None
    with suppress(FileNotFoundError):
        found = os.stat(path)
    target, partial = Path(os.path.realpath(path)), None
    try:
        if found is None or (stat.S_ISREG(found.st_mode) and not _is_output(found)):
            partial = target.with_name(f".{target.name}.{os.urandom(4).hex()}.part")
            plain = open(partial, "xb")  # noqa: SIM115 - closed below
        else:
            plain = open(path, "ab" if stat.S_ISREG(found.st_mode) else "wb")  # noqa: SIM115
        with plain:
            yield plain
            if partial is not None:
                if found is not None:
                    os.fchmod(plain.fileno(), stat.S_IMODE(found.st_mode))
                plain.flush()
                os.fsync(plain.fileno())
        if partial is not None:
            os.replace(partial, target)
    except OSError as error:
        if error.filename in (None, str(partial)):
            error.filename = str(path)
        raise
    finally:
        if partial is not None:
            with suppress(OSError):
                partial.unlink()


def _is_output(found: os.stat_result) -> bool:
    """Return whether a file is what standard output or standard error is redirected to."""
    with suppress(OSError):
        return any(os.path.samestat(found, os.fstat(number)) for number in (1, 2))
    return False


def write_whole(path: Path, data: bytes) -> None:
    """Write an output as `whole_file` does. Raises OSError."""
    with whole_file(path) as file:
        file.write(data)
