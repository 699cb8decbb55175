"""Boot the bench kernel and run one command in it, with the host's files and without changing them."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from jtqd.sim_can.bench_kernel import build

INIT = Path(__file__).with_name("init.sh")
JOB_DIRECTORY = "JTQD_JOB"
"""Environment variable of the guest: directory whose writes are on the host when the system call returns."""
MARK = "JTQD_IN_BENCH_KERNEL"
"""Environment variable that is 1 inside the guest."""
TIME_TRAVEL_MARK = "JTQD_BENCH_TIME_TRAVEL"
"""Environment variable that is 1 inside a guest whose clock moves only when every process sleeps."""
DEFAULT_VCANS = ("vcan0", "vcan1")

_POLL_INTERVAL_S = 0.05
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
# These name places that the guest does not have, or that only the host's session may write.
_NOT_FORWARDED = ("HOME", "TMPDIR", "TMP", "TEMP", "OLDPWD", "PWD", "SHLVL", "_")


class GuestError(RuntimeError):
    """The guest did not boot or went down too early: the first line states why, then come the console's last lines."""


class GuestTimeoutError(GuestError):
    """The command did not end in the time it was given; the guest has been killed."""


@dataclass(frozen=True)
class Result:
    """What the command left: exit status (128 + n when signal n ended it) and its whole output."""

    returncode: int
    stdout: str
    stderr: str


def run(
    command: Sequence[str],
    *,
    time_travel: bool = False,
    timeout_s: float | None = None,
    out_dir: str | os.PathLike[str] | None = None,
    env: Mapping[str, str] | None = None,
    memory: str = "2G",
    sinks: tuple[IO[bytes], IO[bytes]] | None = None,
    systemd: bool = False,
) -> Result:
    """Run `command` in a guest of its own and return its result; arguments as in Guest.

    `sinks` receives standard output and standard error while the command runs.
    Raises GuestTimeoutError, GuestError, build.BuildError, build.MissingPackagesError.
    """
    with Guest(
        command, time_travel=time_travel, out_dir=out_dir, env=env, memory=memory, systemd=systemd
    ) as guest:
        return guest.wait(timeout_s, sinks)


class Guest:
    """One booted bench kernel that runs one command and goes down with it.

    command       program and arguments; runs as root in the guest
    time_travel   guest time advances only when every process sleeps: timers are exact, computing takes no time.
                  A loop that polls the clock without sleeping never ends in this mode.
    out_dir       directory of the host that the guest writes through to; everything else it writes is dropped
    env           set on top of the caller's environment (HOME is a fresh directory of the guest)
    directory     working directory (default: the caller's)
    memory        RAM of the guest; half of it and more can be taken by files that the guest writes
    vcans         CAN interfaces that are up when the command starts
    systemd       the host's systemd is PID 1 and runs the command as a unit; not together with time travel
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        time_travel: bool = False,
        out_dir: str | os.PathLike[str] | None = None,
        env: Mapping[str, str] | None = None,
        directory: str | os.PathLike[str] | None = None,
        memory: str = "2G",
        vcans: Sequence[str] = DEFAULT_VCANS,
        systemd: bool = False,
    ) -> None:
        kernel = build.ensure()
        self.command = tuple(command)
        self.job = Path(tempfile.mkdtemp(prefix="jtqd-guest-")).resolve()
        cwd = os.fspath(directory or os.getcwd())
        try:
            variables = guest_environment(os.environ, env or {}, time_travel=time_travel)
            (self.job / "command.sh").write_text(command_script(command, variables, cwd))
            (self.job / "out").write_text("" if out_dir is None else f"{_made(out_dir)}\n")
            (self.job / "uml").mkdir()
            self._console = open(self.job / "console.log", "wb")  # noqa: SIM115 (closed with the guest)
            arguments = kernel_arguments(self.job, memory, vcans, time_travel=time_travel, systemd=systemd)
            ram = memory_directory(memory, self.job)
            self._process = subprocess.Popen(
                [*_die_with_parent(), str(kernel), *arguments],
                env={"PATH": "/usr/bin:/bin", "HOME": str(self.job), "TMPDIR": ram},
                stdin=subprocess.DEVNULL,
                stdout=self._console,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except BaseException:
            shutil.rmtree(self.job, ignore_errors=True)
            raise

    def running(self) -> bool:
        """Return whether the guest is still up."""
        return self._process.poll() is None

    def wait(
        self, timeout_s: float | None = None, sinks: tuple[IO[bytes], IO[bytes]] | None = None
    ) -> Result:
        """Wait for the command's end (wall time in seconds; None: for ever) and return its result.

        Raises GuestTimeoutError after killing the guest, GuestError when it went down without a status.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        followers = [
            _follow(self.job / name, sink)
            for name, sink in zip(("stdout", "stderr"), sinks or (), strict=False)
        ]
        while True:
            running = self.running()
            for follow in followers:
                follow()
            if not running:
                return self._result()
            if deadline is not None and time.monotonic() > deadline:
                self.kill()
                raise GuestTimeoutError(
                    f"the bench kernel did not finish `{shlex.join(self.command)}` within {timeout_s:g} s "
                    f"and was killed{self._last_words()}"
                )
            time.sleep(_POLL_INTERVAL_S)

    def why(self) -> str:
        """Return why a guest that is not up any more went down, in one line."""
        return end_of_guest(_text(self.job / "console.log"), self._process.poll())

    def kill(self) -> None:
        """End the guest and all its host processes at once."""
        try:
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self._process.wait()

    def close(self) -> None:
        """Kill the guest if it is still up and remove its job directory."""
        self.kill()
        self._console.close()
        shutil.rmtree(self.job, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _result(self) -> Result:
        try:
            status = int((self.job / "status").read_text())
        except (OSError, ValueError):
            raise GuestError(f"the guest ended without a result: {self.why()}{self._last_words()}") from None
        return Result(status, _text(self.job / "stdout"), _text(self.job / "stderr"))

    def _last_words(self) -> str:
        lines = [f"  {name}: {line}" for name in ("console.log", "stderr") for line in _tail(self.job / name)]
        return "\n".join(["; last lines:", *lines]) if lines else ""


_CAUSES = (
    (r"jtqd: guest set-up failed: (.+)", "its set-up failed: {}"),
    (
        r"ptrace set fp regs failed, errno = (\d+)",
        "the kernel does not fit this processor's FPU registers (errno {})",
    ),
    (r"Kernel panic - not syncing: (.+)", "kernel panic: {}"),
    (r"Out of memory: (.+)", "out of memory: {}"),
    (
        r"(?:can't|cannot|couldn't|Failed to) (?:map|expand|create|write)[^\n]*(?:mem|physmem)[^\n]*",
        "not enough space for the guest's memory",
    ),
    (
        r"No space left on device",
        "not enough space for the guest's memory: /dev/shm or the temporary directory is full",
    ),
)
"""What the console shows, and what it means; the first that is found is the cause."""


def end_of_guest(console: str, status: int | None) -> str:
    """Return why a guest went down, in one line, from its console and the exit status of its kernel."""
    for pattern, meaning in _CAUSES:
        seen = re.search(pattern, console)
        if seen is not None:
            return meaning.format(*seen.groups()).strip()
    if status is not None and status < 0:
        return f"its kernel was ended by {signal.Signals(-status).name}"
    if not console.strip():
        return f"its kernel ended with status {status} before its first line"
    return f"its kernel ended with status {status} before the command did"


def guest_environment(
    host: Mapping[str, str], extra: Mapping[str, str], *, time_travel: bool
) -> dict[str, str]:
    """Environment of the command: the host's without places the guest lacks, this Python's programs first."""
    forwarded = {k: v for k, v in host.items() if k not in _NOT_FORWARDED and not k.startswith("XDG_")}
    path = [os.path.dirname(sys.executable), *host.get("PATH", "").split(":")]
    path += [p for p in ("/usr/local/bin", "/usr/bin", "/bin", "/usr/sbin", "/sbin") if p not in path]
    own = {"HOME": "/run/home", "PATH": ":".join(p for p in path if p), MARK: "1"}
    if time_travel:
        own[TIME_TRAVEL_MARK] = "1"
    return {**forwarded, **own, **extra}


def command_script(command: Sequence[str], variables: Mapping[str, str], directory: str) -> str:
    """Shell script that sets the variables, enters the directory and becomes the command."""
    lines = [f"export {name}={shlex.quote(value)}" for name, value in variables.items() if _NAME.match(name)]
    return "\n".join([*lines, f"cd {shlex.quote(directory)} || exit 125", f"exec {shlex.join(command)}", ""])


def kernel_arguments(
    job: Path, memory: str, vcans: Sequence[str], *, time_travel: bool, systemd: bool = False
) -> list[str]:
    """Command line of the kernel; what it does not know itself it hands to init as environment."""
    return [
        f"mem={memory}",
        *(["time-travel=inf-cpu"] if time_travel else []),
        f"umid={job.name}",
        f"uml_dir={job}/uml/",
        "root=/dev/root",
        "rootfstype=hostfs",
        "rootflags=/",
        "rw",
        "con=null",
        "con0=fd:0,fd:1",
        "quiet",
        f"JTQD_JOB={job}",
        f"JTQD_VCANS={','.join(vcans)}",
        f"JTQD_PYTHON={sys.executable}",
        *(["JTQD_SYSTEMD=1"] if systemd else []),
        "init=/bin/sh",
        "--",
        str(INIT),
    ]


def memory_directory(memory: str, fallback: Path, shared: str = "/dev/shm") -> str:
    """Return where the guest's RAM lies as a sparse file: shared memory if it has the room and may be executed."""
    factor = {"K": 2**10, "M": 2**20, "G": 2**30}.get(memory[-1:].upper())
    size = int(memory[:-1]) * factor if factor else int(memory)
    try:
        room = os.statvfs(shared)
    except OSError:
        return str(fallback)
    fits = room.f_bavail * room.f_frsize > size and not room.f_flag & os.ST_NOEXEC
    return shared if fits and os.access(shared, os.W_OK) else str(fallback)


def _made(directory: str | os.PathLike[str]) -> Path:
    path = Path(directory).resolve()
    path.mkdir(parents=True, exist_ok=True)
    return path


def _die_with_parent() -> list[str]:
    """Prefix that kills the kernel when this process is killed, so that no guest spins on for ever."""
    setpriv = shutil.which("setpriv", path="/usr/bin:/bin")
    return [setpriv, "--pdeathsig", "TERM"] if setpriv else []


def _follow(path: Path, sink: IO[bytes]) -> Callable[[], None]:
    """Return a function that copies to `sink` what has been added to the file since its last call."""
    offset = 0

    def copy() -> None:
        nonlocal offset
        try:
            with open(path, "rb") as file:
                file.seek(offset)
                new = file.read()
        except FileNotFoundError:
            return
        offset += len(new)
        if new:
            sink.write(new)
            sink.flush()

    return copy


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _tail(path: Path, count: int = 8) -> list[str]:
    return [line for line in _text(path).splitlines() if line.strip()][-count:]
