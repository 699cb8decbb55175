"""Receive filters with the meaning of CAN_RAW_FILTER: (frame.can_id & mask) == (filter.can_id & mask)."""

import struct
from collections.abc import Iterable
from typing import NamedTuple

from drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_ERR_FLAG, CAN_RTR_FLAG, CAN_SFF_MASK

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


def look_alikes(can_id: int) -> CanFilter:
    """Return the filter for `can_id` in both formats, data and remote: for those who count the wrong ones."""
    return CanFilter(can_id & CAN_EFF_MASK, CAN_EFF_MASK)


def checked(filters: Iterable[CanFilter] | None) -> tuple[CanFilter, ...]:
    """Return `filters` as a tuple; None means everything.

    Raises ValueError for values beyond 32 bits, more than 512 filters, or the flag of inverted filters
    (CAN_INV_FILTER, the same bit as CAN_ERR_FLAG), which the BPF twin does not know.
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
