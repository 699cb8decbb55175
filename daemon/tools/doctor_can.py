"""The CAN interface as the kernel and `ip` describe it."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from daemon.config import Config
from daemon.tools.finding import FAIL, GOOD, SKIP, WARN, Finding
from drivers.errors import BusError
from drivers.frame_socket import open_frame_socket

_NET = Path("/sys/class/net")
_ARPHRD_CAN = "280"
_QUEUE = 100
"""Frames; the default of 10 overflows when one cycle meets SDO traffic."""
_COUNTED = ("error_warning", "error_passive", "bus_off")


def interfaces() -> list[str]:
    """Names of the CAN interfaces of this machine."""
    return sorted(path.parent.name for path in _NET.glob("*/type") if _read(path) == _ARPHRD_CAN)


def can_findings(bus: str | None, config: Config) -> Iterator[Finding]:
    """Every item about the bus; None: all CAN interfaces there are."""
    if bus is None:
        names = interfaces()
        if not names:
            yield Finding(
                "CAN interface",
                WARN,
                "none on this machine",
                "plug it in; `ip link add dev vcan0 type vcan` for a test",
            )
        for name in names:
            yield from _interface(name, config)
    elif bus == "sim":
        yield Finding("CAN interface", SKIP, "the emulated bench needs none")
    elif bus.startswith("unix:"):
        yield _opened(bus)
    elif not (_NET / bus).exists():
        here = ", ".join(interfaces()) or "none"
        yield Finding(
            bus, FAIL, f"no such interface; CAN interfaces here: {here}", "driver loaded? name correct?"
        )
    elif _read(_NET / bus / "type") != _ARPHRD_CAN:
        yield Finding(bus, FAIL, "not a CAN interface")
    else:
        yield from _interface(bus, config)


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text().strip()
    return ""


def _opened(bus: str) -> Finding:
    try:
        open_frame_socket(bus, []).close()
    except BusError as error:
        return Finding(
            "bus", FAIL, str(error), "start its hub: `jtq sim --bus unix:PATH`, or python -m drivers.hub"
        )
    return Finding("bus", GOOD, f"{bus}: the hub answers")


def link_of(name: str) -> dict[str, Any]:
    """What `ip -details -statistics link` says of an interface; {} where there is no ip, or it does not know."""
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
        found: Any = json.loads(done.stdout)
        return dict(found[0])
    return {}


def _interface(name: str, config: Config) -> Iterator[Finding]:
    up = int(_read(_NET / name / "flags") or "0", 16) & 1
    link = link_of(name)
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    kind = info.get("info_kind", "CAN")
    yield (
        Finding(name, GOOD, f"up, {kind}")
        if up
        else Finding(
            name, FAIL, "down", f"ip link set {name} up type can bitrate {config.bitrate} restart-ms 100"
        )
    )
    queue = int(_read(_NET / name / "tx_queue_len") or "0")
    yield Finding(
        f"{name} queue",
        GOOD if queue >= _QUEUE else WARN,
        f"txqueuelen {queue}",
        ""
        if queue >= _QUEUE
        else f"ip link set {name} txqueuelen 1000: a short queue loses frames when the bus is busy",
    )
    if not link:
        yield Finding(
            f"{name} wire", SKIP, "there is no `ip` to ask for bit rate and state", "install iproute2"
        )
    elif kind == "vcan":
        yield Finding(f"{name} wire", SKIP, "virtual: no bit rate, no arbitration, no errors")
    else:
        yield _wire(name, data, config)
        yield _state(name, data, link)
    dropped = _dropped(name)
    if dropped:
        text = ", ".join(f"{each} {count}" for each, count in dropped.items())
        yield Finding(
            f"{name} drops",
            WARN,
            f"{text} since it is there",
            "queue too short, or a controller that overruns",
        )


def _wire(name: str, data: dict[str, Any], config: Config) -> Finding:
    bitrate = data.get("bittiming", {}).get("bitrate", 0)
    restart = data.get("restart_ms", 0)
    text = f"{bitrate} bit/s, restart-ms {restart}"
    if bitrate != config.bitrate:
        hint = (
            f"the configuration says {config.bitrate}: ip link set {name} type can bitrate {config.bitrate}"
        )
        return Finding(f"{name} wire", FAIL, text, hint)
    if not restart:
        hint = f"ip link set {name} type can restart-ms 100: else it stays off after a bus-off"
        return Finding(f"{name} wire", WARN, text, hint)
    return Finding(f"{name} wire", GOOD, text)


def _state(name: str, data: dict[str, Any], link: dict[str, Any]) -> Finding:
    state = str(data.get("state", "unknown"))
    counts = link.get("linkinfo", {}).get("info_xstats", {})
    seen = ", ".join(f"{each.replace('_', ' ')} {counts[each]}" for each in _COUNTED if counts.get(each))
    errors = data.get("berr_counter", {})
    text = f"{state}, error counters tx {errors.get('tx', '?')} rx {errors.get('rx', '?')}" + (
        f"; {seen}" if seen else ""
    )
    if state in ("BUS-OFF", "ERROR-PASSIVE"):
        return Finding(
            f"{name} state", FAIL, text, "wiring, termination, bit rate; is any other node powered?"
        )
    if state != "ERROR-ACTIVE" or seen:
        return Finding(f"{name} state", WARN, text, "errors have happened: wiring, termination, sample point")
    return Finding(f"{name} state", GOOD, text)


def _dropped(name: str) -> dict[str, int]:
    names = ("rx_dropped", "tx_dropped", "rx_over_errors", "tx_errors", "rx_errors")
    counts = {each: int(_read(_NET / name / "statistics" / each) or "0") for each in names}
    return {each: count for each, count in counts.items() if count}
