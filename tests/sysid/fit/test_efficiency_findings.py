"""Findings of the efficiency fit: swapped signs, wrong scales and exchanged columns are noticed by physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from jtqd.estimator.run import RunTable
from jtqd.models.files import shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.fit.efficiency import efficiency_findings
from jtqd.sysid.fit.plateaus import Mean, Plateau, find_plateaus
from tests.sysid.campaign_helpers import section_two_runs
from tests.sysid.fit.eta_grid import JOINT, NM_PER_A, grid, plateau, points_of


def flipped(*names: str) -> Callable[[Plateau], Plateau]:
    def flip(p: Plateau) -> Plateau:
        changes = {name: Mean(-getattr(p, name).value, getattr(p, name).se) for name in names}
        return replace(p, **changes)

    return flip


@pytest.mark.parametrize(
    ("change", "kinds", "cause"),
    [
        (flipped("torque"), ["torque_against_current"], "swapped sign of the torque"),
        (flipped("current"), ["torque_against_current"], "swapped sign of the current"),
        (
            flipped("velocity"),
            ["eta_above_1_driving", "eta_below_1_back_driven"],
            "swapped sign of the velocity",
        ),
        (
            flipped("current", "torque"),
            ["eta_above_1_driving", "eta_below_1_back_driven"],
            "current and torque together",
        ),
    ],
)
def test_swapped_signs_are_found_by_physics(
    change: Callable[[Plateau], Plateau], kinds: list[str], cause: str
) -> None:
    found = efficiency_findings(points_of([change(p) for p in grid()]), JOINT)
    assert [item.kind for item in found] == kinds
    assert all(cause in item.text for item in found)
    assert all("\n" not in item.text for item in found)


def test_torque_and_motor_torque_exchanged_is_called_the_wrong_convention() -> None:
    exchanged = [
        replace(
            p,
            torque=Mean(NM_PER_A * p.current.value, 0.01),
            current=Mean(p.torque.value / NM_PER_A, 0.001),
        )
        for p in grid()
    ]
    found = efficiency_findings(points_of(exchanged), JOINT)
    assert [item.kind for item in found] == ["eta_above_1_driving", "eta_below_1_back_driven"]
    assert all("wrong convention" in item.text for item in found)


@pytest.mark.parametrize(
    ("scale", "kind", "word"),
    [
        (0.5, "eta_above_1_driving", "too small"),
        (0.66, "eta_above_1_driving", "too small"),
        (1.08, "eta_below_1_back_driven", "too large"),
        (1.6, "eta_below_1_back_driven", "too large"),
    ],
)
@pytest.mark.parametrize("parameter", ["gear_ratio", "torque_constant_nm_per_a"])
def test_a_wrong_scale_of_the_joint_file_is_found_by_physics(
    scale: float, kind: str, word: str, parameter: str
) -> None:
    """Driving gives at most 0.72 here, back-driven at least 1.0: G Kt may be wrong by -28 % or by +2 % unseen."""
    joint = replace(JOINT, **{parameter: getattr(JOINT, parameter) * scale})
    found = efficiency_findings(points_of(grid(), joint), joint)
    assert [item.kind for item in found] == [kind]
    assert f"G Kt of the joint file is {word}" in found[0].text
    assert "gear ratio" in found[0].text


def test_eta_at_its_border_within_its_errors_is_no_finding() -> None:
    """Table I itself is 0.998 when back-driven at 3.8 A and -0.2 rad/s; noise and zero may take it a little further."""
    assert efficiency_findings(points_of(grid()), JOINT) == []
    edge = plateau(4.0, -1.0, 4.0 * NM_PER_A - 0.3)
    assert efficiency_findings(points_of([edge]), JOINT) == []
    beyond = plateau(4.0, -1.0, 4.0 * NM_PER_A - 0.5)
    assert [f.kind for f in efficiency_findings(points_of([beyond]), JOINT)] == ["eta_below_1_back_driven"]
    uncertain = plateau(4.0, -1.0, 4.0 * NM_PER_A - 0.5, se_tau=0.05)
    assert efficiency_findings(points_of([uncertain]), JOINT) == []


def test_findings_of_emulated_runs_with_a_wrong_joint_file() -> None:
    table = short_run()
    for ratio, kind in ((50.0, "eta_above_1_driving"), (160.0, "eta_below_1_back_driven")):
        joint = replace(JOINT, gear_ratio=ratio)
        plateaus = []
        for number in (1, 2):  # one run is forward drive of one joint and back drive of the other
            run = table.joint(number, joint.gear_ratio)
            plateaus += find_plateaus(table.time_s, run, joint, "run")
        assert [f.kind for f in efficiency_findings(points_of(plateaus, joint), joint)] == [kind]


def short_run() -> RunTable:
    return section_two_runs(load_plant(shipped("plant.yaml")), velocities=(1.0,))[0]
