"""Tests of compiled code against builds that check: `python -m tests.slow.sanitized [--frames N] [checked|sanitized ...]`.

checked     bounds of arrays, uninitialised memory views
sanitized   AddressSanitizer and UndefinedBehaviorSanitizer of the C compiler; whatever they find ends the process

Each build is made in a copy of the tree below build/, so that the one in use stays as it is.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.paths import ROOT

BUILDS = ("checked", "sanitized")
FOLDERS = ("estimator", "drivers", "daemon/core", "daemon/loop", "daemon/replay", "golden", "sim_can")
_SELECTED = "not (campaign or socketcan or boots or native)"
_KERNEL = "tests/sim_can/bench_kernel"
"""Left out: a sanitizer's library is preloaded into every process, and the kernel, a process here, does not bear it."""


def copy_of_tree(build: str) -> Path:
    """Return a fresh copy of the sources for a build; what it compiled last time is kept."""
    target = ROOT / "build" / f"tree-{build}"
    ignored = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info")
    for item in ("setup.py", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "Makefile"):
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / item, target / item)
    for link in (ROOT / "src" / "jtqd").iterdir():
        if link.is_symlink():
            _mirror(ROOT / link.name, target / link.name, ignored)
    for folder in ("src", "tests", "examples", "docs", "systemd", "tools", "validation"):
        shutil.rmtree(target / folder, ignore_errors=True)
        shutil.copytree(ROOT / folder, target / folder, symlinks=True, ignore=ignored)
    return target


def _mirror(source: Path, target: Path, ignored: object) -> None:
    """Copy a folder; compiled modules that lie there stay."""
    if target.exists():
        for path in target.rglob("*"):
            if path.is_file() and path.suffix != ".so":
                path.unlink()
    shutil.copytree(source, target, symlinks=True, ignore=ignored, dirs_exist_ok=True)  # type: ignore[arg-type]


def environment(build: str, tree: Path) -> dict[str, str]:
    """Return the environment in which the copy is imported, and the sanitizers stop at what they find."""
    given = {
        **os.environ,
        "JTQD_BUILD": build,
        "PYTHONPATH": f"{tree / 'src'}:{tree}",
        "OMP_NUM_THREADS": "1",
    }
    if build == "sanitized":
        libraries = [
            subprocess.run(
                ["cc", f"-print-file-name=lib{name}.so"], capture_output=True, text=True, check=True
            ).stdout.strip()
            for name in ("asan", "ubsan")
        ]
        given |= {
            "LD_PRELOAD": " ".join(libraries),
            "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter frees at exit what it thinks fit
            "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        }
    return given


def main() -> int:
    """Build, test, and fuzz with frames; returns 1 if anything failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("builds", nargs="*", metavar="|".join(BUILDS), help="default: both")
    parser.add_argument("--frames", type=int, default=1_000_000, help="of the frame fuzzer (default 1000000)")
    options = parser.parse_args()
    unknown = set(options.builds) - set(BUILDS)
    if unknown:
        parser.error(f"found {', '.join(sorted(unknown))}, expected {', '.join(BUILDS)}")
    failed = []
    for build in options.builds or BUILDS:
        tree = copy_of_tree(build)
        compiling = {name: value for name, value in environment(build, tree).items() if name != "LD_PRELOAD"}
        subprocess.run(
            [sys.executable, "setup.py", "-q", "build_ext", "--inplace"], cwd=tree, env=compiling, check=True
        )
        present = [f"tests/{folder}" for folder in FOLDERS]
        for command in (
            ["-m", "pytest", "-q", "-p", "no:faulthandler", "-m", _SELECTED, f"--ignore={_KERNEL}", *present],
            ["-m", "tests.slow.fuzz", "frames", "--count", str(options.frames)],
        ):
            print(f"{build}: python {' '.join(command)}", flush=True)
            if subprocess.run(
                [sys.executable, *command], cwd=tree, env=environment(build, tree), check=False
            ).returncode:
                failed.append(f"{build}: {command[1]}")
    print("failed: " + ", ".join(failed) if failed else "nothing found")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
