"""`jtq recover`: recover logs that a crash left unfinished, or that were damaged later."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from jtqd.daemon.logs.container import LogError
from jtqd.daemon.logs.recover import BeingWrittenError, OutsideChunksError, Recovery, recover
from jtqd.daemon.recording.own_files import ACTIVE
from jtqd.estimator.checked import counted

_ENDINGS = (".mcap", ".mcap" + ACTIVE)
_EXAMPLES = """examples:
  jtq recover /var/log/jtqd                       every damaged or unfinished file in the directory
  jtq recover run.mcap.active                     becomes run.mcap
  jtq recover --dry-run --json run.mcap           check every byte, change nothing

Every file is checked completely; intact files of a directory (*.mcap, *.mcap.active) are not listed. Files that a
recorder is writing are refused (in a directory: left out). A file without a readable message stays as it is.
The recovered file is written beside the old one and then replaces it: the free space must be at least the file's size.

exit status: 0 nothing lost, 3 recovered with loss, 1 failure, 2 usage"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq recover`."""
    result = argparse.ArgumentParser(
        prog="jtq recover",
        description="Recover truncated or damaged logs of jtqd; every intact chunk is kept.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("logs", nargs="+", type=Path, metavar="FILE|DIR")
    result.add_argument("--json", action="store_true", help="results as JSON on standard output")
    result.add_argument("--dry-run", action="store_true", help="report only, change nothing")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run `jtq recover`; returns its exit status."""
    options = parser().parse_args(argv)
    for path in options.logs:
        if not path.is_dir() and not path.name.endswith(_ENDINGS):
            parser().error(f"found {path}, expected a directory or a file named *.mcap or *.mcap{ACTIVE}")
    results: list[Recovery] = []
    failures: list[dict[str, str]] = []
    for path, in_directory in _files(options.logs):
        try:
            found = recover(path, dry_run=in_directory or options.dry_run)
            if in_directory and not (found.changed or found.renamed):
                continue
            results.append(found if options.dry_run or not in_directory else recover(path))
        except (BeingWrittenError, OutsideChunksError) as error:
            if not in_directory or (isinstance(error, OutsideChunksError) and not error.ended):
                failures.append(_failure(path, error))
            else:
                print(f"jtq recover: left out: {error}", file=sys.stderr)
            continue
        except (LogError, OSError) as error:
            failures.append(_failure(path, error))
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


def _failure(path: Path, error: LogError | OSError) -> dict[str, str]:
    """Say it on standard error; returns it for the JSON."""
    text = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
    print(f"jtq recover: {text}", file=sys.stderr)
    return {"path": str(path), "error": text}


def _files(paths: list[Path]) -> Iterator[tuple[Path, bool]]:
    """Yield every file, and whether it was named by its directory only."""
    for path in paths:
        if not path.is_dir():
            yield path, False
            continue
        for each in sorted(path.iterdir()):
            if each.is_file() and each.name.endswith(_ENDINGS):
                yield each, True


def _text(result: Recovery, dry_run: bool) -> str:
    would = "would be " if dry_run else ""
    state = f"{would}repaired" if result.changed else f"{would}renamed" if result.renamed else "whole"
    lines = [
        f"{result.path}: {state}: {counted(result.messages, 'message')}, {counted(result.chunks, 'chunk')}, "
        f"{counted(result.attachments, 'attachment')}, {result.seconds:.1f} s"
    ]
    lines += [f"  {finding}" for finding in result.findings]
    if result.lossy:
        time = "unknown time" if result.lost_s is None else f"about {result.lost_s:.2f} s"
        lines.append(
            f"  lost: {counted(result.lost_bytes, 'byte')}, {counted(result.lost_chunks, 'chunk')}, {time}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
