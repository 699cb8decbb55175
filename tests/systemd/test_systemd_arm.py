"""An arm of seven joints: four instances of the unit under a real systemd, each with a status of its own."""

import json
from pathlib import Path

import pytest

from jtqd.sim_can.bench_kernel import guest
from tests.systemd.systemd_wheels import ROOT, make_environment, make_wheels
from tests.systemd.test_systemd_boot import PYTHON, needs

DRIVER = Path(__file__).with_name("arm_driver.py")
JOINTS = {"vcan0": 2, "vcan1": 2, "vcan2": 2, "vcan3": 1}
pytestmark = [pytest.mark.boots, pytest.mark.campaign]


def test_four_instances_have_one_status_each_and_share_no_fate(tmp_path: Path) -> None:
    reason = needs()
    if reason is not None:
        pytest.skip(f"systemd not tested: {reason}")
    wheels = tmp_path / "wheels"
    environment = make_environment(make_wheels(wheels), tmp_path / "opt")
    command = [str(PYTHON), str(DRIVER), str(ROOT), str(environment)]
    with guest.Guest(command, systemd=True, time_travel=True, vcans=list(JOINTS)) as one:
        result = one.wait(600.0)
    assert result.returncode == 0, result.stdout + result.stderr
    found = json.loads(result.stdout.splitlines()[-1])
    assert {bus: len(states) for bus, states in found["states"].items()} == JOINTS
    assert {bus: len(states) for bus, states in found["asked"].items()} == JOINTS
    assert found["processes"] == 3, "of the instances that still run"
    assert set(found["rest"]) == set(JOINTS) - {"vcan2"}
    assert found["gone"] is None
    assert found["directories"] == ["vcan0", "vcan1", "vcan3"]
    assert set(found["results"].values()) == {"success"}
    assert all(found["logs"].values()), "each instance has its own logs"
