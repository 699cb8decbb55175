"""The live view's process: `python -m jtqd.daemon.live.process REQUEST` reads the loop's shared memory and serves viewers.

It sends one set of the cycle's messages per 20 ms, with the log's bytes; a change of status and a missed slot are seen in
every cycle and sent as events, so that nothing that lasts less than 20 ms stays unseen.

It maps ring, snapshot and notices read-only, and nothing that a viewer sends goes anywhere: the server has no capability
(no publishing, no parameters, no services). A viewer that is too slow loses its oldest messages, not others theirs.
It ends on SIGTERM, which it also gets when its parent has gone.

REQUEST is JSON: {"ring", "snapshot", "notices": paths, "host", "port", "bus": name, "nodes": [[node-ID, name]],
"gear_ratios": [two]}.
One line of JSON on stdout says how it began: {"listening": URL} or {"failed": why}. Exit status 0 ended in order,
1 could not begin.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import foxglove

from jtqd.daemon.live.gateway import Gateway
from jtqd.daemon.live.launch import Address
from jtqd.daemon.recording import schemas
from jtqd.daemon.recording.diagnostics import Diagnostics, Node
from jtqd.daemon.recording.messages import (
    CycleMessages,
    JointStateMessage,
    diagnostics,
    event,
    log,
    zeros_of,
)
from jtqd.daemon.recording.recording import SCANNED
from jtqd.daemon.shared import cycle_record as cycle
from jtqd.daemon.shared.conditions import Condition, read_conditions
from jtqd.daemon.shared.notices import Notice, NoticesError, NoticesReader
from jtqd.daemon.shared.ring import RingError, RingReader
from jtqd.daemon.shared.side_process import Stop, answer
from jtqd.daemon.shared.snapshot import SnapshotError, SnapshotReader, View

# ---- messages ----

PERIOD_NS = 20_000_000
"""50 Hz."""
_RECORD_HEAD = 31
"""Bytes before the payload of an MCAP Message record, as `cycle_block` makes it."""
_INFO, _WARN = 20, 30
_QUIET_STATUSES = (1, 2, 6)
"""Starting, valid and standstill are what a healthy joint goes through."""


class Message(NamedTuple):
    """One message on its way to the viewers. `topic` is the channel number of `jtqd.daemon.recording.schemas`."""

    topic: int
    time_ns: int
    payload: bytes


class LiveStream:
    """Thins out the cycles of one run.

    Args:
        bus: name of the bus, for /diagnostics.
        nodes: whose heartbeats /diagnostics shows.
        names: of the joints.
        gear_ratios: motor revolutions per joint revolution; None where not known.
        period_ns: one set of messages in each such stretch of CLOCK_MONOTONIC [ns].
    """

    def __init__(
        self,
        bus: str,
        nodes: Sequence[Node],
        names: Sequence[str],
        gear_ratios: Sequence[float | None],
        period_ns: int = PERIOD_NS,
    ) -> None:
        self._diagnostics = Diagnostics(bus, names, nodes)
        self._overview = JointStateMessage(names, gear_ratios)
        self._messages = CycleMessages(len(names))
        self._scan = cycle.selection(*SCANNED, len(names)).unpack_from
        self._period_ns = period_ns
        self._newest = (0, 0)
        self.forget()

    def forget(self) -> None:
        """Forget the last state after a pause without viewers, so that old changes are not reported."""
        self._slot = -1
        self._statuses: tuple[int, ...] | None = None
        self._missed: int | None = None

    def take(self, records: Iterable[bytes]) -> list[Message]:
        """Return the messages of these cycle records, in the order of time."""
        made: list[Message] = []
        for record in records:
            index, monotonic, realtime, flags, missed, counter, count, *statuses = self._scan(record)
            realtime = max(realtime, 0)
            self._newest = (index, realtime)
            made += self._changes(tuple(statuses), missed)
            slot = monotonic // self._period_ns
            if slot == self._slot:
                continue
            self._slot = slot
            block = self._messages.block(
                record, index, realtime, flags=flags, sync_counter=counter, frames=count
            )
            parts = self._messages.parts
            starts = [start for _, start in parts]
            for (topic, start), end in zip(parts, [*starts[1:], len(block)], strict=True):
                made.append(Message(topic, realtime, block[start + _RECORD_HEAD : end]))
            overview = self._overview.payload(record, realtime)
            made.append(Message(schemas.JOINT_STATES.number, realtime, overview))
        return made

    def _changes(self, statuses: tuple[int, ...], missed: int) -> list[Message]:
        made: list[Message] = []
        before, self._statuses = self._statuses, statuses
        for joint, (old, new) in enumerate(zip(before or statuses, statuses, strict=True), start=1):
            if old != new:
                names = [schemas.STATUS_NAMES.get(code, str(code)) for code in (old, new)]
                text = f"joint {joint}: {names[0]} -> {names[1]}"
                level = _INFO if new in _QUIET_STATUSES else _WARN
                made += self.note(schemas.STATUS_CHANGED, text, level, joint=joint, change=(old, new))
        slots = missed - (missed if self._missed is None else self._missed)
        self._missed = missed
        if slots > 0:
            made += self.note(
                schemas.SLOTS_MISSED,
                f"the loop missed {slots} {'slot' if slots == 1 else 'slots'}",
                _WARN,
                count=slots,
            )
        return made

    def notices(self, news: Iterable[Notice]) -> list[Message]:
        """Return the messages of the supervisor's notices."""
        made: list[Message] = []
        for notice in news:
            made += self.note(
                schemas.NOTICE, notice.text, notice.level, time_ns=notice.realtime_ns, count=notice.node
            )
        return made

    def note(
        self,
        kind: int,
        text: str,
        level: int,
        *,
        time_ns: int | None = None,
        count: int = 0,
        joint: int = 0,
        change: tuple[int, int] = (0, 0),
    ) -> list[Message]:
        """One occurrence as a message on /events and one on /log, at the time of the newest cycle unless one is given."""
        index, newest = self._newest
        when = newest if time_ns is None else time_ns
        payload = event(when, kind, text, index=index, count=count, joint=joint, change=change)
        return [
            Message(schemas.EVENTS.number, when, payload),
            Message(schemas.LOG.number, when, log(when, level, text)),
        ]

    def diagnose(
        self,
        view: View,
        work_us: Sequence[float],
        late_us: Sequence[float],
        now_ns: int,
        conditions: Sequence[Condition] = (),
    ) -> Message:
        """The once-per-second /diagnostics of loop, bus, joints and nodes; what the recorder does is in the log only.

        Args:
            view: of the loop's counters.
            work_us, late_us: p50, p99 and maximum of the work per cycle and of the SYNC's lateness [us].
            now_ns: CLOCK_REALTIME.
            conditions: that are present.
        """
        statuses = self._diagnostics.of_the_loop(
            view, work_us=work_us, late_us=late_us, now_ns=now_ns, conditions=conditions
        )
        return Message(schemas.DIAGNOSTICS.number, now_ns, diagnostics(now_ns, statuses))


# ---- websocket server ----

_INNER_HOST = "127.0.0.1"
"""Where the server itself listens; viewers come through the gateway."""
_BACKLOG = 512
"""Messages kept for a slow viewer: 2.5 s of all topics."""


class LiveServer:
    """Serves one channel per topic of the log, with the log's schema.

    Args:
        name: what viewers show.
        address: where it listens.
        joints: number of them.

    Raises:
        RuntimeError, OSError: it cannot listen there.
    """

    def __init__(self, name: str, address: Address, joints: int = 2) -> None:
        texts = schemas.schemas_of(joints)
        self._context = context = foxglove.Context()  # server and channels hold it only weakly
        self._channels = {
            topic.number: foxglove.Channel(
                topic.name,
                message_encoding="cdr",
                schema=foxglove.Schema(
                    name=topic.schema, encoding="ros2msg", data=texts[topic.schema].encode()
                ),
                context=context,
            )
            for topic in schemas.topics_of(joints)
        }
        self._server = foxglove.start_server(
            name=name,
            host=_INNER_HOST,
            port=0,  # any that is free
            capabilities=[],  # read only: no publishing, no parameters, no services
            context=context,
            message_backlog_size=_BACKLOG,
        )
        try:
            self._gateway = Gateway(address, Address(_INNER_HOST, self._server.port))
        except BaseException:
            self._server.stop()
            raise
        self.address = Address(address.host, self._gateway.port)

    @property
    def watched(self) -> bool:
        """Return whether a viewer has subscribed to a topic."""
        return any(channel.has_sinks() for channel in self._channels.values())

    def send(self, message: Message) -> None:
        """Send to every subscribed viewer; a slow one loses its oldest messages."""
        self._channels[message.topic].log(message.payload, log_time=message.time_ns)

    def stop(self) -> None:
        """Stop the server."""
        self._gateway.stop()
        self._server.stop()


_POLL_S = 0.02
_DIAGNOSIS_S = 1.0
_QUANTILES = (0.5, 0.99, 1.0)
_NICE = 10


def _free(address: Address) -> str | None:
    """None, or why nobody can listen there: the server's own message does not always say."""
    try:
        family, _, _, _, where = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
    except OSError as error:
        return error.strerror or str(error)
    return None


class Source:
    """What the daemon leaves in shared memory, as messages.

    Args:
        request: of the process.

    Raises:
        RingError, SnapshotError: it is not there.
    """

    def __init__(self, request: dict[str, Any]) -> None:
        ratios = request["gear_ratios"]
        names = [f"joint_{number}" for number in range(1, len(ratios) + 1)]
        self._ring = RingReader(Path(request["ring"]), cycle.layout_of(len(ratios)).size)
        self._snapshot = SnapshotReader(Path(request["snapshot"]))
        self._directory = Path(request["snapshot"]).parent
        nodes = [Node(int(number), str(name)) for number, name in request["nodes"]]
        self._stream = LiveStream(request["bus"], nodes, names, ratios)
        self._notices: NoticesReader | None = None
        with suppress(NoticesError):
            self._notices = NoticesReader(Path(request["notices"]))
        self._diagnosed = time.monotonic()
        self.skip()

    def skip(self) -> None:
        """Skip to the newest record while there is no viewer."""
        self._ring.position += self._ring.backlog
        self._stream.forget()
        if self._notices is not None:
            self._notices.read()

    def read(self) -> list[Message]:
        """Return the new messages."""
        made = self._stream.take(self._ring.read().records)
        if self._notices is not None:
            made += self._stream.notices(self._notices.read()[0])
        now = time.monotonic()
        if now - self._diagnosed >= _DIAGNOSIS_S:
            self._diagnosed = now
            work, late = self._snapshot.work_us(*_QUANTILES), self._snapshot.late_us(*_QUANTILES)
            view, conditions = self._snapshot.read(), read_conditions(self._directory)
            made.append(self._stream.diagnose(view, work, late, time.time_ns(), conditions))
            made += [Message(topic.number, view.sync_realtime_ns, text) for topic, text in zeros_of(view)]
        return made


def serve(source: Source, server: LiveServer, stop: Stop) -> None:
    """Serve until stopped. Without a viewer it only follows the ring."""
    while not stop.requested:
        if server.watched:
            for message in source.read():
                server.send(message)
        else:
            source.skip()
        time.sleep(_POLL_S)


def main(arguments: list[str] | None = None) -> int:
    """Command line of the process; returns the exit status."""
    request = json.loads((sys.argv[1:] if arguments is None else arguments)[0])
    stop = Stop()
    with suppress(OSError):
        os.nice(_NICE)
    address = Address(request["host"], request["port"])
    problem = _free(address)
    if problem is not None:
        answer(failed=f"{address.host}:{address.port}: {problem}")
        return 1
    try:
        source = Source(request)
        server = LiveServer(f"jtqd on {request['bus']}", address, len(request["gear_ratios"]))
    except (ImportError, RingError, SnapshotError, RuntimeError, OSError, ValueError) as error:
        answer(failed=f"{address.host}:{address.port}: {error}")
        return 1
    answer(listening=server.address.url)
    try:
        serve(source, server, stop)
    finally:
        server.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
