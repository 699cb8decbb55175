"""A TCP gateway before the websocket server of foxglove-sdk, which knows the subprotocol foxglove.sdk.v1 alone.

Older viewers ask for foxglove.websocket.v1, which has the same messages (Lichtblick's pull request 819): its name is
exchanged in the handshake, and what follows passes unchanged. A client that asks for neither gets an answer that names both.
"""

from __future__ import annotations

import asyncio
import re
import threading
from contextlib import suppress

from jtqd.daemon.live import Address

PROTOCOL, OLDER = "foxglove.sdk.v1", "foxglove.websocket.v1"
_HEADER = re.compile(rb"^(sec-websocket-protocol: *)([^\r\n]*)", re.IGNORECASE | re.MULTILINE)
_END = b"\r\n\r\n"
_LONGEST_HANDSHAKE = 16_384
_HANDSHAKE_S = 5.0
_CHUNK = 65_536
_HELP = (
    "jtqd's live view. Open this address in Foxglove or Lichtblick as a Foxglove WebSocket connection "
    f"(websocket subprotocol {PROTOCOL} or {OLDER}), or run: jtq status\n"
)


def asked(request: bytes) -> list[str]:
    """Return the subprotocols that a handshake offers."""
    values = (value.decode("latin-1") for _, value in _HEADER.findall(request))
    return [each.strip() for value in values for each in value.split(",")]


def renamed(handshake: bytes, name: str) -> bytes:
    """Return a request or an answer with one subprotocol, `name`."""
    return _HEADER.sub(lambda found: found[1] + name.encode(), handshake)


def refusal() -> bytes:
    """Return the answer to a client that asks for no known subprotocol."""
    body = _HELP.encode()
    fields = "Content-Type: text/plain", f"Content-Length: {len(body)}", "Connection: close"
    head = "\r\n".join(("HTTP/1.1 400 Bad Request", *fields, "", ""))
    return head.encode() + body


class Gateway:
    """Listens at `address` (raises OSError) and passes connections on to the server at `inner`, in a thread of its own."""

    def __init__(self, address: Address, inner: Address) -> None:
        self._inner = inner
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        try:
            listening = asyncio.start_server(self._serve, *address, limit=_LONGEST_HANDSHAKE)
            self._server = self._loop.run_until_complete(listening)
        except BaseException:
            self._loop.close()
            raise
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End all connections and stop listening."""
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            with suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
                await self._connect(reader, writer)
        except asyncio.CancelledError:
            pass  # stopped
        finally:
            self._tasks.discard(task)
            writer.close()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await asyncio.wait_for(reader.readuntil(_END), _HANDSHAKE_S)
        names = asked(request)
        if PROTOCOL not in names and OLDER not in names:
            writer.write(refusal())
            await writer.drain()
            return
        inside, outside = await asyncio.open_connection(*self._inner, limit=_LONGEST_HANDSHAKE)
        try:
            outside.write(renamed(request, PROTOCOL))
            answer = await asyncio.wait_for(inside.readuntil(_END), _HANDSHAKE_S)
            writer.write(answer if PROTOCOL in names else renamed(answer, OLDER))
            pumps = [asyncio.ensure_future(_pump(*ends)) for ends in ((reader, outside), (inside, writer))]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)
        finally:
            outside.close()


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Pass on what comes until one side ends; a slow sink makes the source wait."""
    while data := await source.read(_CHUNK):
        sink.write(data)
        await sink.drain()
