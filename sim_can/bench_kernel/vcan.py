"""Whether this machine's own kernel offers a usable virtual CAN interface."""

import os
import socket
import subprocess

from jtqd.sim_can.bench_kernel.packages import find_program


def ready(name: str = "vcan0") -> bool:
    """Return whether a raw CAN socket can be bound to the interface and the interface is up."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((name,))
        with open(f"/sys/class/net/{name}/flags") as flags:
            return bool(int(flags.read(), 16) & 1)  # IFF_UP
    except OSError:
        return False


def ensure(name: str = "vcan0") -> bool:
    """Like ready(); as root, the interface is created and brought up first where the kernel can do that."""
    if ready(name):
        return True
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    ip = find_program("ip")
    if ip is None or os.geteuid() != 0:
        return False
    for arguments in (
        ("link", "add", "dev", name, "type", "vcan"),
        ("link", "set", name, "txqueuelen", "1000", "up"),
    ):
        subprocess.run([ip, *arguments], capture_output=True, check=False)
    return ready(name)
