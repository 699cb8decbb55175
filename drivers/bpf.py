"""Classic BPF twin of CAN_RAW_FILTER for the frames of a unix bus, run by the kernel before they are queued.

`struct sock_filter` and SO_ATTACH_FILTER: linux/filter.h, asm-generic/socket.h.
"""

import ctypes
import socket
import struct
from collections.abc import Sequence

from drivers.can_filter import CanFilter
from drivers.frame import CAN_ERR_FLAG, FRAME_SIZE

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
    """Attach the program for `filters` to `sock`; it replaces the one before. Raises OSError."""
    code = program(filters, error_frames)
    memory = ctypes.create_string_buffer(b"".join(_INSTRUCTION.pack(*each) for each in code))
    # The kernel copies the program within setsockopt; `memory` outlives the call by being a local name.
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, bytes(_Program(len(code), ctypes.addressof(memory))))
