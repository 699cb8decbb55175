"""What the runs of a fit covered: steps in proportion to the joint, and what lies between cells that were driven."""

import numpy as np
import pytest

from jtqd.sysid.fit.envelope import convex, velocity_step


def table(*rows: str) -> np.ndarray:
    return np.array([[cell == "1" for cell in row] for row in rows])


def test_between_two_known_cells_is_known_and_a_corner_beyond_them_is_not() -> None:
    fast_or_heavy = table("00100", "00000", "10001", "00000", "00100")
    assert (convex(fast_or_heavy) == table("00100", "01110", "11111", "01110", "00100")).all()
    assert not convex(fast_or_heavy)[0, 0]


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        (table("000", "010", "000"), table("000", "010", "000")),
        (table("100", "000", "001"), table("100", "010", "001")),
        (table("101", "000", "000"), table("111", "000", "000")),
        (table("10", "00", "10"), table("10", "10", "10")),
        (table("000", "000"), table("000", "000")),
        (table("0110", "1000", "0001"), table("0110", "1110", "0001")),
    ],
)
def test_the_hull_of_few_cells(known: np.ndarray, expected: np.ndarray) -> None:
    assert (convex(known) == expected).all()


def test_the_hull_is_the_smallest_convex_one() -> None:
    """Against all segments between two known cells, in a map of 9 by 9."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        known = rng.uniform(size=(9, 9)) < 0.1
        made = convex(known)
        assert (made >= known).all()
        at = np.argwhere(known)
        for a in at:
            for b in at:
                for part in np.linspace(0.0, 1.0, 25):
                    cell = a + part * (b - a)
                    if (cell == np.rint(cell)).all():
                        assert made[tuple(cell.astype(int))]
        low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (np.zeros(2), np.zeros(2))
        inside = np.argwhere(made)
        assert not len(inside) or ((inside >= low) & (inside <= high)).all()


@pytest.mark.parametrize(
    ("largest", "expected"),
    [(3.0, 0.25), (3.05, 0.25), (2.9, 0.25), (0.5, 0.04), (1.2, 0.1), (25.0, 2.0), (120.0, 10.0)],
)
def test_steps_of_speed_are_in_proportion_to_the_joint(largest: float, expected: float) -> None:
    v = np.linspace(-largest, largest, 40_001)
    assert velocity_step(v) == expected
