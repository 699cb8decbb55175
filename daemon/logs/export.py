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
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.daemon.logs.log_file import LogError, LogFile
from jtqd.daemon.logs.read import (
    ERROR,
    EXTENDED,
    REMOTE,
    Frames,
    Records,
    can_topics,
    iter_frames,
    iter_messages,
    iter_topics,
    log_parts,
    read_attachments,
    topics_of,
)
from jtqd.daemon.recording.messages import JOINTS

_EXAMPLES = """examples:
  jtq export csv run.mcap --out run.csv.gz              the run table: time_s, j1.current_a, ...
  jtq export parquet LOGDIR --out run.parquet           all parts of the run in a directory
  jtq export csv run.mcap --topic /joint/1/state --out joint1.csv      every field of a topic
  jtq export csv run.mcap --start 10 --end 20 --out part.csv           seconds from the first cycle on
  jtq export candump run.mcap | cantools decode bus.dbc
  jtq export dbc run.mcap --out bus.dbc                 as attached to the log
  jtq export dbc --config arm.yaml --out bus.dbc        without a log: integers as the devices send them

exit status: 0 done, 1 failure, 2 usage, 3 done, but cycles with missing values were left out"""
_DBC = "bus.dbc"


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq export`."""
    result = argparse.ArgumentParser(
        prog="jtq export",
        description="Write a log as a table (CSV, Parquet), as lines of candump, or the DBC of its bus.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("what", choices=("csv", "parquet", "candump", "dbc"))
    result.add_argument(
        "logs", nargs="*", type=Path, metavar="LOG", help="parts of one run, or their directory"
    )
    result.add_argument(
        "--out", type=Path, metavar="FILE", help="default: standard output (candump and dbc only)"
    )
    result.add_argument(
        "--topic", metavar="TOPIC", help="csv, parquet: this topic's fields; candump: its frames"
    )
    result.add_argument("--start", type=_seconds, metavar="S", help="seconds from the first message on")
    result.add_argument("--end", type=_seconds, metavar="S", help="up to this time (excluded)")
    result.add_argument(
        "--all-cycles", action="store_true", help="run table: keep cycles with missing values (NaN)"
    )
    result.add_argument("--interface", default="can0", help="name in candump's lines (default can0)")
    result.add_argument(
        "--config", type=Path, metavar="FILE", help="dbc: of a configuration instead of a log"
    )
    result.add_argument("--json", action="store_true", help="result as JSON on standard output")
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
    elif options.out is not None:
        print(", ".join(f"{name} {value}" for name, value in result.items()))
    left_out = result.get("left_out", 0)
    if left_out:
        print(
            f"jtq export: {left_out} {_cycles(left_out)} with a missing value left out (--all-cycles keeps all)",
            file=sys.stderr,
        )
    return 3 if left_out else 0


def _check_usage(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exit with status 2 where the combination of options cannot be meant."""
    of_config = options.what == "dbc" and options.config is not None
    if of_config == bool(options.logs):
        command.error("expected a log" + (" or --config" if options.what == "dbc" else "") + ", and not both")
    if options.what in ("csv", "parquet") and options.out is None:
        command.error("expected --out FILE")
    if options.out is None and options.json:
        command.error("--json needs --out FILE: standard output is used for one of them")
    if options.out is not None and any(_same(options.out, log) for log in options.logs):
        command.error(f"--out {options.out}: that is the log")
    start = max(0.0, options.start or 0.0)
    if options.end is not None and options.end <= start:
        command.error(
            f"--end: found {options.end:g}, expected a time above {start:g} s, where --start begins"
        )
    twice = next(
        (one for n, one in enumerate(options.logs) for other in options.logs[:n] if _same(one, other)), None
    )
    if twice is not None:
        command.error(f"found the log {twice} twice, expected every part once")


def _same(out: Path, log: Path) -> bool:
    return out.exists() and log.exists() and out.samefile(log)


def _export(options: argparse.Namespace) -> dict[str, Any]:
    if options.what == "dbc":
        return _dbc(options.logs, options.config, options.out)
    logs = options.logs[0] if len(options.logs) == 1 else options.logs
    span = _span(logs, options.start, options.end)
    if options.what == "candump":
        return _candump(logs, options, span)
    write = write_csv if options.what == "csv" else write_parquet
    result: dict[str, int] = {}
    if options.topic is not None:
        _require_topic(logs, options.topic)
        size = write(options.out, topic_blocks(logs, options.topic, **span))
    else:
        table = RunTable(logs, all_cycles=options.all_cycles, **span)
        size = write(options.out, table.blocks())
        result = {"left_out": table.left_out}
    return {"path": str(options.out), "rows": size.rows, "columns": size.columns} | result


def _require_topic(logs: Path | Sequence[Path], topic: str) -> None:
    """Raise LogError for a topic that is not in the log."""
    topics = topics_of(logs)
    if topic not in topics:
        raise LogError(
            f"{_named(logs)}: found no topic {topic}, expected one of {', '.join(sorted(topics)) or 'none'}"
        )


def _named(path: Path | Sequence[Path]) -> str:
    return str(path) if isinstance(path, Path) else ", ".join(map(str, path))


def _span(logs: Path | Sequence[Path], start: float | None, end: float | None) -> dict[str, int | None]:
    """Log times of a span given in seconds from the first message on."""
    if start is None and end is None:
        return {}
    with LogFile(log_parts(logs)[0]) as log:
        first = log.start_ns
    return {
        "start_ns": None if start is None else first + round(start * 1e9),
        "end_ns": None if end is None else first + round(end * 1e9),
    }


def _candump(
    logs: Path | Sequence[Path], options: argparse.Namespace, span: dict[str, int | None]
) -> dict[str, Any]:
    topics = can_topics(logs)
    topic = options.topic or topics[0]
    if topic not in topics:
        raise LogError(f"{_named(logs)}: found no frames on {topic}, expected one of {', '.join(topics)}")
    frames = 0
    if options.out is None:
        for part in iter_frames(logs, topic, **span):
            sys.stdout.writelines(line + "\n" for line in candump_lines(part, options.interface))
            frames += len(part.ids)
        return {"frames": frames}
    with whole_file(options.out) as file:
        for part in iter_frames(logs, topic, **span):
            file.write("".join(line + "\n" for line in candump_lines(part, options.interface)).encode())
            frames += len(part.ids)
    return {"path": str(options.out), "frames": frames}


def _dbc(logs: Sequence[Path], config: Path | None, out: Path | None) -> dict[str, Any]:
    if config is not None:
        text = _dbc_of_configuration(config)
    else:
        attachments = read_attachments(list(logs) if len(logs) > 1 else logs[0])
        if _DBC not in attachments:
            have = ", ".join(sorted(attachments)) or "none"
            raise LogError(
                f"{logs[0]}: found attachments {have}, expected {_DBC} (--config makes one without a log)"
            )
        text = attachments[_DBC].decode("utf-8", "replace")
        if "\nBO_ " not in text:
            raise LogError(
                f"{logs[0]}: found no message in its {_DBC} ({len(text)} characters), expected a DBC"
            )
    if out is None:
        print(text, end="" if text.endswith("\n") else "\n")
        return {}
    with whole_file(out) as file:
        file.write(text.encode())
    return {"path": str(out), "messages": text.count("\nBO_ ")}


def _dbc_of_configuration(path: Path) -> str:
    from jtqd.daemon.config import load_config
    from jtqd.daemon.recording.dbc import dbc_text

    try:
        return dbc_text(load_config(path), None)
    except ValueError as error:
        raise LogError(str(error)) from None


def candump_lines(frames: Frames, interface: str) -> Iterator[str]:
    """Yield frames as lines of `candump -L`, without their ends: `(1700000000.000000) can0 181#0011223344556677`."""
    rows = zip(
        frames.stamps_ns.tolist(), frames.ids.tolist(), frames.lengths.tolist(), frames.data, strict=True
    )
    for stamp, can_id, length, data in rows:
        seconds, rest = divmod(stamp, 1_000_000_000)
        number = f"{can_id & 0x3FFFFFFF:08X}" if can_id & (EXTENDED | ERROR) else f"{can_id & 0x7FF:03X}"
        content = f"R{length or ''}" if can_id & REMOTE else data[:length].tobytes().hex().upper()
        yield f"({seconds}.{rest // 1000:06d}) {interface} {number}#{content}"


# ---- tables ----


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
_JOINT_TOPICS = {joint: topic.name for joint, topic in enumerate(JOINTS, start=1)}
"""Of the joints that a log may have; every log has the first."""
_ROW = np.dtype(
    [("cycle", "<u8"), ("sync_monotonic_ns", "<i8"), *((field, "<f8") for field in RUN_FIELDS.values())]
)


class RunTable:
    """Run table of a log: `time_s` from its first row on, `j1.current_a` and so on. The log is read twice, chunk by chunk.

    A column without any value is left out, and so is a cycle in which one of the others is missing.

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
        path: Path | Sequence[Path],
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        all_cycles: bool = False,
    ) -> None:
        self.cycles = self.left_out = 0
        self._path, self._start_ns, self._end_ns, self._all = path, start_ns, end_ns, all_cycles
        there = topics_of(path)
        self._topics = {n: topic for n, topic in _JOINT_TOPICS.items() if n == 1 or topic in there}
        wanted = {f"j{n}.{column}": (n, field) for n in self._topics for column, field in RUN_FIELDS.items()}
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
            when = " in that time" if start_ns is not None or end_ns is not None else ""
            raise LogError(f"{_named(path)}: found no cycle of the joints{when}, expected one at least")
        if not found:
            raise LogError(f"{_named(path)}: found no measured value in {count} {_cycles(count)}")
        self._wanted = {name: where for name, where in wanted.items() if name in found}
        self.columns = tuple(self._wanted)

    def blocks(self) -> Iterator[Columns]:
        """Yield the table, some rows at a time."""
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
                f"{_named(self._path)}: found {kept} {_cycles(kept)} with every column, expected at least 2 "
                "(--all-cycles keeps all)"
            )

    def _rows(self) -> Iterator[dict[int, Records]]:
        """Yield rows (`_ROW`) of all joints, of the same cycles."""
        rest = {number: np.empty(0, _ROW) for number in self._topics}
        topics = tuple(self._topics.values())
        for found in iter_topics(self._path, topics, start_ns=self._start_ns, end_ns=self._end_ns):
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


def _cycles(number: int) -> str:
    return "cycle" if number == 1 else "cycles"


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
    """Yield all fields of a topic as columns, chunk by chunk: `log_time_ns`, then every field by its path.

    A path is such as `header.stamp.sec`. Fixed arrays have one column for each element (`data[3]`). A sequence is one
    column of its values as text.
    """
    found = False
    for messages in iter_messages(path, topic, start_ns=start_ns, end_ns=end_ns):
        columns: Columns = {"log_time_ns": messages.log_times}
        _flatten("", messages.records, columns)
        found = True
        yield columns
    if not found:
        when = " in that time" if start_ns is not None or end_ns is not None else ""
        raise LogError(f"{_named(path)}: found no message on {topic}{when}, expected one at least")


def _flatten(prefix: str, values: NDArray[Any], columns: Columns) -> None:
    kind = values.dtype
    if kind.names is not None:
        for name in kind.names:
            _flatten(_below(prefix, name), values[name], columns)
    elif values.ndim > 1:
        for n in range(values.shape[1]):
            _flatten(f"{prefix}[{n}]", values[:, n], columns)
    elif kind.kind == "S":
        columns[prefix] = np.array([each.decode("utf-8", "replace") for each in values.tolist()], object)
    elif kind.kind == "O":
        _flatten_objects(prefix, values.tolist(), columns)
    else:
        columns[prefix] = values


def _flatten_objects(prefix: str, values: list[Any], columns: Columns) -> None:
    """Take the attributes of the decoder's objects; a sequence becomes text."""
    names = getattr(values[0], "__slots__", None)
    if names is not None:
        for name in names:
            _flatten_objects(_below(prefix, name), [getattr(each, name) for each in values], columns)
    elif isinstance(values[0], int | float):
        columns[prefix] = np.array(values)
    else:
        columns[prefix] = np.array([_as_text(each) for each in values], object)


def _below(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def _as_text(value: Any) -> str:
    if isinstance(value, str):
        return value
    names = getattr(value, "__slots__", None)
    if names is not None:
        return " ".join(f"{name}={_as_text(getattr(value, name))}" for name in names)
    if isinstance(value, Iterable):
        return " ".join(map(_as_text, value))
    return repr(value) if isinstance(value, float) else str(value)


# ---- files ----


_ROWS, _GROUP_ROWS = 20_000, 60_000


class TableSize(NamedTuple):
    """Of a table that was written."""

    rows: int
    columns: int


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that is there when it is complete, or not at all; packed where its name ends in .gz.

    A link is followed, and what is no file (a pipe, /dev/stdout) is written to as it is, never replaced. Raises OSError.
    """
    target = Path(os.path.realpath(path))
    beside = not target.exists() or target.is_file()
    partial = target.with_name(target.name + f".{os.getpid()}.part") if beside else target
    try:
        with open(partial, "wb") as plain:
            if path.suffix == ".gz":
                # Without name and time: equal content makes equal files.
                with gzip.GzipFile("", "wb", 6, plain, mtime=0) as packed:
                    yield packed  # type: ignore[misc]
            else:
                yield plain
        if beside:
            os.replace(partial, target)
    except OSError as error:
        if error.filename in (None, str(partial)):
            error.filename = str(path)
        raise
    finally:
        if beside:
            with suppress(OSError):
                partial.unlink()


def write_csv(path: Path, blocks: Iterable[Columns]) -> TableSize:
    """Write a table: numbers as the shortest text that reads back the same, NaN as an empty cell. Raises OSError."""
    rows = 0
    names: tuple[str, ...] = ()
    with whole_file(path) as file:
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
    with whole_file(path) as file:
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
