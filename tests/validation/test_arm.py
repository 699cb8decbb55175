"""The foreign arm: that it shares nothing with what is judged on it, and its physics against closed forms and balances."""

from __future__ import annotations

import ast
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest

from tests.paths import ROOT
from validation.arm import arm as plant
from validation.arm.arm import (
    CYCLE_S,
    JOINTS,
    Arm,
    Contact,
    Payload,
    Run,
    Silence,
    Trains,
    Truth,
    no_joints,
    read,
    rigid,
)
from validation.arm.baseline import Baseline, Dynamics, best_payload
from validation.arm.judge import tool_jacobians
from validation.arm.trial import (
    ERRORS,
    FORCE_N,
    LEARN_S,
    LEVER_M,
    Drawer,
    Trial,
    coloured,
    error_process,
)

POSE = np.array([0.3, 0.4, -0.2, -1.6, 0.5, 1.9, 0.4])
LIGHT = np.array([0.3, -0.3, 0.0, -2.2, 0.0, 2.0, 0.4])
LOAD = Payload(2.5, (0.02, -0.03, 0.05))
PUSHES = (
    Contact("push", 1.0, 1.01, 1.3, 7, (0.03, 0.04, 0.12), (12.0, -14.0, 9.0)),
    Contact("clamp", 1.6, 2.2, 2.6, 4, (-0.05, 0.05, 0.02), (-8.0, 25.0, 10.0)),
)


def swing(seconds: float, size: float = 0.4) -> np.ndarray:
    t = CYCLE_S * np.arange(round(seconds / CYCLE_S))
    waves = (
        np.sin(2.0 * np.pi * t[:, None] / np.linspace(1.7, 2.9, JOINTS))
        * (1.0 - np.exp(-((t / 0.5) ** 3)))[:, None]
    )
    return np.asarray(POSE + size * waves)


@cache
def pushed() -> tuple[Arm, Run, Truth]:
    arm = Arm("typical", 5)
    run = Run(0, swing(3.0), LOAD, PUSHES)
    return arm, run, arm.record([run])[0]


def test_it_imports_nothing_of_the_product_and_no_pinocchio() -> None:
    allowed = {"__future__", "collections", "functools", "itertools", "pathlib", "typing", "xml"}
    allowed |= {"numpy", "scipy", "mujoco", "yaml", "validation.arm", "validation.study"}
    for name in ("arm", "trial", "judge", "baseline"):
        tree = ast.parse((ROOT / "validation" / "arm" / f"{name}.py").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found = {each.name for each in node.names}
            elif isinstance(node, ast.ImportFrom):
                found = {node.module or ""}
            else:
                continue
            for each in found:
                assert (
                    each.split(".")[0] in allowed or each.rpartition(".")[0] in allowed or each in allowed
                ), each


def test_true_bodies_are_as_far_off_the_file_as_stated() -> None:
    arm, file = Arm("typical", 5), mujoco.MjSpec.from_file(str(plant.URDF))
    given = np.array([file.body(name).mass for name in plant.links()])
    assert np.abs(arm.factors - 1.0) == pytest.approx(np.full(len(given), plant.MASS_OFF))
    assert np.linalg.norm(arm.shifts_m, axis=1) == pytest.approx(np.full(len(given), plant.CENTRE_OFF_M))
    assert arm.model(Payload()).body_mass.sum() == pytest.approx(float(arm.factors @ given))
    assert arm.model(LOAD).body_mass.sum() == pytest.approx(float(arm.factors @ given) + LOAD.mass_kg)
    assert not np.allclose(arm.factors, Arm("typical", 6).factors)
    for k, name in enumerate(plant.links()[:6]):  # the seventh has the hand and the payload with it
        moved = arm.model(LOAD).body(name).ipos - rigid().body(name).ipos
        assert moved == pytest.approx(arm.shifts_m[k])


def test_a_payload_weighs_at_its_centre() -> None:
    zero = np.zeros((1, JOINTS))
    with_load, without = (
        Dynamics(rigid(payload=each)).inverse(POSE[None], zero, zero) for each in (LOAD, None)
    )
    model = rigid()
    data = mujoco.MjData(model)
    data.qpos[:] = POSE
    mujoco.mj_kinematics(model, data)
    force = LOAD.mass_kg * model.opt.gravity
    lever = data.site("tool").xmat.reshape(3, 3) @ np.array(LOAD.centre_m)
    wrench = np.concatenate((force, np.cross(lever, force)))
    assert (without - with_load)[0] == pytest.approx(tool_jacobians(POSE[None])[0].T @ wrench, abs=1e-9)


def test_at_rest_the_gears_carry_the_weight_of_the_true_bodies() -> None:
    arm = Arm("typical", 5)
    truth = arm.record([Run(0, np.repeat(POSE[None], 1500, axis=0), LOAD)])[0]
    dynamics = Dynamics(arm.model(LOAD))
    at, zero = truth.link_rad[-1:], np.zeros((1, JOINTS))
    weight = dynamics.inverse(at, zero, zero)[0]
    assert truth.drive_nm[-100:].mean(axis=0) == pytest.approx(weight, abs=0.02, rel=1e-3)
    believed = Dynamics(rigid(payload=LOAD)).inverse(at, zero, zero)[0]
    assert np.abs(believed - weight).max() > 0.5, "the file's bodies could not be told from the true ones"


def test_generalised_momentum_is_what_drives_gravity_and_contacts_make_of_it() -> None:
    arm, _, truth = pushed()
    momentum, beta = Dynamics(arm.model(LOAD)).momentum(truth.link_rad, truth.link_rad_s)
    force = truth.drive_nm + truth.external_nm + beta
    made = np.cumsum(0.5 * (force[1:] + force[:-1]), axis=0) * CYCLE_S
    off = momentum[1:] - momentum[0] - made
    moved = np.ptp(momentum, axis=0)
    assert (np.abs(off).max(axis=0) < 0.01 * moved + 1e-4).all()
    without = np.abs(off + np.cumsum(truth.external_nm[1:], axis=0) * CYCLE_S).max(axis=0)
    assert (without > 5.0 * np.abs(off).max(axis=0)).sum() >= 6, "the contacts would not be seen"


def test_work_of_contacts_is_the_work_of_their_joint_torques() -> None:
    arm, run, truth = pushed()
    model = arm.model(LOAD)
    data = mujoco.MjData(model)
    for contact in run.contacts:
        for k in (round(1000 * contact.full_s) + 5, round(1000 * contact.end_s) - 5):
            places = []
            for q in (truth.link_rad[k - 1], truth.link_rad[k + 1]):
                data.qpos[:] = q
                mujoco.mj_kinematics(model, data)
                turn = data.xmat[contact.link].reshape(3, 3)
                places.append(data.xpos[contact.link] + turn @ np.array(contact.point_m))
                force = turn @ np.array(contact.force_n)
            moved = truth.link_rad[k + 1] - truth.link_rad[k - 1]
            assert truth.external_nm[k] @ moved == pytest.approx(
                float(force @ (places[1] - places[0])), rel=0.02, abs=1e-5
            )
            assert not truth.external_nm[k, contact.link :].any()
    before = round(1000 * run.contacts[0].start_s)
    assert not truth.external_nm[: before + 1].any()
    assert np.abs(truth.external_nm[before + 5]).max() == pytest.approx(
        0.5 * np.abs(truth.external_nm[before + 10]).max(), rel=0.02
    )


def test_a_push_of_the_tool_is_its_wrench() -> None:
    _, run, truth = pushed()
    k = round(1000 * run.contacts[0].full_s) + 50
    jacobian = tool_jacobians(truth.link_rad[k : k + 1])[0]
    assert jacobian.T @ truth.wrench[k] == pytest.approx(truth.external_nm[k], abs=1e-3)
    assert np.linalg.norm(truth.wrench[k, :3]) == pytest.approx(np.linalg.norm(run.contacts[0].force_n))
    assert not truth.wrench[round(1000 * run.contacts[1].full_s) + 50].any()


def energy(arm: Arm, truth: Truth, payload: Payload) -> np.ndarray:
    """Kinetic and potential energy of links and rotors and that of the springs [n], for straight springs."""
    model = arm.model(payload)
    data = mujoco.MjData(model)
    momentum, _ = Dynamics(model).momentum(truth.link_rad, truth.link_rad_s)
    kinetic = 0.5 * (momentum * truth.link_rad_s).sum(axis=1)
    height = np.zeros(len(kinetic))
    for k, q in enumerate(truth.link_rad):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        height[k] = -model.opt.gravity[2] * (model.body_mass @ data.xipos[:, 2])
    rotor = arm.size * arm.law["motor"]["rotor_inertia_kgm2"] * arm.ratio**2
    speed = np.gradient(truth.motor_rad, CYCLE_S, axis=0) / arm.ratio
    torsion = truth.motor_rad / arm.ratio - truth.link_rad
    stiffness = arm.size * arm.law["gear"]["stiffness_nm_per_rad"][0]
    springs = 0.5 * (rotor * speed**2 + stiffness * torsion**2).sum(axis=1)
    return np.asarray(kinetic + height + springs)


def plain(**changes: dict[str, float]) -> Arm:
    """A typical arm with straight springs and without losses, waves or saturation, but for what is changed."""
    arm = Arm("typical", 5)
    gear, friction = arm.law["gear"], arm.law["friction"]
    gear["stiffness_nm_per_rad"] = np.repeat(gear["stiffness_nm_per_rad"][:1], 3, axis=0)
    gear["damping_nms_per_rad"] *= 0.0
    gear["slips"] = tuple(factor * each for factor, each in zip((0.0, 1.0), gear["slips"], strict=True))
    arm.law["motor"]["saturation_share"] *= 0.0
    arm.law["motor"]["torque_constant_per_k"] *= 0.0
    friction["coulomb_nm"] = friction["coulomb_nm"] * 1e-9
    for key in ("load_nm", "viscous_nm"):
        friction[key] *= 0.0
    arm.of_motor.weights[:] = 0.0
    for section, values in changes.items():
        for key, value in values.items():
            arm.law[section][key] = arm.law[section][key] + value
    return arm


def balance(arm: Arm) -> tuple[np.ndarray, float, Truth]:
    """Energy [J, n] that motors and a contact put in and that is not there; the most that was exchanged."""
    truth = arm.record([Run(0, swing(1.6), LOAD, PUSHES[:1])])[0]
    constant = arm.law["motor"]["torque_constant_nm_per_a"]
    speed = np.gradient(truth.motor_rad, CYCLE_S, axis=0)
    power = (constant * truth.current_a * speed + truth.external_nm * truth.link_rad_s).sum(axis=1)
    put = np.concatenate(([0.0], np.cumsum(0.5 * (power[1:] + power[:-1])) * CYCLE_S))
    there = energy(arm, truth, LOAD)
    return (put - (there - there[0]))[1:-1], float(np.ptp(put)), truth


def test_energy_is_kept_without_losses_and_lost_to_friction() -> None:
    lost, exchanged, _ = balance(plain())
    assert exchanged > 5.0
    assert np.abs(lost).max() < 0.005 * exchanged
    arm = plain(friction={"viscous_nm": 1.0})
    lost, _, truth = balance(arm)
    speed = np.abs(np.gradient(truth.motor_rad, CYCLE_S, axis=0)) / arm.ratio
    day = Trains(arm, {key: value[None] for key, value in arm.day(0).items()})
    rubbed = (day.viscous * speed ** (1.0 + arm.law["friction"]["viscous_exponent"])).sum() * CYCLE_S
    assert rubbed > 0.1 * exchanged
    assert lost[-1] == pytest.approx(rubbed, rel=0.02)


def dragged(arm: Arm, speed: float, torque: float, celsius: float = 25.0) -> np.ndarray:
    """Friction [7] of joints that are kept at a speed under a torque, as a share of rated."""
    day = {key: np.zeros((1, JOINTS)) for key in arm.days}
    day["temperature_k"] = np.full((1, JOINTS), celsius - 25.0)
    trains = Trains(arm, day)
    trains.start(np.zeros((1, JOINTS)), np.zeros((1, JOINTS)))
    for _ in range(2000):
        trains.velocity = np.full((1, JOINTS), speed)
        trains.push(1e-4, np.zeros((1, JOINTS)), torque * arm.rated_nm[None])
    return np.asarray(trains.rubbing[0] / arm.size)


def test_friction_slides_as_its_law_says() -> None:
    arm = Arm("typical", 5)
    arm.of_motor.weights[:] = 0.0
    p = arm.law["friction"]
    peak = (p["static_ratio"] - 1.0) * np.exp(
        -((0.5 / p["stribeck_velocity_rad_s"]) ** p["stribeck_exponent"])
    )
    for speed in (0.5, -0.5):
        for load in (0.6, -0.6, 0.0):
            level = p["coulomb_nm"] * (1.0 + peak) + p["load_nm"] * abs(load) ** p["load_exponent"]
            level *= 1.0 + np.sign(speed) * p["direction_share"]
            wanted = np.sign(speed) * (level + p["viscous_nm"] * 0.5 ** p["viscous_exponent"])
            assert dragged(arm, speed, load) == pytest.approx(wanted, rel=1e-3), (speed, load)
    hot, cold = dragged(arm, 1.5, 0.0, 45.0), dragged(arm, 1.5, 0.0, 5.0)
    assert (hot < 0.75 * cold).all()


def test_friction_falls_while_the_arm_works() -> None:
    arm = Arm("bad_day", 5)
    day = {key: np.zeros((1, JOINTS)) for key in arm.days}
    trains = Trains(arm, day)
    before = trains.viscous.copy(), trains.coulomb.copy()
    for _ in range(1200):
        trains.heat_j = np.full((1, JOINTS), 10.0 * 0.1) * arm.size
        trains.warm(0.1)
    warmed = trains.grease - 25.0
    assert warmed == pytest.approx(np.full((1, JOINTS), 10.0 * 0.4 * (1.0 - np.exp(-1.0))), rel=0.15)
    assert (trains.viscous < 0.95 * before[0]).all()
    assert trains.coulomb == pytest.approx(before[1] * (1.0 - 0.003 * warmed))


def test_hysteresis_and_kinematic_error_are_in_the_gear() -> None:
    arm = Arm("bad_day", 5)
    day = {key: np.zeros((1, JOINTS)) for key in arm.days}
    trains = Trains(arm, day)
    still = np.zeros((1, JOINTS))
    torques = []
    for size in (
        2e-3,
        -2e-3,
        0.0,
        -2e-3,
        2e-3,
        0.0,
    ):  # motor beside the link, joint side; back at zero from both sides
        trains.start(still, still) if not torques else None
        for share in np.linspace(0.0, 1.0, 40):
            trains.motor = (
                trains.motor + share * 0.0 + (arm.ratio * (size - trains.motor / arm.ratio)) * share
            )
            trains.turn(0.0, still)
        torques.append(trains.torque(still)[0] / arm.size)
    assert (np.abs(torques[2] - torques[5]) > 0.5).all()
    trains.start(still, still)
    errors = []
    for turn in np.linspace(0.0, 2.0 * np.pi, 41):
        trains.motor = np.full((1, JOINTS), turn)
        trains.turn(0.0, trains.motor / arm.ratio)
        errors.append(trains.torsion[0])
    assert np.ptp(errors, axis=0) == pytest.approx(np.full(JOINTS, 2.6e-4), rel=0.5)


def test_instruments_read_with_counts_and_the_errors_of_the_day() -> None:
    arm, run, truth = pushed()
    readings = read(arm, run, truth, lambda *_: (truth.drive_nm, truth.drive_nm, truth.drive_nm))
    day = arm.day(0)
    unit = 2.0 * np.pi / 524288
    silent = read(
        arm, run._replace(silences=(Silence(2, 0.5, 0.7),)), truth, lambda *_: (truth.drive_nm,) * 3
    )
    lost = np.isnan(silent.torque_nm)
    assert np.array_equal(np.flatnonzero(lost.any(axis=1)), np.arange(500, 700))
    assert np.array_equal(np.flatnonzero(lost.any(axis=0)), [2])
    assert (silent.status[500:700, 2] == plant.NO_TORQUE).all()
    assert readings.link_rad / unit == pytest.approx(np.round(readings.link_rad / unit), abs=1e-6)
    waves = 5.5e-5
    assert np.abs(readings.link_rad - truth.link_rad - day["link_zero_rad"]).max() < waves + 6.0 * 6e-6
    assert np.abs(readings.motor_rad - truth.motor_rad - day["motor_zero_rad"]).max() < 3.2e-3
    off = (readings.current_a - (1.0 + day["current_gain"]) * truth.current_a) / arm.size - day[
        "current_zero_a"
    ]
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert (off.std(axis=0) > 0.009).all()
    assert np.abs(readings.motor_rad_s - np.gradient(truth.motor_rad, CYCLE_S, axis=0))[10:].std() < 3.0


def test_on_a_towing_bench_every_joint_is_alone_with_its_load() -> None:
    arm = Arm("typical", 7)
    load = 0.4 * arm.rated_nm * np.sin(np.arange(800) / 150.0)[:, None]
    truth = arm.tow([Run(1, swing(0.8))], load[None])[0]
    assert truth.external_nm == pytest.approx(-load)
    force = 0.5 * (truth.drive_nm[1:] + truth.drive_nm[:-1]) + truth.external_nm[:-1]
    made = np.cumsum(force, axis=0) * CYCLE_S / (arm.size * 0.0175)
    off = truth.link_rad_s[1:] - truth.link_rad_s[0] - made
    assert (np.abs(off).max(axis=0) < 0.1 * np.ptp(truth.link_rad_s, axis=0)).all()
    assert np.abs(truth.drive_nm - load).max() < 0.3 * arm.rated_nm.max()


def test_a_run_is_the_same_alone_and_beside_others() -> None:
    arm = Arm("typical", 7)
    path = swing(0.3)
    runs = [Run(3, path, LOAD), Run(4, path[::-1].copy(), Payload())]
    both, alone = arm.record(runs), arm.record(runs[1:])
    assert both[1].drive_nm == pytest.approx(alone[0].drive_nm, abs=1e-7)
    assert not np.allclose(both[0].drive_nm, both[1].drive_nm)


@pytest.mark.parametrize("plant_name", ERRORS)
def test_joints_are_as_wrong_as_they_say(plant_name: str) -> None:
    arm = Arm(plant_name, 5)
    t = CYCLE_S * np.arange(20000)
    angle = 0.5 * t[:, None] * np.ones(JOINTS)
    zero = np.zeros_like(angle)
    truth = Truth(angle, zero, zero, zero, zero[:, :6], arm.ratio * angle, zero, zero)
    days = [error_process(arm, Run(d, angle), truth, np.random.default_rng(d), plant_name) for d in range(60)]
    shares = np.array([torque / sigma for torque, sigma, _ in days])
    assert np.sqrt(np.mean(shares**2)) == pytest.approx(1.0, rel=0.1)
    size, parts = ERRORS[plant_name]
    assert sum(parts) == pytest.approx(1.0)
    assert days[0][1][0] == pytest.approx(size * arm.rated_nm)
    means = shares.mean(axis=1)
    assert np.mean(means**2) == pytest.approx(parts[0] + parts[2] * 0.05, abs=0.07)
    noise = coloured(np.random.default_rng(1), 200000, 0.05)
    assert noise.std() == pytest.approx(1.0, rel=0.03)
    assert np.mean(noise[50:] * noise[:-50]) == pytest.approx(np.exp(-1.0), abs=0.05)


def test_motions_and_contacts_are_drawn_within_their_limits() -> None:
    trial = Trial("typical", 38001, 0)
    run, again, other = trial.contact(0), trial.contact(0), trial.contact(1)
    assert np.array_equal(run.reference_rad, again.reference_rad)
    assert run.contacts == again.contacts
    assert not np.array_equal(run.reference_rad, other.reference_rad)
    bound = plant.limits()
    for each in (run, other):
        assert (each.reference_rad > bound["low_rad"]).all()
        assert (each.reference_rad < bound["high_rad"]).all()
        assert (np.abs(np.diff(each.reference_rad, axis=0)) < bound["rad_s"] * CYCLE_S).all()
        assert each.contacts[0].start_s > LEARN_S
        gaps = [b.start_s - a.end_s for a, b in zip(each.contacts, each.contacts[1:], strict=False)]
        assert min(gaps) > 0.5
    model = rigid()
    data = mujoco.MjData(model)
    for contact in run.contacts:
        if contact.kind in ("push", "clamp"):
            data.qpos[:] = run.reference_rad[round(contact.full_s / CYCLE_S)]
            mujoco.mj_forward(model, data)
            turn, jacobian = data.xmat[contact.link].reshape(3, 3), np.zeros((3, JOINTS))
            point = data.xpos[contact.link] + turn @ np.array(contact.point_m)
            mujoco.mj_jac(model, data, jacobian, None, point, contact.link)
            force = turn @ np.array(contact.force_n)
            assert np.linalg.norm(force) == pytest.approx(FORCE_N)
            assert np.abs(jacobian.T @ force).max() >= LEVER_M * FORCE_N


def test_a_drawer_refuses_what_is_too_heavy_or_too_fast() -> None:
    drawer = Drawer(np.random.default_rng(1))
    assert drawer.possible(LIGHT[None], 1.0)
    stretched = np.array([0.0, 1.35, 0.0, -0.6, 0.0, 1.9, 0.0])
    assert not drawer.possible(stretched[None], 1.0)
    assert not drawer.possible(np.array([LIGHT, LIGHT + 0.3, LIGHT + 0.6]), 0.1)


def test_a_payload_is_found_where_the_model_is_true() -> None:
    arm = Arm("typical", 5)
    load = Payload(1.4, (0.02, -0.03, 0.05))
    run = Run(0, swing(3.0), load)
    truth = arm.record([run])[0]
    for offset, close, near in ((0.0, 0.01, 0.004), (0.4, 0.05, 0.012)):

        def joints(*_: Any, off: float = offset) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            sigma = np.broadcast_to(0.0056 * arm.rated_nm, truth.drive_nm.shape)
            torque = truth.drive_nm + off * sigma
            torque[:5, 2] = torque[1000:1100, 4] = np.nan  # a jtqd starts, and has gaps
            return torque, sigma, np.ones(sigma.shape, np.int8)

        found = best_payload(arm, truth, read(arm, run, truth, joints), "typical")
        assert found.mass_kg == pytest.approx(load.mass_kg, rel=close)
        assert found.centre_m == pytest.approx(load.centre_m, abs=near)


def test_the_baseline_finds_friction_payload_and_pushes() -> None:
    arm, run, truth = pushed()
    free = [Run(10 + k, swing(5.0, 0.35 + 0.05 * k), (Payload(), LOAD)[k % 2]) for k in range(4)]

    told = [
        (read(arm, each, true, no_joints), each.payload)
        for each, true in zip(free, arm.record(free), strict=True)
    ]
    baseline = Baseline(arm, told)
    assert baseline.friction[0] / arm.size == pytest.approx(np.full(JOINTS, 4.2), rel=0.5)
    assert (baseline.sigma < 0.08 * arm.rated_nm).all()
    found = baseline._payload(told[1][0])
    assert found.mass_kg == pytest.approx(LOAD.mass_kg, abs=0.6)
    residual = baseline._residual(read(arm, run, truth, no_joints), Dynamics(rigid(payload=LOAD)))
    look = slice(round(1000 * run.contacts[1].full_s) + 100, round(1000 * run.contacts[1].end_s))
    off = residual[look] - truth.external_nm[look]
    assert (np.abs(off.mean(axis=0)) < 0.1 * arm.rated_nm).all()
    assert (
        np.abs(residual[look].mean(axis=0)[:4] - truth.external_nm[look].mean(axis=0)[:4]).max()
        < 0.7 * np.abs(truth.external_nm[look]).max()
    )
