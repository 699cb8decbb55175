"""What the PDOs of drives 1 and 2, scaled by a boot, say of their motion, and whether it is the one that they make."""

from __future__ import annotations

import math
import time

import pytest

from jtqd.drivers.boot import BootReport
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.drive import DriveScaling
from jtqd.drivers.frame import CAN_EFF_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from tests.library_drives.nodes import GEAR


def moves_as_it_should(values: dict[str, float]) -> None:
    """All values of one SYNC are of one moment: a swing of one turn at 0.2 Hz, 1 A in phase with the position."""
    assert values["gear_ratio"] == GEAR
    assert 0.1 < abs(values["current"]) < 1.0, "it moves"
    assert values["motor_position"] == pytest.approx(2.0 * math.pi * values["current"], abs=2e-2)
    assert values["link_position"] == pytest.approx(values["motor_position"] / GEAR, abs=1e-3)
    velocity = values["motor_velocity"] / (0.8 * math.pi**2)
    assert velocity**2 + values["current"] ** 2 == pytest.approx(1.0, abs=3e-2)


def quantities(name: str, report: BootReport) -> list[dict[str, float]]:
    """What the PDOs of nodes 1 and 2 say in SI units after one SYNC, when the motor is neither at rest nor at its turn."""
    socket = open_frame_socket(name, [CanFilter(0, CAN_EFF_FLAG)])
    wanted = {pdo.cob_id: (node, pdo) for node in (1, 2) for pdo in report.nodes[node].tpdos}
    while not 0.3 < abs(math.sin(0.4 * math.pi * time.monotonic())) < 0.9:
        time.sleep(0.01)
    socket.send(pack(0x080))
    raw: dict[int, dict[str, float]] = {1: {}, 2: {}}
    seen = set()
    deadline = time.monotonic() + 5.0
    while seen != set(wanted) and time.monotonic() < deadline:
        socket.wait(0.1)
        for n in range(socket.receive()):
            can_id, length, data = FRAME.unpack_from(socket.frames, 16 * n)
            if can_id in wanted:
                node, pdo = wanted[can_id]
                raw[node] |= dict(zip(pdo.names, pdo.layout.unpack(data[:length]), strict=True))
                seen.add(can_id)
    socket.close()
    assert seen == set(wanted)
    found = []
    for node in (1, 2):
        scaling = report.nodes[node].scaling
        assert isinstance(scaling, DriveScaling)
        found.append(
            {
                "motor_position": raw[node]["motor_position"] * scaling.motor_rad_per_count,
                "link_position": raw[node]["link_position"] * scaling.link_rad_per_count,
                "motor_velocity": raw[node]["motor_velocity"] * scaling.motor_rad_s_per_unit,
                "current": raw[node]["current"] * scaling.ampere_per_unit,
                "gear_ratio": report.nodes[node].gear_ratio or 0.0,
            }
        )
    return found
