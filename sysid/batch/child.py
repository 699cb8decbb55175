"""`python -m jtqd.sysid.batch.child PID COMMAND ...`: a `jtq` command that ends with its parent PID, however that ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from jtqd.daemon.jtq import main

_PR_SET_PDEATHSIG = 1


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it was gone before we asked
        sys.exit(1)


if __name__ == "__main__":
    _end_with(int(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
