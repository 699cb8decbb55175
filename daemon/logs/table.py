"""Messages of a topic as a table: rows of a structured array, flat columns, a pandas DataFrame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]
"""Name -> values, all of one length."""
_LONGEST = 256


class Table(np.ndarray[Any, np.dtype[Any]]):
    """Messages of a topic: a structured array [n], one field per field of the message; one such field is a plain array."""

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        return found.view(np.ndarray) if isinstance(key, str) and found.dtype.names is None else found

    def columns(self) -> Columns:
        """Return every field as a column [n] by its path, such as `header.stamp.sec`; arrays have one for each element
        (`data[3]`), sequences of more than 256 one of texts.
        """
        return flat_columns(self)

    def to_pandas(self) -> Any:
        """Return `columns` as a pandas DataFrame. Raises ModuleNotFoundError without pandas, which jtqd does not install."""
        try:
            import pandas as pd
        except ImportError:
            raise ModuleNotFoundError("to_pandas needs pandas: pip install pandas", name="pandas") from None
        return pd.DataFrame(self.columns())


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
