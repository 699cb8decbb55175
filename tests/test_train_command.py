"""`jtq train` says what is wrong before it spends minutes: one line, exit status 1 (input) or 2 (usage)."""

import sys
from types import SimpleNamespace

import pytest

from sysid import train_command


@pytest.fixture(autouse=True)
def no_torch(monkeypatch):
    """Whatever is refused is refused before torch is loaded."""
    monkeypatch.setitem(sys.modules, "torch", None)


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--runs", "0", "a whole number >= 1"),
        ("--held-out", "0", "a whole number >= 1"),
        ("--iterations", "0", "a whole number >= 1"),
        ("--runs", "many", "a whole number >= 1"),
        ("--seed", "-1", "a whole number >= 0"),
        ("--seconds", "nan", "a time in seconds > 0"),
        ("--seconds", "0", "a time in seconds > 0"),
    ],
)
def test_numbers_without_sense_are_usage_errors(tmp_path, capsys, option, value, expected):
    with pytest.raises(SystemExit) as refused:
        train_command.main(["--out", str(tmp_path), option, value])
    assert refused.value.code == 2
    assert f"argument {option}: found {value!r}, expected {expected}" in capsys.readouterr().err


def test_plant_that_cannot_be_read_is_one_line(tmp_path, capsys):
    missing = tmp_path / "plant.yaml"
    assert train_command.main(["--out", str(tmp_path), "--plant", str(missing)]) == 1
    assert capsys.readouterr().err == f"jtq train: {missing}: cannot be read: No such file or directory\n"


def test_out_that_cannot_hold_files_is_one_line(tmp_path, capsys):
    file = tmp_path / "file"
    file.touch()
    assert train_command.main(["--out", str(file)]) == 1
    assert capsys.readouterr().err == f"jtq train: --out {file}: files cannot be made there: it is a file\n"
    assert train_command.main(["--out", str(file / "below")]) == 1
    assert "below: files cannot be made there: Not a directory\n" in capsys.readouterr().err


def test_missing_out_is_made_and_nothing_is_left_in_it(tmp_path, capsys):
    out = tmp_path / "new" / "models"
    assert train_command.main(["--out", str(out)]) == 1
    assert "torch is not installed" in capsys.readouterr().err
    assert list(out.iterdir()) == []


def test_runs_too_short_to_move_are_refused_before_training(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(set_num_threads=lambda n: None))
    arguments = ["--out", str(tmp_path), "--runs", "1", "--held-out", "1", "--seconds", "0.01"]
    assert train_command.main(arguments) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == (
        "jtq train: --seconds: found 0.01, expected runs long enough for motion: run 1 has none"
    )
