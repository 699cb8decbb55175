"""The temperature of a joint: TPDO3 at the intake, from its frame to estimator, record, snapshot, and from the log."""

from __future__ import annotations

import itertools
import math
import random
import struct
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import boot_request, bus_load_of
from jtqd.daemon.config import load_config
from jtqd.daemon.core.cycle import frame_counts
from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.input_pdos import InputPdo, TemperaturePdo, joint_inputs, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_TEMPERATURE
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.boot import DriveNode
from jtqd.drivers.drive import Temperature
from jtqd.estimator.estimator import Estimator, make_estimator
from jtqd.estimator.network import load_network
from jtqd.estimator.settings import EstimatorSettings
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import I32, ExactTime, estimates, inputs, make, turn
from tests.daemon.snapshots import counted
from tests.estimator.fused_configuration import joint_of, network_of
from tests.shipped_bench import shipped_bench

LIFE = 200
"""Slots; the real 2 s are 2000 at 1 kHz."""


@pytest.fixture(autouse=True)
def _exact_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cycle is late only where a test wants it to be."""
    ExactTime().install(monkeypatch)


def frame(can_id: int, data: bytes, length: int | None = None) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data) if length is None else length, data)


def temperatures() -> list[TemperaturePdo]:
    return [TemperaturePdo(0x380 + n, n, f"38{n}h drive {n} TPDO3", LIFE) for n in (1, 2)]


def tpdo3(node: int, tenths: int) -> bytes:
    return frame(0x380 + node, struct.pack("<h", tenths))


def coupled(velocity: int = 5000, cycle: int = 0) -> list[bytes]:
    """The inputs with both encoders of a joint at the same angle: its torsion tells no absurd torque.

    cycle: of 10 ms, so that the joints turn with this velocity.
    """
    angle = 1000 + velocity * cycle // 10
    positions = [
        frame(0x180 + n, I32.pack(sign * angle, sign * (angle // 10))) for n, sign in ((1, 1), (2, -1))
    ]
    _, one, _, two, sensor = inputs(velocity=velocity)
    return [positions[0], one, positions[1], two, sensor]


class Spy:
    """An estimator that keeps the temperatures it is given."""

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner
        self.given: list[float] = []
        self.with_network = inner.with_network

    def step(self, *sample: float) -> Any:
        self.given.append(sample[5])
        return self.inner.step(*sample)


def fused(number: int) -> Estimator:
    network = load_network("fused", network_of(number))
    return make_estimator(joint_of(number), EstimatorSettings(method="fused", track_torsion=True), network)


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
    """The network's training had temperatures: without one it is not trusted, and sigma is wider."""
    sigmas = []
    for name, extra in (("without", []), ("with", [tpdo3(1, 250), tpdo3(2, 250)])):
        (tmp_path / name).mkdir()
        cycle, socket, reader = make(
            tmp_path / name,
            lambda n, extra=extra: [*coupled(cycle=n), *extra],
            temperatures=temperatures(),
            estimators=[fused(1), fused(2)],
        )
        turn(cycle, 30)
        assert decode(estimates(socket)[-1]).status == (2, 2)
        joint = cr.joint_of(reader.read().records[-1], 1)
        sigmas.append(joint.sigma_nm)
        if not extra:
            assert math.isnan(joint.temperature_c)
            assert joint.input_flags == 7
    assert sigmas[0] > 1.2 * sigmas[1]


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


POSITION = InputPdo(0x181, 8, struct.Struct("<ii"), 1, "181h drive 1 TPDO1")
NAME = "381h drive 1 TPDO3"
MS = 1_000_000


class Line:
    """An intake with one input and one temperature, cycle by cycle."""

    def __init__(self) -> None:
        self.intake = Intake([POSITION], [TemperaturePdo(0x381, 1, NAME, 2000)])
        self.cycle_number = 0

    def cycle(self, *frames: bytes, before: tuple[bytes, ...] = (), late: tuple[bytes, ...] = ()) -> bool:
        """One cycle with its input; `frames` after SYNC's echo, `before` ahead of it, `late` after the close."""
        number, intake = self.cycle_number, self.intake
        self.cycle_number += 1
        counter = number % 240 + 1
        intake.begin(counter)
        echo = frame(0x080, bytes((counter,)))
        batch = [*before, echo, frame(0x181, bytes(8)), *frames]
        stamps = [MS * (number + 1) + 1000 * n for n in range(len(batch))]
        own = [data is echo for data in batch]
        assert intake.take(bytearray(b"".join(batch)), stamps, own, len(batch)), (
            "nobody waits for a temperature"
        )
        complete = intake.close()
        intake.age_temperatures(number)
        if late:
            intake.drain(
                bytearray(b"".join(late)), [MS * (number + 2)] * len(late), [False] * len(late), len(late)
            )
        return complete

    @property
    def value(self) -> float:
        return self.intake.temperature(0)


@pytest.fixture
def line() -> Line:
    return Line()


def test_unknown_until_the_first_frame_and_complete_without_any(line: Line) -> None:
    assert all(line.cycle() for _ in range(5000))
    assert math.isnan(line.value)
    assert counted(line.intake)["temperatures_lost"] == 0, "what never came was not lost"
    assert counted(line.intake)["stale_inputs"] == 0


@pytest.mark.parametrize("when", ["frames", "before", "late"])
def test_it_counts_whenever_it_comes(line: Line, when: str) -> None:
    frames = (tpdo3(1, -253),)
    assert line.cycle(*frames) if when == "frames" else line.cycle(**{when: frames})
    line.cycle()
    assert line.value == pytest.approx(-25.3)
    assert not any(counted(line.intake).values())


def test_the_newest_of_several_counts(line: Line) -> None:
    line.cycle(tpdo3(1, 250), tpdo3(1, 251), tpdo3(1, 249), before=(tpdo3(1, 300),))
    assert line.value == pytest.approx(24.9)
    assert counted(line.intake)["duplicate_frames"] == 0


def test_lost_after_two_seconds_and_back_with_the_next_frame(line: Line) -> None:
    line.cycle(tpdo3(1, 250))
    for _ in range(2000):
        assert line.cycle()
        assert line.value == 25.0
    assert line.cycle(), "and never a reason for stale"
    assert math.isnan(line.value)
    for _ in range(3000):
        assert line.cycle()
    assert frame_counts(line.intake)[NAME] == {"late": 0, "lost": 1, "duplicate": 0, "rejected": 0}
    line.cycle(tpdo3(1, 260))
    assert line.value == 26.0


def test_a_frame_in_time_prolongs_it(line: Line) -> None:
    for n in range(6000):
        line.cycle(*([tpdo3(1, 250)] if n % 1900 == 0 else []))
        assert line.value == 25.0
    assert counted(line.intake)["temperatures_lost"] == 0


def test_not_measured_is_unknown_at_once_and_no_loss(line: Line) -> None:
    line.cycle(tpdo3(1, 250))
    line.cycle(tpdo3(1, -0x8000))
    assert math.isnan(line.value)
    assert frame_counts(line.intake)[NAME] == {"late": 0, "lost": 0, "duplicate": 0, "rejected": 0}
    line.cycle(tpdo3(1, -0x7FFF))
    assert line.value == pytest.approx(-3276.7)


@pytest.mark.parametrize("length", [0, 1, 3, 8, 200])
def test_another_length_is_rejected_and_counted(line: Line, length: int) -> None:
    line.cycle(tpdo3(1, 250))
    assert line.cycle(frame(0x381, struct.pack("<h", 999), length))
    line.cycle(late=(frame(0x381, struct.pack("<h", 999), length),))
    assert line.value == 25.0
    assert frame_counts(line.intake)[NAME]["rejected"] == counted(line.intake)["rejected_frames"] == 2


@pytest.mark.parametrize("flag", [0x8000_0000, 0x4000_0000, 0xC000_0000])
def test_29_bit_and_remote_frames_are_rejected_and_named(line: Line, flag: int) -> None:
    line.cycle(frame(0x381 | flag, struct.pack("<h", 999)))
    assert math.isnan(line.value)
    assert frame_counts(line.intake)[NAME]["rejected"] == counted(line.intake)["rejected_frames"] == 1


def test_a_node_that_restarted_is_not_believed_until_it_is_configured(line: Line) -> None:
    """Its TPDO3 may hold anything by default."""
    line.cycle(tpdo3(1, 250))
    line.cycle(frame(0x701, b"\x00"), tpdo3(1, 600))
    assert line.value == 25.0, "what it sent before is as old as it is"
    line.cycle(tpdo3(1, 600), late=(tpdo3(1, 600),))
    assert line.value == 25.0
    line.intake.configured(1)
    line.cycle(tpdo3(1, 260))
    assert line.value == 26.0


def test_a_foreign_sync_says_nothing_about_it(line: Line) -> None:
    assert not line.cycle(frame(0x080, b"\x07"), tpdo3(1, 250))
    assert line.value == 25.0


def test_two_users_of_one_identifier_are_refused() -> None:
    one = TemperaturePdo(0x381, 1, "a", 10)
    for pdos, temperatures in (
        ([POSITION], [one, one]),
        ([InputPdo(0x381, 8, struct.Struct("<ii"), 1, "b")], [one]),
    ):
        with pytest.raises(ValueError, match="share a COB-ID"):
            Intake(pdos, temperatures)


@pytest.mark.parametrize("have", [(), (1,), (2,), (1, 2)])
def test_each_joint_finds_its_own(tmp_path: Path, have: tuple[int, ...]) -> None:
    content = shipped_bench()
    content["estimator"] = {"method": "tob"}
    for number in (1, 2):
        content[f"joint_{number}"]["temperature"] = number in have
    if 2 in have:
        content["joint_2"]["objects"] = {"temperature": {"index": 0x2040, "sub": 1, "factor": 0.01}}
    path = tmp_path / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    config = load_config(path)
    drive = {"motor_rad_per_count": 1.0, "motor_rad_s_per_unit": 1.0, "link_rad_per_count": 1.0}
    scaling = {"1": drive | {"ampere_per_unit": 1.0}, "3": {"nm_per_unit": {"1": 1.0}}}
    scaling["2"] = scaling["1"]
    report = {"nodes": {node: {"scaling": factors} for node, factors in scaling.items()}}
    found = joint_temperatures(config)
    for number, joint in enumerate(joint_inputs(config, report), start=1):
        node = None if joint.temperature is None else found[joint.temperature].node_id
        assert node == (number if number in have else None)
    intake = Intake([], found)
    for n, each in enumerate(found):
        intake.receive_temperature(n, frame(each.cob_id, struct.pack("<h", 250)))
        unit = "by the unit of its object"
        assert intake.temperature(n) == pytest.approx(25.0 if each.node_id == 1 else 2.5), unit
    asked = {
        each.node: each.temperature for each in boot_request(config, "b").nodes if isinstance(each, DriveNode)
    }
    assert (2 in have) == (asked[2] == Temperature(0x2040, 1, 0.01))
    assert [row.cob_id for row in bus_load_of(config).rows if row.length == 2] == [0x380 + n for n in have]


def test_the_configuration_says_which_joints_have_one_and_two_seconds_are_slots() -> None:
    found = joint_temperatures(load_config(None))
    assert [(each.cob_id, each.node_id, each.name) for each in found] == [
        (0x381, 1, "381h drive 1 TPDO3"),
        (0x382, 2, "382h drive 2 TPDO3"),
    ]
    intake = Intake([], found)
    intake.receive_temperature(0, tpdo3(1, 250))
    for cycle in (0, 2000, 2001):
        intake.age_temperatures(cycle)
        assert math.isnan(intake.temperature(0)) == (cycle > 2000)
