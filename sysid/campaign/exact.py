"""Exact time: a campaign on the emulated bench runs itself in the bench kernel, where computing takes no time.

Real time needs a machine that is on time. Where it is not, and nothing real is on the bus, the clock waits instead: the same
jtqd, commander and drives on SocketCAN, and no cycle is missed however busy the machine is (docs/testing.md).
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn

from jtqd.sim_can.bench_kernel import build, guest, packages
from jtqd.sysid.campaign.processes import ProcessError

BUS: Final = "exact"
"""As `--bus`."""
BUS_INSIDE: Final = "sim:vcan0"


class NoExactTimeError(ProcessError):
    """The bench kernel cannot be built or booted; one line."""


def inside() -> bool:
    """Return whether this process is in exact time already."""
    return os.environ.get(guest.TIME_TRAVEL_MARK) == "1"


def ready() -> bool:
    """Return whether the bench kernel is there: nothing must be built or installed for it."""
    try:
        return not inside() and build.find() is not None and not packages.missing(packages.GUEST)
    except RuntimeError:
        return False


def campaign(argv: Sequence[str], out: Path) -> int:
    """Run `jtq campaign` with these arguments in the bench kernel; returns its exit status. The last --bus counts.

    Raises:
        NoExactTimeError: the kernel cannot be built or booted.
        ProcessError: a signal ended it.
    """
    command = [sys.executable, "-P", "-m", "jtqd.daemon.jtq", "campaign", *argv, "--bus", BUS_INSIDE]
    sys.stdout.flush()
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        result = guest.run(
            command, time_travel=True, out_dir=out, sinks=(sys.stdout.buffer, sys.stderr.buffer)
        )
    except RuntimeError as error:  # every error of the bench kernel is one
        raise NoExactTimeError(f"exact time: {error}") from None
    except KeyboardInterrupt:
        raise ProcessError("ended by a signal; the same command continues with the remaining runs") from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return result.returncode


def _terminated(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
