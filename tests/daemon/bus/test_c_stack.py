"""Drives by a C stack for CANopen (CANopenNode, Lely, CanFestival), beside those of the `canopen` library, if there is one.

Debian 12 packages none, so there are no drives made of one; this reports it in every run of the tests, and looks again.
"""

from __future__ import annotations

import shutil
import subprocess

import pytest

_WORDS = "canopennode|canopenlinux|lely-core|liblely|libcanfestival"
"""Names of packages."""
_PROGRAMS = ("canopend", "coctl")
"""Of CANopenNode's daemon for Linux, and of Lely's tools."""


def _found() -> list[str]:
    there = [name for name in _PROGRAMS if shutil.which(name)]
    if shutil.which("apt-cache") is None:
        return there
    command = ["apt-cache", "search", "--names-only", _WORDS]
    listed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout
    return there + [line.split(" ")[0] for line in listed.splitlines()]


@pytest.mark.c_stack
def test_drives_of_a_c_stack() -> None:
    found = _found()
    why = f"there is {', '.join(found)} now: make drives of it" if found else "Debian's packages have none"
    pytest.skip(
        f"NO DRIVES OF A C STACK ARE TESTED: {why}; those of the canopen library are (tests/library_drives)"
    )
