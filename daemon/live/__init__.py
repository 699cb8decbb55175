"""Live view: what others see of a running daemon: a page in the browser, Foxglove and Lichtblick, `jtq.status/1`.

In comes the loop's shared memory; out go the page and its events, and the log's topics, thinned out, on a websocket (extra
`live`). Here: the address (HOST:PORT of `jtqd --live`), and how the supervisor starts `process`. `layout` is `jtq layout`.
"""

from __future__ import annotations

import argparse
import importlib.util
import ipaddress
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jtqd.daemon.shared.processes import SideProcess, StartChild

if TYPE_CHECKING:
    from jtqd.daemon.config import Config

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8765
_PACKAGE = "foxglove"
NEEDED = "Foxglove and Lichtblick need the package foxglove-sdk: pip install 'jtqd[live]'"


def installed() -> bool:
    """Return whether the package that Foxglove and Lichtblick need is installed."""
    return importlib.util.find_spec(_PACKAGE) is not None


class Address(NamedTuple):
    """A host name or IP address, and a TCP port (0: any that is free)."""

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT

    def of(self, scheme: str) -> str:
        """Return its URL."""
        return (
            f"{scheme}://[{self.host}]:{self.port}"
            if ":" in self.host
            else f"{scheme}://{self.host}:{self.port}"
        )

    @property
    def loopback(self) -> bool:
        """Only this machine can reach it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def address(text: str) -> Address:
    """HOST:PORT, HOST, PORT or [IPv6]:PORT; what is left out is the default. Raises argparse.ArgumentTypeError."""
    problem = argparse.ArgumentTypeError(f"found {text!r}, expected HOST:PORT, HOST or PORT (0 to 65535)")
    if text.isdecimal():
        host, port = "", text
    elif found := re.fullmatch(r"\[([0-9a-fA-F:.]+)\](?::(\d+))?|([\w.-]+)?(?::(\d+))?", text):
        host, port = found[1] or found[3] or "", found[2] or found[4] or ""
    else:
        raise problem
    if not text or int(port or 0) > 65535:
        raise problem
    return Address(host or DEFAULT_HOST, int(port) if port else DEFAULT_PORT)


class LiveView(SideProcess):
    """Live view of one run of jtqd, listening at `address`; its failures do not affect the loop."""

    def __init__(self, start_child: StartChild, address: Address) -> None:
        super().__init__(start_child, "jtqd.daemon.live.process", "live view", "listening")
        self._address = address

    def start(self, config: Config, runtime: Path, bus: str) -> None:
        """Start the live view of the daemon with this runtime directory; `bus`: its name."""
        from jtqd.daemon.recording.launch import loop_request

        where = self._address
        reach = (
            f"the live view accepts connections from every host that can reach {where.host}; it is read-only"
        )
        self.begin(loop_request(config, runtime, bus) | where._asdict(), "" if where.loopback else reach)
