"""What any local user can put where `jtq` looks, and what a file, an answer or a name can hold: one line, at once, no harm.

Every row is a command of its own process with limited time and memory. What other users own is made where root runs the
tests; there the same things also come from the user himself, which must do no harm either.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import resource
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from jtqd.daemon import jtq
from jtqd.daemon.cli.running import find_daemons
from jtqd.daemon.live.reading import Daemon
from jtqd.daemon.shared.events import ERROR
from jtqd.models.files import shipped
from tests.daemon.cli.status_daemon import running
from tests.paths import GOLDEN, ROOT

MEMORY = 2 << 30
"""Address space of a command [byte]: a sparse file of 3 GB that is read or mapped does not fit."""
TIME_S = 30.0
"""Of a command beside other processes; alone each takes one to two."""
NOBODY = 65534
LOG = GOLDEN / "network.mcap"
ROOT_ONLY = pytest.mark.skipif(os.getuid() != 0, reason="only root can make files of other users")
ESCAPE = "\x1b[2J\x9b31m\u202e\x07"
FORBIDDEN = {*map(chr, range(9)), *map(chr, range(11, 32)), *map(chr, range(127, 160)), "\u202e"}


class Made(NamedTuple):
    """What a command has left."""

    returncode: int
    stdout: str
    stderr: str
    processor_s: float


FORKS = multiprocessing.get_context("forkserver")
USED = "status control doctor replay export recover plot fit diagnose batch check bus-load export-model score probe layout"
FORKS.set_forkserver_preload(
    [
        __name__,
        "matplotlib.backends.backend_agg",
        *(jtq.COMMANDS[each][0] for each in USED.split()),
        *jtq.FORMS.values(),
    ]
)


def command(arguments: list[str], environment: dict[str, str], out: Path, cwd: Path, memory: int) -> None:
    """`jtq` in a fork of a process that has read the modules and nothing else: no start of an interpreter."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(out / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", 1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    began_s = time.process_time()
    try:
        status = jtq.main(arguments)
    finally:
        (out / "processor_s").write_text(str(time.process_time() - began_s))
    sys.exit(status)


def run(root: Path, *arguments: str | Path, memory: int = MEMORY, cwd: Path = ROOT) -> Made:
    """Run `jtq` with runtime directories in `root`. Raises TimeoutError where it waits for something."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(root), "RUNTIME_DIRECTORY": "", "COLUMNS": "120"}
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        words = [str(each) for each in arguments]
        child = FORKS.Process(target=command, args=(words, dict(environment), out, cwd, memory))
        child.start()
        child.join(TIME_S)
        if child.is_alive():
            child.kill()
            child.join()
            raise TimeoutError(words)
        assert child.exitcode is not None
        texts = [(out / each).read_bytes().decode(errors="surrogateescape") for each in ("stdout", "stderr")]
        made = Made(child.exitcode, *texts, float((out / "processor_s").read_text()))
    assert "Traceback" not in made.stderr
    assert not FORBIDDEN & {*made.stdout, *made.stderr}, "control characters reach the terminal"
    return made


def one_line(made: Made, status: int, words: str) -> None:
    assert (made.returncode, made.stdout) == (status, ""), made.stderr
    assert words in made.stderr
    assert made.stderr.count("\n") == 1, made.stderr


# ---- runtime directories ----


def nothing(path: Path) -> None:
    """Leave it out."""


def sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 3 << 30)


def text(content: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_text(content)

    return write


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def shut(path: Path) -> None:
    path.mkdir(mode=0)


def dangling(path: Path) -> None:
    path.symlink_to("nothing")


def device(path: Path) -> None:
    os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 5))


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.bind(str(path))


def grown(path: Path) -> None:
    """A file that is longer than what is said of it, and grows while it is read."""
    path.write_text('{"schema": "jtqd.about/1", "bus": "')

    def grow() -> None:
        end = time.monotonic() + 3.0
        with path.open("a") as file:
            while time.monotonic() < end:
                file.write("x" * 65536)
                time.sleep(0.001)

    threading.Thread(target=grow, daemon=True).start()


THINGS: dict[str, Callable[[Path], None]] = {
    "nothing": nothing,
    "fifo": os.mkfifo,
    "3 GB": sparse,
    "deep": text("[" * 900_000),
    "deep objects": text('{"a":' * 200_000),
    "long number": text("1" * 900_000),
    "half a character": text('{"schema": "\\ud800"}'),
    "no UTF-8": lambda path: path.write_bytes(b"\xff\xfe" * 100),
    "link to a device": endless,
    "device": device,
    "directory": shut,
    "dangling": dangling,
    "socket": listening,
    "grows": grown,
}


@pytest.mark.parametrize("owner", ["own", pytest.param("other", marks=ROOT_ONLY)])
def test_what_is_no_description_is_no_daemon(tmp_path: Path, owner: str) -> None:
    """All of them at once: none is believed, and none keeps a daemon that comes after it from being found."""
    for number, (thing, put) in enumerate(THINGS.items()):
        if thing == "device" and os.getuid() != 0:  # only root can make devices
            continue
        directory = tmp_path / f"jtqd-0-{number}"
        directory.mkdir()
        put(directory / "about.json")
        if owner == "other":
            os.chown(directory, NOBODY, NOBODY)
    status = ("status", "--once", "--bus", "hostile")
    one_line(run(tmp_path, *status), 1, "no jtqd runs on hostile")
    running(tmp_path, "hostile")
    made = run(tmp_path, *status)
    assert (made.returncode, made.stderr) == (0, "")


@pytest.mark.parametrize(
    "command", [("control", "reset"), ("control", "ping", "--json"), ("status", "--json")]
)
def test_every_command_that_looks_for_a_daemon_looks_the_same_way(
    tmp_path: Path, command: tuple[str, ...]
) -> None:
    for thing in ("fifo", "3 GB", "deep"):
        directory = tmp_path / f"jtqd-0-{thing.replace(' ', '')}"
        directory.mkdir()
        THINGS[thing](directory / "about.json")
    made = run(tmp_path, *command, "--bus", "hostile")
    assert (made.returncode, made.stderr.count("\n")) == (1, 1)
    assert "no jtqd runs on hostile" in made.stderr


def test_the_doctor_goes_on_beside_them(tmp_path: Path) -> None:
    for number, thing in enumerate(("fifo", "3 GB", "deep", "dangling")):
        directory = tmp_path / f"jtqd-0-x{number}{ESCAPE}"
        directory.mkdir()
        THINGS[thing](directory / "about.json")
    made = run(tmp_path, "doctor")
    assert made.returncode in (1, 3), made.stderr
    assert "killed daemons" in made.stdout
    assert made.stderr == ""


@pytest.fixture
def daemon(tmp_path: Path) -> Daemon:
    """A daemon of the tests' own user whose description is right."""
    return running(tmp_path, "hostile")


BESIDE = [
    *(("conditions.json", thing) for thing in THINGS if thing != "device"),
    *(
        (file, thing)
        for file in ("snapshot", "bus.json", "notices", "recorded")
        for thing in ("fifo", "3 GB")
    ),
]


@pytest.mark.parametrize(("file", "thing"), BESIDE)
def test_what_lies_beside_a_description_does_not_stop_a_reader(daemon: Daemon, file: str, thing: str) -> None:
    (daemon.directory / file).unlink(missing_ok=True)
    THINGS[thing](daemon.directory / file)
    made = run(daemon.directory.parent, "status", "--once", "--bus", "hostile")
    assert (made.returncode, made.stderr) == (3 if file == "snapshot" else 0, "")
    assert ("booting its nodes" in made.stdout) == (file == "snapshot")


@ROOT_ONLY
@pytest.mark.parametrize("what", ["about.json", "snapshot", "conditions.json", "."])
def test_files_of_another_user_are_not_believed(daemon: Daemon, what: str) -> None:
    """A right file of a wrong owner: whoever could make one would answer in the daemon's place."""
    (daemon.directory / "conditions.json").write_text(
        json.dumps(
            {
                "schema": "jtqd.conditions/1",
                "conditions": [
                    {"name": "bus_off", "subject": "bus", "severity": ERROR, "text": "false", "since_ns": 1}
                ],
            }
        )
    )
    args = ("status", "--once", "--bus", "hostile")
    assert run(daemon.directory.parent, *args).returncode == 0
    os.chown(daemon.directory / what, NOBODY, NOBODY)
    made = run(daemon.directory.parent, *args)
    assert "false" not in made.stdout
    if what == "conditions.json":
        assert made.returncode == 0
    elif what == "snapshot":
        assert (made.returncode, "booting" in made.stdout) == (3, True)
    else:
        one_line(made, 1, "no jtqd runs on hostile")
    if what == ".":
        assert "1 directory of other users not read" in made.stderr


@ROOT_ONLY
def test_a_link_to_the_directory_of_a_daemon_is_not_another_daemon(daemon: Daemon) -> None:
    root = daemon.directory.parent
    for number in range(3):
        link = root / f"jtqd-65534-{number}"
        link.symlink_to(daemon.directory)
        if number:
            os.chown(link, NOBODY, NOBODY, follow_symlinks=False)
    assert len(find_daemons([root]).daemons) == 1
    made = run(root, "status", "--once", "--bus", "hostile")
    assert (made.returncode, made.stderr) == (0, "")


@pytest.mark.parametrize("owner", ["own", pytest.param("other", marks=ROOT_ONLY)])
def test_thousands_of_directories_take_no_time_and_one_line(tmp_path: Path, owner: str) -> None:
    for number in range(5000):
        directory = tmp_path / f"jtqd-0-{number}"
        directory.mkdir()
        if owner == "other":
            os.chown(directory, NOBODY, NOBODY)
    made = run(tmp_path, "status", "--once", "--bus", "hostile")
    one_line(made, 1, "no jtqd runs on hostile" + (" (5000 directories of" if owner == "other" else ""))


def test_what_a_daemon_writes_is_printed_without_control_characters_and_markup(daemon: Daemon) -> None:
    path = daemon.directory / "about.json"
    content = json.loads(path.read_text())
    content["joints"][0]["name"] = f"elbow{ESCAPE}[/bold][link=x]"
    content["configuration"] = f"/etc/{ESCAPE}\ud800"
    path.write_text(json.dumps(content))
    one_line(
        run(path.parent.parent, "status", "--once", "--bus", "hostile"), 1, "no jtqd runs"
    )  # half a character
    content["configuration"] = f"/etc/{ESCAPE}"
    path.write_text(json.dumps(content))
    for form in ("--once", "--json"):
        made = run(path.parent.parent, "status", form, "--bus", "hostile")
        assert (made.returncode, made.stderr) == (0, "")
        assert "[/bold][link=x]" in made.stdout


# ---- answers ----


@contextmanager
def answering(path: Path, reply: bytes | None) -> Iterator[None]:
    """Accept connections at `path` and give the reply to the first request; None: none until the end."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as sock:
        sock.bind(str(path))
        sock.listen(1)
        end = threading.Event()

        def serve() -> None:
            connection, _ = sock.accept()
            with connection:
                connection.recv(4096)
                if reply is not None:
                    connection.send(reply)
                end.wait(TIME_S)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield
        end.set()
        thread.join()


@pytest.mark.parametrize(
    ("reply", "status", "words"),
    [
        (b'{"ok": true}', 0, "jtqd on hostile answers, process -, cycle -"),
        (json.dumps({"ok": True, "pid": ESCAPE, "cycle": "[/x]"}).encode(), 0, "jtqd on hostile answers"),
        (b'{"ok": false}', 1, "jtq control: ping: -"),
        (json.dumps({"ok": False, "error": f"no{ESCAPE}"}).encode(), 1, "ping: no?[2J?31m??"),
        (b"[" * 60_000, 1, "nested too deep"),
        (b'{"ok": true, "pid": "\\ud800"}', 1, "ping: "),
        (b'{"ok": 1}', 1, "found a reply without 'ok'"),
        (b"1" * 60_000, 1, "ping: "),
        (b"\xff", 1, "ping: "),
        (None, 1, "jtqd did not answer in time"),
    ],
)
def test_an_answer_that_jtqd_does_not_give_is_one_line(
    daemon: Daemon, reply: bytes | None, status: int, words: str
) -> None:
    with answering(daemon.directory / "control", reply):
        made = run(daemon.directory.parent, "control", "ping", "--bus", "hostile")
    assert made.returncode == status
    assert words in made.stdout + made.stderr
    assert (made.stdout + made.stderr).count("\n") == 1


FALSE_DAEMON = """
import os, socket, sys
sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
sock.bind(sys.argv[1]); os.chmod(sys.argv[1], 0o777); os.setuid(65534); sock.listen(1); print("up", flush=True)
while True:
    one, _ = sock.accept(); one.send(b'{"ok": true, "pid": 1, "cycle": 1}')
"""


@ROOT_ONLY
@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("control", "ping", "--bus", "hostile"), "user 65534 answers there"),
        (("check", "1", "--bus", "unix:{}"), "user 65534 answers there"),
        (("probe", "--bus", "unix:{}"), "user 65534 answers there"),
    ],
)
def test_another_user_does_not_answer_in_the_place_of_a_daemon_or_a_hub(
    daemon: Daemon, command: tuple[str, ...], words: str
) -> None:
    path = daemon.directory / "control"
    with subprocess.Popen([sys.executable, "-c", FALSE_DAEMON, path], stdout=subprocess.PIPE) as false:
        assert false.stdout is not None
        assert false.stdout.readline() == b"up\n"
        try:
            one_line(run(daemon.directory.parent, *(each.format(path) for each in command)), 1, words)
        finally:
            false.kill()


@pytest.mark.parametrize("thing", ["fifo", "3 GB", "directory", "dangling", "socket"])
def test_what_is_no_control_socket_is_one_line(daemon: Daemon, thing: str) -> None:
    THINGS[thing](daemon.directory / "control")
    made = run(daemon.directory.parent, "control", "ping", "--bus", "hostile")
    one_line(made, 1, "jtq control: ping: ")


# ---- input files ----

FILES = {
    "fifo": os.mkfifo,
    "link to a device": endless,
    "directory": lambda path: path.mkdir(),
    "dangling": dangling,
    "socket": listening,
}
LOG_COMMANDS: dict[str, tuple[str, ...]] = {
    "replay": ("replay", "{}"),
    "export": ("export", "csv", "{}", "--out", "out.csv"),
    "recover": ("recover", "{}"),
    "plot": ("plot", "{}", "--out", "out.png"),
    "fit": ("fit", "friction", "{}", "--joint", str(shipped("joint1.yaml"))),
}


@pytest.mark.parametrize("command", LOG_COMMANDS)
@pytest.mark.parametrize("thing", ["fifo", "link to a device"])
def test_a_log_that_is_no_file_is_refused_and_not_waited_for(
    tmp_path: Path, command: str, thing: str
) -> None:
    path = tmp_path / "run.mcap"
    FILES[thing](path)
    words = [each.format(path) for each in LOG_COMMANDS[command]]
    made = run(tmp_path, *words, memory=8 << 30, cwd=tmp_path)
    assert made.returncode in (1, 2)
    assert re.search("found (no regular file|something that is no file)", made.stderr)
    assert made.stderr.count("\n") == 1, made.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("fit", "friction", "run.csv", "--joint", str(shipped("joint1.yaml"))),
        ("diagnose", "run.csv", "--joint", str(shipped("joint1.yaml")), "--out", "out"),
        ("batch", "replay", "run.mcap", "--out", "out"),
        ("check", "1", "--bus", "unix:none", "--config", "x.yaml"),
        ("bus-load", "--config", "x.yaml"),
        ("export-model", "x.yaml"),
        ("score", "x.yaml", "run.csv"),
        ("init", "--from-csv", "run.csv"),
        ("init", "--node", "5", "--from-eds", "x.eds", "--out", "out"),
    ],
    ids=lambda words: words[0],
)
def test_other_files_are_not_waited_for(tmp_path: Path, words: tuple[str, ...]) -> None:
    for name in ("run.csv", "run.mcap", "x.yaml", "x.eds"):
        os.mkfifo(tmp_path / name)
    made = run(tmp_path, *words, memory=8 << 30, cwd=tmp_path)
    assert made.returncode == (3 if words[0] == "batch" else 1)  # a batch goes on with the next log
    assert re.search("found (no regular file|something that is no file)", made.stderr)


def keys(count: int, form: str) -> bytes:
    return "".join(form.format(n) for n in range(count)).encode()


TEXTS: dict[str, bytes] = {
    "90 000 keys": keys(90_000, "k{}: 1\n"),
    "20 000 keys": keys(20_000, "k{}: 1\n"),
    "200 000 brackets": b"[" * 200_000,
    "100 000 dashes": b"- " * 100_000,
    "4000 digits": b"name: " + b"1" * 4000,
    "200 000 digits": b"name: 0x" + b"f" * 200_000,
    "digits of 60": b"name: 1" + b":1" * 100_000,
    "half a character": b'name: "\\ud800"',
    "a character beyond Unicode": b'name: "\\Uffffffff"',
    "control characters": b'name: "\\e[2J\\a"',
    "aliases": b"a: &a [1,1]\n" + keys(60, "k{0}: &k{0} [*a,*a]\n"),
    "aliases of aliases": b"a0: &a0 [1,1]\n"
    + b"".join(b"a%d: &a%d [*a%d,*a%d]\n" % (n, n, n - 1, n - 1) for n in range(1, 60)),
    "comments": b"#\n" * 120_000,
    "one text": b'name: "' + b"x " * 120_000 + b'"',
    "1 GB": b"",
}


@pytest.mark.parametrize("content", TEXTS)
@pytest.mark.parametrize("command", [("export-model",), ("bus-load", "--config")], ids=lambda words: words[0])
def test_decoding_is_linear_and_every_refusal_is_one_line(
    tmp_path: Path, content: str, command: tuple[str, ...]
) -> None:
    """Processor time: 10 000 values take PyYAML 0.5 s."""
    path = tmp_path / "x.yaml"
    path.write_bytes(TEXTS[content])
    if not TEXTS[content]:
        os.truncate(path, 1 << 30)
    made = run(tmp_path, *command, path, memory=8 << 30)
    one_line(made, made.returncode, str(path))
    assert made.returncode in (1, 2)
    assert len(made.stderr) < 1000
    assert made.processor_s < 3.5


def test_names_of_files_are_printed_without_control_characters(tmp_path: Path) -> None:
    path = tmp_path / f"run{ESCAPE}.mcap"
    path.write_bytes(b"no log")
    for command in ("replay", "export", "recover", "plot"):
        words = [each.format(path) for each in LOG_COMMANDS[command]]
        made = run(tmp_path, *words, memory=8 << 30, cwd=tmp_path)
        assert (made.returncode, made.stderr.count("\n")) == (1, 1), made.stderr
        assert "run?[2J?31m??.mcap" in made.stderr
    named = os.fsencode(tmp_path) + b"/\xff.yaml"
    one_line(run(tmp_path, "export-model", os.fsdecode(named)), 1, "cannot be read")


# ---- outputs ----

OUTPUTS: dict[str, tuple[str, ...]] = {
    "layout": ("layout", "--out", "{}"),
    "csv": ("export", "csv", str(LOG), "--out", "{}"),
    "dbc": ("export", "dbc", str(LOG), "--out", "{}"),
    "plot": ("plot", str(LOG), "--out", "{}"),
}


@pytest.mark.parametrize("command", OUTPUTS)
def test_an_output_goes_through_links_and_devices_and_replaces_files_only(
    tmp_path: Path, command: str
) -> None:
    """A link stays a link, dangling or not; a device stays a device, bare or behind a link; a file is replaced."""
    ending = ".png" if command == "plot" else f".{command}"
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / f"old{ending}").write_bytes(b"old")
    plain = tmp_path / f"plain{ending}"
    for name, target in (("old", f"there/old{ending}"), ("new", f"there/new{ending}"), ("null", "/dev/null")):
        (tmp_path / f"{name}{ending}").symlink_to(target)
    if os.getuid() == 0:
        os.mknod(tmp_path / f"node{ending}", stat.S_IFCHR | 0o666, os.makedev(1, 3))
    names = ["plain", "old", "new", "null", *(["node"] if os.getuid() == 0 else [])]
    for name in names:
        path = tmp_path / f"{name}{ending}"
        made = run(tmp_path, *(each.format(path) for each in OUTPUTS[command]), memory=8 << 30)
        assert made.returncode in (0, 3), made.stderr
        assert path.is_symlink() == (name in ("old", "new", "null"))
    assert len(plain.read_bytes()) > 300
    assert (tmp_path / "there" / f"old{ending}").read_bytes() == plain.read_bytes()
    assert (tmp_path / "there" / f"new{ending}").read_bytes() == plain.read_bytes()
    assert stat.S_ISCHR((tmp_path / f"null{ending}").stat().st_mode)
    if "node" in names:
        assert stat.S_ISCHR((tmp_path / f"node{ending}").lstat().st_mode)
    assert len([*tmp_path.iterdir()]) == 1 + len(names), "a temporary file is left"


def test_an_output_can_be_standard_output(tmp_path: Path) -> None:
    made = run(tmp_path, "export-model", shipped("joint1.yaml"), "--out", "/dev/stdout")
    assert made.stdout.startswith("<mujoco")
    made = run(tmp_path, "layout", "--out", "/dev/full")
    one_line(made, 1, "/dev/full: No space left on device")


@pytest.mark.parametrize("thing", ["dangling", "link to a device", "fifo", "socket"])
def test_replay_writes_new_files_only(tmp_path: Path, thing: str) -> None:
    path = tmp_path / "out.mcap"
    FILES[thing](path)
    before = path.lstat()
    one_line(run(tmp_path, "replay", LOG, "--out", path), 2, "exists already, expected a new file")
    assert path.lstat() == before
