"""Decode plain mappings (from YAML or JSON) into frozen dataclasses whose annotations state unit and range.

    @dataclass(frozen=True)
    class Friction:
        coulomb_nm: Annotated[float, limits("Nm", ge=0.0)]
        stribeck_velocity_rad_s: Annotated[float, limits("rad/s", gt=0.0)] = 0.05

        def __post_init__(self) -> None:
            check(self, "friction")          # values built in code keep the same ranges

    friction = decode(Friction, Section(mapping, "joint.yaml", "friction"))

A range stands once, beside its field. msgspec holds the ranges and converts the values. Its errors have neither the
value nor the unit, and it takes NaN, infinity and keys that no field has: keys, finiteness and messages are ours.

A field is a value (float, int, bool, str or a tuple of numbers), a dataclass (a section), a tuple of dataclasses (a list
of sections) or a Mapping from str to values (a section with free keys). A key may be left out where its field has a
default or may be None; a section or list that is empty in the file counts as left out. A dataclass that differs in
shape from its section has a class method `from_section(section)`.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import inspect

from jtqd.estimator.checked import (
    REQUIRED,
    SECTION,
    ConfigError,
    Section,
    Verbatim,
    in_unit,
    number_as_text,
    range_text,
    shown,
)

T = TypeVar("T")
_LARGEST = 1e30
"""Of a number in a file: no quantity here is larger, and powers of it overflow."""


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
    """Return the annotation of a text that is one of `names`; expected: what a message says instead of them."""
    names = tuple(names)
    expected = expected or "one of " + ", ".join(map(repr, names))
    pattern = "|".join(map(re.escape, names))
    return msgspec.Meta(pattern=rf"\A({pattern})\Z", extra={"choices": names, "expected": expected})


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

    where: name of the dataclass in the message; `decode` puts file and path in its place.
    """

    def __init__(self, where: str, key: str, found: object, expected: str) -> None:
        super().__init__(f"{where}.{key}: found {shown(found)}, expected {expected}")
        self.key, self.found, self.expected = key, found, expected

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str]]:
        """Reach another process as a plain ConfigError."""
        return ConfigError, (str(self),)


def decode(kind: type[T], section: Section, **given: Any) -> T:
    """Return the dataclass `kind` with the values of a section; `given` are fields that are no keys of it.

    Raises ConfigError naming file, key, what was found and what was expected, for an unknown or missing key, a wrong
    type, a number that is not finite or out of range, and what the dataclass itself refuses by FieldError.
    """
    schema: Any = kind
    keys = [field for field in _fields_of(schema) if field.name not in given]
    section.finish(field.name for field in keys)
    for field in keys:
        value = field.read(section)
        if value is not MISSING:
            given[field.name] = value
    try:
        return kind(**given)
    except FieldError as error:
        found = section.as_written(error.key, error.found)
        raise section.error(error.key, found, error.expected) from None


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
class _Field:
    """How one field is read. form: value (by msgspec), section, list (of sections) or mapping."""

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

    def read(self, section: Section) -> Any:
        """Return the value of the section's key; MISSING: the field takes its default. Raises ConfigError."""
        default = MISSING if self.optional else None if self.nullable else REQUIRED
        value = section.raw(self.name, default, self.expected)
        if value is None and self.optional and self.form != "value":
            value = MISSING
        if value is MISSING or (value is None and self.nullable):
            return value
        if self.form == "value":
            return self.convert(section, self.name, value)
        if self.form == "list":
            return tuple(_nested(self.inner, each) for each in section.sections(self.name))
        inner = section.required(self.name)
        if self.form == "section":
            return _nested(self.inner, inner)
        take = (lambda _, __, value: value) if self.inner is None else self.inner.convert
        return {key: take(inner, key, inner.raw(key)) for key in inner.names()}

    def convert(self, section: Section, key: str, value: object) -> Any:
        """Return one value in the type of the field. Raises ConfigError."""
        many = isinstance(self.node, inspect.VarTupleType | inspect.TupleType)
        if not many or isinstance(value, list | tuple):  # msgspec takes sets, whose order is none
            try:
                converted = msgspec.convert(_plain(value), self.hint)
            except msgspec.ValidationError:
                pass
            else:
                if _finite(converted):
                    return converted
        found, expected = value, self.expected
        if many and isinstance(value, list) and len(value) not in _lengths(self.node):
            found = numbers_text(len(value))
        if isinstance(self.node, inspect.FloatType):
            expected += number_as_text(value)
            if isinstance(value, float) and math.isfinite(value) and abs(value) > _LARGEST:
                expected += f" and at most {_LARGEST:g} in magnitude"
        raise section.error(key, found, expected)

    def holds(self, value: Any) -> bool:
        """Return whether a number or choice keeps the annotation."""
        node = self.node
        if value is None:
            return self.nullable
        if self.choices:
            return value in self.choices
        whole = isinstance(node, inspect.IntType)
        return (
            isinstance(value, int if whole else int | float)
            and not isinstance(value, bool)
            and math.isfinite(value)
            and (node.ge is None or value >= node.ge)
            and (node.gt is None or value > node.gt)
            and (node.le is None or value <= node.le)
        )


def _nested(kind: Any, section: Section) -> Any:
    """Return the dataclass of a section, by its own `from_section` where it has one."""
    own = getattr(kind, "from_section", None)
    return decode(kind, section) if own is None else own(section)


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
def _fields_of(kind: Any) -> tuple[_Field, ...]:
    """Return how the fields of a dataclass are read, in its order."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple(
        _field(each.name, hints[each.name], (each.default, each.default_factory) != (MISSING, MISSING))
        for each in fields(kind)
    )


@cache
def _checked_fields(kind: Any) -> tuple[_Field, ...]:
    """Return the numbers and choices among the fields of a dataclass."""
    return tuple(
        each
        for each in _fields_of(kind)
        if each.choices or isinstance(each.node, inspect.FloatType | inspect.IntType)
    )


def _field(name: str, hint: Any, optional: bool) -> _Field:
    """Return how a field of this annotation is read; optional: it has a default."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    nullable = NoneType in options
    (core,) = (each for each in options if each is not NoneType)
    arguments = get_args(core)
    if is_dataclass(core):
        return _Field(name, hint, "section", core, SECTION, nullable, optional)
    if get_origin(core) is tuple and is_dataclass(arguments[0]):
        return _Field(name, hint, "list", arguments[0], "a list of mappings", nullable, optional)
    if get_origin(core) is Mapping:
        inner = None if arguments[1] is Any else _field("", arguments[1], False)
        return _Field(name, hint, "mapping", inner, SECTION, nullable, optional)
    node: Any = inspect.type_info(core)
    extra: dict[str, Any] = {}
    if isinstance(node, inspect.Metadata):
        node, extra = node.type, node.extra or {}
    expected = extra.get("expected") or _expected(node, extra.get("unit", ""))
    return _Field(name, hint, "value", None, expected, nullable, optional, node, extra.get("choices", ()))


def _expected(node: Any, unit: str) -> str:
    """Return what a message calls the values of a type."""
    if isinstance(node, inspect.FloatType | inspect.IntType):
        kind = "a number" if isinstance(node, inspect.FloatType) else "a whole number"
        return range_text(kind + in_unit(unit), node.ge, node.le, node.gt)
    if isinstance(node, inspect.VarTupleType | inspect.TupleType):
        lengths = _lengths(node)
        count = f"{lengths[0]} " if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]} "
        return f"a list of {count if len(lengths) < sys.maxsize else ''}finite numbers{in_unit(unit)}"
    return "true or false" if isinstance(node, inspect.BoolType) else "a text"
