"""`jtqd`, the daemon: command line and exit status."""

from __future__ import annotations

import argparse
import json
import platform
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

# What is heavy to load is loaded in `_run`: Ctrl-C must find its handler installed, also in the first second.
from jtqd import __version__
from jtqd.daemon.live import Address, address
from jtqd.estimator.command_line import command_parser, printable_streams, seconds

_EXAMPLES = """examples:
  jtqd --bus sim --duration 20          emulated bench in its own processes, 20 s, with a live table
  jtqd --bus vcan0                      SocketCAN interface, until Ctrl-C or SIGTERM
  jtqd --bus unix:/run/bench.sock       frame socket of `jtq sim --bus unix:/run/bench.sock`
  jtqd --bus can0 --config /etc/jtqd/arm.yaml --record /var/log/jtqd
  jtqd --bus can0 --config arm/jtqd.yaml --guest     beside a PLC that is the master of the bus
  jtqd --bus can0 --ros2                joint states, torque states and diagnostics for ROS 2 nodes of this machine
  jtqd --bus can0 --live                a page at http://127.0.0.1:8765; in Foxglove ws://127.0.0.1:8765

exit status: 0 done, 1 failure, 2 usage or a wrong configuration, 3 done, but cycles are missing in the log"""

_LONGEST_INTERFACE = 15
"""IFNAMSIZ of Linux without its final zero."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtqd`."""
    result = command_parser(
        "jtqd",
        "Estimate the torque of one to four harmonic-drive joints, as a CANopen master, without torque sensor.",
        _EXAMPLES,
    )
    add = result.add_argument
    add("--bus", required=True, help="SocketCAN interface, unix:PATH, or sim for the emulated bench")
    add("--config", type=Path, metavar="FILE", help="configuration (default: the shipped bench)")
    text = "directory of the MCAP logs, or none (default: $LOGS_DIRECTORY or ./logs)"
    add("--record", metavar="DIR", help=text)
    text = "end after S seconds (default: run until stopped)"
    add("--duration", type=seconds, metavar="S", help=text)
    text = (
        "serve a page, read-only (default: http://127.0.0.1:8765), and Foxglove or Lichtblick (extra: live)"
    )
    add("--live", type=address, nargs="?", const=Address(), metavar="HOST:PORT", help=text)
    text = "publish for ROS 2, 100 Hz, on loopback unless the configuration (ros2) states otherwise (extra: ros2)"
    add("--ros2", action="store_true", help=text)
    roles = result.add_mutually_exclusive_group()
    text = "another node is the master: follow its SYNC, obey its NMT commands, ask nothing (docs/bus.md; role: guest)"
    roles.add_argument("--guest", dest="role", action="store_const", const="guest", help=text)
    text = "as --guest, and send nothing at all (role: listener)"
    roles.add_argument("--listener", dest="role", action="store_const", const="listener", help=text)
    add("--json", action="store_true", help="print the final summary as JSON")
    add("--version", action="version", help="print the version", version=f"jtqd {__version__}")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run the daemon; returns the exit status."""
    printable_streams()
    arguments = parser().parse_args(argv)
    with _early_signals() as stop_requests:
        return _run(arguments, stop_requests)


@contextmanager
def _early_signals() -> Iterator[list[int]]:
    """Collect requests to end until the supervisor takes the signals; SIGHUP is ignored.

    An exception (KeyboardInterrupt) would surface as errors of the libraries that are being loaded.
    """
    stop_requests: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        stop_requests.append(number)

    handlers: dict[int, Callable[[int, FrameType | None], Any] | int] = {
        signal.SIGINT: note,
        signal.SIGTERM: note,
        signal.SIGHUP: signal.SIG_IGN,
    }
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield stop_requests
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _run(arguments: argparse.Namespace, stop_requests: list[int]) -> int:
    if not arguments.bus:
        parser().error("argument --bus: found '', expected an interface, unix:PATH or sim")
    if len(arguments.bus) > _LONGEST_INTERFACE and not arguments.bus.startswith("unix:"):
        parser().error(
            f"argument --bus: found a name of {len(arguments.bus)} characters, expected at most {_LONGEST_INTERFACE}"
        )
    from jtqd.daemon import ros2
    from jtqd.daemon.config import load_config
    from jtqd.daemon.supervisor.process import ConfigurationRefused, Supervisor, SupervisorError
    from jtqd.drivers.frame_socket import BusError
    from jtqd.estimator.errors import ConfigError

    try:
        config = load_config(arguments.config, arguments.role)
        wants_ros2 = arguments.ros2 or config.ros2 is not None
        if wants_ros2 and not ros2.installed():
            who = "--ros2" if arguments.ros2 else f"{config.path}: key 'ros2':"
            print(f"jtqd: {who} needs {ros2.needed(platform.machine())}", file=sys.stderr)
            return 1
        supervisor = Supervisor(
            config,
            arguments.bus,
            arguments.config,
            arguments.record,
            arguments.duration,
            arguments.live,
            ros2=wants_ros2,
        )
        if stop_requests:
            supervisor.stop()
        summary = supervisor.run()
    except (ConfigError, BusError, SupervisorError) as error:
        print(f"jtqd: {error}", file=sys.stderr)
        # 2: started again it would fail again, until somebody has changed a file
        return 2 if isinstance(error, ConfigError | ConfigurationRefused) else 1
    if summary is None:
        print("jtqd: stopped before it ran", file=sys.stderr)
        return 0
    try:
        print(json.dumps(summary.content()) if arguments.json else summary.text(), flush=True)
    except OSError as error:
        print(f"jtqd: the summary could not be printed: {error.strerror}", file=sys.stderr)
        return 1
    return summary.exit_status


if __name__ == "__main__":
    sys.exit(main())
