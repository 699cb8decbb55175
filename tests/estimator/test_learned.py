"""What an estimator has learned goes on in another one where it is true, and is told for a reader."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.estimator.estimator import ExtendedEstimator, FusedEstimator
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.learned import FORGOTTEN, KEPT, LEARNED, NOTHING, PAST_LAYOUT, TRACKED, Zeros, hand_over
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.sample import Estimator
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.test_fused_estimator import NARROW
from tests.estimator.test_zeros import ON, driven

EFFECT = Effect("viscous_friction", {"viscous_nms_per_rad": 1.0})


def learned(joint: Joint = NARROW, settings: EstimatorSettings = ON) -> Estimator:
    """An estimator that has found a zero of 200 µrad."""
    estimator = make_estimator(joint, settings)
    estimator.run(*driven(link_zero_rad=2e-4)[0])
    return estimator


def test_the_layout_of_the_past_is_the_one_of_its_number() -> None:
    """Where this fails, what logs hold means something else: count `PAST_LAYOUT` up, then change the size here."""
    size = len(FusedEstimator(NARROW, ON).past)
    assert (PAST_LAYOUT, size) == (6, 1520)
    assert size <= 8 * PAST_WORDS, "snapshot and log have room for it"


@pytest.mark.parametrize("effects", [(), (EFFECT,)])
def test_where_limits_and_sigmas_change_all_is_kept_and_the_estimate_goes_on(
    effects: tuple[Effect, ...],
) -> None:
    joint = replace(NARROW, effects=effects)
    old = learned(joint)
    fused = replace(joint.fused, sigma=replace(joint.fused.sigma, torsion_nm=0.3))  # type: ignore[union-attr, type-var]
    new = make_estimator(replace(joint, fused=fused), replace(ON, torque_limit=2.0))
    assert hand_over(old, new) == KEPT
    assert isinstance(new, FusedEstimator | ExtendedEstimator)
    assert new.zeros is not None
    assert new.zeros.link_rad == old.zeros.link_rad  # type: ignore[attr-defined]
    columns = driven(link_zero_rad=2e-4)[0]
    row = [float(each[-1]) for each in columns]
    assert new.step(*row).physics_nm == pytest.approx(old.step(*row).physics_nm, abs=0.05)


def test_a_network_alone_changes_nothing_bit_by_bit() -> None:
    old, new = learned(), make_estimator(NARROW, ON)
    assert hand_over(old, new) == KEPT
    columns = driven(link_zero_rad=2e-4)[0]
    assert new.run(*columns).torque_nm.tobytes() == old.run(*columns).torque_nm.tobytes()


def changed(name: str) -> tuple[Joint, EstimatorSettings]:
    fused = NARROW.fused
    assert fused is not None
    assert fused.torsion is not None
    return {
        "stiffness": (replace(NARROW, fused=replace(fused, torsion=replace(fused.torsion, stiffness_nm_per_rad=1.1e4))), ON),
        "zero": (replace(NARROW, fused=replace(fused, torsion=replace(fused.torsion, zero_rad=1e-4))), ON),
        "loss": (replace(NARROW, fused=replace(fused, loss=replace(fused.loss, viscous_per_k=0.003))), ON),
        "torque constant": (replace(NARROW, torque_constant_nm_per_a=0.063), ON),
        "bandwidth": (NARROW, replace(ON, bandwidth_rad_s=150.0)),
        "effects": (replace(NARROW, effects=(EFFECT,)), ON),
        "not tracked": (NARROW, replace(ON, track_zeros=False)),
        "another method": (NARROW, EstimatorSettings(method="tob")),
    }[name]  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["stiffness", "zero", "loss", "torque constant", "bandwidth", "effects", "not tracked", "another method"],
)
def test_where_what_it_was_learned_with_changes_it_is_forgotten(name: str) -> None:
    new = make_estimator(*changed(name))
    before = getattr(new, "zeros", None)
    assert hand_over(learned(), new) == FORGOTTEN
    assert getattr(new, "zeros", None) == before


def test_where_nothing_was_learned_nothing_is_said() -> None:
    fresh = make_estimator(NARROW, ON)
    assert hand_over(fresh, make_estimator(NARROW, ON)) == NOTHING
    assert hand_over(fresh, make_estimator(*changed("loss"))) == NOTHING
    assert hand_over(make_estimator(*changed("not tracked")), make_estimator(NARROW, ON)) == NOTHING


def test_a_past_of_another_length_is_refused() -> None:
    estimator = FusedEstimator(NARROW, ON)
    with pytest.raises(ValueError, match="found a block of 8 bytes"):
        estimator.past = bytes(8)


def test_zeros_in_words() -> None:
    zeros = Zeros(1.02e-4, 9e-6, 9.8e-5, 0.01, 0.02, 0.0, 2e-3, TRACKED | LEARNED, 1)
    assert zeros.text == "link +102 µrad, sigma 9 µrad, +98 µrad taken off; jumped once"
    assert (
        zeros._replace(flags=TRACKED, jumps=0).text == "link not learned yet: the joint has to move both ways"
    )
    assert zeros._replace(flags=0).text == ""
    assert zeros._replace(flags=0).content() is None
    estimator = FusedEstimator(NARROW, replace(ON, track_zeros=False))
    assert estimator.zeros is None
    assert np.isfinite(estimator.run(*driven(0.5)[0]).torque_nm[-1])
