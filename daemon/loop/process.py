"""The loop process: everything is made and warmed up first, then one cycle after the other until told to stop.

Started by the supervisor as `python -m jtqd.daemon.loop.process` with a JSON request as its only argument. It answers on
standard output with one JSON line when it is ready, reads the boot report as one JSON line from standard input, runs, and
ends with one JSON line of results. It has no second thread, logs nothing while it runs, and shares only memory with
other processes.
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

from jtqd.daemon.config import Config, JointConfig, as_booted, load_config
from jtqd.daemon.core.contact import ContactWatch
from jtqd.daemon.core.cycle import RUN_ENDED, SLOT_PASSED, Cycle
from jtqd.daemon.core.input_pdos import (
    JointInputs,
    drive_places,
    first_inputs,
    input_pdos,
    joint_temperatures,
    sensor_index,
)
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint_safety import safety_of
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.core.snapshot import frame_counts
from jtqd.daemon.loop import realtime
from jtqd.daemon.loop.referee import judged
from jtqd.daemon.shared.cycle_record import layout_of
from jtqd.daemon.shared.ring import Ring
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.daemon.shared.systemd import LoopWatchdog, Notifier, watchdog_seconds
from jtqd.drivers.filters import CanFilter, any_format
from jtqd.drivers.frame_socket import BusError, BusGone, FrameSocket, open_frame_socket
from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.methods import AnyEstimator, AnyNetwork, make_estimator
from jtqd.estimator.network import FusedNetwork, load_network
from jtqd.estimator.onnx_graph import NetworkError, RuntimeCheck
from jtqd.estimator.settings import METHODS

_PATIENCE_S = 1.0
"""The supervisor turns twenty times a second; after so long without a turn the watchdog is fed no more."""
SLOTS = 8
"""Slots that pass without the interpreter: so late at most are signals, requests and the watchdog."""


class Duties:
    """Duties in the pauses of the loop: the watchdog, and requests of the supervisor.

    The watchdog is fed only while the supervisor turns as well: a stopped one serves no node, no order and no log.

    Call it in the pause after every `SLOTS` cycles. Costs one look at shared memory and now and then a datagram
    (docs/deployment.md).

    Args:
        cycle: the loop's.
        watchdog: to be fed.
    """

    def __init__(self, cycle: Cycle, watchdog: LoopWatchdog) -> None:
        self._cycle, self._orders = cycle, cycle.snapshot.orders
        self._advanced, self._index = watchdog.advanced, cycle.index
        self._turn, self._turned = self._orders[4], self._index
        self._patience = round(_PATIENCE_S * 1e9 / cycle.grid.period_ns)

    def __call__(self) -> None:
        """Run the duties after some cycles."""
        index = self._cycle.index
        orders = self._orders
        if orders[4] != self._turn:
            self._turn, self._turned = orders[4], index
        if index - self._turned <= self._patience:
            self._advanced(index - self._index)
        self._index = index
        if orders[0] != orders[1]:
            self._reset()
        if orders[2] != orders[3]:
            self._doubt()

    def _reset(self) -> None:
        number = self._orders[0]
        self._cycle.reset_faults()
        self._orders[1] = number

    def _doubt(self) -> None:
        number = self._orders[2]
        self._cycle.configured_nodes.doubt()
        self._orders[3] = number


_WARM_UP_STEPS = 300
_DRIVE_FACTORS = ("motor_rad_per_count", "motor_rad_s_per_unit", "link_rad_per_count", "ampere_per_unit")


class Stop:
    """Set by SIGTERM and SIGINT; asked once per cycle."""

    def __init__(self) -> None:
        self.requested = False
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the supervisor decides

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def physics_only(joint: JointConfig, network: AnyNetwork | None) -> str:
    """Return the line for the operator where no network corrects the physics; "" where one does."""
    if network is None or joint.network is None:
        return f"joint {joint.number}: no network, physics only"
    if isinstance(network, FusedNetwork) and not network.corrects:
        name = joint.network.path.name
        return f"joint {joint.number}: no network, physics only ({name} has the share 0: envelope and calibration only)"
    return ""


def build_estimator(
    config: Config,
    joint: JointConfig,
    verdict: RuntimeCheck | str | None = None,
    notes: list[str] | None = None,
) -> AnyEstimator:
    """Build the estimator of one joint as configured; raises ConfigError or NetworkError.

    verdict: of `referee.judged` on its network, or why it is refused; None: ONNX Runtime judges in this process.
    notes: takes what the operator is to know of it.
    """
    method, network = config.estimator.method, None
    try:
        if isinstance(verdict, str):
            raise NetworkError(verdict)
        if joint.network is not None:
            network = load_network(method, str(joint.network.path), joint.network.sha256, verdict)
        note = physics_only(joint, network) if METHODS[method].network_optional else ""
        if note and notes is not None:
            notes.append(note)
        return make_estimator(joint.joint, config.estimator, network)
    except (ConfigError, NetworkError) as error:
        key = f"joint_{joint.number}"
        raise type(error)(f"{error} ({config.path}: '{key}', estimator.method is {method})") from None


def _scaling(report: dict[str, Any], node: int, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the factors of a node; zeros for an absent one, whose factors come with its configuration."""
    booted = report["nodes"].get(str(node))
    return dict.fromkeys(names, 0.0) if booted is None else booted["scaling"]


def joint_inputs(config: Config, report: dict[str, Any]) -> list[JointInputs]:
    """Return places in `input_pdos` and the scaling that the boot read from the devices."""
    result, firsts = [], first_inputs(config)
    measured = [joint.number for joint in config.joints if joint.temperature]
    for number, joint in enumerate(config.joints):
        drive = _scaling(report, joint.node_id, _DRIVE_FACTORS)
        sensor_nm = 0.0
        if joint.sensor_channel is not None and config.sensor is not None:
            scaling = _scaling(report, config.sensor.node_id, ("nm_per_unit",))
            sensor_nm = scaling["nm_per_unit"][str(joint.sensor_channel)] if scaling["nm_per_unit"] else 0.0
        result.append(
            JointInputs(
                places=drive_places(firsts[number], joint.tpdos, joint.objects),
                sensor=sensor_index(config, joint.sensor_channel),
                **drive,
                sensor_nm_per_unit=sensor_nm,
                temperature=measured.index(joint.number) if joint.temperature else None,
            )
        )
    return result


def contacts_of(config: Config) -> ContactWatch | None:
    """Return the detectors of contacts as configured; None for none."""
    contact = config.contact
    if contact is None:
        return None
    thresholds = [contact.threshold_of(joint.joint.rated_torque_nm) for joint in config.joints]
    return ContactWatch(
        thresholds, opposed=contact.opposed, sends=contact.pdo, period_s=config.period_ns * 1e-9
    )


def loop_filters(config: Config) -> list[CanFilter]:
    """Return filters for SYNC (own echo and foreign), inputs, temperatures and the nodes' heartbeats.

    Each in every frame format, so that 29-bit and remote frames under our identifiers are seen and counted.
    """
    inputs = input_pdos(config)
    pdos = [*(pdo.cob_id for pdo in inputs), *(each.cob_id for each in joint_temperatures(config))]
    nodes = dict.fromkeys(pdo.node_id for pdo in inputs)
    return [any_format(cob_id) for cob_id in (SYNC_COB_ID, *pdos, *(HEARTBEAT_BASE + node for node in nodes))]


def warm_up(estimators: list[AnyEstimator]) -> None:
    """Run every estimator often enough that caches, allocators and the interpreter's specialisation have settled."""
    for estimator in estimators:
        for n in range(_WARM_UP_STEPS):
            estimator.step(1e-3, 1.0 + 0.01 * (n % 7), 0.1 * n, 100.0, 0.001 * n, 25.0)
        estimator.reset()


def run(
    cycle: Cycle,
    grid: Grid,
    stop: Callable[[], bool],
    end_ns: int | None = None,
    duties: Callable[[], None] | None = None,
    *,
    slots: int = SLOTS,
) -> None:
    """Cycle until `stop()` or `end_ns`.

    Args:
        cycle, grid: state of the loop; the first cycle is that of the grid's slot.
        stop: asked before a cycle.
        end_ns: no cycle begins from here on (CLOCK_MONOTONIC); None: without end.
        duties: called in the pause after every `slots` slots.
    """
    passed = False
    while not stop():
        outcome = cycle.go_on(1 if passed or duties is None else slots, end_ns or 0)
        if outcome == RUN_ENDED:
            break
        passed = outcome == SLOT_PASSED  # then the duties wait for the very next cycle
        if passed:
            continue
        if duties is not None:
            duties()
        cycle.skip(grid.advance(time.monotonic_ns()))


def answer(**content: Any) -> None:
    """Send one JSON line to the supervisor."""
    try:
        print(json.dumps(content), flush=True)
    except BrokenPipeError:  # the supervisor has gone, and we are about to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_cycle(
    config: Config,
    request: dict[str, Any],
    report: dict[str, Any],
    socket: FrameSocket,
    estimators: list[AnyEstimator],
) -> tuple[Cycle, Grid]:
    """Build cycle and grid from configuration and boot report."""
    grid = Grid(0, config.period_ns)
    snapshot = Snapshot(
        Path(request["snapshot"]),
        config.period_ns * 1e-9,
        float(report.get("worst_load", request["worst_load"])),
        len(config.joints),
    )
    intake = Intake(input_pdos(config), joint_temperatures(config))
    for node in {pdo.node_id for pdo in intake.pdos} - {int(node) for node in report["nodes"]}:
        intake.leave_out(node)
    cycle = Cycle(
        socket,
        intake,
        list(zip(joint_inputs(config, report), estimators, strict=True)),
        Ring(Path(request["ring"]), config.ring_cycles, layout_of(len(config.joints)).size),
        snapshot,
        safety=safety_of(config),
        node_id=config.node_id,
        counter_overflow=config.counter_overflow,
        wait_ns=config.input_wait_ns,
        deadline_ns=config.input_deadline_ns,
        heartbeat_cycles=max(1, config.heartbeat_ms * 1_000_000 // config.period_ns),
        grid=grid,
        contacts=contacts_of(config),
    )
    return cycle, grid


def build_estimators(
    request: dict[str, Any], notes: list[str] | None = None
) -> tuple[Config, list[AnyEstimator]]:
    """Load the configuration and warm up the estimators of all joints; raises ConfigError or NetworkError.

    notes: as in `build_estimator`.
    """
    config = load_config(Path(request["config"]) if request["config"] else None)
    if config.files_sha256 != request["config_sha256"]:
        raise ConfigError(f"{config.path}: it or one of its joint files was changed during reading")
    estimators = [
        build_estimator(config, joint, verdict, notes)
        for joint, verdict in zip(config.joints, judged(config), strict=True)
    ]
    warm_up(estimators)
    return config, estimators


def serve(request: dict[str, Any]) -> int:
    """Build, report ready, wait for the boot report, run, report the end. Returns the exit status."""
    stop = Stop()
    notes: list[str] = []
    config, estimators = build_estimators(request, notes)
    answer(ready=True, notes=notes)
    line = read_line(stop)
    if line is None:
        return 0
    report = json.loads(line)
    config = as_booted(config, report["nodes"])
    socket = open_frame_socket(request["bus"], loop_filters(config), receive_own=True)
    cycle, grid = build_cycle(config, request, report, socket, estimators)
    refused = realtime.prepare(config.realtime.priority, config.realtime.cpu, config.realtime.lock_memory)
    duties = Duties(cycle, LoopWatchdog(Notifier(), cycle.grid.period_ns, watchdog_seconds()))
    realtime.freeze()
    answer(running=True, refused=refused)
    grid.slot_ns = time.monotonic_ns() + 2 * config.period_ns
    duration_s = request.get("duration_s")
    end_ns = None if duration_s is None else grid.slot_ns + round(duration_s * 1e9)
    error = None
    try:
        run(cycle, grid, lambda: stop.requested, end_ns, duties)
        cycle.leave()
    except BusGone as gone:
        error = str(gone)
    answer(done=True, error=error, counters=frame_counts(cycle.intake))
    return 1 if error else 0


def read_line(stop: Stop) -> str | None:
    """Return the boot report, or None on a stop order or when the supervisor has ended."""
    while not stop.requested:
        if select.select([sys.stdin], [], [], 0.2)[0]:
            return sys.stdin.readline() or None
    return None


def main(argv: list[str]) -> int:
    """Run the process; every foreseeable failure is one JSON line and exit status 1."""
    try:
        return serve(json.loads(argv[0]))
    except (ConfigError, NetworkError, BusError) as error:
        answer(failed=str(error), configuration=not isinstance(error, BusError))
        return 1
    except OSError as error:
        answer(failed=f"{error.filename or 'shared memory'}: {error.strerror or error}")
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
