"""A TCP gateway at the one address of the live view: the page in the browser, and the websocket server of foxglove-sdk.

That server knows the subprotocol foxglove.sdk.v1 alone. Older viewers ask for foxglove.websocket.v1, which has the same
messages (Lichtblick's pull request 819): its name is exchanged in the handshake, and what follows passes unchanged. A
request for neither is answered as HTTP (`web`).
"""

from __future__ import annotations

import asyncio
import re
import threading
from contextlib import suppress
from http import HTTPStatus

from jtqd.daemon.live import NEEDED, Address, web

PROTOCOL, OLDER = "foxglove.sdk.v1", "foxglove.websocket.v1"
_HEADER = re.compile(rb"^(sec-websocket-protocol: *)([^\r\n]*)", re.IGNORECASE | re.MULTILINE)
_END = b"\r\n\r\n"
_LONGEST_HANDSHAKE = 16_384
_HANDSHAKE_S = 5.0
_CHUNK = 65_536
_MOST = 32
"""Pages, and viewers as many."""
_MOST_BRIEF = 64
"""Connections that have not asked yet, or not taken their answer: one more costs the oldest of them its place. A page is one
open file, a viewer three: all stay far below the 1024 of a service."""
_ACCEPTED_AT_ONCE = 32
_UNSENT = 262_144
"""Bytes waiting for a page that does not read, some 10 s; what comes then is not for it."""


def renamed(handshake: bytes, name: str) -> bytes:
    """Return a request or an answer with one subprotocol, `name`."""
    return _HEADER.sub(lambda found: found[1] + name.encode(), handshake)


class Gateway:
    """Listens at `address` (raises OSError), in a thread of its own.

    inner: of the websocket server; None: there is none. page: there is one.
    """

    def __init__(self, address: Address, inner: Address | None, *, page: bool = True) -> None:
        self._inner, self._names, self._page = inner, web.local_names(address.host), page
        self._loop = asyncio.new_event_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._pages: set[asyncio.StreamWriter] = set()
        self._brief: dict[asyncio.StreamWriter, None] = {}  # in the order in which they came
        self._viewers: set[asyncio.StreamWriter] = set()
        try:
            listening = asyncio.start_server(
                self._serve, *address, limit=_LONGEST_HANDSHAKE, backlog=_ACCEPTED_AT_ONCE
            )
            self._server = self._loop.run_until_complete(listening)
        except BaseException:
            self._loop.close()
            raise
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="gateway", daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """Return whether a page is open."""
        return bool(self._pages)

    def publish(self, events: bytes) -> None:
        """Send events to every page; one that does not read loses them."""
        self._loop.call_soon_threadsafe(self._publish, events)

    def _publish(self, events: bytes) -> None:
        for writer in self._pages:
            if writer.transport.get_write_buffer_size() < _UNSENT:
                writer.write(events)

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
        self._brief[writer] = None
        if len(self._brief) > _MOST_BRIEF:
            oldest = next(iter(self._brief))
            del self._brief[oldest]
            oldest.transport.abort()
        try:
            with suppress(OSError, asyncio.IncompleteReadError, TimeoutError):
                await self._connect(reader, writer)
        except asyncio.CancelledError:
            pass  # stopped
        finally:
            self._tasks.discard(task)
            self._brief.pop(writer, None)
            self._viewers.discard(writer)
            writer.close()
            self._loop.call_later(_HANDSHAKE_S, writer.transport.abort)  # what nobody takes is not kept

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answer: bytes | None
        try:
            head = await asyncio.wait_for(reader.readuntil(_END), _HANDSHAKE_S)
            request = web.request_of(head)
        except asyncio.LimitOverrunError:
            why = f"a request may have {_LONGEST_HANDSHAKE} bytes; cookies of localhost count"
            answer = web.text_answer(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, why)
        except ValueError as error:
            answer = web.text_answer(HTTPStatus.BAD_REQUEST, str(error))
        else:
            protocols = [] if web.obstacle(request, self._names) else request.protocols
            if self._inner is not None and (PROTOCOL in protocols or OLDER in protocols):
                answer = await self._pass_on(head, PROTOCOL in protocols, reader, writer)
                if answer is None:
                    return
            elif protocols:
                known = f"websocket subprotocols: {PROTOCOL}, {OLDER}" if self._inner else NEEDED
                answer = web.text_answer(HTTPStatus.BAD_REQUEST, known)
            elif not self._page:
                answer = web.text_answer(HTTPStatus.NOT_FOUND, "no page: Foxglove and Lichtblick alone")
            else:
                answer = web.answer(request, self._names)
        if answer is None and len(self._pages) >= _MOST:
            answer = web.text_answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST} pages are open")
        if answer is None:
            writer.write(web.STREAM_HEAD)
            await self._stream(reader, writer)
        else:
            writer.write(answer)
            writer.write_eof()
            await asyncio.wait_for(_drop(reader), _HANDSHAKE_S)

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Let `publish` write until the browser leaves; what it sends is dropped."""
        self._brief.pop(writer, None)
        self._pages.add(writer)
        try:
            await _drop(reader)
        finally:
            self._pages.discard(writer)
            writer.transport.abort()  # what a page did not read is not waited for

    async def _pass_on(
        self, head: bytes, newest: bool, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bytes | None:
        """Connect a viewer until it leaves; return the answer to one that is refused."""
        assert self._inner is not None
        if len(self._viewers) >= _MOST:
            return web.text_answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST} viewers are connected")
        self._viewers.add(writer)
        inside, outside = await asyncio.open_connection(*self._inner, limit=_LONGEST_HANDSHAKE)
        try:
            outside.write(renamed(head, PROTOCOL))
            try:
                answer = await asyncio.wait_for(inside.readuntil(_END), _HANDSHAKE_S)
            except asyncio.IncompleteReadError:
                return web.text_answer(HTTPStatus.BAD_REQUEST, "expected the handshake of a websocket")
            self._brief.pop(writer, None)
            writer.write(answer if newest else renamed(answer, OLDER))
            pumps = [asyncio.ensure_future(_pump(*ends)) for ends in ((reader, outside), (inside, writer))]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)
        finally:
            outside.close()
        return None


async def _drop(source: asyncio.StreamReader) -> None:
    """Read until the other side ends: a connection closed on unread bytes loses what it has sent."""
    while await source.read(_CHUNK):
        pass


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Pass on what comes until one side ends; a slow sink makes the source wait."""
    while data := await source.read(_CHUNK):
        sink.write(data)
        await sink.drain()
