"""Command line of the daemon."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from daemon.config import load_config
from daemon.supervisor import Supervisor, SupervisorError
from drivers.errors import BusError
from estimator.arguments import seconds
from estimator.checked import ConfigError

_EXAMPLES = """examples:
  jtqd --bus sim --duration 20          emulated bench in its own processes, 20 s, with a live table
  jtqd --bus vcan0                      SocketCAN interface, until Ctrl-C or SIGTERM
  jtqd --bus unix:/run/bench.sock       frame socket of `jtq sim --bus unix:/run/bench.sock`
  jtqd --bus can0 --config /etc/jtqd/arm.yaml --record /var/log/jtqd

exit status: 0 done, 1 failure, 2 usage, 3 done, but cycles are missing in the log"""


def parser() -> argparse.ArgumentParser:
    """Arguments of `jtqd`."""
    result = argparse.ArgumentParser(
        prog="jtqd",
        description="Estimate the torque of two harmonic-drive joints at 1 kHz, as a CANopen master, without torque sensor.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument(
        "--bus", required=True, help="SocketCAN interface, unix:PATH, or sim for the emulated bench"
    )
    result.add_argument(
        "--config", type=Path, metavar="FILE", help="configuration (default: the bench that ships)"
    )
    result.add_argument(
        "--record",
        metavar="DIR",
        help="directory of the MCAP logs, or none (default: $LOGS_DIRECTORY or ./logs)",
    )
    result.add_argument(
        "--duration", type=seconds, metavar="S", help="end after S seconds (default: run until stopped)"
    )
    result.add_argument("--json", action="store_true", help="print the final summary as JSON")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run the daemon; returns the exit status."""
    arguments = parser().parse_args(argv)
    if not arguments.bus:
        parser().error("argument --bus: found '', expected an interface, unix:PATH or sim")
    try:
        config = load_config(arguments.config)
        supervisor = Supervisor(config, arguments.bus, arguments.config, arguments.record, arguments.duration)
        summary = supervisor.run()
    except (ConfigError, BusError, SupervisorError) as error:
        print(f"jtqd: {error}", file=sys.stderr)
        return 1
    if summary is None:
        return 0
    try:
        print(json.dumps(summary.content()) if arguments.json else summary.text(), flush=True)
    except OSError as error:
        print(f"jtqd: the summary could not be printed: {error.strerror}", file=sys.stderr)
        return 1
    return summary.exit_status


if __name__ == "__main__":
    sys.exit(main())
