"""Inputs out of raw frames; rows of a log against the joints of the loop: missing inputs, late estimates, temperatures."""

from __future__ import annotations

import struct
from array import array
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.input_pdos import JointInputs, TemperaturePdo, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.logs import read_topic
from jtqd.daemon.replay.logged import SAMPLE, Pdo, decode, offsets, read_runs
from jtqd.daemon.replay.rows import CycleRows, fields
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.estimator.estimator import make_estimator
from jtqd.estimator.joint import FusedSigma, Joint
from jtqd.estimator.network import load_network
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STALE
from tests.daemon.loop.cycle_helpers import ENABLED, PDOS, SCALE
from tests.daemon.replay.replay_helpers import records
from tests.estimator.fused_configuration import joint_of, network_of
from tests.estimator.fused_helpers import SIGMA, fused
from tests.paths import GOLDEN

ROWS = 1500
PERIOD_NS = 1_000_000
SETTINGS = EstimatorSettings(method="fused", track_torsion=True)


def calm(number: int) -> Joint:
    """Joint 1 or 2 whose sigma at rest is below half of the rated torque."""
    return replace(
        joint_of(number), fused=fused(sigma=FusedSigma(2.0, 1.0, 0.2, 3.5, 0.15, 1.5, SIGMA.scale))
    )


class Counts:
    def __init__(self) -> None:
        self.counters, self.errors = array("Q", [0] * len(COUNTERS)), array("d", [0.0] * 6)


def made() -> tuple[Intake, list[JointCycle]]:
    intake = Intake(PDOS, [TemperaturePdo(0x380 + n, n, f"{n}", 2000) for n in (1, 2)])
    counts = Counts()
    joints = [
        JointCycle(
            n,
            JointInputs(drive_places(2 * n), 4, temperature=n, **SCALE),
            make_estimator(calm(n + 1), SETTINGS, load_network("fused", network_of(n + 1))),
            intake=intake,
            snapshot=counts,
            period_ns=PERIOD_NS,
            safety=JointSafety(None, SETTINGS, calm(n + 1), PERIOD_NS),
        )
        for n in (0, 1)
    ]
    return intake, joints


def guest_flags(rng: np.random.Generator) -> np.ndarray:
    """Of two joints, the first of which is unchecked for a while; SYNC is new at row 40."""
    flags = np.zeros((2, ROWS), int)
    flags[0, 100 : rng.integers(200, 300)] |= cr.FLAG_UNCHECKED
    flags[:, 40:60] |= cr.FLAG_STARTING
    return flags


def log(seed: int) -> dict[str, Any]:
    """Inputs as a log has them; printed seed, everything that may happen to a cycle in it."""
    rng = np.random.default_rng(seed)
    speed, current = np.full((2, ROWS), 50_000), rng.integers(140, 160, (2, ROWS))
    speed[:, 350:600] = rng.integers(-5000, 5000, (2, 250))
    speed[:, 1200:], current[:, 1200:] = (
        rng.integers(-60_000, 60_000, (2, 300)),
        rng.integers(-300, 300, (2, 300)),
    )
    steps = np.cumsum(speed, axis=1) // 100  # 1e-3 rad/s for 1 ms against 1e-4 rad a count
    word = np.full(ROWS, ENABLED)
    word[700:720] = 0x08  # fault
    torque = (rng.integers(-9000, 9000, ROWS), (rng.random(ROWS) < 0.05).astype(int))
    celsius = np.full((2, ROWS), np.nan)
    celsius[0, 300:] = 31.5
    celsius[1, 500:] = 29.0
    dt = np.full((2, ROWS), PERIOD_NS)
    dt[:, rng.integers(0, ROWS, 9)] += 3 * PERIOD_NS
    return {
        "fresh": rng.random((5, ROWS)) > 0.02,
        "values": [
            *[
                part
                for n in (0, 1)
                for part in ((steps[n], steps[n] // 10 - 5), (speed[n], current[n], word))
            ],
            torque,
        ],
        "celsius": celsius,
        "cycle": np.arange(5, ROWS + 5),
        "counter": np.arange(ROWS) % 240 + 1,
        "sync_ns": (1 << 60) + np.cumsum(dt, axis=1),
        "wanted": rng.random((2, ROWS)) > 0.05,
        "flags": np.array([rng.random(ROWS) < 0.03] * 2) * np.uint8(cr.FLAG_WITHDRAWN)
        | guest_flags(rng).astype(np.uint8),
    }


@pytest.mark.parametrize("seed", [31, 32])
def test_rows_are_what_the_joints_make_of_each_cycle(seed: int) -> None:
    given = log(seed)
    intake, joints = made()
    samples: list[list[tuple[float, ...]]] = [[], []]
    pdos = b""
    from_log = 0
    for row in range(ROWS):
        for n, (fresh, values) in enumerate(zip(given["fresh"], given["values"], strict=True)):
            intake.place(n, [int(each[row]) for each in values] if fresh[row] else None)
        intake.age_temperatures(int(given["cycle"][row]))
        for n, logged in enumerate(given["celsius"]):
            if not np.array_equal(intake.temperature(n), logged[row], equal_nan=True):
                frame = struct.pack("<IB3xh", 0x381 + n, 2, round(10 * logged[row]))
                intake.receive_temperature(n, frame)
                from_log += 1
        for n, joint in enumerate(joints):
            flags = given["flags"][n, row]
            joint.trust(not flags & cr.FLAG_UNCHECKED)
            starting = bool(given["cycle"][row] < 20 or flags & cr.FLAG_STARTING)
            joint.observe(int(given["sync_ns"][n, row]), starting, bool(given["wanted"][n, row]))
            if flags & cr.FLAG_WITHDRAWN:
                joint.withdraw(STALE)
            samples[n].append(joint.sample)
        pdos += estimate_pdo.encode(joints[0].published, joints[1].published, int(given["counter"][row]))
    again, others = made()
    rows = CycleRows(again, others, **given)
    for first, end in ((0, 1), (1, 700), (700, 700), (700, ROWS)):
        rows.go_on(first, end)
    for n in (0, 1):
        assert rows.samples[n].view(SAMPLE)[:, 0].tobytes() == np.array(samples[n], SAMPLE).tobytes(), (
            f"seed {seed}"
        )
    assert rows.estimates.tobytes() == pdos
    assert rows.temperatures_from_log == from_log == 2
    published = rows.samples[0].view(SAMPLE)[:, 0]["status"]
    assert {1, 2, 3, 4, 5, 6} <= set(published.tolist())
    assert (published[given["flags"][0] != 0] != 2).all()


def test_arrays_that_do_not_fit_are_refused() -> None:
    intake, joints = made()
    for key in ("fresh", "celsius", "counter", "sync_ns", "wanted", "flags"):
        given = log(1)
        given[key] = given[key][..., :-1]
        with pytest.raises(ValueError, match="found an array of shape"):
            CycleRows(intake, joints, **given)
    rows = CycleRows(intake, joints, **log(1))
    for first, end in ((-1, 3), (5, 3), (0, ROWS + 1)):
        with pytest.raises(ValueError, match=f"found rows {first} to {end}"):
            rows.go_on(first, end)


def test_fields_are_those_of_the_pdo() -> None:
    rng = np.random.default_rng(1)
    torque = np.concatenate((rng.normal(0, 200, 3000), [np.nan, np.inf, 327.67, 327.68, -327.67, -1e300]))
    torque = np.concatenate((torque, np.round(rng.normal(0, 10, 500), 2) + 0.005))  # ties
    sigma = np.abs(rng.normal(0, 8, len(torque)))
    sigma[:6] = np.nan, np.inf, -1.0, 12.7, 0.0, 12.700001
    status = rng.choice([0, 1, 2, 3, 4, 5, 6, 15], len(torque)).astype(np.uint16)
    expected = [estimate_pdo.field(*each) for each in zip(torque, sigma, status.tolist(), strict=True)]
    assert list(zip(*(each.tolist() for each in fields(torque, sigma, status)), strict=True)) == expected


def test_a_log_from_the_middle_of_a_run_has_the_turns_of_its_positions() -> None:
    """Raw counts beside the continuous positions of the log."""
    inputs = JointInputs(drive_places(0), None, 1e-4, 1e-3, 1e-5, 0.01, 0.0)
    log = records([500])
    log["motor_position_rad"], log["link_position_rad"] = (5 * 2**32 + 77) * 1e-4, (-(2**32) - 12) * 1e-5
    pdo = Pdo((np.array([77]), np.array([-12])), np.array([True]))
    assert offsets([pdo], log, inputs, 0) == (5 * 2**32, -(2**32))


def test_of_a_record_without_room_for_all_frames_the_si_values_count(tmp_path: Path) -> None:
    """The last frame in the record may be an older one: the log's SI values beside it are those that were used."""
    log = GOLDEN / "network.mcap"
    ((run, before),) = read_runs([log], tmp_path)
    frames = read_topic(log, "/can/frames")
    assert before.from_si == 0
    rows = [300, 301, 700]
    frames["frames"]["data"][rows] ^= 0x55
    spoilt = decode(run.setup, frames, run.joints)
    frames["frames_left_out"][rows] = 1
    after = decode(run.setup, frames, run.joints)
    assert spoilt.from_si == 0
    assert after.from_si == sum(int(pdo.fresh[rows].sum()) for pdo in before.pdos) > 0
    pdos = zip(before.pdos, after.pdos, spoilt.pdos, strict=True)
    same = [
        ((old == new)[one.fresh].all(), (old == bad)[rows].all())
        for one, two, three in pdos
        for old, new, bad in zip(one.values, two.values, three.values, strict=True)
    ]
    assert all(kept for kept, _ in same)
    assert not all(unchanged for _, unchanged in same)
