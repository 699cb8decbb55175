"""The recorder's request: the JSON file that `python -m jtqd.daemon.recording.recorder` gets.

The supervisor makes it (`jtqd.daemon.recording.keeper`). Nothing heavy is imported here: the recorder is a small process.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jtqd.daemon.recording.diagnostics import Node
from jtqd.daemon.recording.mcap_file import NamedData
from jtqd.daemon.recording.own_files import RUN_PATTERN
from jtqd.daemon.shared.cycle_record import MOST_JOINTS

_SOURCES = {"path", "text", "base64"}
_PATHS = ("progress", "snapshot", "notices")
_LISTS = ("attachments", "joint_names", "gear_ratios")


class RequestError(ValueError):
    """The request cannot be used; the message is one line."""


@dataclass(frozen=True)
class RecorderRequest:
    """Paths and constants of one recording; megabytes are of 1 000 000 bytes.

    Attributes:
        ring: file of the ring of cycle records (`jtqd.daemon.shared.ring`).
        directory: where the MCAP files go; made when it does not exist.
        prefix: what their names begin with (`jtqd.daemon.recording.parts`).
        run: name of the run; another recorder of the same run goes on with its numbers. None: a new one.
        chunk_s: length of a chunk [s]; a crash costs at most this and 0.1 s.
        rotate_s, rotate_mb, budget_mb, keep_run, reserve_mb, flight_recorder_s: see `jtqd.daemon.config`.
        wait_s: how long to wait for the ring to appear [s].
        repair: finish files that a crash has left behind.
        attachments: each {"name", "media_type", and one of "path", "text" and "base64"}.
        progress: file of `jtqd.daemon.recording.progress`; an older recorder's account in it is carried on. None: none.
        snapshot: the loop's `jtqd.daemon.shared.snapshot`, for /diagnostics. None: without it.
        notices: the supervisor's `jtqd.daemon.shared.notices`, for /events and /log. None: without them.
        bus: name of the bus, for /diagnostics.
        nodes: [node-ID, name] of those in /diagnostics.
        joint_names: of the joints, joint 1 first, for /joint_states; there are as many joints as names.
        gear_ratios: of the joints; null where not known.
        channel_metadata: topic -> {key: text}, e.g. the PDO map of /can/frames.
    """

    ring: Path
    directory: Path
    prefix: str = "jtqd"
    run: str | None = None
    chunk_s: float = 0.5
    rotate_s: float = 600.0
    rotate_mb: float = 1000.0
    budget_mb: float | None = None
    keep_run: bool = True
    reserve_mb: float = 0.0
    flight_recorder_s: float | None = None
    wait_s: float = 10.0
    repair: bool = True
    attachments: tuple[dict[str, str], ...] = ()
    progress: Path | None = None
    snapshot: Path | None = None
    notices: Path | None = None
    bus: str = ""
    nodes: tuple[Node, ...] = ()
    joint_names: tuple[str, ...] = ("joint_1", "joint_2")
    gear_ratios: tuple[float | None, ...] = (None, None)
    channel_metadata: dict[str, dict[str, str]] | None = None

    def __post_init__(self) -> None:
        if not 0.01 <= self.chunk_s <= 60.0:
            raise RequestError(f"chunk_s: found {self.chunk_s!r}, expected 0.01 to 60 s")
        if "/" in self.prefix or not self.prefix:
            raise RequestError(f"prefix: found {self.prefix!r}, expected the beginning of a file name")
        if self.run is not None and not RUN_PATTERN.fullmatch(self.run):
            raise RequestError(f"run: found {self.run!r}, expected YYYYmmddTHHMMSSZ")
        for key in ("rotate_s", "rotate_mb", "budget_mb", "reserve_mb", "flight_recorder_s"):
            value = getattr(self, key)
            if value is not None and not 0.0 <= value < math.inf:
                raise RequestError(f"{key}: found {value!r}, expected a number from 0 on")
        if not len(self.gear_ratios) == self.joints <= MOST_JOINTS or not self.joints:
            raise RequestError(f"joint_names and gear_ratios: expected 1 to {MOST_JOINTS}, as many of each")
        for ratio in self.gear_ratios:
            if ratio is not None and not (math.isfinite(ratio) and ratio != 0.0):
                raise RequestError(f"gear_ratios: found {ratio!r}, expected a number other than 0, or null")

    @property
    def joints(self) -> int:
        """Return the number of joints."""
        return len(self.joint_names)

    @classmethod
    def from_file(cls, path: Path) -> RecorderRequest:
        """Read a request.

        Raises:
            RequestError: unreadable, not JSON, an unknown or missing key, a value of the wrong kind.
        """
        try:
            content: Any = json.loads(path.read_text(encoding="utf-8"))
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
        for key in _PATHS:
            if values.get(key) is not None:
                values[key] = Path(values[key])
        for key in _LISTS:
            if key in values:
                values[key] = tuple(values[key])
        values["nodes"] = tuple(Node(int(number), str(name)) for number, name in values.get("nodes", ()))
        for item in values.get("attachments", ()):
            if not isinstance(item, dict) or "name" not in item or len(_SOURCES & item.keys()) != 1:
                raise RequestError(f"attachment {item!r:.200}: expected a name and a path, a text or base64")
        return cls(**values)

    def load_attachments(self) -> tuple[list[NamedData], list[str]]:
        """Attachments, and a line for each that is not what it should be: a missing one must not end a recording."""
        loaded, problems = [], []
        for item in self.attachments:
            media_type = item.get("media_type", "application/octet-stream")
            try:
                data = _content(item)
            except OSError as error:
                problems.append(f"attachment {item['name']}: {error.strerror}: {item['path']}")
                continue
            except ValueError as error:
                problems.append(f"attachment {item['name']}: its base64: {error}")
                continue
            loaded.append(NamedData(item["name"], media_type, data))
        return loaded, problems


def _content(item: dict[str, str]) -> bytes:
    """Return bytes of an attachment. Raises OSError: a file that cannot be read; ValueError: wrong base64."""
    if "base64" in item:
        return base64.b64decode(item["base64"], validate=True)
    return item["text"].encode() if "text" in item else Path(item["path"]).read_bytes()
