"""What a loop has learned, as text, so that another loop of the same build goes on as if it were the first one.

Everything plain (numbers, text, bytes, tuples, lists, sets and mappings of them) that hangs on an object of this package
is carried, at any depth; what the other loop has built for itself (estimators, sockets, memory, precomputed layouts) is not.
A compiled class names what is carried (`carried`); its `state` is one flat block as bytes.
Lists, sets and mappings are filled in place, because others may hold them too. No pickle: JSON, whose floats are exact.

    walk = Walk(cycle)                        # finds the objects a few at a time: there is little time between two cycles
    fill = Fill(other_cycle)
    while found := walk.step(8):
        fill.learn(found)                     # paths and names of attributes
    fill.put(walk.changes(0, 8))              # values alone: of some objects, or
    fill.put(walk.changes())                  # of all; each time those that changed

Values that are no scalars travel as [kind, content].
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from operator import attrgetter, is_
from typing import Any

_SCALARS = frozenset((int, float, bool, str, type(None)))
_LONGEST = 128
"""Longer ones are tables made at the start, not something learned."""
_LONGEST_BLOCK = 4096
"""Bytes."""
_PACKAGE = "jtqd.daemon."
_CONFIGURED = "jtqd.daemon.config"
_CONFIGURED_CLASS = "JointSafety"
"""What comes from configuration and joint files is not learned."""
_SKIP = object()

Path = list[str | int]
Found = tuple[Path, list[str], list[str]]
"""An object: where it hangs, its scalar attributes, its other plain ones."""
Change = tuple[int, list[Any], list[Any]]


class CarryError(Exception):
    """What was carried does not fit the object: it comes from another version of the program."""


class Changed(Exception):  # noqa: N818 - not an error: begin another walk
    """Since the walk an object was replaced, or an attribute is of another kind."""


class _Part:
    """One object, how its attributes are read, and what has been told of them."""

    def __init__(self, thing: Any, scalars: list[str], others: list[str]) -> None:
        self.thing, self.scalars, self.others = thing, scalars, others
        self._get, self._get_others = _reader(scalars), _reader(others)
        self._told: tuple[Any, ...] = (_SKIP,) * len(scalars)
        self._told_others: list[Any] = [_SKIP] * len(others)

    def changed_scalars(self) -> list[Any]:
        """Return number and value of each changed scalar: [1, 0.5, 4, True]. Raises Changed."""
        now, told = self._get(self.thing), self._told
        if all(map(is_, now, told)):
            return []
        self._told = now
        # By identity: 0, False and -0.0 are equal and not the same.
        news: list[Any] = []
        for number, value in enumerate(now):
            if value is not told[number]:
                if type(value) not in _SCALARS:
                    raise Changed(self.scalars[number])
                news += (number, value)
        return news

    def changed_others(self) -> list[Any]:
        """Return number and content of each other changed attribute. Raises Changed."""
        news: list[Any] = []
        told = self._told_others
        for number, value in enumerate(self._get_others(self.thing)):
            if value is told[number] or (type(value) is bytes and value == told[number]):
                continue
            inside = _inside(value)
            if inside is not None and type(told[number]) is tuple and _same(inside, told[number]):
                continue
            content = _content(value)
            if content is _SKIP:
                raise Changed(self.others[number])
            news += (number, content)
            told[number] = _kept(value, inside)
        return news


class Walk:
    """Finds what there is to carry below `thing`, each object once, and reads it."""

    def __init__(self, thing: Any) -> None:
        self._todo: deque[tuple[Path, Any]] = deque([([], thing)])
        self._seen = {id(thing)}
        self._parts: list[_Part] = []
        self._links: list[tuple[Any, str, Any]] = []

    def step(self, count: int) -> list[Found]:
        """Examine at most `count` objects; do nothing when all have been examined."""
        found: list[Found] = []
        while self._todo and len(found) < count:
            path, thing = self._todo.popleft()
            scalars, others = self._look(path, thing)
            self._parts.append(_Part(thing, scalars, others))
            found.append((path, scalars, others))
        return found

    @property
    def left(self) -> bool:
        """Return whether objects remain to be examined."""
        return bool(self._todo)

    @property
    def count(self) -> int:
        """Return the number of objects found so far."""
        return len(self._parts)

    def changes(self, first: int = 0, last: int | None = None) -> list[Change]:
        """Of each object, or of those with number first to last - 1, what has not been told: its number, scalars, others.

        Raises Changed.
        """
        for thing, name, one in self._links:
            now = getattr(thing, name)
            if now is not one:
                raise Changed(name)
        result = []
        for number, part in enumerate(self._parts[first:last], start=first):
            scalars, others = part.changed_scalars(), part.changed_others()
            if scalars or others:
                result.append((number, scalars, others))
        return result

    def _look(self, path: Path, thing: Any) -> tuple[list[str], list[str]]:
        scalars, others = [], []
        for name in _attributes(thing):
            value: Any = getattr(thing, name, _SKIP)
            if type(value) in _SCALARS:
                scalars.append(name)
            elif _own(value) and not _frozen(value):
                self._links.append((thing, name, value))
                self._add([*path, name], value)
            elif type(value) in (tuple, list) and value and all(map(_own, value)):
                self._links.append((thing, name, value))
                for n, each in enumerate(value):
                    if not _frozen(each):
                        self._add([*path, name, n], each)
            elif value is not _SKIP and _content(value) is not _SKIP:
                others.append(name)
        return scalars, others

    def _add(self, path: Path, thing: Any) -> None:
        if id(thing) not in self._seen:
            self._seen.add(id(thing))
            self._todo.append((path, thing))


class Fill:
    """Puts in place below `thing` what a `Walk` has read below another one."""

    def __init__(self, thing: Any) -> None:
        self._thing = thing
        self._parts: list[_Part] = []

    def learn(self, found: list[Found]) -> None:
        """Learn the targets of the next values. Raises CarryError."""
        for path, scalars, others in found:
            thing = self._thing
            try:
                for key in path:
                    thing = thing[key] if isinstance(key, int) else getattr(thing, key)
            except (AttributeError, IndexError, TypeError):
                raise CarryError(f"there is no {'.'.join(map(str, path))}") from None
            known = _attributes(thing)
            strange = [name for name in (*scalars, *others) if name not in known]
            if strange:
                raise CarryError(f"{type(thing).__name__} has no {strange[0]}")
            self._parts.append(_Part(thing, scalars, others))

    def put(self, changes: Sequence[Change]) -> None:
        """Set the values. Raises CarryError for values of another walk."""
        if changes and changes[-1][0] >= len(self._parts):
            raise CarryError(f"found object {changes[-1][0]}, expected {len(self._parts)} of them")
        for number, scalars, others in changes:
            part = self._parts[number]
            thing, names = part.thing, part.scalars
            try:
                for n in range(0, len(scalars), 2):
                    setattr(thing, names[scalars[n]], scalars[n + 1])
                for n in range(0, len(others), 2):
                    _put(thing, part.others[others[n]], others[n + 1])
            except (IndexError, ValueError):
                raise CarryError(
                    f"values of object {number} are not those of {type(thing).__name__}"
                ) from None


def _reader(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Reads all these attributes of an object at once."""
    if len(names) > 1:
        return attrgetter(*names)
    return (lambda thing: (getattr(thing, names[0]),)) if names else (lambda thing: ())


def _inside(value: Any) -> tuple[Any, ...] | None:
    """Return what is in a list, set or mapping now; None for anything else."""
    if type(value) is dict:
        return (*value, *value.values())
    return tuple(value) if type(value) in (list, set) else None


def _same(now: tuple[Any, ...], told: tuple[Any, ...]) -> bool:
    return len(now) == len(told) and all(map(is_, now, told))


def _kept(value: Any, inside: tuple[Any, ...] | None) -> Any:
    """What to compare with next time; what may change deep inside is compared with nothing, and told each time."""
    if inside is None:
        return value if _still(value) else _SKIP
    return inside if all(map(_still, inside)) else _SKIP


def _still(value: Any) -> bool:
    """Return whether the value is immutable."""
    kind = type(value)
    if kind in (tuple, frozenset):
        return _SCALARS.issuperset(map(type, value)) or all(map(_still, value))
    return kind in _SCALARS or kind is bytes or _frozen(value)


def _own(value: Any) -> bool:
    kind = type(value)
    if not kind.__module__.startswith(_PACKAGE) or kind.__module__ == _CONFIGURED:
        return False
    return kind.__name__ != _CONFIGURED_CLASS and kind is not type


def _frozen(value: Any) -> bool:
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and bool(parameters.frozen)


def _attributes(thing: Any) -> list[str]:
    carried = getattr(thing, "carried", None)
    if carried is not None:
        return [*carried]
    slots = [name for base in type(thing).__mro__ for name in getattr(base, "__slots__", ())]
    return [name for name in (*slots, *getattr(thing, "__dict__", ())) if not name.startswith("__")]


def _content(value: Any) -> Any:  # noqa: PLR0911 - a line for each kind
    kind = type(value)
    if kind in _SCALARS:
        return value
    if kind is bytes:
        return ["b", value.hex()] if len(value) <= _LONGEST_BLOCK else _SKIP
    if kind is tuple or kind is list:
        return _plain("t" if kind is tuple else "l", value)
    if kind is set or kind is frozenset:
        return _plain("s" if kind is set else "f", value)
    if kind is dict:
        keys, values = _plain("l", value), _plain("l", value.values())
        return _SKIP if _SKIP in (keys, values) else ["d", [keys[1], values[1]]]
    if _own(value) and _frozen(value):
        return _record(value)
    return _SKIP


def _plain(kind: str, values: Any) -> Any:
    if len(values) > _LONGEST:
        return _SKIP
    if _SCALARS.issuperset(map(type, values)):
        return [kind, list(values)]
    # Objects inside are looked at nowhere: a mapping of objects is an index to what hangs elsewhere.
    contents = [_SKIP if _own(value) else _content(value) for value in values]
    return _SKIP if _SKIP in contents else [kind, contents]


def _record(value: Any) -> Any:
    contents = {field.name: getattr(value, field.name) for field in fields(value)}
    return ["r", contents] if _SCALARS.issuperset(map(type, contents.values())) else _SKIP


def _made(content: Any) -> Any:
    """Convert back to a plain value."""
    if type(content) in _SCALARS:
        return content
    kind, inner = content
    if kind == "b":
        return bytes.fromhex(inner)
    if kind == "d":
        return dict(zip(map(_made, inner[0]), map(_made, inner[1]), strict=True))
    values = map(_made, inner)
    return {"t": tuple, "l": list, "s": set, "f": frozenset}[kind](values)


def _put(thing: Any, name: str, content: Any) -> None:
    now = getattr(thing, name)
    kind = content[0] if type(content) is list else ""
    if kind == "r":
        if content[1] != {key: getattr(now, key) for key in content[1]}:
            setattr(thing, name, replace(now, **content[1]))
    elif kind == "l" and type(now) is list:
        now[:] = _made(content)
    elif kind in ("d", "s") and type(now) in (dict, set):
        now.clear()
        now.update(_made(content))
    else:
        setattr(thing, name, _made(content))
