"""`jtq recover`: repair log files in place."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.records import Source
from jtqd.daemon.logs.recover import Recovery, recover
from jtqd.daemon.logs.tail import footer_of
from jtqd.daemon.recording.parts import ACTIVE

_ENDINGS = (".mcap", ".mcap" + ACTIVE)
_EXAMPLES = """examples:
  jtq recover /var/log/jtqd                       every file there that a crash has left
  jtq recover run.mcap.active                     becomes run.mcap
  jtq recover --dry-run --json run.mcap           check every byte, change nothing

In a directory: every *.mcap.active, and every *.mcap that has no proper end. A file named on the command line is
checked from its first byte to its last. Files that a recorder is writing are refused (in a directory: left out).

exit status: 0 nothing lost, 3 repaired with loss, 1 failure, 2 usage"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq recover`."""
    parser = argparse.ArgumentParser(
        prog="jtq recover",
        description="Repair MCAP files in place: torn by a crash, cut short, damaged within. Never loses what was readable.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("logs", nargs="+", type=Path, metavar="FILE|DIR")
    parser.add_argument("--json", action="store_true", help="results as JSON on standard output")
    parser.add_argument("--dry-run", action="store_true", help="say what would be done, change nothing")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    command = parser()
    options = command.parse_args(argv)
    for path in options.logs:
        if not path.is_dir() and not path.name.endswith(_ENDINGS):
            command.error(f"found {path}, expected a directory or a file named *.mcap or *.mcap{ACTIVE}")
    results: list[Recovery] = []
    failures: list[dict[str, str]] = []
    for path in _files(options.logs):
        try:
            results.append(recover(path, dry_run=options.dry_run))
        except (LogError, OSError) as error:
            text = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
            failures.append({"path": str(path), "error": text})
            print(f"jtq recover: {text}", file=sys.stderr)
            continue
        if not options.json:
            print(_text(results[-1], options.dry_run), flush=True)
    if options.json:
        print(json.dumps({"files": [each.as_json() for each in results], "failures": failures}))
    elif not results and not failures:
        print("nothing to recover")
    if failures:
        return 1
    return 3 if any(each.lossy for each in results) else 0


def _files(paths: list[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        for each in sorted(path.iterdir()):
            if each.is_file() and (
                each.name.endswith(_ENDINGS[1]) or (each.suffix == ".mcap" and not _ends(each))
            ):
                yield each


def _ends(path: Path) -> bool:
    """The file has a footer; also said of one that cannot be opened."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return True
    try:
        return footer_of(Source(descriptor)) is not None
    finally:
        os.close(descriptor)


def _text(result: Recovery, dry_run: bool) -> str:
    would = "would be " if dry_run else ""
    state = f"{would}repaired" if result.changed else f"{would}renamed" if result.renamed else "whole"
    lines = [
        f"{result.path}: {state}: {result.messages} messages, {result.chunks} chunks, "
        f"{result.attachments} attachments, {result.seconds:.1f} s"
    ]
    lines += [f"  {finding}" for finding in result.findings]
    if result.lossy:
        lines.append(
            f"  lost: {result.lost_bytes} bytes, {result.lost_chunks} chunks, about {result.lost_s:.2f} s"
        )
    return "\n".join(lines)
