"""Read joint files and other YAML; every error is a ConfigError of one line."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, Final

import yaml

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.joint import Joint

_LARGEST_YAML: Final = 1_000_000
"""Bytes; ours have 3000. A log given by mistake must not keep the parser busy for minutes."""
_MOST_KEYS: Final = 100_000
"""Of all mappings together, those that were merged into others counted again."""
_SHIPPED: Final = Path(__file__).resolve().parent


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice: YAML says unique, PyYAML would silently keep the last.

    It also refuses merge keys (<<) that multiply: a few hundred bytes of them would take hours and all memory.
    """

    _merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        super().flatten_mapping(node)
        self._merged += len(node.value)
        if self._merged > _MOST_KEYS:
            raise yaml.constructor.ConstructorError(
                None, None, f"more than {_MOST_KEYS} keys by merging", node.start_mark
            )

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key_node.tag != "tag:yaml.org,2002:merge":
                if key in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key '{key}' is given twice", key_node.start_mark
                    )
                seen.add(key)
        return super().construct_mapping(node, deep)


def load_yaml(path: str | os.PathLike[str]) -> tuple[dict[str, Any], str]:
    """Return the root mapping of a YAML file and the SHA-256 of its bytes (hex). Raises ConfigError."""
    mapping, data = read_yaml(path)
    return mapping, hashlib.sha256(data).hexdigest()


def read_yaml(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bytes]:
    """Return the root mapping of a YAML file and the very bytes it was read from. Raises ConfigError."""
    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            data = file.read(_LARGEST_YAML + 1)
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read: {error.strerror or error}") from None
    if len(data) > _LARGEST_YAML:
        raise ConfigError(
            f"{name}: found more than {_LARGEST_YAML} bytes, expected a YAML file written by hand"
        )
    try:
        content = yaml.load(data, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        at = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(f"{name}:{at} not YAML: {error.problem or error.context}") from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{name}: not YAML: {reason}") from None
    if not isinstance(content, dict):
        kind = "an empty file" if content is None else type(content).__name__
        raise ConfigError(f"{name}: found {kind}, expected a mapping of keys to values")
    return content, data


def load_joint(path: str | os.PathLike[str]) -> Joint:
    """Return the joint of a joint file. Raises ConfigError naming file, key, found and expected."""
    mapping, _ = load_yaml(path)
    return Joint.from_mapping(mapping, os.fspath(path))


def shipped(name: str) -> Path:
    """Return the path of a file that ships in models/, e.g. "joint1.yaml"; ConfigError lists what ships."""
    path = (_SHIPPED / name).resolve()
    if not path.is_relative_to(_SHIPPED) or not path.is_file():
        known = sorted(p.name for p in _SHIPPED.iterdir() if p.suffix in {".yaml", ".onnx"})
        raise ConfigError(f"{name}: is not shipped with jtqd; shipped files: {', '.join(known)}")
    return path
