"""TPDO3 at the intake: taken whenever it comes, waited for never, counted when it is garbage."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
import yaml

from jtqd.daemon.bus.boot import boot_request, bus_load_of
from jtqd.daemon.config import load_config
from jtqd.daemon.core.cycle import frame_counts
from jtqd.daemon.core.input_pdos import InputPdo, TemperaturePdo, joint_inputs, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.drivers.boot import DriveNode
from jtqd.drivers.drive import Temperature
from tests.daemon.snapshots import counted
from tests.shipped_bench import shipped_bench

POSITION = InputPdo(0x181, 8, struct.Struct("<ii"), 1, "181h drive 1 TPDO1")
NAME = "381h drive 1 TPDO3"
MS = 1_000_000


def frame(can_id: int, data: bytes, length: int | None = None) -> bytes:
    return struct.pack("<IB3x8s", can_id, len(data) if length is None else length, data)


def celsius(tenths: int) -> bytes:
    return frame(0x381, struct.pack("<h", tenths))


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
    frames = (celsius(-253),)
    assert line.cycle(*frames) if when == "frames" else line.cycle(**{when: frames})
    line.cycle()
    assert line.value == pytest.approx(-25.3)
    assert not any(counted(line.intake).values())


def test_the_newest_of_several_counts(line: Line) -> None:
    line.cycle(celsius(250), celsius(251), celsius(249), before=(celsius(300),))
    assert line.value == pytest.approx(24.9)
    assert counted(line.intake)["duplicate_frames"] == 0


def test_lost_after_two_seconds_and_back_with_the_next_frame(line: Line) -> None:
    line.cycle(celsius(250))
    for _ in range(2000):
        assert line.cycle()
        assert line.value == 25.0
    assert line.cycle(), "and never a reason for stale"
    assert math.isnan(line.value)
    for _ in range(3000):
        assert line.cycle()
    assert frame_counts(line.intake)[NAME] == {"late": 0, "lost": 1, "duplicate": 0, "rejected": 0}
    line.cycle(celsius(260))
    assert line.value == 26.0


def test_a_frame_in_time_prolongs_it(line: Line) -> None:
    for n in range(6000):
        line.cycle(*([celsius(250)] if n % 1900 == 0 else []))
        assert line.value == 25.0
    assert counted(line.intake)["temperatures_lost"] == 0


def test_not_measured_is_unknown_at_once_and_no_loss(line: Line) -> None:
    line.cycle(celsius(250))
    line.cycle(celsius(-0x8000))
    assert math.isnan(line.value)
    assert frame_counts(line.intake)[NAME] == {"late": 0, "lost": 0, "duplicate": 0, "rejected": 0}
    line.cycle(celsius(-0x7FFF))
    assert line.value == pytest.approx(-3276.7)


@pytest.mark.parametrize("length", [0, 1, 3, 8, 200])
def test_another_length_is_rejected_and_counted(line: Line, length: int) -> None:
    line.cycle(celsius(250))
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
    line.cycle(celsius(250))
    line.cycle(frame(0x701, b"\x00"), celsius(600))
    assert line.value == 25.0, "what it told before is as old as it is"
    line.cycle(celsius(600), late=(celsius(600),))
    assert line.value == 25.0
    line.intake.configured(1)
    line.cycle(celsius(260))
    assert line.value == 26.0


def test_a_foreign_sync_says_nothing_about_it(line: Line) -> None:
    assert not line.cycle(frame(0x080, b"\x07"), celsius(250))
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
    for number, inputs in enumerate(joint_inputs(config, report), start=1):
        node = None if inputs.temperature is None else found[inputs.temperature].node_id
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
    intake.receive_temperature(0, celsius(250))
    for cycle in (0, 2000, 2001):
        intake.age_temperatures(cycle)
        assert math.isnan(intake.temperature(0)) == (cycle > 2000)
