"""Finished results on the disk: one JSON file each, named by what it was made from, so that a batch can go on.

    OUT/results/KEY.json     a finished task: parameters, hashes of its logs, what the command printed
    OUT/results/KEY/         what the command wrote beside (a report)
    OUT/hashes.json          content hash of each log by path, size and time of change: a rerun need not read them again
    OUT/summary.json, OUT/index.html

KEY is a hash of the command, of version and code of jtqd, of the parameters and of the content of the logs. A file is there
whole or not at all.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

SCHEMA: Final = "jtq.batch.result/1"
_RESULTS, _HASHES, _LOCK = "results", "hashes.json", ".lock"


class StoreError(Exception):
    """The directory cannot be used; one line."""


def key_of(command: str, tool: str, parameters: Mapping[str, Any], hashes: Sequence[str]) -> str:
    """Name of a result: the same logs, parameters and version give the same, wherever the logs lie."""
    content = [SCHEMA, command, tool, dict(parameters), list(hashes)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def write_whole(path: Path, data: bytes) -> None:
    """Put a file in place that is there whole or not at all, and on the disk. Raises OSError."""
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


class Store:
    """Results of one batch directory; made where it is missing, held by one batch at a time.

    Raises:
        StoreError: another batch works on it.
        OSError: it cannot be made.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._results = directory / _RESULTS
        self._results.mkdir(parents=True, exist_ok=True)
        self._lock = open(directory / _LOCK, "a")  # noqa: SIM115 - held for as long as we live
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise StoreError(f"{directory}: another batch works there") from None
        self._hashes = self._read(directory / _HASHES) or {}

    def close(self) -> None:
        """Let others at it."""
        self._lock.close()

    @staticmethod
    def _read(path: Path) -> dict[str, Any] | None:
        """A JSON object; None where there is none, or something else."""
        try:
            content = json.loads(path.read_bytes())
        except (OSError, ValueError):
            return None
        return content if isinstance(content, dict) else None

    # Hashes --------------------------------------------------------------------------------------------------------------

    def hashes(self, files: Sequence[Path]) -> list[str] | None:
        """Known hashes of files that have not changed since; None where one is not known."""
        found = [self._hashes.get(str(path)) for path in files]
        marks = [_mark(path) for path in files]
        if any(one is None or one[:-1] != mark for one, mark in zip(found, marks, strict=True)):
            return None
        return [str(one[-1]) for one in found if one is not None]

    def learn(self, files: Sequence[Path], hashes: Sequence[str]) -> None:
        """Remember hashes; `save` writes them."""
        for path, value in zip(files, hashes, strict=True):
            mark = _mark(path)
            if mark is not None:
                self._hashes[str(path)] = [*mark, value]

    def save(self) -> None:
        """Write the hashes. Raises OSError."""
        write_whole(self.directory / _HASHES, json.dumps(self._hashes, indent=0).encode())

    # Results -------------------------------------------------------------------------------------------------------------

    def get(self, key: str) -> dict[str, Any] | None:
        """A finished result; None where there is none."""
        content = self._read(self._results / f"{key}.json")
        good = content is not None and content.get("schema") == SCHEMA and content.get("key") == key
        return content if good else None

    def put(self, key: str, content: Mapping[str, Any], files: Mapping[str, bytes]) -> dict[str, Any]:
        """Keep a result: first what was written beside, then the file that says it is finished. Raises OSError."""
        place = self._results / key
        if place.exists():
            shutil.rmtree(place)
        for name, data in files.items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(place / name, data)
        whole = {"schema": SCHEMA, "key": key, **content, "files": sorted(files)}
        write_whole(self._results / f"{key}.json", json.dumps(whole, indent=1, allow_nan=False).encode())
        return whole

    def link(self, key: str, name: str) -> str:
        """Where a file that was written beside a result is, seen from the summary page."""
        return f"{_RESULTS}/{key}/{name}"


def _mark(path: Path) -> list[int] | None:
    """What changes when a file does; None where it cannot be looked at."""
    try:
        state = path.stat()
    except OSError:
        return None
    return [state.st_size, state.st_mtime_ns, state.st_ino]
