"""Identification of an arm whose links MuJoCo knows: Panda with other masses and centres than its URDF."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from jtqd.daemon.arm.model import Payload
from jtqd.sysid.arm.identification import (
    CENTRE_M,
    DETERMINED,
    Body,
    FreeMotion,
    identify,
    noise_of,
    normal_of,
)
from tests.daemon.arm.panda import PERIOD_S, moved, new_model
from validation.arm.arm import Payload as TruePayload
from validation.arm.arm import links

SIGMA = np.array([0.4, 0.4, 0.4, 0.4, 0.06, 0.06, 0.06])
SHAKEN = 1.2e-5


def other_links() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(71)
    way = rng.normal(size=(len(links()), 3))
    return 1.0 + 0.1 * rng.choice([-1.0, 1.0], len(links())), 0.005 * way / np.linalg.norm(
        way, axis=1, keepdims=True
    )


@cache
def runs(offset: float = 0.5) -> list[FreeMotion]:
    made = []
    for seed in range(4):
        payload = TruePayload(2.0, (0.01, -0.02, 0.06)) if seed % 2 else TruePayload()
        factors, shifts = other_links()
        motion = moved(12000, payload=payload, seed=seed, factors=factors, shifts_m=shifts)
        rng = np.random.default_rng([seed, 72])
        errors = SIGMA * (offset * rng.normal(size=7) + 0.6 * rng.normal(size=motion.torque_nm.shape))
        position = motion.position_rad + SHAKEN * rng.normal(size=motion.position_rad.shape)
        sigma = np.broadcast_to(SIGMA, motion.torque_nm.shape)
        made.append(FreeMotion(PERIOD_S, position, motion.torque_nm + errors, sigma, Payload(*payload)))
    return made


def test_held_out_torque_is_several_times_better_than_by_cad() -> None:
    model = new_model()
    normals = [normal_of(model, each) for each in runs(0.0)]
    found = identify(model, normals[:2])
    factors, shifts = other_links()
    clean = moved(4000, seed=9, factors=factors, shifts_m=shifts)
    other = normal_of(
        model, FreeMotion(PERIOD_S, clean.position_rad, clean.torque_nm, np.broadcast_to(SIGMA, (4000, 7)))
    )
    before, after = other.left_nm(model.inertial()), other.left_nm(found.inertial)
    assert after[1] < 0.25 * before[1]
    assert (after < 1.1 * before + 0.01).all()
    assert (before / SIGMA)[1] > 1.0


def test_offsets_of_runs_are_no_part_of_the_links() -> None:
    model = new_model()
    without, beside = (
        identify(model, [normal_of(model, each) for each in runs(size)]).inertial for size in (0.0, 0.5)
    )
    moments = [each[1:4] for each in np.abs(without - beside)]
    assert max(float(each.max()) for each in moments) < 0.02  # kg m; an offset of half a sigma is 0.2 Nm


def test_what_motion_cannot_tell_stays_at_its_cad_value() -> None:
    model = new_model()
    found = identify(model, [normal_of(model, each) for each in runs()])
    cad = model.inertial()
    assert found.relative[0, 0] > 0.99  # the first link turns about a vertical axis: its mass moves nothing
    assert found.inertial[0, 0] == pytest.approx(cad[0, 0], rel=3e-3)
    assert (found.relative < DETERMINED).any()
    assert (found.relative <= 1.0 + 1e-9).all()


def test_every_result_is_a_body_that_can_exist() -> None:
    model = new_model()
    found = identify(model, [normal_of(model, each) for each in runs()])
    rng = np.random.default_rng(5)
    every = [*found.inertial, *(Body(each).theta(rng.normal(size=10)) for each in model.inertial())]
    impossible = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.1, 0.0, 0.0, 0.1])  # xx > yy + zz
    for theta in (*every, Body(impossible).theta(np.zeros(10))):
        xx, xy, yy, xz, yz, zz = theta[4:]
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = 0.5 * np.trace(about) * np.eye(3) - about
        pseudo = np.block([[second, theta[1:4, None]], [theta[None, 1:4], np.array([[theta[0]]])]])
        assert np.linalg.eigvalsh(pseudo).min() > 0.0


def test_at_zero_a_body_is_that_of_cad() -> None:
    for theta in new_model().inertial():
        assert Body(theta).theta(np.zeros(10)) == pytest.approx(theta, rel=1e-9, abs=1e-5)
        heavier = Body(theta).theta(np.array([np.log(1.1), *np.zeros(9)]))
        assert heavier == pytest.approx(1.1 * theta, rel=1e-9, abs=1e-5)
        moved_by = Body(theta).theta(np.array([0.0, CENTRE_M, *np.zeros(8)]))
        assert moved_by[1] / moved_by[0] == pytest.approx(theta[1] / theta[0] + CENTRE_M)


def test_noise_is_what_free_motion_leaves() -> None:
    factors, shifts = other_links()
    model, made = new_model(), []
    for seed in range(2):
        motion = moved(20000, seed=seed, factors=factors, shifts_m=shifts)
        rng = np.random.default_rng([seed, 73])
        keep = np.exp(-PERIOD_S / 0.1)
        slow = np.zeros((20000, 7))
        for k in range(1, 20000):
            slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(size=7)
        position = motion.position_rad + SHAKEN * rng.normal(size=motion.position_rad.shape)
        torque = motion.torque_nm + SIGMA * (0.5 * rng.normal(size=7) + 0.6 * slow)
        made.append(FreeMotion(PERIOD_S, position, torque, np.broadcast_to(SIGMA, torque.shape)))
    model.set_inertial(identify(model, [normal_of(model, each) for each in made]).inertial)
    noise = noise_of(model, made)
    assert noise.position_rad == pytest.approx(np.full(7, SHAKEN), rel=0.05)
    assert 0.25 < noise.offset < 0.75
    assert noise.total == pytest.approx(np.full(7, 0.6), abs=0.12)
    # changes of such an error: sqrt(2 (1 - exp(-0.04 / 0.1))) and almost all of it within 0.3 s
    assert noise.tests[0] == pytest.approx(np.full(7, 0.6 * np.sqrt(2.0 * (1.0 - np.exp(-0.4)))), abs=0.12)
    assert noise.tests[1] == pytest.approx(np.full(7, 0.65), abs=0.15)
