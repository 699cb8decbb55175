"""The loop process: everything is made and warmed up first, then one cycle after the other until told to stop.

Started by the supervisor as `python -m daemon.loop` with a JSON request as its only argument. It answers on standard output
with one JSON line when it is ready, reads the boot report as one JSON line from standard input, runs, and ends with one JSON
line of results. It has no second thread, logs nothing while it runs, and shares only memory with other processes.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from daemon import realtime
from daemon.config import Config, JointConfig, load_config
from daemon.cycle import Cycle
from daemon.cycle_record import RECORD_SIZE
from daemon.grid import Grid
from daemon.input_pdos import input_pdos, joint_temperatures, sensor_index
from daemon.intake import Intake
from daemon.joint_cycle import JointInputs
from daemon.ring import Ring
from daemon.snapshot import Snapshot
from drivers.can_filter import CanFilter, look_alikes
from drivers.devices import SYNC_COB_ID
from drivers.errors import BusError, BusGone
from drivers.frame_socket import FrameSocket, open_frame_socket
from estimator.checked import ConfigError
from estimator.methods import AnyEstimator, load_network, make_estimator
from estimator.network import NetworkError

_WARM_UP_STEPS = 300


class _Stop:
    """Set by SIGTERM and SIGINT; asked once per cycle."""

    def __init__(self) -> None:
        self.requested = False
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the supervisor decides

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def build_estimator(config: Config, joint: JointConfig) -> AnyEstimator:
    """Estimator of one joint as configured; raises ConfigError or NetworkError."""
    method, network = config.estimator.method, None
    try:
        if joint.network is not None:
            network = load_network(method, str(joint.network.path), joint.network.sha256)
        return make_estimator(joint.joint, config.estimator, network)
    except (ConfigError, NetworkError) as error:
        key = f"joint_{joint.number}"
        raise type(error)(f"{error} ({config.path}: '{key}', estimator.method is {method})") from None


def _joint_inputs(config: Config, report: dict[str, Any]) -> list[JointInputs]:
    """Indices into `input_pdos` and the scaling that the boot read from the devices."""
    result = []
    told = [joint.number for joint in config.joints if joint.temperature]
    for number, joint in enumerate(config.joints):
        drive = report["nodes"][str(joint.node_id)]["scaling"]
        sensor_nm = 0.0
        if joint.sensor_channel is not None and config.sensor is not None:
            scaling = report["nodes"][str(config.sensor.node_id)]["scaling"]
            sensor_nm = scaling["nm_per_unit"][str(joint.sensor_channel)]
        result.append(
            JointInputs(
                position=2 * number,
                motion=2 * number + 1,
                sensor=sensor_index(config, joint.sensor_channel),
                motor_rad_per_count=drive["motor_rad_per_count"],
                motor_rad_s_per_unit=drive["motor_rad_s_per_unit"],
                link_rad_per_count=drive["link_rad_per_count"],
                ampere_per_unit=drive["ampere_per_unit"],
                sensor_nm_per_unit=sensor_nm,
                temperature=told.index(joint.number) if joint.temperature else None,
            )
        )
    return result


def loop_filters(config: Config) -> list[CanFilter]:
    """SYNC (own echo and foreign ones), the inputs, temperatures, the nodes' heartbeats: nothing else wakes the loop.

    Each in every frame format, so that 29-bit and remote frames under our identifiers are seen and counted.
    """
    inputs = input_pdos(config)
    pdos = [*(pdo.cob_id for pdo in inputs), *(each.cob_id for each in joint_temperatures(config))]
    nodes = dict.fromkeys(pdo.node_id for pdo in inputs)
    return [look_alikes(cob_id) for cob_id in (SYNC_COB_ID, *pdos, *(0x700 + node for node in nodes))]


def warm_up(estimators: list[AnyEstimator]) -> None:
    """Run every estimator often enough that caches, allocators and the interpreter's specialisation have settled."""
    for estimator in estimators:
        for n in range(_WARM_UP_STEPS):
            estimator.step(1e-3, 1.0 + 0.01 * (n % 7), 0.1 * n, 100.0, 0.001 * n, 25.0)
        estimator.reset()


def run(cycle: Cycle, grid: Grid, stop: Callable[[], bool], duration_s: float | None) -> None:
    """Cycle until `stop()` or the duration has passed ."""
    end_ns = None if duration_s is None else grid.slot_ns + round(duration_s * 1e9)
    monotonic_ns, sleep = time.monotonic_ns, time.sleep
    while not stop():
        pause = grid.slot_ns - monotonic_ns()
        if pause > 0:
            sleep(pause * 1e-9)
        now = monotonic_ns()
        if grid.too_late(now):
            cycle.skip(grid.advance(now) + 1)
            grid.missed += 1
            continue
        if end_ns is not None and grid.slot_ns >= end_ns:
            break
        if cycle.hold_back():
            grid.advance(now)
            continue
        cycle.begin()
        cycle.gather()
        cycle.observe()
        cycle.publish()
        cycle.record()
        cycle.skip(grid.advance(monotonic_ns()))


def _answer(**content: Any) -> None:
    try:
        print(json.dumps(content), flush=True)
    except BrokenPipeError:  # the supervisor has gone, and we are about to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _build(
    config: Config,
    request: dict[str, Any],
    report: dict[str, Any],
    socket: FrameSocket,
    estimators: list[AnyEstimator],
) -> tuple[Cycle, Grid]:
    grid = Grid(0, config.period_ns)
    snapshot = Snapshot(Path(request["snapshot"]), config.period_ns * 1e-9, float(request["worst_load"]))
    cycle = Cycle(
        socket,
        Intake(input_pdos(config), joint_temperatures(config)),
        list(zip(_joint_inputs(config, report), estimators, strict=True)),
        Ring(Path(request["ring"]), config.ring_cycles, RECORD_SIZE),
        snapshot,
        node_id=config.node_id,
        counter_overflow=config.counter_overflow,
        wait_ns=config.input_wait_ns,
        deadline_ns=config.input_deadline_ns,
        heartbeat_cycles=max(1, config.heartbeat_ms * 1_000_000 // config.period_ns),
        grid=grid,
    )
    return cycle, grid


def serve(request: dict[str, Any]) -> int:
    """Build, say ready, wait for the boot report, run, say what happened. Returns the exit status."""
    stop = _Stop()
    config = load_config(Path(request["config"]) if request["config"] else None)
    if config.sha256 != request["config_sha256"]:
        raise ConfigError(f"{config.path}: it changed while jtqd was starting")
    estimators = [build_estimator(config, joint) for joint in config.joints]
    warm_up(estimators)
    _answer(ready=True)
    line = _read_line(stop)
    if line is None:
        return 0
    socket = open_frame_socket(request["bus"], loop_filters(config), receive_own=True)
    cycle, grid = _build(config, request, json.loads(line), socket, estimators)
    refused = realtime.prepare(config.realtime.priority, config.realtime.cpu, config.realtime.lock_memory)
    realtime.freeze()
    _answer(running=True, refused=refused)
    grid.slot_ns = time.monotonic_ns() + 2 * config.period_ns
    error = None
    try:
        run(cycle, grid, lambda: stop.requested, request.get("duration_s"))
        cycle.leave()
    except BusGone as gone:
        error = f"the bus went away: {gone}"
    _answer(done=True, error=error, counters=cycle.intake.counters())
    return 1 if error else 0


def _read_line(stop: _Stop) -> str | None:
    """The boot report, or None when we are told to stop or the supervisor has gone."""
    while not stop.requested:
        if select.select([sys.stdin], [], [], 0.2)[0]:
            return sys.stdin.readline() or None
    return None


def main(argv: list[str]) -> int:
    """Entry of the process; every foreseeable failure is one JSON line and exit status 1."""
    try:
        return serve(json.loads(argv[0]))
    except (ConfigError, NetworkError, BusError) as error:
        _answer(failed=str(error))
        return 1
    except OSError as error:
        _answer(failed=f"shared memory: {error.strerror or error}")
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
