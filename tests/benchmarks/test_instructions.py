"""Instructions of a step against the stored ones: a step that has become dearer is seen on any machine."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest

from tests.benchmarks.instructions import CYCLE, METHODS, SHADOWS, STORED, BusyError, count

WITHIN = 0.05
MORE = 2


def compiler() -> str:
    found = shutil.which("cc")
    if found is None:
        return "none"
    return subprocess.run(
        [found, "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]


@pytest.mark.parametrize(
    "method",
    [
        # the cycle has method `fused` of two joints in it
        pytest.param(
            each, marks=[pytest.mark.native, pytest.mark.measures] if each == CYCLE else pytest.mark.campaign
        )
        for each in (*METHODS, CYCLE, *SHADOWS)
    ],
)
def test_a_step_costs_what_it_did(method: str) -> None:
    stored = json.loads(STORED.read_text())
    if shutil.which("valgrind") is None:
        pytest.skip("found no valgrind: instructions cannot be counted here")
    if compiler() != stored["compiler"]:
        pytest.skip(f"found the compiler {compiler()}, the stored counts are of {stored['compiler']}")
    try:
        counted = count(method)
        for _ in range(MORE):  # frames that come late add instructions and take none
            if counted > (1.0 + WITHIN) * stored["instructions"][method]:
                counted = min(counted, count(method))
    except BusyError as error:
        pytest.skip(f"INSTRUCTIONS OF A CYCLE ARE NOT COUNTED: {error}")
    assert counted == pytest.approx(stored["instructions"][method], rel=WITHIN), (
        "on purpose: python -m tests.benchmarks.instructions --store WHY"
    )
