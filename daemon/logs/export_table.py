"""Tables out of logs: the run table (time and, per joint, what was measured), and all fields of a topic as columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.reader import Messages, iter_messages, iter_topics, read_messages
from jtqd.daemon.logs.rows import Records

Columns = dict[str, NDArray[Any]]
"""Name -> values, all of one length."""

RUN_FIELDS = {
    "current_a": "current_a",
    "motor_position_rad": "motor_position_rad",
    "motor_velocity_rad_s": "motor_velocity_rad_s",
    "link_position_rad": "link_position_rad",
    "torque_nm": "sensor_torque_nm",
    "temperature_c": "temperature_c",
}
"""Column of a joint in a run table -> field of its message. What a run calls torque is measured."""
_JOINT_TOPICS = {1: "/joint/1/state", 2: "/joint/2/state"}
_ROW = np.dtype(
    [("cycle", "<u8"), ("sync_monotonic_ns", "<i8"), *((field, "<f8") for field in RUN_FIELDS.values())]
)


class ColumnsChangedError(Exception):
    """A later chunk has other columns than the first: the table is to be made in one piece (`topic_table`)."""


class RunTable:
    """Run table of a log: `time_s` from its first row on, `j1.current_a` and so on. The log is read twice, chunk by chunk.

    A column without any value is left out, and so is a cycle in which one of the others is missing.

    Args:
        path: as for `jtqd.daemon.logs.reader.read_topics`.
        start_ns, end_ns: log times.
        all_cycles: keep every cycle; what is missing is NaN.

    Attributes:
        columns: names without `time_s`.
        cycles, left_out: counted as far as `blocks` has been read.

    Raises:
        LogError: no cycles, or joints whose cycles do not belong together; also by `blocks`.
        OSError: a file cannot be read.
    """

    def __init__(
        self,
        path: Path | Sequence[Path],
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        all_cycles: bool = False,
    ) -> None:
        self.cycles = self.left_out = 0
        self._path, self._span, self._all = path, {"start_ns": start_ns, "end_ns": end_ns}, all_cycles
        wanted = {f"j{n}.{column}": (n, field) for n in _JOINT_TOPICS for column, field in RUN_FIELDS.items()}
        found: set[str] = set()
        count = 0
        for rows in self._rows():
            count += len(rows[1])
            found |= {
                name
                for name, (n, field) in wanted.items()
                if name not in found and np.isfinite(rows[n][field]).any()
            }
            if len(found) == len(wanted):
                break
        if not count:
            raise LogError(f"{path}: found no cycle of the joints in that time, expected one at least")
        if not found:
            raise LogError(f"{path}: found no measured value in {count} cycles")
        self._wanted = {name: where for name, where in wanted.items() if name in found}
        self.columns = tuple(self._wanted)

    def blocks(self) -> Iterator[Columns]:
        """The table, some rows at a time."""
        self.cycles = self.left_out = 0
        first: int | None = None
        for rows in self._rows():
            columns = {name: rows[n][field] for name, (n, field) in self._wanted.items()}
            there = np.ones(len(rows[1]), np.bool_)
            for values in () if self._all else columns.values():
                there &= np.isfinite(values)
            self.cycles += len(there)
            self.left_out += int(np.count_nonzero(~there))
            stamps = rows[1]["sync_monotonic_ns"][there]
            if len(stamps):
                first = int(stamps[0]) if first is None else first
                yield {
                    "time_s": (stamps - first) * 1e-9,
                    **{name: values[there] for name, values in columns.items()},
                }
        kept = self.cycles - self.left_out
        if kept < 2:
            raise LogError(
                f"{self._path}: found {kept} cycles with every column, expected at least 2 (--all-cycles keeps all)"
            )

    def _rows(self) -> Iterator[dict[int, Records]]:
        """Rows (`_ROW`) of both joints, of the same cycles."""
        rest = {number: np.empty(0, _ROW) for number in _JOINT_TOPICS}
        for found in iter_topics(self._path, tuple(_JOINT_TOPICS.values()), **self._span):
            for number, topic in _JOINT_TOPICS.items():
                if topic in found:
                    rest[number] = np.concatenate([rest[number], _picked(found[topic].records, topic)])
            count = min(map(len, rest.values()))
            whole = {number: rows[:count] for number, rows in rest.items()}
            self._same_cycles(*whole.values())
            rest = {number: rows[count:] for number, rows in rest.items()}
            if count:
                yield whole
        self._same_cycles(*rest.values())

    def _same_cycles(self, one: Records, two: Records) -> None:
        if not np.array_equal(one["cycle"], two["cycle"]):
            raise LogError(
                f"{self._path}: found cycles of one joint that the other does not have, expected the same"
            )


def _picked(records: Records, topic: str) -> Records:
    rows = np.empty(len(records), _ROW)
    for name in _ROW.names or ():
        if name not in (records.dtype.names or ()):
            raise LogError(f"{topic}: found no field {name}, expected jtqd_msgs/JointEstimate")
        rows[name] = records[name]
    return rows


def topic_blocks(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Columns]:
    """All fields of a topic as columns, chunk by chunk; see `topic_table`. Raises ColumnsChangedError as well."""
    first: Columns | None = None
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        columns = _columns(messages)
        first = first or columns
        if columns.keys() != first.keys() or any(columns[name].dtype != first[name].dtype for name in first):
            raise ColumnsChangedError
        yield columns
    if first is None:
        raise LogError(f"{path}: found no message on {topic} in that time, expected one at least")


def topic_table(
    path: Path | Sequence[Path], topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Columns:
    """All fields of a topic as columns: `log_time_ns`, then every number and text by its path (`header.stamp.sec`).

    Fixed arrays have one column for each element (`data[3]`). A sequence is one column of its values as text.
    """
    return _columns(read_messages(path, (topic,), start_ns=start_ns, end_ns=end_ns)[topic])


def _columns(messages: Messages) -> Columns:
    columns: Columns = {"log_time_ns": messages.log_times}
    _flatten("", messages.records, columns)
    return columns


def _flatten(prefix: str, values: Records | NDArray[Any], columns: Columns) -> None:
    kind = values.dtype
    if kind.names is not None:
        for name in kind.names:
            _flatten(f"{prefix}.{name}" if prefix else name, values[name], columns)
    elif values.ndim > 1:
        for n in range(values.shape[1]):
            _flatten(f"{prefix}[{n}]", values[:, n], columns)
    elif kind.kind == "S":
        columns[prefix] = np.array([each.decode("utf-8", "replace") for each in values.tolist()], object)
    elif kind.kind == "O":
        columns[prefix] = np.array([_as_text(each) for each in values.tolist()], object)
    else:
        columns[prefix] = values


def _as_text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return " ".join(map(_as_text, value)) if isinstance(value, list) else _of_mapping(value)


def _of_mapping(value: Any) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{name}={_as_text(each)}" for name, each in value.items())
    return repr(value) if isinstance(value, float) else str(value)
