"""`jtq train` and `jtq fit losses` report what is wrong before they spend minutes: one line, exit status 1, 2 or 3."""

import importlib.util

import numpy as np
import pytest

from jtqd.daemon.jtq import main as jtq
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import shipped
from jtqd.sysid.runs.tables import write_run
from jtqd.sysid.train import command as train_command

JOINT = str(shipped("joint1.yaml"))


@pytest.fixture
def run(tmp_path):
    """A run file of a joint that turns to and fro under load; `sensor` replaces its torque."""

    def made(name="a.csv", sensor=None, count=3000, hz=0.5):
        t = np.arange(count) * 1e-3
        v = np.sin(2 * np.pi * hz * t)
        angle = (1 - np.cos(2 * np.pi * hz * t)) / (2 * np.pi * hz)
        current = 2.0 * np.sign(v) + np.sin(2 * np.pi * 1.7 * t)
        torque = 8.0 * np.sign(v) + 0.01 * np.cos(53.0 * t) if sensor is None else np.full(count, sensor)
        joint = JointColumns(
            current_a=current,
            motor_position_rad=100.0 * angle,
            motor_velocity_rad_s=100.0 * v,
            link_position_rad=angle - torque / 12000.0,
            link_velocity_rad_s=None,
            torque_nm=torque,
            temperature_c=None,
        )
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        write_run(path, RunTable(time_s=t, joints={1: joint}))
        return str(path)

    return made


def arguments(run, tmp_path, *more):
    return [run, "--joint", JOINT, "--network", "paper", "--out", str(tmp_path / "out"), *more]


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--iterations", "0", "a whole number >= 1"),
        ("--iterations", "many", "a whole number >= 1"),
        ("--seed", "-1", "a whole number >= 0"),
    ],
)
def test_numbers_without_sense_are_usage_errors(run, tmp_path, capsys, option, value, expected):  # noqa: PLR0917
    with pytest.raises(SystemExit) as refused:
        train_command.main(arguments(run(), tmp_path, option, value))
    assert refused.value.code == 2
    assert f"argument {option}: found {value!r}, expected {expected}" in capsys.readouterr().err


def test_missing_packages_are_named_before_any_run_is_read(run, tmp_path, capsys, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "torch" else real(name))
    assert train_command.main(arguments("nowhere.csv", tmp_path)) == 1
    assert capsys.readouterr().err == "jtq train: torch is not installed: pip install 'jtqd[train]'\n"


def test_out_that_cannot_hold_files_is_one_line(run, tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    assert train_command.main([run(), "--joint", JOINT, "--network", "ours", "--out", str(file)]) == 1
    assert capsys.readouterr().err == f"jtq train: --out {file}: cannot be created: it is a file\n"


def test_too_few_runs_are_one_line_and_leave_nothing(run, tmp_path, capsys):
    assert train_command.main(arguments(run(), tmp_path)) == 1
    assert "found 1 run, expected at least 5" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []


def test_our_network_needs_the_fitted_section(run, tmp_path, capsys):
    assert (
        train_command.main([run(), "--joint", JOINT, "--network", "ours", "--out", str(tmp_path / "o")]) == 1
    )
    assert "found no section 'fused'" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["train", "--network", "paper"], ["fit", "losses"]])
def test_dead_sensor_is_named_and_nothing_is_written(run, tmp_path, capsys, command):
    out = tmp_path / "out.yaml"
    where = out if command[0] == "fit" else tmp_path / "out"
    assert jtq([*command, run(sensor=3.5), "--joint", JOINT, "--out", str(where)]) == 3
    assert "torque_nm" in capsys.readouterr().err
    assert not out.exists()


def test_missing_run_and_too_few_runs_of_the_loss_fit(run, tmp_path, capsys):
    assert jtq(["fit", "losses", str(tmp_path / "no.csv"), "--joint", JOINT]) == 1
    assert "no.csv: found no such file or directory" in capsys.readouterr().err
    assert jtq(["fit", "losses", run(), "--joint", JOINT]) == 1
    assert "found 1 run, expected at least 6" in capsys.readouterr().err


def test_runs_of_one_name_in_two_folders_keep_their_own_hashes(run, tmp_path, monkeypatch):
    """The network names every run that it was trained on: `jtq evaluate` refuses them by these hashes."""
    seen = {}

    def trained(blocks, joint, hashes, schedule):
        seen.update(hashes)
        raise ValueError("enough")

    monkeypatch.setattr(train_command, "train_paper", trained)
    paths = [run("one/a.csv"), run("other/a.csv", hz=0.7)]
    assert train_command.main([paths[0], *arguments(paths[1], tmp_path)]) == 1
    assert len(set(seen.values())) == len(seen) == 2
