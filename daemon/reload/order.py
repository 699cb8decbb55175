"""The supervisor's order to the loop: load this file of estimators; one JSON line on its standard input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

FILE: Final = "estimators"
"""Name of the file in the runtime directory."""


@dataclass(frozen=True, slots=True)
class Order:
    """The file, its length and its SHA-256 (hex)."""

    path: Path
    length: int
    sha256: str

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Order:
        """Read it from what travelled as JSON."""
        return cls(Path(mapping["swap"]), int(mapping["bytes"]), str(mapping["sha256"]))

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"swap": str(self.path), "bytes": self.length, "sha256": self.sha256}
