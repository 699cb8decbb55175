"""The parts of a replay by themselves: statuses, fields, positions that roll over, what is known and what is not."""

from __future__ import annotations

import numpy as np

from jtqd.daemon.config import load_config
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.input_pdos import JointInputs, drive_places
from jtqd.daemon.core.joint import Unwrap
from jtqd.daemon.replay.compare import SETTLED_CYCLES, bits_equal, identity
from jtqd.daemon.replay.logged import SAMPLE
from jtqd.daemon.replay.replayer import Pdo, offsets
from jtqd.daemon.replay.rows import fields
from jtqd.daemon.replay.runs import BEGINS, LOST, lost_cycles, steps_of

MS = 1_000_000
CONFIG = load_config(None)
LOGGED = np.dtype(
    [
        ("header", [("stamp", [("sec", "<i4"), ("nanosec", "<u4")])]),
        ("cycle", "<u8"),
        ("sync_monotonic_ns", "<i8"),
        ("sync_counter", "u1"),
        ("cycle_flags", "u1"),
        *((name, SAMPLE[name]) for name in SAMPLE.names or ()),
    ]
)


def records(cycles: list[int], period_ns: int = MS) -> np.ndarray:
    """States of a run that began with cycle 0 and has these cycles in its log."""
    out = np.zeros(len(cycles), LOGGED)
    out["cycle"] = cycles
    out["sync_monotonic_ns"] = np.array(cycles) * period_ns
    out["header"]["stamp"]["nanosec"] = np.array(cycles) * period_ns + 77
    out["sync_counter"] = np.array(cycles) % 240 + 1
    out["input_flags"] = 7
    out["dt_s"] = np.where(out["cycle"] == 0, 0.0, period_ns * 1e-9)
    return out


def test_fields_are_those_of_the_pdo() -> None:
    rng = np.random.default_rng(1)
    torque = np.concatenate((rng.normal(0, 200, 3000), [np.nan, np.inf, 327.67, 327.68, -327.67, -1e300]))
    torque = np.concatenate((torque, np.round(rng.normal(0, 10, 500), 2) + 0.005))  # ties
    sigma = np.abs(rng.normal(0, 8, len(torque)))
    sigma[:6] = np.nan, np.inf, -1.0, 12.7, 0.0, 12.700001
    status = rng.choice([0, 1, 2, 3, 4, 5, 6, 15], len(torque)).astype(np.uint16)
    expected = [estimate_pdo.field(*each) for each in zip(torque, sigma, status.tolist(), strict=True)]
    assert list(zip(*(each.tolist() for each in fields(torque, sigma, status)), strict=True)) == expected


def test_a_position_goes_on_with_the_turns_that_it_had() -> None:
    fresh, resumed = Unwrap(), Unwrap(3 << 32)
    for raw in (2**31 - 5, -(2**31) + 5, -(2**31) + 20):
        assert resumed.counts(raw) == fresh.counts(raw) + (3 << 32)


def test_turns_that_a_log_in_the_middle_of_a_run_had() -> None:
    """Raw counts beside the continuous positions of the log."""
    inputs = JointInputs(drive_places(0), None, 1e-4, 1e-3, 1e-5, 0.01, 0.0)
    log = records([500])
    log["motor_position_rad"], log["link_position_rad"] = (5 * 2**32 + 77) * 1e-4, (-(2**32) - 12) * 1e-5
    pdo = Pdo((np.array([77]), np.array([-12])), np.array([True]))
    assert offsets([pdo], log, inputs, 0) == (5 * 2**32, -(2**32))


def test_where_the_state_is_known() -> None:
    whole = steps_of(records(list(range(100))), CONFIG)
    assert whole.begins.tolist() == [0]
    assert whole.breaks == ()
    middle = steps_of(records(list(range(50, 100))), CONFIG)
    assert middle.breaks == ((0, BEGINS),)
    assert len(middle.begins) == 0
    log = records([*range(40), *range(60, 100)])
    assert steps_of(log, CONFIG).breaks == ((40, LOST),)
    assert steps_of(log, CONFIG).dt_ns[40] == 21 * MS
    assert lost_cycles(log, CONFIG) == 20
    slots = records([*range(40), *range(60, 100)])  # slots without SYNC: the loop knew, and nothing is lost
    slots["dt_s"][40], slots["sync_counter"] = 0.021, np.arange(80) % 240 + 1
    assert steps_of(slots, CONFIG).breaks == ()
    assert lost_cycles(slots, CONFIG) == 0
    call = records(
        list(range(100))
    )  # the call that sends was late by 0.7 ms, the SYNC was where its echo says
    call["sync_monotonic_ns"][30] -= 700_000
    assert steps_of(call, CONFIG).breaks == ()
    stale = records(list(range(100)))  # cycles without inputs: the next step is longer
    stale["input_flags"][30:35], stale["dt_s"][30:35], stale["dt_s"][35] = 1, np.nan, 0.006
    assert steps_of(stale, CONFIG).breaks == ()
    part = steps_of(log, CONFIG).part(30, 50)
    assert part.breaks == ((10, LOST),)


def test_a_difference_is_excused_only_while_the_state_was_not_known() -> None:
    """In the middle of a run the first cycles differ; one that differs long after is a finding."""
    logged = records(list(range(1000, 3000)))
    made = np.zeros(len(logged), SAMPLE)
    for name in SAMPLE.names or ():
        made[name] = logged[name]
    steps = [steps_of(logged, CONFIG)] * 2
    made["torque_nm"][:150] += 1e-12
    made["torque_nm"][150] = -made["torque_nm"][150]  # -0.0
    logged["torque_nm"][151] = np.nan
    made["torque_nm"][151] = np.nan
    same = identity((logged, logged), (made, made), steps)
    assert same.explained
    assert (same.identical, same.from_cycle) == (2000 - 151, 1151)
    assert {each.cycles for each in same.unknown} == {151}
    made["torque_nm"][151 + SETTLED_CYCLES + 5] += 0.5
    same = identity((logged, logged), (made, made), steps)
    assert not same.explained
    one, two = same.differences
    assert (one.joint, one.cycle, one.cycles, one.largest_nm) == (1, 1151 + SETTLED_CYCLES + 5, 1, 0.5)
    assert two.joint == 2
    made["torque_nm"][:] += 1.0
    same = identity((logged, logged), (made, made), steps)
    assert not same.explained
    assert same.from_cycle is None


def test_bits_are_compared_and_not_values() -> None:
    a = np.array([0.0, np.nan, 1.0, 1.0])
    b = np.array([-0.0, -np.nan, 1.0, np.nextafter(1.0, 2.0)])
    assert bits_equal(a, b).tolist() == [False, True, True, False]
