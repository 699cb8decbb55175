"""jtqd as a service of a real systemd, in the bench kernel: installed, started, hung, killed, cut off, restarted, stopped.

Guest time moves only when everything sleeps: the times in the table are those of timers (watchdog, restart delay, polling)
and count no CPU time. `make test` runs the short list with an environment made beside the guest; the campaign runs every
step and installs in the guest as a user would. `JTQD_SYSTEMD_LOG=FILE` keeps the table.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from jtqd.sim_can.bench_kernel import build, guest
from tests.daemon.bus.test_guest_on_vcan import configuration
from tests.systemd.systemd_wheels import ROOT, make_environment, make_wheels

DRIVER = Path(__file__).with_name("systemd_driver.py")
PYTHON = Path("/usr/bin/python3")
pytestmark = pytest.mark.boots
SHORT = ("start", "changed file", "stopped loop", "stop", "wrong configuration", "page", "guest")
LONG = (
    *("start", "changed file", "stopped loop", "stopped supervisor"),
    *("killed supervisor", "killed loop"),
    *(
        "link down and up",
        "link removed and made again",
        "full disk",
        "stop",
        "wrong configuration",
        "page",
        "guest",
        "uninstall",
    ),
)


def needs() -> str | None:
    """What is missing here to boot systemd."""
    try:
        build.require(build.SYSTEMD)
        build.ensure()
    except (build.MissingPackagesError, build.BuildError, RuntimeError) as error:
        return str(error)
    return None


def booted(directory: Path, steps: tuple[str, ...], *, whole: bool) -> dict[str, dict[str, Any]]:
    """What each step found; the table is printed."""
    reason = needs()
    if reason is not None:
        print(f"\nSYSTEMD NOT TESTED: {reason}")
        pytest.skip(f"systemd not tested: {reason}")
    wheels = directory / "wheels"
    own = make_wheels(wheels)
    inputs, sync = {"wait_us": 2000, "deadline_us": 4250}, {"period_us": 5000, "counter_overflow": 0}
    configuration(directory, dcf=False, sync=sync, inputs=inputs, recording={"reserve_mb": 1})
    prepared = () if whole else ("prepared", str(make_environment(own, directory / "opt")))
    arguments = prepared or (str(own), str(wheels))
    command = [str(PYTHON), str(DRIVER), str(ROOT), *arguments, *steps]
    with guest.Guest(command, systemd=True, time_travel=True, vcans=["vcan0"]) as one:
        result = one.wait(1500.0)
    assert result.returncode == 0, result.stdout + result.stderr
    found = {line["step"]: line for line in map(json.loads, result.stdout.splitlines())}
    lines = [
        f"{name:<28} " + (", ".join(f"{what} {s:.2f} s" for what, s in line["seconds"].items()) or "-")
        for name, line in found.items()
    ]
    print("\n" + "\n".join(lines))
    if "JTQD_SYSTEMD_LOG" in os.environ:
        Path(os.environ["JTQD_SYSTEMD_LOG"]).write_text(result.stdout)
    return found


def check(found: dict[str, dict[str, Any]], steps: tuple[str, ...]) -> None:
    """What the driver does not check itself."""
    assert list(found) == ["install", *steps]
    assert found["install"]["seen"]["exposure"] <= 2.0
    assert 1.5 < found["stopped loop"]["seconds"]["noticed"] < 4.0  # WatchdogSec=2s
    assert "stopped supervisor" not in found or 1.5 < found["stopped supervisor"]["seconds"]["noticed"] < 8.0
    assert found["wrong configuration"]["seen"]["ExecMainStatus"] == "2"


def test_installed_started_restarted_hung_and_stopped(tmp_path: Path) -> None:
    check(booted(tmp_path, SHORT, whole=False), SHORT)


@pytest.mark.campaign
def test_whatever_happens_to_a_service(tmp_path: Path) -> None:
    check(booted(tmp_path, LONG, whole=True), LONG)
