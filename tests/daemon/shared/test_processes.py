"""Children and their answers; messages to the service manager over a real datagram socket, which hold up no loop."""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from jtqd.daemon.shared.processes import (
    Child,
    ChildError,
    ChildSilence,
    LoopWatchdog,
    Notifier,
    watchdog_seconds,
)


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """The other end: systemd's socket."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    sock.bind(str(tmp_path / "notify"))
    sock.setblocking(False)
    yield sock
    sock.close()


def words(manager: socket.socket) -> list[str]:
    found = []
    try:
        while True:
            found.append(manager.recv(4096).decode())
    except BlockingIOError:
        return found


def test_assignments_arrive_as_one_datagram(manager: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname()})
    assert notifier.send("READY=1", "STATUS=joint 1: valid")
    assert words(manager) == ["READY=1\nSTATUS=joint 1: valid"]


def test_an_abstract_address(tmp_path: Path) -> None:
    name = f"jtqd-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind("\0" + name)
        assert Notifier({"NOTIFY_SOCKET": "@" + name}).send("READY=1")
        assert sock.recv(100) == b"READY=1"


@pytest.mark.parametrize("address", ["", "/no/such/socket", "vsock:2:1234"])
def test_without_a_manager_nothing_is_sent_and_nothing_raised(address: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": address})
    assert not notifier.connected
    assert not notifier.send("READY=1")


def test_a_manager_that_reads_nothing_holds_nobody_up(manager: socket.socket) -> None:
    """Its queue is full: the word is lost, and the loop has not waited for it."""
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname()})
    sent, longest = 0, 0.0
    for _ in range(5000):
        began = time.monotonic()
        sent += notifier.send("WATCHDOG=1")
        longest = max(longest, time.monotonic() - began)
    assert 0 < sent < 5000
    assert longest < 0.5  # a blocking socket would never come back


@pytest.mark.parametrize(
    ("period_ns", "watchdog_s", "every"), [(1_000_000, 2.0, 200), (5_000_000, 2.0, 40), (100_000_000, 0.5, 1)]
)
def test_the_watchdog_is_fed_by_cycles_alone(
    manager: socket.socket, period_ns: int, watchdog_s: float, every: int
) -> None:
    watchdog = LoopWatchdog(Notifier({"NOTIFY_SOCKET": manager.getsockname()}), period_ns, watchdog_s)
    assert watchdog.every == every
    for _ in range(3 * every):
        watchdog.advanced()
    assert words(manager) == ["WATCHDOG=1"] * 3
    for _ in range(every - 1):
        watchdog.advanced()
    assert words(manager) == []


def test_without_a_watchdog_nothing_is_fed(manager: socket.socket) -> None:
    for watchdog in (
        LoopWatchdog(Notifier({"NOTIFY_SOCKET": manager.getsockname()}), 1_000_000, None),
        LoopWatchdog(Notifier({}), 1_000_000, 2.0),
    ):
        for _ in range(1000):
            watchdog.advanced()
    assert words(manager) == []


@pytest.mark.parametrize(
    ("environment", "seconds"),
    [
        ({"WATCHDOG_USEC": "2000000"}, 2.0),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getppid())}, 0.5),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getpid())}, 0.5),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": "1999999"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdogs_time(environment: dict[str, str], seconds: float | None) -> None:
    assert watchdog_seconds(environment) == seconds


# Children


def child(statement: str) -> Child:
    """A process that runs one Python statement; `timeit` is a module that does that."""
    return Child("timeit", ["-n", "1", "-r", "1", statement], name="the child")


def test_last_words_of_a_child_that_has_ended() -> None:
    one = child("print('{}', flush=True); import os; os._exit(3)")
    one.process.wait(30)
    assert one.answer(30.0) == {}
    with pytest.raises(ChildError, match="the child ended with exit status 3"):
        one.answer(30.0)


def test_silence_is_not_the_end() -> None:
    one = child("import time; time.sleep(60)")
    with pytest.raises(ChildSilence, match=r"the child did not answer within 0\.1 s"):
        one.answer(0.1)
    assert one.alive()
    assert len(one.outputs) == 1
    one.end()


def test_a_closed_output_is_not_spun_on() -> None:
    one = child("import os, time; os.close(1); time.sleep(1); os._exit(0)")
    used, begun = time.process_time(), time.monotonic()
    with pytest.raises(ChildError, match="the child ended with exit status 0"):
        one.answer(30.0)
    assert one.outputs == []
    assert time.monotonic() - begun > 0.9
    assert time.process_time() - used < 0.1  # spinning, it would be all of the second
