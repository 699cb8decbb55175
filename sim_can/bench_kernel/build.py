"""Build the bench kernel once and keep it in the user's cache, outside the checkout; the packages that it needs."""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

# Debian packages

SOURCE_PACKAGE = "linux-source-6.1"
SOURCE_ARCHIVE = f"/usr/src/{SOURCE_PACKAGE}.tar.xz"


Requirements = dict[str, str]
"""Debian packages, each with the program (bare name) or file (absolute path) that shows it is there."""
BUILD: Requirements = {
    SOURCE_PACKAGE: SOURCE_ARCHIVE,
    "gcc": "gcc",
    "libc6-dev": "/usr/include/stdio.h",
    "make": "make",
    "flex": "flex",
    "bison": "bison",
    "bc": "bc",
    "libelf-dev": "/usr/include/libelf.h",
    "xz-utils": "xz",
}
GUEST: Requirements = {"iproute2": "ip"}
TESTS: Requirements = {"can-utils": "candump"}
SYSTEMD: Requirements = {
    "systemd": "/lib/systemd/systemd",
    "udev": "/lib/systemd/systemd-udevd",
    "dbus": "/usr/bin/dbus-daemon",
    "python3-venv": "/usr/bin/python3",
}


class MissingPackagesError(RuntimeError):
    """Packages are needed that are not installed and may not be installed by this user."""

    def __init__(self, packages: Iterable[str]) -> None:
        self.packages = tuple(packages)
        names = " ".join(self.packages)
        need = f"the bench kernel needs Debian packages that are not installed: {names}"
        super().__init__(f"{need}; install them with: sudo apt-get install {names}")


def find_program(name: str) -> str | None:
    """Path of a program; looks into the sbin directories too, which are not in every user's PATH."""
    return shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin:/usr/bin:/bin")


def missing(
    requirements: Requirements,
    which: Callable[[str], str | None] = find_program,
    exists: Callable[[str], bool] = os.path.exists,
) -> list[str]:
    """Return names of the packages whose program or file is not there, in the order of `requirements`."""
    there = {name: exists(proof) if proof[0] == "/" else which(proof) for name, proof in requirements.items()}
    return [name for name, found in there.items() if not found]


def require(requirements: Requirements, *, install: bool = True) -> None:
    """Make sure that all packages are there; as root, install what is not.

    Raises MissingPackagesError when packages are missing and this user may not install them (or `install` is
    false), RuntimeError when apt-get fails.
    """
    lacking = missing(requirements)
    if not lacking:
        return
    if not install or os.geteuid() != 0 or find_program("apt-get") is None:
        raise MissingPackagesError(lacking)
    print(f"bench kernel: apt-get install {' '.join(lacking)}", file=sys.stderr, flush=True)
    _apt_get("update")
    # Recommended packages are left out: those of linux-source alone are several hundred megabytes.
    _apt_get("install", "-y", "--no-install-recommends", *lacking)
    if still := missing(requirements):
        raise MissingPackagesError(still)


def _apt_get(*arguments: str) -> None:
    done = subprocess.run(
        ["apt-get", "-q", *arguments],
        env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode != 0:
        last = "\n".join(done.stdout.splitlines()[-15:])
        raise RuntimeError(f"apt-get {' '.join(arguments)} failed with status {done.returncode}:\n{last}")


# The host's own kernel


def vcan_ready(name: str = "vcan0") -> bool:
    """Return whether a raw CAN socket can be bound to the interface and the interface is up."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((name,))
        with open(f"/sys/class/net/{name}/flags") as flags:
            return bool(int(flags.read(), 16) & 1)  # IFF_UP
    except OSError:
        return False


def ensure_vcan(name: str = "vcan0") -> bool:
    """Like vcan_ready(); as root, the interface is created and brought up first where the kernel can do that."""
    if vcan_ready(name):
        return True
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    ip = find_program("ip")
    if ip is None or os.geteuid() != 0:
        return False
    for arguments in (
        ("link", "add", "dev", name, "type", "vcan"),
        ("link", "set", name, "txqueuelen", "1000", "up"),
    ):
        subprocess.run([ip, *arguments], capture_output=True, check=False)
    return vcan_ready(name)


# The build

CONFIG_FILE = Path(__file__).with_name("bench_kernel.config")
OVERRIDE = "JTQD_BENCH_KERNEL"
"""Environment variable: path of a ready-made kernel binary, used as it is."""


@dataclass(frozen=True)
class Edit:
    """In `file`, below the kernel's tree, `found` stands exactly once and becomes `put`."""

    file: str
    found: str
    put: str


EDITS = (
    # The host's ptrace takes a thread's FPU registers back only whole (EFAULT otherwise), and on a processor with AMX they
    # are 11 008 bytes: `userspace - ptrace set fp regs failed, errno = 14`, and the first process of the guest is dead.
    # The same buffer lies below the kernel stack, which is why the configuration asks for CONFIG_KERNEL_STACK_ORDER=3.
    Edit(
        "arch/x86/um/user-offsets.c",
        "DEFINE_LONGS(HOST_FP_SIZE, 2696);",
        "DEFINE_LONGS(HOST_FP_SIZE, 12288);",
    ),
    # A page fault takes the host four switches of processes, and a start of Python some thousands of faults. With one come
    # the pages around it that are in memory, as on any machine, here at once for the host as well; and with a first write
    # to a private page those that follow.
    Edit(
        "arch/um/kernel/trap.c",
        "\tflush_tlb_page(vma, address);\n",
        "\n\tif (is_write && !(vma->vm_flags & VM_SHARED))\n"
        "\t\tfor (unsigned long near = (address & PAGE_MASK) + PAGE_SIZE;\n"
        "\t\t     near < min(vma->vm_end, (address | 0xffffUL) + 1); near += PAGE_SIZE)\n"
        "\t\t\tif (pte_none(*pte_offset_kernel(pmd, near)) &&\n"
        "\t\t\t    handle_mm_fault(vma, near, FAULT_FLAG_WRITE | (flags & FAULT_FLAG_USER), NULL)"
        " & VM_FAULT_ERROR)\n"
        "\t\t\t\tbreak;\n"
        "\tflush_tlb_range(vma, max(vma->vm_start, address & ~0x3ffffUL),"
        " min(vma->vm_end, (address | 0x3ffffUL) + 1));\n",
    ),
    Edit("mm/memory.c", "rounddown_pow_of_two(65536);", "rounddown_pow_of_two(262144);"),
)


class EditError(RuntimeError):
    """The sources are not those that an edit was made for."""


def apply_edits(tree: Path, edits: tuple[Edit, ...] = EDITS) -> None:
    """Change the sources below `tree`. Raises EditError."""
    for edit in edits:
        path = tree / edit.file
        text = path.read_text() if path.is_file() else ""
        if text.count(edit.found) != 1:
            raise EditError(
                f"{edit.file}: `{edit.found}` found {text.count(edit.found)} times, expected once"
            )
        path.write_text(text.replace(edit.found, edit.put))


_MAKE_ARCH = ("ARCH=um", "SUBARCH=x86_64")
_PROGRESS_INTERVAL_S = 10.0
_FILES = 660
"""Files that this configuration compiles, about: what progress is measured by."""


class BuildError(RuntimeError):
    """The kernel could not be built; the message names the log."""


def cache_root() -> Path:
    """Return the directory that holds every cached kernel: ${XDG_CACHE_HOME:-~/.cache}/jtqd."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "jtqd"


def recipe() -> bytes:
    """Return all that makes one build from the same sources differ from another: configuration and edits."""
    return CONFIG_FILE.read_bytes() + b"\0" + repr(EDITS).encode()


def cache_key(recipe: bytes, source_version: str) -> str:
    """Name of a build: changes with every byte of the recipe and with the source package's version."""
    return hashlib.sha256(recipe + b"\0" + source_version.encode()).hexdigest()[:16]


def recipe_key(recipe: bytes) -> str:
    """Name of a recipe alone; finds a cached kernel where the source package is not installed."""
    return hashlib.sha256(recipe).hexdigest()[:16]


def wanted_options(config: str) -> list[str]:
    """Return the lines `CONFIG_X=y` and `CONFIG_X=5` of a configuration (fragment or full)."""
    lines = (line.strip() for line in config.splitlines())
    return [line for line in lines if line.startswith("CONFIG_") and not line.endswith("=n")]


def cached(recipe: bytes, source_version: str | None, root: Path) -> Path | None:
    """Return the cached binary of this recipe and source version, or None.

    Without an installed source package (version None) the newest cached kernel of this recipe serves.
    """
    if source_version is not None:
        binary = root / f"bench-kernel-{cache_key(recipe, source_version)}" / "linux"
        return binary if binary.exists() else None
    same = [
        mark.with_name("linux")
        for mark in root.glob("bench-kernel-*/recipe.key")
        if mark.read_text().strip() == recipe_key(recipe) and mark.with_name("linux").exists()
    ]
    return max(same, key=lambda binary: binary.stat().st_mtime, default=None)


def find() -> Path | None:
    """Path of the ready kernel binary, or None when it has to be built first.

    Raises BuildError when the environment variable JTQD_BENCH_KERNEL names no executable file.
    """
    override = os.environ.get(OVERRIDE)
    if override is None:
        return cached(recipe(), _source_version(), cache_root())
    if not os.access(override, os.X_OK):
        raise BuildError(f"{OVERRIDE}={override}: no such executable file")
    return Path(override)


def needs() -> Requirements:
    """Packages that a guest needs, and where no kernel is ready, those that it is built with.

    Raises BuildError when it has to be built and is not built for this processor.
    """
    if find() is not None:
        return GUEST
    if platform.machine() != "x86_64":
        raise BuildError(f"the bench kernel is built for x86_64 only, this machine is {platform.machine()}")
    return BUILD | GUEST


def ensure(*, install: bool = True) -> Path:
    """Path of the kernel binary; built first when it is not in the cache (2 to 5 minutes).

    Raises MissingPackagesError naming what is missing and may not be installed, BuildError when the
    build fails.
    """
    require(needs(), install=install)
    ready = find()
    if ready is not None:
        return ready
    version = _source_version()
    if version is None:
        raise BuildError(f"{SOURCE_ARCHIVE} exists but dpkg has no package {SOURCE_PACKAGE}")
    root = cache_root()
    root.mkdir(parents=True, exist_ok=True)
    with _only_builder(root):
        ready = cached(recipe(), version, root)  # another builder may have finished while this one waited
        return ready if ready is not None else _build(version, root)


def _source_version() -> str | None:
    """Installed version of the kernel source package, or None."""
    if find_program("dpkg-query") is None:
        return None
    done = subprocess.run(
        ["dpkg-query", "-W", "-f", "${db:Status-Status} ${Version}", SOURCE_PACKAGE],
        capture_output=True,
        text=True,
        check=False,
    )
    status, _, version = done.stdout.strip().partition(" ")
    return version if done.returncode == 0 and status == "installed" else None


@contextmanager
def _only_builder(root: Path) -> Iterator[None]:
    with open(root / "bench-kernel.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _say("another build is running, waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _build(version: str, root: Path) -> Path:
    """Build in a temporary directory beside the final one and move the result in by one rename."""
    final = root / f"bench-kernel-{cache_key(recipe(), version)}"
    for stale in root.glob("building-*"):  # of a builder that was killed: this one holds the lock
        shutil.rmtree(stale, ignore_errors=True)
    work = Path(tempfile.mkdtemp(prefix="building-", dir=root))
    log = work / "build.log"
    started = time.monotonic()
    try:
        with open(log, "w") as out:
            tree = _unpack(work, version, out)
            apply_edits(tree)
            _configure(tree, CONFIG_FILE.read_bytes(), out)
            _compile(tree, log, out)
        done = work / "done"
        done.mkdir()
        shutil.copy2(tree / "linux", done / "linux")
        shutil.copy2(tree / ".config", done / "config")
        shutil.copy2(log, done / "build.log")
        (done / "recipe.key").write_text(recipe_key(recipe()) + "\n")
        shutil.rmtree(final, ignore_errors=True)
        done.rename(final)
    except EditError as error:
        raise BuildError(f"{SOURCE_ARCHIVE} ({version}) does not fit: {error}") from error
    except subprocess.CalledProcessError as error:
        kept = root / f"{final.name}.failed.log"
        shutil.copy2(log, kept)
        last = "\n".join(kept.read_text(errors="replace").splitlines()[-10:])
        command = " ".join(map(str, error.cmd))
        raise BuildError(f"`{command}` failed with status {error.returncode}; log: {kept}\n{last}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    _say(f"built in {time.monotonic() - started:.0f} s: {final / 'linux'}")
    return final / "linux"


def _unpack(work: Path, version: str, out: IO[str]) -> Path:
    _say(f"unpacking {SOURCE_ARCHIVE} ({version})")
    _logged(["tar", "-xJf", SOURCE_ARCHIVE, "-C", str(work)], out)
    return work / SOURCE_PACKAGE


def _logged(command: list[str], out: IO[str], cwd: Path | None = None) -> None:
    env = _clean_environment()
    subprocess.run(command, cwd=cwd, env=env, stdout=out, stderr=subprocess.STDOUT, check=True)


def _configure(tree: Path, config: bytes, out: IO[str]) -> None:
    _say("configuring")
    fragment = tree.parent / "fragment.config"
    fragment.write_bytes(config)
    _logged(["make", *_MAKE_ARCH, "allnoconfig", f"KCONFIG_ALLCONFIG={fragment}"], out, tree)
    arrived = set(wanted_options((tree / ".config").read_text()))
    refused = [option for option in wanted_options(config.decode()) if option not in arrived]
    if refused:
        raise BuildError(f"this kernel source rejects options of {CONFIG_FILE.name}: {' '.join(refused)}")


def _compile(tree: Path, log: Path, out: IO[str]) -> None:
    jobs = len(os.sched_getaffinity(0))
    _say(f"compiling with {jobs} jobs (2 to 5 minutes, once); log: {log}")
    command = ["make", *_MAKE_ARCH, f"-j{jobs}", "linux"]
    started = time.monotonic()
    process = subprocess.Popen(
        command, cwd=tree, env=_clean_environment(), stdout=out, stderr=subprocess.STDOUT
    )
    try:
        while process.poll() is None:
            try:
                process.wait(_PROGRESS_INTERVAL_S)
            except subprocess.TimeoutExpired:
                compiled = log.read_text(errors="replace").count("  CC ")
                share = min(compiled / _FILES, 0.99)
                _say(f"{share:4.0%}  {compiled} of about {_FILES} files, {time.monotonic() - started:.0f} s")
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()
    if process.returncode != 0:
        raise subprocess.CalledProcessError(process.returncode, command)


def _clean_environment() -> dict[str, str]:
    """Return the environment without what a calling `make` or a shell could leak into the kernel's makefiles."""
    leaks = (
        "MAKEFLAGS",
        "MFLAGS",
        "MAKELEVEL",
        "MAKEOVERRIDES",
        "CFLAGS",
        "LDFLAGS",
        "ARCH",
        "CROSS_COMPILE",
    )
    return {name: value for name, value in os.environ.items() if name not in leaks}


def _say(text: str) -> None:
    print(f"bench kernel: {text}", file=sys.stderr, flush=True)
