"""The state of an estimator continues in another one where it is valid there; the offsets as text."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.estimator.estimator import Estimator, FusedEstimator, make_estimator
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import LEARNED, PAST_LAYOUT, TRACKED, Zeros, same_past
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


def test_where_limits_and_sigmas_differ_the_state_is_valid_and_the_estimate_continues() -> None:
    old = learned()
    fused = replace(NARROW.fused, sigma=replace(NARROW.fused.sigma, torsion_nm=0.3))  # type: ignore[union-attr, type-var]
    new = make_estimator(replace(NARROW, fused=fused), replace(ON, torque_limit=2.0))
    assert same_past(old, new)
    assert isinstance(old, FusedEstimator)
    assert isinstance(new, FusedEstimator)
    new.past = old.past
    assert new.zeros is not None
    assert old.zeros is not None
    assert new.zeros.link_rad == old.zeros.link_rad
    row = [float(each[-1]) for each in driven(link_zero_rad=2e-4)[0]]
    assert new.step(*row).physics_nm == pytest.approx(old.step(*row).physics_nm, abs=0.05)


def test_with_the_same_parameters_it_continues_bit_by_bit() -> None:
    old, new = learned(), FusedEstimator(NARROW, ON)
    assert same_past(old, new)
    new.past = old.past  # type: ignore[attr-defined]
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
def test_where_the_parameters_of_the_learning_differ_the_state_is_not_valid(name: str) -> None:
    assert not same_past(learned(), make_estimator(*changed(name)))
    assert not same_past(make_estimator(*changed(name)), learned())


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
