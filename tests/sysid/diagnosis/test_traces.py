"""Traces for plots: what is measured in each balance, beside the residual of the simulation."""

from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.findings import EVERYTHING
from jtqd.sysid.diagnosis.unexplained import remaining, traces
from tests.sysid.diagnosis.diagnose_helpers import bench_run

JOINT = load_joint(shipped("joint1.yaml"))


def test_measured_less_simulated_is_the_residual_of_each_balance() -> None:
    """The file's Coulomb friction is 1 Nm too small: the simulated motor torque is so much below the measured one."""
    friction = replace(JOINT.friction, coulomb_nm=JOINT.friction.coulomb_nm - 1.0)
    # the runs are made without inertia and efficiency
    wrong = replace(JOINT, friction=friction, efficiency=None, rotor_inertia_kgm2=1e-9, link_inertia_kgm2=0.0)
    runs = [(f"r{k}", bench_run(phase=0.7 * k, numbers=(1,))) for k in range(3)]
    usable, _ = usable_signals(runs, {1: wrong}, (1,))
    dataset = build_dataset(usable, {1: wrong}, EVERYTHING)
    left = remaining(dataset, [], np.zeros((len(runs), len(dataset.families))))
    found = {(t.run, t.balance): t for t in traces(left)}
    assert set(found) == {(name, balance) for name, _ in runs for balance in ("motor", "torsion")}
    for name, table in runs:
        columns = table.joints[1]
        assert columns.torque_nm is not None
        motor, torsion = found[name, "motor"], found[name, "torsion"]
        current = np.interp(motor.time_s, table.time_s, columns.current_a)
        sensor = np.interp(motor.time_s, table.time_s, columns.torque_nm)
        scale = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
        known = np.isfinite(motor.before_nm)
        assert known.mean() > 0.5
        assert motor.measured_nm[known] == pytest.approx(scale * current[known], abs=0.2)
        apart = motor.measured_nm - motor.before_nm - (scale * current - np.sign(motor.velocity_rad_s))
        assert np.sqrt(np.mean(apart[known] ** 2)) < 0.3
        assert torsion.measured_nm == pytest.approx(sensor, abs=0.3)
