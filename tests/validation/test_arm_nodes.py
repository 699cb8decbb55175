"""The foreign arm over its buses: nodes of a day on all four, a jtqd on each, in real SocketCAN."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import yaml

from jtqd.daemon.logs.read import read_topic
from jtqd.estimator.status import PUBLISHED
from tests.daemon.test_arm import interfaces  # noqa: F401 (a fixture)
from validation.arm.arm import CYCLE_S, JOINTS, TOOL, URDF, Arm, Contact, Readings, Run, Truth, read
from validation.arm.joints import RealJoints, towed
from validation.arm.nodes import BUSES, WAITING, DaySource, ratings_of, write_arm

SECONDS = 4.0
READY_S = 6.0
"""From the start of all processes to the beginning of the day."""


def test_every_bus_shows_the_same_instant_of_the_day() -> None:
    arm = Arm("typical", 9)
    rows = np.arange(1000.0)[:, None] + 1000.0 * np.arange(JOINTS)
    times = iter((-0.4, 0.05))
    one, other = (DaySource([rows] * 5, BUSES[k], ratings_of(arm)[:2], lambda: next(times)) for k in (0, 1))
    assert one.advance(0.0)
    assert one.drives[1].motor_position_rad == 1000.0  # a whole turn to and fro before the day
    for _ in range(250):
        assert one.advance(CYCLE_S)
    assert one.drives[0].motor_position_rad == 2.0 * WAITING - 250.0
    for _ in range(200):
        one.advance(CYCLE_S)
    other.advance(0.0)
    assert one.drives[0].link_position_rad == 50.0
    assert other.drives[1].current_a == 3050.0
    assert other.advance(0.9)
    assert not other.advance(0.06)


@pytest.mark.campaign
@pytest.mark.socketcan
@pytest.mark.usefixtures("interfaces")
def test_daemons_on_four_buses_estimate_the_arm_at_the_same_instants(tmp_path: Path) -> None:
    arm = Arm("typical", 9)
    joints = RealJoints(arm, *towed(arm, runs=6, seconds=5.0))
    pose = np.array([0.3, -0.3, 0.0, -2.2, 0.0, 2.0, 0.4])
    t = CYCLE_S * np.arange(round(SECONDS / CYCLE_S))
    path = pose + 0.3 * (1.0 - np.cos(2.0 * np.pi * t[:, None] / np.linspace(2.0, 3.5, JOINTS)))
    push = Contact("push", 2.5, 2.51, 3.2, 7, (0.0, 0.0, 0.1), (30.0, 0.0, 0.0))
    run = Run(1, path, contacts=(push,))
    truth = arm.record([run])[0]
    readings = read(arm, run, truth, joints)
    write_arm(tmp_path, arm, joints, readings)
    begin = time.monotonic_ns() + round(1e9 * READY_S)
    with ExitStack() as stack:
        running = [
            started(stack, tmp_path, number, f"vcan{number - 1}", begin)
            for number in range(1, len(BUSES) + 1)
        ]
        above = stack.enter_context(arm_started(tmp_path, begin))
        for jtqd in (*running, above):
            _, error = jtqd.communicate(timeout=60)
            assert jtqd.returncode == 0, error
    begun_ns = []
    for number, on_bus in enumerate(BUSES, start=1):
        for node, joint in enumerate(on_bus, start=1):
            begun_ns.append(
                checked(sorted((tmp_path / f"log_{number}").glob("*.mcap")), node, joint, arm, readings)
            )
    assert np.ptp(begun_ns) <= 1.5e6
    check_arm(tmp_path, arm, truth, push, begin)


def arm_started(folder: Path, begin_ns: int) -> subprocess.Popen[str]:
    """Start jtqd-arm beside the daemons."""
    joints = {
        f"panda_joint{joint}": {"bus": f"vcan{number}", "joint": node, "direction": 1, "zero_rad": 0.0}
        for number, on_bus in enumerate(BUSES)
        for node, joint in enumerate(on_bus, start=1)
    }
    payload = {"mass_kg": 0.0, "centre_m": [0.0, 0.0, 0.0]}
    content = {"urdf": str(URDF), "tool": TOOL, "joints": joints, "payload": payload}
    (folder / "arm.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    duration_s = (begin_ns - time.monotonic_ns()) * 1e-9 + SECONDS - 0.3
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "jtqd.daemon.arm.command", str(folder / "arm.yaml"), "--json"),
            *("--record", str(folder / "log_arm"), "--duration", str(duration_s)),
        ],
        env={**os.environ, "RUNTIME_DIRECTORY": str(folder / "run")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def check_arm(folder: Path, arm: Arm, truth: Truth, push: Contact, begin_ns: int) -> None:
    """Check external torque and contact in the log of jtqd-arm by the truth of the same instants."""
    log = sorted((folder / "log_arm").glob("*.mcap"))
    external = read_topic(log, "/arm/external")
    row = np.round((external["monotonic_ns"] - begin_ns) * 1e-6).astype(int) - 13  # of the filter
    pushed = (row > 1e3 * push.full_s + 30.0) & (row < 1e3 * push.end_s)
    free = (row > 1500) & (row < 1e3 * push.start_s)
    assert pushed.sum() > 300
    assert free.sum() > 300
    off = external["external_nm"] - truth.external_nm[np.clip(row, 0, len(truth.external_nm) - 1)]
    assert np.nanmean(np.isfinite(off[pushed | free])) > 0.9
    size = np.sqrt(np.nanmean((off[pushed | free] / arm.rated_nm) ** 2, axis=0))
    assert (size < 0.04).all()  # links are 10 % and 5 mm off the URDF
    felt = np.nanmean(external["external_nm"][pushed], axis=0)
    true = truth.external_nm[row[pushed]].mean(axis=0)
    assert felt[np.argmax(np.abs(true))] == pytest.approx(true[np.argmax(np.abs(true))], rel=0.35)
    contact = read_topic(log, "/arm/contact")
    clocks = {
        name: table["header"]["stamp"]["sec"].astype(np.int64) * 10**9 + table["header"]["stamp"]["nanosec"]
        for name, table in (("contact", contact), ("external", external))
    }
    ahead = clocks["external"][0] - external["monotonic_ns"][0] + begin_ns
    at = (clocks["contact"] - ahead) * 1e-9
    during = (at > push.full_s + 0.05) & (at < push.end_s)
    before = (at > 1.5) & (at < push.start_s)
    assert (contact["link"][during] == push.link).mean() > 0.8
    assert not contact["link"][before].any()


def started(stack: ExitStack, folder: Path, number: int, bus: str, begin_ns: int) -> subprocess.Popen[str]:
    """Start the nodes and the jtqd of a bus; return the latter."""
    on_bus = ",".join(map(str, BUSES[number - 1]))
    nodes = stack.enter_context(
        subprocess.Popen(
            [
                *(sys.executable, "-m", "validation.arm.nodes", str(folder / "day.npz"), "--bus", bus),
                *("--joints", on_bus, "--begin-ns", str(begin_ns)),
            ],
            stderr=subprocess.PIPE,
            text=True,
        )
    )
    stack.callback(nodes.terminate)
    assert nodes.stderr is not None
    assert "ready" in nodes.stderr.readline()
    jtqd = stack.enter_context(
        subprocess.Popen(
            [
                *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", bus, "--json"),
                *("--config", str(folder / f"bus_{number}.yaml"), "--record", str(folder / f"log_{number}")),
                *("--duration", str((begin_ns - time.monotonic_ns()) * 1e-9 + SECONDS - 0.5)),
            ],
            env={**os.environ, "RUNTIME_DIRECTORY": str(folder / "run")},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    )
    stack.callback(jtqd.terminate)
    return jtqd


def checked(log: list[Path], node: int, joint: int, arm: Arm, readings: Readings) -> float:
    """Return when the day began by the log of a joint [ns]; its estimates are those of the readings without a bus."""
    state = read_topic(log, f"/joint/{node}/state")
    stamp = state["header"]["stamp"]["sec"].astype(np.int64) * 10**9 + state["header"]["stamp"]["nanosec"]
    motor = readings.motor_rad[:, joint - 1]
    row = np.array([int(np.argmin(np.abs(motor - x))) for x in state["motor_position_rad"]])
    during = np.flatnonzero((row > 1200) & (row < 1700))
    assert len(during) > 300
    told = state["torque_nm"][during]
    good = np.isin(state["status"][during], list(PUBLISHED))
    assert good.mean() > 0.9
    off = (told - readings.torque_nm[row[during], joint - 1])[good] / arm.rated_nm[joint - 1]
    assert np.sqrt(np.mean(off * off)) < 0.02
    return float(np.median(stamp[during] - row[during] * 1e6))
