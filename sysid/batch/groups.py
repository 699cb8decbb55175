"""Which logs make one task: files found below what the command line names, put together by run, directory, or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from jtqd.daemon.recording.parts import ACTIVE

_UNFINISHED: Final = f".mcap{ACTIVE}"
"""Ending of a log that is being written, or was left by a crash."""
_PART: Final = re.compile(r"-\d{4,}(?=\.mcap$)", re.ASCII)
"""Number of the part at the end of a log's name (`jtqd.daemon.recording.parts`)."""
BY_RUN, BY_DIRECTORY, BY_FILE = "run", "directory", "file"
WAYS: Final = (BY_RUN, BY_DIRECTORY, BY_FILE)


class GroupError(ValueError):
    """Nothing to work on; one line: what was named, found, expected."""


@dataclass(frozen=True)
class Group:
    """Logs that one task gets, in the order of their names; `name` is unique in a batch."""

    name: str
    files: tuple[Path, ...]


@dataclass(frozen=True)
class Found:
    """The groups, and the logs left out because they are not ended."""

    groups: tuple[Group, ...]
    active: tuple[Path, ...]


def find_groups(named: Sequence[Path], by: str, kinds: Sequence[Sequence[str]]) -> Found:
    """Files among and below `named`, as groups in the order of their names.

    A file that is named must have one of the endings. Of each directory the files of the first kind that it has are taken:
    a campaign's holds the log of every run beside its table, and a run must not count twice.

    Args:
        named: files and directories.
        by: one of `WAYS`.
        kinds: endings of names, by kind.

    Raises:
        GroupError: nothing to work on.
        OSError: a directory cannot be read.
    """
    endings = tuple(ending for kind in kinds for ending in kind)
    files: dict[Path, None] = {}
    active: list[Path] = []
    for path in named:
        if not path.exists():
            raise GroupError(f"{path}: found nothing there, expected a log or a directory of logs")
        inside = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
        wanted = _first_kind(inside, kinds)
        unfinished = [each for each in inside if each.name.endswith(_UNFINISHED)]
        if not wanted and not unfinished:
            kind = "no log in it" if path.is_dir() else f"a file ending in {path.suffix!r}"
            raise GroupError(f"{path}: found {kind}, expected names ending in {', '.join(endings)}")
        files |= dict.fromkeys(_absolute(each) for each in wanted)
        active += unfinished
    if not files:
        raise GroupError(f"{active[0]}: is not ended (`jtq recover` does that), and found no other log")
    grouped: dict[str, list[Path]] = {}
    for path in files:
        grouped.setdefault(_belongs_to(path, by), []).append(path)
    top = os.path.commonpath([path.parent for path in files])
    groups = [Group(_name(key, top), tuple(sorted(paths))) for key, paths in sorted(grouped.items())]
    return Found(tuple(groups), tuple(active))


def _first_kind(inside: Sequence[Path], kinds: Sequence[Sequence[str]]) -> list[Path]:
    """Of each directory the files of the first kind that it has, hidden ones left out."""
    by_directory: dict[Path, list[Path]] = {}
    for path in inside:
        if not path.name.startswith("."):
            by_directory.setdefault(path.parent, []).append(path)
    found: list[Path] = []
    for paths in by_directory.values():
        of_kinds = ([path for path in paths if path.name.endswith(tuple(kind))] for kind in kinds)
        found += next((chosen for chosen in of_kinds if chosen), [])
    return found


def _absolute(path: Path) -> Path:
    """As the worker on another machine must be told; links stay."""
    return Path(os.path.abspath(path))


def _belongs_to(path: Path, by: str) -> str:
    if by == BY_DIRECTORY:
        return str(path.parent)
    return str(path.with_name(_PART.sub("", path.name)) if by == BY_RUN else path)


def _name(key: str, top: str) -> str:
    name = os.path.relpath(key, top)
    return os.path.basename(top) or "logs" if name == "." else name
