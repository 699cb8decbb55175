"""Jumps at changes of quadrant: known steps, swings that are followed late, spikes, rests and gaps."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.sysid.evaluate.methods import Samples
from jtqd.sysid.evaluate.scores import crossings, jumps_around, largest_jump
from tests.sysid.evaluate.evaluate_helpers import samples


def test_a_crossing_is_found_once_although_noise_crosses_zero_often() -> None:
    seed = 2
    rng = np.random.default_rng(seed)
    x = np.linspace(-1.0, 1.0, 2001) + rng.normal(0.0, 0.02, 2001)
    found = crossings(x, 0.1)
    assert len(found) == 1, seed
    assert abs(found[0].at - 1000) < 60
    assert found[0].start <= found[0].at <= found[0].end
    # approaches, turns round, leaves to the side it came from: no crossing; a step over the whole band: one
    assert crossings(np.abs(x) + 0.05, 0.1) == []
    assert [(c.start, c.at, c.end) for c in crossings(np.array([-1.0, -1.0, 1.0, 1.0]), 0.1)] == [(2, 2, 2)]


def _reversal(step_nm: float, swing_nm: float = 0.0, late: int = 0) -> Samples:
    """1 s with v = 0 in the middle: the estimate steps there, the sensor swings (in 20 ms), the estimate follows late."""
    n = 1001
    k = np.arange(n)
    swing = swing_nm * np.clip((k - 490) / 20.0, 0.0, 1.0)
    estimate = swing_nm * np.clip((k - 490 - late) / 20.0, 0.0, 1.0) + step_nm * (k >= 500)
    v = np.linspace(-0.5, 0.5, n) + 1e-6  # positive from sample 500 on
    return samples({"fused": estimate - swing}, sensor_nm=5.0 + swing, velocity_rad_s=v)


@pytest.mark.parametrize("step", [0.3, -2.0])
def test_a_step_at_a_reversal_is_a_jump_of_its_size(step: float) -> None:
    jump = largest_jump([_reversal(step)], "fused")
    assert jump is not None
    assert jump.nm == pytest.approx(abs(step))
    assert (jump.of, jump.crossings) == ("v = 0", 1)
    assert jump.time_s == pytest.approx(0.5, abs=0.011)
    assert largest_jump([_reversal(step)], "tob") is None


def test_what_the_torque_itself_does_is_no_jump_even_when_it_is_followed_late() -> None:
    followed = largest_jump([_reversal(0.0, swing_nm=10.0)], "fused")
    late = largest_jump([_reversal(0.0, swing_nm=10.0, late=5)], "fused", passage=True)
    both = largest_jump([_reversal(3.0, swing_nm=10.0)], "fused")
    assert followed is not None
    assert late is not None
    assert both is not None
    assert followed.nm <= 1e-9
    assert late.nm <= 1e-9
    assert late.unshifted_nm == pytest.approx(2.5, abs=0.3)  # 5 of 20 samples
    assert both.nm == pytest.approx(3.0)


def test_a_spike_within_the_window_is_seen_and_one_elsewhere_is_not() -> None:
    spike = np.zeros(1001)
    spike[505] = 4.0
    v = np.linspace(-0.5, 0.5, 1001)
    at = largest_jump([samples({"fused": spike}, velocity_rad_s=v)], "fused")
    assert at is not None
    assert at.nm == pytest.approx(4.0)
    away = largest_jump([samples({"fused": np.roll(spike, 200)}, velocity_rad_s=v)], "fused", passage=True)
    assert away is not None
    assert away.nm == 0.0


def test_jumps_are_shown_beside_what_is_usual_in_motion() -> None:
    """A spike every 100 ms is in a fifth of the windows: as usual as at the one crossing in two."""
    n = 10_001
    error = np.where(np.arange(n) % 100 == 50, 0.7, 0.0)
    v = np.sin(2.0 * np.pi * (np.arange(n) - 50) / 2500.0)  # 8 crossings, each at a spike
    found = largest_jump([samples({"fused": error}, velocity_rad_s=v)], "fused")
    assert found is not None
    assert found.crossings == 8
    assert found.nm == found.elsewhere_nm == pytest.approx(0.7)  # 1 of 8 < 1 of 5
    calm = largest_jump(
        [samples({"fused": np.where(np.arange(n) == 50, 0.7, 0.0)}, velocity_rad_s=v)], "fused"
    )
    assert calm is not None
    assert calm.elsewhere_nm == 0.0


def test_a_passage_includes_entry_and_exit_of_a_long_rest() -> None:
    v = np.concatenate((np.full(200, -0.5), np.zeros(600), np.full(200, 0.5)))
    error = np.where(np.arange(1000) < 203, 0.0, 1.5)  # steps as it comes to rest
    runs = [samples({"fused": error}, velocity_rad_s=v)]
    assert largest_jump(runs, "fused").nm == 0.0  # type: ignore[union-attr]  # zero is crossed at 800
    assert largest_jump(runs, "fused", passage=True).nm == pytest.approx(1.5)  # type: ignore[union-attr]


def test_jumps_are_not_taken_over_gaps() -> None:
    estimate = np.zeros(100)
    estimate[50] = np.nan
    jump = jumps_around(estimate, np.zeros(100), 21)
    assert np.isnan(jump[40:61]).all()
    assert (jump[10:40] == 0.0).all()
    assert np.isnan(jump[:10]).all()
