"""Options that are passed on to the command, and what of them goes into a result's name: content, not paths."""

from __future__ import annotations

import argparse
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jtqd.estimator.checked import ConfigError
from jtqd.sysid.runs.files import ColumnMap
from jtqd.sysid.runs.joints import joint_files


@dataclass(frozen=True)
class Passed:
    """arguments: for the command, paths absolute; parameters: the same by content."""

    arguments: tuple[str, ...]
    parameters: dict[str, Any]


def passed_to_diagnose(options: argparse.Namespace) -> Passed:
    """Joint files and column map. Raises UsageError, ConfigError, RunError."""
    columns = None if options.columns is None else ColumnMap.load(options.columns)
    files = joint_files(options.joint, columns)
    arguments: list[str] = []
    for text in options.joint:
        number, equals, path = text.rpartition("=")
        arguments += ["--joint", f"{number}{equals}{_absolute(Path(path))}"]
    parameters: dict[str, Any] = {"joint": {str(key): _sha256(path) for key, path in files.items()}}
    if options.columns is not None:
        arguments += ["--columns", _absolute(options.columns)]
        parameters["columns"] = _sha256(options.columns)
    return Passed(tuple(arguments), parameters)


def passed_to_replay(options: argparse.Namespace) -> Passed:
    """Models and method. Raises ConfigError."""
    arguments: list[str] = []
    parameters: dict[str, Any] = {}
    if options.model is not None:
        if not options.model.is_dir():
            raise ConfigError(f"--model {options.model}: found no such directory, expected one with models")
        arguments += ["--model", _absolute(options.model)]
        inside = sorted(path for path in options.model.rglob("*") if path.is_file())
        parameters["model"] = {str(path.relative_to(options.model)): _sha256(path) for path in inside}
    if options.method is not None:
        arguments += ["--method", options.method]
        parameters["method"] = options.method
    if options.exact:
        arguments.append("--exact")
        parameters["exact"] = True
    return Passed(tuple(arguments), parameters)


def _absolute(path: Path) -> str:
    return os.path.abspath(path)


def _sha256(path: Path) -> str:
    """Raises ConfigError for a file that cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
