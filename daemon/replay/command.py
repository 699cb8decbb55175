"""`jtq replay`: the estimator over a log again: bit for bit with the logged models, or with others, and the difference."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from jtqd.daemon.logs import LogError, read_attachments
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData
from jtqd.daemon.recording.messages import CDR_HEADER, JOINT_ESTIMATE_SIZE
from jtqd.daemon.recording.run_files import ACTIVE
from jtqd.daemon.recording.schemas import SCHEMAS
from jtqd.daemon.replay.compare import Comparison, Contacts, Difference, Identity, Unknown
from jtqd.daemon.replay.logged import SAMPLE
from jtqd.daemon.replay.session import ReplayOptions, Result, replay_each
from jtqd.estimator.arrays import RecordArray
from jtqd.estimator.command_line import check_output
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.estimator.settings import METHODS

# ---- results as text ----


def number(count: int) -> str:
    """Format a number with narrow gaps between thousands: 29 981."""
    return f"{count:,}".replace(",", " ")


def text(result: Result, *, compared: bool) -> str:
    """Return the report of one run; `compared`: with the differences, although the models are those of the log."""
    lines = [*_head(result)]
    if result.identity is not None:
        lines += _identity(result, result.identity)
    if compared or result.identity is None:
        lines += [line for each in result.comparisons for line in _comparison(each, result.identity is None)]
    return "\n".join(lines)


def _head(result: Result) -> list[str]:
    logs = ", ".join(str(part.path) for part in result.run.parts)
    speed = result.seconds / max(result.replay_s, 1e-9)
    lines = [
        logs,
        f"  {number(result.run.cycles)} cycles, {result.seconds:.3f} s, method {result.method}; "
        f"{result.replay_s:.2f} s ({speed:.0f} times real time), reading {result.read_s:.2f} s",
    ]
    if result.identity is None:
        lines += [f"  joint {n}: {file}" for n, file in enumerate(result.files, start=1)]
    if result.lost:
        lines.append(f"  {number(result.lost)} cycles are missing in the middle of the log")
    if result.from_si:
        lines.append(
            f"  {number(result.from_si)} inputs have no frame in the log: taken from the recorded SI values"
        )
    if result.temperatures_from_log:
        lines.append(
            f"  {number(result.temperatures_from_log)} times the temperature is not in the frames: taken from the log"
        )
    return lines


def _identity(result: Result, same: Identity) -> list[str]:
    verdict = f"{number(same.identical)} of {number(same.cycles)} cycles"
    since = same.from_cycle
    from_on = "" if since in (None, _first_cycle(result)) else f" from cycle {number(since)} on"
    if same.explained and since is not None and same.network_nm:
        lines = [
            f"  equal to {same.network_nm:.1g} Nm{from_on}; bit-identical: {verdict} (the networks were evaluated otherwise "
            "when this log was recorded)"
        ]
    elif same.explained and since is not None:
        lines = [f"  bit-identical{from_on}: {verdict}"]
    else:
        lines = [f"  NOT bit-identical: {verdict}"]
    if same.pdos:
        lines.append(
            f"  estimate PDO on the bus: same bytes in {number(same.pdos_equal)} of {number(same.pdos)}"
        )
    lines += [_contacts(each) for each in same.contacts]
    lines += [_unknown(each) for each in same.unknown]
    lines += [_difference(each) for each in same.differences]
    return lines


def _first_cycle(result: Result) -> int:
    return int(result.run.joints[0]["cycle"][0])


def _contacts(each: Contacts) -> str:
    count = (
        "no contact"
        if each.logged == 0
        else "1 contact"
        if each.logged == 1
        else f"{number(each.logged)} contacts"
    )
    if not each.different:
        return f"  joint {each.joint}: {count} in the log, told again in the same cycles ({number(each.known)} cycles known)"
    why = (
        " (the detector remembers seconds, and its state was not known at the beginning)"
        if each.excused
        else ""
    )
    return (
        f"  joint {each.joint}: {count} in the log, {number(each.replayed)} replayed; other in {number(each.different)} "
        f"cycles, first in {number(each.first_cycle or 0)}, by {_nm(each.largest_nm, '.3g')} at most{why}"
    )


def _unknown(each: Unknown) -> str:
    if each.until_end:
        return (
            f"  joint {each.joint}: from cycle {number(each.first_cycle)} on the observer's state is not known "
            f"({each.reason}), and {number(each.cycles)} cycles were not enough for convergence"
        )
    return (
        f"  joint {each.joint}: from cycle {number(each.first_cycle)} on the observer's state was not known "
        f"({each.reason}); identical again {number(each.cycles)} cycles later"
    )


def _difference(each: Difference) -> str:
    if each.joint == 0:
        return f"  the estimate PDO's bytes differ in {number(each.cycles)} cycles, first in {number(each.cycle)}"
    return (
        f"  joint {each.joint}: {each.field} differs from cycle {number(each.cycle)} on, in {number(each.cycles)} "
        f"cycles: {each.logged:.6g} -> {each.replayed:.6g}; torque by {each.largest_nm:.3g} Nm at most"
    )


def _nm(value: float, form: str = ".3f") -> str:
    return "-" if isnan(value) else f"{value:{form}} Nm"


def _comparison(each: Comparison, other: bool) -> list[str]:
    now = "now" if other else "replayed"
    largest = "" if each.max_cycle is None else f" in cycle {number(each.max_cycle)}"
    lines = [
        f"  joint {each.joint}: torque differs by {_nm(each.rms_nm, '.4f')} rms, {_nm(each.max_nm, '.4f')} at most{largest}"
        f" ({number(each.both)} cycles)",
    ]
    if each.sensor_cycles:
        better = each.sensor_replayed_nm / each.sensor_logged_nm - 1.0 if each.sensor_logged_nm else 0.0
        lines.append(
            f"    against the torque sensor: {_nm(each.sensor_logged_nm)} rms as logged, "
            f"{_nm(each.sensor_replayed_nm)} {now} ({better:+.1%})"
        )
    lines.append(f"    mean sigma {_nm(each.sigma_logged_nm)} as logged, {_nm(each.sigma_replayed_nm)} {now}")
    share = each.status_changed / max(each.cycles, 1)
    said = ", ".join(f"{c.logged} -> {c.replayed} {number(c.cycles)}" for c in each.changes[:6])
    lines.append(f"    status changed in {share:.2%} of the cycles" + (f": {said}" if said else ""))
    return lines


# ---- MCAP with the logged states on /joint/N/state and the replay on /joint/N/replay ----

_SCHEMA = "jtqd_msgs/msg/JointEstimate"
_CHUNK_CYCLES = 500
_REPEAT_EVERY = 60
_OPCODE_MESSAGE, _RECORD_REST = 0x05, 22
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("rest", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("cdr", "S4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("frame_id", "V16"),
        ("cycle", "<u8"),
        ("sync_monotonic_ns", "<i8"),
        *((name, SAMPLE[name]) for name in SAMPLE.names or ()),
        ("sync_counter", "u1"),
        ("cycle_flags", "u1"),
    ]
)
"""One MCAP Message record with a JointEstimate as `jtqd.daemon.recording.messages` makes it."""


def write(path: Path, results: list[Result]) -> None:
    """Write one run, all stretches of it, to a new file. Raises LogError for several runs, OSError for a disk that fails."""
    runs = len({each.run.number for each in results})
    if runs != 1:
        raise LogError(f"{path}: found logs of {runs} runs, expected those of one for --out")
    joints = range(1, len(results[0].joints) + 1)
    topics = [f"/joint/{joint}/{what}" for joint in joints for what in ("state", "replay")]
    schema = Schema(id=1, name=_SCHEMA, encoding="ros2msg", data=SCHEMAS[_SCHEMA].encode())
    channels = [
        Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=1)
        for number, topic in enumerate(topics, start=1)
    ]
    head = Head([schema], channels, _attachments(results))
    parts = [(number, (number - 1) * _MESSAGE.itemsize) for number in range(1, len(topics) + 1)]
    file = McapFile(
        path.with_name(path.name + ACTIVE), head, {"made by": "jtq replay"}, _first_ns(results[0])
    )
    builder = ChunkBuilder([schema], channels, parts, _REPEAT_EVERY)
    try:
        for result in results:
            _add(file, builder, np.concatenate([_messages(result, n) for n in range(len(joints))], axis=1))
        file.finish(path.name)
    except OSError:
        file.abandon(remove=True)
        raise


def _add(file: McapFile, builder: ChunkBuilder, blocks: RecordArray) -> None:
    """Append the messages of n cycles [n, topics]."""
    data, size = blocks.tobytes(), _MESSAGE.itemsize * blocks.shape[1]
    for row, time_ns in enumerate(blocks["log_time"][:, 0].tolist()):
        builder.add_block(data[row * size : (row + 1) * size], time_ns)
        if row % _CHUNK_CYCLES == _CHUNK_CYCLES - 1:
            _flush(file, builder)
    _flush(file, builder)


def _first_ns(result: Result) -> int:
    """Send time of the first SYNC, CLOCK_REALTIME."""
    stamp = result.run.joints[0]["header"]["stamp"][0]
    return int(stamp["sec"]) * 1_000_000_000 + int(stamp["nanosec"])


def _flush(file: McapFile, builder: ChunkBuilder) -> None:
    sealed = builder.seal()
    if sealed is not None:
        file.append(sealed)


def _attachments(results: list[Result]) -> list[NamedData]:
    """Return the attachments of the first log and a description of the replay."""
    kept = read_attachments(results[0].run.parts[0].path)
    made = json.dumps({"schema": "jtq.replay/1", "runs": [each.to_mapping() for each in results]}).encode()
    return [
        *(NamedData(name, _media_type(name), data) for name, data in kept.items()),
        NamedData("replay.json", "application/json", made),
    ]


def _media_type(name: str) -> str:
    suffixes: Iterable[tuple[str, str]] = (
        (".yaml", "application/yaml"),
        (".json", "application/json"),
        (".onnx", "application/octet-stream"),
    )
    return next((kind for suffix, kind in suffixes if name.endswith(suffix)), "text/plain")


def _messages(result: Result, number: int) -> RecordArray:
    """Message records of joint `number` (from 0 on): logged and replayed [n, 2]."""
    logged, replayed = result.run.joints[number], result.joints[number]
    assert _MESSAGE.itemsize == 31 + JOINT_ESTIMATE_SIZE
    out = np.zeros((len(logged), 2), _MESSAGE)
    stamp = logged["header"]["stamp"]
    seconds, nanoseconds = stamp["sec"].astype(np.uint32), stamp["nanosec"]
    time_ns = seconds.astype(np.uint64) * np.uint64(1_000_000_000) + nanoseconds.astype(np.uint64)
    name = f"joint_{number + 1}\0".encode()
    constants = {
        "opcode": _OPCODE_MESSAGE,
        "rest": _RECORD_REST + JOINT_ESTIMATE_SIZE,
        "cdr": CDR_HEADER,
        "frame_id": np.void(len(name).to_bytes(4, "little") + name + bytes(4)),
    }
    for field, value in constants.items():
        out[field] = value
    out["channel"] = [[2 * number + 1, 2 * number + 2]]
    nothing = np.full(len(logged), np.nan)  # of a log of before: a field that it does not have
    columns = {
        "sequence": logged["cycle"] & 0xFFFF_FFFF,
        "log_time": time_ns,
        "publish_time": time_ns,
        "sec": seconds.view(np.int32),
        "nanosec": nanoseconds,
        **{name: logged[name] for name in ("cycle", "sync_monotonic_ns", "sync_counter", "cycle_flags")},
        **{
            name: logged[name] if name in (logged.dtype.names or ()) else nothing
            for name in SAMPLE.names or ()
        },
    }
    for field, values in columns.items():
        out[field] = values[:, np.newaxis]
    for field in replayed.dtype.names or ():
        out[field][:, 1] = replayed[field]
    return out


_EXAMPLES = """examples:
  jtq replay run.mcap                          check that the log's estimator reproduces the published values
  jtq replay part1.mcap part2.mcap             parts of one run, in any order; or their directory
  jtq replay run.mcap --model trained/         with other joint files and networks
  jtq replay run.mcap --method efficiency      with another method
  jtq replay run.mcap --model new/ --out both.mcap   a log with both results, for Foxglove

Every cycle goes through the loop's own code.
exit status: 0 replayed (with the logged models: identical), 1 a log or model cannot be used, 2 usage, 3 different"""


def parser() -> argparse.ArgumentParser:
    """Options of `jtq replay`."""
    made = argparse.ArgumentParser(
        prog="jtq replay",
        description="Run the estimator again over the inputs of a log, and compare with the published values.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "logs", nargs="+", type=Path, metavar="LOG", help="MCAP files of jtqd, or the directory of one run"
    )
    made.add_argument(
        "--model",
        type=Path,
        metavar="DIR",
        help="other models: jointN.yaml or extended.jointN.yaml, jointN.onnx, jointN.fused.onnx; the rest as logged",
    )
    made.add_argument("--method", choices=METHODS, help="another method of the estimator")
    made.add_argument("--compare", action="store_true", help="show differences also with the logged models")
    made.add_argument("--json", action="store_true", help="results as JSON")
    made.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write a new MCAP with both: /joint/N/state and /joint/N/replay",
    )
    return made


def main(argv: list[str]) -> int:
    """Run `jtq replay`; returns the exit status."""
    try:
        options = parser().parse_args(argv)
    except SystemExit as leave:
        return int(leave.code or 0)
    if options.out is not None and options.out.exists():
        print(f"jtq replay: {options.out}: exists already, expected a new file", file=sys.stderr)
        return 2
    replay_options = ReplayOptions(options.model, options.method)
    bar = _Bar()
    try:
        if options.out is not None:
            check_output(options.out)
        good = _replay(options, replay_options, bar)
    except (LogError, ConfigError, NetworkError) as error:
        return _failed(bar, str(error))
    except OSError as error:
        return _failed(bar, f"{error.filename or options.out or 'output'}: {error.strerror or error}")
    return 0 if good else 3


def _replay(options: argparse.Namespace, replay_options: ReplayOptions, bar: _Bar) -> bool:
    """Replay, print, and write what is asked for; whether all is good. Only --out keeps more than one result in memory."""
    kept: list[Result] = []
    made: list[Any] = []
    good = True
    results = replay_each(options.logs, replay_options, bar.update)
    while (result := next(results, None)) is not None:
        good &= result.good
        made.append(result.to_mapping() if options.json else text(result, compared=options.compare))
        if options.out is not None:
            kept.append(result)
        del result
    bar.close()
    if options.out is not None:
        write(options.out, kept)
    print(json.dumps({"schema": "jtq.replay/1", "runs": made}) if options.json else "\n\n".join(made))
    return good


def _failed(bar: _Bar, line: str) -> int:
    bar.close()
    print(f"jtq replay: {line}", file=sys.stderr)
    return 1


class _Bar:
    """Progress bar on a terminal; nothing elsewhere."""

    def __init__(self) -> None:
        self._progress = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import Progress as RichProgress

            self._progress = RichProgress(console=Console(stderr=True), transient=True)
            self._task = self._progress.add_task("reading", total=None)
            self._progress.start()

    def update(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` are done."""
        if self._progress is not None:
            self._progress.update(self._task, description=what, completed=done, total=total)

    def close(self) -> None:
        """Take it away."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
