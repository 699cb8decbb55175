"""What a drive tells of its units and TPDOs is in the section that `jtq init` and `jtq probe` write.

On a bus the drives are the canopen library's (tests/library_drives): what was written is booted, and the PDOs, scaled, must
say how their motors move.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.bus.boot import boot_request
from jtqd.daemon.cli import init, probe
from jtqd.daemon.cli.proposal import (
    JointProposal,
    Wanted,
    drive_lines,
    kept_tpdos,
    reported_units,
    unit_problems,
)
from jtqd.daemon.config import load_config
from jtqd.drivers.drive import CIA_402, DriveProfile, drive_scaling
from jtqd.drivers.pdo import Tpdo
from jtqd.drivers.survey import Survey, survey_of_eds
from tests.drivers.canopen_nodes import booted
from tests.library_drives.bench import LibraryBench
from tests.library_drives.motion import moves_as_it_should, quantities
from tests.library_drives.nodes import GEAR
from tests.paths import ROOT

EDS = ROOT / "drivers" / "eds" / "drive.eds"
OPTIONS = ["--rated-torque", "30", "--torque-constant", "0.1", "--gear-ratio", str(GEAR)]
QUANTITIES = ("motor_position", "link_position", "motor_velocity")
MILLIDEGREE = 0xFD41_0000


def drive(numbers: dict[tuple[int, int], int] | None = None, tpdos: tuple[Tpdo, ...] = ()) -> Survey:
    """A drive of node 5 with a gear of 100:1 and encoders of 65536 and 524288 counts."""
    reported = {
        (0x608F, 1): 65536,
        (0x608F, 2): 1,
        (0x6090, 1): 65536,
        (0x6090, 2): 1,
        (0x60E6, 1): 524288,
        (0x60EB, 1): 1,
        (0x6091, 1): 100,
        (0x6091, 2): 1,
        (0x6075, 0): 5000,
        (0x6076, 0): 400,
        **(numbers or {}),
    }
    return Survey(
        5, "the bus", 402, {}, {key: value for key, value in reported.items() if value}, tpdos=tpdos
    )


def entries(numbers: dict[tuple[int, int], int], gear: float = 100.0) -> dict[str, Any]:
    found = reported_units(drive(numbers), gear, QUANTITIES, ())
    return {name: each.value for name, each in found.items()}


# Units --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "numbers",
    [
        {},
        {(0x60A8, 0): 0, (0x60A9, 0): 0, (0x6092, 1): 1, (0x6092, 2): 1},
        {(0x60A8, 0): 0x00B5_0000},
        {(0x6092, 1): 6_553_600, (0x6092, 2): 1},
    ],
    ids=[
        "none",
        "of a drive that was reported nothing",
        "increments",
        "counts of the motor per turn of the joint",
    ],
)
def test_counts_need_no_word(numbers: dict[tuple[int, int], int]) -> None:
    assert entries(numbers) == {}


def test_each_unit_is_scaled_by_its_object() -> None:
    position = {"motor_position": {"by": "60A8h"}, "link_position": {"by": "60A8h"}}
    assert entries({(0x60A8, 0): MILLIDEGREE, (0x60A9, 0): 0x00B4_4700}) == {
        **position,
        "motor_velocity": {"by": "60A9h"},
    }
    assert entries({(0x60A9, 0): 0x00B5_0300}) == {"motor_velocity": {"by": "608Fh"}}
    assert entries({(0x6092, 1): 36000, (0x6092, 2): 1}) == {name: {"by": "6092h"} for name in QUANTITIES}
    both = {(0x60A8, 0): MILLIDEGREE, (0x6092, 1): 36000, (0x6092, 2): 1, (0x60A9, 0): 0xFD41_0300}
    assert entries(both)["motor_position"] == {"by": "60A8h"}, "the unit's own word goes before"


@pytest.mark.parametrize(("reported", "gear"), [(100, 100.0), (1, 100.0), (0, 100.0), (50, 100.0), (1, 1.0)])
@pytest.mark.parametrize("velocity", [0, 0xFD41_0300])
def test_the_unit_is_right_whatever_gear_the_drive_counts_with(
    reported: int, gear: float, velocity: int
) -> None:
    """One millidegree of the shaft behind the drive's own gear; the link's position has nothing to do with a gear."""
    numbers = {
        (0x60A8, 0): MILLIDEGREE,
        (0x60A9, 0): velocity,
        (0x6091, 1): reported,
        (0x6091, 2): reported and 1,
    }
    survey = drive(numbers)
    wanted = Wanted(gear_ratio=gear, rated_torque_nm=30.0, torque_constant_nm_per_a=0.1)
    section = yaml.safe_load("\n".join(drive_lines(JointProposal(1, 5, survey, wanted))))["joint_1"]
    given = {(int(name[:4], 16), int(name[6:])): value for name, value in section.get("given", {}).items()}
    objects = CIA_402
    for name, keys in section["objects"].items():
        objects = replace(objects, **{name: replace(getattr(objects, name), **keys)})
    scaling, _ = drive_scaling(DriveProfile(5, objects=objects, given=given), survey.numbers)
    millidegree = 1.7453292519943296e-05
    assert scaling.motor_rad_per_count == pytest.approx(millidegree * (reported or 1))
    assert scaling.motor_rad_s_per_unit == pytest.approx(millidegree * (reported or 1))
    assert scaling.link_rad_per_count == pytest.approx(millidegree)


def test_what_is_not_sure_is_a_guess() -> None:
    survey = drive({(0x60A8, 0): MILLIDEGREE})
    joint = JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0, torque_constant_nm_per_a=0.1))
    guesses = [each for each in joint.guesses if "objects" in each]
    assert [each.split(": ")[1].split(" = ")[0] for each in guesses] == ["link_position", "motor_velocity"]
    assert "no 60A9h: 606Ch taken for 60A8h per second" in guesses[1]
    assert sum("# GUESS" in line for line in drive_lines(joint)) == 2


def test_increments_per_second_are_those_of_the_option() -> None:
    """A drive that names the unit of its velocity, and has no 608Fh that tells how many a turn are."""
    survey = drive({(0x608F, 1): 0, (0x608F, 2): 0, (0x60A8, 0): 0x00B5_0000, (0x60A9, 0): 0x00B5_0300})
    assert (
        "no section of the configuration yet: node 5: 608Fh:1 is not known: give --encoder-counts"
        in probe.text(survey, [])
    )
    joint = JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0, encoder_counts=4096))
    assert {name: each.value for name, each in joint.objects.items()} == {"motor_velocity": {"by": "608Fh"}}
    assert joint.objects["motor_velocity"].origin == "60A9h:0 is 0x00B50300, by the bus"
    assert (0x6090, 1) not in joint.given


def test_counts_by_an_option_go_before_what_the_drive_tells() -> None:
    survey = drive({(0x60A8, 0): MILLIDEGREE, (0x60A9, 0): 0xFD41_0300})
    wanted = Wanted(rated_torque_nm=30.0, encoder_counts=4096, link_encoder_counts=8192)
    joint = JointProposal(1, 5, survey, wanted)
    assert joint.objects == {}
    assert {key: value.value for key, value in joint.given.items()}[0x608F, 1] == 4096


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ({(0x60A8, 0): 0x0001_0000}, "60A8h:0, the unit of positions: expected 0xXX100000 (rad), 0xXX41"),
        ({(0x60A9, 0): 0x0001_0300}, "60A9h:0, the unit of velocities: expected 0xXX10, 0xXX41 or 0xXXB4"),
    ],
)
def test_a_unit_that_is_no_angle_is_reported(numbers: dict[tuple[int, int], int], text: str) -> None:
    survey = drive(numbers)
    (problem,) = unit_problems(survey)
    assert problem.startswith(f"node 5 (drive): {text}")
    assert "found 0x0001" in problem
    assert probe.problems_of(survey) == [problem]
    assert JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0)).problems == [problem]


# TPDOs --------------------------------------------------------------------------------------------------------------

OWN = (
    Tpdo(1, 0x185, (0x6064_0020, 0x60E4_0120)),
    Tpdo(2, 0x285, (0x606C_0020, 0x6078_0010, 0x6041_0010)),
)
MAKERS = (
    Tpdo(1, 0x185, (0x6041_0010, 0x6064_0020)),
    Tpdo(2, 0x385, (0x6061_0008, 0x606C_0020, 0x6078_0010)),
    Tpdo(3, 0x285, (0x1001_0008,), 255),
    Tpdo(4, 0x485, (0x60E4_0120,)),
)


def test_a_layout_that_is_sent_at_each_sync_and_carries_all_is_kept() -> None:
    assert [each.number for each in kept_tpdos(5, drive(tpdos=MAKERS), CIA_402).tpdos] == [1, 2, 4]


@pytest.mark.parametrize(
    "tpdos",
    [
        (),
        OWN,
        MAKERS[:3],
        (replace(MAKERS[0], transmission_type=255), *MAKERS[1:]),
        (replace(MAKERS[0], on=False), *MAKERS[1:]),
        (replace(MAKERS[0], cob_id=0x201), *MAKERS[1:]),
    ],
    ids=["none", "jtqd's own", "no link position", "by itself", "off", "another COB-ID"],
)
def test_any_other_is_mapped_by_jtqd(tpdos: tuple[Tpdo, ...]) -> None:
    layout = kept_tpdos(5, drive(tpdos=tpdos), CIA_402)
    assert (layout.tpdos, layout.problems) == ((), ())


def test_a_tpdo_with_a_29_bit_identifier_is_not_kept() -> None:
    tpdos = (replace(MAKERS[0], cob_id=0x0123_4185), *MAKERS[1:])
    assert kept_tpdos(5, drive(tpdos=tpdos), CIA_402).tpdos == ()


def test_a_mapping_that_an_eds_says_is_fixed_is_kept_or_refused() -> None:
    fixed = tuple(replace(each, mapping_fixed=True, transmission_type=255) for each in MAKERS)
    layout = kept_tpdos(5, drive(tpdos=fixed), CIA_402)
    assert [each.number for each in layout.tpdos] == [1, 2, 4]
    assert layout.max_age_ms is None, "the type can be written"
    (problem,) = kept_tpdos(5, drive(tpdos=fixed[:3]), CIA_402).problems
    assert problem.startswith("node 5 (drive): its mapping is fixed, by its EDS: no TPDO carries 60E4h:1")


@pytest.mark.parametrize(("timer_ms", "age"), [(0, 100), (30, 45), (5000, 1000)])
def test_a_type_that_cannot_be_written_needs_an_age(timer_ms: int, age: int) -> None:
    itself = {"mapping_fixed": True, "type_fixed": True, "transmission_type": 255, "timer_ms": timer_ms}
    joint = JointProposal(1, 5, drive(tpdos=tuple(replace(each, **itself) for each in MAKERS)), Wanted())
    section = yaml.safe_load("\n".join(drive_lines(joint)))["joint_1"]
    assert section["max_age_ms"] == age
    assert {each["type"] for each in section["tpdos"]} == {255}
    assert any("max_age_ms" in each for each in joint.guesses)
    other = tuple(replace(each, **{**itself, "transmission_type": 10}) for each in MAKERS)
    (problem,) = kept_tpdos(5, drive(tpdos=other), CIA_402).problems
    assert "transmission type 10" in problem


def test_init_by_an_eds_with_a_fixed_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The shipped EDS, with the makers' mapping in 1A00h and 1A01h and these as constants."""
    text = EDS.read_text()
    for head, key, value in (
        ("1A00sub0", "AccessType", "const"),
        ("1A00sub0", "DefaultValue", "3"),
        ("1A00sub1", "DefaultValue", "0x60410010"),
        ("1A00sub2", "DefaultValue", "0x60640020"),
        ("1A00sub3", "DefaultValue", "0x60780010"),
        ("1A01sub0", "DefaultValue", "2"),
        ("1A01sub1", "DefaultValue", "0x606C0020"),
        ("1A01sub2", "DefaultValue", "0x60E40120"),
    ):
        start = text.index(f"[{head}]")
        end = text.index("[", start + 1)
        lines = [line for line in text[start:end].splitlines() if line and not line.startswith(f"{key}=")]
        text = text[:start] + "\n".join([*lines, f"{key}={value}", "", ""]) + text[end:]
    path = tmp_path / "maker.eds"
    path.write_text(text)
    assert survey_of_eds(path, 5).tpdos[0].mapping_fixed
    arguments = ["--from-eds", str(path), "--node", "5", "--out", str(tmp_path), "--gear-ratio", "100"]
    assert init.main(arguments) == 0, capsys.readouterr()
    written = yaml.safe_load((tmp_path / "jtqd.yaml").read_text())["joint_1"]["tpdos"]
    assert written == [
        {"number": 1, "cob_id": 0x185, "objects": [0x60410010, 0x60640020, 0x60780010]},
        {"number": 2, "cob_id": 0x285, "objects": [0x606C0020, 0x60E40120]},
    ]
    assert len(load_config(tmp_path / "jtqd.yaml").joints[0].tpdos) == 2


# On a bus -----------------------------------------------------------------------------------------------------------


@contextmanager
def a_bench(tmp_path: Path, *manners: str) -> Iterator[LibraryBench]:
    with LibraryBench(tmp_path, *manners) as bench:
        yield bench


@pytest.mark.parametrize("family", ["millidegrees", "feed"])
def test_units_of_a_drive_on_the_bus(family: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with a_bench(tmp_path, "--family", family) as bench:
        assert probe.main(["--bus", bench.bus, "--node", "1"]) == 0
        capsys.readouterr()
        arguments = ["--bus", bench.bus, "--out", str(tmp_path), *OPTIONS, "--json"]
        assert init.main(arguments) == 0
        by = {"millidegrees": "60A8h", "feed": "6092h"}[family]
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert any(f"joint 1: objects.motor_position: {{by: {by}" in each for each in notes)
        config = load_config(tmp_path / "jtqd.yaml")
        assert config.joints[0].objects.motor_position.by == by
        assert config.joints[1].objects == CIA_402
        with booted(boot_request(config, bench.bus)) as report:
            found = quantities(bench.bus, report)
    assert len(found) == 2
    for each in found:
        moves_as_it_should(each)


def test_the_mapping_of_a_drive_on_the_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is in the configuration, so that the bus load knows it, and is what the boot uses."""
    with a_bench(tmp_path, "--fixed", "mapping") as bench:
        assert probe.main(["--bus", bench.bus, "--node", "1"]) == 0
        assert "- {number: 2, cob_id: 0x381, objects: [0x60610008, 0x606C0020, 0x60780010]}" in (
            capsys.readouterr().out
        )
        assert init.main(["--bus", bench.bus, "--out", str(tmp_path), *OPTIONS]) == 0
        assert "joint 1: tpdos: 3 TPDOs of the drive (as they are, by the bus)" in capsys.readouterr().out
        config = load_config(tmp_path / "jtqd.yaml")
        assert [pdo.cob_id for pdo in config.joints[0].tpdos] == [0x181, 0x381, 0x481]
        with booted(boot_request(config, bench.bus)) as report:
            found = quantities(bench.bus, report)
    assert report.nodes[1].tpdos == config.joints[0].tpdos
    for each in found:
        moves_as_it_should(each)
