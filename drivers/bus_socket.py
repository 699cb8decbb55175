"""Sockets of a bus, opened with filters and time stamps: AF_CAN raw (`can0`) or a client of a unix bus (`unix:PATH`).

An error is a BusError, in one of three classes that need different reactions. `jtqd.drivers.frame_socket` sends and
receives on these sockets.

Filters have the meaning of CAN_RAW_FILTER and are run by the kernel: (frame.can_id & mask) == (filter.can_id & mask). AF_CAN
takes them as they are; on a unix bus a classic BPF program does the same before a frame is queued (`struct sock_filter`,
SO_ATTACH_FILTER: linux/filter.h, asm-generic/socket.h).
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import socket
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    FRAME_SIZE,
)
from jtqd.estimator.files import peer_user, trusted_users

SO_TIMESTAMPNS = 35  # asm-generic/socket.h
SO_RXQ_OVFL = 40


class BusError(Exception):
    """The bus cannot be used; the message is one line with the name of the bus and what to do."""


class BusDown(BusError):  # noqa: N818 - a state of the bus
    """The interface is down (ENETDOWN): keep the socket, it works again after `ip link set up`."""


class BusGone(BusError):  # noqa: N818
    """The interface was removed (ENODEV) or the hub has ended: close the socket and open a new one."""


_GONE = frozenset(
    {errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN, errno.ESHUTDOWN, errno.EBADF}
)


def from_errno(number: int, bus: str) -> BusError:
    """Make the exception for error `number` of a system call on the socket of `bus`.

    ENETDOWN leaves a CAN socket bound; ENODEV (receive) and ENXIO (send) unbind it for good
    (net/can/raw.c, raw_notify and raw_sendmsg).
    """
    if number == errno.ENETDOWN:
        return BusDown(f"{bus}: the interface is down")
    if number in _GONE:
        return BusGone(f"{bus}: bus lost ({os.strerror(number)})")
    return BusError(f"{bus}: {os.strerror(number)} (errno {number})")


# Filters

MAX_FILTERS = 512  # CAN_RAW_FILTER_MAX
_FILTER_STRUCT = struct.Struct("=II")


class CanFilter(NamedTuple):
    """One `struct can_filter`; a frame is received when it matches any filter of the socket."""

    can_id: int
    mask: int


EVERYTHING = (CanFilter(0, 0),)
"""Every frame of the bus but error frames, which have their own switch."""


def exact(can_id: int) -> CanFilter:
    """Return the filter for the data frame `can_id` and nothing else: no remote frame, no other format."""
    identifier = CAN_EFF_MASK if can_id & CAN_EFF_FLAG else CAN_SFF_MASK
    return CanFilter(can_id, identifier | CAN_EFF_FLAG | CAN_RTR_FLAG)


def any_format(can_id: int) -> CanFilter:
    """Return the filter for `can_id` in both formats, data and remote, so that frames of the wrong kind can be counted."""
    return CanFilter(can_id & CAN_EFF_MASK, CAN_EFF_MASK)


def checked_filters(filters: Iterable[CanFilter] | None) -> tuple[CanFilter, ...]:
    """Return `filters` as a tuple; None means everything.

    Raises ValueError for values beyond 32 bits, more than 512 filters, or the flag of inverted filters
    (CAN_INV_FILTER, the same bit as CAN_ERR_FLAG), which the BPF program does not know.
    """
    if filters is None:
        return EVERYTHING
    result = tuple(CanFilter(*each) for each in filters)
    if len(result) > MAX_FILTERS:
        raise ValueError(f"at most {MAX_FILTERS} filters, not {len(result)}")
    for can_id, mask in result:
        if not (0 <= can_id <= 0xFFFFFFFF and 0 <= mask <= 0xFFFFFFFF):
            raise ValueError(f"filter beyond 32 bits: {can_id:#x} mask {mask:#x}")
        if (can_id | mask) & CAN_ERR_FLAG:
            raise ValueError(f"filter with CAN_ERR_FLAG or CAN_INV_FILTER: {can_id:#x} mask {mask:#x}")
    return result


def can_raw_filter(filters: Iterable[CanFilter]) -> bytes:
    """Return the value of setsockopt CAN_RAW_FILTER."""
    return b"".join(_FILTER_STRUCT.pack(*each) for each in filters)


# The same as a BPF program ------------------------------------------------------------------------------------

SO_ATTACH_FILTER = 26

_LOAD_LENGTH = 0x80  # BPF_LD | BPF_W | BPF_LEN
_LOAD_WORD = 0x20  # BPF_LD | BPF_W | BPF_ABS
_AND = 0x54  # BPF_ALU | BPF_AND | BPF_K
_JUMP_EQUAL = 0x15  # BPF_JMP | BPF_JEQ | BPF_K
_JUMP_SET = 0x45  # BPF_JMP | BPF_JSET | BPF_K
_RETURN = 0x06  # BPF_RET | BPF_K
_A_TO_X = 0x07  # BPF_MISC | BPF_TAX
_X_TO_A = 0x87  # BPF_MISC | BPF_TXA

_ACCEPT = (_RETURN, 0, 0, FRAME_SIZE)
_REJECT = (_RETURN, 0, 0, 0)
_INSTRUCTION = struct.Struct("=HBBI")


class _Program(ctypes.Structure):
    """`struct sock_fprog`."""

    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_void_p))


def _as_loaded(value: int) -> int:
    """Return what a BPF load, which is big endian, gives for a host-endian `value` in memory."""
    return int.from_bytes(struct.pack("=I", value), "big")


def bpf_program(filters: Sequence[CanFilter], error_frames: bool) -> list[tuple[int, int, int, int]]:
    """Return the instructions (code, jump if true, jump if false, constant).

    A message is accepted when it is 16 bytes long and matches one of `filters`; error frames pass by
    `error_frames` alone, as on AF_CAN (af_can.c, can_rcv_filter). Jumps are at most one instruction long, so
    512 filters (2054 instructions, the kernel takes 4096) need no far jump.
    """
    code = [
        (_LOAD_LENGTH, 0, 0, 0),
        (_JUMP_EQUAL, 1, 0, FRAME_SIZE),
        _REJECT,
        (_LOAD_WORD, 0, 0, 0),
        (_JUMP_SET, 0, 1, _as_loaded(CAN_ERR_FLAG)),
        _ACCEPT if error_frames else _REJECT,
        (_A_TO_X, 0, 0, 0),
    ]
    for can_id, mask in filters:
        code += [
            (_X_TO_A, 0, 0, 0),
            (_AND, 0, 0, _as_loaded(mask)),
            (_JUMP_EQUAL, 0, 1, _as_loaded(can_id & mask)),
            _ACCEPT,
        ]
    code.append(_REJECT)
    return code


def attach_filters(sock: socket.socket, filters: Sequence[CanFilter], error_frames: bool) -> None:
    """Attach the program for `filters` to `sock` in place of the present one. Raises OSError."""
    code = bpf_program(filters, error_frames)
    memory = ctypes.create_string_buffer(b"".join(_INSTRUCTION.pack(*each) for each in code))
    # The kernel copies the program within setsockopt; `memory` outlives the call by being a local name.
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, bytes(_Program(len(code), ctypes.addressof(memory))))


# A unix bus: AF_UNIX SOCK_SEQPACKET, one 16-byte frame per message ----------------------------------------------

PREFIX = "unix:"
BUFFER_BYTES = 1 << 20  # the kernel cuts it to net.core.rmem_max, wmem_max
_CONNECT_TIMEOUT = struct.Struct("@ll").pack(2, 0)  # struct timeval
_LONGEST_ADDRESS = 107  # bytes of `sun_path` without its end (unix(7))


@contextmanager
def reachable(path: Path | str) -> Iterator[str]:
    """Give the address to bind or connect to for the socket at `path`, in a directory of any depth.

    A path too long for the kernel is reached through its directory, held open as a descriptor while the `with` lasts:
    /proc/self/fd/N/NAME.

    Raises:
        OSError: a path is too long and its directory cannot be opened. A name that alone is too long stays as it is: `bind`
            refuses it.
    """
    text = os.fspath(path)
    directory, name = os.path.split(text)
    if len(os.fsencode(text)) <= _LONGEST_ADDRESS or not name:
        yield text
        return
    descriptor = os.open(directory or ".", os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{name}"
    finally:
        os.close(descriptor)


def require_directory(path: str) -> None:
    """Raise BusError when there is no directory for a bus at `path`."""
    directory = os.path.dirname(path) or "."
    if not os.path.isdir(directory):
        what = "is not a directory" if os.path.lexists(directory) else "does not exist"
        raise BusError(f"{PREFIX}{path}: the directory {directory} {what}")


def open_unix(path: str, filters: Sequence[CanFilter], error_frames: bool) -> socket.socket:
    """Return a non-blocking socket connected to the hub at `path`; its filters are on before it connects.

    Raises BusError: no hub, no such directory, another kind of socket, a hub that does not answer within 2 s.
    """
    bus = PREFIX + path
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        attach_filters(sock, filters, error_frames)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        # Bounds connect() when the hub hangs with a full backlog; a non-blocking connect would fail at once.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _CONNECT_TIMEOUT)
        with reachable(path) as address:
            sock.connect(address)
        if (user := peer_user(sock)) not in trusted_users():
            raise PermissionError(errno.EPERM, f"user {user} answers there")
        sock.setblocking(False)
    except (FileNotFoundError, NotADirectoryError, ConnectionRefusedError):
        sock.close()
        require_directory(path)
        raise BusError(f"no bus at {bus}: start one with `jtq sim --bus {bus}`") from None
    except BlockingIOError:
        sock.close()
        raise BusError(f"{bus}: the hub does not answer") from None
    except OSError as error:
        sock.close()
        raise BusError(f"{bus}: not a frame hub: {error.strerror or error}") from None
    return sock


# AF_CAN -------------------------------------------------------------------------------------------------------

# linux/can.h and linux/can/raw.h; written out because a Python built without these headers lacks the names
AF_CAN = 29
CAN_RAW = 1
SOL_CAN_RAW = 101
CAN_RAW_FILTER = 1
CAN_RAW_ERR_FILTER = 2
CAN_RAW_RECV_OWN_MSGS = 4
CAN_ERR_MASK = 0x1FFFFFFF

_NO_CAN = frozenset({errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT})


def open_socketcan(
    interface: str, filters: Sequence[CanFilter], receive_own: bool, error_frames: bool
) -> socket.socket:
    """Return a non-blocking raw socket bound to `interface`; its filters are in force before it is bound.

    Binding to an interface that is down succeeds, and the first receive then fails with ENETDOWN.
    Raises BusError: no CAN in this kernel, no such interface, not a CAN interface, or another error of bind.
    """
    if not re.fullmatch(r"[^\s/:]{1,15}", interface):
        raise BusError(f"{interface}: found no bus, expected the name of a CAN interface, or unix:PATH")
    try:
        sock = socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW)
    except OSError as error:
        no_can = f"this kernel has no CAN (AF_CAN, errno {error.errno}); use unix:PATH instead"
        raise BusError(f"{interface}: {no_can if error.errno in _NO_CAN else error}") from None
    try:
        set_can_filters(sock, filters)
        sock.setsockopt(SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, int(receive_own))
        if error_frames:
            sock.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, CAN_ERR_MASK)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        sock.setblocking(False)
        sock.bind((interface,))
    except OSError as error:
        sock.close()
        raise BusError(_bind_message(interface, error)) from None
    return sock


def set_can_filters(sock: socket.socket, filters: Sequence[CanFilter]) -> None:
    """Replace the filters of `sock`; an empty list receives nothing."""
    sock.setsockopt(SOL_CAN_RAW, CAN_RAW_FILTER, can_raw_filter(filters))


def _bind_message(interface: str, error: OSError) -> str:
    """Return in one line why `interface` could not be bound."""
    try:
        socket.if_nametoindex(interface)
    except OSError:
        return f"no such CAN interface: {interface}"
    if error.errno == errno.ENODEV:
        return f"not a CAN interface: {interface}"
    return f"{interface}: {error}"
