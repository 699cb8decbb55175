"""Command lines: printable streams, parser with examples, numbers of options, checks before the work."""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import sys
import textwrap
from pathlib import Path
from typing import Any, Final, TextIO

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.text import printable


def command_parser(prog: str, description: str, examples: str) -> argparse.ArgumentParser:
    """Return a parser without arguments; examples: epilog of its help, printed line by line."""
    return _Parser(prog=prog, description=description, epilog=examples, formatter_class=HelpFormatter)


class _Parser(argparse.ArgumentParser):
    """A parser, as those of its subcommands, whose `type=Path` refuses an empty name: Path would take it for here."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register("type", Path, file_name)


def file_name(text: str) -> Path:
    """Return the path of a file or directory. Raises argparse.ArgumentTypeError for an empty one."""
    if not text:
        raise argparse.ArgumentTypeError("found '', expected the name of a file or directory")
    return Path(text)


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help whose lines fit the terminal: a longer one goes on below, and so does the remark behind a command."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(each for line in text.splitlines() for each in _folded(indent + line, width))


def _folded(line: str, width: int) -> list[str]:
    if len(line) <= width:
        return [line]
    at = len(line) - len(line.lstrip())
    text, _, remark = line[at:].partition("  ")
    below = " " * (at + 4 if at else 0)
    lines = textwrap.wrap(
        text, width - 2, initial_indent=" " * at, subsequent_indent=below, break_on_hyphens=False
    )
    goes_on = " \\" if text.startswith(("jtq", "python")) else ""
    lines = [each + goes_on for each in lines[:-1]] + lines[-1:]
    return lines + textwrap.wrap(remark.strip(), width, initial_indent=below, subsequent_indent=below)


class _PrintableStream:
    """A text stream to which everything is written as `printable`; what else it has is that of `stream`."""

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file: Final = stream
        """Where rich writes: its colours are control characters. Texts that go to rich are `printable` before."""

    def write(self, text: str) -> int:
        """Write a text."""
        return self.rich_proxied_file.write(printable(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


def printable_streams() -> None:
    """Let standard output and standard error of this process have `printable` text only; the command line's first call."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, _PrintableStream):
            setattr(sys, name, _PrintableStream(stream))


def seconds(text: str) -> float:
    """Return a time in seconds, > 0 and below 1e9 (30 years). Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
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
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number >= {low}")
    return value


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
    """Make the directory of `--out` and check that files can be created in it. Raises ConfigError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"--out {path}: cannot be created: {reason}") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise ConfigError(
            f"--out {path}: files cannot be created there: no right to, or a read-only file system"
        )


def check_installed(extra: str, *packages: str) -> None:
    """Raise ConfigError unless the packages (import names) of an extra of pyproject.toml are installed."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise ConfigError(f"{', '.join(missing)} {verb} not installed: pip install 'jtqd[{extra}]'")
