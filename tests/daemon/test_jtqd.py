"""The daemon from the outside: run as users run it, on the emulated bench over the unix frame socket."""

import json
import os
import resource
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import canopen
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.logs import read_topic
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_NETWORK_SKIPPED, FLAG_POSITION
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.daemon.supervisor.process import wait_for
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.can_unix import UnixBus
from jtqd.drivers.frame import pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.estimator.status import PUBLISHED, STALE
from jtqd.models.files import shipped
from tests.daemon.slow_bench import slow_configuration
from tests.drivers.hub_helpers import until_it_listens
from tests.estimator.fused_configuration import configured, networks
from tests.paths import JTQD_EDS
from tests.shipped_bench import shipped_bench

pytestmark = pytest.mark.native

JTQD = [sys.executable, "-m", "jtqd.daemon.jtqd"]
Daemon = tuple[str, "subprocess.Popen[str]", dict[str, str]]
"""Address of its bus, process, environment."""
INPUTS = FLAG_POSITION | FLAG_MOTION
PERIOD_US = 5_000
"""Of the cycle, where it is not the loop that is tried."""


def runtime(directory: Path) -> dict[str, str]:
    """A runtime directory of its own, so that runs of other people do not meet ours."""
    (directory / "run").mkdir()
    return {**os.environ, "RUNTIME_DIRECTORY": str(directory / "run"), "LOGS_DIRECTORY": ""}


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    return runtime(tmp_path)


def run(
    *arguments: str, environment: dict[str, str], timeout: float = 60
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*JTQD, *arguments], env=environment, capture_output=True, text=True, timeout=timeout, check=False
    )


def started(
    *arguments: str,
    environment: dict[str, str],
    own_group: bool = False,
    limit: Callable[[], None] | None = None,
) -> subprocess.Popen[str]:
    """jtqd, running, without a log unless the arguments name one; both outputs are pipes."""
    return subprocess.Popen(
        [*JTQD, "--record", "none", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=own_group,
        preexec_fn=limit,  # noqa: PLW1509 - no threads here
    )


def until(true: Callable[[], object], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def until_it_publishes(process: subprocess.Popen[str], environment: dict[str, str], count: int = 100) -> None:
    """Wait until the loop has counted cycles in its shared memory."""

    def published() -> bool:
        assert process.poll() is None, "it ended before"
        paths = Path(environment["RUNTIME_DIRECTORY"]).glob("*/snapshot")
        return any(SnapshotReader(path).read().counters["published"] > count for path in paths)

    until(published)


def no_traceback(result: subprocess.CompletedProcess[str]) -> str:
    assert "Traceback" not in result.stderr, result.stderr
    return result.stderr.strip()


def temperatures(log: Path, number: int) -> tuple[list[float], list[float]]:
    """Of one joint: what each cycle had, and what its drive sent, frame by frame [degC]."""
    state = read_topic(log, f"/joint/{number}/state")
    assert ((state["input_flags"] & 8 != 0) == np.isfinite(state["temperature_c"])).all()
    frames = read_topic(log, "/can/frames")["frames"]
    data = frames["data"][frames["id"] == 0x380 + number]
    sent = [0.1 * struct.unpack_from("<h", bytes(each))[0] for each in data]
    return state["temperature_c"].tolist(), sent


def test_a_run_on_the_emulated_bench(tmp_path: Path, environment: dict[str, str]) -> None:
    options = ["--bus", "sim", "--duration", "2", "--record", str(tmp_path / "logs"), "--json"]
    result = run(*options, environment=environment)
    assert result.returncode == 0, result.stderr
    no_traceback(result)
    reported = [line for line in result.stderr.splitlines() if "physics only" in line]
    assert [line.partition("joint ")[2].partition(" (")[0] for line in reported] == [
        f"{number}: no network, physics only" for number in (1, 2)
    ]
    summary = json.loads(result.stdout)
    slots = summary["cycles"] + summary["missed"] + summary["counters"]["sync_gaps"]
    assert slots == pytest.approx(2000, abs=2)
    recording = summary["recording"]
    assert recording["lost"] == 0
    assert recording["cycles"] == summary["cycles"]
    with open(recording["path"], "rb") as file:
        reader = make_reader(file)
        content = reader.get_summary()
        assert content is not None
        assert content.statistics is not None
        counts = {
            channel.topic: content.statistics.channel_message_counts[channel.id]
            for channel in content.channels.values()
        }
        attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        attachments, dbc = attached.keys(), attached["bus.dbc"].decode()
    assert counts["/joint/1/state"] == counts["/joint/2/state"] == counts["/can/frames"] == summary["cycles"]
    files = ("configuration.yaml", "joint1.yaml", "joint2.yaml", "bus.dbc", "provenance.json", "drive.eds")
    assert set(files) <= attachments
    for number in (1, 2):
        values, sent = temperatures(Path(recording["path"]), number)
        assert set(values[-500:]) <= set(sent), (
            "known half a second after the start, by the frames of the log"
        )
        assert 3 <= len(sent) <= 5
        assert f"drive_{number}_TPDO3: 2 drive_{number}" in dbc


def test_method_fused_on_the_emulated_bench(tmp_path: Path, environment: dict[str, str]) -> None:
    """With random networks: it is the daemon that is tried here."""
    config = str(configured(tmp_path, "fused", networks(), temperature=True))
    options = ["--bus", "sim", "--config", config, "--duration", "2", "--record", str(tmp_path), "--json"]
    result = run(*options, environment=environment)
    assert result.returncode == 0, result.stderr
    no_traceback(result)
    assert "physics only" not in result.stderr
    recording = json.loads(result.stdout)["recording"]
    for number in (1, 2):
        state = read_topic(Path(recording["path"]), f"/joint/{number}/state")[-1000:]
        used = np.isfinite(state["network_nm"])
        had_time = (state["input_flags"] & (INPUTS | FLAG_NETWORK_SKIPPED) == INPUTS) & (
            state["status"] != STALE
        )
        assert had_time.sum() > 100
        assert used[had_time].mean() > 0.9
        assert {2, 6} & set(state["status"])
        values, sent = temperatures(Path(recording["path"]), number)
        assert set(values[-1000:]) <= set(sent)
        assert np.isfinite(state["physics_nm"][used]).all()
        assert not np.isfinite(state["tob_nm"]).any(), "no stage of this method"


@contextmanager
def a_bench(directory: Path) -> Iterator[str]:
    """The emulated bench as a process; the address of its bus."""
    bus = f"unix:{directory / 'bus'}"
    process = subprocess.Popen([sys.executable, "-m", "jtqd.sim_can", "--bus", bus])
    until_it_listens(bus, process)
    yield bus
    process.terminate()
    process.wait(5)


@contextmanager
def a_daemon(bus: str, environment: dict[str, str]) -> Iterator[Daemon]:
    """jtqd on that bench, publishing."""
    process = started("--bus", bus, "--json", environment=environment)
    socket = open_frame_socket(bus, [exact(0x1A0)])
    deadline = time.monotonic() + 20
    while not socket.wait(0.1):
        assert process.poll() is None, process.stderr
        assert time.monotonic() < deadline
    socket.close()
    yield bus, process, environment
    if process.poll() is None:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """One for all daemons of this file, each of which ends with its test."""
    with a_bench(tmp_path_factory.mktemp("bench")) as bus:
        yield bus


@pytest.fixture
def daemon(bench: str, environment: dict[str, str]) -> Iterator[Daemon]:
    with a_daemon(bench, environment) as made:
        yield made


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """One for all tests that only look at it."""
    directory = tmp_path_factory.mktemp("running")
    with a_bench(directory) as bus, a_daemon(bus, runtime(directory)) as made:
        yield made


def test_any_master_reads_its_object_dictionary(running: Daemon) -> None:
    bus, _, _ = running
    network = canopen.Network()
    network.bus = UnixBus(channel=bus.removeprefix("unix:"))
    network.connect()
    try:
        node = network.add_node(0x20, str(JTQD_EDS))
        node.sdo.RESPONSE_TIMEOUT = 5.0  # the supervisor may be about to begin
        assert "jtqd" in node.sdo[0x1008].raw
        first = node.sdo[0x2200][1].raw
        time.sleep(0.5)
        assert node.sdo[0x2200][1].raw > first
        assert node.sdo[0x2202][1].raw == pytest.approx(100.0)  # gear ratio of joint 1
        assert node.sdo[0x2202][7].raw == 0.0  # age of its estimate, ms: the torsion is tracked
        assert len(node.sdo[0x2204].raw) == 64
        with pytest.raises(canopen.SdoAbortedError):
            node.sdo[0x2200][1].raw = 0
    finally:
        network.disconnect()


def test_sigterm_ends_in_order(daemon: Daemon) -> None:
    bus, process, environment = daemon
    socket = open_frame_socket(bus, [exact(0x1A0), exact(0x000)])
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=15)
    assert process.returncode == 0, err
    assert json.loads(out)["cycles"] > 0
    assert list(Path(environment["RUNTIME_DIRECTORY"]).iterdir()) == [], "nothing is left behind"
    estimates, nmt = [], []
    while count := socket.receive():
        for n in range(count):
            can_id, _, data = struct.unpack_from("<IB3x8s", socket.frames, 16 * n)
            (estimates if can_id == 0x1A0 else nmt).append(data)
    assert decode(estimates[-1]).status == (0, 0), "the last estimate says off"
    assert [bytes(data[:2]) for data in nmt] == [b"\x80\x01", b"\x80\x02", b"\x80\x03"]
    socket.close()


@pytest.mark.parametrize("command", [0x02, 0x80, 0x81])  # stop, enter pre-operational, reset node
def test_nmt_commands_to_the_own_node_are_ignored(running: Daemon, command: int) -> None:
    bus, process, _ = running
    socket = open_frame_socket(bus, [exact(0x1A0), exact(0x720)])
    socket.send(pack(0x000, bytes((command, 0x20))))
    time.sleep(0.3)
    estimates, states = 0, set()
    while count := socket.receive():
        for n in range(count):
            can_id, _, data = struct.unpack_from("<IB3x8s", socket.frames, 16 * n)
            estimates += can_id == 0x1A0
            states |= {data[0]} if can_id == 0x720 else set()
    socket.close()
    assert estimates > 100
    assert states == {5}
    assert process.poll() is None


def test_garbage_on_the_bus_is_counted_and_changes_nothing(daemon: Daemon) -> None:
    bus, process, _ = daemon
    socket = open_frame_socket(bus, [exact(0x1A0)])
    for n in range(200):
        socket.send(pack(0x181, bytes(n % 8)))  # too short
        socket.send(pack(0x181 | 0x8000_0000, bytes(8)))  # 29-bit
        socket.send(pack(0x7FF, bytes(8)))
        time.sleep(0.001)
    socket.close()
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=15)
    assert "Traceback" not in err
    summary = json.loads(out)
    assert summary["counters"]["rejected_frames"] == 400
    assert summary["error"] is None


def test_a_node_that_restarts_is_configured_again_before_it_is_believed(daemon: Daemon) -> None:
    bus, process, _ = daemon
    socket = open_frame_socket(bus, [exact(0x1A0)])
    time.sleep(0.5)
    while socket.receive():
        pass  # what was before does not count
    socket.send(pack(0x000, b"\x81\x01"))  # NMT reset node 1: its mapping is the device's default again
    seen: list[int] = []
    deadline = time.monotonic() + 15
    back = False
    while not back and time.monotonic() < deadline:
        socket.wait(0.1)
        frames, count = socket.frames, socket.receive()
        seen += [decode(bytes(frames[16 * n + 8 : 16 * n + 16])).status[0] for n in range(count)]
        back = seen.count(4) > 50 and 4 not in seen[-100:]
    socket.close()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=15)
    assert back, err
    assert "node 1 returned and is configured again" in err
    assert "jtqd: joint 1: inputs lost: " in err
    assert process.returncode == 0


def test_the_bus_that_ends_is_said(environment: dict[str, str], tmp_path: Path) -> None:
    with a_bench(tmp_path) as bus:
        process = started("--bus", bus, environment=environment)
        until_it_publishes(process, environment)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 1
    assert "Traceback" not in err
    assert "bus lost (" in out + err


def test_unknown_bus(environment: dict[str, str]) -> None:
    for bus in ("can77", "unix:/nonexistent/bus", "unix:"):
        result = run("--bus", bus, "--duration", "1", "--record", "none", environment=environment)
        assert result.returncode == 1
        message = no_traceback(result)
        assert len(message.splitlines()) == 1, message
        assert bus.removeprefix("unix:") in message
    assert list(Path(environment["RUNTIME_DIRECTORY"]).iterdir()) == [], "nothing is left behind"


def configuration(directory: Path, **changes: object) -> str:
    content = shipped_bench()
    for key, value in changes.items():
        section, _, name = key.partition("__")
        if name:
            content[section][name] = value
        else:
            content[section] = value
    path = directory / "c.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def with_joint_1(directory: Path, joint_1: dict[str, object], **estimator: object) -> str:
    """A configuration whose first joint file and estimator say something else."""
    joint = yaml.safe_load(shipped("joint1.yaml").read_text())
    (directory / "other.yaml").write_text(yaml.safe_dump({**joint, **joint_1}))
    changes = {f"estimator__{key}": value for key, value in estimator.items()}
    changes["estimator__shadow"] = ["network"]  # of the shipped ones that is no method of these tests
    return configuration(directory, joint_1__file=str(directory / "other.yaml"), **changes)


@pytest.mark.measures
def test_an_estimate_far_from_the_sensor_is_said_once_and_counted(
    tmp_path: Path, environment: dict[str, str], bench: str
) -> None:
    too_sure = {"load_uncertainty": 0.0, "friction_uncertainty": 0.0, "sigma_floor": 0.001}
    path = with_joint_1(tmp_path, {"torque_constant_nm_per_a": 0.11}, method="tob", **too_sure)
    process = started("--bus", bench, "--config", path, "--json", environment=environment)
    assert process.stderr is not None
    assert process.stdout is not None
    warning = "jtqd: joint {}: the estimate has been more than 3 sigma away"
    deadline, reported = time.monotonic() + 60, ""
    while warning.format(1) not in reported and time.monotonic() < deadline:
        reported += process.stderr.readline()  # at least one comes every 5 s
    process.send_signal(signal.SIGTERM)
    reported += process.stderr.read()
    counted = json.loads(process.stdout.read())["deviations"]
    assert process.wait(15) == 0
    assert counted["joint_1"] >= 1
    assert counted == {f"joint_{number}": reported.count(warning.format(number)) for number in (1, 2)}


def test_no_process_that_stays_loads_torch_or_scipy(running: Daemon) -> None:
    """Training libraries are for training."""
    _, process, _ = running
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    for pid in [str(process.pid), *children]:
        try:
            maps = Path(f"/proc/{pid}/maps").read_text()
        except FileNotFoundError:
            continue
        assert "libtorch" not in maps
        assert "scipy/" not in maps


def test_a_second_daemon_on_the_same_bus_is_refused(running: Daemon) -> None:
    bus, process, environment = running
    result = run("--bus", bus, "--duration", "1", "--record", "none", environment=environment)
    assert result.returncode == 1
    message = no_traceback(result)
    assert len(message.splitlines()) == 1
    assert str(process.pid) in message
    assert process.poll() is None, "the first one goes on"
    assert len(list(Path(environment["RUNTIME_DIRECTORY"]).glob("*/ring"))) == 1, "and keeps its memory"


def test_ctrl_c_on_a_terminal_ends_in_order(environment: dict[str, str]) -> None:
    """A terminal sends SIGINT to its whole foreground group; bench, loop and recorder must not die of it."""
    process = started("--bus", "sim", "--json", environment=environment, own_group=True)
    until_it_publishes(process, environment)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=15)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert json.loads(out)["error"] is None


def test_a_loop_that_hangs_does_not_keep_the_daemon(environment: dict[str, str]) -> None:
    process = started("--bus", "sim", environment=environment)
    until_it_publishes(process, environment)
    for entry in Path("/proc").glob("[0-9]*"):
        command = (entry / "cmdline").read_bytes() if (entry / "cmdline").exists() else b""
        if b"jtqd.daemon.loop.process" in command and environment["RUNTIME_DIRECTORY"].encode() in command:
            os.kill(int(entry.name), signal.SIGKILL)
    out, err = process.communicate(timeout=15)
    assert process.returncode == 1
    assert "the loop ended with exit status -9" in out
    assert "Traceback" not in err


# Signals and requests while it starts, and where memory is short ----------------------------------------------------------


class Slow(NamedTuple):
    """A bench, and a configuration of a slow cycle: it is not the loop that is tried here."""

    bus: str
    configuration: Path
    environment: dict[str, str]

    @property
    def directory(self) -> Path:
        return Path(self.environment["RUNTIME_DIRECTORY"])

    def start(self, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
        options = ("--bus", self.bus, "--config", str(self.configuration))
        return started(*options, environment=self.environment, own_group=True, limit=limit)


@pytest.fixture
def slow(bench: str, tmp_path: Path, environment: dict[str, str]) -> Slow:
    return Slow(bench, slow_configuration(tmp_path, PERIOD_US), environment)


def ended(process: subprocess.Popen[str], directory: Path) -> tuple[int, str]:
    """(exit status, standard error); no traceback, nothing left."""
    _, err = process.communicate(timeout=30)
    assert "Traceback" not in err
    assert list(directory.iterdir()) == []
    return process.returncode, err


def loaded(process: subprocess.Popen[str], library: str) -> bool:
    assert process.poll() is None
    return library in Path(f"/proc/{process.pid}/maps").read_text()


def child_of(process: subprocess.Popen[str], module: bytes) -> int | None:
    """Process-ID of the daemon's child that runs this module, if there is one."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    for pid in children:
        try:
            if module in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                return int(pid)
        except OSError:
            continue
    return None


def booting(process: subprocess.Popen[str]) -> bool:
    return child_of(process, b"jtqd.drivers.boot") is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", ["loading", "booting"])
def test_told_to_end_while_it_starts(slow: Slow, number: signal.Signals, moment: str) -> None:
    """While its modules are loaded, and while the nodes are booted: one line, status 0, no child left."""
    process = slow.start()
    until(lambda: loaded(process, "msgspec") if moment == "loading" else booting(process))
    os.killpg(process.pid, number)
    assert ended(process, slow.directory) == (0, "jtqd: stopped before it ran\n")


def test_sighup_is_ignored_with_a_line(slow: Slow) -> None:
    """While its modules are loaded, and while it runs; the loop outlives the signals that its recorder takes."""
    process = slow.start()
    until(lambda: loaded(process, "msgspec"))
    process.send_signal(signal.SIGHUP)
    until(lambda: list(slow.directory.glob("*/control")))
    loop = child_of(process, b"jtqd.daemon.loop.process")
    assert loop is not None
    process.send_signal(signal.SIGHUP)
    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
        os.kill(loop, number)
    out, _ = control("ping", slow).communicate(timeout=30)
    assert json.loads(out)["loop"] == loop
    process.terminate()
    status, err = ended(process, slow.directory)
    assert (status, err.count("SIGHUP ignored")) == (0, 1)


def test_nodes_are_put_back_where_the_start_fails_after_their_boot(slow: Slow) -> None:
    """No file may be as large as the ring must be: the loop ends, when the boot has started all nodes."""
    nmt = open_frame_socket(slow.bus, [exact(0x000)])

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    process = slow.start(limit)
    status, err = ended(process, slow.directory)
    assert (status, err.splitlines()[-1]) == (1, "jtqd: shared memory: File too large")
    sent = []
    while count := nmt.receive():
        sent += [bytes(nmt.frames[16 * n + 8 : 16 * n + 10]) for n in range(count)]
    nmt.close()
    assert [each[0] for each in sent if each[1] == 1][-2:] == [0x01, 0x80], "started, and put back"
    assert sent[-3:] == [b"\x80\x01", b"\x80\x02", b"\x80\x03"]


def control(verb: str, slow: Slow) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "control", verb, "--bus", slow.bus, "--json"],
        env={**slow.environment, "XDG_RUNTIME_DIR": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_an_order_while_it_starts_is_refused_in_plain_words(slow: Slow) -> None:
    process = slow.start()
    until(lambda: list(slow.directory.glob("*/about.json")))
    process.send_signal(signal.SIGSTOP)  # it stays where it is
    _, err = control("ping", slow).communicate(timeout=30)
    process.send_signal(signal.SIGCONT)
    assert err == "jtq control: ping: jtqd accepts no orders now: it is starting or ending\n"
    process.terminate()
    assert ended(process, slow.directory)[0] == 0


def test_a_child_is_not_waited_for_when_we_are_told_to_end() -> None:
    child = Child("http.server", ["--bind", "127.0.0.1", "0"])
    assert wait_for(child, lambda: True) is None
    child.end()


# A processor hog (fault 39): a real one, above the loop's priority, on the only CPU that daemon and bench may use.
# What must come out follows from what the hog has seen of its own time, not from the speed of the machine.

HOG_S = 0.2
HOG = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
began = last = time.monotonic_ns()
longest = 0
while last - began < float(sys.argv[2]) * 1e9:
    now = time.monotonic_ns()
    longest = max(longest, now - last)
    last = now
print(began, last, longest)
"""


@pytest.mark.measures
def test_a_processor_hog_costs_counted_cycles_and_nothing_that_is_published_is_stale(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    cpu = max(os.sched_getaffinity(0))
    logs = tmp_path / "logs"
    deadlines = {"wait_us": 2000, "deadline_us": 4250}  # daemon and bench take turns on one processor
    config = slow_configuration(tmp_path, PERIOD_US, inputs=deadlines)
    options = ["--bus", "sim", "--config", str(config), "--duration", "4", "--record", str(logs), "--json"]
    process = started(*options, environment=environment, limit=lambda: os.sched_setaffinity(0, {cpu}))
    until_it_publishes(process, environment, 200)
    hog = subprocess.run(
        [sys.executable, "-c", HOG, str(cpu), str(HOG_S)], capture_output=True, text=True, check=False
    )
    reported = json.loads(process.communicate(timeout=60)[0])
    if "PermissionError" in hog.stderr:
        pytest.skip("CPU HOG NOT TESTED: no right to a real-time priority")
    began, ended, longest = map(int, hog.stdout.split())
    taken = (ended - began - 2 * longest) // (1000 * PERIOD_US) - 1
    assert reported["missed"] >= taken > 20, "what the hog took from the loop is counted"
    assert process.returncode == 0
    loop = read_topic(list(logs.glob("*.mcap")), "/can/frames")
    sent_ns, cycle = loop["sync_monotonic_ns"], loop["cycle"]
    assert not np.any((sent_ns > began + longest) & (sent_ns < ended - longest)), "the hog had it all"
    before, after = np.searchsorted(sent_ns, [began + longest, ended - longest]) - [1, 0]
    slots = round((sent_ns[after] - sent_ns[before]) / (1000 * PERIOD_US))
    assert cycle[after] - cycle[before] == slots > taken, "the grid is the same, no slot is made up"
    counted = reported["missed"] + reported["counters"]["sync_gaps"]
    assert cycle[-1] + 1 == len(cycle) + counted, "each slot is a record or is counted"
    assert reported["cycles"] == len(cycle)
    for number in (1, 2):
        joint = read_topic(list(logs.glob("*.mcap")), f"/joint/{number}/state")
        published = np.isin(joint["status"], tuple(PUBLISHED))
        fresh = (joint["input_flags"] & INPUTS) == INPUTS
        assert np.all(fresh[published]), "no torque from inputs of another cycle"
        assert np.count_nonzero(published[after : after + 200]) >= 20, "it goes on"
