"""Next experiments: for every effect and pair there is one, it keeps the joints' ratings, and it separates what it says.

The bench is written out here once more, statically: friction-only joints that face each other, theta_l2 = -theta_l1.
"""

import math
import random
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Friction, Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.diagnosis.next_experiment import MOST_KINDS, PAIRS, SHOWN_BY, kinds_for, next_experiment
from jtqd.sysid.planner.experiments import EXPERIMENTS, pair_range_of, pair_runs
from jtqd.sysid.planner.plan import Plan, Plateau, Run, check_plan, expand

SEED = 20261121
SHIPPED = {number: load_joint(shipped(f"joint{number}.yaml")) for number in (1, 2)}


def drawn_joint(rng: random.Random, name: str) -> Joint:
    ratio = float(rng.randint(80, 160))
    return Joint(
        name=name,
        gear_ratio=ratio,
        torque_constant_nm_per_a=rng.uniform(0.04, 0.12),
        rotor_inertia_kgm2=rng.uniform(0.3, 1.1) / ratio**2,
        stiffness_nm_per_rad=rng.uniform(8e3, 3e4),
        damping_nms_per_rad=8.0,
        link_inertia_kgm2=0.01,
        rated_torque_nm=rng.uniform(30.0, 90.0),
        friction=Friction(rng.uniform(3.0, 6.0), rng.uniform(2.0, 8.0)),
    )


def plan_of(kind: str, joints: dict[int, Joint], **options: Any) -> Plan:
    """The plan of one kind alone, through YAML as a file goes."""
    made = next_experiment([[name for name in EFFECTS if SHOWN_BY[name] == kind][:1]], joints, **options)
    return Plan.from_mapping(yaml.safe_load(yaml.safe_dump(made["plan"])), "plan")


class Static:
    """What both joints of a run do by the joint files: arrays [n] every 10 ms, own frames."""

    def __init__(self, run: Run, joints: dict[int, Joint]) -> None:
        points = expand(run)
        mover, driver = joints[run.velocity_joint], joints[3 - run.velocity_joint]
        v, i = points.velocity_rad_s[::10], points.current_a[::10]
        a = np.gradient(v, 0.01)
        self.torque = self._gain(driver) * i - self._loss(driver, -v) + self._inertia(driver) * a
        own = (self.torque + self._loss(mover, v) + self._inertia(mover) * a) / self._gain(mover)
        self.velocity = {run.velocity_joint: v, 3 - run.velocity_joint: -v}
        self.current = {run.velocity_joint: own, 3 - run.velocity_joint: i}
        self.acceleration = {run.velocity_joint: a, 3 - run.velocity_joint: -a}

    @staticmethod
    def _gain(joint: Joint) -> float:
        return joint.gear_ratio * joint.torque_constant_nm_per_a

    @staticmethod
    def _inertia(joint: Joint) -> float:
        return joint.gear_ratio**2 * joint.rotor_inertia_kgm2

    @staticmethod
    def _loss(joint: Joint, v: FloatArray) -> FloatArray:
        result: FloatArray = joint.friction.coulomb_nm * np.sign(v) + joint.friction.viscous_nms_per_rad * v
        return result


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_and_all_that_it_is_confused_with_have_an_experiment(name: str) -> None:
    assert EFFECTS[name].experiment in EXPERIMENTS
    for other in EFFECTS[name].confused_with:
        kinds = kinds_for([(name, other)])
        assert 1 <= len(kinds) <= 2
        # both are to be seen in it, or a kind of its own is known to separate them
        assert set(kinds) == {PAIRS.get(frozenset((name, other)))} or {
            SHOWN_BY[name],
            SHOWN_BY[other],
        } == set(kinds)


def test_the_table_of_pairs_speaks_of_effects_and_kinds_that_exist() -> None:
    for pair, kind in PAIRS.items():
        assert len(pair) == 2
        assert pair <= set(EFFECTS)
        assert kind in EXPERIMENTS


def test_kinds_are_few_and_those_that_serve_most_come_first() -> None:
    assert kinds_for([]) == ("excitation", "repeat")
    assert kinds_for([("torque_constant", "load_dependent_friction")]) == ("load_at_both_directions",)
    several = kinds_for(
        [
            ("sensor_drift", "temperature_dependent_friction", "torque_constant_temperature"),
            ("rotor_inertia", "channel_delay"),
            ("stribeck_friction", "coulomb_friction"),
            ("hysteresis", "lost_motion"),
        ]
    )
    assert several[0] == "warm_up"
    assert len(several) == MOST_KINDS
    assert kinds_for([("no_such_effect",)]) == ("excitation",)


@pytest.mark.parametrize("kind", sorted(EXPERIMENTS))
def test_a_plan_is_what_the_campaign_takes_and_moves_either_joint(kind: str) -> None:
    runs = pair_runs([kind], pair_range_of(SHIPPED))
    assert {run.velocity_joint for run in runs} == {1, 2}
    assert len({run.name for run in runs}) == len(runs)
    assert 10.0 < sum(run.duration_s for run in runs) < 1300.0


@pytest.mark.parametrize("kind", sorted({SHOWN_BY[name] for name in EFFECTS}))
@pytest.mark.parametrize("seed", range(SEED, SEED + 4))
def test_no_plan_asks_more_than_the_ratings_of_joints_of_any_size(kind: str, seed: int) -> None:
    rng = random.Random(seed)
    joints = {number: drawn_joint(rng, f"drawn {number} of seed {seed}") for number in (1, 2)}
    plan = plan_of(kind, joints)
    check_plan(plan)
    rated = min(joint.rated_torque_nm for joint in joints.values())
    assert plan.limits.torque_nm <= rated
    highest = 0.0
    for run in plan.runs:
        static = Static(run, joints)
        highest = max(highest, float(np.abs(static.torque).max()))
        assert np.abs(static.torque).max() < 0.97 * rated, run.name
        for number in (1, 2):
            assert np.abs(static.current[number]).max() < 0.97 * plan.limits.current_a, run.name
    print(f"{kind}, seed {seed}: up to {highest / rated:.0%} of the rated torque")
    if kind in ("load_at_both_directions", "load_ramp", "full_turns", "warm_up"):
        assert highest > 0.5 * rated  # and it asks for something


def emulated_peaks(run: Run) -> tuple[FloatArray, FloatArray, float, float]:
    """Largest measured currents [2] and velocities [2] of a run on the campaign's bench, torque, travel."""
    points = expand(run)
    velocity, current = points.velocity_rad_s.tolist(), points.current_a.tolist()
    commands = (
        JointCommand.velocity(lambda t: velocity[min(round(t * 1000), len(velocity) - 1)]),
        JointCommand.current(lambda t: current[min(round(t * 1000), len(current) - 1)]),
    )
    swapped = commands if run.velocity_joint == 1 else commands[::-1]
    table = emulate_run(load_plant(shipped("campaign_plant.yaml")), swapped, len(points) * 1e-3, SEED, day=2)
    peaks = np.array(
        [
            [np.abs(getattr(table.joints[n], name)).max() for n in (1, 2)]
            for name in ("current_a", "motor_velocity_rad_s")
        ]
    )
    torque, link = table.joints[1].torque_nm, table.joints[1].link_position_rad
    assert torque is not None
    assert link is not None
    return peaks[0], peaks[1] / 100.0, float(np.abs(torque).max()), float(np.abs(link - link[0]).max())


@pytest.mark.parametrize(
    ("kind", "index"),
    [
        ("quick_changes", 1),
        ("load_at_both_directions", 1),
        ("speed_ladder", 2),
        ("load_ramp", 0),
        ("repeat", 5),
    ],
)
def test_the_emulated_bench_stays_within_the_plans_limits(kind: str, index: int) -> None:
    made = next_experiment([], SHIPPED) if kind == "repeat" else None
    plan = plan_of(kind, SHIPPED) if made is None else Plan.from_mapping(made["plan"], "plan")
    runs = [run for run in plan.runs if run.name.startswith(kind)]
    currents, velocities, torque, travel = emulated_peaks(runs[index])
    print(
        f"{runs[index].name}: {currents} A, {velocities} rad/s, {torque:.1f} Nm, {travel:.1f} rad, {plan.limits}"
    )
    assert currents.max() < 0.95 * plan.limits.current_a
    assert velocities.max() < plan.limits.velocity_rad_s
    assert torque < 0.95 * plan.limits.torque_nm
    assert travel < plan.limits.travel_rad


def columns(name: str, static: Static) -> FloatArray:
    """What an effect of joint 1 (or of the sensor) leaves in the motor balances of both joints [2 n], in motion."""
    v, i, a = static.velocity[1], static.current[1], static.acceleration[1]
    s = np.sign(v)
    tau = static.torque
    one: dict[str, FloatArray] = {
        "torque_constant": i,
        "load_dependent_friction": np.abs(tau) * s,
        "coulomb_friction": s,
        "viscous_friction": v,
        "stribeck_friction": np.exp(-((v / 0.06) ** 2)) * s,
        "rotor_inertia": a,
        "torque_constant_saturation": i * np.abs(i),
        "channel_delay": np.gradient(tau, 0.01),
    }
    common: dict[str, FloatArray] = {"sensor_gain": tau}
    moving = np.abs(v) > 0.03
    if name in common:
        return np.concatenate([common[name][moving]] * 2)
    return np.concatenate([one[name][moving], np.zeros(int(moving.sum()))])


def shared(a: str, b: str, statics: list[Static]) -> float:
    """Squared correlation of the columns of two effects over runs, beside offsets of both joints."""
    x, y = (np.concatenate([columns(name, each) for each in statics]) for name in (a, b))
    x, y = x - x.mean(), y - y.mean()
    return float((x @ y) ** 2 / ((x @ x) * (y @ y)))


@pytest.mark.parametrize(
    ("pair", "most"),
    [
        (("torque_constant", "load_dependent_friction"), 0.2),
        (("torque_constant", "sensor_gain"), 0.6),
        (("torque_constant", "torque_constant_saturation"), 0.95),
        (("load_dependent_friction", "coulomb_friction"), 0.8),
        (("coulomb_friction", "viscous_friction"), 0.85),
        (("coulomb_friction", "stribeck_friction"), 0.85),
        (("rotor_inertia", "channel_delay"), 0.5),
        (("rotor_inertia", "viscous_friction"), 0.2),
    ],
)
def test_the_chosen_experiment_separates_what_one_direction_at_one_load_cannot(
    pair: tuple[str, str], most: float
) -> None:
    made = next_experiment([pair], SHIPPED)
    joints = {n: Joint.from_mapping(_friction_only(j), "joint") for n, j in SHIPPED.items()}
    runs = Plan.from_mapping(made["plan"], "plan").runs
    value = shared(*pair, [Static(run, joints) for run in runs])
    print(f"{pair}: {value:.3f} by {[run.name for run in runs]}")
    assert value < most


def _friction_only(joint: Joint) -> dict[str, Any]:
    mapping = joint.to_mapping()
    del mapping["efficiency"]
    mapping.pop("fused", None)
    return mapping


def test_the_text_says_why_what_and_how_long_and_the_limits_follow_the_joints() -> None:
    made = next_experiment(
        [("current_offset", "friction_asymmetry"), ("hysteresis",)], SHIPPED, "Two classes."
    )
    assert set(made) == {"why", "plan"}
    why = made["why"]
    for part in (
        "Two classes. Proposed to distinguish current_offset from friction_asymmetry and to detect hysteresis:",
        "drives switched off",
        " runs, ",
        "at most 40 Nm",
    ):
        assert part in why
    assert "\n" not in why
    plain = next_experiment([("hysteresis",)], SHIPPED, temperature=False)["plan"]
    assert plain["limits"]["temperature_c"] is None
    assert Plan.from_mapping(plain, "plan").limits.temperature_c == math.inf
    assert pair_range_of(SHIPPED, velocity_rad_s=0.8).limits.velocity_rad_s < 1.0
    with pytest.raises(ValueError, match="found none"):
        next_experiment([], {})


def test_the_same_question_gives_the_same_plan() -> None:
    classes = [("torque_ripple", "cogging")]
    assert next_experiment(classes, SHIPPED) == next_experiment(classes, SHIPPED)
    plans = [
        next_experiment([pair], SHIPPED)["plan"] for pair in combinations(("hysteresis", "lost_motion"), 2)
    ]
    assert plans[0]["name"] == "next_load_ramp"


def test_every_load_is_driven_at_the_same_velocity_in_both_directions() -> None:
    for run in pair_runs(["load_at_both_directions"], pair_range_of(SHIPPED)):
        points = {(s.velocity_rad_s, s.current_a) for s in run.segments if isinstance(s, Plateau)}
        assert len({i for _, i in points}) >= 10
        assert all((-v, i) in points and (v, -i) in points for v, i in points)
