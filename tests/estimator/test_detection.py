"""Frozen, jumping and reversed encoders, a frozen current: found by name and in time; nothing is found on healthy runs."""

from __future__ import annotations

import random
from functools import partial
from itertools import islice
from pathlib import Path

import pytest

from jtqd.daemon.config import load_config
from jtqd.daemon.core.status import safety_of
from jtqd.estimator.decoder import decode
from jtqd.estimator.detection import FROZEN_RAD
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.settings import PlausibilityLimits
from jtqd.estimator.status import CURRENT_FROZEN, LINK_JUMP, MOTOR_JUMP, TORSION, VELOCITY_MISMATCH
from jtqd.models.files import shipped
from jtqd.sim_can.play import columns_beside, open_play
from tests.daemon.loop.safety_helpers import PERIOD_S, RUNS, Sample, checks, faults, run

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
