"""Addresses of AF_UNIX sockets in directories of any depth.

The kernel takes at most 107 bytes (`sun_path`, unix(7)). A longer path is reached through its directory, held open as a
descriptor: /proc/self/fd/N/NAME.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST = 107
"""Bytes of an address, without its end."""


@contextmanager
def reachable(path: Path | str) -> Iterator[str]:
    """What to bind or connect to for the socket at `path`; valid within the `with`.

    Raises:
        OSError: a path is too long and its directory cannot be opened. A name that alone is too long stays as it is, and
            `bind` says so.
    """
    text = os.fspath(path)
    directory, name = os.path.split(text)
    if len(os.fsencode(text)) <= LONGEST or not name:
        yield text
        return
    descriptor = os.open(directory or ".", os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{name}"
    finally:
        os.close(descriptor)
