"""Checks of this machine: kernel and rights of this user (`check_kernel`), CAN interfaces (`check_can`).

Kernel and rights are judged as far as the loop depends on them, an interface by what the kernel and `ip` report of it.
"""

from __future__ import annotations

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
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

from jtqd import __version__
from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult
from jtqd.daemon.cli.running import DaemonSearch
from jtqd.daemon.config import Config, Realtime
from jtqd.daemon.loop.process import build_estimator
from jtqd.daemon.shared.runtime_dir import installed
from jtqd.drivers.bus_load import BusLoadError, check_bus_load
from jtqd.drivers.bus_socket import AF_CAN, CAN_RAW
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.onnx_graph import NetworkError
from jtqd.estimator.text import percent, size

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_LOCKED_BYTES = 256 << 20
"""What the loop has touched when it begins, with room to spare."""
_SLOW_CLOCK_NS = 1_000
_GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
_SYS = Path("/sys/devices/system")
_NET = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_QUEUE = 100
"""Frames; the default of 10 overflows when one cycle meets SDO traffic."""
_COUNTED = ("error_warning", "error_passive", "bus_off")
_UNITS = (
    "/etc/systemd/system",
    "/run/systemd/system",
    "/usr/local/lib/systemd/system",
    "/usr/lib/systemd/system",
    "/lib/systemd/system",
)
_UNIT = "jtqd@.service"
_LOG_FREE = 10 << 30
"""A working day of recording."""
_SHM_FREE = 64 << 20
_BYTES_AN_HOUR = 1.1e9


def check_kernel(wanted: Realtime, *, can: bool) -> Iterator[CheckResult]:
    """Check the kernel and the rights of this user; `can`: SocketCAN is required."""
    yield _kernel()
    yield _tick()
    yield _clock()
    yield _can_sockets(wanted=can)
    yield _priority(wanted)
    yield _throttling(wanted)
    yield _memory(wanted)
    yield _cpu(wanted)
    yield _governor()


def _text(path: str | Path) -> str:
    """Return the content of a file, "" if it cannot be read."""
    with suppress(OSError):
        return Path(path).read_text(errors="replace").strip()
    return ""


def _kernel() -> CheckResult:
    version = platform.version()
    text = f"Linux {platform.release()} {platform.machine()}"
    if _text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return CheckResult("kernel", GOOD, f"{text}, PREEMPT_RT")
    kind = (
        "PREEMPT_DYNAMIC"
        if "PREEMPT_DYNAMIC" in version
        else "PREEMPT"
        if "PREEMPT" in version
        else "no preemption"
    )
    return CheckResult(
        "kernel",
        WARN,
        f"{text}, {kind}",
        "not a real-time kernel: a driver may delay the loop by milliseconds; `jtq check` measures how often",
    )


def build_options() -> dict[str, str]:
    """Return the build options of the running kernel, e.g. {"CONFIG_HZ": "250"}; empty if not published."""
    with suppress(OSError, EOFError), gzip.open("/proc/config.gz", "rt") as file:
        return dict(re.findall(r"^(CONFIG_\w+)=(.*)$", file.read(), re.MULTILINE))
    return dict(re.findall(r"^(CONFIG_\w+)=(.*)$", _text(f"/boot/config-{platform.release()}"), re.MULTILINE))


def _tick() -> CheckResult:
    hz = build_options().get("CONFIG_HZ")
    shown = f"HZ {hz}" if hz else "HZ unknown (the kernel does not publish its configuration)"
    resolution = time.clock_getres(time.CLOCK_MONOTONIC)
    if resolution <= 1e-6:
        return CheckResult("timers", GOOD, f"high resolution ({resolution * 1e9:.0f} ns), {shown}")
    return CheckResult(
        "timers",
        FAIL,
        f"resolution {resolution * 1e3:.3g} ms, {shown}",
        "CONFIG_HIGH_RES_TIMERS, and no `highres=off`",
    )


def _clock() -> CheckResult:
    name = _text(_SYS / "clocksource/clocksource0/current_clocksource") or "unknown"
    count = 2000
    start = time.perf_counter_ns()
    for _ in range(count):
        time.monotonic_ns()
    each = (time.perf_counter_ns() - start) / count
    text = f"{name}, {each:.0f} ns for a reading"
    if each > _SLOW_CLOCK_NS:
        others = _text(_SYS / "clocksource/clocksource0/available_clocksource")
        return CheckResult(
            "clocksource",
            WARN,
            text,
            f"the loop reads it ten times a cycle; available: {others or 'unknown'}",
        )
    if name not in _GOOD_CLOCKS and name != "unknown":
        return CheckResult(
            "clocksource", WARN, text, "stability unknown: see `clocksource` in the kernel log"
        )
    return CheckResult("clocksource", GOOD, text)


def _can_sockets(*, wanted: bool) -> CheckResult:
    try:
        socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW).close()
    except OSError as error:
        text = f"AF_CAN: {error.strerror} (errno {error.errno})"
        hint = "modprobe can can_raw; or a kernel with CONFIG_CAN and CONFIG_CAN_RAW; in systemd, RestrictAddressFamilies"
        return (
            CheckResult("SocketCAN", FAIL, text, hint)
            if wanted
            else CheckResult("SocketCAN", SKIP, f"{text}; not needed")
        )
    return CheckResult("SocketCAN", GOOD, "raw CAN sockets can be opened")


def _capability(number: int) -> bool:
    match = re.search(r"^CapEff:\s*([0-9a-f]+)", _text("/proc/self/status"), re.MULTILINE)
    return bool(match and int(match[1], 16) >> number & 1)


def _priority(wanted: Realtime) -> CheckResult:
    if not wanted.priority:
        return CheckResult(
            "SCHED_FIFO",
            WARN,
            "not requested by the configuration (realtime.priority 0)",
            "80 is the default",
        )
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    limit_text = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority))
    except OSError as error:
        return CheckResult(
            "SCHED_FIFO",
            FAIL,
            f"priority {wanted.priority} is refused to this user: {error.strerror}; RLIMIT_RTPRIO {limit_text}",
            "LimitRTPRIO= in the unit, or /etc/security/limits.d: `jtqd - rtprio 80`",
        )
    os.sched_setscheduler(0, *before)
    how = "CAP_SYS_NICE" if _capability(_CAP_SYS_NICE) else f"RLIMIT_RTPRIO {limit_text}"
    return CheckResult("SCHED_FIFO", GOOD, f"priority {wanted.priority} is granted to this user by {how}")


def _throttling(wanted: Realtime) -> CheckResult:
    runtime, period = (_text(f"/proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
    if not runtime or not period:
        return CheckResult("RT throttling", SKIP, "not reported by the kernel")
    if int(runtime) < 0:
        return CheckResult("RT throttling", GOOD, "off: a real-time process may take a whole CPU")
    part = int(runtime) / int(period)
    text = f"real-time processes get {int(runtime) / 1000:.0f} of {int(period) / 1000:.0f} ms"
    if wanted.priority and part < 0.9:
        return CheckResult(
            "RT throttling",
            FAIL,
            text,
            "sysctl kernel.sched_rt_runtime_us=950000: otherwise the loop is stopped",
        )
    return CheckResult("RT throttling", GOOD, f"{text}: far more than the loop needs")


def _memory(wanted: Realtime) -> CheckResult:
    if not wanted.lock_memory:
        return CheckResult(
            "locked memory", WARN, "not requested by the configuration", "realtime: {lock_memory: true}"
        )
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit == resource.RLIM_INFINITY or _capability(_CAP_IPC_LOCK):
        return CheckResult("locked memory", GOOD, "unlimited for this user")
    text = f"RLIMIT_MEMLOCK {limit >> 20} MiB for this user"
    if limit < _LOCKED_BYTES:
        return CheckResult(
            "locked memory", FAIL, text, "LimitMEMLOCK=infinity in the unit: a page fault delays a cycle"
        )
    return CheckResult("locked memory", GOOD, text)


def _cpus(text: str) -> set[int]:
    """Parse a CPU list of the kernel, "0-2,5"."""
    cpus: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        cpus |= set(range(int(first), int(last or first) + 1))
    return cpus


def _cpu(wanted: Realtime) -> CheckResult:
    isolated = _text(_SYS / "cpu/isolated")
    allowed = os.sched_getaffinity(0)
    if wanted.cpu is None:
        text = f"any of {len(allowed)}" + (f"; isolated: {isolated}" if isolated else "")
        hint = f"realtime: {{cpu: {min(_cpus(isolated))}}} would use the isolated one" if isolated else ""
        return CheckResult("CPU", WARN if hint else GOOD, text, hint)
    if wanted.cpu not in _cpus(_text(_SYS / "cpu/online")):
        return CheckResult("CPU", FAIL, f"{wanted.cpu} by the configuration: does not exist", "realtime.cpu")
    if wanted.cpu not in _cpus(isolated):
        return CheckResult(
            "CPU",
            WARN,
            f"{wanted.cpu} by the configuration, shared with other processes (isolated: {isolated or 'none'})",
            f"isolcpus={wanted.cpu} on the kernel command line reserves it",
        )
    return CheckResult("CPU", GOOD, f"{wanted.cpu}, isolated")


def _governor() -> CheckResult:
    governors = {_text(path) for path in _SYS.glob("cpu/cpu[0-9]*/cpufreq/scaling_governor")} - {""}
    if not governors:
        return CheckResult("cpufreq", GOOD, "the kernel does not scale the frequency")
    text = f"governor {', '.join(sorted(governors))}"
    if governors == {"performance"}:
        return CheckResult("cpufreq", GOOD, text)
    return CheckResult(
        "cpufreq", WARN, text, "cpupower frequency-set -g performance: a slow clock makes a cycle long"
    )


def interfaces() -> list[str]:
    """Return the names of the CAN interfaces of this machine."""
    return sorted(path.parent.name for path in _NET.glob("*/type") if _text(path) == _ARPHRD_CAN)


def check_can(bus: str | None, config: Config) -> Iterator[CheckResult]:
    """Check the bus; None: all CAN interfaces."""
    if bus is None:
        names = interfaces()
        if not names:
            yield CheckResult(
                "CAN interface",
                WARN,
                "none on this machine",
                "connect one; `ip link add dev vcan0 type vcan` for a test",
            )
        for name in names:
            yield from _interface(name, config)
    elif bus == "sim":
        yield CheckResult("CAN interface", SKIP, "the emulated bench needs none")
    elif bus.startswith("unix:"):
        yield _opened(bus)
    elif not (_NET / bus).exists():
        here = ", ".join(interfaces()) or "none"
        yield CheckResult(
            bus, FAIL, f"no such interface; CAN interfaces here: {here}", "check driver and name"
        )
    elif _text(_NET / bus / "type") != _ARPHRD_CAN:
        yield CheckResult(bus, FAIL, "not a CAN interface")
    else:
        yield from _interface(bus, config)


def _opened(bus: str) -> CheckResult:
    try:
        open_frame_socket(bus, []).close()
    except BusError as error:
        return CheckResult(
            "bus", FAIL, str(error), "start its hub: `jtq sim --bus unix:PATH`, or python -m jtqd.drivers.hub"
        )
    return CheckResult("bus", GOOD, f"{bus}: the hub answers")


def link_of(name: str) -> dict[str, Any]:
    """Return the output of `ip -details -statistics link` for an interface; {} without ip or interface."""
    if shutil.which("ip") is None:
        return {}
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            ["ip", "-json", "-details", "-statistics", "link", "show", name],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
        links: Any = json.loads(done.stdout)
        return dict(links[0])
    return {}


def _interface(name: str, config: Config) -> Iterator[CheckResult]:
    up = int(_text(_NET / name / "flags") or "0", 16) & 1
    link = link_of(name)
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    kind = info.get("info_kind", "CAN")
    yield (
        CheckResult(name, GOOD, f"up, {kind}")
        if up
        else CheckResult(
            name, FAIL, "down", f"ip link set {name} up type can bitrate {config.bitrate} restart-ms 100"
        )
    )
    queue = int(_text(_NET / name / "tx_queue_len") or "0")
    yield CheckResult(
        f"{name} queue",
        GOOD if queue >= _QUEUE else WARN,
        f"txqueuelen {queue}",
        ""
        if queue >= _QUEUE
        else f"ip link set {name} txqueuelen 1000: a short queue loses frames when the bus is busy",
    )
    if not link:
        yield CheckResult(
            f"{name} wire", SKIP, "`ip` is missing, so bit rate and state are unknown", "install iproute2"
        )
    elif kind == "vcan":
        yield CheckResult(f"{name} wire", SKIP, "virtual: no bit rate, no arbitration, no errors")
    else:
        yield _wire(name, data, config)
        yield _state(name, data, link)
    dropped = _dropped(name)
    if dropped:
        text = ", ".join(f"{each} {count}" for each, count in dropped.items())
        yield CheckResult(
            f"{name} drops",
            WARN,
            f"{text} since the interface exists",
            "queue too short, or controller overruns",
        )


def _wire(name: str, data: dict[str, Any], config: Config) -> CheckResult:
    bitrate = data.get("bittiming", {}).get("bitrate", 0)
    restart = data.get("restart_ms", 0)
    text = f"{bitrate} bit/s, restart-ms {restart}"
    if bitrate != config.bitrate:
        hint = (
            f"the configuration says {config.bitrate}: ip link set {name} type can bitrate {config.bitrate}"
        )
        return CheckResult(f"{name} wire", FAIL, text, hint)
    if not restart:
        hint = f"ip link set {name} type can restart-ms 100: otherwise it stays off after a bus-off"
        return CheckResult(f"{name} wire", WARN, text, hint)
    return CheckResult(f"{name} wire", GOOD, text)


def _state(name: str, data: dict[str, Any], link: dict[str, Any]) -> CheckResult:
    state = str(data.get("state", "unknown"))
    counts = link.get("linkinfo", {}).get("info_xstats", {})
    seen = ", ".join(f"{each.replace('_', ' ')} {counts[each]}" for each in _COUNTED if counts.get(each))
    errors = data.get("berr_counter", {})
    text = f"{state}, error counters tx {errors.get('tx', '?')} rx {errors.get('rx', '?')}" + (
        f"; {seen}" if seen else ""
    )
    if state in ("BUS-OFF", "ERROR-PASSIVE"):
        return CheckResult(
            f"{name} state",
            FAIL,
            text,
            "check wiring, termination, bit rate, and that another node is powered",
        )
    if state != "ERROR-ACTIVE" or seen:
        return CheckResult(
            f"{name} state", WARN, text, "errors occurred: check wiring, termination, sample point"
        )
    return CheckResult(f"{name} state", GOOD, text)


def _dropped(name: str) -> dict[str, int]:
    names = ("rx_dropped", "tx_dropped", "rx_over_errors", "tx_errors", "rx_errors")
    counts = {each: int(_text(_NET / name / "statistics" / each) or "0") for each in names}
    return {each: count for each, count in counts.items() if count}


def check_files(config: Config) -> Iterator[CheckResult]:
    """Check configuration, joint files, models and their hashes; the configuration has been read already."""
    load = bus_load_of(config)
    yield CheckResult(
        "configuration", GOOD, f"{config.path}, sha256 {config.sha256[:12]}, method {config.estimator.method}"
    )
    try:
        check_bus_load(load)
        yield CheckResult("bus load", GOOD, f"{percent(load.worst)} in the worst case (`jtq bus-load`)")
    except BusLoadError as error:
        yield CheckResult("bus load", FAIL, str(error), "`jtq bus-load` shows the share of each sender")
    for joint in config.joints:
        item = f"joint {joint.number}"
        shown = f"{joint.joint_path.name} {hashlib.sha256(joint.joint_path.read_bytes()).hexdigest()[:12]}"
        network = (
            f", {joint.network.path.name} {joint.network.sha256[:12]}" if joint.network else ", no network"
        )
        try:
            build_estimator(config, joint).step(1e-3, 0.1, 0.0, 1.0, 0.0, 25.0)
        except (ConfigError, NetworkError) as error:
            yield CheckResult(item, FAIL, str(error), "jtqd will not start with it")
        else:
            yield CheckResult(item, GOOD, f"{joint.joint.name}: {shown}{network}: loads and runs")


def check_directories(log: Path | None, roots: list[Path]) -> Iterator[CheckResult]:
    """Check the directories of logs and shared memory for this user; `log` None: none is named."""
    if log is None:
        yield CheckResult(
            "log directory", SKIP, "jtqd writes to ./logs without --record DIR or $LOGS_DIRECTORY"
        )
    else:
        yield _directory(
            "log directory", log, _LOG_FREE, f"an hour takes up to {size(round(_BYTES_AN_HOUR))}"
        )
    yield _directory("shared memory", roots[0], _SHM_FREE, "ring and snapshot of a daemon take 3 MB")


def _directory(item: str, path: Path, wanted: int, what: str) -> CheckResult:
    existing = next(
        each for each in (path, *path.absolute().parents) if os.path.exists(each)
    )  # not in a closed one
    free = shutil.disk_usage(existing).free
    text = f"{path}: {size(free)} free, {what}"
    if not os.access(existing, os.W_OK | os.X_OK):
        return CheckResult(
            item, FAIL, f"{path}: not writable for this user", "owner and mode; LogsDirectory= in the unit"
        )
    if existing != path:
        text += "; it will be created"
    if free < wanted:
        return CheckResult(
            item, WARN, text, f"less than {size(wanted)}: recording pauses when the disk is full"
        )
    return CheckResult(item, GOOD, text)


def check_packages() -> Iterator[CheckResult]:
    """Compare installed versions with the requirements of jtqd's package."""
    try:
        wanted = [each for each in requires("jtqd") or () if "extra ==" not in each]
    except PackageNotFoundError:
        yield CheckResult(
            "packages",
            WARN,
            "jtqd is not installed as a package: its requirements are unknown",
            "pip install .",
        )
        return
    versions, wrong = [], []
    for line in wanted:
        name, limits = requirement(line)
        version = installed(name)
        versions.append(f"{name} {version}")
        if version is None:
            wrong.append(f"{name} is missing")
        elif not all(fits(version, *limit) for limit in limits):
            wrong.append(f"{name} {version}, expected {line.removeprefix(name)}")
    text = f"jtqd {__version__}, " + ", ".join(versions)
    if wrong:
        yield CheckResult(
            "packages", FAIL, "; ".join(wrong), "pip install --upgrade jtqd, in its own environment"
        )
    else:
        yield CheckResult("packages", GOOD, text)


def requirement(line: str) -> tuple[str, list[tuple[str, str]]]:
    """Split a requirement into name and limits: "mcap>=1.3,<2" is ("mcap", [(">=", "1.3"), ("<", "2")])."""
    name = re.split(r"[^A-Za-z0-9_.-]", line, maxsplit=1)[0]
    return name, re.findall(r"(>=|<=|==|<|>)\s*([0-9][0-9A-Za-z.]*)", line.partition(";")[0])


def fits(version: str, operator: str, limit: str) -> bool:
    """Compare the numbers of two versions; the first part that is not a number ends them."""
    have, want = _numbers(version), _numbers(limit)
    length = max(len(have), len(want))
    have, want = have + (0,) * (length - len(have)), want + (0,) * (length - len(want))
    return {">=": have >= want, "<=": have <= want, "==": have == want, "<": have < want, ">": have > want}[
        operator
    ]


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(map(int, match[0].split("."))) if match else ()


def check_unit() -> CheckResult:
    """Check the systemd unit."""
    if not Path("/run/systemd/system").exists():
        return CheckResult("systemd unit", SKIP, "systemd does not run here")
    for directory in _UNITS:
        path = Path(directory) / _UNIT
        if path.exists():
            return CheckResult("systemd unit", GOOD, str(path))
    return CheckResult(
        "systemd unit",
        WARN,
        "not installed",
        "see docs/deployment.md; without the unit jtqd does not start at boot",
    )


def check_leftovers(log: Path | None, search: DaemonSearch) -> Iterator[CheckResult]:
    """Check for unfinished logs and runtime directories of killed daemons."""
    running = [each.about for each in search.daemons]
    text = ", ".join(f"{each.instance} (process {each.pid})" for each in running) or "none"
    yield CheckResult("running jtqd", GOOD, text)
    directories = {Path(each.log_directory) for each in running if each.log_directory} | (
        {log} if log else set()
    )
    growing = tuple(each.log_prefix for each in running)
    files = [
        path
        for directory in sorted(directories)
        for path in sorted(directory.glob("*.mcap.active"))
        if not (growing and path.name.startswith(growing))
    ]
    if files:
        names = ", ".join(str(path) for path in files[:3]) + (
            f" and {len(files) - 3} more" if len(files) > 3 else ""
        )
        yield CheckResult("unfinished logs", WARN, names, "left by a crash: jtq recover FILE")
    else:
        yield CheckResult("unfinished logs", GOOD, "none")
    if search.left_over:
        yield CheckResult(
            "left over",
            WARN,
            ", ".join(map(str, search.left_over)),
            "from killed daemons; removed by the next start, or remove it manually",
        )
