"""Exchanged columns of two joints are named as swapped; columns where they belong never are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.runs.checks import check_runs
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_runs
from tests.paths import ROOT
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run

NOMINAL = load_joint(shipped("joint1.yaml"))
ONE = replace(NOMINAL, efficiency=None, friction=replace(NOMINAL.friction, stribeck_nm=0.0))
TWO = replace(
    ONE,
    name="two",
    gear_ratio=50.0,
    torque_constant_nm_per_a=0.03,
    friction=replace(ONE.friction, coulomb_nm=0.6, viscous_nms_per_rad=0.4),
)
JOINTS = {3: ONE, 4: TWO}
MOTION = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
KINOVA = ROOT / "models" / "kinova_gen3"


def run(seed: int) -> RunTable:
    one, two = (rich_run(j, seed + k, noise=2e-3) for k, j in enumerate((ONE, TWO)))
    return RunTable(one.time_s, {3: one.joints[1], 4: two.joints[1]})


def exchanged(table: RunTable, names: tuple[str, ...], a: int = 3, b: int = 4) -> RunTable:
    one, two = table.joints[a], table.joints[b]
    joints = {
        a: replace(one, **{n: getattr(two, n) for n in names}),
        b: replace(two, **{n: getattr(one, n) for n in names}),
    }
    return RunTable(table.time_s, {**table.joints, **joints})


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("torque_nm",), "good: j3.torque_nm and j4.torque_nm: found the other joint's"),
        (("current_a",), "good: j3.current_a and j4.current_a: found the other joint's"),
        (("current_a", *MOTION, "torque_nm"), "good: j3 and j4: found that each fits the other's joint file"),
    ],
    ids=["torque", "current", "all"],
)
def test_exchanged_columns_are_called_swapped(names: tuple[str, ...], said: str) -> None:
    checked = check_runs([("good", exchanged(run(5), names))], JOINTS)
    assert checked.runs == ()
    (line,) = checked.refused
    assert line.startswith(said)
    assert "swapped columns" in line
    assert checked.lost == (3, 4)


def test_the_run_is_named_and_the_others_are_used() -> None:
    bad = exchanged(run(5), ("torque_nm",))
    checked = check_runs([("a", run(7)), ("b", bad), ("c", run(9))], JOINTS)
    assert [name for name, _ in checked.runs] == ["a", "c"]
    assert [line.split(":")[0] for line in checked.refused] == ["b"]


def test_a_wrong_joint_file_is_no_exchange() -> None:
    wrong = replace(ONE, torque_constant_nm_per_a=0.7 * ONE.torque_constant_nm_per_a, rotor_inertia_kgm2=1e-6)
    assert not [line for line in check_runs([("a", run(5))], {3: wrong, 4: TWO}).refused if "swapped" in line]


@cache
def kinova() -> tuple[list[tuple[str, RunTable]], dict[int, Joint]]:
    columns = ColumnMap.load(KINOVA / "columns.yaml")
    read = read_runs(sorted(KINOVA.glob("*.csv.gz")), columns)
    joints = {n: load_joint(KINOVA / f"joint{n}.yaml") for n in range(2, 8)}
    return [(run.name, run.table) for run in read], joints


def test_columns_of_a_real_arm_are_where_they_belong() -> None:
    runs, joints = kinova()
    assert not [line for line in check_runs(runs, joints).refused if "swapped" in line]


@pytest.mark.parametrize("names", [("torque_nm",), ("current_a",)])
def test_exchanged_columns_of_a_real_arm(names: tuple[str, ...]) -> None:
    runs, joints = kinova()
    bad = [(name, exchanged(table, names)) for name, table in runs]
    said = [
        line for line in check_runs(bad, {3: joints[3], 4: joints[4]}).refused if "swapped columns" in line
    ]
    assert len(said) == len(runs)
    assert all(f"j3.{names[0]} and j4.{names[0]}" in line for line in said)
