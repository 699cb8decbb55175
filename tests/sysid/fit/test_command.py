"""`jtq fit efficiency|friction` from the outside: files, exit status, what is printed, what is refused."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon import jtq
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.runs.tables import write_run
from tests.estimator.estimator_helpers import joint1
from tests.sysid.campaign_helpers import section_two_runs

JOINT = shipped("joint1.yaml")
Files = Callable[..., Path]


@pytest.fixture(scope="module")
def tables() -> list[RunTable]:
    """Three velocities of section II at its currents: enough for Eq. (8), and quick."""
    plant = load_plant(shipped("plant.yaml"))
    return section_two_runs(plant, velocities=(0.6, 1.4, 3.0), hold_s=0.7, ramp_s=0.25)


@pytest.fixture(scope="module")
def campaign(tables: list[RunTable], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    for name, table in zip(("forward_p", "forward_n", "back_p", "back_n"), tables, strict=True):
        write_run(folder / f"{name}.csv.gz", table)
    (folder / "forward_p.json").write_text("{}")  # marks and logs lie beside the runs
    (folder / "forward_p.mcap").write_bytes(b"")
    return folder


def run(*arguments: object) -> int:
    return jtq.main(["fit", *map(str, arguments)])


def test_a_campaign_becomes_a_joint_file_with_report_and_picture(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "new.yaml", tmp_path / "fig6.png"
    assert run("efficiency", campaign, "--joint", JOINT, "--out", out, "--plot", picture) == 0
    text = capsys.readouterr().out
    assert "i > 0, w < 0: back-driven" in text
    assert "Table I" in text
    assert "0.0550" in text  # the paper's RMSE beside ours
    assert text.count("i = 0.00") + text.count("i = -0.00") == 6  # left out, and listed
    assert picture.read_bytes()[:4] == b"\x89PNG"
    old, new = load_joint(JOINT), load_joint(out)
    assert new.efficiency is not None
    assert new.efficiency.convention == "joint_over_motor"
    assert new.efficiency != old.efficiency
    assert replace(new, efficiency=old.efficiency, provenance=old.provenance) == old
    record = new.provenance["efficiency"]
    assert set(record["sha256"]) == {f"{n}.csv.gz" for n in ("forward_p", "forward_n", "back_p", "back_n")}
    assert all(len(value) == 64 for value in record["sha256"].values())
    assert record["date"].startswith("20")
    assert load_joint(JOINT) == old


def test_json_holds_everything(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("efficiency", campaign, "--joint", JOINT, "--json", "--convention", "motor_over_joint") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["schema"] == "jtq.efficiency/1"
    assert [(fit["convention"], fit["weighted"]) for fit in result["fits"]] == [
        ("motor_over_joint", False),
        ("motor_over_joint", True),
        ("joint_over_motor", False),
    ]
    assert result["fits"][2]["quadrants"]["i_neg_w_pos"]["paper_rmse"] == 0.05599
    assert len(result["plateaus"]) + len(result["left_out"]) == 4 * 17
    assert result["findings"] == []


def test_the_other_joint_of_the_same_runs(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the end of the joint's name, or by --number."""
    found = []
    for more in ((), ("--number", 2)):
        run("efficiency", campaign / "back_p.csv.gz", "--joint", shipped("joint2.yaml"), "--json", *more)
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]
    assert found[0]["number"] == 2
    assert found[0]["plateaus"]


def with_joint(tmp_path: Path, **changes: float) -> Path:
    path = tmp_path / "changed.yaml"
    write_joint(path, replace(joint1(), **changes), "changed")
    return path


@pytest.mark.parametrize(
    ("constant", "kind"), [(0.031, "eta_above_1_driving"), (0.09, "eta_below_1_back_driven")]
)
def test_a_wrong_torque_constant_is_a_finding_and_nothing_is_written(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], constant: float, kind: str
) -> None:
    joint, out = with_joint(tmp_path, torque_constant_nm_per_a=constant), tmp_path / "new.yaml"
    more = ("--out", out, "--plot", tmp_path / "p.png", "--json")
    assert run("efficiency", campaign, "--joint", joint, *more) == 3
    output = capsys.readouterr()
    assert [item["kind"] for item in json.loads(output.out)["findings"]] == [kind]
    assert "nothing was written" in output.err
    assert not out.exists()


def test_a_wrong_gear_ratio_is_shown_by_the_positions(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = with_joint(tmp_path, gear_ratio=50.0)
    forward = sorted(campaign.glob("forward*.csv.gz"))
    assert run("efficiency", *forward, "--joint", joint, "--out", tmp_path / "new.yaml") == 3
    output = capsys.readouterr().out
    assert output.count("gear_ratio: ") == 2  # one per run
    assert "expected gear_ratio 50 of joint1" in output
    assert run("friction", forward[0], "--joint", joint) == 3


def changed(table: RunTable, **columns: object) -> RunTable:
    return RunTable(table.time_s, {1: replace(table.joints[1], **columns)})


def test_bad_channels_are_findings(
    tables: list[RunTable], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torque = tables[0].joints[1].torque_nm
    assert torque is not None
    clipped = changed(tables[0], torque_nm=np.clip(torque, -20.0, 20.0))
    dead = changed(tables[1], torque_nm=np.zeros(len(torque)))
    write_run(tmp_path / "a.csv", clipped)
    write_run(tmp_path / "b.csv", dead)
    assert run("efficiency", tmp_path, "--joint", JOINT, "--out", tmp_path / "new.yaml") == 3
    text = capsys.readouterr().out
    assert "torque_nm_saturated: a.csv: j1.torque_nm: found exactly 20 Nm" in text
    assert "b.csv: j1.torque_nm is exactly zero" in text
    assert not (tmp_path / "new.yaml").exists()


def test_missing_quadrants_are_refused_by_name_unless_the_files_own_may_stay(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    forward = sorted(campaign.glob("forward*.csv.gz"))
    out = tmp_path / "new.yaml"
    assert run("efficiency", *forward, "--joint", JOINT, "--out", out) == 1
    assert "i_neg_w_pos: found 0 distinct operating points" in capsys.readouterr().err
    assert not out.exists()
    assert run("efficiency", *forward, "--joint", JOINT, "--out", out, "--allow-missing") == 0
    new, old = load_joint(out), load_joint(JOINT)
    assert new.efficiency is not None
    assert old.efficiency is not None
    assert new.efficiency.i_neg_w_pos == old.efficiency.i_neg_w_pos
    assert new.efficiency.i_pos_w_pos != old.efficiency.i_pos_w_pos
    assert new.provenance["efficiency"]["kept_from_joint_file"] == ["i_neg_w_pos", "i_pos_w_neg"]
    bare = with_joint(tmp_path, efficiency=None)  # type: ignore[arg-type]
    assert run("efficiency", *forward, "--joint", bare, "--out", tmp_path / "x.yaml", "--allow-missing") == 1
    assert "no efficiency" in capsys.readouterr().err


@pytest.fixture(scope="module")
def broken(campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run files that cannot be used, and forward_p.csv.gz, which can."""
    folder = tmp_path_factory.mktemp("broken")
    good = (campaign / "forward_p.csv.gz").read_bytes()
    (folder / "good.csv.gz").write_bytes(good)
    (folder / "empty").mkdir()
    text = gzip.decompress(good).decode().splitlines()
    cells = text[100].split(",")
    cells[1] = "nan"
    (folder / "nan.csv").write_text("\n".join([*text[:100], ",".join(cells), *text[101:]]))
    n = 4000
    swing = np.sin(0.003 * np.arange(n))
    moving = JointColumns(current_a=4 * swing, motor_velocity_rad_s=100 * swing, torque_nm=15 * swing)
    write_run(folder / "swing.csv", RunTable(0.001 * np.arange(n), {1: moving}))
    return folder


@pytest.mark.parametrize(
    ("runs", "more", "words"),
    [
        (["absent.csv"], (), "found no such file or directory"),
        (["empty"], (), "found no run file in it"),
        (["nan.csv"], (), "line 101, column"),
        (["swing.csv"], (), "swing.csv: found no settled plateau"),
        (["good.csv.gz", "good.csv.gz"], (), "found it twice"),
        (["good.csv.gz"], ("--number", 5), "j5"),
        (["good.csv.gz"], ("--joint", "none.yaml"), "none.yaml: cannot be read"),
    ],
)
def test_bad_input_is_one_line(
    broken: Path, capsys: pytest.CaptureFixture[str], runs: list[str], more: tuple[object, ...], words: str
) -> None:
    assert run("efficiency", *(broken / name for name in runs), "--joint", JOINT, *more) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("kind", "option", "words"),
    [
        *(
            (kind, "--out=none/a.yaml", "none: found no such directory")
            for kind in ("efficiency", "friction", "losses")
        ),
        ("efficiency", "--plot=none/a.png", "none: found no such directory"),
        ("efficiency", "--plot=a.xyz", "found the ending '.xyz', expected a picture: .png"),
    ],
)
def test_where_results_cannot_go_is_an_error_before_runs_are_read(
    capsys: pytest.CaptureFixture[str], kind: str, option: str, words: str
) -> None:
    assert run(kind, "absent.csv", "--joint", JOINT, option) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_usage_errors(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 2
    assert run("--help") == 0
    assert "jtq fit efficiency campaigns/efficiency" in capsys.readouterr().out
    assert run("eficiency") == 2
    assert "did you mean 'efficiency'" in capsys.readouterr().err
    assert run("efficiency", campaign, "--joint", JOINT, "--out", JOINT) == 2
    assert "the joint file itself, expected a new file" in capsys.readouterr().err
    for arguments in (
        ("efficiency", campaign, "--joint", JOINT, "--min-hold", "-1"),
        ("efficiency", "--joint", JOINT),
    ):
        with pytest.raises(SystemExit) as error:
            run(*arguments)
        assert error.value.code == 2


def test_friction_command_writes_the_friction_only(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new.yaml"
    assert run("friction", campaign, "--joint", JOINT, "--out", out, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    old, new = load_joint(JOINT), load_joint(out)
    assert result["friction"]["coulomb_nm"] == new.friction.coulomb_nm
    assert len(result["plateaus"]) == 6
    assert new.friction.coulomb_nm == pytest.approx(3.0, abs=0.8)
    assert new.friction.viscous_nms_per_rad == pytest.approx(2.0, abs=0.6)
    assert replace(new, friction=old.friction, provenance=old.provenance) == old
    assert set(new.provenance["friction"]["sha256"]) == {p.name for p in campaign.glob("*.csv.gz")}
