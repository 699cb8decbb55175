"""`jtq replay`: the estimator over a log again: bit for bit with the logged models, or with others, and the difference."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from daemon.logs.errors import LogError
from daemon.replay.session import SHORT_CYCLES, Result, Wishes, replay_each
from daemon.replay.text import text
from estimator.checked import ConfigError
from estimator.onnx_graph import NetworkError
from estimator.settings import METHODS

_EXAMPLES = f"""examples:
  jtq replay run.mcap                          does the log's own estimator give what was published?
  jtq replay part1.mcap part2.mcap             parts of one run, in any order; or their directory
  jtq replay run.mcap --model trained/         with other joint files and networks: what changes
  jtq replay run.mcap --method efficiency      with another method
  jtq replay run.mcap --model new/ --out both.mcap   a log with both, for Foxglove

Up to {SHORT_CYCLES:,} cycles with the logged models are replayed cycle by cycle by the loop's own code, longer logs
and other models as a whole in arrays; --exact forces the first.
exit status: 0 replayed (with the logged models: identical), 1 a log or model cannot be used, 2 usage, 3 it differs"""


def parser() -> argparse.ArgumentParser:
    """Options of `jtq replay`."""
    made = argparse.ArgumentParser(
        prog="jtq replay",
        description="Run the estimator over the inputs of a log again, and compare with what was published.",
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
    made.add_argument("--exact", action="store_true", help="cycle by cycle, whatever the length")
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
    wishes = Wishes(options.model, options.method, True if options.exact or _short(options) else None)
    bar = _Bar()
    try:
        good = _replay(options, wishes, bar)
    except (LogError, ConfigError, NetworkError) as error:
        return _failed(bar, str(error))
    except OSError as error:
        return _failed(bar, f"{error.filename or 'log'}: {error.strerror or error}")
    return 0 if good else 3


def _replay(options: argparse.Namespace, wishes: Wishes, bar: _Bar) -> bool:
    """Replay, print, and write what is asked for; whether all is good. Only --out keeps more than one result in memory."""
    kept: list[Result] = []
    made: list[Any] = []
    good = True
    results = replay_each(options.logs, wishes, bar.update)
    while (result := next(results, None)) is not None:
        good &= result.good
        made.append(result.to_mapping() if options.json else text(result, compared=options.compare))
        if options.out is not None:
            kept.append(result)
        del result
    bar.close()
    if options.out is not None:
        from daemon.replay.output import write

        write(options.out, kept)
    print(json.dumps({"schema": "jtq.replay/1", "runs": made}) if options.json else "\n\n".join(made))
    return good


def _short(options: argparse.Namespace) -> bool:
    """--compare with the logged models asks for the loop's own numbers."""
    return bool(options.compare and options.model is None and options.method is None)


def _failed(bar: _Bar, line: str) -> int:
    bar.close()
    print(f"jtq replay: {line}", file=sys.stderr)
    return 1


class _Bar:
    """Progress on a terminal; nothing elsewhere."""

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
