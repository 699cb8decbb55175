"""`jtq init` and `jtq probe`: from devices, EDS files and options to files that jtqd reads and boots. Guesses are named."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
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
    MissingValueError,
    Wanted,
    config_text,
    drive_lines,
    joint_text,
    kept_tpdos,
    plain,
    reported_units,
    unit_problems,
)
from jtqd.daemon.config import load_config
from jtqd.drivers.drive import CIA_402, DriveProfile, drive_scaling
from jtqd.drivers.object_dictionary import ObjectStore, read_eds
from jtqd.drivers.pdo import Tpdo
from jtqd.drivers.survey import Survey, survey, survey_of_eds
from tests.drivers.canopen_nodes import booted
from tests.library_drives.bench import LibraryBench
from tests.library_drives.motion import moves_as_it_should, quantities
from tests.library_drives.nodes import GEAR
from tests.paths import ROOT

EDS = ROOT / "drivers" / "eds" / "drive.eds"
NODE = 5
GIVEN = Wanted(gear_ratio=101.0, encoder_counts=4096, link_encoder_counts=2**19, rated_current_a=8.0)


def drive(values=None, without=()):
    """Survey of a drive with these values, and without some objects."""
    entries = [each for each in read_eds(EDS, NODE).entries if (each.index, each.subindex) not in without]
    store = ObjectStore(entries, NODE)
    for (index, sub), value in {
        (0x6091, 1): 100,
        (0x608F, 1): 65536,
        (0x6090, 1): 65536,
        **(values or {}),
    }.items():
        if (index, sub) in store.entries:
            store.set_number(index, sub, value)
    return survey(store, NODE)


def numbers(values):
    return {name: value.value for name, value in values.items()}


def test_values_of_the_drive_are_used_and_none_is_given():
    joint = JointProposal(1, NODE, drive({(0x6075, 0): 8000, (0x6076, 0): 500}), Wanted())
    values = numbers(joint.values)
    assert values["gear_ratio"] == 100.0
    assert values["torque_constant_nm_per_a"] == pytest.approx(0.5 / 8.0, rel=0.01)
    assert values["rated_torque_nm"] == pytest.approx(0.7 * 100 * 0.5)
    assert (joint.given, joint.problems, joint.values["gear_ratio"].verify) == ({}, [], "")
    assert len(joint.guesses) == 8


@pytest.mark.parametrize(
    ("wanted", "given"),
    [
        (
            Wanted(gear_ratio=50.5, rated_torque_nm=28.0, torque_constant_nm_per_a=0.05, rated_current_a=6.0),
            {(0x6091, 1): 101, (0x6091, 2): 2, (0x6075, 0): 6000},
        ),
        (Wanted(gear_ratio=100.0, rated_current_a=8.0, encoder_counts=65536), {}),
    ],
    ids=["an option replaces the drive's value", "one that agrees gives nothing"],
)
def test_options(wanted, given):
    joint = JointProposal(1, NODE, drive({(0x6075, 0): 8000}), wanted)
    assert numbers(joint.given) == given
    assert joint.values["gear_ratio"].value == wanted.gear_ratio
    assert all("the drive has " in each.origin for each in joint.given.values())


@pytest.mark.parametrize(
    ("without", "wanted", "option"),
    [
        (((0x6091, 1),), Wanted(), "--gear-ratio"),
        (((0x6075, 0),), Wanted(rated_torque_nm=30.0), "--rated-current"),
        (((0x6076, 0),), Wanted(), "--rated-torque"),
        (((0x608F, 1),), Wanted(), "--encoder-counts"),
        (((0x60E6, 1),), Wanted(), "--link-encoder-counts"),
    ],
)
def test_a_value_that_cannot_be_guessed_is_asked_for_by_its_option(without, wanted, option):
    with pytest.raises(MissingValueError, match=f"give {option}"):
        JointProposal(1, NODE, drive(without=without), wanted)


def test_a_gear_of_one_to_one_is_not_believed():
    with pytest.raises(MissingValueError, match="1:1"):
        JointProposal(1, NODE, drive({(0x6091, 1): 1}), Wanted())


def test_a_drive_without_scaling_is_scaled_by_options_as_the_boot_does():
    """What is given makes the same factors as a drive that has the objects: one turn is one turn."""
    turns = [(index, sub) for index in (0x608F, 0x6090, 0x6091) for sub in (1, 2)]
    missing = [*turns, (0x60E6, 1), (0x60EB, 1)]
    found = drive({(0x6075, 0): 8000}, without=missing)
    joint = JointProposal(1, NODE, found, GIVEN)
    given = {key: round(value.value) for key, value in joint.given.items()}
    assert set(missing) == set(given)
    scaling, gear = drive_scaling(DriveProfile(NODE, given=given), found.numbers)
    assert gear == 101.0
    assert scaling.motor_rad_per_count * 4096 == pytest.approx(6.283185307)
    assert scaling.motor_rad_s_per_unit == scaling.motor_rad_per_count
    assert scaling.link_rad_per_count * 2**19 == pytest.approx(6.283185307)
    assert any("606Ch" in each for each in joint.guesses)


@pytest.mark.parametrize(
    ("values", "without", "wanted", "problem"),
    [
        ({}, [(0x6041, 0)], Wanted(), "node 5 (emulated joint drive): has no 6041h:0, which jtqd maps"),
        ({(0x6075, 0): 2_000_000}, [], Wanted(), "rated current in mA: expected 1..1000000, found 2000000"),
        ({(0x6075, 0): 2_000_000}, [], Wanted(rated_current_a=8.0), None),
    ],
)
def test_problems_of_a_drive(values, without, wanted, problem):
    found = JointProposal(1, NODE, drive(values, without), wanted).problems
    assert len(found) == (problem is not None)
    assert all(each.endswith(problem) for each in found)


def test_every_number_is_one_in_yaml():
    for number in (1e-05, 2e-300, 1e16, 7.12e-05, 100.0):
        assert yaml.safe_load(plain(number)) == number


LINK = ((0x60E4, 1), (0x60E6, 1), (0x60EB, 1))
VELOCITY = ((0x606C, 0), (0x6090, 1), (0x6090, 2))
CURRENT = ((0x6078, 0), (0x6075, 0))


@pytest.mark.parametrize(
    ("without", "wanted", "objects", "why"),
    [
        (LINK, Wanted(), {"link_position": False}, "no 60E4h:1"),
        ((), Wanted(one_encoder=True), {"link_position": False}, "--one-encoder"),
        (VELOCITY, Wanted(), {"motor_velocity": False}, "no 606Ch:0"),
        (CURRENT, Wanted(rated_current_a=8.0), {"current": {"index": 0x6077}}, "no 6078h:0"),
    ],
)
def test_a_drive_that_tells_less_gets_objects_that_say_so(without, wanted, objects, why, tmp_path):
    """And no scaling of what it does not tell; jtqd reads the section, and its boot takes the drive as it is."""
    found = drive({(0x6075, 0): 8000, (0x6076, 0): 500}, without)
    joint = JointProposal(1, NODE, found, wanted)
    assert joint.problems == []
    assert joint.given == {}
    text = "\n".join(drive_lines(joint))
    assert yaml.safe_load(text)["joint_1"]["objects"] == objects
    assert why in text
    assert all(line[at - 1] == " " for line in text.splitlines() if (at := line.find("#")) > 0), (
        "YAML wants it"
    )
    (tmp_path / "joint_1.yaml").write_text(joint_text(joint))
    config = tmp_path / "c.yaml"
    config.write_text(config_text([joint], bus="can0", bitrate=1_000_000, period_us=1000))
    joint = load_config(config).joints[0]
    profile = DriveProfile(NODE, objects=joint.objects, torque_constant_nm_per_a=0.05)
    scaling, _ = drive_scaling(profile, found.numbers)
    assert scaling.motor_rad_per_count > 0.0
    assert (scaling.link_rad_per_count == 0.0) == ("link_position" in objects)
    assert (scaling.motor_rad_s_per_unit == 0.0) == ("motor_velocity" in objects)
    assert scaling.ampere_per_unit > 0.0


def run(capsys, arguments, *more):
    status = init.main([*arguments.split(), *map(str, more)])
    out, err = capsys.readouterr()
    return status, out, err


BY_EDS = f"--from-eds {EDS} --gear-ratio 101"
BY_HAND = "--node 9 --gear-ratio 101 --rated-torque 30 --torque-constant 0.1"


def test_from_an_eds_alone(tmp_path, capsys):
    status, out, err = run(capsys, f"{BY_EDS} --node 5 --node 6 --out", tmp_path / "arm")
    assert (status, err) == (0, "")
    assert "still a guess:" in out
    config = load_config(tmp_path / "arm" / "jtqd.yaml")
    assert [joint.node_id for joint in config.joints] == [5, 6]
    assert (config.estimator.method, config.sensor) == ("tob", None)
    assert (config.joints[0].joint.gear_ratio, config.joints[0].identity.vendor) == (101.0, 0x7A1)


def test_an_eds_without_a_node_id_is_one_joint_at_a_guessed_node(tmp_path, capsys):
    status, out, err = run(capsys, f"{BY_EDS} --out", tmp_path)
    assert (status, err) == (0, "")
    assert "joint_1: node = 1 (an EDS knows no node-ID: --node, or --bus)" in out.partition("a guess:")[2]
    assert "  node: 1                 # GUESS, an EDS" in (tmp_path / "jtqd.yaml").read_text()
    assert [joint.node_id for joint in load_config(tmp_path / "jtqd.yaml").joints] == [1]
    assert "node = " not in run(capsys, f"{BY_EDS} --node 1 --force --out", tmp_path)[1]


@pytest.mark.parametrize(
    ("arguments", "nodes", "period_us"),
    [
        (BY_HAND, [9], 1000),
        (f"{BY_EDS} --node 5 --node 6 --node 7 --node 8", [5, 6, 7, 8], 2000),
        (f"{BY_EDS} --node 1 --node 2 --bitrate 500000", [1, 2], 2000),
    ],
)
def test_joints_and_the_shortest_period_that_fits(arguments, nodes, period_us, tmp_path, capsys):
    status, out, err = run(capsys, f"{arguments} --json --out", tmp_path)
    assert (status, err) == (0, "")
    config = load_config(tmp_path / "jtqd.yaml")
    assert [joint.node_id for joint in config.joints] == nodes
    assert json.loads(out)["period_us"] == config.period_ns // 1000 == period_us


def test_every_guess_is_marked_in_the_files_and_listed(tmp_path, capsys):
    _, out, _ = run(capsys, f"{BY_EDS} --node 5 --json --out", tmp_path)
    text = (tmp_path / "joint_1.yaml").read_text()
    marked = [line.split(":")[0].strip() for line in text.splitlines() if "# GUESS" in line]
    assert marked == [each.split(": ")[1].split(" = ")[0] for each in json.loads(out)["guesses"]]
    assert len(marked) == 8


def test_a_name_for_the_unit_of_an_interface(tmp_path, capsys):
    assert run(capsys, f"{BY_EDS} --node 5 --name can0 --out", tmp_path)[0] == 0
    assert load_config(tmp_path / "can0.yaml").joints[0].node_id == 5
    for wrong in ("joint_1", "../x", ""):
        with pytest.raises(SystemExit):
            run(capsys, f"{BY_EDS} --node 5", "--out", tmp_path, "--name", wrong)


def test_existing_files_are_not_overwritten(tmp_path, capsys):
    (tmp_path / "joint_2.yaml").write_text("mine")
    status, _, err = run(capsys, f"{BY_EDS} --node 5 --out", tmp_path)
    assert status == 2
    assert "joint_2.yaml: exists" in err
    assert (tmp_path / "joint_2.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "status", "problem"),
    [
        (["--node", "5", "--node", "5"], 2, "names a node twice"),
        ([f"--node={node}" for node in range(5, 10)], 2, "at most 4 joints"),
        ([], 2, "give --node"),
        (["--node", "5", "--gear-ratio", "1", "--gear-ratio", "2"], 2, "--gear-ratio: given 2 times"),
        (["--node", "5", "--from-eds", "none.eds"], 1, "none.eds"),
        (["--from-eds", "none.eds"], 1, "none.eds: cannot be read"),
        (["--bus", "unix:/none/bus"], 1, "/none"),
        (["--node", "5", "--from-eds", str(EDS.parent / "torque_sensor.eds")], 2, "no CiA 402 drive"),
        (["--node", "5", "--sensor-joint", "1"], 2, "--gear-ratio"),
        (["--node", "5", "--from-eds", "/dev/zero"], 1, "/dev/zero: found no regular file, expected an EDS"),
        (["--node", "5", "--from-eds", "a\x1b[31m.eds"], 1, "'a\\x1b[31m.eds': cannot be read"),
        (["--node", "5", "--from-eds", "a\0.eds"], 1, "cannot be read: "),
    ],
)
def test_wrong_input_is_one_line(arguments, status, problem, tmp_path, capsys):
    found, out, err = run(capsys, "", *arguments, "--out", tmp_path / "arm")
    assert (found, out) == (status, "")
    assert problem in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "data", [b"", b"garbage\x00\xff", b"[DeviceInfo]\nVendorNumber=zz\n", b"\0" * 16_000_001]
)
def test_a_broken_eds_is_one_line(data, tmp_path, capfd):
    """Also on the file descriptor, as the library's parser writes to stderr by itself."""
    (tmp_path / "bad.eds").write_bytes(data)
    status, out, err = run(capfd, "--node 5 --out", tmp_path / "d", "--from-eds", tmp_path / "bad.eds")
    assert (status, out, err.count("\n"), err.isascii()) == (1, "", 1, True)
    assert "bad.eds" in err


def test_a_pipe_is_not_waited_for(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.eds")
    status, _, err = run(capsys, "--node 5 --out", tmp_path, "--from-eds", tmp_path / "pipe.eds")
    assert (status, err.endswith("found no regular file, expected an EDS\n")) == (1, True)


def test_an_eds_in_the_maker_s_code_page_is_read(tmp_path, capsys):
    (tmp_path / "maker.eds").write_bytes(b"; 0.1 \xb0\n" + EDS.read_bytes())
    maker = ("--from-eds", tmp_path / "maker.eds")
    assert run(capsys, "--node 5 --gear-ratio 101 --out", tmp_path, *maker)[0] == 0


def test_files_that_jtqd_refuses_do_not_stay(tmp_path, capsys):
    status, _, err = run(capsys, f"{BY_HAND} --bitrate 1 --out", tmp_path)
    assert (status, err.count("\n")) == (1, 1)
    assert f"{tmp_path / 'jtqd.yaml'}: key 'bitrate'" in err
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "jtqd.yaml").write_text("mine")
    assert run(capsys, f"{BY_HAND} --bitrate 1 --force --out", tmp_path)[0] == 1
    assert [each.read_text() for each in tmp_path.iterdir()] == ["mine"], "nothing is lost"


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Nodes of these buses answer at once."""
    monkeypatch.setattr("jtqd.drivers.survey.SYNC_LISTEN_S", 0.05)
    monkeypatch.setattr("jtqd.drivers.survey._PRESENT_S", 0.15)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """The emulated bench on a unix bus."""
    bus = f"unix:{tmp_path_factory.mktemp('bench')}/bus"
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus], stderr=subprocess.PIPE, text=True
    )
    assert "ready" in process.stderr.readline()
    yield bus
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)


def test_the_devices_of_a_bus(bench, tmp_path, capsys):
    status, out, err = run(capsys, f"--bus {bench} --out", tmp_path / "arm")
    assert (status, err) == (0, "")
    assert "node 3: emulated torque sensor" in out
    content = yaml.safe_load((tmp_path / "arm" / "jtqd.yaml").read_text())
    assert (content["joint_1"]["node"], content["joint_2"]["node"], content["sensor"]["node"]) == (1, 2, 3)
    assert "given" not in content["joint_1"]
    config = load_config(tmp_path / "arm" / "jtqd.yaml")
    assert config.joints[0].sensor_channel == 1

    status, out, err = run(capsys, f"--bus {bench} --from-eds {EDS} --out", tmp_path / "with_eds")
    assert (status, err) == (0, "")
    assert [line.rsplit("by ")[-1] for line in out.splitlines() if line.startswith("node 1:")] == [
        "the bus)",
        f"defaults of {EDS.name})",
    ]
    other = tmp_path / "other.eds"
    other.write_text(EDS.read_text().replace("DefaultValue=1953", "DefaultValue=154"))
    status, _, err = run(capsys, f"--bus {bench} --from-eds {other} --out", tmp_path / "other")
    assert (status, err.count("\n")) == (2, 1)
    assert "is of vendor 0000009Ah, but node 1 has 000007A1h" in err

    for sensor, reported in ((2, "node 2 is no CiA 404 sensor"), (9, "node 9 does not answer")):
        status, _, err = run(capsys, f"--bus {bench} --node 1 --sensor {sensor} --out", tmp_path / "other")
        assert (status, err.count("\n")) == (2, 1)
        assert f"--sensor: {reported}" in err

    status, _, err = run(capsys, f"--bus {bench} --node 8 --out", tmp_path / "other")
    assert status == 2
    assert "node 8 does not answer" in err
    assert "1 (emulated joint drive)" in err


def test_probe_of_a_bus_and_of_its_devices(bench, capsys):
    assert probe.main(["--bus", bench]) == 0
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == [
        "node 1",
        "node 2",
        "node 3",
    ]
    assert probe.main(["--bus", bench, "--node", "1"]) == 0
    reported = capsys.readouterr().out
    for words in ("608Fh:1", "60E4h:1", "TPDOs", "181h", "identity: {vendor: 0x000007A1"):
        assert words in reported
    assert probe.main(["--bus", bench, "--node", "1", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["device"]["vendor"] == 0x7A1
    assert content["missing"] == content["problems"] == []
    assert content["tpdos"][0]["objects"]
    assert probe.main(["--bus", bench, "--node", "3"]) == 0
    assert "sensor:" in capsys.readouterr().out
    assert probe.main(["--bus", bench, "--node", "9"]) == 1
    assert capsys.readouterr().err == f"jtq probe: node 9 does not answer on {bench}\n"
    assert probe.main(["--bus", bench, "--eds", "x.eds"]) == 2
    capsys.readouterr()
    assert probe.main(["--bus", bench, "--node", "1", "--eds", str(EDS.parent / "torque_sensor.eds")]) == 2
    assert "is of profile 404, but node 1 has 402 (1000h)" in capsys.readouterr().err


def test_the_section_alone_goes_into_a_configuration_that_jtqd_reads(bench, tmp_path, capsys):
    arm = tmp_path / "arm"
    assert run(capsys, f"--bus {bench} --node 1 --sensor none --out", arm)[0] == 0
    arguments = ["--bus", bench, "--node", "2", "--joint", "2", "--gear-ratio", "101"]
    assert probe.main([*arguments, "--section"]) == 0
    section = capsys.readouterr().out
    with (arm / "jtqd.yaml").open("a") as file:
        file.write(section)
    (arm / "joint_2.yaml").write_text((arm / "joint_1.yaml").read_text().replace("100.0 ", "101.0 ", 1))
    config = load_config(arm / "jtqd.yaml")
    assert [(each.number, each.node_id) for each in config.joints] == [(1, 1), (2, 2)]
    assert '"6091h:1": 101' in section
    assert probe.main(["--bus", bench, "--section"]) == 2
    assert capsys.readouterr().err == "jtq probe: --section needs --node\n"


def test_a_drive_that_does_not_know_its_gear_has_a_section_with_the_option():
    found = drive({(0x6091, 1): 1})
    reported = probe.text(found, [])
    assert "no section of the configuration yet: " in reported
    assert "give --gear-ratio" in reported
    with pytest.raises(MissingValueError, match="give --gear-ratio"):
        probe.section(found)
    lines = probe.section(found, None, Wanted(gear_ratio=101.0), 3)
    assert lines[0].startswith("joint_3:")
    assert any('"6091h:1": 101' in line for line in lines)


def test_probe_says_what_each_object_is():
    lines = [line.split(maxsplit=2) for line in probe.text(drive(), []).splitlines()]
    reported = {line[0]: line[1:] for line in lines if len(line) == 3}
    assert reported["1018h:1"] == ["000007A1h", "vendor"]
    assert reported["608Fh:1"] == ["65536", "position encoder increments"]
    assert reported["6064h:0"][1] == "motor position"
    assert (len(reported["6041h:0"][0]), reported["6041h:0"][1]) == (5, "statusword")
    assert reported["6075h:0"][1] == "motor rated current in mA"
    named = [
        each for each in probe.text(drive(), []).splitlines() if each.startswith("  ") and "h:" in each[:8]
    ]
    assert all(len(each.split()) >= 3 for each in named), "each has a name"


def test_probe_names_what_a_drive_lacks():
    found = drive(without=[(0x6041, 0)])
    (problem,) = probe.problems_of(found)
    assert "6041h:0" in problem
    assert "6041h:0  not there" in probe.text(found, [problem])
    less = drive(without=[(0x60E4, 1)])
    assert probe.problems_of(less) == []
    assert "link_position: false" in probe.text(less, [])


def test_on_a_terminal_what_is_missing_is_asked_for(tmp_path):
    """A number that is none is asked for again."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "init", "--node", "5", "--out", str(tmp_path / "arm")],
        stdin=slave,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.write(master, b"fast\n100\n30\n0.06\n")
    out, err = process.communicate(timeout=60)
    os.close(slave)
    os.close(master)
    assert process.returncode == 0, err
    assert "expected a number above 0" in err
    joint = load_config(tmp_path / "arm" / "jtqd.yaml").joints[0].joint
    assert (joint.gear_ratio, joint.rated_torque_nm, joint.torque_constant_nm_per_a) == (100.0, 30.0, 0.06)
    assert "still a guess:" in out


OPTIONS = ["--rated-torque", "30", "--torque-constant", "0.1", "--gear-ratio", str(GEAR)]
QUANTITIES = ("motor_position", "link_position", "motor_velocity")
MILLIDEGREE = 0xFD41_0000


def reporting(numbers: dict[tuple[int, int], int] | None = None, tpdos: tuple[Tpdo, ...] = ()) -> Survey:
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
    found = reported_units(reporting(numbers), gear, QUANTITIES, ())
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
    survey = reporting(numbers)
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
    survey = reporting({(0x60A8, 0): MILLIDEGREE})
    joint = JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0, torque_constant_nm_per_a=0.1))
    guesses = [each for each in joint.guesses if "objects" in each]
    assert [each.split(": ")[1].split(" = ")[0] for each in guesses] == ["link_position", "motor_velocity"]
    assert "no 60A9h: 606Ch taken for 60A8h per second" in guesses[1]
    assert sum("# GUESS" in line for line in drive_lines(joint)) == 2


def test_increments_per_second_are_those_of_the_option() -> None:
    """A drive that names the unit of its velocity, and has no 608Fh that tells how many a turn are."""
    survey = reporting({(0x608F, 1): 0, (0x608F, 2): 0, (0x60A8, 0): 0x00B5_0000, (0x60A9, 0): 0x00B5_0300})
    assert (
        "no section of the configuration yet: node 5: 608Fh:1 is not known: give --encoder-counts"
        in probe.text(survey, [])
    )
    joint = JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0, encoder_counts=4096))
    assert {name: each.value for name, each in joint.objects.items()} == {"motor_velocity": {"by": "608Fh"}}
    assert joint.objects["motor_velocity"].origin == "60A9h:0 is 0x00B50300, by the bus"
    assert (0x6090, 1) not in joint.given


def test_counts_by_an_option_go_before_what_the_drive_tells() -> None:
    survey = reporting({(0x60A8, 0): MILLIDEGREE, (0x60A9, 0): 0xFD41_0300})
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
    survey = reporting(numbers)
    (problem,) = unit_problems(survey)
    assert problem.startswith(f"node 5 (drive): {text}")
    assert "found 0x0001" in problem
    assert probe.problems_of(survey) == [problem]
    assert JointProposal(1, 5, survey, Wanted(rated_torque_nm=30.0)).problems == [problem]


# TPDOs --------------------------------------------------------------------------------------------------------------

OWN = (Tpdo(1, 0x185, (0x6064_0020, 0x60E4_0120)), Tpdo(2, 0x285, (0x606C_0020, 0x6078_0010, 0x6041_0010)))
MAKERS = (
    Tpdo(1, 0x185, (0x6041_0010, 0x6064_0020)),
    Tpdo(2, 0x385, (0x6061_0008, 0x606C_0020, 0x6078_0010)),
    Tpdo(3, 0x285, (0x1001_0008,), 255),
    Tpdo(4, 0x485, (0x60E4_0120,)),
)


def test_a_layout_that_is_sent_at_each_sync_and_carries_all_is_kept() -> None:
    assert [each.number for each in kept_tpdos(5, reporting(tpdos=MAKERS), CIA_402).tpdos] == [1, 2, 4]


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
    layout = kept_tpdos(5, reporting(tpdos=tpdos), CIA_402)
    assert (layout.tpdos, layout.problems) == ((), ())


def test_a_tpdo_with_a_29_bit_identifier_is_not_kept() -> None:
    tpdos = (replace(MAKERS[0], cob_id=0x0123_4185), *MAKERS[1:])
    assert kept_tpdos(5, reporting(tpdos=tpdos), CIA_402).tpdos == ()


def test_a_mapping_that_an_eds_says_is_fixed_is_kept_or_refused() -> None:
    fixed = tuple(replace(each, mapping_fixed=True, transmission_type=255) for each in MAKERS)
    layout = kept_tpdos(5, reporting(tpdos=fixed), CIA_402)
    assert [each.number for each in layout.tpdos] == [1, 2, 4]
    assert layout.max_age_ms is None, "the type can be written"
    (problem,) = kept_tpdos(5, reporting(tpdos=fixed[:3]), CIA_402).problems
    assert problem.startswith("node 5 (drive): its mapping is fixed, by its EDS: no TPDO carries 60E4h:1")


@pytest.mark.parametrize(("timer_ms", "age"), [(0, 100), (30, 45), (5000, 1000)])
def test_a_type_that_cannot_be_written_needs_an_age(timer_ms: int, age: int) -> None:
    itself = {"mapping_fixed": True, "type_fixed": True, "transmission_type": 255, "timer_ms": timer_ms}
    joint = JointProposal(1, 5, reporting(tpdos=tuple(replace(each, **itself) for each in MAKERS)), Wanted())
    section = yaml.safe_load("\n".join(drive_lines(joint)))["joint_1"]
    assert section["max_age_ms"] == age
    assert {each["type"] for each in section["tpdos"]} == {255}
    assert any("max_age_ms" in each for each in joint.guesses)
    other = tuple(replace(each, **{**itself, "transmission_type": 10}) for each in MAKERS)
    (problem,) = kept_tpdos(5, reporting(tpdos=other), CIA_402).problems
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


DCF = EDS.read_text().replace("[6091sub1]\n", "[6091sub1]\nParameterValue=120\n")


@pytest.mark.parametrize(
    ("setups", "options", "expected"),
    [
        (["NodeID=11\nBaudrate=500"], "", ([11], 500_000, 0)),
        (["NodeID=11\nBaudrate=500", "NodeID=12\nBaudrate=500"], "", ([11, 12], 500_000, 0)),
        (["NodeID=11\nBaudrate=500", ""], "", ([11, 2], 500_000, 1)),
        (["Baudrate=500"], "", ([1], 500_000, 1)),
        (["NodeID=11"], "", ([11], 1_000_000, 0)),
        (["NodeID=11\nBaudrate=500"], "--node 5 --bitrate 250000", ([5], 250_000, 0)),
    ],
)
def test_a_dcf_has_node_bit_rate_and_values(tmp_path, capsys, setups, options, expected):
    """Expected: nodes, bit rate, node-IDs that are a guess."""
    files = []
    for number, setup in enumerate(setups):
        (tmp_path / f"{number}.dcf").write_text(f"{DCF}\n[DeviceComissioning]\n{setup}\n")
        files += ["--from-eds", tmp_path / f"{number}.dcf"]
    status, out, err = run(capsys, f"{options} --json --out", tmp_path / "arm", *files)
    assert (status, err) == (0, "")
    config, report = load_config(tmp_path / "arm" / "jtqd.yaml"), json.loads(out)
    nodes = [each.node_id for each in config.joints]
    assert (nodes, config.bitrate, sum("node = " in each for each in report["guesses"])) == expected
    assert [each.joint.gear_ratio for each in config.joints] == [120.0] * len(nodes)
    assert any("of node 11 by its NodeID, read for node 5" in each for each in report["notes"]) == (
        nodes == [5]
    )


@pytest.mark.parametrize(
    ("setups", "expected"),
    [
        (["NodeID=11\nBaudrate=500", "NodeID=12\nBaudrate=250"], "found bit rates [250000, 500000]"),
        (["NodeID=11", "NodeID=11"], "[11, 11] names a node twice"),
    ],
)
def test_dcfs_that_contradict_each_other(tmp_path, capsys, setups, expected):
    files = []
    for number, setup in enumerate(setups):
        (tmp_path / f"{number}.dcf").write_text(f"{DCF}\n[DeviceComissioning]\n{setup}\n")
        files += ["--from-eds", tmp_path / f"{number}.dcf"]
    status, _, err = run(capsys, "--out", tmp_path / "arm", *files)
    assert status == 2
    assert expected in err


def test_an_entry_that_cannot_be_read_is_a_note(tmp_path, capsys):
    (tmp_path / "maker.eds").write_text(
        f"{EDS.read_text()}\n[2010]\nObjectType=7\nDataType=5\nDefaultValue=3\n"
    )
    status, out, _ = run(
        capsys, "--node 5 --gear-ratio 100 --out", tmp_path / "arm", "--from-eds", tmp_path / "maker.eds"
    )
    assert status == 0
    assert "[2010]: no AccessType" in out
