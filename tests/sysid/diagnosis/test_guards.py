"""Guards: what fits and is no cause all the same."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.gain import squares_beside
from jtqd.sysid.diagnosis.guards import beyond_bounds
from jtqd.sysid.diagnosis.refine import PresentEffect, free_names


def said(name: str, values: Mapping[str, float], nothing: Mapping[str, float]) -> str:
    effect = EFFECTS[name]
    return beyond_bounds(PresentEffect(effect, 1, values, free_names(effect, values)), dict(nothing))


@pytest.mark.parametrize(
    ("name", "value", "nothing", "why"),
    [
        ("rotor_inertia_kgm2", 1e-9, 6e-5, "rotor_inertia_kgm2 1e-09 kg m2 is at the end"),
        ("rotor_inertia_kgm2", 1e-6, 6e-5, "not physical: the file has 6e-05"),
        ("rotor_inertia_kgm2", 4e-6, 6e-5, ""),
        ("link_inertia_kgm2", -0.02, 0.1, "link_inertia_kgm2 -0.02 kg m2 is at the end"),
        ("torque_constant_nm_per_a", 0.00126, 0.0585, "not physical: the file has 0.0585"),
        ("torque_constant_nm_per_a", 0.061, 0.0585, ""),
        ("viscous_nms_per_rad", 0.0, 2.0, "viscous_nms_per_rad 0 Nms/rad is at the end"),
        ("viscous_nms_per_rad", 0.05, 2.0, ""),
    ],
)
def test_ends_of_what_is_plausible(name: str, value: float, nothing: float, why: str) -> None:
    effect = next(
        e.name for e in EFFECTS.values() if any(p.key.endswith(name) for p in e.parameters if p.key)
    )
    found = said(effect, {name: value}, {name: nothing})
    assert (why in found) if why else not found


def test_a_reference_temperature_out_of_range_is_an_objection_and_no_error() -> None:
    found = said(
        "torque_constant_temperature",
        {"per_k": 1e-4, "reference_c": 811.2124},
        {"per_k": 0.0, "reference_c": 25.0},
    )
    assert "reference_c 811.2" in found


def test_a_part_of_an_effect_that_is_switched_off_is_at_no_bound() -> None:
    values = {"amplitude_nm": 0.374, "share": 0.0, "phase_rad": 0.95}
    assert not said("sensor_crosstalk", values, {"amplitude_nm": 0.0, "share": 0.0, "phase_rad": 0.0})


def test_what_a_run_has_of_its_own_does_not_speak_against_an_effect() -> None:
    """A small loss under a friction of the day that is larger and lies against it: the plain square falls without it."""
    rng = np.random.default_rng(0)
    direction = np.sign(np.sin(np.linspace(0.0, 60.0, 500)))
    loss = 0.2 * np.abs(np.cos(np.linspace(0.0, 17.0, 500))) * direction
    with_it = -0.9 * direction + rng.normal(0.0, 0.05, 500)
    both = np.column_stack((with_it, with_it + loss))
    variance, noise = 0.8, 0.05
    plain, beside = (
        np.sum(both**2, axis=0),
        squares_beside(both, direction[:, None], np.array([noise**2 / variance**2])),
    )
    assert plain[1] < plain[0]
    assert beside[1] > 1.5 * beside[0]
    dense = np.eye(500) + variance**2 / noise**2 * np.outer(direction, direction)
    assert beside == pytest.approx([x @ np.linalg.solve(dense, x) for x in both.T])
