"""The goals' row of the measured arm: what is best is taken from the table, and what was not fitted is in no count."""

import math

import numpy as np
import pytest

from jtqd.sysid.goals import kinova
from jtqd.sysid.goals.kinova import Row, markdown

SIMPLE = {"current": 0.9, "tob_load": 0.7, "tob_fitted": 1.5}


def row(tob: float, inside: float, fused: float | None = None) -> Row:
    rmse = {"tob": tob, **SIMPLE} | ({} if fused is None else {"fused": fused})
    told = {"tob": inside} | ({} if fused is None else {"fused": inside})
    return Row(4, "a", "b", rmse, told, {"tob": math.nan})


def test_ours_is_compared_with_the_best_of_the_baselines() -> None:
    lines = markdown([row(0.7, 90.0), row(0.71, 84.0, fused=0.6)])
    assert lines[2] == "| 4, a | 0.700 | - | 0.900 | **0.700** | 1.500 | 90 %, - | -, - |"
    assert lines[-2].startswith(
        "- `tob`: error at most that of the best simple regression in 1 of 2; interval 85 to 95 % in 1 of 2"
    )
    assert lines[-1].startswith(
        "- `fused`: error at most that of the best simple regression in 1 of 1; interval 85 to 95 % in 0 of 1; "
        "not fitted in 1: too little motion"
    )


def test_of_the_shipped_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """Every joint both ways, and nobody is fitted on what judges."""
    assert kinova.main([]) == 0
    table = capsys.readouterr().out
    assert len([line for line in table.splitlines() if line.startswith("| ")]) == 1 + 4
    assert "of 4; interval 85 to 95 % in" in table


def test_pieces_are_the_run() -> None:
    from jtqd.models.files import load_joint, shipped
    from jtqd.sysid.fit.signals import run_signals

    columns = kinova.ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    file = kinova.read_run(shipped("kinova_gen3/RunTrajectory1.csv.gz"), columns)
    joint = load_joint(columns.joint_files[4])
    one = kinova._one_encoder(file.table.joints[4], joint)
    run = run_signals("a", joint, kinova.EstimatorSettings(method="tob"), file.table.time_s, one)
    pieces = kinova.pieces_of(run, 5)
    assert len(pieces) == 5
    np.testing.assert_array_equal(np.concatenate([each.seen.raw_nm for each in pieces]), run.seen.raw_nm)
    np.testing.assert_array_equal(np.concatenate([each.sensor_nm for each in pieces]), run.sensor_nm)
