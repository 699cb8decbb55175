"""Read joint files and other YAML; every error is a ConfigError of one line."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import read_regular
from jtqd.estimator.joint import Joint

_LARGEST_YAML: Final = 250_000
"""Bytes; ours have 3000. A log given by mistake must not keep the parser busy for minutes."""
_MOST_VALUES: Final = 10_000
"""Keys and values; the largest of ours has 813. PyYAML takes some 0.1 ms for each."""
_DEEPEST: Final = 50
_LONGEST_NUMBER: Final = 100
"""Characters: the conversion of a longer one takes time that grows as the square."""
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_MOST_MERGED: Final = 100_000
"""Keys taken over by merging (<<), those that were merged before counted again."""
_MERGE_TAG: Final = "tag:yaml.org,2002:merge"
_NUMBERS: Final = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_SHIPPED: Final = Path(__file__).resolve().parent


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice: YAML requires unique keys, PyYAML would silently keep the last.

    Merge keys (<<) are resolved here: which of two merged values holds is not the same in all versions of PyYAML.
    """

    _merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Put merged keys before the mapping's own: own keys hold, then the first of a list (yaml.org/type/merge)."""
        merges = [value for key, value in node.value if key.tag == _MERGE_TAG]
        if not merges:
            return
        own = [pair for pair in node.value if pair[0].tag != _MERGE_TAG]
        node.value = own  # first, so that a mapping that merges itself ends
        known = {_identity(key) for key, _ in own}
        merged = []
        for source in _sources(merges):
            self.flatten_mapping(source)
            self._merged += len(source.value)
            if self._merged > _MOST_MERGED:
                raise yaml.constructor.ConstructorError(
                    None, None, f"more than {_MOST_MERGED} keys by merging", node.start_mark
                )
            for pair in source.value:
                if (identity := _identity(pair[0])) not in known:
                    known.add(identity)
                    merged.append(pair)
        node.value = merged + own

    _values = _depth = 0

    def __init__(self, stream: bytes) -> None:
        super().__init__(stream)
        self._sizes: dict[int, int] = {}
        """Keys and values of each node; what an alias repeats is counted again."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose the next value: not one too many or too deep, no number without end, no half of a surrogate pair."""
        self._values += 1
        self._depth += 1
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        _refuse(self._values > _MOST_VALUES, f"more than {_MOST_VALUES} keys and values", mark)
        _refuse(self._depth > _DEEPEST, f"values nested more than {_DEEPEST} deep", mark)
        before, again = self._values, self.check_event(yaml.AliasEvent)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode):
            half = _SURROGATE.search(node.value) is not None
            _refuse(half, "half of a surrogate pair, expected a character", mark)
            long = node.tag in _NUMBERS and len(node.value) > _LONGEST_NUMBER
            _refuse(
                long, f"a number of {len(node.value)} characters, expected at most {_LONGEST_NUMBER}", mark
            )
        if again:
            self._values += self._sizes.get(id(node), 0)  # 0: inside of itself
        else:
            self._sizes[id(node)] = self._values - before
        return node

    def fetch_flow_collection_start(self, token: Any) -> None:
        """Begin a list or mapping in brackets: refused here, because the scanner reads a thousand brackets ahead."""
        _refuse(self.flow_level >= _DEEPEST, f"brackets nested more than {_DEEPEST} deep", self.get_mark())
        super().fetch_flow_collection_start(token)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str):
                if key in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key '{key}' is given twice", key_node.start_mark
                    )
                seen.add(key)
        return super().construct_mapping(node, deep)


def _refuse(wrong: bool, what: str, mark: Any) -> None:
    """Raise the error for what was found at a mark, where it is wrong."""
    if wrong:
        raise yaml.MarkedYAMLError(None, None, f"found {what}", mark)


def _sources(merges: list[yaml.Node]) -> Iterator[yaml.MappingNode]:
    """Yield the mappings that merge keys name, the one that holds first."""
    for merge in merges:
        for source in merge.value if isinstance(merge, yaml.SequenceNode) else [merge]:
            if not isinstance(source, yaml.MappingNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "expected the mapping that << merges", source.start_mark
                )
            yield source


def _identity(key: yaml.Node) -> tuple[str, str | int]:
    """What makes two keys the same: kind and text, or the place of a key that is no scalar."""
    return (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else (key.tag, id(key))


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the root mapping of a YAML file. Raises ConfigError."""
    return read_yaml(path)[0]


def read_yaml(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bytes]:
    """Return the root mapping of a YAML file and the very bytes it was read from. Raises ConfigError."""
    data = read_regular(path, _LARGEST_YAML, "a YAML file written by hand")
    return parse_yaml(data, os.fspath(path)), data


def parse_yaml(data: bytes, name: str) -> dict[str, Any]:
    """Return the root mapping of a YAML text; `name` is the file's, for messages. Raises ConfigError."""
    if len(data) > _LARGEST_YAML:
        raise ConfigError(f"{name}: found {len(data)} bytes, expected a YAML file written by hand")
    try:
        content = yaml.load(data, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{name}:{_marked(error)}") from None
    except yaml.reader.ReaderError as error:
        raise ConfigError(
            f"{name}: not YAML: found {error.character:02X}h at offset {error.position}, expected a text file"
        ) from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError, LookupError, AttributeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{name}: not YAML: {reason}") from None
    if not isinstance(content, dict):
        kind = "an empty file" if content is None else type(content).__name__
        raise ConfigError(f"{name}: found {kind}, expected a mapping of keys to values")
    return content


_PLAIN: Final = (
    ("but got '<stream end>'", "found the end of the file"),
    ("but found '<stream end>'", "found the end of the file"),
    ("found unexpected end of stream", "found the end of the file"),
    ("but got ", "found "),
    ("but found ", "found "),
    ("'<block end>'", "a line that is indented less"),
    ("<block end>", "a line that is indented less"),
    ("'<block mapping start>'", "a line that is indented more"),
    ("'<block sequence start>'", "a list"),
    ("'<document start>'", "a second document ('---')"),
    ("<document start>", "a new document"),
    ("'<scalar>'", "a text"),
    ("found '?'", "found a key"),
    ("character '\\t' that cannot start any token", "a tab, expected spaces"),
    ("that cannot start any token", "that must stand in quotes"),
    (
        "mapping values are not allowed here",
        "found ': ', expected one key in a line, indented like its neighbours",
    ),
    ("could not determine a constructor for the tag", "found the tag"),
    ("could not find expected ':'", "found no ': ' behind a key"),
    ("a flow sequence", "a list in [ ]"),
    ("a flow mapping", "a mapping in { }"),
    ("a block mapping", "a mapping"),
    ("a block collection", "a list"),
    ("a quoted scalar", "a text in quotes"),
    ("a simple key", "a key"),
)
"""Words of PyYAML's scanner -> words of this project, in the order in which they are replaced."""


def _marked(error: yaml.MarkedYAMLError) -> str:
    """Return place and problem of an error, in words of people who write YAML."""
    mark, begin = error.problem_mark, error.context_mark
    at = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
    text = error.problem or error.context or "cannot be read"
    if error.problem and error.context and begin and begin.line != (mark.line if mark else -1):
        text += f" ({error.context} that begins in line {begin.line + 1})"
    for theirs, ours in _PLAIN:
        text = text.replace(theirs, ours)
    return f"{at} not YAML: {' '.join(text.split())}"


def load_joint(path: str | os.PathLike[str], *, elastic: bool = True) -> Joint:
    """Return the joint of a joint file. Raises ConfigError naming file, key, found and expected; all missing keys at once.

    elastic: stiffness, damping and link inertia must be there.
    """
    mapping = load_yaml(path)
    return Joint.from_mapping(mapping, os.fspath(path), elastic=elastic)


def shipped(name: str) -> Path:
    """Return the path of a file that ships in models/, e.g. "joint1.yaml"; ConfigError lists what ships."""
    path = (_SHIPPED / name).resolve()
    if not path.is_relative_to(_SHIPPED) or not path.is_file():
        known = sorted(p.name for p in _SHIPPED.iterdir() if p.suffix in {".yaml", ".onnx"})
        raise ConfigError(f"{name}: is not shipped with jtqd; shipped files: {', '.join(known)}")
    return path
