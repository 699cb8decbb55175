"""Faults of encoders and current, and contacts: found by name and in time on benches and arrays; none on healthy runs."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.core.status import safety_of
from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.decoder import decode
from jtqd.estimator.detection import FROZEN_RAD, detect_contacts
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import PlausibilityLimits, recommended
from jtqd.estimator.status import (
    CONTACT_NONE,
    CONTACT_PRESENT,
    CONTACT_UNKNOWN,
    CURRENT_FROZEN,
    LINK_JUMP,
    MOTOR_JUMP,
    REPEATED,
    TORSION,
    VELOCITY_MISMATCH,
)
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate
from jtqd.sim_can.plant_source import load_any_plant
from jtqd.sim_can.play import columns_beside, open_play
from tests.daemon.loop.safety_helpers import PERIOD_S, RUNS, Sample, checks, faults, run

# ---- plausibility

SINE, DEMO = "sine", "demo"
AT = 1200
"""The fault begins here: in run "sine" joint 1 then turns with 1.4 rad/s, 140 rad/s of the motor."""


@pytest.mark.parametrize("name", RUNS)
def test_healthy_runs_of_the_bench_raise_nothing(name: str) -> None:
    """Four quadrants, hard steps, current mode, standstill with and without power."""
    for number, samples in enumerate(run(name), start=1):
        assert set(faults(samples, checks(number))) == {0}


def test_the_margin_on_healthy_runs_is_wide() -> None:
    """The largest mismatch of position and velocity stays below a tenth of its limit."""
    check = checks()
    largest = 0.0
    for _ in faults(run("steps")[0], check):
        largest = max(largest, abs(check.mismatch_rad))
    assert 0.0 < largest < 0.1 * PlausibilityLimits().mismatch_rad


@pytest.mark.parametrize("name", ["RunTrajectory1", "opti_traj_testing1"])
def test_measured_runs_of_a_real_arm_raise_nothing(name: str) -> None:
    log = shipped(f"kinova_gen3/{name}.csv.gz")
    source = open_play(log, columns_beside(log), (2, 4))
    limits = safety_of(load_config(shipped("kinova_gen3/jtqd_before.yaml")))
    source.advance(0.0)
    for _ in range(3000):
        for safety, drive in zip(limits, source.drives, strict=True):
            assert safety.plausibility is not None
            position, velocity = drive.motor_position_rad, drive.motor_velocity_rad_s
            found = safety.plausibility.step(
                PERIOD_S, position, velocity, drive.link_position_rad, drive.current_a
            )
            assert found == 0
        source.advance(PERIOD_S)


def stuck(name: str, held: dict[str, float], n: int, sample: Sample) -> Sample:
    """One quantity keeps its value from AT on."""
    if n < AT:
        return sample
    return sample._replace(**{name: held.setdefault(name, getattr(sample, name))})


def shifted(name: str, by: float, n: int, sample: Sample) -> Sample:
    return sample if n < AT else sample._replace(**{name: getattr(sample, name) + by})


def reversed_(name: str, about: dict[str, float], n: int, sample: Sample) -> Sample:
    """The sign of a change is wrong from AT on, the value itself goes on from where it was."""
    if n < AT:
        return sample
    value = getattr(sample, name)
    start = about.setdefault(name, value) if name.endswith("position") else 0.0
    return sample._replace(**{name: 2.0 * start - value})


CASES = [
    # what happens, bit of its name, found within [samples]
    ("motor position frozen", partial(stuck, "motor_position", {}), TORSION | VELOCITY_MISMATCH, 150),
    ("link position frozen", partial(stuck, "link_position", {}), TORSION, 60),
    ("motor velocity frozen", partial(stuck, "motor_velocity", {}), VELOCITY_MISMATCH, 500),
    ("motor position jumps", partial(shifted, "motor_position", 1.4), MOTOR_JUMP, 1),
    ("motor position loses a bit", partial(shifted, "motor_position", -65536.0), MOTOR_JUMP, 1),
    ("link position jumps", partial(shifted, "link_position", 0.02), LINK_JUMP, 1),
    ("motor position reversed", partial(reversed_, "motor_position", {}), VELOCITY_MISMATCH | TORSION, 100),
    ("motor velocity reversed", partial(reversed_, "motor_velocity", {}), VELOCITY_MISMATCH, 150),
    ("link position reversed", partial(reversed_, "link_position", {}), TORSION, 60),
    ("current frozen", partial(stuck, "current", {}), CURRENT_FROZEN, 600),
]


@pytest.mark.parametrize(("fault", "bits", "within"), [case[1:] for case in CASES], ids=[c[0] for c in CASES])
def test_a_fault_is_named_in_time(fault, bits: int, within: int) -> None:
    found = list(faults(run(SINE)[0], checks(), fault))
    assert set(found[:AT]) == {0}
    seen = 0
    first = next(n for n, each in enumerate(found) if each)
    for each in found[AT : AT + within]:
        seen |= each
    assert seen & bits
    assert not seen & ~bits & (MOTOR_JUMP | LINK_JUMP), "no jump where there was none"
    assert first - AT < within


def test_a_whole_pdo_that_repeats_itself_is_found() -> None:
    """TPDO2 frozen: velocity and current keep their bytes while the joint swings on."""

    held: dict[str, float] = {}

    def fault(n: int, sample: Sample) -> Sample:
        return stuck("current", held, n, stuck("motor_velocity", held, n, sample))

    found = list(faults(run(SINE)[0], checks(), fault))
    assert any(each & VELOCITY_MISMATCH for each in found[AT : AT + 500])


def test_all_of_it_frozen_at_rest_is_no_fault() -> None:
    """A joint that stands still for an hour: not one digit changes, and nothing is concluded from that."""
    check = checks()
    assert {check.step(PERIOD_S, 5.0, 0.0, 0.05, 0.7) for _ in range(200_000)} == {0}


def _noisy(count: int, counts: float, seed: int) -> list[tuple[float, float, float, float]]:
    """Return (motor position, velocity, link position, current) of a joint at rest, each with noise, in its counts."""
    drawn = np.round(np.random.default_rng(seed).normal(0.0, counts, (count, 4)))
    return [tuple(row) for row in (drawn * (1e-4, 1e-4, 1e-5, 8e-3)).tolist()]


@pytest.mark.parametrize("counts", [0.3, 0.6, 1.5, 6.0])
def test_noise_that_comes_twice_is_found_and_its_chance_is_not(counts: float) -> None:
    """Numbers of few counts come again by chance; 60 samples in their order do not, whatever the delay."""
    check, rows = checks(), _noisy(20_000, counts, 5)
    assert {check.step(PERIOD_S, *row) for row in rows} == {0}
    for delay in (100, 250):
        check.reset()
        check.step(PERIOD_S, *rows[0])
        late = rows[1:1000] + rows[1000 - delay : 1000]
        found = [check.step(PERIOD_S, *row) for row in late]
        assert set(found[:999]) == {0}
        assert REPEATED in found[999 : 999 + 60]


@pytest.mark.parametrize("counts", [0.6, 1.5])
@pytest.mark.parametrize("delay", [9, 12, 19])
def test_at_rest_data_that_turn_a_few_cycles_old_are_found(delay: int, counts: float) -> None:
    """A sample later than they have come once more; noise of 0.6 counts repeats every thirtieth sample."""
    rows, found = _noisy(20_000, counts, 7), []
    for start in range(0, 20_000, 400):
        check, turned = checks(), start + 370
        for row in rows[start:turned]:
            assert check.step(PERIOD_S, *row) == 0
        late = [check.step(PERIOD_S, *row) for row in rows[turned - delay : turned + 1]]
        found.append(REPEATED in late)
    assert np.mean(found) >= 0.9


@pytest.mark.parametrize(("values", "delay"), [(6, 16), (8, 14), (10, 12)])
def test_data_that_turn_old_are_found_where_each_sample_comes_often(values: int, delay: int) -> None:
    """The chance of a period and the same again, not of each sample by when it came last."""
    draw, found = np.random.default_rng(values), []
    for _ in range(100):
        check = checks()
        angles = [1e-5 * which for which in draw.integers(0, values, 300).tolist()]
        late = [*angles[:250], *angles[250 - delay :]]
        found.append(any(check.step(PERIOD_S, angle, 0.0, 1e-2 * angle, 0.0) for angle in late))
    assert np.mean(found) >= 0.9


@pytest.mark.parametrize("values", [2, 3, 5, 8, 30])
def test_a_joint_that_stops_where_it_has_few_values_is_not_old(values: int) -> None:
    """10 000 stops, each with values that have never come before: their first repetitions prove nothing."""
    check, draw = checks(), np.random.default_rng(values)
    for stop in range(10_000):
        for which in draw.integers(0, values, 120).tolist():
            angle = 1e-3 * stop + 1e-5 * which
            assert check.step(PERIOD_S, angle, 0.0, 1e-2 * angle, 0.0) == 0


@pytest.mark.parametrize("delay", [4, 5, 12])
def test_of_a_moving_joint_few_samples_that_come_twice_are_found(delay: int) -> None:
    """Noise of two counts on 1.5 rad/s of the motor: it jumps back, and sends again what it sent before."""
    rows = [
        (p + 1.5e-3 * n, v + 1.5, q + 1.5e-5 * n, i) for n, (p, v, q, i) in enumerate(_noisy(4000, 2.0, 3))
    ]
    check = checks()
    assert {check.step(PERIOD_S, *row) for row in rows} == {0}
    found = [check.step(PERIOD_S, *row) for row in rows[-delay:]]
    assert REPEATED in found
    # a jump whose samples are new is none
    check.reset()
    assert not any(check.step(PERIOD_S, *row) & REPEATED for row in [*rows[:2000], *rows[2020:]])


def test_a_velocity_that_was_far_wrong_is_forgotten_soon() -> None:
    check = checks()
    found = [check.step(PERIOD_S, 0.0, 60.0 if n < 800 else 0.0, 0.0, 0.0) for n in range(1200)]
    assert found[799] == VELOCITY_MISMATCH
    assert set(found[1050:]) == {0}


def test_a_repetition_is_told_by_its_samples_and_not_by_those_that_stand_still() -> None:
    """A joint without noise repeats one sample for ever, or two by turns: nothing is concluded from either."""
    check = checks()
    rows = _noisy(2, 2.0, 1)
    assert {check.step(PERIOD_S, *rows[n // 7 % 2]) for n in range(20_000)} == {0}


@pytest.mark.parametrize("period", [4, 12, 16, 40])
def test_a_limit_cycle_at_rest_repeats_and_is_not_old(period: int) -> None:
    """A noisy joint stops, and its current goes up and down in the counts of its converter, the same every time."""
    check = checks()
    assert {check.step(PERIOD_S, *row) for row in _noisy(20_000, 1.5, 2)} == {0}
    cycle = [8e-3 * abs(n - period // 2) for n in range(period)]
    assert {check.step(PERIOD_S, 0.0, 0.0, 0.0, cycle[n % period]) for n in range(5000)} == {0}
    assert {check.step(PERIOD_S, *row) for row in _noisy(1000, 1.5, 9)} == {0}


def test_no_current_at_all_while_the_motor_is_turned_is_no_fault() -> None:
    check = checks()
    for n in range(3000):
        angle = 0.1 * n
        assert check.step(PERIOD_S, angle, 100.0, angle / 100.0, 0.0) == 0


def test_a_constant_current_counts_only_while_the_motor_turns() -> None:
    check = checks()
    for n in range(3000):
        angle = min(0.001 * n, FROZEN_RAD - 0.1)
        assert check.step(PERIOD_S, angle, 1.0 if angle < FROZEN_RAD - 0.1 else 0.0, angle / 100.0, 1.0) == 0


def test_the_twist_stays_a_fault_until_reset() -> None:
    """A link encoder that slipped: the numbers are not right again only because it goes on counting."""
    check, slip = checks(), partial(shifted, "link_position", 0.05)
    found = list(faults(run(SINE)[0], check, slip))
    assert all(each & TORSION for each in found[AT:])
    check.reset()
    after = faults(run(SINE)[0][AT:], check, lambda n, sample: slip(n + AT, sample))
    assert set(after) == {0}


@pytest.mark.parametrize("seed", range(3))
def test_gaps_are_no_jumps(seed: int) -> None:
    """Samples missing for up to 60 ms, again and again, in the quickest run."""
    draw = random.Random(seed)
    check, samples = checks(), run("steps")[0]
    dt = 0.0
    for sample in samples:
        if dt == 0.0 or draw.random() > 0.9 or dt > 0.06:
            found = check.step(
                dt, sample.motor_position, sample.motor_velocity, sample.link_position, sample.current
            )
            assert found == 0, f"seed {seed}"
            dt = 0.0
        dt += PERIOD_S


def test_what_moved_in_a_gap_is_not_held_against_the_velocity() -> None:
    """The motor started and stopped within 40 ms that nobody has seen: both readings of its velocity are 0."""
    check = checks()
    for n in range(100):
        assert check.step(PERIOD_S, 0.0, 0.0, 0.0, 0.1 * n) == 0
    assert check.step(0.04, 6.0, 0.0, 0.06, 0.0) == 0
    assert check.step(PERIOD_S, 6.0, 0.0, 0.06, 0.1) == 0


def test_the_first_sample_and_a_wrong_time_step_conclude_nothing() -> None:
    check = checks()
    for dt in (0.0, -1.0, 0.0, 10.0):
        assert check.step(dt, 1000.0, 300.0, -55.0, 1.0) == 0


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (
            {"motor_jump_rad": 0.0},
            "safety.plausibility.motor_jump_rad': found 0.0, expected a number in rad from",
        ),
        ({"frozen_s": "long"}, "safety.plausibility.frozen_s': found 'long'"),
        ({"frozen": 1}, "unknown key, did you mean 'frozen_s'?"),
    ],
)
def test_limits_out_of_range_are_refused(mapping: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        decode(PlausibilityLimits, mapping, "c.yaml", "safety.plausibility")
    assert message in str(caught.value)


def test_the_limits_of_the_configuration_are_used(tmp_path: Path) -> None:
    text = shipped("bench.yaml").read_text().replace("file: ", f"file: {shipped('bench.yaml').parent}/")
    (tmp_path / "c.yaml").write_text(text + "safety: {plausibility: {motor_jump_rad: 100.0}}\n")
    safety = safety_of(load_config(tmp_path / "c.yaml"))[0]
    assert safety.plausibility is not None
    jump = partial(shifted, "motor_position", 2.0)
    found = list(islice(faults(run(SINE)[0], safety.plausibility, jump), AT + 1))
    assert not found[AT] & MOTOR_JUMP


# ---- contacts

SETTINGS = replace(recommended("fused"), track_zeros=False)
THRESHOLD_NM = 0.6
JOINTS = tuple(load_joint(shipped(f"trained/joint{n}.yaml")) for n in (1, 2))
SINGLE, BLANK = 0.8, 6
"""Weight of one residual; samples without a result after a contact."""


def loads_of(
    made: EmulatedRun, joints: tuple[Joint, ...] = JOINTS, keep: CodeArray | None = None
) -> list[FloatArray]:
    """Loads of both joints at the rows that are kept."""
    rows = slice(None) if keep is None else np.flatnonzero(keep)
    time_s, found = made.table.time_s[rows], []
    for number, joint in enumerate(joints, start=1):
        c = made.table.joint(number, joint.gear_ratio)
        columns = c.current_a, c.motor_position_rad, c.motor_velocity_rad_s, c.link_position_rad
        inputs = [each[rows] for each in columns if each is not None]
        dt_s = np.diff(time_s, prepend=time_s[0])
        found.append(FusedEstimator(joint, SETTINGS).run(dt_s, *inputs).load_nm)
    return found


def angle_of(made: EmulatedRun) -> FloatArray:
    angle = made.table.joints[1].motor_position_rad
    assert angle is not None
    return angle


def opposed(made: EmulatedRun, threshold_nm: float = THRESHOLD_NM) -> tuple[FloatArray, CodeArray]:
    """Residual and code, in the frame of joint 1."""
    one, two = loads_of(made)
    return detect_contacts(two - one, angle_of(made), threshold_nm)


def alone(x: FloatArray, threshold_nm: float) -> tuple[FloatArray, CodeArray]:
    """Residual and code of a motor at rest."""
    return detect_contacts(x, np.zeros(len(x)), threshold_nm)


def reversals(made: EmulatedRun) -> int:
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    return np.count_nonzero(np.diff(np.sign(velocity[104:])))


@cache
def pushed_run(pushes: tuple[Push, ...] = (), seconds: float = 2.0) -> EmulatedRun:
    """Accelerations, reversals at up to 25 rad/s^2 and a reversing load, on day 3."""
    moved = JointCommand.velocity(lambda t: 1.2 * math.sin(9.0 * t))
    loaded = JointCommand.current(lambda t: 4.0 * math.sin(5.0 * t + 1.0))
    plant = load_any_plant(shipped("campaign_plant.yaml"))
    return emulate(plant, (moved, loaded), seconds, 41, day=3, pushes=pushes)


@pytest.mark.parametrize("phase_ms", [0.0, 0.3, 0.7, 0.95])
@pytest.mark.parametrize("torque_nm", [3.0, -3.0])
def test_a_push_is_found_within_two_samples_with_its_size_and_sign(torque_nm: float, phase_ms: float) -> None:
    begin_s = 1.0 + 1e-3 * phase_ms
    residual, code = opposed(pushed_run((Push(begin_s, torque_nm), Push(1.2, 0.0))))
    first = int(np.flatnonzero(code == CONTACT_PRESENT)[0])
    assert 1000 < first <= 1002
    assert residual[first] * torque_nm > 0.0
    # the link swings at some 200 Hz for a few milliseconds, then carries the push
    assert np.mean(residual[1006:1040]) == pytest.approx(torque_nm, abs=0.5)
    assert (code[first:1200] == CONTACT_PRESENT).all()
    assert (code[200:1000] == CONTACT_NONE).all()
    end = 1100 + int(np.argmax(code[1100:] == CONTACT_NONE))
    assert 1201 <= end - BLANK <= 1203
    assert (code[end - BLANK : end] == CONTACT_UNKNOWN).all()
    assert (code[end:1400] == CONTACT_NONE).all()


@pytest.mark.parametrize("drift_nm", [2.5, -2.5])
def test_a_load_that_changes_under_a_push_neither_ends_nor_outlasts_it(drift_nm: float) -> None:
    """Its error moves by almost the push itself in 0.2 s; the step back is the end, and no contact of the other sign."""
    t = np.arange(2400) * 1e-3
    moved = drift_nm * np.clip((t - 1.0) / 0.2, 0.0, 1.0)
    pushes = np.where((t >= 1.0) & (t < 1.2), 3.0, 0.0) - np.where((t >= 1.5) & (t < 1.7), 3.0, 0.0)
    residual, code = alone(moved + pushes, 2.0)
    present = code == CONTACT_PRESENT
    pushed = (t > 1.0005) & (t < 1.1995) | (t > 1.5005) & (t < 1.6995)
    assert present[pushed].all()
    pushed[[1000, 1200, 1500, 1700]] = True
    assert not present[~pushed].any()
    assert residual[1001] > 0.0 > residual[1501]


def test_an_outlier_is_no_contact_and_two_of_them_are_a_brief_one() -> None:
    x = np.zeros(1000)
    x[500] = 1.9
    residual, code = alone(x, 1.6)
    assert not (code == CONTACT_PRESENT).any()
    assert residual[500] == pytest.approx(SINGLE * 1.9)
    assert residual[501] == pytest.approx(0.95, abs=0.1), "the mean with the next"
    assert np.flatnonzero(alone(x, 1.5)[1] == CONTACT_PRESENT)[0] == 500, "large enough for one sample"
    x[500], x[501] = 1.8, 1.3
    x[502:] = 0.7  # less than a step of the threshold back
    found = np.flatnonzero(alone(x, 1.5)[1] == CONTACT_PRESENT)
    assert found[0] == 501
    assert len(found) < 20
    x = np.zeros(1000)
    x[500:503] = 1.9, np.nan, 1.5
    residual, code = alone(x, 1.6)
    assert residual[502] == pytest.approx(SINGLE * 1.5, abs=0.1), "no mean across a missing sample"
    assert not (code == CONTACT_PRESENT).any()


def test_motion_reversal_and_load_are_no_contact() -> None:
    made = pushed_run(seconds=8.0)
    residual, code = opposed(made)
    assert (code[:103] == CONTACT_UNKNOWN).all()
    assert (code[104:] == CONTACT_NONE).all()
    assert reversals(made) > 20
    assert np.nanmax(np.abs(residual)) < THRESHOLD_NM / 1.1


def test_stick_slip_is_no_contact() -> None:
    """At a crawl against the breakaway of a bristle friction: a bench with equations of its own, and the nominal spring."""
    crawl = JointCommand.velocity(lambda t: 0.012 * math.sin(2.0 * t))
    loaded = JointCommand.current(lambda t: 1.5 * math.sin(7.0 * t))
    made = emulate(load_any_plant(shipped("plants/typical.yaml")), (crawl, loaded), 6.0, 5, day=1)
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    assert np.count_nonzero(np.diff((np.abs(velocity) < 1e-3).astype(int))) > 20, "it sticks and slips"
    assert (opposed(made, 1.0)[1][110:] == CONTACT_NONE).all()


def test_the_momentum_is_earlier_than_the_torsion() -> None:
    """Without the link's inertia in it the residual of the first sample after a push is smaller."""
    made = pushed_run((Push(1.0, 3.0), Push(1.2, 0.0)))

    def first_step(joints: tuple[Joint, ...]) -> float:
        one, two = loads_of(made, joints)
        return float((two - one)[1001] - (two - one)[1000])

    assert first_step(JOINTS) > 0.8
    assert abs(first_step(tuple(replace(each, link_inertia_kgm2=1e-9) for each in JOINTS))) < 0.4


def link_on_its_spring(x_nm: FloatArray) -> FloatArray:
    """Link position at 1 kHz, motor at rest, pushed by x [n] at 20 kHz."""
    torsion = JOINTS[0].fused.torsion  # type: ignore[union-attr]
    assert torsion is not None
    q = w = 0.0
    found = []
    for k, x in enumerate(x_nm):
        if k % 20 == 0:
            found.append(q)
        torque = -torsion.stiffness_nm_per_rad * q - torsion.damping_nms_per_rad * w
        w += 5e-5 * (torque + x) / JOINTS[0].link_inertia_kgm2
        q += 5e-5 * w
    return np.array(found)


def test_of_one_joint_the_residual_is_the_push_itself() -> None:
    x = np.zeros(20 * 600)
    x[20 * 300 + 7 :] = 2.0
    zero, dt = np.zeros(600), np.full(600, 1e-3)
    run = FusedEstimator(JOINTS[0], SETTINGS).run(dt, zero, zero, zero, link_on_its_spring(x))
    rate = run.torque_rate_nm_s
    residual, code = alone(-run.load_nm, 0.5)
    assert np.flatnonzero(code == CONTACT_PRESENT)[0] <= 302
    assert residual[310:320] == pytest.approx(2.0, abs=0.4)  # the joint's slip carries 0.35 Nm
    assert np.nanmin(rate[300:306]) < -300.0  # the joint's torque opposes the push
    assert np.nansum(rate[300:340]) * 1e-3 == pytest.approx(-2.0, abs=0.2)


def test_a_slow_load_is_load_and_a_long_contact_becomes_one() -> None:
    t = np.arange(3000) * 1e-3
    assert (alone(20.0 * np.sin(2.0 * t), 1.0)[1][100:] == CONTACT_NONE).all()
    residual, code = alone(np.where(t < 1.0, 0.0, 3.0), 1.0)
    found = np.flatnonzero(code == CONTACT_PRESENT)
    assert found[0] == 1000
    assert 498 <= len(found) <= 502
    assert abs(residual[2000]) < 1e-9


def test_an_error_over_the_motor_s_turn_is_no_contact() -> None:
    """1.5 Nm at one per turn, more than the threshold; a push on top of it is found."""
    t = np.arange(4000) * 1e-3
    angle = 150.0 * t
    wave = 1.5 * np.cos(angle + 0.4) + 0.5 * np.cos(2.0 * angle)
    push = np.where((t >= 3.0) & (t < 3.2), 3.0, 0.0)
    residual, code = detect_contacts(wave * np.minimum(t, 1.0) + push, angle, 1.0)
    assert (code[100:3000] == CONTACT_NONE).all()
    assert (code[3000:3200] == CONTACT_PRESENT).all()
    assert residual[3050] == pytest.approx(3.0, abs=0.2)


def test_a_gap_in_the_inputs_is_unknown_and_no_contact() -> None:
    made = pushed_run()
    keep = np.ones(2000, bool)
    keep[1000] = False
    one, two = loads_of(made, keep=keep)
    _, code = detect_contacts(two - one, angle_of(made)[keep], THRESHOLD_NM)
    assert (code[1000:1003] == CONTACT_UNKNOWN).all(), "three equal steps give an acceleration"
    assert (code[104:1000] == CONTACT_NONE).all()
    assert (code[1003:] == CONTACT_NONE).all()


def test_after_a_long_gap_it_settles_again() -> None:
    x = np.zeros(1000)
    x[300:360] = np.nan
    x[360:] = 8.0
    _, code = alone(x, 1.0)
    assert (code[99:300] == CONTACT_NONE).all()
    assert (code[300:459] == CONTACT_UNKNOWN).all(), "a load that changed in the gap is no contact"
    assert (code[459:] == CONTACT_NONE).all()


@pytest.mark.parametrize(
    ("threshold_nm", "period_s"), [(0.0, 1e-3), (math.nan, 1e-3), (1.0, 0.0), (1.0, 0.02)]
)
def test_a_threshold_or_period_out_of_range_is_refused(threshold_nm: float, period_s: float) -> None:
    with pytest.raises(ValueError, match="found a threshold of"):
        detect_contacts(np.zeros(3), np.zeros(3), threshold_nm, period_s)


def test_inputs_that_do_not_fit_are_refused() -> None:
    zero = np.zeros(3)
    with pytest.raises(ValueError, match="found 2 angles, expected 3"):
        detect_contacts(zero, np.zeros(2), 1.0)
