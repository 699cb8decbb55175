"""The status machine: bad at once, good after a while, never flickering, and what is latched stays."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from jtqd.daemon.config import LATCHED_BY_DEFAULT, SafetySettings
from jtqd.daemon.core.status import NEEDED, JointStatus
from jtqd.daemon.shared import faults
from jtqd.estimator.decoder import decode
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.status import (
    DEGRADED,
    DRIVE_FAULT,
    INVALID,
    NAMES,
    OFF,
    PUBLISHED,
    STALE,
    STANDSTILL,
    STARTING,
    VALID,
)

CODES = sorted(NAMES)
JUMP = faults.BITS["motor_jump"]


def settled(safety: SafetySettings | None = None) -> JointStatus:
    """One that has been valid for long."""
    state = JointStatus(safety or SafetySettings())
    assert [state.update(VALID, 0) for _ in range(2000)] == [VALID] * 2000
    return state


def asked(state: JointStatus, statuses: Iterable[int]) -> list[int]:
    return [state.update(status, 0) for status in statuses]


def returns(statuses: Iterable[int]) -> int:
    """How often a number comes back."""
    return sum(a not in PUBLISHED and b in PUBLISHED for a, b in itertools.pairwise(statuses))


def test_the_cycles_that_each_status_is_held() -> None:
    held = {DEGRADED: 100, STARTING: 1, OFF: 20, STALE: 5, INVALID: 50, DRIVE_FAULT: 100}
    assert held == NEEDED


def test_degraded_is_held_as_long_after_relapses() -> None:
    state = settled()
    for _ in range(4):
        asked(state, [STALE, *[VALID] * 25])
    assert asked(state, [DEGRADED, *[VALID] * 150]).index(VALID) == NEEDED[DEGRADED]


@pytest.mark.parametrize("bad", [OFF, STALE, DRIVE_FAULT, INVALID, DEGRADED])
def test_bad_at_once_and_good_after_so_many_cycles(bad: int) -> None:
    state = settled()
    assert state.update(bad, 0) == bad
    assert asked(state, [VALID] * (NEEDED[bad] + 1)) == [bad] * (NEEDED[bad] - 1) + [VALID] * 2


@pytest.mark.parametrize("bad", [OFF, STALE, DRIVE_FAULT, INVALID, DEGRADED])
def test_the_count_begins_again_with_each_bad_cycle(bad: int) -> None:
    state = settled()
    pattern = [bad, *[VALID] * (NEEDED[bad] - 1)] * 20
    assert set(asked(state, pattern)) == {bad}


def test_the_start_needs_no_wait() -> None:
    assert asked(JointStatus(SafetySettings()), [STARTING] * 3 + [VALID] * 2) == [STARTING] * 3 + [VALID] * 2


@pytest.mark.parametrize("bad", [OFF, STALE, INVALID, DRIVE_FAULT])
def test_a_joint_whose_first_cycle_is_bad_waits_as_long_as_later(bad: int) -> None:
    out = asked(JointStatus(SafetySettings()), [bad, *[VALID] * 150])
    assert out.index(VALID) == NEEDED[bad]


def test_a_fall_within_ten_cycles_of_the_start_is_a_relapse() -> None:
    for cycles, wait in ((9, 2 * NEEDED[STALE]), (10, NEEDED[STALE])):
        state = JointStatus(SafetySettings())
        asked(state, [STARTING, *[VALID] * cycles, STALE])
        assert asked(state, [VALID] * 60).index(VALID) + 1 == wait


def test_standstill_comes_and_goes_with_valid_and_degraded() -> None:
    state = settled()
    pattern = [STANDSTILL, VALID, STANDSTILL, DEGRADED, STANDSTILL, VALID]
    assert asked(state, pattern) == [STANDSTILL, VALID, STANDSTILL, DEGRADED, STANDSTILL, DEGRADED]


def test_of_two_bad_ones_the_worse_stays() -> None:
    state = settled()
    assert asked(state, [STALE, INVALID] * 50)[1:] == [INVALID] * 99
    assert asked(state, [DRIVE_FAULT, OFF]) == [DRIVE_FAULT] * 2


def test_an_input_that_comes_and_goes_every_other_cycle_is_stale() -> None:
    """500 times a second in, not once out."""
    out = asked(settled(), [STALE, VALID] * 1000)
    assert set(out) == {STALE}


def test_what_comes_and_goes_waits_longer_and_longer() -> None:
    state = settled()
    waits = []
    for _ in range(5):
        asked(state, [STALE])
        waits.append(asked(state, [VALID] * 40).index(VALID) + 1)
        asked(state, [VALID] * 3)
    # each return lasts 43 cycles less the wait: within 10 times the wait it counts as a relapse
    assert waits == [5, 10, 20, 20, 20]
    asked(state, [VALID] * 500)
    asked(state, [STALE])
    assert asked(state, [VALID] * 40).index(VALID) + 1 == 5, "forgiven"


@pytest.mark.parametrize("good", [VALID, STANDSTILL, DEGRADED])
def test_a_relapse_from_every_status_with_a_torque_waits_longer(good: int) -> None:
    state = JointStatus(SafetySettings())
    asked(state, [good] * 500)
    waits = []
    for _ in range(3):
        asked(state, [STALE])
        waits.append(asked(state, [good] * 40).index(good) + 1)
    assert waits == [5, 10, 20]


def test_only_a_torque_lost_is_a_relapse() -> None:
    state = settled()
    asked(state, [STALE, *[VALID] * 6, DEGRADED, STALE])
    assert asked(state, [VALID] * 60).index(VALID) + 1 == 2 * NEEDED[STALE]
    state = settled()
    asked(state, [DEGRADED, *[VALID] * (NEEDED[DEGRADED] + 5), STALE])
    assert asked(state, [VALID] * 60).index(VALID) + 1 == NEEDED[STALE], "degraded has a torque"


@settings(max_examples=120, deadline=None)
@given(some.lists(some.tuples(some.sampled_from(CODES), some.integers(1, 60)), min_size=1, max_size=120))
def test_whatever_comes_in(runs: list[tuple[int, int]]) -> None:
    """Never better than what is asked for; a number only after enough good cycles; at most 50 returns a second."""
    rank = {
        code: n
        for n, code in enumerate((VALID, STANDSTILL, DEGRADED, STARTING, OFF, STALE, INVALID, DRIVE_FAULT))
    }
    asked_for = [status for status, count in runs for _ in range(count)]
    state = JointStatus(SafetySettings())
    out = asked(state, asked_for)
    for n, (wanted, given_) in enumerate(zip(asked_for, out, strict=True)):
        assert rank[given_] >= rank[wanted] or {given_, wanted} <= {VALID, STANDSTILL}
        if given_ in PUBLISHED and n >= 5:
            before = asked_for[n - 4 : n]
            assert STALE not in before
            assert INVALID not in before
    for start in range(0, len(out), 500):
        assert returns(out[start : start + 1000]) <= 50


@pytest.mark.parametrize("seed", range(20))
def test_no_pattern_makes_it_flicker(seed: int) -> None:
    """Steady patterns of every length, and at random: never more than 50 returns a second at 1 kHz."""
    draw = random.Random(seed)
    good, bad = draw.randint(1, 60), draw.randint(1, 3)
    code = draw.choice((STALE, INVALID, OFF, DRIVE_FAULT))
    steady = [code if n % (good + bad) < bad else VALID for n in range(5000)]
    loose = [code if draw.random() < 0.03 else VALID for _ in range(5000)]
    for pattern in (steady, loose):
        out = asked(settled(), pattern)
        assert max(returns(out[n : n + 1000]) for n in range(0, 4000, 100)) <= 50, f"seed {seed}"


def test_a_frame_lost_now_and_then_costs_little() -> None:
    """One in a thousand, each costing two cycles: 99 of 100 cycles still have a number."""
    out = asked(settled(), [STALE if n % 1000 < 2 else VALID for n in range(20_000)])
    assert sum(code == VALID for code in out) > 0.99 * len(out)


@pytest.mark.parametrize(("share", "with_torque"), [(0.005, 0.95), (0.01, 0.86), (0.02, 0.66)])
def test_the_price_of_frames_lost_at_random(share: float, with_torque: float) -> None:
    """Each costs two cycles of inputs; docs/safety.md names these figures."""
    draw = random.Random(1)
    pattern, left = [], 0
    for _ in range(100_000):
        left = 2 if draw.random() < share else max(0, left - 1)
        pattern.append(STALE if left else VALID)
    out = asked(settled(), pattern)
    assert sum(code == VALID for code in out) / len(out) == pytest.approx(with_torque, abs=0.015)


def test_a_fault_makes_the_cycle_invalid_whatever_the_estimator_says() -> None:
    for status in (VALID, DEGRADED, STANDSTILL, STARTING, STALE, OFF):
        state = settled()
        assert state.update(status, faults.OUT_OF_RANGE) == INVALID
    assert settled().update(DRIVE_FAULT, faults.OUT_OF_RANGE) == DRIVE_FAULT


@pytest.mark.parametrize(
    ("fault", "status"), [("motor_jump", INVALID), ("link_jump", INVALID), ("not_finite", INVALID)]
)
def test_what_is_latched_by_default_stays_until_the_reset(fault: str, status: int) -> None:
    state = settled()
    state.update(VALID, faults.BITS[fault])
    assert set(asked(state, [VALID] * 10_000)) == {status}
    assert faults.names_of(state.latched) == (fault,)
    assert state.reset_latch()
    out = asked(state, [VALID] * 200)
    assert out[: NEEDED[INVALID] - 1] == [INVALID] * (NEEDED[INVALID] - 1)
    assert out[-1] == VALID
    assert not state.reset_latch(), "nothing is latched any more"


def test_a_fault_that_is_still_there_latches_again() -> None:
    state = settled()
    for _ in range(3):
        state.update(VALID, JUMP)
        state.reset_latch()
        assert state.update(VALID, JUMP) == INVALID
        assert state.latched == JUMP


def test_what_is_not_to_be_latched_is_not() -> None:
    state = settled(SafetySettings(latch=0))
    for bit in faults.COUNTED:
        state.update(VALID, bit)
    assert state.latched == 0
    assert asked(state, [VALID] * 200)[-1] == VALID


def test_a_worse_status_shows_through_a_latch() -> None:
    state = settled()
    state.update(VALID, JUMP)
    assert asked(state, [STALE, DRIVE_FAULT]) == [INVALID, DRIVE_FAULT]


def test_the_drive_fault_latches_where_it_is_configured() -> None:
    state = settled(SafetySettings(latch=faults.DRIVE_FAULT))
    assert asked(state, [DRIVE_FAULT, *[OFF] * 500, *[VALID] * 500]) == [DRIVE_FAULT] * 1001
    state.reset_latch()
    assert asked(state, [VALID] * 200)[-1] == VALID


def test_twenty_missed_cycles_in_a_row_latch_where_it_is_configured() -> None:
    """As libfranka stops a robot after 20 missed steps."""
    safety = SafetySettings(latch=faults.STALE, stale_latch_cycles=20)
    state = settled(safety)
    assert asked(state, [*[STALE] * 19, *[VALID] * 200])[-1] == VALID
    assert state.latched == 0
    assert asked(state, [*[STALE] * 20, *[VALID] * 200])[-1] == STALE
    assert state.latched == faults.STALE
    assert state.reset_latch()


@pytest.mark.parametrize("between", [OFF, STARTING, VALID, INVALID, DRIVE_FAULT])
def test_missed_cycles_are_counted_in_a_row(between: int) -> None:
    state = settled(SafetySettings(latch=faults.STALE, stale_latch_cycles=20))
    asked(state, [*[STALE] * 19, between, *[STALE] * 19])
    assert state.latched == 0
    asked(state, [STALE])
    assert state.latched == faults.STALE


def test_without_a_limit_missed_cycles_latch_nothing() -> None:
    state = settled(SafetySettings(latch=faults.STALE, stale_latch_cycles=None))
    asked(state, [STALE] * 1000)
    assert state.latched == 0


def test_late_cycles_count_as_missed_ones() -> None:
    state = settled(SafetySettings(latch=faults.STALE, stale_latch_cycles=3))
    for _ in range(3):
        assert state.latched == 0
        assert (state.update(VALID, 0), state.late())[1] == STALE
    state = settled(SafetySettings(latch=faults.STALE, stale_latch_cycles=20))
    assert state.update(VALID, 0) == VALID
    assert state.late() == STALE
    assert asked(state, [VALID] * 4) == [STALE] * 4
    assert state.update(VALID, 0) == VALID


def test_the_same_input_gives_the_same_output_again() -> None:
    draw = random.Random(5)
    pattern = [(draw.choice(CODES), draw.choice((0, 0, 0, 0, JUMP, faults.TORSION))) for _ in range(3000)]
    one, two = (JointStatus(SafetySettings(latch=0)) for _ in range(2))
    assert [one.update(*each) for each in pattern] == [two.update(*each) for each in pattern]


def section(mapping: object) -> SafetySettings:
    return decode(SafetySettings, mapping, "c.yaml", "safety")


def test_the_configuration_says_what_is_latched() -> None:
    assert SafetySettings() == section({})
    assert section({}).latch == LATCHED_BY_DEFAULT
    assert section({"latch": []}).latch == 0
    assert section({"latch": ["drive_fault", "torsion"]}).latch == 0x120
    assert section({"latch": [], "stale_latch_cycles": 20}).latch == faults.STALE
    assert section({"stale_latch_cycles": None}) == SafetySettings()
    assert section({"plausibility": False}).plausibility is None


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"latch": ["stale"]}, "'safety.latch': found ['stale'], expected a list of not_finite, "),
        ({"latch": "all"}, "'safety.latch': found 'all', expected a list of"),
        ({"latch": [1]}, "'safety.latch': found [1]"),
        ({"latched": []}, "unknown key, did you mean 'latch'?"),
        ({"stale_latch_cycles": 0}, "expected a whole number from 1 to 1000000"),
        ({"plausibility": True}, "found True, expected a mapping"),
        ({"deviation_s": -1}, "expected a number in s from 0.01"),
    ],
)
def test_a_wrong_section_is_one_line(mapping: object, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        section(mapping)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
