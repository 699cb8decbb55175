"""Files of others and outputs: what is not waited for, what is not believed, what an output replaces and what not."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from jtqd.estimator import files
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import open_regular, read_file, read_regular, trusted_users, whole_file, write_whole
from tests.paths import ROOT


def fifo(path: Path) -> Path:
    os.mkfifo(path)
    return path


def link(path: Path, target: str) -> Path:
    path.symlink_to(target)
    return path


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (fifo, "found no regular file"),
        (lambda path: link(path, "/dev/zero"), "found no regular file"),
        (lambda path: path.mkdir() or path, "Is a directory"),
        (lambda path: link(path, "nothing"), "No such file"),
        (lambda path: link(path, path.name), "Too many levels"),
        (lambda path: path.with_name("a\0b"), "embedded null byte"),
    ],
)
def test_what_is_no_regular_file_is_neither_waited_for_nor_read(
    tmp_path: Path, make: Callable[[Path], Path], problem: str
) -> None:
    path = make(tmp_path / "it")
    with pytest.raises(OSError, match=problem):
        open_regular(path)
    with pytest.raises(ConfigError, match=problem):
        read_regular(path, 10, "a file")


def test_a_file_is_read_up_to_its_bound(tmp_path: Path) -> None:
    path = tmp_path / "it"
    path.write_bytes(b"1234567890")
    assert read_file(path, 10) == b"1234567890"
    with pytest.raises(OSError, match="found more than 9 bytes"):
        read_file(path, 9)
    os.truncate(path, 3 << 30)
    with pytest.raises(OSError, match="found more than 9 bytes"):
        read_file(path, 9)


def test_of_others_nothing_is_believed_and_no_link_is_followed(tmp_path: Path) -> None:
    path, own = tmp_path / "it", {os.getuid()}
    path.write_bytes(b"1")
    path.chmod(0o640)
    assert read_file(path, 10, owners=own) == b"1"
    with pytest.raises(OSError, match=f"it belongs to user {os.getuid()}"):
        read_file(path, 10, owners={os.getuid() + 1})
    with pytest.raises(OSError, match="Too many levels"):
        read_file(link(tmp_path / "link", "it"), 10, owners=own)
    path.chmod(0o646)
    with pytest.raises(OSError, match="every user may write it"):
        read_file(path, 10, owners=own)


def test_root_and_the_users_of_services_are_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "_SERVICES", tmp_path)
    assert trusted_users() == {0, os.getuid()}
    if os.getuid() == 0:
        (tmp_path / "can0").mkdir()
        os.chown(tmp_path / "can0", 4711, -1)
        assert trusted_users() == {0, 4711}
        os.chown(tmp_path, 4712, -1)
        assert trusted_users() == {0}, "others make entries in it"


def test_an_output_replaces_a_regular_file_whole_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "it"
    path.write_bytes(b"old")
    path.chmod(0o600)
    before = path.stat().st_ino
    with suppress(ValueError), whole_file(path) as file:
        file.write(b"half")
        raise ValueError
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (b"new", 0o600)
    assert path.stat().st_ino != before
    assert [each.name for each in tmp_path.iterdir()] == ["it"]


def test_an_output_follows_links(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_bytes(b"old")
    for name, target in (("to a file", "there/file"), ("dangling", "there/new")):
        path = link(tmp_path / name, target)
        write_whole(path, b"new")
        assert path.is_symlink()
        assert (tmp_path / target).read_bytes() == b"new"
    assert sorted(each.name for each in (tmp_path / "there").iterdir()) == ["file", "new"]


def test_an_output_writes_through_a_pipe_and_a_device(tmp_path: Path) -> None:
    path = fifo(tmp_path / "pipe")
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(path, b"through")
    assert (os.read(reader, 100), stat.S_ISFIFO(path.stat().st_mode)) == (b"through", True)
    os.close(reader)
    null = link(tmp_path / "null", "/dev/null")
    write_whole(null, b"away")
    assert stat.S_ISCHR(null.stat().st_mode)
    assert null.is_symlink()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["null", "pipe"]


def test_standard_output_is_written_to_where_it_is_a_pipe_a_file_or_a_file_continued(tmp_path: Path) -> None:
    code = "from pathlib import Path; from jtqd.estimator.files import write_whole as w; w(Path('/dev/stdout'), b'12')"
    assert subprocess.check_output([sys.executable, "-c", code]) == b"12"
    path = tmp_path / "out"
    path.write_bytes(b"0")
    with path.open("ab") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert path.read_bytes() == b"012"


def test_a_name_planted_beside_an_output_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a directory where everybody may write, a link with the name of the temporary file would be written through."""
    monkeypatch.setattr(os, "urandom", bytes)
    link(tmp_path / ".it.00000000.part", "victim")
    with pytest.raises(FileExistsError):
        write_whole(tmp_path / "it", b"new")
    assert not (tmp_path / "victim").exists()


WRITERS = re.compile(
    r"os\.replace\(|(?<!\"\))\.write_(text|bytes)\(|savefig\((?!file|stream)|open\([^)\n]*\"wb?\""
)
OWN_FILES = {
    "daemon/cli/init.py": "files of a temporary directory",
    "daemon/jtq.py": "standard streams",
    "daemon/logs/can_io.py": "python-can opens its outputs so",
    "daemon/logs/recover.py": "the log that is repaired",
    "daemon/recording/launch.py": "runtime directory",
    "daemon/replay/logged.py": "files of a temporary directory",
    "daemon/shared/runtime_dir.py": "runtime directory",
    "estimator/files.py": "the one place",
    "sysid/batch/command.py": "directory of results",
    "sysid/campaign/bench.py": "directory of a run",
    "sysid/campaign/runner.py": "directory of a run",
    "sysid/diagnosis/command.py": "files of a temporary directory",
}


def test_outputs_are_written_in_one_place() -> None:
    """`--out` of every command follows links and replaces regular files only, because all call `whole_file`."""
    found = {
        str(path.relative_to(ROOT))
        for package in ("daemon", "drivers", "estimator", "models", "sim_can", "sysid")
        for path in (ROOT / package).rglob("*.py")
        if "bench_kernel" not in path.parts and WRITERS.search(path.read_text())
    }
    assert found == set(OWN_FILES)
