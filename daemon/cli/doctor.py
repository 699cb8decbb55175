"""`jtq doctor`: examine whether this machine is suitable for jtqd: kernel, rights, CAN interface, files, packages.

An interface is judged by /sys and by the output of `ip`. Nothing is changed.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
import time
from base64 import urlsafe_b64decode
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distributions, requires
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from jtqd import __version__
from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult, judge, report
from jtqd.daemon.cli.running import DaemonSearch, find_daemons, places
from jtqd.daemon.config import Config, Realtime, load_config
from jtqd.daemon.loop.process import build_estimator
from jtqd.daemon.shared.runtime_dir import installed
from jtqd.drivers.bus_load import BusLoadError, check_bus_load
from jtqd.drivers.bus_socket import AF_CAN, CAN_RAW
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import read_file
from jtqd.estimator.network import NetworkError
from jtqd.estimator.text import percent, size

SCHEMA = "jtq.doctor/1"
_EXAMPLES = """examples:
  jtq doctor                                          all CAN interfaces of this machine, the shipped configuration
  jtq doctor --bus can0 --config /etc/jtqd/can0.yaml
  sudo -u jtqd jtq doctor --bus can0                  as jtqd's user: the rights of the caller are checked
  jtq doctor --json | jq '.items[] | select(.level == "FAIL")'

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_LOCKED_BYTES = 256 << 20
"""Memory of the loop at its start, with a margin."""
_SLOW_CLOCK_NS = 1_000
_GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "unknown")
_SYS = Path("/sys/devices/system")
_NET = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_QUEUE = 100
"""Frames; the default of 10 overflows when one cycle meets SDO traffic."""
_BUS_STATE_COUNTS = ("error_warning", "error_passive", "bus_off")
_DROP_COUNTS = ("rx_dropped", "tx_dropped", "rx_over_errors", "tx_errors", "rx_errors")
_UNITS = (
    "/etc/systemd/system",
    "/run/systemd/system",
    "/usr/local/lib/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
)
_UNIT = "jtqd@.service"
_MD5SUMS = Path("/var/lib/dpkg/info/jtqd.md5sums")
_USUAL_LOGS = Path("/var/log/jtqd")
_LOG_FREE = 10 << 30
"""A working day of recording."""
_SHM_FREE = 64 << 20
_BYTES_AN_HOUR = 1_100_000_000


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq doctor`."""
    result = command_parser(
        "jtq doctor",
        "Examine whether this machine is suitable for jtqd: GOOD, WARN or FAIL for each item, with a remedy. "
        "Nothing is changed.",
        _EXAMPLES,
    )
    add = result.add_argument
    add("--bus", help="interface, unix:PATH or sim (default: every CAN interface)")
    add("--config", type=Path, metavar="FILE", help="configuration (default: the shipped bench)")
    add("--record", type=Path, metavar="DIR", help="directory of the logs (default: that of jtqd)")
    add("--json", action="store_true", help="print as JSON")
    return result


def main(argv: list[str]) -> int:
    """Examine and report; return the exit status."""
    arguments = parser().parse_args(argv)
    results = list(_examine(arguments.bus, arguments.config, arguments.record or _log_directory()))
    return report(results, SCHEMA if arguments.json else None, bus=arguments.bus)


def _examine(bus: str | None, path: Path | None, log: Path | None) -> Iterator[CheckResult]:
    """Run every check. An unreadable configuration is one failure; the shipped one is used instead."""
    broken = ""
    try:
        config = load_config(path)
    except ConfigError as error:
        broken, config = str(error), load_config(None)
    needs_can = bus is None or not (bus == "sim" or bus.startswith("unix:"))
    yield from check_kernel(config.realtime, can=needs_can)
    yield from check_can(bus, config)
    if broken:
        yield CheckResult("configuration", FAIL, broken, "jtqd will not start with it")
    else:
        yield from _files(config)
    yield from check_directories(log, places())
    yield _packages()
    yield _installed_files(Path(__file__))
    yield _unit()
    yield from _remains(log, find_daemons())


def _log_directory() -> Path | None:
    """Return the directory that jtqd would write to, as far as it does not depend on the working directory."""
    named = os.environ.get("LOGS_DIRECTORY", "").split(":")[0]
    return Path(named) if named else _USUAL_LOGS if _USUAL_LOGS.exists() else None


# ---- kernel and rights ----


def check_kernel(wanted: Realtime, *, can: bool) -> Iterator[CheckResult]:
    """Check the kernel and the rights of this user; can: SocketCAN is required."""
    yield _kernel()
    yield _timers()
    yield _clocksource()
    yield _can_sockets(required=can)
    yield _priority(wanted)
    yield _throttling(wanted)
    yield _memory(wanted)
    yield _cpu(wanted)
    yield _governor()


def _read(path: str | Path) -> str:
    """Return the content of a file, "" if it cannot be read."""
    with suppress(OSError):
        return Path(path).read_text(errors="replace").strip()
    return ""


def _kernel() -> CheckResult:
    version, text = platform.version(), f"Linux {platform.release()} {platform.machine()}"
    if _read("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return CheckResult("kernel", GOOD, f"{text}, PREEMPT_RT")
    kind = next((each for each in ("PREEMPT_DYNAMIC", "PREEMPT") if each in version), "no preemption")
    hint = (
        "not a real-time kernel: a driver may delay the loop by milliseconds; `jtq check` measures how often"
    )
    return CheckResult("kernel", WARN, f"{text}, {kind}", hint)


def _timers() -> CheckResult:
    options = _read(f"/boot/config-{platform.release()}")
    with suppress(OSError, EOFError), gzip.open("/proc/config.gz", "rt") as file:
        options = file.read()
    hz = re.search(r"^CONFIG_HZ=(.*)$", options, re.MULTILINE)
    shown = f"HZ {hz[1]}" if hz else "HZ unknown (the kernel does not publish its configuration)"
    resolution = time.clock_getres(time.CLOCK_MONOTONIC)
    if resolution <= 1e-6:
        return CheckResult("timers", GOOD, f"high resolution ({resolution * 1e9:.0f} ns), {shown}")
    text = f"resolution {resolution * 1e3:.3g} ms, {shown}"
    return CheckResult("timers", FAIL, text, "CONFIG_HIGH_RES_TIMERS, and no `highres=off`")


def _clocksource() -> CheckResult:
    name = _read(_SYS / "clocksource/clocksource0/current_clocksource") or "unknown"
    others = _read(_SYS / "clocksource/clocksource0/available_clocksource") or "unknown"
    count, start = 2000, time.perf_counter_ns()
    for _ in range(count):
        time.monotonic_ns()
    each_ns = (time.perf_counter_ns() - start) / count
    slow = f"the loop reads it ten times a cycle; available: {others}"
    return judge(
        "clocksource",
        f"{name}, {each_ns:.0f} ns for a reading",
        (each_ns > _SLOW_CLOCK_NS, WARN, slow),
        (name not in _GOOD_CLOCKS, WARN, "stability unknown: see `clocksource` in the kernel log"),
    )


def _can_sockets(*, required: bool) -> CheckResult:
    try:
        socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW).close()
    except OSError as error:
        text = f"AF_CAN: {error.strerror} (errno {error.errno})"
        if not required:
            return CheckResult("SocketCAN", SKIP, f"{text}; not needed")
        hint = "modprobe can can_raw; or a kernel with CONFIG_CAN and CONFIG_CAN_RAW; in systemd, RestrictAddressFamilies"
        return CheckResult("SocketCAN", FAIL, text, hint)
    return CheckResult("SocketCAN", GOOD, "raw CAN sockets can be opened")


def _capability(number: int) -> bool:
    match = re.search(r"^CapEff:\s*([0-9a-f]+)", _read("/proc/self/status"), re.MULTILINE)
    return bool(match and int(match[1], 16) >> number & 1)


def _priority(wanted: Realtime) -> CheckResult:
    if not wanted.priority:
        text = "not requested by the configuration (realtime.priority 0)"
        return CheckResult("SCHED_FIFO", WARN, text, "80 is the default")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    limit_text = f"RLIMIT_RTPRIO {'unlimited' if limit == resource.RLIM_INFINITY else limit}"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority))
    except OSError as error:
        text = f"priority {wanted.priority} is refused to this user: {error.strerror}; {limit_text}"
        hint = "LimitRTPRIO= in the unit, or /etc/security/limits.d: `jtqd - rtprio 80`"
        return CheckResult("SCHED_FIFO", FAIL, text, hint)
    os.sched_setscheduler(0, *before)
    how = "CAP_SYS_NICE" if _capability(_CAP_SYS_NICE) else limit_text
    return CheckResult("SCHED_FIFO", GOOD, f"priority {wanted.priority} is granted to this user by {how}")


def _throttling(wanted: Realtime) -> CheckResult:
    runtime, period = (_read(f"/proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
    if not runtime or not period:
        return CheckResult("RT throttling", SKIP, "not reported by the kernel")
    if int(runtime) < 0:
        return CheckResult("RT throttling", GOOD, "off: a real-time process may take a whole CPU")
    text = f"real-time processes get {int(runtime) / 1000:.0f} of {int(period) / 1000:.0f} ms"
    if wanted.priority and int(runtime) < 0.9 * int(period):
        hint = "sysctl kernel.sched_rt_runtime_us=950000: otherwise the loop is stopped"
        return CheckResult("RT throttling", FAIL, text, hint)
    return CheckResult("RT throttling", GOOD, f"{text}: far more than the loop needs")


def _memory(wanted: Realtime) -> CheckResult:
    if not wanted.lock_memory:
        hint = "realtime: {lock_memory: true}"
        return CheckResult("locked memory", WARN, "not requested by the configuration", hint)
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit == resource.RLIM_INFINITY or _capability(_CAP_IPC_LOCK):
        return CheckResult("locked memory", GOOD, "unlimited for this user")
    hint = "LimitMEMLOCK=infinity in the unit: a page fault delays a cycle"
    text = f"RLIMIT_MEMLOCK {limit >> 20} MiB for this user"
    return judge("locked memory", text, (limit < _LOCKED_BYTES, FAIL, hint))


def _cpus(text: str) -> set[int]:
    """Parse a CPU list of the kernel, "0-2,5"."""
    cpus: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        cpus |= set(range(int(first), int(last or first) + 1))
    return cpus


def _cpu(wanted: Realtime) -> CheckResult:
    isolated = _read(_SYS / "cpu/isolated")
    if wanted.cpu is None:
        text = f"any of {len(os.sched_getaffinity(0))}" + (f"; isolated: {isolated}" if isolated else "")
        hint = f"realtime: {{cpu: {min(_cpus(isolated))}}} would use the isolated one" if isolated else ""
        return judge("CPU", text, (hint, WARN, hint))
    text = f"{wanted.cpu} by the configuration"
    if wanted.cpu not in _cpus(_read(_SYS / "cpu/online")):
        return CheckResult("CPU", FAIL, f"{text}: does not exist", "realtime.cpu")
    if wanted.cpu in _cpus(isolated):
        return CheckResult("CPU", GOOD, f"{wanted.cpu}, isolated")
    text += f", shared with other processes (isolated: {isolated or 'none'})"
    return CheckResult("CPU", WARN, text, f"isolcpus={wanted.cpu} on the kernel command line reserves it")


def _governor() -> CheckResult:
    governors = {_read(path) for path in _SYS.glob("cpu/cpu[0-9]*/cpufreq/scaling_governor")} - {""}
    text = f"governor {', '.join(sorted(governors))}"
    hint = "cpupower frequency-set -g performance: a slow clock makes a cycle long"
    return judge(
        "cpufreq",
        text if governors else "the kernel does not scale the frequency",
        (governors - {"performance"}, WARN, hint),
    )


# ---- CAN interfaces ----


def check_can(bus: str | None, config: Config) -> Iterator[CheckResult]:
    """Check the bus; None: all CAN interfaces."""
    here = sorted(path.parent.name for path in _NET.glob("*/type") if _read(path) == _ARPHRD_CAN)
    if bus is None:
        if not here:
            hint = "connect one; `ip link add dev vcan0 type vcan` for a test"
            yield CheckResult("CAN interface", WARN, "none on this machine", hint)
        for name in here:
            yield from _interface(name, config)
    elif bus == "sim":
        yield CheckResult("CAN interface", SKIP, "the emulated bench needs none")
    elif bus.startswith("unix:"):
        yield _hub(bus)
    elif not (_NET / bus).exists():
        text = f"no such interface; CAN interfaces here: {', '.join(here) or 'none'}"
        yield CheckResult(bus, FAIL, text, "check driver and name")
    elif bus not in here:
        yield CheckResult(bus, FAIL, "not a CAN interface")
    else:
        yield from _interface(bus, config)


def _hub(bus: str) -> CheckResult:
    try:
        open_frame_socket(bus, []).close()
    except BusError as error:
        hint = "start its hub: `jtq sim --bus unix:PATH`, or python -m jtqd.drivers.hub"
        return CheckResult("bus", FAIL, str(error), hint)
    return CheckResult("bus", GOOD, f"{bus}: the hub answers")


def link_of(name: str) -> dict[str, Any]:
    """Return the output of `ip -details -statistics link` for an interface; {} without ip or interface."""
    command = ["ip", "-json", "-details", "-statistics", "link", "show", name]
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
        return dict(json.loads(done.stdout)[0])
    return {}


def _interface(name: str, config: Config) -> Iterator[CheckResult]:
    link = link_of(name)
    info = link.get("linkinfo", {})
    kind, bitrate = info.get("info_kind", "CAN"), config.bitrate
    up = int(_read(_NET / name / "flags") or "0", 16) & 1
    down = f"ip link set {name} up type can bitrate {bitrate} restart-ms 100"
    yield judge(name, f"up, {kind}" if up else "down", (not up, FAIL, down))
    queue = int(_read(_NET / name / "tx_queue_len") or "0")
    short = f"ip link set {name} txqueuelen 1000: a short queue loses frames when the bus is busy"
    yield judge(f"{name} queue", f"txqueuelen {queue}", (queue < _QUEUE, WARN, short))
    if not link:
        text = "`ip` is missing, so bit rate and state are unknown"
        yield CheckResult(f"{name} wire", SKIP, text, "install iproute2")
    elif kind == "vcan":
        yield CheckResult(f"{name} wire", SKIP, "virtual: no bit rate, no arbitration, no errors")
    else:
        yield from _controller(name, info.get("info_data", {}), info.get("info_xstats", {}), bitrate)
    counts = {each: int(_read(_NET / name / "statistics" / each) or "0") for each in _DROP_COUNTS}
    if any(counts.values()):
        text = ", ".join(f"{each} {count}" for each, count in counts.items() if count)
        hint = "queue too short, or controller overruns"
        yield CheckResult(f"{name} drops", WARN, f"{text} since the interface exists", hint)


def _controller(
    name: str, data: dict[str, Any], counts: dict[str, int], wanted: int
) -> Iterator[CheckResult]:
    """Check bit rate, restart and error state; data, counts: of `ip`; wanted: bit rate of the configuration."""
    bitrate, restart = data.get("bittiming", {}).get("bitrate", 0), data.get("restart_ms", 0)
    wrong = f"the configuration has {wanted}: ip link set {name} type can bitrate {wanted}"
    stays_off = f"ip link set {name} type can restart-ms 100: otherwise it stays off after a bus-off"
    text = f"{bitrate} bit/s, restart-ms {restart}"
    yield judge(f"{name} wire", text, (bitrate != wanted, FAIL, wrong), (not restart, WARN, stays_off))
    state, errors = str(data.get("state", "unknown")), data.get("berr_counter", {})
    seen = ", ".join(
        f"{each.replace('_', ' ')} {counts[each]}" for each in _BUS_STATE_COUNTS if counts.get(each)
    )
    text = f"{state}, error counters tx {errors.get('tx', '?')} rx {errors.get('rx', '?')}"
    dead = "check wiring, termination, bit rate, and that another node is powered"
    yield judge(
        f"{name} state",
        f"{text}; {seen}" if seen else text,
        (state in ("BUS-OFF", "ERROR-PASSIVE"), FAIL, dead),
        (state != "ERROR-ACTIVE" or seen, WARN, "errors occurred: check wiring, termination, sample point"),
    )


# ---- files, directories, packages ----


def _files(config: Config) -> Iterator[CheckResult]:
    """Check the files that a configuration names, by their use; the configuration itself is read already."""
    method, load = config.estimator.method, bus_load_of(config)
    yield CheckResult("configuration", GOOD, f"{config.path}, sha256 {config.sha256[:12]}, method {method}")
    try:
        check_bus_load(load)
        yield CheckResult("bus load", GOOD, f"{percent(load.worst)} in the worst case (`jtq bus-load`)")
    except BusLoadError as error:
        yield CheckResult("bus load", FAIL, str(error), "`jtq bus-load` shows the share of each sender")
    for joint in config.joints:
        item = f"joint {joint.number}"
        try:
            for each in (config, *config.shadows):
                built = build_estimator(each, each.joints[joint.number - 1], shadow=each is not config)
                built.step(1e-3, 0.1, 0.0, 1.0, 0.0, 25.0)
        except (ConfigError, NetworkError) as error:
            yield CheckResult(item, FAIL, str(error), "jtqd will not start with it")
            continue
        network = f"{joint.network.path.name} {joint.network.sha256[:12]}" if joint.network else "no network"
        file = f"{joint.joint_path.name} {joint.joint_sha256[:12]}"
        yield CheckResult(item, GOOD, f"{joint.joint.name}: {file}, {network}: loads and runs")


def check_directories(log: Path | None, roots: list[Path]) -> Iterator[CheckResult]:
    """Check the directories of logs and shared memory for this user; log None: none is named."""
    if log is None:
        text = "jtqd writes to ./logs without --record DIR or $LOGS_DIRECTORY"
        yield CheckResult("log directory", SKIP, text)
    else:
        yield _directory("log directory", log, _LOG_FREE, f"an hour takes up to {size(_BYTES_AN_HOUR)}")
    yield _directory("shared memory", roots[0], _SHM_FREE, "ring and snapshot of a daemon take 3 MB")


def _directory(item: str, path: Path, wanted: int, use: str) -> CheckResult:
    parents = (path, *path.absolute().parents)
    existing = next(each for each in parents if os.path.exists(each))  # not in a closed one
    if not os.access(existing, os.W_OK | os.X_OK):
        text = f"{path}: not writable for this user"
        return CheckResult(item, FAIL, text, "owner and mode; LogsDirectory= in the unit")
    free = shutil.disk_usage(existing).free
    text = f"{path}: {size(free)} free, {use}" + ("; it will be created" if existing != path else "")
    hint = f"less than {size(wanted)}: recording pauses when the disk is full"
    return judge(item, text, (free < wanted, WARN, hint))


def _packages() -> CheckResult:
    """Compare installed versions with the requirements of jtqd's package."""
    try:
        wanted = [Requirement(each) for each in requires("jtqd") or ()]
    except PackageNotFoundError:
        text = "jtqd is not installed as a package: its requirements are unknown"
        return CheckResult("packages", WARN, text, "pip install .")
    found: dict[str, str | None] = {}
    wrong = []
    for each in wanted:
        if each.marker is not None and not each.marker.evaluate({"extra": ""}):
            continue
        version = found[each.name] = installed(each.name)
        if version is None:
            wrong.append(f"{each.name} is missing")
        elif not each.specifier.contains(version, prereleases=True):
            wrong.append(f"{each.name} {version}, expected {each.specifier}")
    versions = ", ".join(f"{name} {version}" for name, version in found.items())
    hint = "pip install --upgrade jtqd, in its own environment"
    return judge("packages", "; ".join(wrong) or f"jtqd {__version__}, {versions}", (wrong, FAIL, hint))


def _installed_files(own: Path) -> CheckResult:
    """Compare the files of the environment that `own` lies in with the hashes of dpkg, without /etc, or else of pip."""
    sums = (line.split(maxsplit=1) for line in _read(_MD5SUMS).splitlines())
    wanted = {Path("/", name): ("md5", bytes.fromhex(digest)) for digest, name in sums if name[:4] != "etc/"}
    if own not in wanted:
        found = (each for one in distributions(path=[str(own.parents[3])]) for each in one.files or ())
        wanted = {
            Path(str(each.locate())): (each.hash.mode, urlsafe_b64decode(each.hash.value + "=="))
            for each in found
            if each.hash and (".." not in each.parts or os.path.exists(each.locate()))  # scripts: optional
        }
    if own not in wanted:
        return CheckResult("installed files", SKIP, "no hashes to compare with (source or editable install)")
    wrong = []
    for path, (algorithm, digest) in wanted.items():
        with suppress(OSError):
            if hashlib.new(algorithm, read_file(path)).digest() == digest:
                continue
        wrong.append(f"{path} {'differs' if path.exists() else 'is missing'}")
    text = f"{len(wrong)} of {len(wanted)} are not as installed: {'; '.join(wrong[:50])}"
    hint = "install it again, from files that `sha256sum -c SHA256SUMS` finds right"
    return judge("installed files", text if wrong else f"{len(wanted)} as installed", (wrong, FAIL, hint))


def _unit() -> CheckResult:
    if not Path("/run/systemd/system").exists():
        return CheckResult("systemd unit", SKIP, "systemd does not run here")
    path = next((path for each in _UNITS if (path := Path(each, _UNIT)).exists()), None)
    hint = "see docs/deployment.md; without the unit jtqd does not start at boot"
    return judge("systemd unit", str(path or "not installed"), (path is None, WARN, hint))


def _remains(log: Path | None, search: DaemonSearch) -> Iterator[CheckResult]:
    """Check for unfinished logs and runtime directories of killed daemons."""
    running = [each.about for each in search.daemons]
    text = ", ".join(f"{each.instance} (process {each.pid})" for each in running) or "none"
    yield CheckResult("running jtqd", GOOD, text)
    directories = {Path(each.log_directory) for each in running if each.log_directory}
    directories |= {log} if log else set()
    growing = tuple(each.log_prefix for each in running)
    files = [
        str(path)
        for directory in sorted(directories)
        for path in sorted(directory.glob("*.mcap.active"))
        if not path.name.startswith(growing)  # an empty tuple is the start of no name
    ]
    text = ", ".join(files[:3]) + (f" and {len(files) - 3} more" if len(files) > 3 else "")
    yield judge("unfinished logs", text or "none", (files, WARN, "of a crash: jtq recover FILE"))
    if search.foreign:
        yield CheckResult("other users", SKIP, f"{len(search.foreign)} runtime directories, not read")
    if search.abandoned:
        text = ", ".join(map(str, search.abandoned))
        hint = "runtime directories; removed by the next start, or remove them manually"
        yield CheckResult("killed daemons", WARN, text, hint)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
