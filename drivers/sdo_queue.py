"""SDO requests to one node, one after the other: for a master that is in service and must not wait. Pure.

A node has one default SDO server, which holds one transfer: requests to it must queue, those to different nodes need not.
The queue is bounded, each request has its own waiting time, and its result is given to the function it was submitted with.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers.sdo_transfer import Exchange


@dataclass(frozen=True)
class SdoResult:
    """How a request ended: one of `value` (b"" for a write), `refusal` (abort code), or neither: silence."""

    index: int
    subindex: int
    value: bytes | None
    refusal: int | None


@dataclass(frozen=True)
class _Request:
    index: int
    subindex: int
    data: bytes | None
    timeout_s: float
    done: Callable[[SdoResult], None]


class SdoQueue:
    """The queue of one node. Times are seconds of one steady clock; frames are the 8 bytes of 600h+n and 580h+n.

    Attributes:
        ignored: answers that belonged to no request of ours.
        repeats, silences, refusals: requests asked again, never answered, refused.
    """

    def __init__(self, limit: int = 32) -> None:
        self._waiting: deque[_Request] = deque()
        self._limit = limit
        self._exchange: Exchange | None = None
        self._done: Callable[[SdoResult], None] = lambda _result: None
        self.ignored = self.repeats = self.silences = self.refusals = 0

    @property
    def busy(self) -> bool:
        """Something is under way or waits."""
        return self._exchange is not None or bool(self._waiting)

    def read(
        self, index: int, subindex: int, done: Callable[[SdoResult], None], timeout_s: float = 0.5
    ) -> bool:
        """Queue an upload; False when the queue is full."""
        return self._submit(_Request(index, subindex, None, timeout_s, done))

    def write(
        self,
        index: int,
        subindex: int,
        data: bytes,
        done: Callable[[SdoResult], None],
        timeout_s: float = 0.5,
    ) -> bool:
        """Queue a download; False when the queue is full."""
        return self._submit(_Request(index, subindex, data, timeout_s, done))

    def clear(self) -> None:
        """Forget everything: somebody else (the boot) talks to the node now. Nobody is told."""
        self._waiting.clear()
        self._exchange = None

    def on_reply(self, reply: bytes, now: float) -> list[bytes]:
        """A frame of the node; returns what to send."""
        if self._exchange is None:
            self.ignored += 1
            return []
        return self._then(self._exchange.on_reply(reply, now), now)

    def tick(self, now: float) -> list[bytes]:
        """Call often; returns what to send."""
        if self._exchange is None:
            return self._next(now)
        return self._then(self._exchange.tick(now), now)

    def _submit(self, request: _Request) -> bool:
        if len(self._waiting) >= self._limit:
            return False
        self._waiting.append(request)
        return True

    def _then(self, frames: list[bytes], now: float) -> list[bytes]:
        exchange = self._exchange
        if exchange is None or not exchange.over:
            return frames
        self._exchange = None
        self.ignored += exchange.ignored
        self.repeats += exchange.repeats
        self.silences += exchange.silent
        self.refusals += exchange.refusal is not None
        self._done(SdoResult(exchange.index, exchange.subindex, exchange.value, exchange.refusal))
        return frames + self._next(now)

    def _next(self, now: float) -> list[bytes]:
        if not self._waiting or self._exchange is not None:
            return []
        request = self._waiting.popleft()
        self._done = request.done
        self._exchange = Exchange(
            request.index, request.subindex, request.data, now=now, timeout_s=request.timeout_s
        )
        return self._exchange.begin()
