"""Message definitions in ros2msg: the text of a schema record taken apart, each type's fields by name."""

from __future__ import annotations

import re
from functools import cached_property, lru_cache
from typing import NamedTuple

from jtqd.daemon.logs.errors import LogError

PRIMITIVES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    **{f"{sign}int{8 * size}": f"<{sign or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)},
    "float32": "<f4",
    "float64": "<f8",
}
"""Type -> numpy's code."""

_FIELD = re.compile(
    r"(?P<kind>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)(?:\s+[^\s=].*)?$"
)
"""Type, array, name, default value."""
_CONSTANT = re.compile(r"[\w<=/]+\s+[A-Z]\w*\s*=")
_NESTED = re.compile(r"^=+\s*\nMSG: (\S+)[^\n]*\n", re.MULTILINE)
_COMMENT = re.compile(r"#.*")
_BUILT_IN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
}
"""Some writers leave their texts out."""
_EMPTY = "uint8 structure_needs_at_least_one_member\n"


class Field(NamedTuple):
    """One field. `elements`: of a fixed array; `sequence`: as many as the message says."""

    name: str
    kind: str
    elements: int | None = None
    sequence: bool = False


class Types:
    """All types of one schema. Raises LogError for a text that is no ros2msg, when the type is asked for."""

    main = ""

    def __init__(self, text: str) -> None:
        first, *rest = _NESTED.split(text.replace("\r\n", "\n"))
        self._texts = {"": first}
        for name, body in zip(rest[::2], rest[1::2], strict=True):
            self._texts.setdefault(_bare(name), body)
        self._fields: dict[str, tuple[Field, ...]] = {}

    @cached_property
    def _by_last(self) -> dict[str, str]:
        return {name.rsplit("/", 1)[-1]: name for name in self._texts}

    def fields(self, name: str) -> tuple[Field, ...]:
        """Fields of a type; "" is the message itself."""
        if name not in self._fields:
            self._fields[name] = tuple(self._parse(self._text(name)))
        return self._fields[name]

    def _text(self, name: str) -> str:
        bare = _bare(name)
        found = self._texts.get(bare, _BUILT_IN.get(bare))
        if found is None and "/" not in bare and bare in self._by_last:
            found = self._texts[self._by_last[bare]]
        if found is None:
            raise LogError(f"found type {name!r} in a schema, expected its definition")
        return found if any(self._lines(found)) else _EMPTY

    @staticmethod
    def _lines(text: str) -> list[str]:
        lines = (_COMMENT.sub("", line).strip() for line in text.splitlines())
        return [line for line in lines if line and not _CONSTANT.match(line)]

    def _parse(self, text: str) -> list[Field]:
        fields = []
        for line in self._lines(text):
            found = _FIELD.match(line)
            if found is None:
                raise LogError(f"found {line!r} in a schema, expected a field")
            sequence = bool(found["array"]) and (found["bound"] is not None or not found["count"])
            count = int(found["count"]) if found["array"] and not sequence else None
            fields.append(Field(found["name"], found["kind"], count, sequence))
        names = [field.name for field in fields]
        if len(set(names)) != len(names):
            raise LogError("found two fields of one name in a schema")
        return fields


@lru_cache(maxsize=16)
def types_of(text: str) -> Types:
    """Types of a schema, taken apart once however many chunks are of it."""
    return Types(text)


def _bare(name: str) -> str:
    return name.replace("/msg/", "/")
