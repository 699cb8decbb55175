"""The publisher's process: what a DDS reader of its own, with types from the .msg files, gets of a running loop."""

import json
import math
import os
import platform
import re
import signal
import sys
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from jtqd.daemon import jtqd
from jtqd.daemon.config import Ros2Settings, load_config
from jtqd.daemon.ros2 import Ros2Publisher
from tests.daemon.live.live_view_helpers import Kept, Memory
from tests.daemon.ros2.publisher_helpers import Process, Publisher, Reader, own_domain, request_of
from tests.paths import ROOT

pytestmark = pytest.mark.native


@pytest.fixture
def memory(tmp_path):
    return Memory(tmp_path)


def test_a_reader_with_types_from_the_msg_files_gets_all_three_topics(memory):
    """Types that do not fit those of the reader would not be connected by Cyclone DDS at all."""
    with Reader() as reader, Publisher(memory.directory) as publisher:
        where = f"domain {own_domain()}, interface lo"
        topics = "/joint_states, /joint_torque_states, /diagnostics"
        assert publisher.answer == {"publishing": f"{topics} at 100 Hz, {where}"}
        memory.feed(1500, statuses=lambda index: (15 if index % 2 else 2, 2))
        states, torques = reader.wait_for("joint_states", 50), reader.wait_for("joint_torque_states", 50)
        assert states[-1]["name"] == torques[-1]["name"] == ["shoulder", "elbow"]
        for state in states:
            stamp = state["header"]["stamp"]
            cycle = (stamp["sec"] % 1000) * 1000 + stamp["nanosec"] // 1_000_000
            assert state["position"] == [1000.0 + cycle + 3 / 16, 2000.0 + cycle + 3 / 16]
            assert state["velocity"] == [(1000.0 + cycle + 2 / 16) / 100.0, (2000.0 + cycle + 2 / 16) / 160.0]
            assert math.isnan(state["effort"][0]) == bool(cycle % 2)
            assert state["effort"][1] == 2000.0 + cycle + 6 / 16
        for state in torques:
            assert state["status"] == [15 if state["cycle"] % 2 else 2, 2]
            assert math.isnan(state["torque"][0]) == bool(state["cycle"] % 2)
            assert state["sync_counter"] == state["cycle"] % 240 + 1
        assert len({state["cycle"] for state in torques}) == len(torques)
        for before, state in pairwise(torques):
            cycles = range(before["cycle"] + 1, state["cycle"] + 1)
            if len(cycles) < 15:  # none of the messages between was lost
                assert state["withheld"] == [sum(cycle % 2 for cycle in cycles), 0]
        (status, *_) = reader.wait_for("diagnostics")
        assert [each["name"] for each in status["status"]] == [
            "jtqd vcan7: loop",
            "jtqd vcan7: bus",
            "jtqd vcan7: joint 1",
            "jtqd vcan7: joint 2",
            "jtqd vcan7: node 1",
        ]
        assert {"faults", "latched", "age_s"} <= {each["key"] for each in status["status"][2]["values"]}
        assert status["status"][2]["hardware_id"] == "shoulder"
        writers = reader.writers()
    assert {name: each["type"] for name, each in writers.items()} == {
        "rt/joint_states": "sensor_msgs::msg::dds_::JointState_",
        "rt/joint_torque_states": "jtqd_msgs::msg::dds_::JointTorqueState_",
        "rt/diagnostics": "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    }
    for each in writers.values():
        shown = " ".join(each["qos"])
        assert "Policy.Reliability.Reliable" in shown
        assert "Policy.Durability.Volatile" in shown
        assert "use_cdrv0_representation=True, use_xcdrv2_representation=False" in shown
        assert re.fullmatch(r"typehash=RIHS01_[0-9a-f]{64};", each["data"])


@pytest.mark.parametrize(
    "discovery",
    [
        "SUBNET",
        pytest.param("LOCALHOST", marks=pytest.mark.campaign),
        pytest.param("ROS_LOCALHOST_ONLY", marks=pytest.mark.campaign),
    ],
)
def test_nodes_of_this_machine_find_it_in_any_order(memory, discovery):
    with Reader(None, discovery) as first, Publisher(memory.directory), Reader(None, discovery) as second:
        memory.feeding(10_000)
        first.wait_for("joint_states")
        second.wait_for("joint_states")


@pytest.mark.measures
def test_100_messages_a_second_while_the_loop_runs_and_no_old_torque_when_it_stands_still(memory):
    with Reader() as reader, Publisher(memory.directory):
        thread = memory.feeding(3000)
        reader.wait_for("joint_states", 10)
        before = len(reader.messages("joint_states"))
        reader.watch(1.0)
        assert (
            50 <= len(reader.messages("joint_states")) - before <= 105
        )  # turns may be late; none is made up
        thread.join()
        reader.watch(0.4)
        states, torques = len(reader.messages("joint_states")), reader.messages("joint_torque_states")
        assert torques[-1]["status"] == [4, 4]
        assert all(math.isnan(value) for value in torques[-1]["torque"] + torques[-1]["sigma"])
        reader.watch(0.4)
        later = reader.messages("joint_torque_states")
        assert len(reader.messages("joint_states")) == states
        assert later[-1]["age"] > torques[-1]["age"] + 0.2
        assert later[-1]["cycle"] == torques[-1]["cycle"]
        memory.feeding(2000)
        reader.until(lambda: reader.messages("joint_torque_states")[-1]["status"] == [2, 2])


@pytest.mark.measures
def test_a_reader_that_is_stopped_holds_up_nobody(memory):
    with Reader() as stopped, Reader() as reader, Publisher(memory.directory):
        memory.feeding(5000)
        stopped.wait_for("joint_states")
        reader.wait_for("joint_states")
        stopped.process.send_signal(signal.SIGSTOP)
        before = len(reader.messages("joint_states"))
        reader.watch(1.0)
        stopped.process.send_signal(signal.SIGCONT)
        assert len(reader.messages("joint_states")) - before > 50


def test_it_maps_the_loops_memory_read_only_and_needs_no_library_of_the_loop(memory):
    with Publisher(memory.directory) as publisher:
        maps = open(f"/proc/{publisher.process.pid}/maps").read().splitlines()  # noqa: SIM115
        for name in ("ring", "snapshot"):
            (mapped,) = (line for line in maps if line.endswith(str(memory.directory / name)))
            assert mapped.split()[1] == "r--s"
        assert not any("onnxruntime" in line for line in maps)


def test_what_is_sent_leaves_by_the_loopback_alone(memory):
    """Other programs' settings do not open another interface, and the socket that sends is bound to 127.0.0.1."""
    opened = (
        '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface autodetermine="true"/>'
        "</Interfaces></General></Domain></CycloneDDS>"
    )
    with Publisher(memory.directory, environment={"CYCLONEDDS_URI": opened}) as publisher:
        descriptors = f"/proc/{publisher.process.pid}/fd"
        inodes = {os.readlink(f"{descriptors}/{fd}") for fd in os.listdir(descriptors)}
        rows = [line.split() for line in open("/proc/net/udp").read().splitlines()[1:]]  # noqa: SIM115
        bound = [row[1].split(":") for row in rows if f"socket:[{row[9]}]" in inodes]
    base = 7400 + 250 * own_domain()
    known = range(
        base, base + 250
    )  # DDS's ports for receiving; the sender's, given by the kernel, may lie among them
    senders = {at for at, port in bound if at == "0100007F" or int(port, 16) not in known}
    assert senders == {"0100007F"}
    assert len(bound) > 1


FORBIDDEN = (
    "import socket, sys\n"
    "def refused(*_): raise OSError(97, 'Address family not supported by protocol')\n"
    "socket.if_nameindex = refused\n"
    "from jtqd.daemon.ros2.process import begin\n"
    "from jtqd.daemon.shared.processes import run_side_process\n"
    "sys.exit(run_side_process([sys.argv[1]], 'publishing', begin))"
)
"""As a unit that forbids network sockets."""


@pytest.mark.parametrize(
    ("program", "changes", "failed"),
    [
        (
            ("-m", "jtqd.daemon.ros2.process"),
            {"interface": "eth77"},
            "eth77: there is no such network interface",
        ),
        (("-m", "jtqd.daemon.ros2.process"), {"ring": "/none"}, "/none"),
        (("-c", FORBIDDEN), {}, "no network sockets: Address family not supported by protocol"),
    ],
)
def test_one_that_cannot_begin_answers_why(memory, program, changes, failed):
    with Process(*program, _request(memory, **changes)) as publisher:
        assert failed in publisher.first()["failed"]
        assert publisher.process.wait(5) == 1


def _request(memory, **changes):
    return json.dumps(request_of(memory.directory, **changes))


# ---- the supervisor's side ----


def publisher(directory, capfd, **settings):
    settings = Ros2Settings(domain_id=own_domain(), **settings)
    return Kept(directory, capfd, lambda child: Ros2Publisher(child, settings))


@pytest.fixture
def kept(tmp_path, capfd):
    made = publisher(tmp_path, capfd)
    yield made
    made.end()


def test_one_that_is_killed_is_reported_and_started_again(kept):
    kept.until(r"jtqd: ROS 2 publisher: /joint_states, .* at 100 Hz, domain \d+, interface lo\n")
    kept.kill()
    kept.until("jtqd: the ROS 2 publisher ended with exit status -9; restarted, the loop continues\n")
    kept.until("jtqd: ROS 2 publisher: /joint_states")


def test_one_that_cannot_begin_is_reported_once_and_an_interface_that_others_reach(tmp_path, capfd):
    made = publisher(tmp_path, capfd, interface="eth77")
    made.until("jtqd: ROS 2: torques, positions and diagnostics go to every host that is reached by eth77\n")
    made.until("no ROS 2 publisher: domain .*eth77: there is no such network interface; the loop continues\n")
    made.keeper.watch()
    assert len(made.children) == 1
    made.end()


def test_without_the_package_the_daemon_refuses_in_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    assert jtqd.main(["--bus", "sim", "--record", "none", "--ros2"]) == 1
    shown = capsys.readouterr()
    assert shown.err == "jtqd: --ros2 needs the package cyclonedds: pip install 'jtqd[ros2]'\n"
    shipped = load_config(None)
    path = tmp_path / "arm.yaml"
    text = re.sub(r"file: (\S+)", lambda found: f"file: {shipped.path.parent / found[1]}", shipped.text)
    path.write_text(text + "\nros2: {}\n")
    assert jtqd.main(["--bus", "sim", "--record", "none", "--config", str(path)]) == 1
    key = f"jtqd: {path}: key 'ros2': needs the package cyclonedds: pip install 'jtqd[ros2]'\n"
    assert capsys.readouterr().err == key


def test_a_domain_that_is_none_is_refused_with_status_2(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert jtqd.main(["--bus", "sim", "--record", "none", "--ros2"]) == 2
    assert "jtqd: ROS_DOMAIN_ID: found 'many'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def publisher_of(directory):
    """Process-ID of the publisher that reads this directory."""
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):  # it has just ended
            line = Path(f"/proc/{entry}/cmdline").read_bytes()
            if b"jtqd.daemon.ros2.process" in line and str(directory).encode() in line:
                return int(entry)
    raise AssertionError("there is no publisher")


def test_a_whole_daemon(tmp_path):
    """The emulated bench: torques arrive, the publisher is killed and comes back, the loop misses nothing for it."""
    environment = {
        "XDG_RUNTIME_DIR": str(tmp_path),
        "PYTHONPATH": str(ROOT),
        "ROS_DOMAIN_ID": str(own_domain()),
    }
    arguments = ["--bus", "sim", "--record", "none", "--ros2", "--duration", "6", "--json"]
    with Reader() as reader, Process("-m", "jtqd.daemon.jtqd", *arguments, environment=environment) as daemon:
        states = reader.wait_for("joint_torque_states", 20, timeout_s=60)
        assert states[-1]["name"] == ["joint_1", "joint_2"]
        assert all(0.0 < state["age"] < 0.1 for state in states[10:])
        pid = publisher_of(tmp_path)
        os.kill(pid, signal.SIGKILL)
        count = len(reader.messages("joint_torque_states"))
        reader.wait_for("joint_torque_states", count + 5)
        daemon.until(lambda: daemon.lines, 60)
        assert daemon.process.wait(30) == 0
    assert "the ROS 2 publisher ended with exit status -9; restarted, the loop continues" in daemon.errors
    summary = daemon.lines[-1]
    assert summary["cycles"] + summary["missed"] >= 5900
    states = reader.messages("joint_torque_states")
    assert any(not math.isnan(state["torque"][0]) for state in states)
