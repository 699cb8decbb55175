"""`jtq check`: measure a bus and this machine's timing for some seconds, and judge them item by item."""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jtqd.daemon.bus.boot import boot_request
from jtqd.daemon.cli.checks import (
    FAIL,
    GOOD,
    CheckResult,
    check_bus,
    check_conditions,
    check_loop_timing,
    check_own_timing,
    check_stolen_time,
    report,
)
from jtqd.daemon.cli.running import find_daemons, on_bus
from jtqd.daemon.cli.traffic import Traffic, drive, leave, listen, silent
from jtqd.daemon.config import MASTER, Config, as_booted, load_config
from jtqd.daemon.live.reading import Daemon
from jtqd.daemon.loop import realtime
from jtqd.daemon.loop.realtime import stolen_s
from jtqd.daemon.shared.conditions import read_conditions
from jtqd.daemon.shared.processes import Child, ChildError
from jtqd.daemon.shared.runtime_dir import SharedMemoryError
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.frame_socket import BusError, FrameSocket, open_frame_socket
from jtqd.estimator.command_line import command_parser, seconds
from jtqd.estimator.errors import ConfigError

SCHEMA = "jtq.check/1"
_EXAMPLES = """examples:
  jtq check --bus can0                   listen for 10 s, with or without a running jtqd
  jtq check 60 --bus can0 --config /etc/jtqd/can0.yaml
  jtq check --bus vcan0 --drive-sync     without jtqd: boot the nodes as it does, send SYNC, measure the answers
  jtq check 5 --bus sim                  this machine's timing, against the emulated bench
  jtq check --json | jq '.items[] | select(.level != "GOOD")'

Without --drive-sync nothing is sent. With it the nodes are configured and started, and set to pre-operational at the
end, as by jtqd; no drive is commanded. It is refused if jtqd runs, or if another node sends SYNC.

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_CAPACITY = 256
_QUIET_S = 0.5
_BENCH_WAIT_S = 60.0


class CheckError(Exception):
    """The check is not possible; the message is one line for the operator."""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq check`."""
    result = command_parser(
        "jtq check",
        "Measure a bus and the timing of this machine: GOOD, WARN or FAIL for each item, with a remedy.",
        _EXAMPLES,
    )
    add = result.add_argument
    text = "seconds to measure (default: 10)"
    add("seconds", type=seconds, nargs="?", default=10.0, metavar="S", help=text)
    add("--bus", default="can0", help="SocketCAN interface, unix:PATH, or sim (default: can0)")
    text = "configuration of the bus (default: that of the running jtqd, else the shipped bench)"
    add("--config", type=Path, metavar="FILE", help=text)
    add("--drive-sync", action="store_true", help="boot the nodes and send SYNC")
    add("--json", action="store_true", help="print as JSON")
    return result


def main(argv: list[str]) -> int:
    """Measure and evaluate; return the exit status."""
    arguments = parser().parse_args(argv)
    try:
        daemon = None if arguments.bus == "sim" else on_bus(find_daemons(), arguments.bus)
        path = arguments.config or (Path(daemon.about.configuration) if daemon else None)
        config = load_config(path)
        if (
            daemon is not None and daemon.about.configuration_sha256 == config.sha256
        ):  # then as its drives have it
            config = as_booted(config, {node: {"tpdos": each} for node, each in daemon.about.tpdos.items()})
        drives = arguments.drive_sync or arguments.bus == "sim"
        if drives and config.role != MASTER:
            who = f"{config.path}: role {config.role}: another master sends SYNC and boots the nodes"
            raise CheckError(f"{who}: on its bus, without --drive-sync, this check listens")
        before_s, began_s = stolen_s(), time.monotonic()
        with _bus(arguments.bus, daemon) as bus:
            results = list(
                _drive(bus, config, arguments.seconds, daemon)
                if drives
                else _listen(bus, config, arguments.seconds, daemon)
            )
        results.append(check_stolen_time(stolen_s() - before_s, time.monotonic() - began_s))
    except (CheckError, ConfigError, BusError, ChildError) as error:
        print(f"jtq check: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 1
    return report(
        results,
        SCHEMA if arguments.json else None,
        bus=arguments.bus,
        seconds=arguments.seconds,
        configuration=str(config.path),
    )


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f"jtq check: {text}", file=sys.stderr)


def _open(bus: str, *, receive_own: bool = False) -> FrameSocket:
    errors = not bus.startswith("unix:")
    return open_frame_socket(bus, None, receive_own=receive_own, error_frames=errors, capacity=_CAPACITY)


def _listen(bus: str, config: Config, for_s: float, daemon: Daemon | None) -> Iterator[CheckResult]:
    """Listen without sending; beside a running jtqd its timing is judged, else that of this process."""
    traffic, socket = Traffic(config), _open(bus)
    if daemon is None:
        refused = _become_real_time(config)
        _progress(f"listening on {bus} for {for_s:g} s")
        timing = listen(socket, traffic, for_s, config.period_ns)
        yield from check_own_timing(timing, config.period_ns, refused, driven=False)
    else:
        try:
            reader = SnapshotReader(daemon.directory / "snapshot")
            bins, view = reader.late_bins(), reader.read()
        except SharedMemoryError as error:
            raise CheckError(f"jtqd on {daemon.about.instance} is still starting ({error})") from None
        _progress(f"listening on {bus} for {for_s:g} s beside jtqd, process {daemon.about.pid}")
        listen(socket, traffic, for_s, 10 * config.period_ns)
        yield check_loop_timing(bins, reader.late_bins(), view, reader.read())
    yield from _check_traffic(traffic, config, bus, socket)
    if daemon is not None:
        yield from check_conditions(read_conditions(daemon.directory))


def _drive(bus: str, config: Config, for_s: float, daemon: Daemon | None) -> Iterator[CheckResult]:
    """Boot the nodes, send SYNC, and reset the nodes to pre-operational."""
    if daemon is not None:
        raise CheckError(
            f"jtqd runs on {bus} (process {daemon.about.pid}): without --drive-sync this check listens"
        )
    socket = _open(bus, receive_own=True)
    if not silent(socket, _QUIET_S):
        raise CheckError(f"another node sends SYNC on {bus}: without --drive-sync this check listens")
    _progress(f"booting the nodes on {bus}")
    booted, nodes = _boot(bus, config)
    yield booted
    if booted.level != GOOD:
        return
    refused = _become_real_time(config)
    config = as_booted(config, nodes)
    traffic = Traffic(config)
    while socket.receive():
        pass  # frames of the boot
    _progress(f"sending SYNC on {bus} for {for_s:g} s")
    try:
        timing = drive(socket, traffic, for_s, config)
    finally:
        leave(socket, config)
    yield from check_own_timing(timing, config.period_ns, refused, driven=True)
    yield from (each for each in _check_traffic(traffic, config, bus, socket) if "jtqd" not in each.item)


def _check_traffic(traffic: Traffic, config: Config, bus: str, socket: FrameSocket) -> Iterator[CheckResult]:
    return check_bus(traffic, config, lost=socket.rx_dropped, error_frames=not bus.startswith("unix:"))


def _become_real_time(config: Config) -> list[str]:
    """Request the real-time settings of jtqd's loop; return the refused ones."""
    wanted = config.realtime
    refused = realtime.prepare(wanted.priority, wanted.cpu, wanted.lock_memory)
    gc.disable()
    return refused


def _boot(bus: str, config: Config) -> tuple[CheckResult, dict[str, Any]]:
    """Return how the boot went, and what it found, by node-ID."""
    child = Child("jtqd.drivers.boot", name="the boot")
    try:
        child.send(boot_request(config, bus).as_json())
        child.end_of_input()
        answer = child.answer(60.0)
    finally:
        child.end()
    if not answer["ok"]:
        hint = "identity, mapping or scaling of a node differs from the configuration, or the node is silent"
        return CheckResult("boot", FAIL, str(answer["error"]["message"]), hint), {}
    nodes: dict[str, Any] = answer["nodes"]
    text = f"nodes {', '.join(sorted(nodes))}: identity, mapping and scaling as configured, operational"
    own = [
        f"node {node}: {note}"
        for node, each in nodes.items()
        for note in each.get("notes", [])
        if "as it is" in note
    ]
    return CheckResult("boot", GOOD, "; ".join((text, *own))), nodes


@contextmanager
def _bus(name: str, daemon: Daemon | None) -> Iterator[str]:
    """Return the name of the bus; for "sim" start the emulated bench while it is used."""
    if name != "sim":
        yield daemon.about.bus if daemon else name
        return
    with tempfile.TemporaryDirectory(prefix="jtq-check-") as directory:
        path = Path(directory) / "bus"
        bench = Child("jtqd.sim_can", ["--bus", f"unix:{path}"], name="the emulated bench")
        try:
            until = time.monotonic() + _BENCH_WAIT_S
            while not path.exists():
                if not bench.alive() or time.monotonic() > until:
                    raise CheckError("the emulated bench did not open its bus")
                time.sleep(0.01)
            yield f"unix:{path}"
        finally:
            bench.end()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
