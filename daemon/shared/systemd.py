"""Messages to systemd (sd_notify): ready, status, stopping, and the watchdog that only a loop that advances feeds.

One datagram to $NOTIFY_SOCKET by a socket that is connected once and never blocks; where nobody listens, nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

_FEED_SHARE = 0.1
"""The watchdog is fed ten times within its time: nine of these may be late."""


class Notifier:
    """Sends to the service manager.

    Args:
        environment: holds NOTIFY_SOCKET (a path, or @ and an abstract name), WATCHDOG_USEC and WATCHDOG_PID.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@"):
            return
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            sock.connect("\0" + address[1:] if address.startswith("@") else address)
        except OSError:
            sock.close()
            return
        self._socket = sock

    @property
    def connected(self) -> bool:
        """A service manager listens."""
        return self._socket is not None

    def send(self, *lines: str) -> bool:
        """Send assignments such as "READY=1"; False where nobody took them. Never blocks, never raises."""
        if self._socket is None:
            return False
        try:
            self._socket.send("\n".join(lines).encode())
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the connection: nothing is sent after it."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
            self._socket = None


class LoopWatchdog:
    """Feeds systemd's watchdog from the loop: call `advanced` after some cycles; every n-th cycle sends one datagram.

    Args:
        notifier: where to.
        period_ns: of the cycle.
        watchdog_s: time after which the service manager takes the loop for dead; None: there is no watchdog.
    """

    def __init__(self, notifier: Notifier, period_ns: int, watchdog_s: float | None) -> None:
        self._notifier = notifier
        fed = notifier.connected and watchdog_s is not None
        self.every = max(1, round(_FEED_SHARE * (watchdog_s or 0.0) * 1e9 / period_ns)) if fed else 0
        """Cycles between two datagrams; 0: never."""
        self._left = self.every

    def advanced(self, cycles: int = 1) -> None:
        """Count completed cycles."""
        if self.every == 0:
            return
        self._left -= cycles
        if self._left <= 0:
            self._left = self.every
            self._notifier.send("WATCHDOG=1")


def watchdog_seconds(environment: Mapping[str, str] = os.environ) -> float | None:
    """Return the time of systemd's watchdog [s], None without one.

    WATCHDOG_PID names the main process; the loop is its child and feeds in its place (NotifyAccess=all).
    """
    text = environment.get("WATCHDOG_USEC", "")
    owner = environment.get("WATCHDOG_PID", "")
    if not text.isdigit() or int(text) == 0 or (owner and owner not in (str(os.getpid()), str(os.getppid()))):
        return None
    return int(text) * 1e-6
