"""Scores against the true torque of emulated runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.sysid.evaluate.scores import truth_tables
from jtqd.sysid.runs.tables import read_truth, truth_path, write_truth
from tests.sysid.evaluate.evaluate_helpers import samples

TIME = np.arange(4000) * 1e-3
TORQUE = 20.0 * np.sin(2.0 * np.pi * 0.5 * TIME)


def test_a_zero_of_the_sensor_is_no_error_against_the_truth() -> None:
    """The estimate is 0.5 Nm from the sensor, which is 0.5 Nm off: it is right."""
    one = samples({"fused": np.full(4000, -0.5)}, sensor_nm=TORQUE + 0.5, sigma_nm=0.2)
    tables = truth_tables([replace(one, true_nm=TORQUE)])
    assert tables is not None
    assert tables.now[1]["fused"].rmse_nm == pytest.approx(0.0, abs=1e-12)
    assert tables.aligned[1]["fused"].rmse_nm == pytest.approx(
        0.005 * 20.0 * 2.0 * np.pi * 0.5 / np.sqrt(2.0), rel=0.02
    )
    assert tables.intervals is not None
    shifted = truth_tables([replace(one, true_nm=TORQUE + 2.0)])
    assert shifted is not None
    assert shifted.intervals is not None
    assert shifted.intervals.overall.share < 0.01
    assert shifted.now[1]["fused"].rmse_rated_percent == pytest.approx(5.0)


def test_samples_without_truth_are_in_no_table() -> None:
    one = samples({"fused": np.zeros(4000)}, sensor_nm=TORQUE)
    assert truth_tables([one]) is None
    both = truth_tables([one, replace(one, number=2, true_nm=TORQUE + 1.0)])
    assert both is not None
    assert list(both.now) == [2]


def test_true_torques_are_written_beside_a_run_and_a_broken_file_is_named(tmp_path: Path) -> None:
    run = tmp_path / "a.b.csv.gz"
    assert read_truth(run) == {}
    write_truth(run, {1: TORQUE, 2: -TORQUE})
    assert truth_path(run) == tmp_path / "a.b.truth.npz"
    found = read_truth(run)
    assert np.array_equal(found[1], TORQUE)
    assert np.array_equal(found[2], -TORQUE)
    truth_path(run).write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match="expected true torques"):
        read_truth(run)
