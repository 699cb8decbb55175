"""Words of messages: number and noun agree; places for results that cannot be written are refused before the work."""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path

import pytest

from jtqd.estimator.command_line import check_installed, check_output, make_directory
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.text import counted

ROOT = Path(__file__).parents[2]
IMPORTED = {"pin": "pinocchio"}
"""Packages that are imported by another name."""


def test_one_thing_has_no_plural() -> None:
    assert [counted(n, "group") for n in (0, 1, 2)] == ["0 groups", "1 group", "2 groups"]
    assert counted(0, "velocity", "velocities") == "0 velocities"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none/a.csv", "none: found no such directory, expected a directory for a.csv"),
        ("file/a.csv", "file: found a file, expected a directory for a.csv"),
        ("folder", "folder: found a directory, expected the name of a file"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError) as refused:
        check_output(tmp_path / name)
    assert str(refused.value) == f"{tmp_path}/{words}"
    check_output(tmp_path / "file")
    check_output(tmp_path / "folder" / "new")
    check_output(Path("/dev/stdout"))


def test_what_has_no_right_to_write_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with pytest.raises(ConfigError, match=r"a\.csv: cannot be written"):
        check_output(tmp_path / "a.csv")
    with pytest.raises(ConfigError, match="files cannot be created there"):
        make_directory(tmp_path)


def test_a_directory_is_made_where_it_can_be(tmp_path: Path) -> None:
    make_directory(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file: cannot be created: it is a file"):
        make_directory(tmp_path / "file")


def test_packages_that_are_missing_are_named_with_the_extra_that_brings_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check_installed("analysis", "scipy", "onnx")
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(ConfigError) as refused:
        check_installed("analysis", "scipy", "onnx")
    assert str(refused.value) == "scipy is not installed: pip install 'jtqd[analysis]'"
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match="scipy, onnx are not installed"):
        check_installed("analysis", "scipy", "onnx")


def test_every_extra_that_is_asked_for_brings_what_is_asked_of_it() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {
        name: {IMPORTED.get(package, package) for package in (re.split(r"\W", line)[0] for line in lines)}
        for name, lines in project["optional-dependencies"].items()
    }
    asked = [
        (path, words)
        for path in sorted((ROOT / "sysid").rglob("*.py"))
        for words in re.findall(r'check_installed\("(.*?)"\)', path.read_text(encoding="utf-8"))
    ]
    assert len(asked) >= 5
    for path, words in asked:
        extra, *packages = words.split('", "')
        assert set(packages) <= extras[extra], path
