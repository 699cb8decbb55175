"""jtqd with drives and a sensor of the `canopen` library: strict nodes that share no code with it (tests/library_drives)."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.daemon.cli import init, probe
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.models.files import shipped
from tests.library_drives.bench import LibraryBench
from tests.library_drives.families import PULSES, RATED_MA
from tests.library_drives.nodes import GEAR, LINK_COUNTS, TORQUE_CONSTANT


@contextmanager
def a_bench(*manners: str, bus: str | None = None) -> Iterator[LibraryBench]:
    with (
        tempfile.TemporaryDirectory(prefix="jtq") as directory,
        LibraryBench(Path(directory), *manners, bus=bus) as bench,
    ):
        yield bench


@pytest.fixture(scope="module")
def running() -> Iterator[LibraryBench]:
    """A bench with a jtqd that serves several tests, each of which leaves all nodes in use."""
    with a_bench() as bench, bench.served():
        yield bench


@pytest.fixture
def bench(running: LibraryBench) -> LibraryBench:
    running.forget_frames()
    running.expect(running.both_used)
    return running


def no_errors(bench: LibraryBench) -> bool:
    return not any(node["errors"] for node in bench.order("state").values())


def agree(pairs: list[tuple[float, float]], within_nm: float) -> None:
    """Two joints with the same motion and joint file have the same torque; at a reversal one rpm is another quadrant."""
    assert len(pairs) > 250
    assert max(abs(one) for one, _ in pairs) > 2.0
    apart = sorted(abs(one - two) for one, two in pairs)
    assert apart[round(0.8 * len(apart))] < within_nm


def test_first_start_and_restart_after_a_clean_stop_and_after_a_kill() -> None:
    """The drives watch jtqd's heartbeat: 8130h, once it has ended, and no start before that is over."""
    with a_bench() as bench:
        with bench.served():
            assert no_errors(bench), bench.order("state")
        bench.expect(lambda: not no_errors(bench), 3.0)
        bench.expect(lambda: set(bench.emergencies(1)) == {0x8130})
        second = bench.start()
        bench.expect(bench.both_used)
        assert no_errors(bench)
        bench.stop(second, signal.SIGKILL)
        with bench.served():  # within the 0.5 s in which the drives still wait for the second one
            assert no_errors(bench)


def test_a_second_jtqd_is_refused_and_the_first_goes_on(bench: LibraryBench) -> None:
    second = bench.start()
    assert second.wait(20) == 1
    assert "another SYNC producer is on the bus" in bench.log_text()
    assert not [data for can_id, data in bench.heard if can_id == 0x000], "it touches no node"
    bench.logs.append(bench.logs[0])  # the first one's is the last again
    bench.expect(bench.both_used)


@pytest.mark.parametrize("node", [1, pytest.param(2, marks=pytest.mark.campaign), 3])
def test_power_cycle_of_a_node_in_service(bench: LibraryBench, node: int) -> None:
    """It comes back with 1019h = 0, nothing mapped and no heartbeat, and is used again."""
    bench.order(f"off {node}")
    if node < 3:
        bench.expect(lambda: bench.joint_stale(node - 1))
    time.sleep(0.5)
    bench.forget_frames()
    bench.order(f"on {node}")
    bench.expect(f"node {node} returned and is configured again")
    bench.expect(bench.both_used)
    bench.expect(lambda: bench.order("state")[str(node)]["state"] == 5)
    assert bench.emergencies(node) == []


def test_bus_off_of_one_node(bench: LibraryBench) -> None:
    """It neither hears nor is heard for a second: its master's heartbeat is missing, and it waits in pre-operational."""
    bench.order("cut 1")
    bench.expect(lambda: bench.joint_stale(0))
    bench.expect(lambda: 0x8130 in bench.order("state")["1"]["errors"])
    bench.forget_frames()
    bench.order("join 1")
    bench.expect(bench.both_used)
    bench.expect(lambda: no_errors(bench))


def test_emcy_with_and_without_heartbeat(bench: LibraryBench) -> None:
    bench.order("emcy 1 2310")
    bench.expect("node 1: EMCY 2310h (continuous overcurrent)")
    bench.order("well 1 2310")
    bench.expect("node 1: EMCY 0000h: error reset")
    bench.order("mute 2")
    bench.expect("node 2: no heartbeat for 0.3 s")
    bench.order("emcy 2 4310")
    bench.expect("node 2: EMCY 4310h (excess temperature of the drive)")
    bench.forget_frames()
    bench.expect(bench.both_used)  # its PDOs come in time and are used


@pytest.mark.parametrize(
    "manners",
    [
        ("--boot-ups", "2", "--without", "1016,1029,1014,1019,1008"),
        pytest.param(("--boot-ups", "2"), marks=pytest.mark.campaign),
        pytest.param(("--without", "1016,1029,1014"), marks=pytest.mark.campaign),
        pytest.param(("--without", "1019,1008"), marks=pytest.mark.campaign),
        pytest.param(("--sdo", "0.06", "--boot-ups", "2"), marks=pytest.mark.campaign),
    ],
    ids=["all at once", "boot-up twice", "no 1016h 1029h 1014h", "no 1019h 1008h", "slow, boot-up twice"],
)
def test_devices_differ(manners: tuple[str, ...]) -> None:
    with a_bench(*manners) as bench, bench.served(longest_s=40.0):
        if "1016" in manners[-1]:
            assert "1016h:1 consumer heartbeat time: no such object" in bench.log_text()


@pytest.mark.parametrize("fixed", ["mapping", "valid"])
def test_a_fixed_mapping_is_used_as_it_is(fixed: str) -> None:
    """Quantities in three of four TPDOs, one of them on another COB-ID: read from the drive, also after its power cycle."""
    with a_bench("--fixed", fixed) as bench:
        booted = items(bench, "0.5", "--drive-sync") if fixed == "mapping" else {}
        with bench.served():
            found = "its mapping is used as it is: TPDO1 (181h), TPDO2 (381h), TPDO4 (481h)"
            assert found in bench.log_text()
            bench.expect(bench.moves)
            if booted:  # `jtq check` knows it by its own boot, and beside jtqd
                assert "node 1: its mapping is used as it is: TPDO1 (181h)" in booted["boot"]
                beside = items(bench, "0.5", RUNTIME_DIRECTORY=str(bench.runs[-1]))
                for each in (booted, beside):
                    assert "481h drive 1 TPDO4" in each
                    assert "281h drive 1 TPDO2" not in each
                    assert all("wrong length" not in text for text in each.values())
            bench.order("off 1")
            bench.expect(lambda: bench.joint_stale(0))
            bench.forget_frames()
            bench.order("on 1")
            bench.expect(bench.both_used)


def items(bench: LibraryBench, *arguments: str, **environment: str) -> dict[str, str]:
    """Results of `jtq check` with a configuration that does not name the mapping."""
    command = [sys.executable, "-m", "jtqd.daemon.jtq", "check", *arguments, "--bus", bench.bus, "--json"]
    command += ["--config", bench.configuration()]
    run = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )
    return {each["item"]: each["text"] for each in json.loads(run.stdout)["items"]}


def test_what_init_writes_for_drives_that_have_fewer_objects_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No 60E4h, 606Ch, 6078h: `jtq probe` and `jtq init` report it, and jtqd runs with the files as they are."""
    with a_bench("--without", "60E4,60E6,60EB,606C,6090,6078,6075") as bench:
        assert probe.main(["--bus", bench.bus, "--node", "1"]) == 0
        reported = capsys.readouterr().out
        for line in ("link_position: false", "motor_velocity: false", "current: {index: 0x6077}"):
            assert line in reported
        known = ["--rated-torque", "30", "--torque-constant", str(TORQUE_CONSTANT)]
        assert init.main(["--bus", bench.bus, "--out", str(tmp_path), *known]) == 0
        assert "joint 2: objects.link_position: false (no 60E4h:1, by the bus)" in capsys.readouterr().out
        path = tmp_path / "jtqd.yaml"
        content = yaml.safe_load(path.read_text()) | {"sync": {"period_us": 10_000}}
        path.write_text(yaml.safe_dump(content))
        with bench.served(path):
            bench.expect(bench.moves)


def test_a_drive_that_sends_by_itself_needs_an_age_and_is_used_by_its_stamps() -> None:
    """Type 255 for good, inhibit time 10 ms, event timer 30 ms; one TPDO changes always, one (1001h) never."""
    with a_bench("--fixed", "event") as bench:
        refused = bench.start()
        assert refused.wait(20) == 1
        assert "TPDO1 has transmission type 255: joint_N.max_age_ms allows it" in bench.log_text()
        with bench.served(**{f"joint_{n}": {"max_age_ms": 100} for n in (1, 2)}):
            assert "TPDO1 keeps transmission type 255" in bench.log_text()
            bench.expect(bench.moves)
            changing, constant = frames_in_a_second(bench.bus, 0x181, 0x281)
            assert 40 < changing < 110, "at most one in 10 ms"
            assert 10 < constant < 40, "by its timer alone"


def frames_in_a_second(bus: str, *can_ids: int) -> list[int]:
    socket = open_frame_socket(bus, [exact(can_id) for can_id in can_ids])
    counts, until = dict.fromkeys(can_ids, 0), time.monotonic() + 1.0
    while time.monotonic() < until:
        socket.wait(0.05)
        for n in range(socket.receive()):
            counts[int.from_bytes(socket.frames[16 * n : 16 * n + 4], "little")] += 1
    socket.close()
    return list(counts.values())


@pytest.mark.native
@pytest.mark.measures
def test_objects_of_the_makers_own() -> None:
    """Joint 1 by its drive's mA, counted backwards, and rpm; joint 2, with the same motion, by CiA 402."""
    objects = {
        "current": {"index": 0x2030, "sign": -1, "factor": 0.001},
        "motor_velocity": {"index": 0x2031, "type": "I16", "factor": 2.0 * math.pi / 60.0},
    }
    joint_2 = {"file": str(shipped("joint1.yaml"))}
    with a_bench() as bench, bench.served(joint_1={"objects": objects}, joint_2=joint_2):
        bench.expect(lambda: len(bench.pairs()) > 300)
        agree(bench.pairs(), 0.3)


@pytest.mark.native
@pytest.mark.measures
def test_one_encoder_no_velocity_and_torque_instead_of_current() -> None:
    """Drives that have none of 60E4h, 606Ch and their scaling; joint 1 by 6077h, counted backwards, joint 2 by 6078h."""
    less = {"link_position": False, "motor_velocity": False}
    joint_1 = {"objects": {**less, "current": {"index": 0x6077, "sign": -1}}}
    joint_2 = {"objects": less, "file": str(shipped("joint1.yaml"))}
    with a_bench("--without", "60E4,60E6,60EB,606C,6090") as bench:
        with bench.served(joint_1=joint_1, joint_2=joint_2):
            bench.expect(lambda: len(bench.pairs()) > 300)
        agree(bench.pairs(), 0.3)


ONE_TO_ONE = {"6091h:1": GEAR, "6091h:2": 1}
LINK = {"link_position": {"factor": 2.0 * math.pi / LINK_COUNTS}}
CURRENT = {"current": {"factor": 1e-6 * RATED_MA}}


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("family", "objects", "given"),
    [
        ("epos4", {"motor_position": {"factor": math.pi / (2 * PULSES)}, **LINK, **CURRENT}, ONE_TO_ONE),
        ("elmo_gold", LINK, {"608Fh:1": 4 * PULSES, "6090h:1": 4 * PULSES, **ONE_TO_ONE}),
        ("nanotec", CURRENT, ONE_TO_ONE),
    ],
)
def test_a_drive_of_a_family_beside_one_of_cia_402(
    family: str, objects: dict[str, Any], given: dict[str, int]
) -> None:
    """Joint 1 by its profile, joint 2, with the same motion and joint file, by CiA 402: the torques agree."""
    joint_1 = {"profile": family, "objects": objects, "given": given}
    joint_2 = {"file": str(shipped("joint1.yaml"))}
    with a_bench("--family", family) as bench, bench.served(joint_1=joint_1, joint_2=joint_2):
        bench.expect(lambda: len(bench.torques_nm) > 500)
        agree(bench.pairs(), 0.5)


@pytest.mark.campaign
def test_answers_of_half_a_second() -> None:
    slow = {"sdo_timeout_ms": 800}
    with a_bench("--sdo", "0.5") as bench, bench.served(longest_s=150.0, sensor=slow, nodes=slow):
        pass


@pytest.mark.socketcan
def test_first_start_restart_and_power_cycle_on_socketcan() -> None:
    with a_bench(bus=os.environ.get("JTQD_CAN_INTERFACE", "vcan0")) as bench:
        first = bench.start()
        bench.expect(bench.both_used)
        bench.stop(first, signal.SIGKILL)
        with bench.served():
            bench.order("off 1")
            bench.expect(lambda: bench.joint_stale(0))
            bench.order("on 1")
            bench.expect(bench.both_used)
