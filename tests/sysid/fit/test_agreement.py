"""Section `fused.agreement`: levels of unseen runs, and none where nothing can be told."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.agreement import QUANTILE, fit_agreement
from jtqd.sysid.fit.fused import fit_fused
from tests.sysid.fit.test_fused import emulated


def test_levels_are_quantiles_over_all_blocks() -> None:
    source = np.random.default_rng(3)
    runs = [tuple(source.uniform(0.0, most, 1000) for most in (4.0, 1.0, 0.02, 0.5)) for _ in range(3)]
    found = fit_agreement(runs)  # type: ignore[arg-type]
    assert found is not None
    assert found.slow_nm == pytest.approx(np.sqrt(4.0 * QUANTILE), rel=0.03)
    assert found.fast_nm == pytest.approx(np.sqrt(QUANTILE), rel=0.03)
    assert found.gain == pytest.approx(0.02 * QUANTILE, rel=0.03)
    assert found.zero_nm == pytest.approx(0.5 * QUANTILE, rel=0.03)


def test_too_little_motion_has_no_levels() -> None:
    short = tuple(np.ones(150) for _ in range(4))
    assert fit_agreement([short]) is None  # type: ignore[list-item]


def test_the_fit_writes_levels_of_the_size_of_its_own_errors() -> None:
    joint = load_joint(shipped("joint1.yaml"))
    runs = [emulated(7000 + k, 6.0, day=k)[0] for k in range(8)]
    fused = fit_fused(runs, joint.friction, joint.rated_torque_nm).fused
    assert fused.agreement is not None
    assert fused.torsion is not None
    assert 0.2 * fused.sigma.torsion_nm < fused.agreement.slow_nm < 10.0 * fused.sigma.current_nm
    assert fused.agreement.gain < 0.05
    assert fit_fused(runs, joint.friction).fused.agreement is None  # nothing is known of the joint's size
