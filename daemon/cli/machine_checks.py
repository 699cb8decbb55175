"""Checks of this machine: kernel and rights of this user (`check_kernel`), CAN interfaces (`check_can`).

Kernel and rights are judged as far as the loop depends on them, an interface by what the kernel and `ip` report of it.
"""

from __future__ import annotations

import gzip
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
from pathlib import Path
from typing import Any

from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult
from jtqd.daemon.config import Config, Realtime
from jtqd.drivers.bus_socket import AF_CAN, CAN_RAW
from jtqd.drivers.frame_socket import BusError, open_frame_socket

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
