"""Operating envelope of a fit: steps in proportion to the joint, and a map as wide as held-out runs need."""

import numpy as np
import pytest

from jtqd.estimator.joint import Envelope
from jtqd.estimator.native_network import envelope_weights
from jtqd.sysid.fit.fused import BEYOND_SHARE, MOST_WIDER, envelope_of, velocity_step, widened


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


STEPS = {"velocity_step_rad_s": 0.25, "torque_step_nm": 3.0}


def runs(count: int, most_nm: float, seed: int = 1) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each with loads of its own, up to most_nm, over speeds up to 3 rad/s."""
    source = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 4000)
    return [
        (
            3.0 * np.sin(2.0 * np.pi * source.integers(5, 9) * t),
            source.uniform(0.3, 1.0) * most_nm * np.sin(2.0 * np.pi * t + source.uniform(0.0, 6.28)),
        )
        for _ in range(count)
    ]


def covered(made: Envelope, of: list[tuple[np.ndarray, np.ndarray]]) -> float:
    return float(np.mean([np.mean(envelope_weights(made, v, raw) >= 0.5) for v, raw in of]))


def test_the_map_is_as_much_wider_in_load_as_held_out_runs_need() -> None:
    """Few runs have shown little of what the next one will do, many have; the map never grows in speed."""
    wider = {}
    for count in (8, 60):
        seen, others = runs(count, 40.0), runs(60, 40.0, seed=2)
        v, raw = (np.concatenate(each) for each in zip(*seen, strict=True))
        made = envelope_of(v, raw, np.ones_like(v), [25.0], **STEPS)
        found = widened(made, seen)
        wider[count] = (len(found.known[0]) - len(made.known[0])) // 2
        assert covered(found, others) >= covered(made, others)
        assert len(found.known) == len(made.known)
        assert np.array_equal(np.any(found.known, axis=1), np.any(made.known, axis=1))
        if wider[count] < MOST_WIDER:
            assert covered(found, others) > 1.0 - 2.0 * BEYOND_SHARE
    assert wider[8] > 0
    assert wider[60] < wider[8] or wider[60] == 0


def test_a_wider_map_has_one_cell_more_on_either_side_of_each_row() -> None:
    made = Envelope(0.25, 3.0, ((0, 0, 0), (0, 1, 0), (0, 0, 0)), 4.0, None)
    still = (np.zeros(30), np.zeros(30)), (np.zeros(30), np.full(30, 3.0))
    known = np.array(
        widened(made, still).known
    )  # the second run is a cell beyond the first, and the first beyond the second
    assert known[1].tolist() == [0, 1, 1, 1, 0]
    assert not known[[0, 2]].any()
