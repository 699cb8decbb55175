"""Receive filters with the meaning of CAN_RAW_FILTER, run by the kernel: (frame.can_id & mask) == (filter.can_id & mask).

AF_CAN takes them as they are (`can_raw_filter`); on a unix bus a classic BPF program does the same (`attach`) before a frame
is queued. `struct sock_filter` and SO_ATTACH_FILTER: linux/filter.h, asm-generic/socket.h.
"""

from __future__ import annotations

import ctypes
import socket
import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    FRAME_SIZE,
)

MAX_FILTERS = 512  # CAN_RAW_FILTER_MAX
_CAN_FILTER = struct.Struct("=II")


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


def checked(filters: Iterable[CanFilter] | None) -> tuple[CanFilter, ...]:
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
    return b"".join(_CAN_FILTER.pack(*each) for each in filters)


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


def program(filters: Sequence[CanFilter], error_frames: bool) -> list[tuple[int, int, int, int]]:
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


def attach(sock: socket.socket, filters: Sequence[CanFilter], error_frames: bool) -> None:
    """Attach the program for `filters` to `sock` in place of the present one. Raises OSError."""
    code = program(filters, error_frames)
    memory = ctypes.create_string_buffer(b"".join(_INSTRUCTION.pack(*each) for each in code))
    # The kernel copies the program within setsockopt; `memory` outlives the call by being a local name.
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, bytes(_Program(len(code), ctypes.addressof(memory))))
