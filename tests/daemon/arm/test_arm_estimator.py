"""External torque against MuJoCo: motions of the Panda whose joint torques, pushes and payloads MuJoCo computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from jtqd.daemon.arm.estimator import ArmEstimate, ArmEstimator, ArmNoise
from jtqd.daemon.arm.model import ArmModel, Payload
from jtqd.estimator.errors import ConfigError
from tests.daemon.arm import small_arm
from tests.daemon.arm.panda import JOINTS, PERIOD_S, Motion, Push, model_text, moved, new_model
from validation.arm.arm import TOOL, rigid
from validation.arm.arm import Payload as TruePayload

SIGMA = np.array([0.4, 0.4, 0.4, 0.4, 0.06, 0.06, 0.06])
RNG = np.random.default_rng


NOISE = ArmNoise(np.full(7, 0.8), 0.5, np.array([[1.2], [0.9], [0.7]]) * np.ones(7), np.full(7, 1e-6))


def run(
    motion: Motion,
    *,
    payload: Payload | None = None,
    noise: ArmNoise = NOISE,
    errors: np.ndarray | float = 0.0,
    change: Callable[[int, np.ndarray, np.ndarray], None] | None = None,
) -> list[ArmEstimate]:
    estimator = ArmEstimator(new_model(), PERIOD_S, noise, payload)
    made = []
    torque = motion.torque_nm + errors
    for k in range(len(torque)):
        position, value = motion.position_rad[k].copy(), torque[k].copy()
        if change is not None:
            change(k, position, value)
        made.append(estimator.step(position, value, np.where(np.isfinite(value), SIGMA, np.nan)))
    return made


def stacked(made: list[ArmEstimate], name: str) -> np.ndarray:
    return np.array([getattr(each, name) for each in made])


def test_mechanics_are_those_of_mujoco() -> None:
    rng, model = RNG(3), new_model()
    true = TruePayload(2.0, (0.01, -0.02, 0.06))
    model.set_payload(Payload(*true))
    other: Any = rigid(payload=true)
    data = mujoco.MjData(other)
    cube = 2.0 * 0.1**2 / 6.0  # MuJoCo's payload has an inertia about its centre
    for _ in range(5):
        q, v, a = rng.normal(size=(3, 7))
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(other, data)
        assert model.torque(q, v, a) == pytest.approx(data.qfrc_inverse, abs=20.0 * cube)
        model.place(q)
        jacobian = np.zeros((6, 7))
        mujoco.mj_jacSite(other, data, jacobian[:3], jacobian[3:], other.site("tool").id)
        assert model.tool_jacobian() == pytest.approx(jacobian, abs=1e-12)
        made, normal = model.surface_jacobians()
        for p in rng.integers(len(normal), size=20):
            link = int(model.surface.link[p])
            point = data.xpos[link] + data.xmat[link].reshape(3, 3) @ model.surface.point_m[p]
            one = np.zeros((3, 7))
            mujoco.mj_jac(other, data, one, None, point, link)
            assert made[p] == pytest.approx(one.T, abs=1e-12)
        model.set_payload(Payload())
        assert model.regressor(q, v, a) @ model.inertial().ravel() == pytest.approx(model.torque(q, v, a))
        model.set_payload(Payload(*true))


def test_a_free_motion_has_no_external_torque() -> None:
    motion = moved(800)
    external = stacked(run(motion, payload=Payload()), "external_nm")[100:]
    assert np.abs(external / SIGMA).max() < 0.1


def test_external_torque_and_wrench_are_what_pushes_with_its_sign() -> None:
    push = Push(7, (0.0, 0.0, 0.1), (5.0, -12.0, 8.0), 300, 800)
    motion = moved(800, push=push)
    made = run(motion, payload=Payload())
    at = 360
    assert made[at].external_nm == pytest.approx(motion.external_nm[at - 13], abs=0.1)
    assert made[at].wrench[:3] == pytest.approx(push.force_n, abs=0.7)
    assert made[at].wrench == pytest.approx(motion.wrench[at - 13], abs=0.7)
    assert (np.abs(stacked(made, "external_nm")[200:300]) < 0.1 * SIGMA).all()
    # after 20 ms of the full force 4 of 5 parts are there
    assert (
        made[330].external_nm @ motion.external_nm[330]
        > 0.8 * motion.external_nm[330] @ motion.external_nm[330]
    )


def test_sigma_is_what_the_noise_says() -> None:
    made = run(moved(200), payload=Payload(), noise=NOISE._replace(offset=0.0))
    assert made[-1].sigma_nm == pytest.approx(0.8 * SIGMA, rel=0.02)
    made = run(moved(200), payload=Payload(), noise=NOISE._replace(offset=0.6))
    assert made[-1].sigma_nm == pytest.approx(SIGMA, rel=0.02)
    shaken = run(
        moved(200), payload=Payload(), noise=NOISE._replace(offset=0.0, position_rad=np.full(7, 1e-4))
    )
    assert (shaken[-1].sigma_nm[:2] > 1.5 * made[-1].sigma_nm[:2]).all()


def test_the_payload_is_learned_and_its_sigma_is_honest() -> None:
    rng = RNG(5)
    for seed, payload in ((11, TruePayload(2.0, (0.02, -0.03, 0.07))), (12, TruePayload())):
        motion = moved(6000, payload=payload, seed=seed)
        offsets = 0.5 * SIGMA * rng.normal(size=7)
        made = run(motion, errors=offsets)[-1]
        assert abs(made.payload_kg - payload.mass_kg) < min(3.0 * made.payload_sigma_kg, 0.15)
        assert made.payload_sigma_kg < 0.1
        if payload.mass_kg:
            assert made.centre_m == pytest.approx(payload.centre_m, abs=0.01)
        assert np.abs(made.external_nm / SIGMA).max() < 0.8


def test_before_it_is_known_an_unknown_payload_is_no_contact() -> None:
    made = run(moved(2500, payload=TruePayload(3.0, (0.0, 0.05, 0.1)), seed=13))
    assert not stacked(made, "contact").any()
    assert made[70].sigma_nm[1] > 5.0  # it may be 5 kg
    assert made[2400].sigma_nm[1] < 1.0


@pytest.mark.parametrize("link", [3, 5, 7])
def test_a_push_is_reported_with_link_point_and_force(link: int) -> None:
    model, data = new_model(), mujoco.MjData(rigid())
    surface = model.surface
    model.place(moved(1, seed=20 + link, still=True).position_rad[0])
    jacobian, normal = model.surface_jacobians()
    lever = np.abs(np.einsum("pnk,pk->pn", jacobian, normal) / SIGMA).max(axis=1)
    p = int(np.argmax(np.where(surface.link == link, lever, 0.0)))
    force = -20.0 * surface.normal[p]
    first = 400
    motion = moved(first + 450, seed=20 + link, still=True)
    data.qpos[:] = motion.position_rad[first]
    mujoco.mj_kinematics(rigid(), data)
    turn = data.xmat[link].reshape(3, 3)
    push = Push(link, tuple(surface.point_m[p]), tuple(turn @ force), first, first + 200)
    motion = moved(first + 450, seed=20 + link, still=True, push=push)
    made = run(motion, payload=Payload(), errors=0.2 * SIGMA * RNG(link).normal(size=motion.torque_nm.shape))
    contact = stacked(made, "contact")
    assert not contact[:first].any()
    assert contact[first + 40]
    assert not contact[-20:].any()
    at = made[first + 150]
    assert at.contact == link
    off = np.linalg.norm(at.point_m - surface.point_m[p])
    assert off < 2.0 * at.point_sigma_m
    assert link == 3 or off < 0.06
    assert at.strength_n == pytest.approx(20.0, rel=0.4)
    assert abs(at.since_cycle - first) < 50


def test_a_clamp_that_takes_seconds_is_a_contact_by_its_level() -> None:
    push = Push(6, (0.0, 0.0, 0.0), (0.0, 0.0, -25.0), 500, 3400, rise=2500)
    made = stacked(run(moved(3600, push=push), payload=Payload()), "contact")
    assert not made[:500].any()
    assert made[2900:3300].all()
    assert not made[3540:].any()


def test_a_payload_that_is_taken_ends_the_contact() -> None:
    cycles, first = 9000, 500
    without, taken = moved(cycles), moved(cycles, payload=TruePayload(1.5, (0.0, 0.0, 0.05)))
    torque = np.where(np.arange(cycles)[:, None] < first, without.torque_nm, taken.torque_nm)
    estimator = ArmEstimator(new_model(), PERIOD_S, NOISE)
    estimator.belief.covariance[:4, :4] = np.diag([1e-4, 1e-6, 1e-6, 1e-6])  # believed: nothing
    made = [estimator.step(q, x, SIGMA) for q, x in zip(without.position_rad, torque, strict=True)]
    contact = stacked(made, "contact")
    assert contact[first + 100 : first + 4500].all()
    assert not contact[-1000:].any()
    assert made[-1].payload_kg == pytest.approx(1.5, abs=0.1)


def test_a_hand_that_holds_on_is_no_payload() -> None:
    push = Push(7, (0.0, 0.0, 0.1), (20.0, 0.0, 0.0), 500, 9000)
    made = run(moved(9000, push=push), payload=None, noise=NOISE)
    # from the start it is believed that nothing hangs there
    estimator = ArmEstimator(new_model(), PERIOD_S, NOISE)
    estimator.belief.covariance[:4, :4] = np.diag([1e-4, 1e-6, 1e-6, 1e-6])
    motion = moved(9000, push=push)
    made = [estimator.step(q, x, SIGMA) for q, x in zip(motion.position_rad, motion.torque_nm, strict=True)]
    assert stacked(made, "contact")[600:].all()
    assert made[-1].payload_kg < 0.1


def test_a_joint_without_torque_leaves_what_the_others_tell() -> None:
    push = Push(7, (0.0, 0.0, 0.1), (0.0, 20.0, 5.0), 600, 900)

    def silent(k: int, position: np.ndarray, torque: np.ndarray) -> None:
        if 300 <= k < 1100:
            torque[2] = np.nan

    motion = moved(1300, push=push)
    made = run(motion, payload=Payload(), change=silent)
    external = stacked(made, "external_nm")
    assert np.isnan(external[300:1100, 2]).all()
    assert np.isfinite(np.delete(external[100:], 2, axis=1)).all()
    assert np.isfinite(external[1150:]).all()
    contact = stacked(made, "contact")
    assert not contact[:600].any()
    assert contact[650:850].all()
    assert not contact[1100:].any()
    assert np.delete(made[700].external_nm, 2) == pytest.approx(
        np.delete(motion.external_nm[687], 2), abs=0.2
    )
    assert made[700].wrench == pytest.approx(motion.wrench[687], abs=2.0)


def test_without_one_joint_the_others_learn_the_payload() -> None:
    def silent(k: int, position: np.ndarray, torque: np.ndarray) -> None:
        torque[4] = np.nan

    made = run(moved(6000, payload=TruePayload(2.0, (0.02, -0.03, 0.07)), seed=11), change=silent)[-1]
    assert made.payload_kg == pytest.approx(2.0, abs=0.1)
    assert np.isfinite(np.delete(made.external_nm, 4)).all()
    assert np.isnan(made.external_nm[4])


def test_without_a_position_there_is_nothing() -> None:
    def gap(k: int, position: np.ndarray, torque: np.ndarray) -> None:
        if 300 <= k < 310:
            position[4] = np.nan

    made = run(moved(500), payload=Payload(), change=gap)
    for each in made[300:310]:
        assert np.isnan(each.external_nm).all()
        assert np.isnan(each.wrench).all()
        assert not each.contact
    assert np.isfinite(made[-1].external_nm).all()
    assert not stacked(made, "contact").any()


def test_a_pose_that_cannot_tell_has_no_wrench() -> None:
    motion = moved(120, still=True)
    straight = motion._replace(position_rad=np.zeros_like(motion.position_rad))  # the arm stretched upwards
    made = run(straight, payload=Payload())[-1]
    assert made.conditioning > 30.0
    assert np.isnan(made.wrench).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: "<robot", ("URDF", "XML")),
        (lambda text: "<sdf/>", ("<sdf>", "<robot>")),
        (
            lambda text: text.replace(
                'name="panda_joint3" type="revolute"', 'name="panda_joint3" type="prismatic"'
            ),
            ("panda_joint3", "revolute"),
        ),
        (lambda text: text.replace("panda_joint3", "elbow"), ("panda_joint3", "elbow")),
        (lambda text: text.replace(TOOL, "tip"), (TOOL, "tool")),
        (lambda text: __import__("re").sub(r'<mass value="[^"]*"', '<mass value="0"', text), ("mass",)),
    ],
)
def test_a_urdf_that_does_not_fit_is_refused_in_one_line(
    change: Callable[[str], str], words: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigError) as error:
        ArmModel(change(model_text()), JOINTS, TOOL)
    assert "\n" not in str(error.value)
    assert all(word in str(error.value) for word in words)


def small_runs(
    joints: list[str], change: Callable[[int, np.ndarray, np.ndarray, np.ndarray], None]
) -> list[ArmEstimate]:
    """Estimates of the small arm, or of a part of it, in motion."""
    model = ArmModel(small_arm.URDF, joints, "flange")
    estimator, n = ArmEstimator(model, PERIOD_S, payload=Payload()), len(joints)
    rate, made = 1.0 + np.arange(n), []
    for k in range(1200):
        phase = rate * PERIOD_S * k
        q, v, a = 0.5 * np.sin(phase), 0.5 * rate * np.cos(phase), -0.5 * rate**2 * np.sin(phase)
        torque, sigma = model.torque(q, v, a), np.full(n, 0.4)
        change(k, q, torque, sigma)
        made.append(estimator.step(q, torque, sigma))
    return made


def test_an_arm_of_one_joint_has_an_external_torque_and_no_wrench() -> None:
    def pushed(k: int, position: np.ndarray, torque: np.ndarray, sigma: np.ndarray) -> None:
        torque -= 8.0 * (k >= 800)

    made = small_runs(["shoulder"], pushed)
    assert abs(made[700].external_nm[0]) < 0.05
    assert made[900].external_nm == pytest.approx([8.0], abs=0.05)
    assert made[900].contact == 1
    assert not stacked(made[:800], "contact").any()
    assert np.isnan(made[900].wrench).all()
    assert made[900].conditioning == np.inf


def test_a_position_that_lacks_a_turn_pushes_nothing() -> None:
    def turned(k: int, position: np.ndarray, torque: np.ndarray, sigma: np.ndarray) -> None:
        position[0] -= 2.0 * np.pi * (k >= 600)

    made = small_runs(["shoulder", "elbow"], turned)
    external = stacked(made, "external_nm")
    assert np.nanmax(np.abs(external)) < 0.05
    assert np.isnan(external[600:640]).all()
    assert np.isfinite(external[700:]).all()
    assert not stacked(made, "contact").any()


@pytest.mark.parametrize("value", [0.0, -0.4, 5e-324, np.inf, np.nan])
def test_a_torque_without_a_sigma_that_can_be_is_none(value: float) -> None:
    def without(k: int, position: np.ndarray, torque: np.ndarray, sigma: np.ndarray) -> None:
        if k >= 600:
            sigma[0] = value

    made = small_runs(["shoulder", "elbow"], without)
    assert np.isnan(made[-1].external_nm[0])
    assert np.isnan(made[-1].sigma_nm[0])
    assert abs(made[-1].external_nm[1]) < 0.05
    assert not stacked(made, "contact").any()


def test_without_any_torque_no_contact_is_told() -> None:
    def lost(k: int, position: np.ndarray, torque: np.ndarray, sigma: np.ndarray) -> None:
        torque -= 8.0 * (k >= 600)
        torque += np.nan if 800 <= k < 1000 else 0.0

    contact = stacked(small_runs(["shoulder", "elbow"], lost), "contact")
    assert contact[700:800].all()
    assert not contact[800:1000].any()
    assert contact[1100:].all()


def test_what_was_learned_just_before_a_contact_is_taken_back() -> None:
    push = Push(
        7, (0.0, 0.0, 0.1), (0.0, 0.0, -12.0), 3000, 5000, rise=1900
    )  # it leans: like a payload that grows
    motion = moved(5000, push=push)
    estimator = ArmEstimator(new_model(), PERIOD_S, NOISE)
    made = [estimator.step(q, x, SIGMA) for q, x in zip(motion.position_rad, motion.torque_nm, strict=True)]
    contact = stacked(made, "contact") > 0
    first = int(np.argmax(contact))
    assert 3000 < first < 4600
    before, after = made[first - 60], made[first + 120]
    assert abs(after.payload_kg - made[2900].payload_kg) < 0.6 * abs(
        before.payload_kg - made[2900].payload_kg
    )


def test_at_rest_nothing_is_learned() -> None:
    estimator = ArmEstimator(new_model(), PERIOD_S, NOISE)
    motion = moved(1500, payload=TruePayload(1.0, (0.0, 0.0, 0.05)), still=True)
    positions = motion.position_rad + 1e-6 * RNG(6).normal(size=motion.position_rad.shape)
    made = [estimator.step(q, x, SIGMA) for q, x in zip(positions, motion.torque_nm, strict=True)]
    assert made[-1].payload_sigma_kg == made[0].payload_sigma_kg
    assert made[-1].payload_kg == 0.0


def test_residuals_of_before_follow_what_is_learned() -> None:
    motion = moved(1200, payload=TruePayload(2.0, (0.02, -0.03, 0.07)), seed=11)
    estimator = ArmEstimator(new_model(), PERIOD_S, NOISE)
    last, off, learned = np.full(7, np.nan), [], []
    for q, x in zip(motion.position_rad, motion.torque_nm, strict=True):
        before = estimator.belief.hung
        made = estimator.step(q, x, SIGMA)
        off.append(np.abs(made.external_nm - last).max())
        learned.append(np.abs(estimator.belief.hung - before).max())
        last = estimator.detector.smooth[0].copy()
    assert np.nanmax(learned) > 0.5  # kg at once
    assert np.nanmax(off[70:]) < 0.3
