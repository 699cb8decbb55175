"""Command line: `python -m tests.benchmarks [NAME ...] [--quick] [--json]`; no name means all."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.benchmarks import cycle, log_reading, long_run, recording, replay_speed, stages, start
from tests.benchmarks.contender import description
from tests.benchmarks.fixture import make_fixture

NAMES = ("cycle", "stages", "grid", "start", "logs", "recording", "replay")
_BITRATE = 1_000_000
_EXAMPLES = """examples:
  python -m tests.benchmarks                   everything, about 13 minutes
  python -m tests.benchmarks cycle stages      ratios and stages, about 2 minutes
  python -m tests.benchmarks --quick           everything in half a minute; its figures are rough
  python -m tests.benchmarks grid --minutes 1

Targets are marked PASS, over or under; the exit status is 0 either way, 1 when something could not be measured."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", nargs="*", metavar="|".join(NAMES), help="default: all")
    parser.add_argument("--quick", action="store_true", help="short runs")
    parser.add_argument("--json", action="store_true", help="results as JSON on standard output")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of `cycle` (default 5)")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of a round (default 4)")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of `grid` (default 10)")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for; returns the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    unknown = [each for each in options.what if each not in NAMES]
    if unknown:
        parser.error(f"found {unknown[0]!r}, expected one of {', '.join(NAMES)}")
    if options.quick:
        options.rounds, options.seconds, options.minutes = 2, 0.6, 5.0 / 60.0
    results: dict[str, Any] = {"machine": description()}
    if not options.json:
        print(f"{results['machine']}\n")
    # So that what was started is ended and what was written is removed.
    signal.signal(signal.SIGTERM, lambda _number, _frame: sys.exit(1))
    failed = False
    # On a tmpfs, as the loop's shared memory is in service.
    shared = "/dev/shm" if Path("/dev/shm").is_dir() else None
    for name in options.what or NAMES:
        with tempfile.TemporaryDirectory(prefix="jtqd-bench-", dir=shared) as directory:
            try:
                content, lines = _measure(name, Path(directory), options)
            except (RuntimeError, OSError) as error:
                failed = True
                content, lines = {"error": str(error)}, f"{name}: not measured: {error}"
        results[name] = content
        if not options.json:
            print(f"{lines}\n", flush=True)
    if options.json:
        print(json.dumps(results))
    return int(failed)


def _measure(name: str, directory: Path, options: argparse.Namespace) -> tuple[Any, str]:
    small = {
        "start": (start, {}),
        "recording": (recording, {"seconds": 5.0 if options.quick else 30.0}),
        "logs": (log_reading, {"minutes": 0.25 if options.quick else 5.0}),
        "replay": (replay_speed, {}),
    }
    if name in small:
        module, arguments = small[name]
        result = module.run(directory, **arguments)
        return result, module.text(result)
    fixture = make_fixture(directory)
    if name == "grid":
        result = long_run.run(fixture, minutes=options.minutes)
        return result, long_run.text(result)
    if name == "stages":
        result = stages.run(fixture, seconds=options.rounds * options.seconds / 2.0, quiet=True)
        return result, stages.text(result)
    few = max(1, options.rounds // 2)
    content = {
        "quiet_core": cycle.run(fixture, rounds=options.rounds, seconds=options.seconds, quiet=True),
        "wire": cycle.run(fixture, rounds=few, seconds=options.seconds, quiet=True, bitrate=_BITRATE),
        "shared_core": cycle.run(fixture, rounds=few, seconds=options.seconds, quiet=False),
    }
    return content, "\n\n".join(cycle.text(each) for each in content.values())


if __name__ == "__main__":
    sys.exit(main())
