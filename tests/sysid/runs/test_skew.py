"""When a shift in time of a whole channel is believed: where it takes away half of what is left over."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs import time_base
from tests.estimator.effects.effect_signals import PLAIN


@pytest.mark.parametrize(("left", "late_s"), [(0.02, 0.105), (0.031, None)])
def test_a_shift_is_believed_that_takes_away_half(
    monkeypatch: pytest.MonkeyPatch, left: float, late_s: float | None
) -> None:
    """0.051 in step and 0.031 after 0.105 s were those of slow motions with stiction, whose channels were in step."""
    t = np.arange(0.0, 20.0, 1e-3)
    velocity = np.sin(t)
    columns = JointColumns(current_a=velocity, motor_velocity_rad_s=100.0 * velocity, torque_nm=np.cos(t))

    def residual_shares(_q: object, _y: object, shifts: int) -> np.ndarray:
        curve = np.full(shifts, 0.051)
        curve[shifts // 2 + 21] = left
        return curve

    monkeypatch.setattr(time_base, "_residual_shares", residual_shares)
    found = time_base.skew_s(RunTable(t, {1: columns}), 1, PLAIN)
    assert found == (late_s if late_s is None else pytest.approx(late_s))
