"""`jtq export`: logs as tables (CSV, Parquet), frames as lines of candump, the bus as a DBC.

Two kinds of tables: the run table (time and, per joint, what was measured), and all fields of a topic as columns. Both are
made chunk by chunk, and written to a file that is there when it is complete, or not at all.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import io
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import LogError, LogFile
from jtqd.daemon.logs.read import (
    ERROR,
    EXTENDED,
    REMOTE,
    Logs,
    Records,
    can_topics,
    interface_of,
    iter_bus,
    iter_messages,
    iter_topics,
    log_parts,
    read_attachments,
    topics_of,
)
from jtqd.daemon.logs.table import Columns, flat_columns
from jtqd.daemon.recording.messages import JOINTS
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.files import whole_file
from jtqd.estimator.text import counted

_EXAMPLES = """examples:
  jtq export csv run.mcap --out run.csv.gz              the run table: time_s, j1.current_a, ...
  jtq export parquet LOGDIR --out run.parquet           all parts of the run in a directory
  jtq export csv run.mcap --topic /joint/1/state --out joint1.csv      every field of a topic
  jtq export csv run.mcap --start 10 --end 20 --out part.csv           seconds from the first cycle on
  jtq export candump run.mcap | cantools decode bus.dbc
  jtq export dbc run.mcap --out bus.dbc                 as attached to the log
  jtq export dbc --config arm.yaml --out bus.dbc        without a log: integers as the devices send them

exit status: 0 done, 1 failure, 2 usage"""
_DBC = "bus.dbc"


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq export`."""
    description = "Write a log as a table (CSV, Parquet), as lines of candump, or the DBC of its bus."
    result = command_parser("jtq export", description, _EXAMPLES)
    add = result.add_argument
    add("what", choices=("csv", "parquet", "candump", "dbc"))
    add("logs", nargs="*", type=Path, metavar="LOG", help="parts of one run, or their directory")
    add("--out", type=Path, metavar="FILE", help="- or, of candump and dbc, none: standard output")
    add(
        "--topic",
        metavar="TOPIC",
        help="csv, parquet: this topic's fields; candump: its frames (default: of all)",
    )
    add("--start", type=_seconds, metavar="S", help="seconds from the first message on")
    add("--end", type=_seconds, metavar="S", help="up to this time (excluded)")
    add("--all-cycles", action="store_true", help="run table: keep cycles with missing values (NaN)")
    add("--interface", help="name in candump's lines (default: as in the log, else can0)")
    add("--config", type=Path, metavar="FILE", help="dbc: of a configuration instead of a log")
    add("--json", action="store_true", help="result as JSON on standard output")
    return result


def _seconds(text: str) -> float:
    """Return seconds that log times can hold."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a time in seconds")
    return value


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    command = parser()
    options = command.parse_intermixed_args(argv)  # options may stand before the logs
    if options.out == Path("-"):
        options.out = Path("/dev/stdout")
    _check_usage(command, options)
    try:
        result = _export(options)
    except (LogError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            raise  # `| head` has gone: the caller (`jtq`) ends without a word
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            text = f"{error.filename}: {error.strerror}"
        elif isinstance(error, OSError):
            text = f"output: {error.strerror or error}"
        print(f"jtq export: {text}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(result))
    elif options.out not in (None, Path("/dev/stdout")):
        print(", ".join(f"{name} {value}" for name, value in result.items()))
    left_out = result.get("left_out", 0)
    if left_out:
        what = f"{counted(left_out, 'cycle')} with a missing value left out (--all-cycles keeps all)"
        print(f"jtq export: {what}", file=sys.stderr)
    return 0


def _check_usage(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exit with status 2 where the combination of options cannot be meant."""
    what, logs, out = options.what, options.logs, options.out
    if (what == "dbc" and options.config is not None) == bool(logs):
        command.error("expected a log or --config, and not both" if what == "dbc" else "expected a log")
    if what in ("csv", "parquet") and out is None:
        command.error("expected --out FILE")
    if out is None and options.json:
        command.error("--json needs --out FILE: standard output is used for one of them")
    if out is not None and any(_same(out, log) for log in logs):
        command.error(f"--out {out}: that is the log")
    start = max(0.0, options.start or 0.0)
    if options.end is not None and options.end <= start:
        command.error(
            f"--end: found {options.end:g}, expected a time above {start:g} s, where --start begins"
        )
    for n, one in enumerate(logs):
        if any(_same(one, other) for other in logs[:n]):
            command.error(f"found the log {one} twice, expected every part once")


def _same(one: Path, other: Path) -> bool:
    return one.exists() and other.exists() and one.samefile(other)


def _export(options: argparse.Namespace) -> dict[str, Any]:
    logs: Logs = options.logs[0] if len(options.logs) == 1 else options.logs
    out: Path | None = options.out
    if options.what == "dbc":
        return _dbc(logs, options.config, out)
    span: dict[str, int] = {}
    if (options.start, options.end) != (None, None):
        with LogFile(log_parts(logs)[0]) as log:
            times = {"start_ns": options.start, "end_ns": options.end}
            span = {key: log.start_ns + round(s * 1e9) for key, s in times.items() if s is not None}
    if options.what == "candump":
        return _candump(logs, options, span)
    assert out is not None
    write = write_csv if options.what == "csv" else write_parquet
    result: dict[str, int] = {}
    if options.topic is not None:
        _one_of(logs, sorted(topics_of(logs)), options.topic, "topic")
        size = write(out, topic_blocks(logs, options.topic, **span))
    else:
        table = RunTable(logs, all_cycles=options.all_cycles, **span)
        size = write(out, table.blocks())
        result = {"left_out": table.left_out}
    return {"path": str(out), "rows": size.rows, "columns": size.columns} | result


def _one_of(logs: Logs, there: Sequence[str], topic: str, what: str) -> None:
    """Raise LogError for a topic that is not in the log."""
    if topic not in there:
        raise LogError(
            f"{_named(logs)}: found no {what} {topic}, expected one of {', '.join(there) or 'none'}"
        )


def _named(path: Logs) -> str:
    return str(path) if isinstance(path, Path) else ", ".join(map(str, path))


def _candump(logs: Logs, options: argparse.Namespace, span: dict[str, int]) -> dict[str, Any]:
    topics = can_topics(logs)
    if options.topic is not None:
        _one_of(logs, topics, options.topic, "frames on")
        topics = [options.topic]
    frames = 0
    with nullcontext(sys.stdout.buffer) if options.out is None else _table_file(options.out) as file:
        for topic, *frame in iter_bus(logs, topics, **span):
            line = candump_line(frame, options.interface or interface_of(topic) or "can0")
            file.write(f"{line}\n".encode())
            frames += 1
    return ({} if options.out is None else {"path": str(options.out)}) | {"frames": frames}


def _dbc(logs: Logs, config: Path | None, out: Path | None) -> dict[str, Any]:
    text = _dbc_of_log(logs) if config is None else _dbc_of_configuration(config)
    if out is None:
        print(text, end="" if text.endswith("\n") else "\n")
        return {}
    with _table_file(out) as file:
        file.write(text.encode())
    return {"path": str(out), "messages": text.count("\nBO_ ")}


def _dbc_of_log(logs: Logs) -> str:
    attachments = read_attachments(logs)
    where = logs if isinstance(logs, Path) else logs[0]
    if _DBC not in attachments:
        have = ", ".join(sorted(attachments)) or "none"
        raise LogError(
            f"{where}: found attachments {have}, expected {_DBC} (--config makes one without a log)"
        )
    text = attachments[_DBC].decode("utf-8", "replace")
    if "\nBO_ " not in text:
        raise LogError(f"{where}: found no message in its {_DBC} ({len(text)} characters), expected a DBC")
    return text


def _dbc_of_configuration(path: Path) -> str:
    from jtqd.daemon.config import load_config
    from jtqd.daemon.recording.dbc import dbc_text

    try:
        return dbc_text(load_config(path), None)
    except ValueError as error:
        raise LogError(str(error)) from None


def candump_line(frame: Sequence[Any], interface: str) -> str:
    """Return a frame (stamp [ns], identifier, length, data) as `candump -L` does: `(1700000000.000000) can0 181#0011`."""
    stamp_ns, can_id, length, data = frame
    seconds, micros = divmod((stamp_ns + 500) // 1000, 1_000_000)
    number = f"{can_id & 0x3FFFFFFF:08X}" if can_id & (EXTENDED | ERROR) else f"{can_id & 0x7FF:03X}"
    content = f"R{length or ''}" if can_id & REMOTE else data.hex().upper()
    return f"({seconds}.{micros:06d}) {interface} {number}#{content}"


# ---- tables ----


RUN_FIELDS = {
    "current_a": "current_a",
    "motor_position_rad": "motor_position_rad",
    "motor_velocity_rad_s": "motor_velocity_rad_s",
    "link_position_rad": "link_position_rad",
    "torque_nm": "sensor_torque_nm",
    "temperature_c": "temperature_c",
}
"""Column of a joint in a run table -> field of its message. What a run calls torque is measured."""
_ESTIMATE = {"estimate_nm": "torque_nm", "sigma_nm": "sigma_nm", "status": "status"}
"""Further columns, which no reader of runs needs and no cycle must have."""
_FIELDS = RUN_FIELDS | _ESTIMATE
_ROW = np.dtype(
    [
        *(("cycle", "<u8"), ("sync_monotonic_ns", "<i8")),
        *((field, "u1" if field == "status" else "<f8") for field in _FIELDS.values()),
    ]
)


class RunTable:
    """Run table of a log: `time_s` from its first row on, `j1.current_a` and so on. The log is read twice, chunk by chunk.

    A column without any value is left out, and so is a cycle in which a measured one is missing. Before the first frame of
    a temperature its value holds.

    Args:
        path: as for `jtqd.daemon.logs.read_topics`.
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
        path: Logs,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        all_cycles: bool = False,
    ) -> None:
        self.cycles = self.left_out = 0
        self._path, self._all = path, all_cycles
        self._span: dict[str, Any] = {"start_ns": start_ns, "end_ns": end_ns}
        names = topics_of(path)
        self._topics = {
            n: each.name for n, each in enumerate(JOINTS, start=1) if n == 1 or each.name in names
        }
        wanted = {f"j{n}.{column}": (n, field) for n in self._topics for column, field in _FIELDS.items()}
        found: dict[str, float] = {}
        count = 0
        for rows in self._rows():
            count += len(rows[1])
            for name, (n, field) in wanted.items():
                if name not in found and len(there := np.flatnonzero(np.isfinite(rows[n][field]))):
                    found[name] = float(rows[n][field][there[0]])
            if len(found) == len(wanted):
                break
        if not count:
            when = _when(self._span)
            raise LogError(f"{_named(path)}: found no cycle of the joints{when}, expected one at least")
        if all(wanted[name][1] in _ESTIMATE.values() for name in found):
            raise LogError(f"{_named(path)}: found no measured value in {counted(count, 'cycle')}")
        self._wanted = {name: where for name, where in wanted.items() if name in found}
        self.columns = tuple(self._wanted)
        self._first = {name: value for name, value in found.items() if name.endswith("temperature_c")}

    def blocks(self) -> Iterator[Columns]:
        """Yield the table, some rows at a time."""
        self.cycles = self.left_out = 0
        first: int | None = None
        held = {} if self._all else dict(self._first)
        for rows in self._rows():
            columns = {name: rows[n][field] for name, (n, field) in self._wanted.items()}
            for name, value in list(held.items()):
                known = np.cumsum(np.isfinite(columns[name])) > 0
                columns[name] = np.where(known, columns[name], value)
                if known[-1]:
                    del held[name]
            there = np.ones(len(rows[1]), np.bool_)
            for name in () if self._all else self._wanted:
                if self._wanted[name][1] not in _ESTIMATE.values():
                    there &= np.isfinite(columns[name])
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
                f"{_named(self._path)}: found {counted(kept, 'cycle')} with every column, expected at least 2 "
                "(--all-cycles keeps all)"
            )

    def _rows(self) -> Iterator[dict[int, Records]]:
        """Yield rows (`_ROW`) of all joints, of the same cycles."""
        rest = {number: np.empty(0, _ROW) for number in self._topics}
        topics = tuple(self._topics.values())
        for found in iter_topics(self._path, topics, **self._span):
            for number, topic in self._topics.items():
                if topic in found:
                    rest[number] = np.concatenate([rest[number], _picked(found[topic].records, topic)])
            count = min(map(len, rest.values()))
            whole = {number: rows[:count] for number, rows in rest.items()}
            self._same_cycles(*whole.values())
            rest = {number: rows[count:] for number, rows in rest.items()}
            if count:
                yield whole
        self._same_cycles(*rest.values())

    def _same_cycles(self, first: Records, *others: Records) -> None:
        if not all(np.array_equal(first["cycle"], each["cycle"]) for each in others):
            raise LogError(
                f"{_named(self._path)}: found cycles of one joint that another does not have, expected the same"
            )


def _when(span: Mapping[str, int | None]) -> str:
    return " in that time" if any(bound is not None for bound in span.values()) else ""


def _picked(records: Records, topic: str) -> Records:
    rows = np.empty(len(records), _ROW)
    for name in _ROW.names or ():
        if name not in (records.dtype.names or ()):
            raise LogError(f"{topic}: found no field {name}, expected jtqd_msgs/JointEstimate")
        rows[name] = records[name]
    return rows


def topic_blocks(
    path: Logs, topic: str, *, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Columns]:
    """Yield all fields of a topic as columns, chunk by chunk: `log_time_ns`, then every field by its path.

    The columns are those of `Table.columns`, blank where a sequence of a message has fewer elements.
    """
    kinds: dict[str, list[np.dtype[Any]]] = {}
    blocks = 0
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        if messages.records.dtype != object:  # a schema with fixed rows has no sequence
            break
        blocks += 1
        for name, values in flat_columns(messages.records).items():
            kinds.setdefault(name, []).append(values.dtype)
    absent = [np.dtype(float)]
    kind = {name: np.result_type(*each, *absent * (len(each) < blocks)) for name, each in kinds.items()}
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        columns = flat_columns(messages.records)
        for name, each in kind.items():
            if name not in columns:
                columns[name] = np.full(len(messages.records), "" if each.kind == "O" else np.nan, each)
            columns[name] = columns[name].astype(each, copy=False)
        yield {"log_time_ns": messages.log_times, **{name: columns[name] for name in kind or columns}}


# ---- files ----


_ROWS, _GROUP_ROWS = 20_000, 60_000


class TableSize(NamedTuple):
    """Of a table that was written."""

    rows: int
    columns: int


@contextmanager
def _table_file(path: Path) -> Iterator[IO[bytes]]:
    """Open an output as `whole_file` does, packed where its name ends in .gz."""
    with whole_file(path) as plain:
        if path.suffix != ".gz":
            yield plain
            return
        # Without name and time: equal content makes equal files.
        with gzip.GzipFile("", "wb", 6, plain, mtime=0) as packed:
            yield packed  # type: ignore[misc]


def write_csv(path: Path, blocks: Iterable[Columns]) -> TableSize:
    """Write a table: numbers as the shortest text that reads back the same, NaN as an empty cell. Raises OSError."""
    rows = 0
    names: tuple[str, ...] = ()
    with _table_file(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=False)
        writer = csv.writer(text, lineterminator="\n")
        try:
            for block in blocks:
                if not names:
                    names = tuple(block)
                    writer.writerow(names)
                rows += _length(block)
                for begin in range(0, _length(block), _ROWS):
                    parts = [_cells(values[begin : begin + _ROWS]) for values in block.values()]
                    writer.writerows(zip(*parts, strict=True))
            text.flush()
        finally:
            text.detach()
    return TableSize(rows, len(names))


def _cells(values: NDArray[Any]) -> list[Any]:
    cells: list[Any] = values.tolist()
    if values.dtype.kind == "f" and np.isnan(values).any():
        return ["" if value != value else value for value in cells]  # noqa: PLR0124
    return cells


def write_parquet(path: Path, blocks: Iterable[Columns]) -> TableSize:
    """Write a table: columns with their types, packed by zstd. Raises LogError where pyarrow is not installed, OSError."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise LogError("found no pyarrow, expected it for Parquet: pip install 'jtqd[parquet]'") from None
    rows, columns, writer = 0, 0, None
    with _table_file(path) as file:
        try:
            for block in _gathered(blocks):
                table = pa.table({name: pa.array(np.ascontiguousarray(v)) for name, v in block.items()})
                writer = writer or parquet.ParquetWriter(file, table.schema, compression="zstd")
                writer.write_table(table.cast(writer.schema))
                rows, columns = rows + _length(block), len(block)
        finally:
            if writer is not None:
                writer.close()
    return TableSize(rows, columns)


def _gathered(blocks: Iterable[Columns]) -> Iterator[Columns]:
    """Yield blocks of at least `_GROUP_ROWS`, but for the last: Parquet packs each on its own."""
    kept: list[Columns] = []
    for block in blocks:
        kept.append(block)
        if sum(map(_length, kept)) >= _GROUP_ROWS:
            yield _joined(kept)
            kept = []
    if kept:
        yield _joined(kept)


def _joined(blocks: list[Columns]) -> Columns:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _length(block: Columns) -> int:
    return len(next(iter(block.values())))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
