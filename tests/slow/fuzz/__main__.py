"""Command line: `python -m tests.slow.fuzz frames|service|files|storm`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

_EXAMPLES = """examples:
  python -m tests.slow.fuzz frames --count 1000000 --seed 1    frames through the loop's path
  python -m tests.slow.fuzz service --count 1000000            frames through the supervisor's path
  python -m tests.slow.fuzz files --count 300                  damaged files, 300 of each kind
  python -m tests.slow.fuzz storm                              one run, quiet and in a storm of 120 000 frames by turns

Exit status 0: nothing found; 3: findings."""


def main(arguments: list[str] | None = None) -> int:
    """Run one fuzzer and print what it counted; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.slow.fuzz",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("frames", "service", "files", "storm"))
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of all that is random (default 1)")
    parser.add_argument("--count", type=int, metavar="N", help="frames, or files of each kind")
    parser.add_argument("--only", default="", metavar="WORD", help="files: kinds whose name has this word")
    parser.add_argument("--json", action="store_true", help="result as JSON")
    options = parser.parse_args(arguments)
    print(f"seed {options.seed}", file=sys.stderr)
    if options.what == "files":
        return _files(options)
    with tempfile.TemporaryDirectory(prefix="jtqfuzz") as name:
        if options.what == "frames":
            from tests.slow.fuzz.frames import fuzz_frames

            report = fuzz_frames(Path(name), options.seed, options.count or 1_000_000)
            result, ok = report.as_json(), report.ok
        elif options.what == "service":
            from tests.slow.fuzz.service import fuzz_service

            result = fuzz_service(Path(name), options.seed, options.count or 1_000_000)
            ok = result["ok"]
        else:
            from tests.slow.fuzz.storm import storm

            result = storm(options.seed, options.count or 120_000)
            ok = result["ok"]
    if options.json:
        print(json.dumps(result))
    else:
        for key, value in result.items():
            print(f"{key.replace('_', ' '):32}{value}")
    return 0 if ok else 3


def _files(options: argparse.Namespace) -> int:
    from tests.slow.fuzz.files import fuzz_files

    reports = fuzz_files(options.seed, options.count or 100, options.only)
    if options.json:
        rows = [
            {"name": r.name, **r.counts, "slowest_s": round(r.slowest_s, 2), "findings": r.wrong}
            for r in reports
        ]
        print(json.dumps(rows))
    else:
        print(f"{'file':18}{'accepted':>9}{'refused':>9}{'wrong':>7}{'slowest s':>11}")
        for r in reports:
            counts = (r.counts["accepted"], r.counts["refused"], r.counts["wrong"])
            print(f"{r.name:18}{counts[0]:9}{counts[1]:9}{counts[2]:7}{r.slowest_s:11.2f}")
        for r in reports:
            for line in r.wrong:
                print(f"{r.name}: {line}", file=sys.stderr)
    return 3 if any(r.wrong for r in reports) else 0


if __name__ == "__main__":
    sys.exit(main())
