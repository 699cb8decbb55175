"""A run table beside its set-points: a good run has nothing to say, and every fault put into it is named."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign.plan import expand
from jtqd.sysid.campaign.plans import ladder
from jtqd.sysid.campaign.runner import findings, gap_too_long
from jtqd.sysid.motion.setpoints import Setpoints
from jtqd.sysid.runs.logs import LoggedRun

Change = Callable[[dict[int, JointColumns]], None]


@lru_cache
def good_run() -> tuple[RunTable, Setpoints, tuple[Joint, Joint]]:
    """Joint 2 drives over three points, both directions; as measured on the emulated bench."""
    points = expand(ladder("r", 2, [(1.2, 1.0), (1.2, 3.0), (-1.2, -3.0)], 0.8))
    last = len(points) - 1
    current = JointCommand.current(lambda t: float(points.current_a[min(round(t * 1e3), last)]))
    velocity = JointCommand.velocity(lambda t: float(points.velocity_rad_s[min(round(t * 1e3), last)]))
    table = emulate_run(load_plant(shipped("plant.yaml")), (current, velocity), points.duration_s, seed=2)
    return table, points, (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))


def logged(table: RunTable) -> LoggedRun:
    gap = float(np.diff(table.time_s).max())
    return LoggedRun(table, missed=0, incomplete=0, incomplete_by={}, longest_gap_s=gap)


def found(change: Change | None = None) -> tuple[str, ...]:
    table, points, joints = good_run()
    columns = dict(table.joints)
    if change is not None:
        change(columns)
    return findings(logged(RunTable(table.time_s, columns)), points, joints, sensor=True)


def torque(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """The same change of the sensor as both joints have it."""

    def both(columns: dict[int, JointColumns]) -> None:
        for number in (1, 2):
            values = columns[number].torque_nm
            assert values is not None
            columns[number] = replace(columns[number], torque_nm=change(np.array(values)))

    return both


def one(number: int, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def joint(columns: dict[int, JointColumns]) -> None:
        values = np.array(getattr(columns[number], name))
        columns[number] = replace(columns[number], **{name: change(values)})

    return joint


def held(values: np.ndarray) -> np.ndarray:
    values[1200:2600] = values[1200]
    return values


def without_sensor(columns: dict[int, JointColumns]) -> None:
    for number in (1, 2):
        columns[number] = replace(columns[number], torque_nm=None)


def test_a_good_run_has_nothing_to_say() -> None:
    assert found() == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_sensor, ["j1.torque_nm", "no value in the whole run"]),
        (torque(lambda x: 0.0 * x), ["torque_nm", "exactly zero", "dead channel"]),
        (torque(held), ["torque_nm", "stuck"]),
        (torque(lambda x: np.clip(x, -8.0, 8.0)), ["torque_nm", "saturated"]),
        (torque(lambda x: -x), ["torque_nm", "swapped sign"]),
        (one(1, "current_a", lambda x: -x), ["j1.current_a", "opposite sign"]),
        (one(1, "current_a", lambda x: 0.7 * x), ["j1.current_a", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: 0.8 * x), ["j2.motor_velocity_rad_s", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: -x), ["j2.motor_velocity_rad_s", "opposite sign"]),
        (one(1, "link_position_rad", lambda x: -x), ["j1.link_position_rad", "swapped sign"]),
        (one(2, "link_position_rad", lambda x: 1.03 * x), ["j2", "gear ratio"]),
        (one(2, "link_position_rad", lambda x: -x), ["j2.link_position_rad", "expected -1"]),
    ],
)
def test_every_fault_is_named(change: Change, words: list[str]) -> None:
    lines = found(change)
    assert all(len(line.splitlines()) == 1 for line in lines)
    assert any(all(word in line for word in words) for line in lines), lines


def test_a_bench_without_a_sensor_is_not_reproached_for_it() -> None:
    table, points, joints = good_run()
    columns = dict(table.joints)
    without_sensor(columns)
    assert findings(logged(RunTable(table.time_s, columns)), points, joints, sensor=False) == ()


def test_missing_cycles_are_named_above_one_percent_only() -> None:
    table, points, joints = good_run()
    run = logged(table)
    few = replace(run, missed=20, incomplete=10, incomplete_by={"joint 1": 10, "sensor": 0})
    assert findings(few, points, joints, sensor=True) == ()
    many = replace(run, missed=50, incomplete=10, incomplete_by={"joint 1": 10, "sensor": 0})
    (line,) = findings(many, points, joints, sensor=True)
    for word in ("50 without a cycle", "10 incomplete: joint 1 10", "at most 1%"):
        assert word in line


def test_lost_cycles_do_not_make_a_motion_look_wrong() -> None:
    """Rows are compared with the set-point of their own time, not of their number."""
    table, points, joints = good_run()
    keep = np.random.default_rng(1).random(len(table.time_s)) > 0.3
    columns = {
        number: JointColumns(
            **{
                name: None if getattr(joint, name) is None else getattr(joint, name)[keep]
                for name in joint.__slots__
            }
        )
        for number, joint in table.joints.items()
    }
    assert findings(logged(RunTable(table.time_s[keep], columns)), points, joints, sensor=True) == ()


def test_a_gap_that_readers_refuse_makes_a_run_gap_too_long() -> None:
    table, _, _ = good_run()
    assert gap_too_long(logged(table)) is None
    assert gap_too_long(replace(logged(table), longest_gap_s=0.009)) is None
    shifted = np.array(table.time_s)
    shifted[1000:] += 0.024
    why = gap_too_long(logged(RunTable(shifted, table.joints)))
    assert why is not None
    assert "25.0 ms" in why
    assert "at 0.999 s" in why
