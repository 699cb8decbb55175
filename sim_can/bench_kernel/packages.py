"""Debian packages that the bench kernel needs: which are missing, and their installation."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from typing import NamedTuple

SOURCE_PACKAGE = "linux-source-6.1"
SOURCE_ARCHIVE = f"/usr/src/{SOURCE_PACKAGE}.tar.xz"


class Requirement(NamedTuple):
    """One Debian package and the program (bare name) or file (absolute path) that shows it is there."""

    package: str
    proof: str


BUILD = (
    Requirement(SOURCE_PACKAGE, SOURCE_ARCHIVE),
    Requirement("gcc", "gcc"),
    Requirement("libc6-dev", "/usr/include/stdio.h"),
    Requirement("make", "make"),
    Requirement("flex", "flex"),
    Requirement("bison", "bison"),
    Requirement("bc", "bc"),
    Requirement("libelf-dev", "/usr/include/libelf.h"),
    Requirement("xz-utils", "xz"),
)
GUEST = (Requirement("iproute2", "ip"),)
TESTS = (Requirement("can-utils", "candump"),)
SYSTEMD = (
    Requirement("systemd", "/lib/systemd/systemd"),
    Requirement("udev", "/lib/systemd/systemd-udevd"),
    Requirement("dbus", "/usr/bin/dbus-daemon"),
    Requirement("python3-venv", "/usr/bin/python3"),
)


class MissingPackagesError(RuntimeError):
    """Packages are needed that are not installed and may not be installed by this user."""

    def __init__(self, packages: Iterable[str]) -> None:
        self.packages = tuple(packages)
        super().__init__(
            "the bench kernel needs Debian packages that are not installed: "
            f"{' '.join(self.packages)}; install them with: sudo apt-get install {' '.join(self.packages)}"
        )


def find_program(name: str) -> str | None:
    """Path of a program; looks into the sbin directories too, which are not in every user's PATH."""
    return shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin:/usr/bin:/bin")


def missing(
    requirements: Iterable[Requirement],
    which: Callable[[str], str | None] = find_program,
    exists: Callable[[str], bool] = os.path.exists,
) -> list[str]:
    """Return names of the packages whose program or file is not there, in the order of `requirements`."""
    return [
        need.package
        for need in requirements
        if not (exists(need.proof) if need.proof.startswith("/") else which(need.proof))
    ]


def require(requirements: Iterable[Requirement], *, install: bool = True) -> None:
    """Make sure that all packages are there; as root, install what is not.

    Raises MissingPackagesError when packages are missing and this user may not install them (or `install` is
    false), RuntimeError when apt-get fails.
    """
    wanted = tuple(requirements)
    lacking = missing(wanted)
    if not lacking:
        return
    if not install or os.geteuid() != 0 or find_program("apt-get") is None:
        raise MissingPackagesError(lacking)
    print(f"bench kernel: apt-get install {' '.join(lacking)}", file=sys.stderr, flush=True)
    _apt_get("update")
    # Recommended packages are left out: those of linux-source alone are several hundred megabytes.
    _apt_get("install", "-y", "--no-install-recommends", *lacking)
    still = missing(wanted)
    if still:
        raise MissingPackagesError(still)


def _apt_get(*arguments: str) -> None:
    done = subprocess.run(
        ["apt-get", "-q", *arguments],
        env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode != 0:
        last = "\n".join(done.stdout.splitlines()[-15:])
        raise RuntimeError(f"apt-get {' '.join(arguments)} failed with status {done.returncode}:\n{last}")
