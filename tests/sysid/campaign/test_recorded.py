"""The run table of a motion: faults that are found, gaps that are interpolated, logs that cannot be kept."""

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
from jtqd.sysid.campaign.runner import LONGEST_GAP, findings, interpolate_gaps, unusable
from jtqd.sysid.motion.setpoints import Setpoints
from jtqd.sysid.planner.campaigns import plateau_run
from jtqd.sysid.planner.plan import expand
from jtqd.sysid.runs.logs import LoggedRun

GAP_S = 1e-3 * LONGEST_GAP
Change = Callable[[dict[int, JointColumns]], None]


@lru_cache
def good_run() -> tuple[RunTable, Setpoints, tuple[Joint, Joint]]:
    """Joint 2 drives over three points, both directions; as measured on the emulated bench."""
    points = expand(plateau_run("r", 2, [(1.2, 1.0), (1.2, 3.0), (-1.2, -3.0)], 0.8))
    last = len(points) - 1
    current = JointCommand.current(lambda t: float(points.current_a[min(round(t * 1e3), last)]))
    velocity = JointCommand.velocity(lambda t: float(points.velocity_rad_s[min(round(t * 1e3), last)]))
    table = emulate_run(load_plant(shipped("plant.yaml")), (current, velocity), points.duration_s, seed=2)
    return table, points, (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))


def logged(table: RunTable) -> LoggedRun:
    gap = float(np.diff(table.time_s).max())
    return LoggedRun(table, missed=0, incomplete=0, incomplete_by={}, longest_gap_s=gap)


def with_rows(keep: np.ndarray) -> LoggedRun:
    """The good run with some of its rows."""
    table = good_run()[0]
    joints = {number: joint.map(lambda _, column: column[keep]) for number, joint in table.joints.items()}
    return logged(RunTable(table.time_s[keep], joints))


def found(run: LoggedRun | None = None, measured: tuple[int, ...] = (1, 2)) -> tuple[str, ...]:
    table, points, joints = good_run()
    return findings(run or logged(table), points, joints, measured=measured)


def changed(change: Change) -> LoggedRun:
    table = good_run()[0]
    columns = dict(table.joints)
    change(columns)
    return logged(RunTable(table.time_s, columns))


def one(number: int, name: str, change: Callable[[np.ndarray], np.ndarray | None]) -> Change:
    def joint(columns: dict[int, JointColumns]) -> None:
        values = np.array(getattr(columns[number], name))
        columns[number] = replace(columns[number], **{name: change(values)})

    return joint


def both(name: str, change: Callable[[np.ndarray], np.ndarray | None]) -> Change:
    """The same change of both joints, as of the sensor that they share."""

    def joints(columns: dict[int, JointColumns]) -> None:
        for number in (1, 2):
            one(number, name, change)(columns)

    return joints


def absent(_: np.ndarray) -> None:
    return None


def stuck(values: np.ndarray) -> np.ndarray:
    values[1200:2600] = values[1200]
    return values


def one_encoder(columns: dict[int, JointColumns]) -> None:
    both("link_position_rad", absent)(columns)


def one_encoder_and_longer_travel(columns: dict[int, JointColumns]) -> None:
    one_encoder(columns)
    one(2, "motor_position_rad", lambda x: 1.05 * x)(columns)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (both("torque_nm", absent), ["j1.torque_nm", "no value in the whole run"]),
        (both("torque_nm", lambda x: 0.0 * x), ["torque_nm", "exactly zero", "dead channel"]),
        (both("torque_nm", stuck), ["torque_nm", "stuck"]),
        (both("torque_nm", lambda x: np.clip(x, -8.0, 8.0)), ["torque_nm", "saturated"]),
        (both("torque_nm", lambda x: -x), ["torque_nm", "swapped sign"]),
        (one(1, "current_a", lambda x: -x), ["j1.current_a", "opposite sign"]),
        (one(1, "current_a", lambda x: 0.7 * x), ["j1.current_a", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: 0.8 * x), ["j2.motor_velocity_rad_s", "off the set-point"]),
        (one(2, "motor_velocity_rad_s", lambda x: -x), ["j2.motor_velocity_rad_s", "opposite sign"]),
        (one(1, "link_position_rad", lambda x: -x), ["j1.link_position_rad", "swapped sign"]),
        (one(2, "link_position_rad", lambda x: 1.03 * x), ["j2", "gear ratio"]),
        (one(2, "link_position_rad", lambda x: -x), ["j2.link_position_rad", "expected -1"]),
        (one_encoder_and_longer_travel, ["j2.motor_position_rad: through the gear", "-1.049 times"]),
    ],
)
def test_faults_of_a_run_are_found(change, words):
    lines = found(changed(change))
    assert all(len(line.splitlines()) == 1 for line in lines)
    assert any(all(word in line for word in words) for line in lines), lines


def test_a_good_run_has_no_findings():
    assert found() == ()
    assert found(changed(one_encoder)) == ()
    assert found(changed(both("torque_nm", absent)), measured=()) == ()


def test_missing_cycles_are_a_finding_above_one_percent():
    run = replace(logged(good_run()[0]), incomplete=10, incomplete_by={"joint 1": 10, "sensor": 0})
    assert found(replace(run, missed=20)) == ()
    (line,) = found(replace(run, missed=50))
    for word in ("50 without a cycle", "10 incomplete: joint 1 10", "at most 1%"):
        assert word in line


def test_lost_cycles_do_not_make_a_motion_look_wrong():
    """Rows are compared with the set-point of their own time, not of their number."""
    keep = np.random.default_rng(1).random(len(good_run()[0].time_s)) > 0.3
    assert found(with_rows(keep)) == ()


def with_gaps(*gaps: tuple[int, int]) -> LoggedRun:
    """The good run without the rows [first, first + count) of each gap."""
    keep = np.ones(len(good_run()[0].time_s), bool)
    for first, count in gaps:
        keep[first : first + count] = False
    return with_rows(keep)


def test_a_gap_is_interpolated_and_counted():
    table, points, _ = good_run()
    whole, made = interpolate_gaps(with_gaps((1000, 15), (2000, 5)), GAP_S)
    assert made == 15, "readers accept a short gap"
    assert unusable(whole, points, GAP_S) is None
    assert np.abs(np.diff(whole.table.time_s)[990:1020] - 1e-3).max() < 1e-9
    place = slice(1000, 1015)
    for name, worst in (("motor_position_rad", 0.05), ("link_position_rad", 1e-3), ("current_a", 0.5)):
        error = getattr(whole.table.joints[2], name)[place] - getattr(table.joints[2], name)[place]
        assert np.abs(error).max() < worst


@pytest.mark.parametrize("gaps", [((1000, 60),), ((1000, 45), (3000, 45)), ()], ids=["long", "many", "none"])
def test_too_long_or_too_many_gaps_are_not_interpolated(gaps):
    run = with_gaps(*gaps)
    assert interpolate_gaps(run, GAP_S) == (run, 0)
    assert (unusable(run, good_run()[1], GAP_S) is None) == (not gaps)


def test_a_log_with_a_gap_or_without_the_end_of_the_motion_is_not_kept():
    table, points, _ = good_run()
    good = logged(table)
    assert unusable(good, points, GAP_S) is None
    assert unusable(replace(good, longest_gap_s=0.009), points, GAP_S) is None
    shifted = np.array(table.time_s)
    shifted[1000:] += 0.024
    why = unusable(logged(RunTable(shifted, table.joints)), points, GAP_S)
    assert why is not None
    assert "25.0 ms" in why
    assert "at 0.999 s" in why
    why = unusable(with_rows(table.time_s < points.duration_s - 0.2), points, GAP_S)
    assert why is not None
    assert "found the last row of the log at" in why
