"""The temperature of a joint from its frame to the estimator, the record and the snapshot; and again from the log."""

from __future__ import annotations

import itertools
import math
import random
import struct
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.core.cycle import frame_counts
from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.input_pdos import TemperaturePdo
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_TEMPERATURE
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.methods import AnyEstimator, make_estimator
from jtqd.estimator.network import load_network
from jtqd.estimator.settings import EstimatorSettings
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import I32, ExactTime, estimates, frame, inputs, make, turn
from tests.estimator.fused_configuration import joint_of, network_of

LIFE = 200
"""Slots; the real 2 s are 2000 at 1 kHz."""


@pytest.fixture(autouse=True)
def _exact_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cycle is late only where a test wants it to be."""
    ExactTime().install(monkeypatch)


def temperatures() -> list[TemperaturePdo]:
    return [TemperaturePdo(0x380 + n, n, f"38{n}h drive {n} TPDO3", LIFE) for n in (1, 2)]


def tpdo3(node: int, tenths: int) -> bytes:
    return frame(0x380 + node, struct.pack("<h", tenths))


def coupled(velocity: int = 5000) -> list[bytes]:
    """The inputs with both encoders of a joint at the same angle: its torsion tells no absurd torque."""
    positions = [frame(0x180 + n, I32.pack(sign * 1000, sign * 100)) for n, sign in ((1, 1), (2, -1))]
    _, one, _, two, sensor = inputs(velocity=velocity)
    return [positions[0], one, positions[1], two, sensor]


class Spy:
    """An estimator that keeps the temperatures it is given."""

    def __init__(self, inner: AnyEstimator) -> None:
        self.inner = inner
        self.given: list[float] = []
        self.with_network = inner.with_network

    def step(self, *sample: float) -> Any:
        self.given.append(sample[5])
        return self.inner.step(*sample)


def fused(number: int) -> AnyEstimator:
    network = load_network("fused", network_of(number))
    return make_estimator(joint_of(number), EstimatorSettings(method="fused"), network)


def test_each_joint_has_its_own_from_the_cycle_of_its_frame_on(tmp_path: Path) -> None:
    def script(n: int) -> list[bytes]:
        extra = {3: [tpdo3(2, -15)], 5: [tpdo3(1, 251)], 7: [tpdo3(1, 252), tpdo3(2, -14)]}
        return inputs() + extra.get(n, [])

    spies = [Spy(fused(1)), Spy(fused(2))]
    cycle, _, reader = make(tmp_path, script, temperatures=temperatures(), estimators=spies)
    turn(cycle, 9)
    nan = math.nan
    assert spies[0].given == pytest.approx([nan] * 4 + [25.1] * 2 + [25.2] * 3, nan_ok=True)
    assert spies[1].given == pytest.approx([nan] * 2 + [-1.5] * 4 + [-1.4] * 3, nan_ok=True)
    records = reader.read().records
    for number, spy in enumerate(spies, start=1):
        joints = [cr.joint_of(record, number) for record in records]
        assert [joint.temperature_c for joint in joints] == pytest.approx(spy.given, nan_ok=True)
        known = [bool(joint.input_flags & FLAG_TEMPERATURE) for joint in joints]
        assert known == [not math.isnan(value) for value in spy.given]
        assert {joint.input_flags & 7 for joint in joints} == {7}


def test_a_temperature_changes_the_estimate_of_a_method_that_knows_it(tmp_path: Path) -> None:
    """Cold oil is stiffer: at 15 degC more of the motor's torque is lost than at the fit's 25 degC."""
    torques = []
    for tenths in (150, 250):
        directory = tmp_path / str(tenths)
        directory.mkdir()
        script = [*coupled(velocity=20_000), tpdo3(1, tenths)]
        cycle, socket, _ = make(
            directory,
            lambda n, script=script: script,
            temperatures=temperatures(),
            estimators=[fused(1), fused(2)],
        )
        turn(cycle, 60)
        torque = decode(estimates(socket)[-1]).torque_nm[0]
        assert torque is not None
        torques.append(torque)
    assert torques[0] < torques[1] - 0.05


def test_without_one_the_joint_is_estimated_all_the_same(tmp_path: Path) -> None:
    cycle, socket, reader = make(
        tmp_path, lambda n: coupled(), temperatures=temperatures(), estimators=[fused(1), fused(2)]
    )
    turn(cycle, 30)
    # degraded: the network's training data had temperatures, so that its share of trust is zero without one
    assert decode(estimates(socket)[-1]).status == (3, 3)
    joint = cr.joint_of(reader.read().records[-1], 1)
    assert math.isnan(joint.temperature_c)
    assert joint.input_flags == 7


def test_it_is_kept_for_its_life_and_then_unknown(tmp_path: Path) -> None:
    cycle, socket, reader = make(
        tmp_path,
        lambda n: inputs() + ([tpdo3(1, 300)] if n in {10, 230} else []),
        temperatures=temperatures(),
        slots=256,
    )
    turn(cycle, 235)
    joints = [cr.joint_of(record, 1) for record in reader.read(limit=256).records]
    known = [n for n, joint in enumerate(joints) if joint.temperature_c == 30.0]
    assert known == [*range(9, 9 + LIFE + 1), *range(229, 235)]
    assert {decode(data).status for data in estimates(socket)[20:]} == {(2, 2)}, "never a reason for stale"
    turn(cycle, 8)
    view = SnapshotReader(tmp_path / "snapshot").read()
    assert view.counters["temperatures_lost"] == 1
    assert [joint.input_flags for joint in view.joints] == [15, 7]


def test_slots_that_were_missed_make_it_older(tmp_path: Path) -> None:
    cycle, _, reader = make(
        tmp_path, lambda n: inputs() + ([tpdo3(1, 300)] if n == 1 else []), temperatures=temperatures()
    )
    turn(cycle)
    cycle.skip(LIFE - 1)
    turn(cycle, 2)
    temperature = [cr.joint_of(record, 1).temperature_c for record in reader.read().records]
    assert temperature == pytest.approx([30.0, 30.0, math.nan], nan_ok=True)


def test_a_stale_joint_keeps_it_in_the_log(tmp_path: Path) -> None:
    cycle, _, reader = make(tmp_path, lambda n: [*inputs()[1:], tpdo3(1, 301)], temperatures=temperatures())
    turn(cycle, 3)
    joint = cr.joint_of(reader.read().records[-1], 1)
    assert (joint.status, joint.temperature_c, joint.input_flags) == (4, pytest.approx(30.1), 2 | 4 | 8)


def test_an_estimate_that_is_withdrawn_keeps_its_inputs_in_the_log(tmp_path: Path) -> None:
    cycle, _, reader = make(tmp_path, lambda n: [*inputs(), tpdo3(1, 301)], temperatures=temperatures())
    turn(cycle, 30)

    def late() -> None:
        cycle.grid.slot_ns -= 20_000_000  # the next SYNC was due 10 ms ago

    before = cr.joint_of(reader.read().records[-1], 1)
    turn(cycle, publish=late)
    joint = cr.joint_of(reader.read(limit=64).records[-1], 1)
    assert joint.status == 4
    assert (math.isnan(joint.torque_nm), math.isnan(joint.sigma_nm)) == (True, True)
    kept = ("temperature_c", "sensor_torque_nm", "current_a", "statusword", "sensor_status", "input_flags")
    assert [getattr(joint, name) for name in kept] == [getattr(before, name) for name in kept]
    assert joint.physics_nm == pytest.approx(before.physics_nm, abs=0.5)


def replayed(records: list[bytes], node: int) -> list[float]:
    """What the rule of docs/bus.md gives from the frames and cycle numbers of a log."""
    value, heard, result = math.nan, 0, []
    for record in records:
        cycle = cr.header_of(record).cycle
        for data, _ in rr.frames_of(record):
            can_id, length = struct.unpack_from("<IB", data)
            if can_id == 0x380 + node and length == 2:
                (raw,) = struct.unpack_from("<h", data, 8)
                value, heard = (math.nan if raw == -0x8000 else 0.1 * raw), cycle
        result.append(value if cycle - heard <= LIFE else math.nan)
    return result


@pytest.mark.parametrize("seed", range(4))
def test_frames_and_cycle_numbers_of_the_log_give_the_same_values_again(tmp_path: Path, seed: int) -> None:
    """Frames at any time, also between two cycles and in slots without SYNC, garbage among them; slots missed."""
    random_ = random.Random(seed)

    def some() -> list[bytes]:
        kinds = [
            tpdo3(random_.choice((1, 2)), random_.choice((-0x8000, random_.randrange(-400, 900)))),
            frame(0x381, bytes(random_.choice((0, 1, 3, 8)))),
            frame(0x8000_0382, struct.pack("<h", 111)),
        ]
        return [random_.choice(kinds) for _ in range(random_.choice((0, 0, 0, 0, 0, 0, 1, 2)))]

    quiet = iter(itertools.cycle([True] * 500 + [False] * 500))
    cycle, socket, reader = make(
        tmp_path,
        lambda n: inputs() + ([] if next(quiet) else some()),
        temperatures=temperatures(),
        slots=2048,
    )
    for _ in range(1500):
        socket.pending += [(data, False) for data in some() if random_.random() < 0.05]  # late, for the drain
        if random_.random() < 0.02:
            cycle.intake.gap_wanted = True
            assert cycle.pass_slot()
            socket.pending += [(data, False) for data in some()]  # in the slot without SYNC
            assert not cycle.pass_slot()
        turn(cycle)
        cycle.skip(random_.choice((0, 0, 0, 0, 50)) * (random_.random() < 0.1))
    records = reader.read(limit=2048).records
    assert len(records) == 1500
    for number in (1, 2):
        used = [cr.joint_of(record, number).temperature_c for record in records]
        assert used == pytest.approx(replayed(records, number), nan_ok=True), f"seed {seed}"
        assert 300 < sum(math.isnan(value) for value in used) < 1400
    for counts in [*frame_counts(cycle.intake).values()][-2:]:
        assert counts["rejected"] > 10
