"""SDO client of one node over canopen's Network, with this project's waiting times and checks.

canopen's client alone retries nothing (MAX_RETRIES = 1 means one try), takes any frame length, and does not
compare the answer to a download with its request; all three are done here. Writes are expedited: boot writes
1..4 bytes.
"""

from __future__ import annotations

import struct
import time
from typing import Any

from canopen import ObjectDictionary, SdoAbortedError, SdoCommunicationError
from canopen.sdo import SdoClient

from drivers.boot_procedure import SdoSilence
from drivers.sdo_abort import SdoAbort

ANSWER_S = 0.1  # a device answers within milliseconds; a longer silence is a lost frame, so ask again
_INITIATE = struct.Struct("<BHB")
_DOWNLOAD_RESPONSE = 0x60


class NodeSdo:
    """Implements `boot_procedure.SdoAccess`. Asks again until `timeout_s` is over, then raises SdoSilence."""

    def __init__(self, network: Any, node: int, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._client = SdoClient(0x600 + node, 0x580 + node, ObjectDictionary())
        self._client.network = network
        self._client.RESPONSE_TIMEOUT = min(ANSWER_S, timeout_s)
        self._client.MAX_RETRIES = 1
        network.subscribe(0x580 + node, self._on_response)

    def _on_response(self, can_id: int, data: bytes, timestamp: float) -> None:
        if len(data) == 8:  # anything else is no SDO
            self._client.on_response(can_id, data, timestamp)

    def read(self, index: int, subindex: int) -> bytes:
        """Upload, expedited or segmented."""
        return bytes(self._repeat(lambda: self._client.upload(index, subindex)))

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Expedited download of 1..4 bytes."""
        head = _INITIATE.pack(0x23 | (4 - len(data)) << 2, index, subindex)

        def download() -> None:
            reply = self._client.request_response(head + data.ljust(4, b"\0"))
            if _INITIATE.unpack_from(reply) != (_DOWNLOAD_RESPONSE, index, subindex):
                raise SdoCommunicationError(f"answer to another request: {reply.hex(' ')}")

        self._repeat(download)

    def _repeat(self, request: Any) -> Any:
        deadline = time.monotonic() + self._timeout_s
        while True:
            try:
                return request()
            except SdoAbortedError as abort:
                raise SdoAbort(abort.code) from abort
            except SdoCommunicationError as error:
                if time.monotonic() >= deadline - 0.5 * ANSWER_S:
                    raise SdoSilence(self._timeout_s) from error
