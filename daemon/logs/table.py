"""Messages of a topic as flat columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]
"""Name -> values, all of one length."""
_LONGEST = 256


def flat_columns(records: NDArray[Any]) -> Columns:
    """Return the fields of messages as columns."""
    columns: Columns = {}
    if records.dtype == object:
        _flatten_objects("", records.tolist(), columns)
    else:
        _flatten("", records, columns)
    return columns


def _flatten(prefix: str, values: NDArray[Any], columns: Columns) -> None:
    """Put the fields below `prefix` into columns."""
    kind = values.dtype
    if kind.names is not None:
        for name in kind.names:
            _flatten(f"{prefix}.{name}".lstrip("."), values[name], columns)
    elif values.ndim > 1:
        for n in range(values.shape[1]):
            _flatten(f"{prefix}[{n}]", values[:, n], columns)
    elif kind.kind == "S":
        columns[prefix] = np.array([each.decode("utf-8", "replace") for each in values.tolist()], object)
    else:
        columns[prefix] = values


def _flatten_objects(prefix: str, values: list[Any], columns: Columns) -> None:
    """Put the attributes of the decoder's objects into columns as `_flatten` does; None: an element that is not there."""
    one: Any = next((each for each in values if each is not None), None)
    if hasattr(one, "__slots__"):
        for name in one.__slots__:
            inner = [getattr(each, name, None) for each in values]
            _flatten_objects(f"{prefix}.{name}".lstrip("."), inner, columns)
    elif isinstance(one, Sequence) and not isinstance(one, str):
        rows: list[Any] = [() if each is None else each for each in values]
        longest = max(map(len, rows))
        element: Any = next((row[0] for row in rows if len(row)), None)
        if hasattr(element, "__slots__"):
            for name in element.__slots__:
                inner = [[getattr(each, name) for each in row] for row in rows]
                _flatten_objects(f"{prefix}.{name}", inner, columns)
        elif longest > _LONGEST:
            columns[prefix] = np.array([" ".join(map(str, row)) for row in rows], object)
        else:
            for n in range(longest):
                inner = [row[n] if n < len(row) else None for row in rows]
                _flatten_objects(f"{prefix}[{n}]", inner, columns)
    elif isinstance(one, int | float):
        columns[prefix] = np.array([math.nan if each is None else each for each in values])
    else:
        columns[prefix] = np.array(["" if each is None else str(each) for each in values], object)
