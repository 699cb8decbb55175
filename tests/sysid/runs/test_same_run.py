"""One run in two files is found by its data; runs of the same motion are not taken for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import export
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis import command as diagnose
from jtqd.sysid.runs import RunError, read_runs
from jtqd.sysid.runs.files import same_run, windows
from jtqd.sysid.runs.tables import write_run
from tests.paths import ROOT

LOG = ROOT / "tests" / "golden" / "network.mcap"
COUNT_RAD, LEVEL_A = 2.0 * np.pi / 65536, 0.005


def run(seed: int, rows: int = 20_000, moves: float = 1.0, levels: float = 3.0) -> RunTable:
    """One motion as a drive tells it: counts, and current in steps; moves: part of the time; noise: in steps of current."""
    rng = np.random.default_rng(seed)
    time_s = 1e-3 * np.arange(rows)
    swing = np.sin(np.minimum(2.0 * np.pi * 0.5 * time_s, 2.0 * np.pi * 0.5 * moves * time_s[-1]))
    position = np.round(40.0 * swing / COUNT_RAD) * COUNT_RAD
    current = np.round(swing / LEVEL_A + levels * rng.normal(size=rows) / 3.0) * LEVEL_A
    return RunTable(time_s, {1: JointColumns(current_a=current, motor_position_rad=position)})


def part(table: RunTable, rows: slice, digits: int = 17) -> RunTable:
    """These rows, with so many digits."""

    def told(numbers: np.ndarray | None) -> np.ndarray:
        assert numbers is not None
        return np.array([float(f"{number:.{digits}g}") for number in numbers[rows]])

    return RunTable(
        table.time_s[rows] - table.time_s[rows][0],
        {
            number: JointColumns(
                current_a=told(each.current_a), motor_position_rad=told(each.motor_position_rad)
            )
            for number, each in table.joints.items()
        },
    )


@pytest.mark.parametrize(
    ("rows", "digits"), [(slice(None), 17), (slice(None), 7), (slice(3000, 9000), 9), (slice(5, None), 8)]
)
def test_the_same_samples_are_the_same_run(rows: slice, digits: int) -> None:
    whole = run(1)
    assert same_run(windows(whole), windows(part(whole, rows, digits)))
    assert same_run(windows(part(whole, rows, digits)), windows(whole))


@pytest.mark.parametrize("moves", [1.0, 0.1])
@pytest.mark.parametrize("levels", [3.0, 1.0, 0.0])
def test_runs_of_one_motion_are_not(moves: float, levels: float) -> None:
    """Also with little noise, and mostly at rest; without any noise nobody can tell, so it is not tried."""
    one, two = (windows(run(seed, moves=moves, levels=levels)) for seed in (1, 2))
    if levels:
        assert not same_run(one, two)
    elif moves < 1.0:
        assert not one, "not judged"


def test_other_joints_and_missing_columns_are_not_compared() -> None:
    table = run(1)
    other = RunTable(table.time_s, {2: table.joints[1]})
    assert not same_run(windows(table), windows(other))
    assert windows(RunTable(table.time_s, {1: JointColumns(current_a=table.joints[1].current_a)})) == {}
    assert windows(run(1, rows=100)) == {}


def test_one_joint_that_differs_makes_another_run() -> None:
    one, two = run(1), run(2)
    both = [RunTable(one.time_s, {1: one.joints[1], 2: each.joints[1]}) for each in (one, two)]
    assert not same_run(*map(windows, both))


def test_a_log_and_its_table_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "exported.csv"
    export.main(["csv", str(LOG), "--out", str(table)])
    capsys.readouterr()
    with pytest.raises(RunError, match=r"exported\.csv: found the same run as in network\.mcap"):
        read_runs([LOG, table], segments=True)
    joint = str(ROOT / "models" / "joint1.yaml")
    assert diagnose.main([str(LOG), str(table), "--joint", joint, "--out", str(tmp_path / "d")]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "expected every run once" in told


def test_a_table_of_all_cycles_is_the_same_run_without_its_blank_cells(tmp_path: Path) -> None:
    table = tmp_path / "all.csv"
    export.main(["csv", str(LOG), "--out", str(table), "--all-cycles"])
    [found] = read_runs([table], segments=True)
    assert "193 of 1050 rows left out for a blank cell ('j1.temperature_c' in 193" in found.notes[0]
    with pytest.raises(RunError, match=r"found the same run as in network\.mcap"):
        read_runs([LOG, table], segments=True)


def test_two_runs_are_read(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_run(tmp_path / f"{seed}.csv", run(seed, rows=3000))
    assert len(read_runs([tmp_path])) == 2
