"""What the recorder is asked to do: the JSON file that `python -m daemon.recorder` gets."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from daemon.mcap_writer import NamedData

DEFAULT_CHUNK_S = 0.5


class RequestError(ValueError):
    """The request cannot be used; the message is one line."""


@dataclass(frozen=True)
class RecorderRequest:
    """Paths and constants of one recording.

    Attributes:
        ring: file of the ring of cycle records (`daemon.ring`).
        directory: where the MCAP file goes; made when it does not exist.
        prefix: the file is PREFIX-YYYYmmddTHHMMSSZ.mcap.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        wait_s: how long to wait for the ring to appear [s].
        attachments: each {"name", "media_type", and "path" or "text"}.
        progress: file of `daemon.recorder_progress`; an older recorder's account in it is carried on. None: none.
        snapshot: the loop's `daemon.snapshot`, whose counters go to /diagnostics. None: without them.
        joint_names: of joint 1 and 2, for /joint_states.
        gear_ratios: of joint 1 and 2; null where not known.
        channel_metadata: topic -> {key: text}, e.g. the PDO map of /can/frames.
    """

    ring: Path
    directory: Path
    prefix: str = "jtqd"
    chunk_s: float = DEFAULT_CHUNK_S
    wait_s: float = 10.0
    attachments: tuple[dict[str, str], ...] = ()
    progress: Path | None = None
    snapshot: Path | None = None
    joint_names: tuple[str, str] = ("joint_1", "joint_2")
    gear_ratios: tuple[float | None, float | None] = (None, None)
    channel_metadata: dict[str, dict[str, str]] | None = None

    def __post_init__(self) -> None:
        if not 0.01 <= self.chunk_s <= 60.0:
            raise RequestError(f"chunk_s: found {self.chunk_s!r}, expected 0.01 to 60 s")
        if "/" in self.prefix or not self.prefix:
            raise RequestError(f"prefix: found {self.prefix!r}, expected the beginning of a file name")
        if len(self.joint_names) != 2 or len(self.gear_ratios) != 2:
            raise RequestError("joint_names and gear_ratios: expected two of each")
        for ratio in self.gear_ratios:
            if ratio is not None and not (math.isfinite(ratio) and ratio != 0.0):
                raise RequestError(f"gear_ratios: found {ratio!r}, expected a number other than 0, or null")

    @classmethod
    def from_file(cls, path: Path) -> RecorderRequest:
        """Read a request.

        Raises:
            RequestError: unreadable, not JSON, an unknown or missing key, a value of the wrong kind.
        """
        try:
            content: Any = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise RequestError(f"{path}: cannot be read as JSON: {error}") from None
        try:
            return cls._from_mapping(content)
        except RequestError as error:
            raise RequestError(f"{path}: {error}") from None
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise RequestError(f"{path}: {type(error).__name__}: {error}") from None

    @classmethod
    def _from_mapping(cls, content: Any) -> RecorderRequest:
        if not isinstance(content, dict):
            raise RequestError("expected a mapping")
        unknown = content.keys() - {field.name for field in fields(cls)}
        if unknown:
            raise RequestError(f"unknown key {sorted(unknown)[0]!r}")
        for key in ("ring", "directory"):
            if not isinstance(content.get(key), str):
                raise RequestError(f"key {key!r}: expected a path")
        values = dict(content, ring=Path(content["ring"]), directory=Path(content["directory"]))
        for key in ("progress", "snapshot"):
            if values.get(key) is not None:
                values[key] = Path(values[key])
        for key in ("attachments", "joint_names", "gear_ratios"):
            if key in values:
                values[key] = tuple(values[key])
        for item in values.get("attachments", ()):
            if not isinstance(item, dict) or "name" not in item or ("path" in item) == ("text" in item):
                raise RequestError(f"attachment {item!r}: expected a name and either a path or a text")
        return cls(**values)

    def load_attachments(self) -> tuple[list[NamedData], list[str]]:
        """Attachments, and a line for each that cannot be read: a missing one must not end a recording."""
        loaded, problems = [], []
        for item in self.attachments:
            media_type = item.get("media_type", "application/octet-stream")
            try:
                data = item["text"].encode() if "text" in item else Path(item["path"]).read_bytes()
            except OSError as error:
                problems.append(f"attachment {item['name']}: {error.strerror}: {item['path']}")
                continue
            loaded.append(NamedData(item["name"], media_type, data))
        return loaded, problems
