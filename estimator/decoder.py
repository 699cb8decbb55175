"""Decode mappings (from YAML or JSON) into frozen dataclasses whose annotations state unit and range.

    @dataclass(frozen=True)
    class Friction:
        coulomb_nm: Annotated[float, limits("Nm", ge=0.0)]
        stribeck_velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)] = 0.05

        def __post_init__(self) -> None:
            check(self, "friction")          # values built in code keep the same ranges

    friction = decode(Friction, mapping, "joint.yaml", "friction")

A range stands once, beside its field. msgspec holds the ranges and converts the values. Its errors have neither the
value nor the unit, and it takes NaN, infinity and keys that no field has: keys, finiteness and messages are ours.

A field is a value (float, int, bool, str, a tuple of numbers, or what `parsed` makes), a dataclass (a section), a tuple
of dataclasses or of mappings (a list of sections) or a Mapping from str to values or sections (free keys). A key may
be left out where its field has a default or may be None; a section or list that is empty in the file counts as left out.
`false` for a section that may be None and has another default is None.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Final, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import inspect

from jtqd.estimator.errors import ConfigError, Verbatim, in_unit, number_as_text, range_text, shown
from jtqd.estimator.files import read_file

T = TypeVar("T")
_LARGEST = 1e30
"""Of a number in a file: no quantity here is larger, and powers of it overflow."""
_SECTION: Final = "a mapping of keys to values"


def limits(
    unit: str = "",
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    length: tuple[int, int] = (0, sys.maxsize),
) -> msgspec.Meta:
    """Return the annotation of a number, or of a list of numbers: unit, range, least and largest length."""
    bounds: dict[str, Any] = {"ge": ge, "gt": gt, "le": le}
    if length != (0, sys.maxsize):
        bounds |= {"min_length": length[0], "max_length": length[1]}
    return msgspec.Meta(**bounds, extra={"unit": unit})


def choice(names: Iterable[str], expected: str = "") -> msgspec.Meta:
    """Return the annotation of a text that is one of `names`; expected: text of the message in place of them."""
    names = tuple(names)
    expected = expected or "one of " + ", ".join(map(repr, names))
    pattern = "|".join(map(re.escape, names))
    return msgspec.Meta(pattern=rf"\A({pattern})\Z", extra={"choices": names, "expected": expected})


def parsed(parse: Callable[[Any], Any], expected: str) -> msgspec.Meta:
    """Return the annotation of a value that `parse` makes of what the file has; it raises ValueError or FieldError."""
    return msgspec.Meta(extra={"parse": parse, "expected": expected})


Text = Annotated[
    str,
    msgspec.Meta(
        pattern=r"\A(?=.*\S)[^\x00-\x1f\x7f-\x9f]+\Z",
        extra={"expected": "a text of printable characters that is not empty"},
    ),
]
"""A text that is not empty; it comes to terminals, file names and reports, so it holds no control characters."""


def numbers_text(count: int) -> Verbatim:
    """Return how a message shows a list of a wrong length."""
    return Verbatim("1 number" if count == 1 else f"{count} numbers")


class FieldError(ConfigError):
    """A value of a dataclass cannot be used: key (dotted below the dataclass), what was found, what was expected.

    where: name of the dataclass in the message; `decode` puts file and path in its place. found MISSING: the key is
    not there. problem: what is wrong in other words. also: further keys that are not there, and what is expected of each.
    """

    def __init__(
        self,
        where: str,
        key: str,
        found: object,
        expected: str,
        problem: str = "",
        *,
        also: tuple[tuple[str, str], ...] = (),
    ) -> None:
        if not problem:
            problem = "missing" if found is MISSING else f"found {shown(found)}"
            problem += f", expected {expected}"
        self.where, self.key, self.found, self.expected, self.problem = where, key, found, expected, problem
        self.also = also
        super().__init__(f"{where}.{key}: {problem}{self.others}")

    @property
    def others(self) -> str:
        """Return the further keys that are not there, for the end of a message."""
        return "".join(f"; key '{key}': missing, expected {expected}" for key, expected in self.also)

    def below(self, key: str, where: str = "") -> FieldError:
        """Return the error with a key before its own; where: name of what that key belongs to."""
        also = tuple((_joined(key, other), expected) for other, expected in self.also)
        path = _joined(key, self.key)
        return FieldError(where or self.where, path, self.found, self.expected, self.problem, also=also)

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str]]:
        """Reach another process as a plain ConfigError."""
        return ConfigError, (str(self),)


@contextmanager
def below(key: str, where: str = "") -> Iterator[None]:
    """Put a key before those of the FieldErrors that are raised inside; where: name of what the key belongs to."""
    try:
        yield
    except FieldError as error:
        raise error.below(key, where) from None


@contextmanager
def in_file(where: str, path: str = "") -> Iterator[None]:
    """Raise the FieldErrors that are raised inside as a ConfigError that names file and key; path: of the section."""
    try:
        yield
    except FieldError as error:
        error = error.below(path)
        at = f"key '{error.key}': " if error.key else ""
        raise ConfigError(f"{where}: {at}{error.problem}{error.others}") from None


def _joined(path: str, key: str) -> str:
    return f"{path}.{key}" if path and key else path or key


def decode(
    kind: type[T],
    mapping: object,
    where: str,
    path: str = "",
    *,
    required: Iterable[str] = (),
    **given: Any,
) -> T:
    """Return the dataclass `kind` with the values of a section; `given` are fields that are no keys of it.

    mapping: as the parser returned it; where: name of the file; path: dotted key of the section in it; required: keys that
    must be there although their fields have a default. Raises ConfigError naming file, key, what was found and what was
    expected, for an unknown key, all missing keys, a wrong type, a number that is not finite or out of range, and what the
    dataclass itself refuses by FieldError.
    """
    with in_file(where, path):
        return _read(kind, mapping, required, given)


def read(kind: type[T], mapping: object, **given: Any) -> T:
    """Return the dataclass as `decode` does. Raises FieldError with the key below this section."""
    return _read(kind, mapping, (), given)


def _read(kind: type[T], mapping: object, required: Iterable[str], given: Mapping[str, Any]) -> T:
    schema: Any = kind
    section = _section(mapping)
    known = [each for each in _fields_of(schema) if each.name not in given]
    if required:
        known = [replace(each, optional=False) if each.name in required else each for each in known]
    values = {**given, **read_values(known, section)}
    try:
        return kind(**values)
    except FieldError as error:
        found = _as_written(section, error.key, error.found)
        if found is error.found:
            raise
        raise FieldError(error.where, error.key, found, error.expected) from None


def split(section: Mapping[str, Any], key: str, hint: Any) -> tuple[Any, dict[str, Any]]:
    """Return the value of a key of this annotation, and the section's other keys. Raises FieldError."""
    value = field_of(key, hint).read(section)
    return value, {name: each for name, each in section.items() if name != key}


def read_values(known: Iterable[Field], mapping: object) -> dict[str, Any]:
    """Return the values of a section's keys by name, without those left out that are optional.

    Raises FieldError for the first key that cannot be used; where it is missing, with all others that are.
    """
    section, known = _section(mapping), tuple(known)
    _check_known(section, [each.name for each in known])
    values: dict[str, Any] = {}
    errors: list[FieldError] = []
    for each in known:
        try:
            values[each.name] = each.read(section)
        except FieldError as error:
            errors.append(error)
    if errors:
        first, *others = errors
        if first.found is not MISSING:
            raise first
        missing = [each for each in others if each.found is MISSING]
        also = tuple(pair for each in missing for pair in ((each.key, each.expected), *each.also))
        raise FieldError(
            first.where, first.key, MISSING, first.expected, first.problem, also=(*first.also, *also)
        )
    return {name: value for name, value in values.items() if value is not MISSING}


def _section(value: object) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise FieldError("", "", value, _SECTION)
    for key in value:
        if not isinstance(key, str):
            raise FieldError("", str(key), key, "a text key", f"found the key {key!r}, expected a text key")
    return value


def _check_known(section: Mapping[str, Any], known: list[str]) -> None:
    for key in section:
        if key not in known:
            import difflib  # seldom needed, and not small

            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else "known keys: " + ", ".join(known)
            raise FieldError("", key, section[key], hint, f"unknown key, {hint}")


def _as_written(section: Mapping[str, Any], key: str, value: object) -> object:
    """Return the value of a dotted key as it stands in the file when it equals `value` (1 for 1.0), else `value`."""
    found: Any = section
    for part in key.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found if found == value else value


def check(value: Any, where: str) -> None:
    """Check the numbers and choices of a dataclass built in code against its annotations (for `__post_init__`).

    Raises FieldError. None passes where the annotation has it.
    """
    kind: Any = type(value)
    for field in _checked_fields(kind):
        item = getattr(value, field.name)
        if not field.holds(item):
            raise FieldError(where, field.name, item, field.expected)


@dataclass(frozen=True, slots=True)
class Field:
    """How one key is read. form: value (by msgspec or `parse`), section, list (of sections) or mapping."""

    name: str
    hint: Any
    form: str
    inner: Any
    expected: str
    nullable: bool
    optional: bool
    node: Any = None
    """Of msgspec.inspect, without None and unit."""
    choices: tuple[str, ...] = ()
    parse: Callable[[Any], Any] | None = None
    none_by_false: bool = False
    """Whether `false` in the file is None."""
    unknown: bool = False
    """Whether the default is NaN: not known."""

    def read(self, section: Mapping[str, Any]) -> Any:
        """Return the value of the section's key; MISSING: the field takes its default. Raises FieldError."""
        value = section.get(self.name, MISSING)
        if value is MISSING or (value is None and self.form != "value"):
            if self.optional:
                return MISSING
            value = None if self.nullable else value
        if (value is None and self.nullable) or (value is False and self.none_by_false):
            return None
        if value is MISSING:
            raise FieldError("", self.name, MISSING, self.expected + self._least())
        return self.convert(self.name, value) if self.form == "value" else self._nested(value)

    def _least(self) -> str:
        """Return the keys that a section must have, for messages."""
        keys = (
            [each.name for each in _fields_of(self.inner) if not each.optional]
            if self.form == "section"
            else []
        )
        return f" ({', '.join(keys)})" if keys else ""

    def _nested(self, value: object) -> Any:
        """Return the section, list of sections or mapping. Raises FieldError."""
        if self.form == "list":
            if not isinstance(value, list | tuple):
                raise FieldError("", self.name, value, self.expected)
            return tuple(_nested(self.inner, each, f"{self.name}[{n}]") for n, each in enumerate(value))
        if self.form == "section":
            return _nested(self.inner, value, self.name)
        with below(self.name):
            free = _section(value)
            if self.inner is None:
                return dict(free)
            return {key: replace(self.inner, name=key).read(free) for key in free}

    def convert(self, key: str, value: object) -> Any:
        """Return one value in the type of the field. Raises FieldError."""
        many = isinstance(self.node, inspect.VarTupleType | inspect.TupleType)
        try:
            if self.parse is not None:
                return self.parse(value)
            if not many or isinstance(value, list | tuple):  # msgspec takes sets, whose order is none
                converted = msgspec.convert(_plain(value), self.hint)
                if _finite(converted):
                    return converted
        except FieldError as error:
            raise error.below(key) from None
        except ValueError:  # of msgspec as well
            pass
        found, expected = value, self.expected
        if many and self.parse is None and isinstance(value, list) and len(value) not in _lengths(self.node):
            found = numbers_text(len(value))
        if isinstance(self.node, inspect.FloatType):
            expected += number_as_text(value)
            if self.node.le is None and isinstance(value, float) and _LARGEST < abs(value) < math.inf:
                expected += f" and at most {_LARGEST:g} in magnitude"
        raise FieldError("", key, found, expected)

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of the key's value as it is read."""
        found: dict[str, Any] = {"description": self.expected}
        if self.form == "section":
            found |= json_schema(self.inner)
        elif self.form == "list":
            inner = {"type": "object"} if self.inner is None else json_schema(self.inner)
            found |= {"type": "array", "items": inner}
        elif self.form == "mapping":
            inner = {} if self.inner is None else {"additionalProperties": self.inner.schema()}
            found |= {"type": "object", **inner}
        elif self.choices:
            found["enum"] = [*self.choices]
        elif self.parse is None:
            text = msgspec.json.encode(msgspec.json.schema(self.hint))
            found |= msgspec.json.decode(
                text.replace(rb"\\A", b"^").replace(rb"\\Z", b"$")
            )  # Python's own anchors
        others: list[Any] = (
            [{"type": "null"}] if self.nullable or (self.optional and self.form != "value") else []
        )
        others += [{"const": False}] if self.none_by_false else []
        return {"anyOf": [found, *others]} if others else found

    def holds(self, value: Any) -> bool:
        """Return whether a number or choice keeps the annotation."""
        node = self.node
        if value is None:
            return self.nullable
        if self.choices:
            return value in self.choices
        if self.unknown and math.isnan(value):
            return True
        whole = isinstance(node, inspect.IntType)
        return (
            isinstance(value, int if whole else int | float)
            and not isinstance(value, bool)
            and math.isfinite(value)
            and (node.ge is None or value >= node.ge)
            and (node.gt is None or value > node.gt)
            and (node.le is None or value <= node.le)
        )


def json_schema(kind: Any, *given: str) -> dict[str, Any]:
    """Return the JSON schema of what `read` takes, but for what the dataclass refuses; given: fields that are no keys."""
    known = [each for each in _fields_of(kind) if each.name not in given]
    return {
        "type": "object",
        "properties": {each.name: each.schema() for each in known},
        "required": [each.name for each in known if not each.optional],
        "additionalProperties": False,
    }


def _nested(kind: Any, value: object, key: str) -> Any:
    """Return the dataclass of a section; kind None: the mapping itself. Raises FieldError with the key."""
    with below(key):
        return _section(value) if kind is None else read(kind, value)


def _plain(value: object) -> object:
    """Return numpy's floats, bare or in a list, as Python's: msgspec takes no subclasses."""
    if isinstance(value, list | tuple):
        return [float(each) if isinstance(each, float) else each for each in value]
    return float(value) if isinstance(value, float) else value


def _finite(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_finite, value))
    return not isinstance(value, float) or abs(value) <= _LARGEST


def _lengths(node: Any) -> range:
    """Return the numbers of items that a list may have."""
    if isinstance(node, inspect.TupleType):
        return range(len(node.item_types), len(node.item_types) + 1)
    return range(node.min_length or 0, sys.maxsize if node.max_length is None else node.max_length + 1)


@cache
def _fields_of(kind: Any) -> tuple[Field, ...]:
    """Return how the fields of a dataclass are read, in its order."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        replace(
            field_of(
                each.name,
                hints[each.name],
                optional=(each.default, each.default_factory) != (MISSING, MISSING),
                none_by_false=each.default is not None,
            ),
            unknown=isinstance(each.default, float) and math.isnan(each.default),
        )
        for each in fields(kind)
    )


@cache
def _checked_fields(kind: Any) -> tuple[Field, ...]:
    """Return the numbers and choices among the fields of a dataclass."""
    return tuple(
        each
        for each in _fields_of(kind)
        if each.choices or isinstance(each.node, inspect.FloatType | inspect.IntType)
    )


def field_of(name: str, hint: Any, *, optional: bool = False, none_by_false: bool = False) -> Field:
    """Return how a key of this annotation is read; optional: it has a default."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    nullable = NoneType in options
    (core,) = (each for each in options if each is not NoneType)
    arguments = get_args(core)
    if is_dataclass(core):
        refusable = none_by_false and nullable and optional
        return Field(name, hint, "section", core, _SECTION, nullable, optional, none_by_false=refusable)
    if get_origin(core) is tuple and (is_dataclass(arguments[0]) or get_origin(arguments[0]) is Mapping):
        inner = arguments[0] if is_dataclass(arguments[0]) else None
        return Field(name, hint, "list", inner, "a list of mappings", nullable, optional)
    if get_origin(core) is Mapping:
        values = None if arguments[1] is Any else field_of("", arguments[1])
        return Field(name, hint, "mapping", values, _SECTION, nullable, optional)
    node: Any = inspect.type_info(core)
    extra: dict[str, Any] = {}
    if isinstance(node, inspect.Metadata):
        node, extra = node.type, node.extra or {}
    expected = extra.get("expected") or _expected(node, extra.get("unit", ""))
    choices, parse = extra.get("choices", ()), extra.get("parse")
    return Field(name, hint, "value", None, expected, nullable, optional, node, choices, parse)


def _expected(node: Any, unit: str) -> str:
    """Return what a message calls the values of a type."""
    if isinstance(node, inspect.FloatType | inspect.IntType):
        kind = "a number" if isinstance(node, inspect.FloatType) else "a whole number"
        return range_text(kind + in_unit(unit), node.ge, node.le, node.gt)
    if isinstance(node, inspect.VarTupleType) and isinstance(node.item_type, inspect.StrType):
        return "a list of texts"
    if isinstance(node, inspect.VarTupleType | inspect.TupleType):
        lengths = _lengths(node)
        count = f"{lengths[0]} " if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]} "
        return f"a list of {count if len(lengths) < sys.maxsize else ''}finite numbers{in_unit(unit)}"
    return "true or false" if isinstance(node, inspect.BoolType) else "a text"


def plain_values(value: Any) -> Any:
    """Return a value as JSON has it: dataclasses and mappings as dicts, keys as text, NaN and infinity as None."""
    return msgspec.json.decode(msgspec.json.encode(value, enc_hook=_json_value))


def parse_json(text: bytes | str) -> Any:
    """Return the value of a JSON text. Raises ValueError, of one line, for whatever is no JSON of this depth and UTF-8."""
    try:
        return msgspec.json.decode(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def read_json(
    path: str | os.PathLike[str], largest: int = 1 << 24, *, owners: Container[int] | None = None
) -> Any:
    """Return the value of a JSON file, read as by `read_file`. Raises OSError, ValueError."""
    return parse_json(read_file(path, largest, owners=owners))


def _json_value(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else value.item()  # a numpy scalar
