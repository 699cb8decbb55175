"""SDO server: expedited and segmented transfers (CiA 301, 7.2.4.3.3 to 7.2.4.3.8). Pure: bytes in, bytes out.

Block transfer is not offered and is answered with 05040001h. One server holds one transfer; a new initiate
request ends the running one, as the client that lost its answer will start again.
"""

from __future__ import annotations

from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.sdo import (
    HEADER,
    INITIATE,
    LENGTH_TOO_HIGH,
    LENGTH_TOO_LOW,
    OUT_OF_MEMORY,
    TOGGLE,
    TOGGLE_NOT_ALTERNATED,
    UNKNOWN_COMMAND,
    SdoAbort,
    abort_frame,
)

MAX_DOWNLOAD_BYTES = 4096  # bounds the memory a client that never ends its transfer can take

# Client command specifiers, bits 7..5 of byte 0
_DOWNLOAD_SEGMENT, _DOWNLOAD_INITIATE, _UPLOAD_INITIATE, _UPLOAD_SEGMENT, _ABORT = range(5)


class _Transfer:
    """A segmented transfer under way; `size` is what was announced in a download, None when it was not."""

    def __init__(
        self, index: int, subindex: int, upload: bool, data: bytes = b"", size: int | None = None
    ) -> None:
        self.index, self.subindex, self.upload = index, subindex, upload
        self.data = bytearray(data)
        self.size = size
        self.toggle = 0


class SdoServer:
    """SDO server of one `ObjectStore`. It never raises for what a client sends."""

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        self._transfer: _Transfer | None = None

    def handle(self, request: bytes) -> bytes | None:
        """Answer one request; None when no answer is due (not 8 bytes, or the client's abort)."""
        if len(request) != 8:
            return None
        command, index, subindex = HEADER.unpack_from(request)
        specifier = command >> 5
        if specifier == _ABORT:
            self._transfer = None
            return None
        if specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT):
            transfer = self._transfer
            index, subindex = (transfer.index, transfer.subindex) if transfer else (0, 0)
        try:
            return self._answer(specifier, command, index, subindex, request)
        except SdoAbort as abort:
            self._transfer = None
            return abort_frame(index, subindex, abort.code)

    def _answer(self, specifier: int, command: int, index: int, subindex: int, request: bytes) -> bytes:
        if specifier == _UPLOAD_INITIATE:
            return self._upload(index, subindex)
        if specifier == _DOWNLOAD_INITIATE:
            return self._download(command, index, subindex, request[4:])
        if specifier == _UPLOAD_SEGMENT:
            return self._upload_segment(command)
        if specifier == _DOWNLOAD_SEGMENT:
            return self._download_segment(command, request[1:])
        raise SdoAbort(UNKNOWN_COMMAND)  # block transfer (5, 6) and the reserved 7

    def _upload(self, index: int, subindex: int) -> bytes:
        self._transfer = None
        data = self.store.read(index, subindex)
        if 1 <= len(data) <= 4:  # expedited; it has no code for an empty object
            return HEADER.pack(0x43 | (4 - len(data)) << 2, index, subindex) + data.ljust(4, b"\0")
        self._transfer = _Transfer(index, subindex, upload=True, data=data)
        return INITIATE.pack(0x41, index, subindex, len(data))

    def _upload_segment(self, command: int) -> bytes:
        transfer = self._running(command, upload=True)
        segment = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = not transfer.data
        reply = bytes([transfer.toggle | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0")
        transfer.toggle ^= TOGGLE
        if last:
            self._transfer = None
        return reply

    def _download(self, command: int, index: int, subindex: int, field: bytes) -> bytes:
        self._transfer = None
        expedited, sized = command & 2, command & 1
        if expedited:
            length = 4 - (command >> 2 & 3) if sized else self._own_length(index, subindex)
            self.store.write(index, subindex, field[:length])
        else:
            size = int.from_bytes(field, "little") if sized else None
            self.store.check_write(index, subindex, size)
            if size is not None and size > MAX_DOWNLOAD_BYTES:
                raise SdoAbort(OUT_OF_MEMORY)
            self._transfer = _Transfer(index, subindex, upload=False, size=size)
        return INITIATE.pack(0x60, index, subindex, 0)

    def _own_length(self, index: int, subindex: int) -> int:
        """Return how many of the four bytes count in an expedited download without size: by the object's type."""
        return min(4, self.store.entry(index, subindex).bits // 8 or 4)

    def _download_segment(self, command: int, payload: bytes) -> bytes:
        transfer = self._running(command, upload=False)
        transfer.data += payload[: 7 - (command >> 1 & 7)]
        limit = MAX_DOWNLOAD_BYTES if transfer.size is None else transfer.size
        if len(transfer.data) > limit:
            raise SdoAbort(OUT_OF_MEMORY if transfer.size is None else LENGTH_TOO_HIGH)
        reply = bytes([0x20 | transfer.toggle]).ljust(8, b"\0")
        transfer.toggle ^= TOGGLE
        if command & 1:  # last segment
            if transfer.size is not None and len(transfer.data) < transfer.size:
                raise SdoAbort(LENGTH_TOO_LOW)
            self._transfer = None
            self.store.write(transfer.index, transfer.subindex, bytes(transfer.data))
        return reply

    def _running(self, command: int, upload: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.upload != upload:
            raise SdoAbort(UNKNOWN_COMMAND)
        if command & TOGGLE != transfer.toggle:
            raise SdoAbort(TOGGLE_NOT_ALTERNATED)
        return transfer
