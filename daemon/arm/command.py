"""`jtqd-arm`: command line and exit status."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from jtqd import __version__
from jtqd.daemon.live import Address, address
from jtqd.daemon.shared.processes import CannotBegin, Stop
from jtqd.estimator.command_line import check_installed, command_parser, printable_streams, seconds
from jtqd.estimator.errors import ConfigError

_EXAMPLES = """examples:
  jtqd-arm arm.yaml                     what pushes on the arm whose jtqd run on this machine, until Ctrl-C or SIGTERM
  jtqd-arm arm.yaml --record /var/log/jtqd
  jtqd-arm arm.yaml --live              in Foxglove ws://127.0.0.1:8765

exit status: 0 done, 1 failure, 2 usage or a wrong ARM.yaml, 3 done, but cycles are missing in the log"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtqd-arm`."""
    text = "Estimate what pushes on an arm from outside, from the joint torques of the running jtqd."
    result = command_parser("jtqd-arm", text, _EXAMPLES)
    add = result.add_argument
    add("arm", type=Path, metavar="ARM.yaml", help="URDF, and which jtqd has which of its joints")
    add("--record", type=Path, metavar="DIR", help="directory of MCAP logs (default: no log)")
    add("--duration", type=seconds, metavar="S", help="end after S seconds (default: run until stopped)")
    text = "serve Foxglove and Lichtblick (default: ws://127.0.0.1:8765; extra: live)"
    add("--live", type=address, nargs="?", const=Address(), metavar="HOST:PORT", help=text)
    add("--json", action="store_true", help="print the final summary as JSON")
    add("--version", action="version", help="print the version", version=f"jtqd-arm {__version__}")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run until stopped; returns the exit status."""
    printable_streams()
    arguments = parser().parse_args(argv)
    stop = Stop()
    try:
        check_installed("arm", "pinocchio")
        if arguments.live is not None:
            check_installed("live", "foxglove")
        from jtqd.daemon.arm.arm_file import load_arm
        from jtqd.daemon.arm.process import run

        summary = run(load_arm(arguments.arm), arguments.record, arguments.live, arguments.duration, stop)
    except (ConfigError, CannotBegin) as error:
        print(f"jtqd-arm: {error}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    recording = summary["recording"]
    lines = (f"{key.replace('_', ' '):<18}{_shown(value)}" for key, value in summary.items())
    try:
        print(json.dumps(summary) if arguments.json else "\n".join(lines), flush=True)
    except OSError as error:
        print(f"jtqd-arm: the summary could not be printed: {error.strerror}", file=sys.stderr)
        return 1
    return 3 if recording is not None and not recording["complete"] else 0


def _shown(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_shown(each)}" for key, each in value.items())
    if isinstance(value, list):
        return "; ".join(map(str, value)) or "none"
    return "none" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
