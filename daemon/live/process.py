"""The live view's process, `python -m jtqd.daemon.live.process REQUEST`: the loop's memory, for pages and viewers.

Viewers get one set of the cycle's messages per 20 ms, with the log's bytes; a change of status and a missed slot are seen in
every cycle and sent as events. Pages get `page_events`, made once for all. Ring, snapshot and notices are mapped read-only,
and nothing that anybody sends goes anywhere. Who is too slow loses messages, not others theirs.

REQUEST is the JSON of `recording.launch.loop_request` with "host" and "port". The answer is {"listening": where} or
{"failed": why} (`shared.processes`).
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.live import NEEDED, Address, installed
from jtqd.daemon.live.gateway import Gateway
from jtqd.daemon.live.page_events import SAMPLE_NS, PageEvents
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.diagnostics import LoopReader
from jtqd.daemon.recording.messages import (
    SCANNED,
    CycleMessages,
    EventKind,
    EventLog,
    JointStateMessage,
    diagnostics,
    zeros_of,
)
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared.events import NoticesReader
from jtqd.daemon.shared.processes import CannotBegin, Stop, run_side_process
from jtqd.daemon.shared.runtime_dir import SharedMemoryError

# ---- messages ----


class Message(NamedTuple):
    """One message on its way to the viewers. `topic` is the channel number of `jtqd.daemon.recording.messages`."""

    topic: int
    time_ns: int
    payload: bytes


class LiveStream:
    """Thins out the cycles of one run; `events` makes messages of what happens.

    gear_ratios: motor revolutions per joint revolution; None where not known. shadow: there are shadow methods.
    """

    def __init__(
        self, names: Sequence[str], gear_ratios: Sequence[float | None], *, shadow: bool = False
    ) -> None:
        self._overview = JointStateMessage(names, gear_ratios)
        self._cycles = CycleMessages(len(names), shadow=shadow)
        self._scan = cycle.selection(*SCANNED, len(names)).unpack_from
        self._made: list[Message] = []
        self.events = EventLog(self.add)
        self.forget()

    def forget(self) -> None:
        """Forget the last state after a pause without viewers, so that old changes are not reported."""
        self._slot = -1
        self.events.forget()

    def add(self, topic: int, time_ns: int, payload: bytes) -> None:
        """Add a message."""
        self._made.append(Message(topic, time_ns, payload))

    def take(self, records: Iterable[bytes] = ()) -> list[Message]:
        """Return the messages added, and those of these cycle records, in the order of time."""
        for record in records:
            index, monotonic, realtime, flags, missed, counter, count, *statuses = self._scan(record)
            realtime = max(realtime, 0)
            self.events.newest = (index, realtime)
            self.events.cycle(tuple(statuses), missed)
            slot = monotonic // SAMPLE_NS
            if slot == self._slot:
                continue
            self._slot = slot
            block = self._cycles.block(
                record, index, realtime, flags=flags, sync_counter=counter, frames=count
            )
            for topic, payload in self._cycles.payloads(block):
                self.add(topic, realtime, payload)
            self.add(messages.JOINT_STATES.number, realtime, self._overview.payload(record, realtime))
        self.events.new_span()
        made, self._made = self._made, []
        return made


# ---- websocket server ----

_INNER_HOST = "127.0.0.1"
"""Where the server itself listens; viewers come through the gateway."""
_BACKLOG = 512
"""Messages kept for a slow viewer: 2.5 s of all topics."""


class LiveServer:
    """Serves one channel per topic of the log, with the log's schema; `name` is what viewers show.

    schemas, channels: records of the log. Needs the extra `live`. Raises RuntimeError, OSError where it cannot listen.
    """

    def __init__(self, name: str, schemas: Sequence[Any], channels: Sequence[Any]) -> None:
        import foxglove

        self._context = context = foxglove.Context()  # server and channels hold it only weakly
        known = {
            each.id: foxglove.Schema(name=each.name, encoding="ros2msg", data=each.data) for each in schemas
        }
        self._channels = {
            each.id: foxglove.Channel(
                each.topic, message_encoding="cdr", schema=known[each.schema_id], context=context
            )
            for each in channels
        }
        self._server = foxglove.start_server(
            name=name,
            host=_INNER_HOST,
            port=0,  # any that is free
            capabilities=[],  # read only: no publishing, no parameters, no services
            context=context,
            message_backlog_size=_BACKLOG,
        )
        self.address = Address(_INNER_HOST, self._server.port)

    @property
    def watched(self) -> bool:
        """Return whether a viewer has subscribed to a topic."""
        return any(channel.has_sinks() for channel in self._channels.values())

    def send(self, message: Message) -> None:
        """Send to every subscribed viewer; a slow one loses its oldest messages."""
        self._channels[message.topic].log(message.payload, log_time=message.time_ns)

    def stop(self) -> None:
        """Stop the server."""
        self._server.stop()


def obstacle(address: Address) -> str:
    """Return why nobody can listen there, or nothing: the server's own message does not always contain it."""
    try:
        family, _, _, _, where = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
    except OSError as error:
        return error.strerror or str(error)
    return ""


# ---- the process ----

_POLL_S = 0.02


class Source:
    """What the daemon leaves in shared memory, as messages. Raises SharedMemoryError where it is not there."""

    def __init__(self, request: dict[str, Any]) -> None:
        self._loop = LoopReader(request)
        self._stream = LiveStream(self._loop.joints, request["gear_ratios"], shadow=request["shadow"])
        self._notices: NoticesReader | None = None
        with suppress(SharedMemoryError):
            self._notices = NoticesReader(Path(request["notices"]))
        self.skip()

    def skip(self) -> None:
        """Skip to the newest record while nobody looks."""
        self._loop.skip()
        self.forget()

    def forget(self) -> None:
        """Forget what viewers were sent while there is none."""
        self._stream.forget()
        if self._notices is not None:
            self._notices.read()

    def records(self) -> list[bytes]:
        """Return the new cycle records."""
        return self._loop.ring.read().records

    def messages(self, records: list[bytes]) -> list[Message]:
        """Return the messages of these records, and of what has happened since."""
        stream, now_ns = self._stream, time.time_ns()
        made = stream.take(records)
        for notice in () if self._notices is None else self._notices.read()[0]:
            stream.events.note(
                EventKind.NOTICE,
                notice.text,
                level=notice.level,
                time_ns=notice.realtime_ns,
                count=notice.node,
            )
        found = self._loop.diagnosis(time.monotonic_ns(), now_ns)
        if found is not None:
            view, statuses = found
            stream.add(messages.DIAGNOSTICS.number, now_ns, diagnostics(now_ns, statuses))
            for topic, payload in zeros_of(view):
                stream.add(topic.number, view.sync_realtime_ns, payload)
        return made + stream.take()


def serve(source: Source, gateway: Gateway, viewers: LiveServer | None, page: PageEvents, stop: Stop) -> int:
    """Serve until stopped. Without anybody who looks it only follows the ring."""
    try:
        while not stop.requested:
            watched = viewers is not None and viewers.watched
            if watched or gateway.watched:
                records = source.records()
                if viewers is None or not watched:
                    source.forget()
                else:
                    for message in source.messages(records):
                        viewers.send(message)
                if gateway.watched and (events := page.take(records, time.monotonic_ns())):
                    gateway.publish(events)
            else:
                source.skip()
            time.sleep(_POLL_S)
    finally:
        gateway.stop()
        if viewers is not None:
            viewers.stop()
    return 0


def begin(request: dict[str, Any]) -> tuple[str, Callable[[Stop], int]]:
    """Open memory and servers; returns where they listen, and what serves. Raises CannotBegin."""
    address = Address(request["host"], request["port"])
    why = obstacle(address)
    if why:
        raise CannotBegin(f"{address.host}:{address.port}: {why}")
    viewers = None
    try:
        source = Source(request)
        count, shadow = len(request["joint_names"]), request["shadow"]
        page = PageEvents(Path(request["snapshot"]).parent, count, shadow=shadow)
        if installed():
            viewers = LiveServer(f"jtqd on {request['bus']}", *messages.definitions(count, shadow=shadow))
        gateway = Gateway(address, None if viewers is None else viewers.address)
    except (SharedMemoryError, RuntimeError, OSError, ValueError) as error:
        if viewers is not None:
            viewers.stop()
        raise CannotBegin(f"{address.host}:{address.port}: {error}") from None
    where = Address(address.host, gateway.port)
    others = NEEDED if viewers is None else f"Foxglove and Lichtblick: {where.of('ws')}"
    return f"{where.of('http')}  ({others})", partial(serve, source, gateway, viewers, page)


if __name__ == "__main__":
    sys.exit(run_side_process(None, "listening", begin))
