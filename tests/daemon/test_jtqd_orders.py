"""Signals and requests to a daemon while it starts, and where memory is short. Real processes."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from jtqd.daemon.shared.processes import Child
from jtqd.daemon.supervisor.process import wait_for
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame_socket import open_frame_socket
from tests.daemon.slow_bench import slow_configuration

pytestmark = pytest.mark.native

PERIOD_US = 5000
"""Slow: it is not the loop that is tried here."""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[str]:
    bus = f"unix:{tmp_path / 'bus'}"
    process = subprocess.Popen(
        [sys.executable, "-m", "jtqd.sim_can", "--bus", bus], stderr=subprocess.DEVNULL
    )
    until((tmp_path / "bus").exists)
    yield bus
    process.terminate()
    process.wait(5)


@pytest.fixture
def run_directory(tmp_path: Path) -> Path:
    directory = tmp_path / "run"
    directory.mkdir()
    return directory


@pytest.fixture
def configuration(tmp_path: Path) -> Path:
    return slow_configuration(tmp_path, PERIOD_US)


def until(true: Callable[[], object], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def started(*options: str, directory: Path, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtqd", "--record", "none", *options],
        env={**os.environ, "RUNTIME_DIRECTORY": str(directory), "LOGS_DIRECTORY": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limit,  # noqa: PLW1509 - no threads here
        start_new_session=True,
    )


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
def test_told_to_end_while_it_starts(
    bench: str, run_directory: Path, configuration: Path, number: signal.Signals, moment: str
) -> None:
    """While its modules are loaded, and while the nodes are booted: one line, status 0, no child left."""
    process = started("--bus", bench, "--config", str(configuration), directory=run_directory)
    until(lambda: loaded(process, "msgspec") if moment == "loading" else booting(process))
    os.killpg(process.pid, number)
    assert ended(process, run_directory) == (0, "jtqd: stopped before it ran\n")


def test_sighup_is_ignored_with_a_line(bench: str, run_directory: Path, configuration: Path) -> None:
    """While its modules are loaded, and while it runs; the loop outlives the signals that its recorder takes."""
    process = started("--bus", bench, "--config", str(configuration), directory=run_directory)
    until(lambda: loaded(process, "msgspec"))
    process.send_signal(signal.SIGHUP)
    until(lambda: list(run_directory.glob("*/control")))
    loop = child_of(process, b"jtqd.daemon.loop.process")
    assert loop is not None
    process.send_signal(signal.SIGHUP)
    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
        os.kill(loop, number)
    out, _ = control("ping", bench, run_directory).communicate(timeout=30)
    assert json.loads(out)["loop"] == loop
    process.terminate()
    status, err = ended(process, run_directory)
    assert (status, err.count("SIGHUP ignored")) == (0, 1)


def test_nodes_are_put_back_where_the_start_fails_after_their_boot(
    bench: str, run_directory: Path, configuration: Path
) -> None:
    """No file may be as large as the ring must be: the loop ends, when the boot has started all nodes."""
    nmt = open_frame_socket(bench, [exact(0x000)])
    small = 200_000

    def limit() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (small, small))

    process = started("--bus", bench, "--config", str(configuration), directory=run_directory, limit=limit)
    status, err = ended(process, run_directory)
    assert (status, err.splitlines()[-1]) == (1, "jtqd: shared memory: File too large")
    sent = []
    while count := nmt.receive():
        sent += [bytes(nmt.frames[16 * n + 8 : 16 * n + 10]) for n in range(count)]
    nmt.close()
    assert [each[0] for each in sent if each[1] == 1][-2:] == [0x01, 0x80], "started, and put back"
    assert sent[-3:] == [b"\x80\x01", b"\x80\x02", b"\x80\x03"]


def control(verb: str, bus: str, directory: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "control", verb, "--bus", bus, "--json"],
        env={**os.environ, "RUNTIME_DIRECTORY": str(directory), "XDG_RUNTIME_DIR": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_an_order_while_it_starts_is_refused_in_plain_words(
    bench: str, run_directory: Path, configuration: Path
) -> None:
    process = started("--bus", bench, "--config", str(configuration), directory=run_directory)
    until(lambda: list(run_directory.glob("*/about.json")))
    process.send_signal(signal.SIGSTOP)  # it stays where it is
    _, err = control("ping", bench, run_directory).communicate(timeout=30)
    process.send_signal(signal.SIGCONT)
    assert err == "jtq control: ping: jtqd accepts no orders now: it is starting or ending\n"
    process.terminate()
    assert ended(process, run_directory)[0] == 0


def test_a_child_is_not_waited_for_when_we_are_told_to_end() -> None:
    child = Child("http.server", ["--bind", "127.0.0.1", "0"])
    assert wait_for(child, lambda: True) is None
    child.end()
