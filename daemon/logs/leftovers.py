"""Files that a crash left behind: `python -m jtqd.daemon.logs.leftovers DIRECTORY PREFIX` repairs those of one prefix.

A process of its own at the lowest priority, started by the recorder once it records: a large file takes seconds. A file that
somebody is writing (it is locked then) is left alone, and so is everything that is not named as ours. One JSON line on
stdout for each file: {"file", "text", "lossy"}.
"""

from __future__ import annotations

import fcntl
import json
import os
import sys
from contextlib import suppress
from pathlib import Path

from jtqd.daemon.logs.recover import RecoverError, recover
from jtqd.daemon.recording.parts import OwnFile, own_files


def _is_being_written(path: Path) -> bool:
    with suppress(OSError), open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def repair(file: OwnFile) -> tuple[str, bool] | None:
    """Repair one file: what was done, and whether something in it could not be read. None: somebody is writing it."""
    path = file.path
    if _is_being_written(path):
        return None
    try:
        if path.stat().st_size == 0:  # its recorder died before the first byte
            path.unlink()
            return f"{path.name} was empty: removed", False
        found = recover(path)
    except RecoverError as error:
        return str(error), True
    except OSError as error:
        return f"{path.name} cannot be repaired: {error.strerror}", True
    text = f"{found.path.name} repaired: {found.chunks} chunks kept"
    if found.lost_bytes:
        text += f", {found.lost_bytes} B ({found.lost_s:.1f} s) unreadable"
    return text, found.lossy


def main(arguments: list[str]) -> int:
    """Repair all; exit status 0, or 2 for wrong use."""
    if len(arguments) != 2:
        print("usage: python -m jtqd.daemon.logs.leftovers DIRECTORY PREFIX", file=sys.stderr)
        return 2
    with suppress(OSError):
        os.nice(19)
    for file in own_files(Path(arguments[0]), arguments[1]):
        result = repair(file) if file.active else None
        if result is not None:
            print(json.dumps({"file": str(file.path), "text": result[0], "lossy": result[1]}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
