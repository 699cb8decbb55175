"""A hub or a bench as a process: when it takes connections."""

import subprocess
import time
from typing import Any

from jtqd.drivers.frame_socket import BusError, open_frame_socket


def until_it_listens(bus: str, process: "subprocess.Popen[Any]") -> None:
    """Wait; the path of a bus is there a moment before it takes connections."""
    while True:
        try:
            open_frame_socket(bus, []).close()
        except BusError:
            assert process.poll() is None
            time.sleep(0.02)
        else:
            return
