"""The supervisor's side of recording: the request, the recorder's start and restart, the account of every cycle.

`recording_request` attaches what a log must carry to be understood without the machine that wrote it.
"""

from __future__ import annotations

import base64
import json
import platform
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jtqd.daemon.config import Config, JointConfig, NetworkFile
from jtqd.daemon.recording.dbc import dbc_text
from jtqd.daemon.recording.run_files import Account, free_run, part_files, read_account
from jtqd.daemon.shared.events import FILE as NOTICES
from jtqd.daemon.shared.processes import Child, ChildError, StartChild
from jtqd.daemon.shared.runtime_dir import versions
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.own_objects import own_sheet

_STARTS = 5
"""A recorder that has been started more often than this in a minute waits for `_LONG_PAUSE_S`."""
_PAUSE_S, _LONG_PAUSE_S = 1.0, 60.0
_END_LIMIT_S = 10.0
_PROGRESS = "recorded"
"""File of the account, in the runtime directory."""


class RecorderProcess:
    """The recorder of one run of jtqd, as the supervisor has it.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        runtime: jtqd's runtime directory, with ring and snapshot; request and progress of the recorder go there.
    """

    def __init__(self, start_child: StartChild, runtime: Path) -> None:
        self._start_child = start_child
        self._request = runtime / "recorder.json"
        self.progress = runtime / _PROGRESS
        self._snapshot = runtime / "snapshot"
        self._child: Child | None = None
        self._starts: list[float] = []
        self._waits = False
        self._directory: Path | None = None
        self._prefix = self._run_name = ""
        self._result: dict[str, Any] | None = None

    def start(self, request: dict[str, Any]) -> None:
        """Start the recorder with the request of `recording_request`. Raises OSError."""
        self._directory, self._prefix = Path(request["directory"]), str(request["prefix"])
        self._run_name = free_run(self._directory, self._prefix, time.time_ns())
        self.progress.unlink(missing_ok=True)
        self._write(request)
        self._run()

    @property
    def pid(self) -> int | None:
        """Process-ID of the recorder; None while there is none."""
        return self._child.pid if self._child is not None and self._child.alive() else None

    @property
    def lost(self) -> int:
        """Cycles lost so far."""
        return (read_account(self.progress) or Account()).lost

    def save(self) -> bool:
        """Request the flight recording; return False without a recorder."""
        if self.pid is None:
            return False
        assert self._child is not None
        self._child.process.send_signal(signal.SIGUSR1)
        return True

    def renew(self, request: dict[str, Any]) -> None:
        """Begin a new part with the new files attached. Raises OSError."""
        if self._child is not None:
            self._write(request)
            self._child.process.send_signal(signal.SIGHUP)

    def _write(self, request: dict[str, Any]) -> None:
        temporary = self._request.with_name(self._request.name + ".new")
        temporary.write_text(json.dumps(request | {"run": self._run_name}), encoding="utf-8")
        temporary.replace(self._request)

    def watch(self) -> None:
        """Restart a recorder that died; it continues where it was.

        After a second; after a minute if it dies again and again. What the ring has overwritten by then is counted as lost.
        """
        if self._child is None or self._child.alive():
            return
        often = len(self._starts) > _STARTS
        if time.monotonic() - self._starts[-1] > (_LONG_PAUSE_S if often else _PAUSE_S):
            self._waits = False
            self._warn("restarted, the loop continues")
            self._run()
        elif often and not self._waits:
            self._waits = True
            self._warn(f"{len(self._starts)} times in a minute; the next try in {_LONG_PAUSE_S:.0f} s")

    def end(self, *, failed: bool = False) -> dict[str, Any] | None:
        """End the recorder and return its account as far as known; None if nothing was to be recorded.

        Args:
            failed: the loop ended in an error: a flight recorder saves what it has.
        """
        if self._child is not None:
            if failed:
                self._child.process.send_signal(signal.SIGUSR2)
            self._child.process.send_signal(signal.SIGTERM)
            self._child.process.send_signal(signal.SIGCONT)  # a stopped one would sleep through it
            try:
                self._result = self._child.answer(_END_LIMIT_S)
            except ChildError as error:
                self._result = self._account(str(error))
            self._child = None
        return None if self._result is None else self._result | {"left": self._unfinished()}

    def _warn(self, what: str) -> None:
        assert self._child is not None
        code = self._child.process.returncode
        print(f"jtqd: the recorder ended with exit status {code}; {what}", file=sys.stderr)

    def _run(self) -> None:
        now = time.monotonic()
        self._starts = [*(start for start in self._starts if now - start < 60.0), now]
        # A SIGTERM before it has set up its handlers waits: it still records what is in the ring.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            self._child = self._start_child(
                "jtqd.daemon.recording.recorder", [str(self._request)], "the recorder"
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _account(self, error: str) -> dict[str, Any]:
        """Return the account of a recorder that gave none; cycles not written count as lost."""
        settled = read_account(self.progress) or Account()
        cycles = SnapshotReader(self._snapshot).count("cycles")
        return {
            "path": None,
            "cycles": cycles,
            "written": settled.written,
            "lost": cycles - settled.written,
            "error": error,
        }

    def _unfinished(self) -> list[str]:
        """Return unfinished files of this run left by killed recorders."""
        if self._directory is None:
            return []
        files = part_files(self._directory, self._prefix)
        return [str(each.path) for each in files if each.active and each.run == self._run_name]


# ---- request ----

_EDS_DIRECTORY = Path(__file__).resolve().parents[2] / "drivers" / "eds"


def loop_request(config: Config, runtime: Path, bus: str) -> dict[str, Any]:
    """Return the part that is common to the requests of all processes that read the loop's memory.

    runtime: jtqd's runtime directory; bus: its name as it can stand in a file name.
    """
    nodes = [(joint.node_id, f"drive {joint.number}") for joint in config.joints]
    if config.sensor is not None:
        nodes.append((config.sensor.node_id, "torque sensor"))
    return {
        "ring": str(runtime / "ring"),
        "snapshot": str(runtime / "snapshot"),
        "notices": str(runtime / NOTICES),
        "bus": bus,
        "nodes": nodes,
        "joint_names": [f"joint_{joint.number}" for joint in config.joints],
        "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
        "shadow": bool(config.shadow),
    }


def recording_request(
    config: Config, report: dict[str, Any], *, runtime: Path, directory: Path, bus: str
) -> dict[str, Any]:
    """Return the request for the recorder: configuration, joint files, EDS, DBC, networks and versions attached.

    report: of the boot, with the scaling read from the devices; directory: where logs go; others as of `loop_request`.
    """
    provenance = json.dumps(_provenance(config, report))
    attachments: list[dict[str, str]] = [
        {"name": "configuration.yaml", "media_type": "application/yaml", "text": config.text},
        {"name": "bus.dbc", "media_type": "text/plain", "text": dbc_text(config, report)},
        {"name": "provenance.json", "media_type": "application/json", "text": provenance},
    ]
    # By their content: a recorder that is started later attaches what is in force, even if the files have changed.
    for name, (kind, data) in _attached_files(config).items():
        content = base64.b64encode(data).decode("ascii")
        attachments.append({"name": name, "media_type": kind, "base64": content})
    for name in sorted(("drive.eds", own_sheet(len(config.joints)), "torque_sensor.eds")):
        path = str(_EDS_DIRECTORY / name)
        attachments.append({"name": name, "media_type": "text/plain", "path": path})
    settings = asdict(config.recording)
    del settings["ring_cycles"]
    return {
        **loop_request(config, runtime, bus),
        **settings,
        "progress": str(runtime / _PROGRESS),
        "directory": str(directory),
        "prefix": f"jtqd-{bus}",
        "attachments": attachments,
    }


def _networks_of(joint: JointConfig) -> list[NetworkFile]:
    """Return the networks of a joint: of the method that is sent, and of shadow methods."""
    return [*([joint.network] if joint.network else []), *joint.shadow_networks.values()]


def _attachment_names(config: Config) -> dict[Path, str]:
    """Return names of joint files, networks and profiles in the log: their own, unless two of them are called the same."""
    names: dict[Path, str] = {}
    for joint in config.joints:
        networks = [each.path for each in _networks_of(joint)]
        for path in (joint.joint_path, *networks, joint.profile_path):
            if path is not None and path not in names:
                taken = path.name in names.values()
                names[path] = f"joint_{joint.number}.{path.name}" if taken else path.name
    return names


def _attached_files(config: Config) -> dict[str, tuple[str, bytes]]:
    """Name -> media type and content of joint files, networks and profiles."""
    names = _attachment_names(config)
    found: dict[str, tuple[str, bytes]] = {}
    for joint in config.joints:
        found.setdefault(names[joint.joint_path], ("application/yaml", joint.joint_data))
        for network in _networks_of(joint):
            found.setdefault(names[network.path], ("application/octet-stream", network.data))
        if joint.profile_path:
            found.setdefault(names[joint.profile_path], ("application/yaml", joint.profile_data))
    return found


def _provenance(config: Config, report: dict[str, Any]) -> dict[str, Any]:
    names = _attachment_names(config)
    return {
        "configuration": {"path": str(config.path), "sha256": config.sha256},
        "method": config.estimator.method,
        "joints": {
            str(joint.number): {
                "file": names[joint.joint_path],
                "file_sha256": joint.joint_sha256,
                "network": names[joint.network.path] if joint.network else None,
                "network_sha256": joint.network.sha256 if joint.network else None,
                **({"profile": names[joint.profile_path]} if joint.profile_path else {}),
                "shadow_networks": {name: names[each.path] for name, each in joint.shadow_networks.items()},
            }
            for joint in config.joints
        },
        "nodes": report["nodes"],
        "versions": versions(),
        "kernel": platform.release(),
        "machine": platform.machine(),
    }
