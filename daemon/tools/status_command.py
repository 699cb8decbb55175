"""`jtq status`: how a running jtqd is doing. It reads shared memory and can never slow the loop."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time

from rich.console import Console, Group
from rich.live import Live

from daemon.shared.snapshot import SnapshotReader
from daemon.supervisor.live_table import plain_line
from daemon.tools.reading import RUNNING, Reading, Watch
from daemon.tools.running import Daemon, Found, find_daemons, on_bus
from daemon.tools.status_json import content
from daemon.tools.status_view import StatusView, clock

_EXAMPLES = """examples:
  jtq status                     live view of the daemon that runs here; Ctrl-C ends the view
  jtq status --bus can0          of the one on can0, where there are several
  jtq status --once              one picture, also into a file or a mail
  jtq status --json | jq '.joints[].torque_nm'

exit status: 0 it runs, 1 no daemon runs (or none that you may look at), 2 usage, 3 it does not advance, or is still starting
what you may look at: your own daemons, and those whose group you are in (usermod -a -G jtqd YOU)"""
_PERIOD_S = 0.2
_PLAIN_PERIOD_S = 1.0
_BETWEEN_S = 0.3
"""Between the two readings of one picture: bus load and causes need what has changed."""


class _NotOneError(Exception):
    """No daemon to look at, or more than one; the message is for the operator."""

    def __init__(self, message: str, exit_status: int) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def parser() -> argparse.ArgumentParser:
    """Options of `jtq status`."""
    made = argparse.ArgumentParser(
        prog="jtq status",
        description="How a running jtqd is doing: torque, status with its reason, inputs, timing, bus, nodes, log.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--bus", help="whose daemon: can0, unix:PATH or sim (default: the only one that runs)")
    made.add_argument("--once", action="store_true", help="one picture, then end")
    made.add_argument("--json", action="store_true", help="one reading as JSON, then end")
    return made


def main(argv: list[str]) -> int:
    """Show it; returns the exit status."""
    arguments = parser().parse_args(argv)
    try:
        daemon = _chosen(find_daemons(), arguments.bus)
        if arguments.json or arguments.once:
            return _once(daemon, as_json=arguments.json)
        os.nice(5)
        console = Console()
        return _live(console, daemon) if console.is_terminal else _lines(daemon)
    except _NotOneError as error:
        print(f"jtq status: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return 0


def _chosen(found: Found, bus: str | None) -> Daemon:
    if bus is not None:
        daemon = on_bus(found, bus)
        if daemon is None:
            raise _NotOneError(f"no jtqd runs on {bus}{_others(found)}{_closed(found)}", 1)
        return daemon
    if not found.daemons:
        raise _NotOneError(f"no jtqd runs here{_closed(found)}", 1)
    if len(found.daemons) > 1:
        raise _NotOneError(f"several daemons run: which one?{_others(found)}", 2)
    return found.daemons[0]


def _others(found: Found) -> str:
    return "".join(f"\n  --bus {each.about.instance:<24} pid {each.about.pid}" for each in found.daemons)


def _closed(found: Found) -> str:
    return "".join(f"\n  {path} belongs to others: join its group to look at it" for path in found.closed)


def _twice(daemon: Daemon) -> Reading:
    watch = Watch(daemon)
    watch.read()
    time.sleep(_BETWEEN_S)
    return watch.read()


def _once(daemon: Daemon, *, as_json: bool) -> int:
    reading = _twice(daemon)
    if as_json:
        print(json.dumps(content(reading)))
    else:
        Console().print(StatusView(reading))
    return 0 if reading.state == RUNNING else 3


def _live(console: Console, daemon: Daemon) -> int:
    """Until Ctrl-C, or the daemon ends; one that is started again is found again."""
    watch = Watch(daemon)
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            if daemon.about.running():
                live.update(Group(StatusView(watch.read()), clock()), refresh=True)
            else:
                live.update(
                    f"jtqd on {daemon.about.instance} has ended; waiting for its return", refresh=True
                )
                again = on_bus(find_daemons(), daemon.about.instance)
                if again is not None:
                    daemon, watch = again, Watch(again)
            time.sleep(_PERIOD_S)


def _lines(daemon: Daemon) -> int:
    """Not a terminal: a line a second, until the daemon ends."""
    watch = Watch(daemon)
    while daemon.about.running():
        reading = watch.read()
        if reading.state != RUNNING or reading.view is None or reading.earlier is None:
            print(f"not running: {reading.why}", flush=True)
        else:
            reader = SnapshotReader(daemon.directory / "snapshot")
            print(plain_line(reader, reading.earlier, reading.view, daemon.about.bitrate), flush=True)
        time.sleep(_PLAIN_PERIOD_S)
    return 0
