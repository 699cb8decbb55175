"""`jtq export`: logs as tables for other programs, frames as lines of candump, the bus as a DBC."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jtqd.daemon.logs.can_frames import can_topics, iter_frames
from jtqd.daemon.logs.candump import candump_lines
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.export_table import ColumnsChangedError, RunTable, topic_blocks, topic_table
from jtqd.daemon.logs.reader import log_parts, read_attachments
from jtqd.daemon.logs.table_files import whole_file, write_csv, write_parquet

_EXAMPLES = """examples:
  jtq export csv run.mcap --out run.csv.gz              the run table: time_s, j1.current_a, ...
  jtq export parquet LOGDIR --out run.parquet           all parts of the run in a directory
  jtq export csv run.mcap --topic /joint/1/state --out joint1.csv      every field of a topic
  jtq export csv run.mcap --start 10 --end 20 --out part.csv           seconds from the first cycle on
  jtq export candump run.mcap | cantools decode bus.dbc
  jtq export dbc run.mcap --out bus.dbc                 as attached to the log
  jtq export dbc --config arm.yaml --out bus.dbc        without a log: integers as the devices send them

exit status: 0 done, 1 failure, 2 usage, 3 done, but cycles with a missing value were left out"""
_DBC = "bus.dbc"


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq export`."""
    parser = argparse.ArgumentParser(
        prog="jtq export",
        description="Write a log as a table (CSV, Parquet), as lines of candump, or the DBC of its bus.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("csv", "parquet", "candump", "dbc"))
    parser.add_argument(
        "logs", nargs="*", type=Path, metavar="LOG", help="parts of one run, or their directory"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="default: standard output (candump and dbc only)"
    )
    parser.add_argument(
        "--topic", metavar="TOPIC", help="csv, parquet: this topic's fields; candump: its frames"
    )
    parser.add_argument("--start", type=_seconds, metavar="S", help="seconds from the first message on")
    parser.add_argument("--end", type=_seconds, metavar="S", help="up to, but without, this time")
    parser.add_argument(
        "--all-cycles", action="store_true", help="run table: keep cycles with missing values (NaN)"
    )
    parser.add_argument("--interface", default="can0", help="name in candump's lines (default can0)")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="dbc: of a configuration instead of a log"
    )
    parser.add_argument("--json", action="store_true", help="result as JSON on standard output")
    return parser


def _seconds(text: str) -> float:
    """Seconds that log times can hold."""
    value = float(text)
    if not abs(value) < 1e9:
        raise argparse.ArgumentTypeError(f"found {text}, expected seconds")
    return value


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    command = parser()
    options = command.parse_intermixed_args(argv)  # options may stand before the logs
    of_config = options.what == "dbc" and options.config is not None
    if of_config == bool(options.logs):
        command.error("expected a log" + (" or --config" if options.what == "dbc" else "") + ", and not both")
    if options.what in ("csv", "parquet") and options.out is None:
        command.error("expected --out FILE")
    if options.out is None and options.json:
        command.error("--json needs --out FILE: standard output takes one of them")
    if options.out is not None and any(_same(options.out, log) for log in options.logs):
        command.error(f"--out {options.out}: that is the log")
    try:
        result = _export(options)
    except (LogError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            raise  # `| head` has gone: the caller (`jtq`) ends without a word
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            text = f"{error.filename}: {error.strerror}"
        print(f"jtq export: {text}", file=sys.stderr)
        return 1
    if options.json:
        print(json.dumps(result))
    elif options.out is not None:
        print(", ".join(f"{name} {value}" for name, value in result.items()))
    left_out = result.get("left_out", 0)
    if left_out:
        print(
            f"jtq export: {left_out} cycles with a missing value left out (--all-cycles keeps them)",
            file=sys.stderr,
        )
    return 3 if left_out else 0


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
        try:
            size = write(options.out, topic_blocks(logs, options.topic, **span))
        except ColumnsChangedError:
            size = write(options.out, [topic_table(logs, options.topic, **span)])
    else:
        table = RunTable(logs, all_cycles=options.all_cycles, **span)
        size = write(options.out, table.blocks())
        result = {"left_out": table.left_out}
    return {"path": str(options.out), "rows": size.rows, "columns": size.columns} | result


def _span(logs: Path | Sequence[Path], start: float | None, end: float | None) -> dict[str, int | None]:
    """Log times of a span given in seconds from the first message on."""
    if start is None and end is None:
        return {}
    from jtqd.daemon.logs.log_file import LogFile

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
        raise LogError(f"{logs}: found frames on {', '.join(topics)}, expected them on {topic}")
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
