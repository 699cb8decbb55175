"""Command line of the hub."""

import argparse
import ctypes
import signal
import sys
from types import FrameType

from drivers.errors import BusError
from drivers.hub import Hub
from drivers.unix_socket import PREFIX

_PR_SET_TIMERSLACK = 29


class _StopError(Exception):
    """SIGINT or SIGTERM."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise _StopError


def run(arguments: list[str] | None) -> int:
    """Run a hub until SIGINT or SIGTERM; exit status 0, or 1 when the bus cannot be made."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.hub",
        description="CAN bus on a unix socket",
        epilog="example: python -m drivers.hub unix:/tmp/bus --bitrate 1000000",
    )
    parser.add_argument("bus", help="unix:PATH")
    parser.add_argument(
        "--bitrate", type=int, help="model the wire at this many bit/s; default: pass at once"
    )
    options = parser.parse_args(arguments)
    if not options.bus.startswith(PREFIX) or options.bus == PREFIX:
        parser.error(f"found {options.bus!r}, expected unix:PATH")
    if options.bitrate is not None and options.bitrate <= 0:
        parser.error(f"--bitrate must be positive, not {options.bitrate}")
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    # The default slack of 50 us on every timeout is one short frame at 1 Mbit/s.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    hub = None
    try:
        hub = Hub(options.bus.removeprefix(PREFIX), options.bitrate)
        print(f"hub: {options.bus} is up", flush=True)
        while True:
            hub.run_once(None)
    except _StopError:
        return 0
    except BusError as error:
        print(f"hub: {error}", file=sys.stderr)
        return 1
    finally:
        if hub is not None:
            hub.close()
