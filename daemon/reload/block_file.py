"""Estimators as a file of flat blocks, from the process that prepares them to the running loop.

    8 bytes    magic and version of this format
    4 bytes    length of the header
    header     JSON: `build` of the program, `position` in the ring of cycles, per joint its plain values and sizes of blocks
    blocks     one after the other, in the order of the header

Its length and SHA-256 travel beside it, from process to process: a file that is not the one that was written is refused
before anything of it is used. `build` is a hash of the program: the layout of a block is that of one build.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

from jtqd.estimator.blocks import EstimatorBlocks, blocks_of
from jtqd.estimator.sample import Estimator
from jtqd.estimator.sha256 import sha256

_MAGIC: Final = b"jtqdEB\x00\x01"
_LENGTH: Final = struct.Struct("<I")


class BlockFileError(Exception):
    """The file is not what it should be; the message is one line."""


@cache
def build() -> str:
    """Return a hash of the program that writes and reads blocks, as it lies on the disk when first asked."""
    digest = sha256()
    for package in ("jtqd.estimator", "jtqd.daemon.reload"):
        folder = Path(str(resources.files(package)))
        for path in sources(folder):
            digest.update(f"{package} {path.relative_to(folder)}".encode())
            digest.update(path.read_bytes())
    return str(digest.hexdigest())


def sources(folder: Path) -> list[Path]:
    """Return the modules under a folder in order. Folders of byte code are left out: they come and go while we read."""
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = [each for each in folders if each != "__pycache__"]
        found += [Path(place, each) for each in files if each.endswith((".py", ".so"))]
    return sorted(found)


def encoded(estimators: Sequence[Estimator], position: int) -> bytes:
    """Return the file of the estimators of joint 1, 2, ...; position: of the first record that they have not seen.

    Raises ValueError for an estimator that is not in its blocks alone (`blocks_of`).
    """
    all_blocks = [blocks_of(estimator) for estimator in estimators]
    joints = [{**each.plain, "sizes": [len(block) for block in each.blocks]} for each in all_blocks]
    header = json.dumps({"build": build(), "position": position, "joints": joints}).encode()
    blocks = [block for each in all_blocks for block in each.blocks]
    return b"".join((_MAGIC, _LENGTH.pack(len(header)), header, *blocks))


def decoded(content: memoryview) -> tuple[int, list[EstimatorBlocks]]:
    """Return the position and the estimators' blocks, which are views of `content`. Raises BlockFileError."""
    start = len(_MAGIC) + _LENGTH.size
    if len(content) < start or bytes(content[: len(_MAGIC)]) != _MAGIC:
        raise BlockFileError(f"found {bytes(content[:8])!r} at its beginning, expected {_MAGIC!r}")
    (length,) = _LENGTH.unpack_from(content, len(_MAGIC))
    header: dict[str, Any] = json.loads(bytes(content[start : start + length]))
    if header.get("build") != build():
        raise BlockFileError("the program has changed since jtqd started, it needs a restart")
    start += length
    result = []
    for plain in header["joints"]:
        blocks = []
        for size in plain["sizes"]:
            blocks.append(content[start : start + size])
            start += size
        result.append(EstimatorBlocks(plain, tuple(blocks)))
    if start != len(content):
        raise BlockFileError(f"found {len(content)} bytes, expected {start}")
    return header["position"], result
