"""Where the live view listens: HOST:PORT of `jtqd --live`. Pure."""

from __future__ import annotations

import argparse
import importlib.util
import ipaddress
import re
from typing import NamedTuple

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8765
_PACKAGE = "foxglove"
NEEDED = "--live needs the package foxglove-sdk: pip install 'jtqd[live]'"


def installed() -> bool:
    """Return whether the package that the live view needs is installed."""
    return importlib.util.find_spec(_PACKAGE) is not None


class Address(NamedTuple):
    """A host name or IP address, and a TCP port (0: any that is free)."""

    host: str = DEFAULT_HOST
    port: int = DEFAULT_PORT

    @property
    def url(self) -> str:
        """URL for a viewer."""
        return f"ws://[{self.host}]:{self.port}" if ":" in self.host else f"ws://{self.host}:{self.port}"

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
