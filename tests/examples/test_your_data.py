"""docs/your_data.md: every command runs as it stands, every map is a map, and what the page says of the results holds."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from examples.own_rig import DATA_SHEET, TRUE
from examples.own_rig import main as own_rig
from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.joint import Joint
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.simulators import mjcf, model_of
from tests.daemon.logs.campaign_log import Cycle, write_log
from tests.daemon.logs.campaign_log import Joint as LogJoint
from tests.paths import ROOT
from tests.sysid.diagnosis.diagnose_core_helpers import rigid_run
from tests.sysid.simulators.mujoco_rig import free_run_error

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

PAGE = (ROOT / "docs" / "your_data.md").read_text()
COMMANDS = re.findall(r"^    ((?:jtq|python -m) .*)$", PAGE, re.MULTILINE)
MAPS = re.findall(r"^    ((?:time_s|j\d\.\w+): .*)$", PAGE, re.MULTILINE)


def without_efficiency(number: int) -> Joint:
    """The shipped joint whose losses are its friction, by which `rigid_run` computes."""
    return replace(load_joint(shipped(f"joint{number}.yaml")), efficiency=None)


def logs(folder: Path) -> None:
    """Two logs of jtqd of joints that are as their files say; each has lost 0.3 s."""
    folder.mkdir()
    for number, phase in enumerate((0.0, 0.9), 1):
        sides = [
            rigid_run(
                joint,
                phase,
                step_s=2e-3,
                noise=0.05,
                stribeck_nm=joint.friction.stribeck_nm,
                stribeck_velocity_rad_s=joint.friction.stribeck_velocity_rad_s,
                damping_nms_per_rad=joint.damping_nms_per_rad,
            ).joints[1]
            for joint in map(without_efficiency, (1, 2))
        ]
        columns = [replace(c, torque_nm=sides[0].torque_nm) for c in sides]
        cycles = []
        for k in range(3000):
            if 1500 <= k < 1650:
                continue
            joints = []
            for c in columns:
                assert c.current_a is not None
                assert c.motor_position_rad is not None
                assert c.link_position_rad is not None
                assert c.torque_nm is not None
                before = c.motor_position_rad[max(k - 1, 0)]
                after = c.motor_position_rad[min(k + 1, 2999)]
                joints.append(
                    LogJoint(
                        float(c.current_a[k]),
                        float(c.motor_position_rad[k]),
                        float(after - before) / 0.004,
                        float(c.link_position_rad[k]),
                        float(c.torque_nm[k]),
                    )
                )
            cycles.append(Cycle(100 + k, 7_000_000_000 + 2_000_000 * k, (joints[0], joints[1])))
        write_log(folder / f"jtqd-can0-2026112{number}T080000Z-0001.mcap", cycles)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all commands have been run: a directory with what the page takes for given, the models and logs of jtqd."""
    folder = tmp_path_factory.mktemp("your_data")
    (folder / "models").mkdir()
    (folder / "models" / "kinova_gen3").symlink_to(ROOT / "models" / "kinova_gen3")
    for number in (1, 2):
        write_joint(
            folder / "models" / f"joint{number}.yaml", without_efficiency(number), "Its losses are friction."
        )
    logs(folder / "logs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in COMMANDS:
            program, *arguments = shlex.split(command)
            if program == "python":
                assert arguments[:2] == ["-m", "examples.own_rig"]
                status = own_rig(arguments[2:])
            else:
                status = jtq(arguments)
            assert status in (0, 3), command
    return folder


def test_the_page_has_commands_and_maps() -> None:
    assert len(COMMANDS) >= 8
    assert len(MAPS) >= 10


def test_every_map_of_the_page_is_one() -> None:
    whole: dict[str, object] = {}
    for line in MAPS:
        mapping = yaml.safe_load(line)
        beside = {"time_s": "t", "j1.link_position_rad": "q", "j1.motor_position_rad": "m"}
        ColumnMap.from_mapping({**beside, **mapping}, "docs", Path())
        whole |= mapping
    for key in ("j3.torque_nm", "j3.load"):  # one reference of joint 3
        ColumnMap.from_mapping(
            {k: v for k, v in whole.items() if k.startswith("j3") and k != key} | {"time_s": "t"}, "", Path()
        )


def test_the_rig_is_found_as_it_is(place: Path) -> None:
    found = json.loads((place / "rig" / "diagnosis" / "findings.json").read_text())
    assert found["verdict"] == "cause"
    values = {name: each for cause in found["causes"] for name, each in cause["parameters"].items()}
    for key, attribute in (("coulomb_nm", "coulomb"), ("viscous_nms_per_rad", "viscous")):
        true, before = getattr(TRUE, attribute), getattr(DATA_SHEET, attribute)
        low, high = values[key]["ci95"]
        assert low <= true <= high
        assert values[key]["value"] == pytest.approx(true, rel=0.05)
        assert values[key]["file_value"] == before
        assert values[key]["change"] == pytest.approx(values[key]["value"] / before - 1.0)
    assert len(found["causes"]) == 2
    assert any("2 segments of one recording" in note for note in found["channel_notes"])
    assert any("taken as true" in note for note in found["channel_notes"])


def test_logs_of_joints_that_are_as_their_files_have_no_gap(place: Path) -> None:
    found = json.loads((place / "diagnosis_logs" / "findings.json").read_text())
    (group,) = json.loads((place / "fleet_diagnosis" / "summary.json").read_text())["groups"]
    assert found["joints"] == [1, 2]
    assert found["verdict"] == group["figures"]["verdict"] == "no_gap"


def test_with_no_torque_known_the_values_are_found_as_they_are(place: Path) -> None:
    found = json.loads((place / "flat" / "diagnosis" / "findings.json").read_text())
    assert found["verdict"] == "cause"
    causes = [cause for cause in found["causes"] if cause["matters"]]
    assert not any(cause["joint"] == "sensor" for cause in causes), "no torque was measured"
    values = {name: each for cause in causes for name, each in cause["parameters"].items()}
    for key, attribute in (("coulomb_nm", "coulomb"), ("viscous_nms_per_rad", "viscous")):
        assert values[key]["ci95"][0] <= getattr(TRUE, attribute) <= values[key]["ci95"][1]
    assert len(causes) == 2, [cause["name"] for cause in causes]
    gain = found["gain"]
    assert gain["rmse_after_nm"] < 0.1 * gain["rmse_before_nm"]


def test_the_gain_is_there_on_new_runs_in_our_simulation_and_in_mujoco(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(place / "rig" / "servo.yaml"), str(place / "rig" / "new")]
    options = ["--columns", str(place / "rig" / "columns.yaml"), "--after"]
    options.append(str(place / "rig" / "diagnosis" / "extended.joint.yaml"))
    assert jtq(["score", *arguments, *options, "--json"]) == 0
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)["rows"] if row["run"] == "all"}
    assert rows["simulation, motor balance"]["change"] < -0.9
    columns = ColumnMap.load(place / "rig" / "columns.yaml")
    table = read_run(place / "rig" / "new" / "swing_7.csv", columns).table
    errors = []
    for name in ("servo.yaml", "diagnosis/extended.joint.yaml"):
        joint = load_joint(place / "rig" / name)
        errors.append(free_run_error(mjcf(model_of(joint)), table, 1, joint.gear_ratio))
    assert errors[1] < 0.1 * errors[0]


def test_logs_with_gaps_are_used(place: Path) -> None:
    found = json.loads((place / "diagnosis_logs" / "findings.json").read_text())
    assert sum("(1 of 2)" in run["name"] or "(2 of 2)" in run["name"] for run in found["runs"]) == 4
    assert found["verdict"] != "insufficient_data"


def test_an_arm_gets_a_motion_of_one_joint_within_the_limits(place: Path) -> None:
    found = json.loads((place / "kinova4" / "findings.json").read_text())
    assert not any("sensor_crosstalk" in cause["class"] for cause in found["causes"])
    experiment = found["next_experiment"]
    assert experiment["plan"] is None
    motion = experiment["motions"]["next_experiment.motion.csv"]
    assert motion["joint"] == 4
    assert motion["velocity_rad_s"] <= 0.5
    assert motion["torque_nm"] == 20.0
    rows = (place / "kinova4" / "next_experiment.motion.csv").read_text().splitlines()
    assert rows[0] == "run,time_s,position_rad,velocity_rad_s"
    assert max(abs(float(row.split(",")[3])) for row in rows[1:]) <= 0.51
    assert not (place / "kinova4" / "next_experiment.plan.yaml").exists()
