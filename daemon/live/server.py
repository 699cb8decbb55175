"""The websocket server of the live view: foxglove-sdk, with the log's topics and nothing that a viewer could change."""

from __future__ import annotations

import foxglove

from daemon.live.address import Address
from daemon.live.stream import Message
from daemon.recording import schemas

_BACKLOG = 512
"""Messages kept for a slow viewer: 2.5 s of all topics."""


class LiveServer:
    """Serves one channel per topic of the log, with the log's schema.

    Args:
        name: what viewers show.
        address: where it listens.

    Raises:
        RuntimeError, OSError: it cannot listen there.
    """

    def __init__(self, name: str, address: Address) -> None:
        self._context = context = foxglove.Context()  # server and channels hold it only weakly
        self._channels = {
            topic.number: foxglove.Channel(
                topic.name,
                message_encoding="cdr",
                schema=foxglove.Schema(
                    name=topic.schema, encoding="ros2msg", data=schemas.SCHEMAS[topic.schema].encode()
                ),
                context=context,
            )
            for topic in schemas.TOPICS
        }
        self._server = foxglove.start_server(
            name=name,
            host=address.host,
            port=address.port,
            capabilities=[],  # read only: no publishing, no parameters, no services
            context=context,
            message_backlog_size=_BACKLOG,
        )
        self.address = Address(address.host, self._server.port)

    @property
    def watched(self) -> bool:
        """Somebody has subscribed to something."""
        return any(channel.has_sinks() for channel in self._channels.values())

    def send(self, message: Message) -> None:
        """To every viewer that has subscribed to the topic; a slow one loses its oldest messages."""
        self._channels[message.topic].log(message.payload, log_time=message.time_ns)

    def stop(self) -> None:
        """End it."""
        self._server.stop()
