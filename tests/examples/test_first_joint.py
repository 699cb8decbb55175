"""docs/first_joint.md: every command of it runs on the emulated bench, in the order of the page.

The commands are those that stand indented in the page and begin with a name of PROGRAMS. `can0` is the interface of the
tests; what only real hardware can do is named in NOT_HERE.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.paths import ROOT

PAGE = ROOT / "docs" / "first_joint.md"
PROGRAMS = ("jtq ", "jtqd ", "cc ", "./", "sudo ", "ip ")
NOT_HERE = {
    "sudo ip link add vcan0 type vcan; sudo ip link set vcan0 up": "the interface of the tests is there",
    "sudo ip link set can0 down": "other tests use the interface",
    "sudo ip link set can0 type can bitrate 1000000": "a virtual interface has no bit rate",
    "sudo ip link set can0 type can restart-ms 100": "and no bus-off",
    "sudo ip link set can0 txqueuelen 1000 up": "other tests use the interface",
}
FINDINGS = {"jtq doctor": {0, 1, 3}, "jtq check": {0, 3}, "jtq diagnose": {0, 3}, "jtq evaluate": {0, 3}}
"""Exit statuses that are fine; 0 alone for all others. The guest is no good machine, which `doctor` rightly says."""
IN_A_SECOND_TERMINAL = ("jtq status", "cc ", "./receive_estimate")
INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")


def commands() -> list[str]:
    indented = re.findall(r"^ {4}(\S.*)$", PAGE.read_text(), re.MULTILINE)
    return [line for line in indented if line.startswith(PROGRAMS)]


def allowed(command: str) -> set[int]:
    return next((found for name, found in FINDINGS.items() if command.startswith(name)), {0})


def test_every_command_is_known_and_everything_that_is_left_out_stands_in_the_page() -> None:
    assert set(NOT_HERE) <= set(commands())
    run = [each for each in commands() if each not in NOT_HERE]
    assert len(run) > 10
    for needed in ("jtq init", "jtqd ", "jtq fit friction", "jtq diagnose", "./receive_estimate"):
        assert any(each.startswith(needed) for each in run), needed


def emulated(command: str) -> subprocess.Popen[str]:
    """Start the emulated bench as the page says it, on the interface of the tests."""
    options = command.replace("vcan0", INTERFACE).split()[2:]
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", *options], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "ready" in process.stderr.readline()
    return process


def end(process: subprocess.Popen[str] | None) -> None:
    if process is not None and process.poll() is None:
        process.terminate()
        process.communicate(timeout=60)


@pytest.mark.campaign
@pytest.mark.socketcan
@pytest.mark.skipif(shutil.which("cc") is None, reason="NOT TESTED: no cc")
def test_every_command_of_the_page(tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "RUNTIME_DIRECTORY": str(tmp_path / "run"),
    }
    (tmp_path / "run").mkdir()
    bench: subprocess.Popen[str] | None = None
    beside: subprocess.Popen[str] | None = None
    said = {}
    try:
        for command in commands():
            if command in NOT_HERE:
                continue
            if command.startswith("jtq sim"):
                end(bench)
                bench = emulated(command)
                continue
            line = re.sub(r"\bcan0\b", INTERFACE, command)
            if beside is not None and not command.startswith(IN_A_SECOND_TERMINAL):
                _, err = beside.communicate(timeout=60)
                assert beside.returncode == 0, err
                beside = None
            if command.startswith("jtqd "):
                beside = subprocess.Popen(
                    line,
                    shell=True,
                    cwd=tmp_path,
                    env=environment,
                    text=True,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                )
                time.sleep(5)
                continue
            done = subprocess.run(
                line,
                shell=True,
                cwd=tmp_path,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=600,
                check=False,
            )
            assert done.returncode in allowed(command), (
                f"{line}: {done.returncode}\n{done.stdout}{done.stderr}"
            )
            assert "Traceback" not in done.stderr
            said[command] = done.stdout
    finally:
        end(beside)
        end(bench)
    (received,) = (out for command, out in said.items() if command.startswith("./receive"))
    assert " lost 0," in received
    assert "USE   valid" in received
    fitted = [out for command, out in said.items() if command.startswith("jtq fit")]
    assert all("coulomb_nm = " in out for out in fitted)
    assert (tmp_path / "diagnosis" / "report.html").is_file()
