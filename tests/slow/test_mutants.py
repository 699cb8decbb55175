"""Mutants of compiled code: the transformation itself, and the rooms of which every mutant must be killed."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT
from tests.slow.mutants import DONE, SPAN
from tests.slow.mutants.__main__ import equivalent, main
from tests.slow.mutants.transform import C_CODE

SOURCE = """
cdef double LIMIT = 4.0

cdef int clipped(double x, int *count) noexcept nogil:
    cdef int k
    if not (-LIMIT <= x < LIMIT and count[0] >= 0):
        return -1
    for k in range(2, 0, -1):
        count[0] += 1
    return 10 if x > 1.5 else 20

def both(double x):
    cdef int count = 0
    return clipped(x, &count), count
"""
CHANGES = {
    "4.0 -> 8.0": "5.0 -> (10, 2)",
    "<= -> <": "-4.0 -> (-1, 0)",
    "< -> <= (link 2)": "4.0 -> (10, 2)",
    "minus left out": "-3.0 -> (-1, 0)",
    "+= -> -=": "0.0 -> (20, -2)",
    "statement deleted": "0.0 -> (20, 0)",
    "10 -> 11": "2.0 -> (11, 2)",
    "1.5 -> 3.0": "2.0 -> (20, 2)",
    "and -> or": "5.0 -> (10, 2)",
}
"""What some mutants of SOURCE return, which the original does not."""
RUN = """
import sys
from pathlib import Path
from Cython.Build import cythonize
from setuptools import Extension, setup
from tests.slow.mutants.transform import install
install({"small": 0}, Path("."))
sys.argv = ["setup.py", "-q", "build_ext", "--inplace"]
directives = {"language_level": 3, "cdivision": True}
setup(ext_modules=cythonize([Extension("small", ["small.pyx"], extra_compile_args=["-O1"])], compiler_directives=directives))
"""


def test_every_change_of_a_module_acts_alone(tmp_path: Path) -> None:
    (tmp_path / "small.pyx").write_text(SOURCE + C_CODE.replace("JTQD_NUMBERS", str(SPAN)))
    memory = tmp_path / "memory"
    memory.write_bytes(struct.pack("<i", -1) + bytes(SPAN))
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'src'}", "JTQD_MUTANTS": str(memory)}
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    table = json.loads((tmp_path / "small.json").read_text())["mutants"]
    assert [each["number"] for each in table] == list(range(len(table)))

    def returned(number: int, x: str) -> str:
        memory.write_bytes(struct.pack("<i", number) + bytes(SPAN))
        code = f"import small; print('{x} ->', small.both({x}))"
        return subprocess.check_output(
            [sys.executable, "-c", code], cwd=tmp_path, env=environment, text=True
        ).strip()

    for change, result in CHANGES.items():
        number = next(each["number"] for each in table if each["change"] == change)
        x = result.partition(" ")[0]
        assert returned(number, x) == result
        assert returned(-1, x) != result
    reached = memory.read_bytes()[4:]
    assert reached[next(each["number"] for each in table if each["change"] == "<= -> <")] == 1


def test_every_equivalent_mutant_has_a_reason() -> None:
    assert all(len(reason.split()) >= 5 for reason in equivalent().values())


@pytest.mark.campaign
def test_no_mutant_of_the_rooms_that_are_done_survives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["mutants", "--room", *DONE])
    assert main() == 0
