"""The detector alone: residuals of one joint whose noise is known."""

from __future__ import annotations

import numpy as np

from jtqd.daemon.arm.contact import BEGINS, LONG_S, Detector, quantile

PERIOD_S = 1e-3
SPREAD = np.array([[0.7], [0.6], [0.45]])
NO_BELIEF = np.zeros((3, 1, 1))


def contacts(residual: np.ndarray, belief: np.ndarray = NO_BELIEF) -> list[tuple[int, int]]:
    """First cycles of contact and the first after it."""
    detector = Detector(1, PERIOD_S, SPREAD)
    on = [detector.add(np.array([x]), np.ones(1), belief) for x in residual]
    edges = np.flatnonzero(np.diff(np.array([False, *on, False]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def test_a_push_on_an_error_of_the_pose_ends_although_the_arm_is_in_another_pose() -> None:
    residual = np.full(3500, -1.2)  # sigmas: less than a contact
    residual[:600] = 1.2
    residual[600:1300] = -8.8
    ((first, end),) = contacts(residual)
    assert 600 <= first <= 605
    assert 1300 <= end <= 600 + 1000 * LONG_S + 200


def test_a_weak_push_is_one_contact_as_long_as_it_lasts() -> None:
    residual = np.zeros(1500)
    residual[500:1100] = 4.0  # beyond a sudden change's limit, below that of a level at its edge
    ((first, end),) = contacts(residual)
    assert 500 <= first <= 510
    assert 1100 <= end <= 1250


def test_what_is_believed_is_no_contact() -> None:
    residual = np.zeros(1500)
    residual[500:1100] = 4.0
    assert not contacts(residual, np.full((3, 1, 1), 1.0))


def test_the_limit_is_a_quantile_of_chi_square() -> None:
    chi = {1: 26.3, 3: 33.2, 7: 43.3}  # exceeded with the probability of 5 sigma, 2.87e-7, by scipy
    for freedom, exact in chi.items():
        assert 0.97 * exact < quantile(float(freedom), BEGINS) < 1.2 * exact  # never more alarms than that
