"""Command line: `python -m tests.slow.soak [--minutes 30] [--seed N] [--native | --exact [--wall S]]`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

_EXAMPLES = """examples:
  python -m tests.slow.soak                            30 minutes on a unix bus
  python -m tests.slow.soak --minutes 5 --seed 7
  python -m tests.slow.soak --exact --minutes 5        in the bench kernel, guest time: on vcan0, with the link taken down
  python -m tests.slow.soak --exact --minutes 1440 --wall 3600    as much guest time as an hour of this machine gives

Exit status 0: all is well; 3: findings."""
_STOP = "stop"
_ENDS_WITHIN_S = 1800.0
"""Wall time that a soak in the guest may take to end and to count, after `--wall`."""


def main(arguments: list[str] | None = None) -> int:
    """Run; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.slow.soak",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="how long (default 30)")
    parser.add_argument("--seed", type=int, default=1, help="of the faults (default 1)")
    parser.add_argument("--native", action="store_true", help="here, on a unix bus (default)")
    parser.add_argument("--exact", action="store_true", help="in the bench kernel, in time travel, on vcan0")
    parser.add_argument("--wall", type=float, help="with --exact: end after so many seconds of wall time")
    parser.add_argument("--interface", help="a CAN interface instead of a unix bus")
    parser.add_argument("--stop-directory", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help="result as JSON")
    options = parser.parse_args(arguments)
    if options.exact and options.native:
        parser.error("--native and --exact exclude each other")
    if options.wall is not None and not options.exact:
        parser.error("--wall belongs to --exact")
    if options.exact:
        return _in_guest(options)
    print(f"seed {options.seed}", file=sys.stderr)
    from tests.slow.soak.run import soak

    def stop() -> bool:  # a listing, because the guest asks the host for it each time
        directory = options.stop_directory
        return directory is not None and _STOP in os.listdir(directory)

    with tempfile.TemporaryDirectory(prefix="js") as name:
        report = soak(Path(name), options.minutes * 60.0, options.seed, options.interface, stop)
    print(json.dumps(report.as_json()) if options.json else report.text())
    return 3 if report.findings else 0


def _in_guest(options: argparse.Namespace) -> int:
    """The same command in the bench kernel; then what it has cost of this machine."""
    from jtqd.sim_can.bench_kernel import guest

    with tempfile.TemporaryDirectory(prefix="jsx") as directory:
        command = [sys.executable, "-m", "tests.slow.soak", "--interface", "vcan0"]
        command += ["--minutes", str(options.minutes), "--seed", str(options.seed)]
        command += ["--stop-directory", directory, *(["--json"] * options.json)]
        timer = threading.Timer(options.wall or 0.0, (Path(directory) / _STOP).touch)
        if options.wall is not None:
            timer.start()
        begun, sinks = time.monotonic(), (sys.stdout.buffer, sys.stderr.buffer)
        try:
            limit_s = None if options.wall is None else options.wall + _ENDS_WITHIN_S
            status = guest.run(
                command, time_travel=True, timeout_s=limit_s, out_dir=directory, memory="4G", sinks=sinks
            ).returncode
        finally:
            timer.cancel()
        used = os.times()
        cpu_s = used.children_user + used.children_system
        print(f"wall time {time.monotonic() - begun:.0f} s, CPU time {cpu_s:.0f} s", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
