"""Errors of what an operator wrote: sections of a file read key by key, numbers of a command line, nouns in messages.

Every message names the file, the key, what was found and what was expected. Whole dataclasses are read by
`jtqd.estimator.decoder`.
"""

from __future__ import annotations

import importlib.util
import math
import os
import reprlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final


class Required:
    """Type of the mark REQUIRED."""


REQUIRED: Final = Required()
"""Default of every reading method: the key must be there."""
SECTION: Final = "a mapping of keys to values"


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


class Section:
    """One mapping of a configuration; each key is read once with its type, unit and range.

    mapping: what the parser gave; `where`: file name for the messages; `path`: dotted key of this mapping.
    Raises ConfigError from every reading method. `finish()` refuses the keys that nobody asked for.
    """

    def __init__(self, mapping: object, where: str, path: str = "") -> None:
        self.where: Final = where
        self.path: Final = path
        if not isinstance(mapping, Mapping):
            at = f"key '{path}': " if path else ""
            raise ConfigError(f"{where}: {at}found {shown(mapping)}, expected {SECTION}")
        for key in mapping:
            if not isinstance(key, str):
                raise ConfigError(
                    f"{where}: {self._at(str(key))}: found the key {key!r}, expected a text key"
                )
        self._mapping: Final[Mapping[str, Any]] = mapping
        self._known: Final[dict[str, None]] = {}

    def _at(self, key: str) -> str:
        return f"key '{self.path}.{key}'" if self.path else f"key '{key}'"

    def error(self, key: str, found: object, expected: str) -> ConfigError:
        """Return (not raise) the error of one key, for checks that this class does not know."""
        return ConfigError(f"{self.where}: {self._at(key)}: found {shown(found)}, expected {expected}")

    def as_written(self, key: str, value: object) -> object:
        """Return the value of a dotted key as it stands in the file when it equals `value` (1 for 1.0), else `value`."""
        found: Any = self._mapping
        for part in key.split("."):
            found = found.get(part) if isinstance(found, Mapping) else None
        return found if found == value else value

    def _take(self, key: str, default: object, expected: str) -> Any:
        self._known[key] = None
        if key in self._mapping:
            return self._mapping[key]
        if isinstance(default, Required):
            raise ConfigError(f"{self.where}: {self._at(key)}: missing, expected {expected}")
        return default

    def has(self, key: str) -> bool:
        """Return whether the key is present (does not count as reading it)."""
        return key in self._mapping

    def names(self) -> tuple[str, ...]:
        """Return all keys that are present, in file order."""
        return tuple(self._mapping)

    def raw(self, key: str, default: Any = REQUIRED, expected: str = "a value") -> Any:
        """Return the value as parsed, marking the key as known; `expected` is for the message when it is missing."""
        return self._take(key, default, expected)

    def number(
        self,
        key: str,
        unit: str = "",
        low: float | None = None,
        high: float | None = None,
        default: Any = REQUIRED,
        *,
        above: float | None = None,
    ) -> float:
        """Return a finite float in [low, high], and > `above`; bool, text, NaN and infinity are refused."""
        expected = range_text("a number" + in_unit(unit), low, high, above)
        value = self._take(key, default, expected)
        if key not in self._mapping:
            return value  # type: ignore[no-any-return]  # the caller's own default, None included
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, value, expected + number_as_text(value))
        try:
            number = float(value)
        except OverflowError:
            raise self.error(key, value, expected) from None
        if not math.isfinite(number) or not _in_range(number, low, high, above):
            raise self.error(key, value, expected)
        return number

    def integer(
        self,
        key: str,
        unit: str = "",
        low: int | None = None,
        high: int | None = None,
        default: Any = REQUIRED,
    ) -> int:
        """Return a whole number in [low, high]; 3.0, bool and text are refused."""
        expected = range_text("a whole number" + in_unit(unit), low, high, None)
        value = self._take(key, default, expected)
        if key not in self._mapping:
            return value  # type: ignore[no-any-return]
        if isinstance(value, bool) or not isinstance(value, int) or not _in_range(value, low, high, None):
            raise self.error(key, value, expected)
        return value

    def text(
        self,
        key: str,
        choices: Iterable[str] | None = None,
        default: Any = REQUIRED,
    ) -> str:
        """Return a non-empty text, one of `choices` where given."""
        allowed = None if choices is None else tuple(choices)
        expected = "a text" if allowed is None else "one of " + ", ".join(repr(c) for c in allowed)
        value = self._take(key, default, expected)
        if key not in self._mapping:
            return value  # type: ignore[no-any-return]
        if not isinstance(value, str) or not value.strip() or (allowed is not None and value not in allowed):
            raise self.error(key, value, expected)
        return value

    def section(self, key: str, optional: bool = False) -> Section | None:
        """Return the mapping under `key`; None when it is optional and missing (or empty in the file)."""
        value = self._take(key, None if optional else REQUIRED, SECTION)
        if value is None and optional:
            return None
        return Section(value, self.where, self._child(key))

    def required(self, key: str) -> Section:
        """Return the mapping under `key`, which must be there."""
        return Section(self._take(key, REQUIRED, SECTION), self.where, self._child(key))

    def sections(self, key: str) -> list[Section]:
        """Return the list of mappings under `key`; a missing key or null is an empty list."""
        value = self._take(key, None, "a list of mappings")
        if value is None:
            return []
        if not isinstance(value, list | tuple):
            raise self.error(key, value, "a list of mappings")
        return [Section(item, self.where, f"{self._child(key)}[{n}]") for n, item in enumerate(value)]

    def _child(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key

    def finish(self, known: Iterable[str] = ()) -> None:
        """Refuse keys that were not read yet and are not `known`, naming the nearest one."""
        self._known.update(dict.fromkeys(known))
        for key in self._mapping:
            if key not in self._known:
                import difflib  # seldom needed, and not small

                near = difflib.get_close_matches(key, self._known, n=1)
                hint = f"did you mean '{near[0]}'?" if near else "known keys: " + ", ".join(self._known)
                raise ConfigError(f"{self.where}: {self._at(key)}: unknown key, {hint}")


def _in_range(value: float, low: float | None, high: float | None, above: float | None) -> bool:
    return (
        (low is None or value >= low) and (high is None or value <= high) and (above is None or value > above)
    )


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


def check_installed(extra: str, *packages: str) -> None:
    """Raise ConfigError unless the packages are installed, import names of what an extra of pyproject.toml brings."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise ConfigError(f"{', '.join(missing)} {verb} not installed: pip install 'jtqd[{extra}]'")


# Words of messages, and numbers of JSON.


def finite(value: float) -> float | None:
    """Return the number, or None for NaN and infinity, which JSON does not have."""
    return value if math.isfinite(value) else None


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return number and noun in agreement.

    >>> counted(1, "run"), counted(2, "run"), counted(0, "velocity", "velocities")
    ('1 run', '2 runs', '0 velocities')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
