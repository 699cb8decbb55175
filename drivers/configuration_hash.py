"""A node's configuration as one number: the hash over all that the boot has read back, and what 1020h holds of it. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from drivers.devices import Key


def configuration_sha256(found: Mapping[Key, int]) -> str:
    """SHA-256 over every value found, in the order of the objects."""
    lines = [f"{index:04X}h:{subindex}={value}\n" for (index, subindex), value in sorted(found.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def signature(sha256: str) -> tuple[int, int]:
    """The two words of 1020h for a configuration: the first 64 bits of its hash, never zero (zero: not configured).

    CiA 301 calls them date and time; CiA 302-2 compares them with what the master expects and nothing else.
    """
    words = int(sha256[:8], 16), int(sha256[8:16], 16)
    return words[0] or 1, words[1] or 1
