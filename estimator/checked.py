"""Errors of what an operator wrote, numbers and outputs of a command line, nouns in messages.

Every message names the file, the key, what was found and what was expected. Files are read by `jtqd.estimator.decoder`.
"""

from __future__ import annotations

import importlib.util
import math
import os
import reprlib
from pathlib import Path
from typing import Final

from jtqd.estimator.text import counted, finite

__all__ = (
    "ConfigError",
    "Verbatim",
    "check_installed",
    "check_output",
    "count",
    "counted",
    "finite",
    "in_unit",
    "make_directory",
    "natural",
    "number_as_text",
    "range_text",
    "seconds",
    "shown",
)


class ConfigError(ValueError):
    """What an operator wrote cannot be used; the message is one line: where, what, and what instead."""


_SHORT: Final = reprlib.Repr()
"""YAML's aliases can make a list of lists without end out of a few bytes: repr() would fill the memory with it."""
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict, _SHORT.maxset = 3, 20, 20, 20
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 200


class Verbatim(str):
    """What was found, in words: a message shows it without quotes."""

    __slots__ = ()


def shown(value: object) -> str:
    """Return a value as messages show it: its repr, shortened; what is `Verbatim` as it is."""
    if isinstance(value, Verbatim):
        return value
    text = _SHORT.repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def number_as_text(value: object) -> str:
    """Return an explanation for a number that arrived as text: YAML 1.1 needs a point and a signed exponent."""
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return ""
        return " (YAML reads this as text: write 7.0e-5, not 7e-5, and no quotes)"
    return ""


def range_text(kind: str, low: float | None, high: float | None, above: float | None) -> str:
    """Return a kind of number with its range in words."""
    if low is not None and high is not None:
        return f"{kind} from {_bound(low)} to {_bound(high)}"
    if low is not None:
        return f"{kind} >= {_bound(low)}"
    if above is not None:
        return f"{kind} > {_bound(above)}" + (f" and <= {_bound(high)}" if high is not None else "")
    return f"{kind} <= {_bound(high)}" if high is not None else kind


def in_unit(unit: str) -> str:
    """Return " in UNIT", nothing for a number without one."""
    return f" in {unit}" if unit not in {"", "1"} else ""


def _bound(value: float) -> str:
    """Whole numbers in full: 1000000 and not 1e+06, where the operator counts bits or nodes."""
    return str(value) if isinstance(value, int) else f"{value:g}"


# Numbers of a command line: types for argparse's `type=`.


def seconds(text: str) -> float:
    """Return a time in seconds, > 0 and below 1e9 (30 years). Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
        import argparse  # the daemon reads no command line with it

        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time in seconds > 0")
    return value


def count(text: str) -> int:
    """Return a whole number >= 1. Raises argparse.ArgumentTypeError."""
    return _whole(text, 1)


def natural(text: str) -> int:
    """Return a whole number >= 0. Raises argparse.ArgumentTypeError."""
    return _whole(text, 0)


def _whole(text: str, low: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if value < low:
        import argparse  # the daemon reads no command line with it

        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number >= {low}")
    return value


# What a command needs and where its results go: looked at before the work.


def check_output(path: Path) -> None:
    """Refuse the name of a file that cannot be written. Raises ConfigError."""
    parent = path.parent
    if path.is_dir():
        raise ConfigError(f"{path}: found a directory, expected the name of a file")
    if not parent.is_dir():
        what = "a file" if parent.exists() else "no such directory"
        raise ConfigError(f"{parent}: found {what}, expected a directory for {path.name}")
    if not os.access(parent if not path.exists() else path, os.W_OK):
        raise ConfigError(f"{path}: cannot be written: no right to, or a read-only file system")


def make_directory(path: Path) -> None:
    """Make the directory of `--out`, and look whether files can be created in it. Raises ConfigError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"--out {path}: cannot be created: {reason}") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise ConfigError(
            f"--out {path}: files cannot be created there: no right to, or a read-only file system"
        )


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that is there whole or, also after a crash, as it was before. Raises OSError."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_installed(extra: str, *packages: str) -> None:
    """Raise ConfigError unless the packages are installed, import names of what an extra of pyproject.toml brings."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise ConfigError(f"{', '.join(missing)} {verb} not installed: pip install 'jtqd[{extra}]'")
