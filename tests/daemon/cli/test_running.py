"""Running daemons: their description, how they are found, who may look, and why a status is what it is."""

import json
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from jtqd.daemon.cli.running import find_daemons, on_bus
from jtqd.daemon.config import load_config
from jtqd.daemon.live.reading import Watch
from jtqd.daemon.shared.events import Notices
from jtqd.daemon.shared.faults import DRIVE_FAULT
from jtqd.daemon.shared.reasons import drive_state, joint_reason, silent_s
from jtqd.daemon.shared.runtime_dir import About, AboutError, read_about, start_ticks, write_about
from jtqd.daemon.shared.snapshot import JointView
from jtqd.daemon.supervisor.process import about
from jtqd.estimator import status as st
from jtqd.estimator.status import LINK_JUMP, MOTOR_JUMP
from tests.daemon.cli.status_daemon import described, running
from tests.daemon.supervisor.watch_views import NAN, WELL, view


def test_the_description_comes_back_as_it_was_written(tmp_path: Path) -> None:
    content = described("vcan0", tmp_path)
    write_about(tmp_path, content)
    assert read_about(tmp_path / "about.json") == content
    assert (tmp_path / "about.json").stat().st_mode & 0o777 == 0o640
    assert content.running()
    assert content.joints[0].inputs == ("181h drive 1 TPDO1", "281h drive 1 TPDO2")
    assert content.joints[1].sensor == "183h sensor 3 channel 1"
    assert content.nodes == {1: "drive of joint 1", 2: "drive of joint 2", 3: "torque sensor"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"schema": "jtqd.about/9"}', '{"schema": "jtqd.about/1", "joints": 1}']
)
def test_other_descriptions_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "about.json").write_text(text)
    with pytest.raises(AboutError):
        read_about(tmp_path / "about.json")
    with pytest.raises(AboutError):
        read_about(tmp_path / "none")


def test_the_start_of_a_process_tells_it_from_another_with_its_number() -> None:
    ticks = start_ticks(os.getpid())
    assert ticks is not None
    process = subprocess.Popen(["sleep", "5"])
    later = start_ticks(process.pid)
    assert later is not None
    assert later >= ticks
    process.kill()
    time.sleep(0.1)
    assert start_ticks(process.pid) is None, "a zombie runs no more"
    process.wait()


def test_a_bus_is_found_by_its_name_or_its_instance(tmp_path: Path) -> None:
    directory = tmp_path / "jtqd-0-sim"
    directory.mkdir()
    write_about(
        directory, about(load_config(None), bus="unix:/run/x/bus", instance="sim", log_directory=None)
    )
    found = find_daemons([tmp_path, tmp_path / "none"])
    assert on_bus(found, "sim") == on_bus(found, "unix:/run/x/bus") == found.daemons[0]
    assert on_bus(found, "can0") is None
    content = json.loads((directory / "about.json").read_text())
    for change in (
        {"started_ticks": content["started_ticks"] + 1},
        {"pid": 2**22 + 1},
    ):  # another process has its number
        (directory / "about.json").write_text(json.dumps(content | change))
        found = find_daemons([tmp_path])
        assert (found.daemons, found.closed, found.abandoned) == ((), (), (directory,))


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user, which only root can")
@pytest.mark.parametrize(
    ("groups", "seen"), [([0], (1, 0, True)), ([], (0, 1, False))], ids=["member", "stranger"]
)
def test_the_group_may_look_and_nobody_else(
    groups: list[int], seen: tuple[int, int, bool], tmp_path: Path
) -> None:
    """In the directory that jtqd claims itself, as a user who is, or is not, in the group of the daemon (root's)."""
    root = Path(tempfile.mkdtemp(dir="/dev/shm"))
    try:
        root.chmod(0o755)
        daemon = running(root)
        daemon.directory.chmod(0o750)  # as tests/daemon/shared/test_runtime_dir.py holds it
        Notices(daemon.directory / "notices")
        readable, writable = os.pipe()
        child = os.fork()
        if not child:
            try:
                os.setgroups(groups)
                os.setgid(65534)
                os.setuid(65534)
                found = find_daemons([root])
                looked = [Watch(each).read().state == "running" for each in found.daemons]
                with suppress(OSError):
                    os.open(daemon.directory / "snapshot", os.O_RDWR)
                    looked = [False]
                os.write(
                    writable, json.dumps([len(found.daemons), len(found.closed), looked == [True]]).encode()
                )
            finally:
                os._exit(0)
        os.close(writable)
        with os.fdopen(readable) as file:
            assert tuple(json.load(file)) == seen
        os.waitpid(child, 0)
    finally:
        shutil.rmtree(root)


# Why a status is what it is --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench() -> About:
    return about(load_config(None), bus="vcan0", instance="vcan0", log_directory=None)


def why(bench: About, one: JointView, **more: int) -> str:
    now = view(1000, one, **more)
    return joint_reason(bench, 1, now, view(900))


def test_a_good_estimate_needs_no_reason(bench: About) -> None:
    assert why(bench, WELL) == ""


def test_stale_names_the_pdo_the_node_or_the_bus(bench: About) -> None:
    stale = WELL._replace(status=st.STALE, torque_nm=NAN, input_flags=1)
    assert why(bench, stale) == "281h drive 1 TPDO2 not received in time"
    assert why(bench, stale._replace(input_flags=2)) == "181h drive 1 TPDO1 not received in time"
    assert why(bench, stale, bus_errors=3) == "the bus is down"
    assert why(bench, stale, foreign_sync=3) == "another SYNC producer is on the bus"
    assert why(bench, stale._replace(input_flags=3)).startswith("the inputs are back; waiting for")
    assert (
        why(bench, stale._replace(input_flags=3), overruns=1)
        == "the estimate is not ready before the next SYNC"
    )
    heard = tuple(1_000_000_000 if node == 1 else 0 for node in range(128))
    silent = view(1000, stale)._replace(sync_realtime_ns=3_500_000_000, node_heard_ns=heard)
    assert joint_reason(bench, 1, silent, view(900)) == "node 1 is silent: no heartbeat for 2.5 s"
    assert silent_s(silent._replace(sync_realtime_ns=1_200_000_000), 1, 100) is None
    assert silent_s(silent, 2, 100) is None, "one that has never been heard is not silent"
    unready = view(1000, stale, unconfigured=(1,))
    assert joint_reason(bench, 1, unready, view(900)) == "node 1 has a changed configuration"
    restarted = view(1000, stale, unconfigured=(1,), states={1: 127})
    assert joint_reason(bench, 1, restarted, view(900)).startswith("node 1 has restarted")
    assert (
        joint_reason(bench, 1, view(1000, stale, states={1: 127}), view(900)) == "node 1 is pre-operational"
    )


def test_drive_states(bench: About) -> None:
    assert why(bench, WELL._replace(status=st.OFF, statusword=0x0250)).startswith(
        "drive 1: switch on disabled (6041h 0250h)"
    )
    assert why(bench, WELL._replace(status=st.DRIVE_FAULT, statusword=0x18)) == "drive 1: fault (6041h 0018h)"
    back = why(bench, WELL._replace(status=st.DRIVE_FAULT, statusword=0x27))
    assert back.startswith("drive 1: operation enabled (6041h 0027h); waiting for")
    assert drive_state(0x1637) == "operation enabled"
    assert drive_state(0x0031) == "ready to switch on"
    assert drive_state(0x0023) == "switched on, not enabled"
    assert drive_state(0x0007) == "quick stop active"
    assert drive_state(0x000F) == "fault reaction active"


def test_degraded_and_invalid(bench: About) -> None:
    far = 1.01 * bench.joints[0].network_limit_nm
    degraded = WELL._replace(status=st.DEGRADED, physics_nm=10.0, network_nm=10.5)
    alone = bench
    bench = replace(bench, joints=(replace(bench.joints[0], network="joint1.fused.onnx"), *bench.joints[1:]))
    assert why(bench, degraded).startswith("outside the network's training range")
    assert "Nm from physics, limit" in why(bench, degraded._replace(network_nm=10.0 - far))
    assert "not finite" in why(bench, degraded._replace(network_nm=NAN))
    assert "no time for the network" in why(bench, degraded._replace(input_flags=0x1F))
    assert why(alone, degraded._replace(network_nm=NAN)).startswith(
        "outside of what the joint file was fitted to"
    )
    invalid = WELL._replace(status=st.INVALID, torque_nm=NAN)
    found = why(bench, invalid._replace(input_flags=7 | (MOTOR_JUMP | LINK_JUMP) << 8))
    assert found == "the motor position jumped, the link position jumped"
    assert why(bench, invalid).startswith("fault cleared; waiting for")
    latched = why(bench, invalid._replace(latched=DRIVE_FAULT))
    assert latched == "latched: the drive was in fault; `jtq control reset` releases it"


def test_starting_and_standstill(bench: About) -> None:
    starting = WELL._replace(status=st.STARTING)
    assert joint_reason(bench, 1, view(8, starting), view(0)) == "first cycles after the start"
    assert joint_reason(bench, 1, view(800, starting), view(0)).startswith("the observer restarts")
    assert "sigma is half of it" in why(bench, WELL._replace(status=st.STANDSTILL))
