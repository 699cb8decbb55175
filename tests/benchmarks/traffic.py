"""The traffic of the bench, the same for every contender: five TPDOs per SYNC with values that vary like a robot's.

`python -m tests.benchmarks.traffic PATH CPU BITRATE PERIOD_US` (CPU and bit rate may be empty) runs it: a hub on a unix
socket with one lean node that answers each SYNC with the next cycle of a table of finished frames. It does no arithmetic
while it runs, so that it has answered long before the inputs are due.
"""

from __future__ import annotations

import struct
import sys
from math import cos, pi, sin

from jtqd.drivers.frame import pack
from jtqd.drivers.hub import Hub
from tests.benchmarks.measure import punctual

CYCLES = 4000
"""Cycles of the table; its end joins its beginning without a jump."""
SCALING = {
    "motor_rad_per_count": 2.0 * pi / 65536,
    "motor_rad_s_per_unit": 2.0 * pi / 65536,
    "link_rad_per_count": 2.0 * pi / 524288,
    "ampere_per_unit": 0.01,
}
SENSOR_NM_PER_UNIT = 1e-3
GEAR_RATIO = 100.0
_OPERATION_ENABLED = 0x0027
_POSITION, _MOTION, _SENSOR = struct.Struct("<ii"), struct.Struct("<ihH"), struct.Struct("<iB")
_PRIORITY = 50


def cycle_frames(cycle: int, period_s: float = 1e-3) -> list[bytes]:
    """The five TPDOs of one cycle as `struct can_frame`, in the order of their identifiers.

    Both joints swing through all four quadrants and through standstill, sometimes beyond the network's envelope.
    """
    phase = 2.0 * pi * (cycle % CYCLES) / CYCLES
    omega = 2.0 * pi / (CYCLES * period_s)
    velocity = 1.2 * cos(phase) + 0.3 * cos(3.0 * phase)  # joint side [rad/s]
    angle = (1.2 * sin(phase) + 0.1 * sin(3.0 * phase)) / omega
    torque = 9.0 * sin(2.0 * phase + 0.4) + 2.0 * sin(7.0 * phase)
    current = 3.0 * sin(2.0 * phase + 0.4) + 1.5 * cos(phase) + 0.2 * sin(11.0 * phase)
    twist = torque / 12000.0
    positions, motions = [], []
    for node, side in ((1, 1.0), (2, -1.0)):
        motor_counts = round(side * angle * GEAR_RATIO / SCALING["motor_rad_per_count"])
        link_counts = round(side * (angle - twist) / SCALING["link_rad_per_count"])
        units = round(side * velocity * GEAR_RATIO / SCALING["motor_rad_s_per_unit"])
        amperes = round(side * current / SCALING["ampere_per_unit"])
        positions.append(pack(0x180 + node, _POSITION.pack(motor_counts, link_counts)))
        motions.append(pack(0x280 + node, _MOTION.pack(units, amperes, _OPERATION_ENABLED)))
    sensor = pack(0x183, _SENSOR.pack(round(torque / SENSOR_NM_PER_UNIT), 0))
    return [positions[0], positions[1], sensor, motions[0], motions[1]]


def serve(path: str, cpu: int | None, bitrate: int | None, period_s: float) -> None:
    """Answer every SYNC on the hub at `path` until it is killed; prints one line when it is ready."""
    punctual(cpu, _PRIORITY)  # drives answer in time whatever else runs on a controller
    table = [cycle_frames(cycle, period_s) for cycle in range(CYCLES)]
    hub = Hub(path, bitrate)
    step = 0

    def on_frame(frame16: bytes, _stamp_ns: int) -> None:
        nonlocal step
        if frame16[0] == 0x80 and frame16[1] == 0:
            for frame in table[step]:
                port.send(frame)
            step = (step + 1) % CYCLES

    port = hub.attach(on_frame)
    print("ready", flush=True)
    while True:
        hub.run_once(None)


if __name__ == "__main__":
    _, _path, _cpu, _bitrate, _period_us = sys.argv
    serve(_path, int(_cpu) if _cpu else None, int(_bitrate) if _bitrate else None, 1e-6 * int(_period_us))
