"""`jtq layout`: the layout file for Foxglove and Lichtblick."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from daemon.live.layout import layout
from estimator.arguments import seconds

_EXAMPLES = """examples:
  jtq layout --out jtqd.layout.json     then "Import from file..." in the layouts menu of Foxglove or Lichtblick
  jtq layout --follow 10 > live.layout.json     plots that show the last 10 s, for the live view

The layout fits a recorded file and the live view of `jtqd --live` alike."""


def parser() -> argparse.ArgumentParser:
    """Arguments of `jtq layout`."""
    result = argparse.ArgumentParser(
        prog="jtq layout",
        description="Write the layout file for Foxglove and Lichtblick: torque with its sigma band, residual to the "
        "sensor, status, stages, inputs, cycle time, diagnostics and log.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--out", type=Path, metavar="FILE", help="write it there (default: standard output)")
    result.add_argument(
        "--follow", type=seconds, metavar="S", help="plots show the last S seconds (default: all there is)"
    )
    return result


def main(argv: list[str] | None = None) -> int:
    """Write the layout; returns the exit status."""
    arguments = parser().parse_args(argv)
    text = json.dumps(layout(arguments.follow), indent=2) + "\n"
    if arguments.out is None:
        sys.stdout.write(text)
        return 0
    temporary = arguments.out.with_name(f".{arguments.out.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, arguments.out)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        print(f"jtq layout: {arguments.out}: {error.strerror}", file=sys.stderr)
        return 1
    return 0
