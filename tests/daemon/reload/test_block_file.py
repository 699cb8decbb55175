"""The file between the preparing process and the loop: what it holds, and what is refused."""

import json
import os
import stat
import struct
from pathlib import Path

import pytest

from jtqd.daemon.reload import block_file
from jtqd.daemon.reload.block_file import BlockFileError, decoded, encoded
from jtqd.daemon.reload.prepare import write
from jtqd.estimator.methods import make_estimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped


def content(position: int = 7) -> bytes:
    settings = EstimatorSettings(method="efficiency")
    return encoded(
        [make_estimator(load_joint(shipped(f"joint{n}.yaml")), settings) for n in (1, 2)], position
    )


def header_of(data: bytes) -> tuple[int, dict[str, object]]:
    (length,) = struct.unpack_from("<I", data, 8)
    return length, json.loads(data[12 : 12 + length])


def test_what_goes_in_comes_out() -> None:
    position, joints = decoded(memoryview(content(4711)))
    assert position == 4711
    assert [each.plain["joint"]["name"] for each in joints] == ["joint1", "joint2"]
    assert [[len(block) for block in each.blocks] for each in joints] == [
        each.plain["sizes"] for each in joints
    ]


@pytest.mark.parametrize("length", [0, 5, 11])
def test_a_beginning_alone_is_none(length: int) -> None:
    with pytest.raises(BlockFileError, match="at its beginning, expected"):
        decoded(memoryview(content()[:length]))


def test_another_version_of_the_format_is_refused() -> None:
    data = content()
    with pytest.raises(BlockFileError, match="at its beginning, expected"):
        decoded(memoryview(data[:7] + b"\x02" + data[8:]))


@pytest.mark.parametrize("change", [slice(None, -1), slice(None, -1000)])
def test_another_length_is_refused(change: slice) -> None:
    with pytest.raises(BlockFileError, match=r"found \d+ bytes, expected \d+"):
        decoded(memoryview(content()[change]))
    with pytest.raises(BlockFileError, match=r"found \d+ bytes, expected \d+"):
        decoded(memoryview(content() + b"\0"))


def test_blocks_of_another_program_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that was installed while the daemon ran may lay its blocks out otherwise, at the same sizes."""
    data = content()
    monkeypatch.setattr(block_file, "build", lambda: "another")
    with pytest.raises(
        BlockFileError, match="the program has changed since jtqd started, it needs a restart"
    ):
        decoded(memoryview(data))
    monkeypatch.undo()
    length, header = header_of(data)
    del header["build"]
    bare = json.dumps(header).encode()
    with pytest.raises(BlockFileError, match="the program has changed"):
        decoded(memoryview(data[:8] + struct.pack("<I", len(bare)) + bare + data[12 + length :]))


def test_folders_of_byte_code_are_no_part_of_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process makes or removes them while a daemon starts: one that goes between two looks must not stop it."""
    for name in ("b.py", "a/c.so", "a/notes.txt", "__pycache__/b.py", "a/__pycache__/c.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    looked_into = os.scandir

    def scandir(path: str) -> "os._ScandirIterator[str]":
        if str(path).endswith("__pycache__"):
            raise FileNotFoundError(2, "No such file or directory", path)
        return looked_into(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert block_file.sources(tmp_path) == [tmp_path / "a/c.so", tmp_path / "b.py"]


def test_it_is_for_its_owner_alone_and_follows_no_link(tmp_path: Path) -> None:
    path, elsewhere = tmp_path / "estimators", tmp_path / "elsewhere"
    elsewhere.write_text("untouched")
    path.symlink_to(elsewhere)
    write(path, b"blocks")
    assert elsewhere.read_text() == "untouched"
    assert path.read_bytes() == b"blocks"
    assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    write(path, b"others")
    assert path.read_bytes() == b"others"
