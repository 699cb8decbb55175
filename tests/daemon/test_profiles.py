"""Profiles of drive families: read, put below a configuration, found by vendor-ID, and tried on nodes with their layouts.

The nodes are the canopen library's (tests/library_drives/families.py). What `jtq init` writes for such a node is booted, and
its PDOs are scaled: they must say how its motor moves, as those of the drive of CiA 402 beside it do.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon import profiles
from jtqd.daemon.bus.boot import boot_request
from jtqd.daemon.cli import init, probe
from jtqd.daemon.config import load_config
from jtqd.daemon.recording import launch
from jtqd.daemon.replay.logged import CONFIGURATION, PROVENANCE, read_setup
from jtqd.estimator.errors import ConfigError
from jtqd.models.files import shipped
from tests.drivers.canopen_nodes import booted
from tests.library_drives.families import PULSES, RATED_MA
from tests.library_drives.motion import moves_as_it_should, quantities
from tests.library_drives.nodes import GEAR, LINK_COUNTS
from tests.paths import ROOT

FAMILIES = ["elmo_gold", "epos4", "nanotec"]
PAGE = ROOT / "docs" / "bus.md"
OPTIONS = ["--rated-torque", "30", "--torque-constant", "0.1", "--gear-ratio", str(GEAR)]
COUNTS = {
    "epos4": ["--link-encoder-counts", str(LINK_COUNTS)],
    "elmo_gold": ["--encoder-counts", str(4 * PULSES), "--link-encoder-counts", str(LINK_COUNTS)],
    "nanotec": [],
}
"""What no object of such a drive tells."""


def configuration(tmp_path: Path, **joint: Any) -> Path:
    path = tmp_path / "c.yaml"
    section = {"node": 1, "file": str(shipped("joint1.yaml")), **joint}
    path.write_text(yaml.safe_dump({"node_id": 32, "estimator": {"method": "tob"}, "joint_1": section}))
    return path


def test_every_family_is_read_and_every_line_has_its_source() -> None:
    assert profiles.names() == FAMILIES
    for family in profiles.shipped():
        assert family.lines
        assert profiles.of_vendor(family.vendor) == family
        assert all(line.source and line.state in profiles.STATES for line in family.lines)
    assert profiles.of_vendor(0x7A1) is None
    assert profiles.of_vendor(None) is None


def test_the_page_lists_every_profile_with_its_vendor() -> None:
    page = PAGE.read_text()
    for family in profiles.shipped():
        assert re.search(rf"^\| `{family.name}` .*\| {family.vendor:X}h \|", page, re.MULTILINE), family.name


@pytest.mark.parametrize("name", FAMILIES)
def test_a_configuration_has_the_values_of_its_profile_and_its_own_go_before(
    name: str, tmp_path: Path
) -> None:
    family = profiles.named(name)
    own: dict[str, Any] = {"profile": name}
    for line in family.lines:
        if line.open and line.key is not None:
            section, *middle, last = line.key.split(".")
            place = own.setdefault(section, {})
            for each in middle:
                place = place.setdefault(each, {})
            place[last] = 7
    own.setdefault("objects", {})["statusword"] = {"index": 0x2041}
    (joint,) = load_config(configuration(tmp_path, **own)).joints
    assert joint.profile == name
    assert joint.objects.statusword.index == 0x2041
    section = family.section()
    for quantity, values in section["objects"].items():
        for key, value in values.items():
            found = getattr(joint.objects, quantity)
            assert {"index": found.index, "sub": found.subindex, "factor": found.factor}.get(
                key, value
            ) == value
    assert {key: joint.given[key] for key in section.get("given", {})} == section.get("given", {})


def test_a_joint_with_one_encoder_needs_nothing_of_its_link_encoder(tmp_path: Path) -> None:
    given = {"608Fh:1": 65536, "6090h:1": 65536, "6091h:1": 100, "6091h:2": 1}
    section = {"profile": "elmo_gold", "objects": {"link_position": False}, "given": given}
    (joint,) = load_config(configuration(tmp_path, **section)).joints
    assert joint.objects.link_position is None
    with pytest.raises(ConfigError, match=r"objects\.link_position\.factor': missing"):
        load_config(configuration(tmp_path, profile="elmo_gold", given=given))


def test_what_the_profile_leaves_open_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(configuration(tmp_path, profile="epos4"))
    text = str(caught.value)
    assert text.startswith(f"{tmp_path / 'c.yaml'}: key 'joint_1.objects.motor_position.factor': missing")
    assert "3010h:1" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("epos5", "key 'joint_1.profile': profile: found 'epos5', expected one of 'elmo_gold', 'epos4'"),
        ("mine.yaml", "mine.yaml: cannot be read"),
    ],
)
def test_a_profile_that_there_is_not_is_one_line(name: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"joint_1\.profile") as caught:
        load_config(configuration(tmp_path, profile=name))
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ({"key": "a.b"}, "a key with one of value, read and option"),
        ({"key": "a.b", "value": 1, "read": "6075h"}, "a key with one of value, read and option"),
        ({"value": 1}, "a key with one of value, read and option"),
        ({"check": "6075h"}, "an object with its expected value"),
        ({"check": "75", "expected": 1}, "an object like 608Fh:1"),
        ({"state": "surely"}, "one of 'by the manual'"),
        ({"source": ""}, "a text of printable characters"),
        ({"unknown": 1}, "unknown"),
    ],
)
def test_a_wrong_line_is_one_line_that_names_it(line: dict[str, Any], text: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    whole = {"why": "w", "source": "s", "state": "not confirmed", **line}
    path.write_text(yaml.safe_dump({"title": "t", "vendor": 1, "lines": [whole]}))
    with pytest.raises(ConfigError) as caught:
        profiles.load(path)
    assert text in str(caught.value)
    assert str(path) in str(caught.value)


def own_profile(directory: Path, value: float) -> Path:
    """A profile mine.yaml with one value."""
    line = {"key": "objects.current.factor", "value": value, "why": "w", "source": "s"}
    whole = {"title": "t", "vendor": 1, "lines": [line | {"state": "tried on the bus"}]}
    (directory / "mine.yaml").write_text(yaml.safe_dump(whole))
    return directory / "mine.yaml"


def test_a_profile_of_ones_own_lies_beside_the_configuration(tmp_path: Path) -> None:
    own_profile(tmp_path, 0.25)
    (joint,) = load_config(configuration(tmp_path, profile="mine.yaml")).joints
    assert joint.objects.current.factor == 0.25


def test_the_log_keeps_the_profile_and_a_replay_reads_it_as_it_was(tmp_path: Path) -> None:
    profile = own_profile(tmp_path, 0.25)
    config = load_config(configuration(tmp_path, profile="mine.yaml"))
    attached = {name: data for name, (_, data) in launch._attached_files(config).items()}
    assert attached["mine.yaml"] == profile.read_bytes()
    factors = dict.fromkeys(
        ("motor_rad_per_count", "motor_rad_s_per_unit", "link_rad_per_count", "ampere_per_unit"), 1.0
    )
    factors["ampere_per_unit"] = -0.25  # a drive that counts backwards
    provenance = launch._provenance(config, {"nodes": {"1": {"scaling": factors, "gear_ratio": 100.0}}})
    attached |= {CONFIGURATION: config.text.encode(), PROVENANCE: json.dumps(provenance).encode()}
    profile.unlink()
    empty = tmp_path / "empty"
    empty.mkdir()
    setup = read_setup(tmp_path / "a.mcap", attached, empty)
    assert setup.config.joints[0].objects.current.factor == 0.25
    own_profile(tmp_path, 0.5)
    changed = load_config(configuration(tmp_path, profile="mine.yaml"))
    assert changed.sha256 == config.sha256
    assert changed.files_sha256 != config.files_sha256


# On a bus -----------------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of these buses answer at once."""
    monkeypatch.setattr("jtqd.drivers.survey._PRESENT_S", 0.15)


@pytest.fixture(scope="module", params=FAMILIES)
def bus(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[str, str]]:
    """A hub with a drive of the family as node 1, one of CiA 402 as node 2, a sensor as node 3."""
    hub = tmp_path_factory.mktemp("hub") / "h"
    name = f"unix:{hub}"
    command = [sys.executable, "-m"]
    with subprocess.Popen([*command, "jtqd.drivers.hub", name]) as server:
        deadline = time.monotonic() + 20.0
        while not hub.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        nodes = subprocess.Popen(
            [*command, "tests.library_drives", name, "--family", request.param],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert nodes.stdout is not None
        assert nodes.stdout.readline() == "ready\n"
        yield name, request.param
        nodes.terminate()
        nodes.communicate(timeout=20)
        server.terminate()


def files_of_init(name: str, family: str, tmp_path: Path, *more: str) -> tuple[int, Path]:
    nodes = ["--node", "1", "--node", "2", "--sensor", "none"]
    arguments = ["--bus", name, "--out", str(tmp_path), *nodes, *OPTIONS, *COUNTS[family], *more]
    return init.main([*arguments, "--json", "--force"]), tmp_path / "jtqd.yaml"


def test_init_finds_the_family_and_its_drive_is_scaled_as_the_one_beside_it(
    bus: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, family = bus
    status, path = files_of_init(name, family, tmp_path)
    printed = capsys.readouterr()
    assert status == 0, printed
    assert any(f"profile {family}" in note for note in json.loads(printed.out)["notes"])
    config = load_config(path)
    assert [joint.profile for joint in config.joints] == [family, None]
    with booted(boot_request(config, name)) as report:
        found = quantities(name, report)
    for each in found:
        moves_as_it_should(each)
    first, second = found
    assert first["motor_velocity"] == pytest.approx(second["motor_velocity"], abs=2.0), "the same direction"


def test_probe_names_the_family_and_prints_its_section(
    bus: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    name, family = bus
    probe.main(["--bus", name, "--node", "1"])
    text = capsys.readouterr().out
    assert f"profile {family}: {profiles.named(family).title}" in text
    probe.main(["--bus", name, "--node", "1", "--profile", "none"])
    assert "profile" not in capsys.readouterr().out.splitlines()[1]
    probe.main(["--bus", name, "--node", "2"])
    assert "profile epos4" not in capsys.readouterr().out


def test_a_drive_in_other_units_than_the_profile_takes_it_for_is_reported() -> None:
    numbers = {(0x60A8, 0): 0x00B50000, (0x60A9, 0): 0xFDB44700}
    (finding,) = profiles.named("epos4").findings(numbers)
    assert finding.startswith("60A9h:0: expected 0xB44700, found 0xFDB44700")


def test_the_rated_current_makes_the_factor() -> None:
    family = profiles.named("epos4")
    filled = family.filled({(0x3001, 1): RATED_MA, (0x3010, 1): 800}, {})
    assert filled["objects.current.factor"] == (pytest.approx(RATED_MA * 1e-6), "3001h:1 of the drive")
    assert filled["objects.motor_position.factor"][0] == pytest.approx(2.0 * math.pi / 3200)
    assert "objects.link_position.factor" not in filled
