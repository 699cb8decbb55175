"""Words of messages: number and noun agree; places for results that cannot be written are refused before the work."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from jtqd.estimator.checked import ConfigError, check_output, counted, make_directory


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
