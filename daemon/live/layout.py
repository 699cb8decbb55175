"""`jtq layout`: copies the layout of Foxglove and Lichtblick for jtqd's topics, as "Import from file..." takes it.

The shipped files (`layouts/N.json`, N joints) hold the panels and user scripts. The viewer runs the scripts: they add the
sigma band, the residual to the sensor, contacts and the cycle time to a recorded file as to the live view.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from jtqd.daemon.shared.cycle_record import MOST_JOINTS
from jtqd.estimator.command_line import command_parser, seconds
from jtqd.estimator.files import write_whole

_LAYOUTS = Path(__file__).with_name("layouts")
_EXAMPLES = """examples:
  jtq layout --out jtqd.layout.json     then "Import from file..." in the layouts menu of Foxglove or Lichtblick
  jtq layout --follow 10 > live.layout.json     plots that show the last 10 s, for the live view

The layout works for a recorded file and for the live view of `jtqd --live`."""


def layout(follow_s: float | None = None, joints: int = 2) -> dict[str, Any]:
    """Return the shipped layout: panels by identifier, user scripts and their arrangement.

    follow_s: plots show this many seconds up to the newest message; None: the whole recording.
    """
    content: dict[str, Any] = json.loads((_LAYOUTS / f"{joints}.json").read_text(encoding="utf-8"))
    for name, panel in content["configById"].items():
        if follow_s is not None and name.startswith("Plot!"):
            panel["followingViewWidth"] = follow_s
    return content


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq layout`."""
    description = (
        "Write the layout file for Foxglove and Lichtblick: torque with its sigma band, residual to the sensor, status, "
        "stages, inputs, contacts, cycle time, diagnostics and log."
    )
    result = command_parser("jtq layout", description, _EXAMPLES)
    result.add_argument("--out", type=Path, metavar="FILE", help="output file (default: standard output)")
    result.add_argument(
        "--follow", type=seconds, metavar="S", help="plots show the last S seconds (default: everything)"
    )
    counts = range(1, MOST_JOINTS + 1)
    text = "joints of the bus, 1 to 4 (default: 2)"
    result.add_argument("--joints", type=int, choices=counts, default=2, metavar="N", help=text)
    return result


def main(argv: list[str] | None = None) -> int:
    """Write the layout; returns the exit status."""
    arguments = parser().parse_args(argv)
    text = json.dumps(layout(arguments.follow, arguments.joints), indent=2) + "\n"
    if arguments.out is None:
        sys.stdout.write(text)
        return 0
    try:
        write_whole(arguments.out, text.encode())
    except OSError as error:
        print(f"jtq layout: {arguments.out}: {error.strerror}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
