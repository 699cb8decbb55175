"""The copy of the tree whose rooms are compiled with their mutants: build/mutants/tree.

python -m tests.slow.mutants.build ROOM...: compiles in the working directory, which is the copy (`make_copy`).
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

from tests.paths import ROOT
from tests.slow.mutants import ROOMS, SPAN

PLACE = ROOT / "build" / "mutants"
TREE, TABLES = PLACE / "tree", PLACE / "tables"


def first_number(room: str) -> int:
    """Return the number of a room's first mutant."""
    return SPAN * list(ROOMS).index(room)


def module_of(room: str) -> str:
    """Return the import name of a room."""
    return "jtqd." + ROOMS[room].removesuffix(".pyx").replace("/", ".")


def make_copy(rooms: list[str], *, built: bool = False) -> None:
    """Copy the tree as it stands and compile `rooms` with their mutants; the other modules stay as they are compiled here.

    built: the copy of the last run stays, and only its tests are copied again.
    """
    if built:
        shutil.rmtree(TREE / "tests")
        unwanted = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "tests", TREE / "tests", ignore=unwanted)
        return
    shutil.rmtree(PLACE, ignore_errors=True)
    TABLES.mkdir(parents=True)
    listed = subprocess.check_output(["git", "-C", ROOT, "ls-files", "-coz", "--exclude-standard"], text=True)
    names = [each for each in listed.split("\0") if each and not each.startswith("docs/figures")]
    compiled = [
        path.relative_to(ROOT)
        for folder in ("daemon", "drivers", "estimator", "src/jtqd")
        for path in (ROOT / folder).rglob("*.so")
    ]
    for each in (*names, *compiled):
        source, target = ROOT / each, TREE / each
        if source.exists() or source.is_symlink():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
    for made in [
        ROOT / "build" / "cython",
        *(ROOT / "build").glob("lib.*"),
        *(ROOT / "build").glob("temp.*"),
    ]:
        shutil.copytree(made, TREE / "build" / made.name)
    environment = os.environ | {"PYTHONPATH": str(TREE / "src"), "CFLAGS": "-ftrivial-auto-var-init=zero"}
    command = [sys.executable, "-m", "tests.slow.mutants.build", *rooms]
    done = subprocess.run(command, cwd=TREE, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"the mutants do not compile:\n{done.stdout[-15000:]}\n{done.stderr[-4000:]}")


def main(rooms: list[str]) -> None:
    """Compile `rooms` with their mutants in the working directory."""
    from tests.slow.mutants.transform import C_CODE, install

    count = SPAN * len(ROOMS)
    for room in rooms:
        with open(ROOMS[room], "a", encoding="utf-8") as file:
            file.write(C_CODE.replace("JTQD_NUMBERS", str(count)))
    install({module_of(room): first_number(room) for room in rooms}, Path.cwd().parent / "tables")
    sys.argv = ["setup.py", "-q", "build_ext", "--inplace"]
    runpy.run_path("setup.py", run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
