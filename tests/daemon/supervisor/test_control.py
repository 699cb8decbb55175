"""The control socket, with real sockets: who may give orders, what becomes of orders that are none, and the command."""

import json
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from jtqd.daemon.cli.control import ask
from jtqd.daemon.supervisor import control
from jtqd.daemon.supervisor.control import ControlError, ControlServer

pytestmark = pytest.mark.native

Handlers = dict[str, Callable[[dict[str, Any]], Any]]


class Served:
    """A server whose turn comes again and again, as in the supervisor's loop."""

    def __init__(self, path: Path, handlers: Handlers) -> None:
        self.path = path
        self.server = ControlServer(path, handlers)
        self.end = threading.Event()
        self.thread = threading.Thread(target=self._turn)
        self.thread.start()

    def _turn(self) -> None:
        while not self.end.wait(0.005):
            self.server.serve()
        self.server.close()

    def close(self) -> None:
        self.end.set()
        self.thread.join()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    count = iter(range(1000))

    def refuse(request: dict[str, Any]) -> Any:
        raise ControlError("not today")

    def later(request: dict[str, Any]) -> Any:
        return lambda: {"ok": True, "turns": 3} if next(count) >= 3 else None

    handlers: Handlers = {
        "ping": lambda request: {"ok": True, "request": request},
        "later": later,
        "refuse": refuse,
        "long": lambda request: {"ok": True, "text": "x" * control.REPLY_BYTES},
    }
    one = Served(tmp_path / "control", handlers)
    yield one
    one.close()
    assert not one.path.exists()


def raw(path: Path, data: bytes) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.settimeout(5)
        sock.connect(str(path))
        sock.send(data)
        return dict(json.loads(sock.recv(1 << 20)))


def test_an_order_and_its_reply(served: Served) -> None:
    assert ask(served.path, {"verb": "ping"}, 5.0) == {"ok": True, "request": {"verb": "ping"}}
    assert ask(served.path, {"verb": "later"}, 5.0) == {"ok": True, "turns": 3}
    assert ask(served.path, {"verb": "refuse"}, 5.0) == {"ok": False, "error": "not today"}
    assert ask(served.path, {"verb": "long"}, 5.0) == {"ok": False, "error": "the reply is too long"}


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"hello", "found no JSON"),
        (b"\xff\xfe", "found no JSON"),
        (b"[" * 4000, "found no JSON"),
        (b"[]", "verb: found None, expected one of ping, later, refuse, long"),
        (b'{"verb": "rm -rf"}', "verb: found 'rm -rf', expected one of ping, later, refuse, long"),
        (b'{"verb": ["ping"]}', "verb: found ['ping'], expected one of ping, later, refuse, long"),
        (b'{"verb": "' + b"p" * 5000 + b'"}', "found a request of more than 4096 bytes"),
    ],
)
def test_what_is_no_order_is_refused_and_the_next_one_served(served: Served, data: bytes, error: str) -> None:
    assert raw(served.path, data) == {"ok": False, "error": error}
    assert ask(served.path, {"verb": "ping"}, 5.0)["ok"]


def test_in_a_deep_runtime_directory(tmp_path: Path) -> None:
    """Longer than what the kernel takes as an address of a socket."""
    directory = tmp_path / ("d" * 100) / ("e" * 100)
    directory.mkdir(parents=True)
    one = Served(directory / "control", {"ping": lambda request: {"ok": True}})
    try:
        assert ask(one.path, {"verb": "ping"}, 5.0)["ok"]
        assert stat.S_IMODE(one.path.stat().st_mode) == 0o600
    finally:
        one.close()
    assert not one.path.exists()
    with pytest.raises(FileNotFoundError):
        ask(one.path, {"verb": "ping"}, 5.0)


def test_only_the_owner_can_open_it(served: Served) -> None:
    assert stat.S_IMODE(served.path.stat().st_mode) == 0o600


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be somebody else")
def test_another_user_is_refused_even_where_the_file_lets_him_in(served: Served) -> None:
    """Second lock: the mode is opened by hand, and the credentials still tell who asks."""
    served.path.chmod(0o666)
    for directory in served.path.parents:
        if str(directory).startswith("/tmp/"):
            directory.chmod(0o755)
    program = (
        "import os, socket, sys\n"
        "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET); s.settimeout(5); s.connect(sys.argv[1])\n"
        "sys.stdout.write(s.recv(4096).decode())\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", program, str(served.path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout) == {"ok": False, "error": "user 65534 may not give orders"}


def test_those_who_ask_nothing_do_not_shut_out_others_for_long(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "PATIENCE_S", 0.8)
    idle = []
    for _ in range(control.MOST_CONNECTIONS):
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.connect(str(served.path))
        idle.append(sock)
    assert ask(served.path, {"verb": "ping"}, 5.0)["ok"]
    for sock in idle:
        sock.settimeout(5)
        assert sock.recv(10) == b""  # closed from the other side
        sock.close()


def test_one_that_goes_away_without_its_reply_hurts_nobody(served: Served) -> None:
    for _ in range(5):
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.connect(str(served.path))
        sock.send(b'{"verb": "later"}')
        sock.close()
    assert ask(served.path, {"verb": "ping"}, 5.0)["ok"]


def command(*arguments: str, directory: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(directory), "XDG_RUNTIME_DIR": ""}
    return subprocess.run(
        [sys.executable, "-m", "jtqd.daemon.jtq", "control", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_command_reports_that_there_is_no_daemon(tmp_path: Path) -> None:
    done = command("ping", "--bus", "no-such-bus", directory=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("jtq control: ping: no jtqd runs on no-such-bus")
    assert done.stdout == ""
    found = command("ping", "--bus", "no-such-bus", "--json", directory=tmp_path)
    assert not json.loads(found.stdout)["ok"]


def test_a_verb_that_is_none_is_a_matter_of_usage(tmp_path: Path) -> None:
    done = command("explode", directory=tmp_path)
    assert done.returncode == 2
    assert "invalid choice: 'explode'" in done.stderr
