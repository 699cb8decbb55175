"""Lines about the bus, for the operator and for the log: one call says a line and puts it among the notices."""

from __future__ import annotations

from daemon.shared.notices import WARNING as NOTICE_WARNING
from daemon.shared.notices import Notices
from daemon.supervisor.say import WARNING, Say


class Teller:
    """Says lines. `notices` may be set later: before it, lines are only said."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self.notices: Notices | None = None

    def __call__(self, topic: str, node: int, line: str, kind: str = "") -> None:
        """One line; `topic` and `node` as in `daemon.shared.notices.Notice`, `kind` as in `daemon.supervisor.say.Say`."""
        self._say(line, WARNING, kind)
        if self.notices is not None:
            self.notices.add(NOTICE_WARNING, topic, node, line)
