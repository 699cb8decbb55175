"""The loop process: build and warm up everything, then run one cycle after the other until the stop request.

The supervisor starts it as `python -m jtqd.daemon.loop.process` with a JSON request as its only argument. It answers on
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
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from jtqd.daemon.config import GUEST, LISTENER, MASTER, Config, JointConfig, as_booted, load_config
from jtqd.daemon.core.cycle import RUN_ENDED, SLOT_PASSED, Cycle, frame_counts
from jtqd.daemon.core.input_pdos import input_pdos, joint_inputs, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import contacts_of
from jtqd.daemon.core.schedule import Grid, SyncGrid
from jtqd.daemon.core.status import safety_of
from jtqd.daemon.loop import realtime
from jtqd.daemon.shared.cycle_record import Ring, layout_of
from jtqd.daemon.shared.processes import Child, ChildError, LoopWatchdog, Notifier, watchdog_seconds
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.drivers.bus_socket import CanFilter, any_format, exact
from jtqd.drivers.frame_socket import BusError, BusGone, FrameSocket, open_frame_socket
from jtqd.drivers.nmt import HEARTBEAT_BASE
from jtqd.drivers.own_objects import loop_cob_ids
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import Estimator, make_estimator
from jtqd.estimator.network import NetworkError, RuntimeCheck, load_network
from jtqd.estimator.settings import METHODS

_PATIENCE_S = 1.0
"""Without a sign of life of the supervisor, which comes twenty times a second, the watchdog is fed no longer than this."""
_HANDOVER_S = 1.0
"""From the first cycle: so long the boot may still send jtqd's heartbeat, until the supervisor has ended it."""
SLOTS = 8
"""Slots that pass without the interpreter: so late at most are signals, requests and the watchdog."""


class Duties:
    """Duties in the pauses of the loop, after every `SLOTS` cycles: the watchdog, and requests of the supervisor.

    The watchdog is fed only while the supervisor runs as well: a stopped one serves no node, no request and no log.
    """

    def __init__(self, cycle: Cycle, watchdog: LoopWatchdog) -> None:
        self._cycle, self._orders = cycle, cycle.snapshot.orders
        self._advanced, self._index = watchdog.advanced, cycle.index
        self._sign, self._sign_at = self._orders[4], self._index
        self._patience = round(_PATIENCE_S * 1e9 / cycle.grid.period_ns)
        self._claim_from = cycle.index + round(_HANDOVER_S * 1e9 / cycle.grid.period_ns)

    def __call__(self) -> None:
        """Run the duties after some cycles."""
        index, orders = self._cycle.index, self._orders
        if orders[4] != self._sign:
            self._sign, self._sign_at = orders[4], index
        if index - self._sign_at <= self._patience:
            self._advanced(index - self._index)
        self._index = index
        if index >= self._claim_from:
            self._cycle.intake.claims = True
        if (number := orders[0]) != orders[1]:
            self._cycle.reset_faults()
            orders[1] = number
        if (number := orders[2]) != orders[3]:
            self._cycle.configured_nodes.doubt()
            orders[3] = number


_WARM_UP_STEPS = 300
CHECK_PROGRAM = "jtqd.estimator.network"
_CHECK_S = 60.0


class Stop:
    """Set by SIGTERM and SIGINT; asked once per cycle."""

    def __init__(self) -> None:
        self.requested = False
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the supervisor decides

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def check_networks(config: Config) -> list[RuntimeCheck | str | None]:
    """Have ONNX Runtime check the networks of a start in a process of its own, which has ended before the loop begins.

    A graph of ours then runs natively on the bytes that were checked (their SHA-256 is part of the check). The loop loads
    ONNX Runtime (40 MB, and a library that may fail with a file it was not made for) only for other graphs. Returns per
    joint the check of its network, or why the network is refused; None: it has none.
    """
    networks = [joint.network for joint in config.joints]
    if not any(networks):
        return [None] * len(networks)
    child = Child(CHECK_PROGRAM, name="the check by ONNX Runtime")
    try:
        for each in networks:
            if each is not None:
                child.send([config.estimator.method, str(each.path), each.sha256])
        return [None if each is None else _check_of(child, str(each.path)) for each in networks]
    finally:
        child.end()


def _check_of(child: Child, path: str) -> RuntimeCheck | str:
    try:
        answer = child.answer(_CHECK_S)
    except ChildError as error:
        return f"{path}: {error}"
    return str(answer["refused"]) if "refused" in answer else RuntimeCheck(**answer)


def build_estimator(
    config: Config,
    joint: JointConfig,
    check: RuntimeCheck | str | None = None,
    notes: list[str] | None = None,
    *,
    shadow: bool = False,
) -> Estimator:
    """Build the estimator of one joint; notes takes lines for the operator. Raises ConfigError, NetworkError.

    check: of its network by `check_networks`, or why it is refused; None: ONNX Runtime checks it in this process.
    shadow: of a shadow method (`Config.shadows`), whose network must run natively: its time is then bounded.
    """
    method, network = config.estimator.method, None
    try:
        if isinstance(check, str):
            raise NetworkError(check)
        if joint.network is not None:
            network = load_network(method, str(joint.network.path), joint.network.sha256, check)
        if shadow and network is not None and network.perceptron is None:
            expected = "expected a graph with weights as jtq train writes them: a shadow method runs natively"
            raise network.error(f"found a graph that ONNX Runtime must run, {expected}")
        if network is None and METHODS[method].network_optional and notes is not None:
            notes.append(f"joint {joint.number}: no network, physics only")
        return make_estimator(joint.joint, config.estimator, network)
    except (ConfigError, NetworkError) as error:
        key, asks = f"joint_{joint.number}", "estimator.shadow has" if shadow else "estimator.method is"
        raise type(error)(f"{error} ({config.path}: '{key}', {asks} {method})") from None


def build_shadows(config: Config) -> list[list[Estimator]]:
    """Build the estimators of each joint's shadow methods. Raises ConfigError, NetworkError."""
    of_methods = [
        [
            build_estimator(each, joint, check, shadow=True)
            for joint, check in zip(each.joints, check_networks(each), strict=True)
        ]
        for each in config.shadows
    ]
    return [list(of_joint) for of_joint in zip(*of_methods, strict=True)]


def loop_filters(config: Config) -> list[CanFilter]:
    """Return filters for SYNC and the loop's own COB-IDs (echo and foreign), inputs, temperatures, the nodes' heartbeats.

    Those of others in every frame format, so that 29-bit and remote frames under their identifiers are seen and counted.
    """
    inputs = input_pdos(config)
    pdos = [*(pdo.cob_id for pdo in inputs), *(each.cob_id for each in joint_temperatures(config))]
    nodes = dict.fromkeys(pdo.node_id for pdo in inputs)
    others = (SYNC_COB_ID, *pdos, *(HEARTBEAT_BASE + node for node in nodes))
    own = set(own_cob_ids(config)) - set(pdos)
    commands = [exact(0x000)] if config.role == GUEST else []
    return [*map(any_format, others), *map(exact, sorted(own)), *commands]


def own_cob_ids(config: Config) -> tuple[int, ...]:
    """Return the COB-IDs that only the loop may use; none of a listener, which may stand beside another jtqd."""
    return () if config.role == LISTENER else loop_cob_ids(config.node_id)


def warm_up(estimators: list[Estimator]) -> None:
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
    """Cycle until `stop()` or `end_ns` (CLOCK_MONOTONIC); `duties` come in the pause after every `slots` slots."""
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
    estimators: list[Estimator],
    *,
    shadows: Sequence[Sequence[Estimator]] = (),
) -> tuple[Cycle, Grid]:
    """Build cycle and grid from configuration and boot report; shadows: of each joint, empty without."""
    grid = Grid(0, config.period_ns) if config.role == MASTER else SyncGrid(config.period_ns)
    snapshot = Snapshot(
        Path(request["snapshot"]),
        config.period_ns * 1e-9,
        float(report.get("worst_load", request["worst_load"])),
        len(config.joints),
    )
    for node in report.get("unchecked", ()):
        snapshot.unchecked[node] = 1
    intake = Intake(input_pdos(config), joint_temperatures(config), own_cob_ids(config))
    for node in {pdo.node_id for pdo in intake.pdos} - {int(node) for node in report["nodes"]}:
        intake.leave_out(node)
    cycle = Cycle(
        socket,
        intake,
        list(zip(joint_inputs(config, report), estimators, strict=True)),
        Ring(Path(request["ring"]), config.ring_cycles, layout_of(len(config.joints), bool(shadows)).size),
        snapshot,
        safety=safety_of(config),
        node_id=config.node_id,
        counter_overflow=config.counter_overflow,
        wait_ns=config.input_wait_ns,
        deadline_ns=config.input_deadline_ns,
        heartbeat_cycles=0
        if config.role == LISTENER
        else max(1, config.heartbeat_ms * 1_000_000 // config.period_ns),
        grid=grid,
        contacts=contacts_of(config),
        shadows=shadows,
    )
    return cycle, grid


def build_estimators(
    request: dict[str, Any], notes: list[str] | None = None
) -> tuple[Config, list[Estimator]]:
    """Load the configuration and warm up the estimators of all joints. Raises ConfigError, NetworkError."""
    config = load_config(Path(request["config"]) if request["config"] else None, request.get("role"))
    if config.files_sha256 != request["config_sha256"]:
        raise ConfigError(f"{config.path}: it or one of its joint files was changed during reading")
    estimators = [
        build_estimator(config, joint, check, notes)
        for joint, check in zip(config.joints, check_networks(config), strict=True)
    ]
    warm_up(estimators)
    return config, estimators


def serve(request: dict[str, Any]) -> int:
    """Build, report ready, wait for the boot report, run, report the end. Returns the exit status."""
    stop = Stop()
    notes: list[str] = []
    config, estimators = build_estimators(request, notes)
    shadows = build_shadows(config)
    notes += [f"shadow methods, never sent: {', '.join(config.shadow)}"] if shadows else []
    warm_up([each for of_joint in shadows for each in of_joint])
    answer(ready=True, notes=notes)
    line = read_line(stop)
    if line is None:
        return 0
    report = json.loads(line)
    config = as_booted(config, report["nodes"])
    socket = open_frame_socket(request["bus"], loop_filters(config), receive_own=True)
    cycle, grid = build_cycle(config, request, report, socket, estimators, shadows=shadows)
    refused = realtime.prepare(config.realtime.priority, config.realtime.cpu, config.realtime.lock_memory)
    duties = Duties(cycle, LoopWatchdog(Notifier(), cycle.grid.period_ns, watchdog_seconds()))
    realtime.freeze()
    answer(running=True, refused=refused)
    grid.slot_ns = time.monotonic_ns() + 2 * config.period_ns
    duration_s = request.get("duration_s")
    end_ns = None if duration_s is None else grid.slot_ns + round(duration_s * 1e9)
    if config.role == GUEST:
        cycle.reset_communication()
    error = None
    try:
        # A guest hears at any time that a node is changed: it looks after each cycle.
        slots = SLOTS if config.role == MASTER else 1
        run(cycle, grid, lambda: stop.requested, end_ns, duties, slots=slots)
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
