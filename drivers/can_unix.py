"""python-can interface `jtq_unix`: the unix bus for canopen, can.logger and every other tool on python-can.

can.Bus(interface="jtq_unix", channel="/run/jtqd/bus")
python -m can.logger -i jtq_unix -c /run/jtqd/bus
"""

import time
from collections.abc import Mapping, Sequence
from select import select
from typing import Any

import can

from jtqd.drivers.bus_socket import PREFIX, CanFilter
from jtqd.drivers.frame import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    FRAME,
    FRAME_SIZE,
    MAX_LENGTH,
)
from jtqd.drivers.frame_socket import BusError, open_frame_socket


class UnixBus(can.BusABC):  # type: ignore[misc]
    """A unix bus; `channel` is the path of the hub's socket, with or without `unix:`.

    Filters run in the kernel (BPF), time stamps are the kernel's. Receives one frame per system call, because
    a reader that waits on `fileno()` would not see frames kept in user space.
    Raises can.CanInitializationError when there is no hub; can.CanOperationError when it has ended.
    """

    def __init__(
        self,
        channel: str,
        can_filters: Sequence[Mapping[str, Any]] | None = None,
        receive_own_messages: bool = False,
        ignore_rx_error_frames: bool = False,
        **kwargs: Any,
    ) -> None:
        if kwargs.pop("fd", False):
            raise can.CanInitializationError("a unix bus does not support CAN FD")
        path = str(channel).removeprefix(PREFIX)
        try:
            self._frames = open_frame_socket(
                PREFIX + path,
                _filters(can_filters),
                receive_own=receive_own_messages,
                error_frames=not ignore_rx_error_frames,
                capacity=1,
            )
        except (BusError, ValueError) as error:
            raise can.CanInitializationError(str(error)) from error
        self.channel = path
        self.channel_info = f"unix bus {path}"
        super().__init__(channel=path, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._frames.fd

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send `msg`; wait up to `timeout` s for room in the transmit queue.

        Raises ValueError for a message that is no classic CAN frame, can.CanOperationError when there is no
        room or no hub.
        """
        frame16 = _pack(msg)
        deadline = time.monotonic() + (timeout or 0.0)
        try:
            while not self._frames.send(frame16):
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise can.CanOperationError("Transmit buffer full")
                select((), (self._frames.fd,), (), left)
        except BusError as error:
            raise can.CanOperationError(str(error)) from error

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._frames.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return (message or None, True: the kernel has filtered)."""
        frames = self._frames
        try:
            if not frames.wait(timeout) or frames.receive() == 0 or frames.lengths[0] != FRAME_SIZE:
                return None, True
        except (BusError, OSError, ValueError) as error:  # the last two: closed while waiting
            raise can.CanOperationError(str(error)) from error
        return self._message(*FRAME.unpack(frames.frames)), True

    def _apply_filters(self, filters: Sequence[Mapping[str, Any]] | None) -> None:
        """Put the filters of python-can into the kernel."""
        try:
            self._frames.set_filters(_filters(filters))
        except BusError as error:
            raise can.CanOperationError(str(error)) from error

    def _message(self, can_id: int, length: int, data: bytes) -> can.Message:
        """Make python-can's message of the frame received last."""
        extended = bool(can_id & CAN_EFF_FLAG)
        remote = bool(can_id & CAN_RTR_FLAG)
        error = bool(can_id & CAN_ERR_FLAG)
        return can.Message(
            timestamp=self._frames.stamps_ns[0] * 1e-9,
            arbitration_id=can_id & (CAN_EFF_MASK if extended or error else CAN_SFF_MASK),
            is_extended_id=extended,
            is_remote_frame=remote,
            is_error_frame=error,
            is_rx=not self._frames.own[0],
            channel=self.channel,
            dlc=length,
            data=None if remote else data[:length],
        )


def _filters(filters: Sequence[Mapping[str, Any]] | None) -> list[CanFilter] | None:
    """Translate python-can's filters (can_id, can_mask, perhaps extended); None or none: everything."""
    if not filters:
        return None
    result = []
    for each in filters:
        can_id = int(each["can_id"]) & ~CAN_ERR_FLAG
        mask = int(each["can_mask"]) & ~CAN_ERR_FLAG
        if "extended" in each:
            mask |= CAN_EFF_FLAG
            can_id = can_id | CAN_EFF_FLAG if each["extended"] else can_id & ~CAN_EFF_FLAG
        result.append(CanFilter(can_id, mask))
    return result


def _pack(msg: can.Message) -> bytes:
    """Return the 16 bytes of `msg`. Raises ValueError for what a classic CAN frame cannot hold."""
    if msg.is_fd:
        raise ValueError("a unix bus does not support CAN FD")
    limit = CAN_EFF_MASK if msg.is_extended_id or msg.is_error_frame else CAN_SFF_MASK
    if not 0 <= msg.arbitration_id <= limit:
        raise ValueError(f"arbitration_id {msg.arbitration_id:#x} is above {limit:#x}")
    data = b"" if msg.is_remote_frame else bytes(msg.data)
    if not 0 <= msg.dlc <= MAX_LENGTH or (not msg.is_remote_frame and len(data) != msg.dlc):
        raise ValueError(f"dlc {msg.dlc} does not fit {len(data)} bytes of data")
    can_id = msg.arbitration_id
    if msg.is_extended_id:
        can_id |= CAN_EFF_FLAG
    if msg.is_remote_frame:
        can_id |= CAN_RTR_FLAG
    if msg.is_error_frame:
        can_id |= CAN_ERR_FLAG
    return FRAME.pack(can_id, msg.dlc, data)
