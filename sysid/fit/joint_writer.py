"""Write joint files: every section the joint has, and the runs from which each fitted section comes.

A file is put in place only where its text reads back as the same joint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.estimator.joint import Joint
from jtqd.models.files import parse_yaml

_UNITS: Final = (
    "SI units. Friction, stiffness, damping and link inertia are joint side; torque constant and rotor inertia are "
    "motor side."
)


class _Row(dict[str, Any]):
    """A mapping that is written as {key: value, ...}."""


class _Numbers(list[Any]):
    """A list that is written as [1.0, 2.0, ...]."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper with indented lists; rows and lists of numbers on one line."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


_MAP, _SEQUENCE = "tag:yaml.org,2002:map", "tag:yaml.org,2002:seq"
_Dumper.add_representer(_Row, lambda dumper, row: dumper.represent_mapping(_MAP, row, flow_style=True))
_Dumper.add_representer(
    _Numbers, lambda dumper, row: dumper.represent_sequence(_SEQUENCE, row, flow_style=True)
)


def with_fit(
    joint: Joint,
    section: str,
    *,
    by: str,
    runs: Mapping[str, str],
    date: str,
    temperature_c: float = math.nan,
    notes: Mapping[str, Any] | None = None,
) -> Joint:
    """Return the joint with the origin of `section` (e.g. "efficiency") in its provenance; the rest of it stays.

    by: the command; runs: name of every run and the SHA-256 of its file; date: ISO 8601; temperature_c: mean over what
    was fitted, left out when NaN; notes: further plain values.
    """
    record: dict[str, Any] = {"by": by, "date": date}
    if math.isfinite(temperature_c):
        record["temperature_c"] = round(temperature_c, 1)
    record |= dict(notes or {})
    record["sha256"] = dict(runs)
    return replace(joint, provenance={**joint.provenance, section: record})


def joint_text(joint: Joint, title: str) -> str:
    """Return the joint file as text; `title` is its first line, a comment."""
    blocks = [f"# {' '.join(title.split())}\n# {_UNITS}\n"]
    simple: dict[str, Any] = {}
    for key, value in joint.to_mapping().items():
        if isinstance(value, dict | list):
            blocks += [_dump(simple)] if simple else []
            simple = {}
            blocks.append(_dump({key: value if key == "provenance" else _short(value)}))
        else:
            simple[key] = value
    blocks += [_dump(simple)] if simple else []
    return blocks[0] + "\n".join(blocks[1:])


def write_joint(path: Path | str, joint: Joint, title: str) -> None:
    """Write a joint file, whole or not at all.

    Raises:
        ConfigError: it cannot be written, or what was written does not read back as this joint.
    """
    path, data = Path(path), joint_text(joint, title).encode()
    if Joint.from_mapping(parse_yaml(data, str(path)), str(path), elastic=False) != joint:
        raise ConfigError(f"{path}: the written file reads back differently from the joint {joint.name}")
    try:
        write_whole(path, data)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from None


def _short(value: Any) -> Any:
    """A section with what is below it laid out: lists of numbers, and mappings of numbers below the first level."""
    if isinstance(value, list):
        return _Numbers(value) if all(map(_number, value)) else [_short(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: _Row(item) if isinstance(item, dict) and all(map(_number, item.values())) else _short(item)
        for key, item in value.items()
    }


def _number(value: Any) -> bool:
    return isinstance(value, int | float)


def _dump(mapping: Mapping[str, Any]) -> str:
    return yaml.dump(dict(mapping), Dumper=_Dumper, sort_keys=False, width=160, allow_unicode=True)
