"""Kernel and real-time rights of this machine, as far as the loop depends on them."""

from __future__ import annotations

import gzip
import os
import platform
import re
import resource
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from daemon.config import Realtime
from daemon.tools.finding import FAIL, GOOD, SKIP, WARN, Finding
from drivers.socketcan import AF_CAN, CAN_RAW

_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_LOCKED_BYTES = 256 << 20
"""What the loop has touched when it begins, with room to spare."""
_SLOW_CLOCK_NS = 1_000
_GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
_SYS = Path("/sys/devices/system")


def kernel_findings(wanted: Realtime, *, can: bool) -> Iterator[Finding]:
    """Every item about the kernel and the rights of this user; `can`: SocketCAN is wanted."""
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
    with suppress(OSError):
        return Path(path).read_text(errors="replace").strip()
    return ""


def _kernel() -> Finding:
    version = platform.version()
    text = f"Linux {platform.release()} {platform.machine()}"
    if _text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", GOOD, f"{text}, PREEMPT_RT")
    kind = (
        "PREEMPT_DYNAMIC"
        if "PREEMPT_DYNAMIC" in version
        else "PREEMPT"
        if "PREEMPT" in version
        else "no preemption"
    )
    return Finding(
        "kernel",
        WARN,
        f"{text}, {kind}",
        "not a real-time kernel: a driver may hold the loop up for milliseconds; `jtq check` measures how often",
    )


def build_options() -> dict[str, str]:
    """What the running kernel was built with, e.g. {"CONFIG_HZ": "250"}; empty where it does not tell."""
    with suppress(OSError, EOFError), gzip.open("/proc/config.gz", "rt") as file:
        return dict(re.findall(r"^(CONFIG_\w+)=(.*)$", file.read(), re.MULTILINE))
    return dict(re.findall(r"^(CONFIG_\w+)=(.*)$", _text(f"/boot/config-{platform.release()}"), re.MULTILINE))


def _tick() -> Finding:
    hz = build_options().get("CONFIG_HZ")
    shown = f"HZ {hz}" if hz else "HZ unknown (the kernel does not tell its configuration)"
    resolution = time.clock_getres(time.CLOCK_MONOTONIC)
    if resolution <= 1e-6:
        return Finding("timers", GOOD, f"high resolution ({resolution * 1e9:.0f} ns), {shown}")
    return Finding(
        "timers",
        FAIL,
        f"resolution {resolution * 1e3:.3g} ms, {shown}",
        "CONFIG_HIGH_RES_TIMERS, and no `highres=off`",
    )


def _clock() -> Finding:
    name = _text(_SYS / "clocksource/clocksource0/current_clocksource") or "unknown"
    count = 2000
    start = time.perf_counter_ns()
    for _ in range(count):
        time.monotonic_ns()
    each = (time.perf_counter_ns() - start) / count
    text = f"{name}, {each:.0f} ns for a reading"
    if each > _SLOW_CLOCK_NS:
        others = _text(_SYS / "clocksource/clocksource0/available_clocksource")
        return Finding(
            "clocksource",
            WARN,
            text,
            f"the loop reads it ten times a cycle; available: {others or 'unknown'}",
        )
    if name not in _GOOD_CLOCKS and name != "unknown":
        return Finding(
            "clocksource", WARN, text, "not one that is known to be steady: kernel log, `clocksource`"
        )
    return Finding("clocksource", GOOD, text)


def _can_sockets(*, wanted: bool) -> Finding:
    try:
        socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW).close()
    except OSError as error:
        text = f"AF_CAN: {error.strerror} (errno {error.errno})"
        hint = "modprobe can can_raw; or a kernel with CONFIG_CAN and CONFIG_CAN_RAW; in systemd, RestrictAddressFamilies"
        return (
            Finding("SocketCAN", FAIL, text, hint)
            if wanted
            else Finding("SocketCAN", SKIP, f"{text}; not needed")
        )
    return Finding("SocketCAN", GOOD, "raw CAN sockets can be opened")


def _capability(number: int) -> bool:
    found = re.search(r"^CapEff:\s*([0-9a-f]+)", _text("/proc/self/status"), re.MULTILINE)
    return bool(found and int(found[1], 16) >> number & 1)


def _priority(wanted: Realtime) -> Finding:
    if not wanted.priority:
        return Finding(
            "SCHED_FIFO", WARN, "the configuration asks for none (realtime.priority 0)", "80 is the default"
        )
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    limit_text = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority))
    except OSError as error:
        return Finding(
            "SCHED_FIFO",
            FAIL,
            f"priority {wanted.priority} is refused to this user: {error.strerror}; RLIMIT_RTPRIO {limit_text}",
            "LimitRTPRIO= in the unit, or /etc/security/limits.d: `jtqd - rtprio 80`",
        )
    os.sched_setscheduler(0, *before)
    how = "CAP_SYS_NICE" if _capability(_CAP_SYS_NICE) else f"RLIMIT_RTPRIO {limit_text}"
    return Finding("SCHED_FIFO", GOOD, f"priority {wanted.priority} is granted to this user by {how}")


def _throttling(wanted: Realtime) -> Finding:
    runtime, period = (_text(f"/proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
    if not runtime or not period:
        return Finding("RT throttling", SKIP, "the kernel does not tell")
    if int(runtime) < 0:
        return Finding("RT throttling", GOOD, "off: a real-time process may take a whole CPU")
    part = int(runtime) / int(period)
    text = f"real-time processes get {int(runtime) / 1000:.0f} of {int(period) / 1000:.0f} ms"
    if wanted.priority and part < 0.9:
        return Finding(
            "RT throttling", FAIL, text, "sysctl kernel.sched_rt_runtime_us=950000: the loop would be stopped"
        )
    return Finding("RT throttling", GOOD, f"{text}: far more than the loop takes")


def _memory(wanted: Realtime) -> Finding:
    if not wanted.lock_memory:
        return Finding(
            "locked memory", WARN, "the configuration does not ask for it", "realtime: {lock_memory: true}"
        )
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit == resource.RLIM_INFINITY or _capability(_CAP_IPC_LOCK):
        return Finding("locked memory", GOOD, "unlimited for this user")
    text = f"RLIMIT_MEMLOCK {limit >> 20} MiB for this user"
    if limit < _LOCKED_BYTES:
        return Finding(
            "locked memory", FAIL, text, "LimitMEMLOCK=infinity in the unit: a page fault delays a cycle"
        )
    return Finding("locked memory", GOOD, text)


def _cpus(text: str) -> set[int]:
    """A CPU list of the kernel, "0-2,5"."""
    found: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


def _cpu(wanted: Realtime) -> Finding:
    isolated = _text(_SYS / "cpu/isolated")
    allowed = os.sched_getaffinity(0)
    if wanted.cpu is None:
        text = f"any of {len(allowed)}" + (f"; isolated: {isolated}" if isolated else "")
        hint = f"realtime: {{cpu: {min(_cpus(isolated))}}} would use the isolated one" if isolated else ""
        return Finding("CPU", WARN if hint else GOOD, text, hint)
    if wanted.cpu not in _cpus(_text(_SYS / "cpu/online")):
        return Finding("CPU", FAIL, f"{wanted.cpu} by the configuration: not there", "realtime.cpu")
    if wanted.cpu not in _cpus(isolated):
        return Finding(
            "CPU",
            WARN,
            f"{wanted.cpu} by the configuration, shared with everybody (isolated: {isolated or 'none'})",
            f"isolcpus={wanted.cpu} on the kernel's command line keeps others off it",
        )
    return Finding("CPU", GOOD, f"{wanted.cpu}, isolated")


def _governor() -> Finding:
    found = {_text(path) for path in _SYS.glob("cpu/cpu[0-9]*/cpufreq/scaling_governor")} - {""}
    if not found:
        return Finding("cpufreq", GOOD, "the kernel does not scale the frequency")
    text = f"governor {', '.join(sorted(found))}"
    if found == {"performance"}:
        return Finding("cpufreq", GOOD, text)
    return Finding(
        "cpufreq", WARN, text, "cpupower frequency-set -g performance: a slow clock makes a cycle long"
    )
