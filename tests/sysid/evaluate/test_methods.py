"""Methods that a directory of models allows: ours without its network is its physics, one method and not two."""

from pathlib import Path

import numpy as np

from jtqd.sysid.evaluate.inputs import read_inputs
from jtqd.sysid.evaluate.methods import load_models
from tests.sysid.evaluate.evaluate_helpers import make_bench


def test_ours_without_a_network_is_the_physics_of_ours_with_one(tmp_path: Path) -> None:
    models = make_bench(tmp_path) / "models"
    with_network = load_models(models)
    (run,) = read_inputs([tmp_path / "runs" / "variable_1.csv.gz"], with_network).runs
    for n in (1, 2):
        (models / f"joint{n}.fused.onnx").unlink()
    without = load_models(models)
    for both, alone in zip(with_network, without, strict=True):
        assert {"physics", "fused"} <= {*both.methods}
        assert "fused" in alone.methods
        assert "physics" not in alone.methods
        assert "physics" in alone.missing
        time_s, columns = run.table.time_s, run.columns[both.number]
        expected, found = (each.estimate(time_s, columns)[0] for each in (both, alone))
        assert np.isfinite(found["fused"].torque_nm).mean() > 0.9
        np.testing.assert_array_equal(found["fused"].torque_nm, expected["physics"].torque_nm)
