"""The recorder's request: the JSON file that `python -m jtqd.daemon.recording.recorder` gets, read and made.

`RecorderRequest` is the recorder's side. `recording_request` is the supervisor's: it attaches what a log must carry to be
understood without the machine that wrote it.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import platform
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jtqd.daemon.config import Config
from jtqd.daemon.recording.dbc import dbc_text
from jtqd.daemon.recording.diagnostics import Node
from jtqd.daemon.recording.mcap_file import NamedData
from jtqd.daemon.recording.parts import RUN_PATTERN

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
        joint_names: of joint 1 and 2, for /joint_states.
        gear_ratios: of joint 1 and 2; null where not known.
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
    joint_names: tuple[str, str] = ("joint_1", "joint_2")
    gear_ratios: tuple[float | None, float | None] = (None, None)
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
    """Bytes of an attachment. Raises OSError: a file that cannot be read; ValueError: wrong base64."""
    if "base64" in item:
        return base64.b64decode(item["base64"], validate=True)
    return item["text"].encode() if "text" in item else Path(item["path"]).read_bytes()


# ---- made by the supervisor ----

_EDS_DIRECTORY = Path(__file__).resolve().parents[2] / "drivers" / "eds"
_PACKAGES = ("jtqd", "numpy", "onnxruntime", "python-can", "canopen", "mcap")


def recording_request(
    config: Config,
    report: dict[str, Any],
    *,
    directory: Path,
    ring: Path,
    progress: Path,
    snapshot: Path,
    notices: Path,
    instance: str,
) -> dict[str, Any]:
    """Request for the recorder process: configuration, joint files, EDS, DBC, networks and versions attached.

    Args:
        config: configuration in force.
        report: boot report with the scaling read from the devices.
        directory: where logs go.
        ring: the loop's ring of cycle records.
        progress: file in which the recorder stores how far it is.
        snapshot: the loop's counters.
        notices: the supervisor's notices.
        instance: name of the bus as it can stand in a file name.
    """
    attachments: list[dict[str, str]] = [
        {"name": "configuration.yaml", "media_type": "application/yaml", "text": config.text},
        {"name": "bus.dbc", "media_type": "text/plain", "text": dbc_text(config, report)},
        {
            "name": "provenance.json",
            "media_type": "application/json",
            "text": json.dumps(_provenance(config, report)),
        },
    ]
    # By their content: what is in force, whatever becomes of the files, even if the recorder must be started again.
    for name, kind, data in _attached_files(config):
        attachments.append(
            {"name": name, "media_type": kind, "base64": base64.b64encode(data).decode("ascii")}
        )
    attachments += [
        {"name": path.name, "media_type": "text/plain", "path": str(path)}
        for path in sorted(_EDS_DIRECTORY.glob("*.eds"))
    ]
    settings = config.recording
    return {
        "ring": str(ring),
        "progress": str(progress),
        "snapshot": str(snapshot),
        "notices": str(notices),
        "bus": instance,
        "nodes": nodes_of(config),
        "chunk_s": settings.chunk_s,
        "rotate_s": settings.rotate_s,
        "rotate_mb": settings.rotate_mb,
        "budget_mb": settings.budget_mb,
        "keep_run": settings.keep_run,
        "reserve_mb": settings.reserve_mb,
        "flight_recorder_s": settings.flight_recorder_s,
        "directory": str(directory),
        "prefix": f"jtqd-{instance}",
        "attachments": attachments,
        "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
    }


def nodes_of(config: Config) -> list[tuple[int, str]]:
    """(node-ID, name) of the nodes whose heartbeats /diagnostics shows."""
    nodes = [(joint.node_id, f"drive {joint.number}") for joint in config.joints]
    return nodes if config.sensor is None else [*nodes, (config.sensor.node_id, "torque sensor")]


def _attachment_names(config: Config) -> dict[Path, str]:
    """Names of joint files and networks in the log: their own, unless two of them are called the same."""
    names: dict[Path, str] = {}
    for joint in config.joints:
        for path in (joint.joint_path, *([joint.network.path] if joint.network else [])):
            if path not in names:
                taken = path.name in names.values()
                names[path] = f"joint_{joint.number}.{path.name}" if taken else path.name
    return names


def _attached_files(config: Config) -> list[tuple[str, str, bytes]]:
    """(name, media type, content) of joint files and networks."""
    names = _attachment_names(config)
    found: dict[str, tuple[str, bytes]] = {}
    for joint in config.joints:
        found.setdefault(names[joint.joint_path], ("application/yaml", joint.joint_data))
        if joint.network:
            found.setdefault(names[joint.network.path], ("application/octet-stream", joint.network.data))
    return [(name, kind, data) for name, (kind, data) in found.items()]


def _provenance(config: Config, report: dict[str, Any]) -> dict[str, Any]:
    names = _attachment_names(config)
    return {
        "configuration": {"path": str(config.path), "sha256": config.sha256},
        "method": config.estimator.method,
        "joints": {
            str(joint.number): {
                "file": names[joint.joint_path],
                "file_sha256": hashlib.sha256(joint.joint_data).hexdigest(),
                "network": names[joint.network.path] if joint.network else None,
                "network_sha256": joint.network.sha256 if joint.network else None,
            }
            for joint in config.joints
        },
        "nodes": report["nodes"],
        "versions": {name: _version(name) for name in _PACKAGES} | {"python": platform.python_version()},
        "kernel": platform.release(),
        "machine": platform.machine(),
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except ImportError:
        return "not installed"
