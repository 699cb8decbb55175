"""`jtq replay`: the estimator over a log again: bit for bit with the logged models, or with others, and the difference."""

from __future__ import annotations

import argparse
import os
import sys
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from jtqd.daemon.logs import LogError, LogFile, rmse, shadow_errors
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData
from jtqd.daemon.recording.messages import SCHEMAS, CycleMessages
from jtqd.daemon.recording.run_files import ACTIVE
from jtqd.daemon.replay.compare import Comparison, Contacts, Difference, Identity, Unknown
from jtqd.daemon.replay.logged import ADDED, SAMPLE, STAMP, stamps_ns
from jtqd.daemon.replay.session import Result, as_json, content, replay
from jtqd.daemon.shared.cycle_record import layout_of
from jtqd.estimator.arrays import RecordArray
from jtqd.estimator.command_line import check_output, command_parser
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.network import NetworkError
from jtqd.estimator.settings import METHODS

# ---- results as text ----


def number(count: int) -> str:
    """Format a number with narrow gaps between thousands: 29 981."""
    return f"{count:,}".replace(",", " ")


def text(result: Result, *, compared: bool) -> str:
    """Return the report of one run; `compared`: with the differences, although the models are those of the log."""
    same = result.identity
    speed = result.seconds / max(result.replay_s, 1e-9)
    lines = [
        ", ".join(map(str, result.run.logs)),
        f"  {number(result.run.cycles)} cycles, {result.seconds:.3f} s, method {result.method}; "
        f"{result.replay_s:.2f} s ({speed:.0f} times real time), reading {result.read_s:.2f} s",
    ]
    if same is None:
        lines += [f"  joint {n}: {model.source}" for n, model in enumerate(result.models, start=1)]
    for count, what in (
        (result.lost, "cycles are missing in the middle of the log"),
        (result.from_si, "inputs have no frame in the log: taken from the recorded SI values"),
        (result.temperatures_from_log, "times the temperature is not in the frames: taken from the log"),
    ):
        if count:
            lines.append(f"  {number(count)} {what}")
    if same is not None:
        lines.append(_verdict(same, int(result.run.joints[0]["cycle"][0])))
        if same.pdos:
            equal = f"{number(same.pdos_equal)} of {number(same.pdos)}"
            lines.append(f"  estimate PDO on the bus: same bytes in {equal}")
        lines += map(_contacts, same.contacts)
        lines += map(_unknown, same.unknown)
        lines += map(_difference, same.differences)
    for n, joint in enumerate(result.joints if result.models[0].shadows else (), start=1):
        found = ", ".join(f"{name} {_nm(rmse(error))}" for name, error in shadow_errors(joint, joint).items())
        lines.append(
            f"  joint {n}: shadow methods, rms error in motion against the sensor as old as each: {found}"
        )
    if compared or same is None:
        for each in result.comparisons:
            lines += _comparison(each, "now" if same is None else "replayed")
    return "\n".join(lines)


def _verdict(same: Identity, first_cycle: int) -> str:
    counts = f"{number(same.identical)} of {number(same.cycles)} cycles"
    if not same.explained or same.from_cycle is None:
        return f"  NOT bit-identical: {counts}"
    from_on = "" if same.from_cycle == first_cycle else f" from cycle {number(same.from_cycle)} on"
    if not same.network_nm:
        return f"  bit-identical{from_on}: {counts}"
    return (
        f"  equal to {same.network_nm:.1g} Nm{from_on}; bit-identical: {counts} (the networks were evaluated otherwise "
        "when this log was recorded)"
    )


def _contacts(each: Contacts) -> str:
    count = "1 contact" if each.logged == 1 else f"{number(each.logged) if each.logged else 'no'} contacts"
    if not each.different:
        return (
            f"  joint {each.joint}: {count} in the log, the same replayed ({number(each.known)} cycles known)"
        )
    why = " (the detector remembers seconds, and its state was not known at the beginning)"
    return (
        f"  joint {each.joint}: {count} in the log, {number(each.replayed)} replayed; other in {number(each.different)} "
        f"cycles, first in {number(each.first_cycle or 0)}, by {_nm(each.largest_nm, '.3g')} at most"
        f"{why if each.excused else ''}"
    )


def _unknown(each: Unknown) -> str:
    where = f"  joint {each.joint}: from cycle {number(each.first_cycle)} on the observer's state"
    if each.until_end:
        end = (
            f"is not known ({each.reason}), and {number(each.cycles)} cycles were not enough for convergence"
        )
    else:
        end = f"was not known ({each.reason}); identical again {number(each.cycles)} cycles later"
    return f"{where} {end}"


def _difference(each: Difference) -> str:
    if each.joint == 0:
        return f"  the estimate PDO's bytes differ in {number(each.cycles)} cycles, first in {number(each.cycle)}"
    return (
        f"  joint {each.joint}: {each.field} differs from cycle {number(each.cycle)} on, in {number(each.cycles)} "
        f"cycles: {each.logged:.6g} -> {each.replayed:.6g}; torque by {each.largest_nm:.3g} Nm at most"
    )


def _nm(value: float, form: str = ".3f") -> str:
    return "-" if isnan(value) else f"{value:{form}} Nm"


def _comparison(each: Comparison, now: str) -> list[str]:
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
    changes = ", ".join(f"{c.logged} -> {c.replayed} {number(c.cycles)}" for c in each.changes[:6])
    share = each.status_changed / max(each.cycles, 1)
    lines.append(f"    status changed in {share:.2%} of the cycles" + (f": {changes}" if changes else ""))
    return lines


# ---- MCAP with the logged states on /joint/N/state and the replay on /joint/N/replay ----

_SCHEMA = "jtqd_msgs/msg/JointEstimate"
_CHUNK_CYCLES = 500
_REPEAT_EVERY = 60
_MESSAGE = np.dtype(
    [
        ("opcode and length", "V9"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
        ("encapsulation", "V4"),
        ("stamp", STAMP),
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
    joints = range(len(results[0].joints))
    topics = [f"/joint/{n + 1}/{what}" for n in joints for what in ("state", "replay")]
    schema = Schema(id=1, name=_SCHEMA, encoding="ros2msg", data=SCHEMAS[_SCHEMA].encode())
    channels = [
        Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=1)
        for number, topic in enumerate(topics, start=1)
    ]
    with LogFile(results[0].run.logs[0]) as log:
        attached = [NamedData(each.name, each.media_type, log.attachment(each)) for each in log.attachments]
    attached.append(
        NamedData("replay.json", "application/json", as_json([content(each) for each in results]))
    )
    file = McapFile(
        path.with_name(path.name + ACTIVE),
        Head([schema], channels, attached),
        {"made by": "jtq replay"},
        int(stamps_ns(results[0].run.joints[0][:1])[0]),
    )
    parts = [(channel.id, n * _MESSAGE.itemsize) for n, channel in enumerate(channels)]
    builder = ChunkBuilder([schema], channels, parts, _REPEAT_EVERY)
    try:
        for result in results:
            rows = np.concatenate([_messages(result, n) for n in joints], axis=1)
            for begin in range(0, len(rows), _CHUNK_CYCLES):
                for row in rows[begin : begin + _CHUNK_CYCLES]:
                    builder.add_block(row.tobytes(), int(row["log_time"][0]))
                sealed = builder.seal()
                assert sealed is not None
                file.append(sealed)
        file.finish(path.name)
    except OSError:
        file.abandon(remove=True)
        raise


def _messages(result: Result, n: int) -> RecordArray:
    """Message records of joint `n`, from 0 on: logged and replayed [cycles, 2]."""
    logged, replayed = result.run.joints[n], result.joints[n]
    empty = bytes(layout_of(n + 1).size)
    block = CycleMessages(n + 1).block(empty, 0, 0, flags=0, sync_counter=0, frames=0)
    template = np.frombuffer(block, _MESSAGE, 1, n * _MESSAGE.itemsize)
    out = np.repeat(template, 2 * len(logged)).reshape(-1, 2)
    out["channel"] = 2 * n + 1, 2 * n + 2
    time_ns = stamps_ns(logged)
    columns = {"sequence": logged["cycle"] & 0xFFFF_FFFF, "log_time": time_ns, "publish_time": time_ns}
    columns |= {name: np.full(len(logged), np.nan) for name in ADDED}  # of an older log
    columns |= {name: logged[name] for name in logged.dtype.names or () if name in (out.dtype.names or ())}
    for field, values in (columns | {"stamp": logged["header"]["stamp"]}).items():
        out[field] = values[:, np.newaxis]
    for field in SAMPLE.names or ():
        out[field][:, 1] = replayed[field]
    return out


# ---- command ----

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
    description = "Run the estimator again over the inputs of a log, and compare with the published values."
    made = command_parser("jtq replay", description, _EXAMPLES)
    add = made.add_argument
    add("logs", nargs="+", type=Path, metavar="LOG", help="MCAP files of jtqd, or the directory of one run")
    add(
        "--model",
        type=Path,
        metavar="DIR",
        help="other models: jointN.yaml or extended.jointN.yaml, jointN.onnx, jointN.fused.onnx; the rest as logged",
    )
    add("--method", choices=METHODS, help="another method of the estimator")
    add("--compare", action="store_true", help="show differences also with the logged models")
    add("--json", action="store_true", help="results as JSON")
    both = "write a new MCAP with both: /joint/N/state and /joint/N/replay"
    add("--out", type=Path, metavar="FILE", help=both)
    return made


def main(argv: list[str]) -> int:
    """Run `jtq replay`; returns the exit status."""
    try:
        options = parser().parse_args(argv)
    except SystemExit as leave:
        return int(leave.code or 0)
    if options.out is not None and os.path.lexists(options.out):
        print(f"jtq replay: {options.out}: exists already, expected a new file", file=sys.stderr)
        return 2
    bar = _Bar()
    try:
        if options.out is not None:
            check_output(options.out)
        good = _replay(options, bar)
    except (LogError, ConfigError, NetworkError) as error:
        return _failed(bar, str(error))
    except OSError as error:
        return _failed(bar, f"{error.filename or options.out or 'output'}: {error.strerror or error}")
    return 0 if good else 3


def _replay(options: argparse.Namespace, bar: _Bar) -> bool:
    """Replay, print, and write what is asked for; whether all is good. Only --out keeps more than one result in memory."""
    kept: list[Result] = []
    made: list[Any] = []
    good = True
    results = replay(options.logs, options.model, options.method, progress=bar.update)
    while (result := next(results, None)) is not None:
        good &= result.good
        made.append(content(result) if options.json else text(result, compared=options.compare))
        if options.out is not None:
            kept.append(result)
        del result
    bar.close()
    if options.out is not None:
        write(options.out, kept)
    print(as_json(made).decode() if options.json else "\n\n".join(made))
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


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
