"""What the runs of a fit covered: steps in proportion to the joint."""

import numpy as np
import pytest

from jtqd.sysid.fit.envelope import envelope_of, velocity_step


@pytest.mark.parametrize(
    ("largest", "expected"),
    [(3.0, 0.25), (3.05, 0.25), (2.9, 0.25), (0.5, 0.04), (1.2, 0.1), (25.0, 2.0), (120.0, 10.0)],
)
def test_steps_of_speed_are_in_proportion_to_the_joint(largest: float, expected: float) -> None:
    v = np.linspace(-largest, largest, 40_001)
    assert velocity_step(v) == expected


def test_a_slow_joint_is_outside_of_its_speeds_a_tenth_beyond_them() -> None:
    """With the step of the shipped joints its map would go to twice its speed."""
    v = 0.5 * np.sin(np.linspace(0.0, 60.0, 20_000))
    made = envelope_of(
        v, 2.0 * v, np.zeros_like(v) + 0.1, [25.0], velocity_step_rad_s=velocity_step(v), torque_step_nm=0.3
    )
    visited = np.flatnonzero(np.array(made.known).any(axis=1)) - len(made.known) // 2
    assert 0.5 <= (visited.max() + 0.5) * made.velocity_step_rad_s <= 0.55
