"""The supervisor: starts bench, loop, boot and recorder, shows how the loop is doing, ends all in order.

It also serves the own node. It has no thread and touches no frame of the cycle; if it is busy, or dies, no
cycle is late for it.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.live import Live

from daemon.boot_request import boot_request
from daemon.children import Child, ChildError, ChildSilence
from daemon.config import Config
from daemon.deviation_watch import DeviationWatch
from daemon.input_watch import InputWatch
from daemon.live_table import LiveTable, plain_line
from daemon.load import bus_load_of
from daemon.own_node import OwnNode
from daemon.recorder_progress import Account, ProgressFile
from daemon.recording_request import recording_request
from daemon.returning_nodes import ReturningNodes
from daemon.runtime_dir import claim, instance_name, remove
from daemon.snapshot import SnapshotReader, View
from daemon.summary import Summary
from drivers.bus_load import BusLoad, BusLoadError, check_bus_load
from drivers.errors import BusError
from drivers.frame import pack
from drivers.frame_socket import exact, open_frame_socket
from drivers.object_dictionary import ObjectStore, entries_from_json

_WARM_UP_TIMEOUT_S = 60.0
"""Generous: a controller that loads its libraries from a slow card may take its time; nothing is published meanwhile."""
_TABLE_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0
_NMT_PRE_OPERATIONAL = 0x80
_BENCH_PRIORITY = 40
_RECORDER_STARTS = 5
_LOOP_END_S = 3.0


class SupervisorError(Exception):
    """The daemon cannot start; the message is one line for the operator."""


class Supervisor:
    """One run of the daemon.

    Args:
        config: what was read from `config_path`.
        bus: SocketCAN interface, "unix:PATH" or "sim".
        config_path: the file, None for the one that ships.
        record: directory for logs, "none", or None for the default.
        duration_s: end by itself after this time, None to run until told.
    """

    def __init__(
        self, config: Config, bus: str, config_path: Path | None, record: str | None, duration_s: float | None
    ) -> None:
        self._config = config
        self._config_path = config_path
        self._duration_s = duration_s
        self._stop = False
        self._started = time.time()
        self._bus_gone = False
        self._load = _checked_load(config)
        try:
            self._directory, self._lock = claim(bus)
        except BlockingIOError as error:
            raise SupervisorError(f"{bus}: {error}: one jtqd per bus") from None
        except OSError as error:
            raise SupervisorError(f"no directory for shared memory: {error}") from None
        self._emulate = bus == "sim"
        self._bus = f"unix:{self._directory / 'bus'}" if self._emulate else bus
        self._instance = instance_name(bus)
        self._log_directory = _log_directory(record)
        self._ring = self._directory / "ring"
        self._snapshot = self._directory / "snapshot"
        self._progress = self._directory / "recorded"
        self._children: list[Child] = []
        self._recorder: Child | None = None
        self._recorder_starts: list[float] = []
        self._recording: dict[str, Any] | None = None
        self._inputs, self._deviation = InputWatch(config), DeviationWatch()
        self._console = Console(stderr=True)

    def run(self) -> Summary | None:
        """Run to the end. None when it was stopped before the loop ran.

        Raises:
            SupervisorError, BusError: it could not start.
        """
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        try:
            return self._run()
        except ChildError as error:
            raise SupervisorError(str(error)) from None
        finally:
            for child in reversed(self._children):
                child.end()
            remove(self._directory)

    # Start ---------------------------------------------------------------------------------------------------------------

    def _run(self) -> Summary | None:
        bench = self._start_bench() if self._emulate else None
        socket = open_frame_socket(self._bus, [exact(0x600 + self._config.node_id)])
        loop = self._child("daemon.loop", [json.dumps(self._loop_request())], "the loop")
        report = self._boot()
        ready = self._wait(loop)
        if ready is None or self._stop:
            return None
        _check(ready)
        loop.tell(report)
        running = self._wait(loop)
        if running is None or self._stop:
            return None
        _check(running)
        for line in running["refused"]:
            print(f"jtqd: not granted: {line}", file=sys.stderr)
        reader = SnapshotReader(self._snapshot, supervisor=True)
        self._returning = ReturningNodes(self._config, self._bus, report, self._child)
        self._start_recorder(report)
        store = ObjectStore(entries_from_json(report["own_entries"]), self._config.node_id)
        node = OwnNode(socket, store, self._config, reader)
        result = self._watch(loop, node, reader, bench)
        self._leave(socket.send)
        self._end_recorder()
        return self._summary(reader, result, running["refused"])

    def _child(self, module: str, arguments: list[str], name: str) -> Child:
        child = Child(module, arguments, name=name)
        self._children.append(child)
        return child

    def _start_bench(self) -> Child:
        path = Path(self._bus.removeprefix("unix:"))
        path.unlink(missing_ok=True)
        bench = self._child("sim_can", ["--bus", self._bus], "the emulated bench")
        deadline = time.monotonic() + _WARM_UP_TIMEOUT_S
        while not path.exists():
            if not bench.alive():
                raise SupervisorError(f"the emulated bench ended with exit status {bench.process.returncode}")
            if time.monotonic() > deadline:
                raise SupervisorError("the emulated bench did not open its bus")
            time.sleep(0.01)
        if self._config.realtime.priority > _BENCH_PRIORITY:
            # The emulated nodes stand for hardware: they come before everything but the loop.
            with suppress(PermissionError):
                os.sched_setscheduler(bench.pid, os.SCHED_FIFO, os.sched_param(_BENCH_PRIORITY))
        return bench

    def _loop_request(self) -> dict[str, Any]:
        return {
            "config": str(self._config_path) if self._config_path else None,
            "config_sha256": self._config.sha256,
            "bus": self._bus,
            "ring": str(self._ring),
            "snapshot": str(self._snapshot),
            "worst_load": self._load.worst,
            "duration_s": self._duration_s,
        }

    def _boot(self) -> dict[str, Any]:
        """Boot all nodes; the report holds their scaling."""
        child = self._child("drivers.boot", [], "the boot")
        child.tell(boot_request(self._config, self._bus))
        child.end_of_input()
        report = self._wait(child)
        if report is None:
            raise SupervisorError("stopped while booting the nodes")
        if not report["ok"]:
            raise SupervisorError(report["error"]["message"])
        for joint in self._config.joints:
            _check_gear_ratio(joint.number, joint.node_id, joint.joint.gear_ratio, joint.joint_path, report)
        return report

    def _wait(self, child: Child) -> dict[str, Any] | None:
        """The child's next answer; None when we were told to stop."""
        deadline = time.monotonic() + _WARM_UP_TIMEOUT_S
        while not self._stop:
            try:
                return child.answer(0.25)
            except ChildSilence:
                if time.monotonic() > deadline:
                    raise
        return None

    # Run -----------------------------------------------------------------------------------------------------------------

    def _watch(
        self, loop: Child, node: OwnNode, reader: SnapshotReader, bench: Child | None
    ) -> dict[str, Any]:
        """Until the loop ends: table, SDO requests, recorder. Returns the loop's last answer."""
        terminal = self._console.is_terminal
        title = f"jtqd on {self._instance}, node {self._config.node_id:02X}h, {self._config.estimator.method}"
        previous = reader.read()
        shown = time.monotonic()
        stopping = 0.0
        with Live(console=self._console, auto_refresh=False, transient=False) as live:
            while True:
                select.select([*loop.outputs, *([] if self._bus_gone else [node.socket.fd])], [], [], 0.05)
                self._serve(node)
                answer = loop.poll_answer()
                if answer is not None and answer.get("done"):
                    return answer
                if not loop.alive():
                    final = loop.poll_answer()
                    return final or {"error": f"the loop ended with exit status {loop.process.returncode}"}
                if bench is not None and not bench.alive():
                    print(
                        f"jtqd: the emulated bench ended with exit status {bench.process.returncode}",
                        file=sys.stderr,
                    )
                    bench = None
                if self._stop and not stopping:
                    stopping = time.monotonic()
                    loop.process.send_signal(signal.SIGTERM)
                    loop.process.send_signal(signal.SIGCONT)  # a stopped one would sleep through it
                if stopping and time.monotonic() - stopping > _LOOP_END_S:
                    loop.process.kill()
                    return {"error": f"the loop did not end within {_LOOP_END_S:g} s"}
                self._watch_recorder(node)
                view, now = reader.read(), time.monotonic()
                self._returning.watch(view, reader.note_configured)
                for line in (*self._inputs.lines(view, now), *self._deviation.lines(view, now)):
                    print(f"jtqd: {line}", file=sys.stderr, flush=True)
                if now - shown >= (_TABLE_PERIOD_S if terminal else _LOG_PERIOD_S):
                    previous, shown = self._show(live, terminal, reader, previous, title), now

    def _serve(self, node: OwnNode) -> None:
        """The own node's duties, for as long as there is a bus; what became of it the loop says."""
        if self._bus_gone:
            return
        try:
            node.serve()
            node.watch()
        except BusError:
            self._bus_gone = True

    def _show(self, live: Live, terminal: bool, reader: SnapshotReader, previous: View, title: str) -> View:
        view = reader.read()
        if terminal:
            live.update(LiveTable(reader, previous, view, self._config.bitrate, title), refresh=True)
        else:
            print(plain_line(reader, previous, view, self._config.bitrate), file=sys.stderr, flush=True)
        return view

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._stop = True

    # Recorder ------------------------------------------------------------------------------------------------------------

    def _start_recorder(self, report: dict[str, Any]) -> None:
        if self._log_directory is None:
            return
        request = recording_request(
            self._config,
            report,
            directory=self._log_directory,
            ring=self._ring,
            progress=self._progress,
            snapshot=self._snapshot,
            instance=self._instance,
        )
        self._progress.unlink(missing_ok=True)
        (self._directory / "recorder.json").write_text(json.dumps(request), encoding="utf-8")
        self._run_recorder()

    def _run_recorder(self) -> None:
        now = time.monotonic()
        self._recorder_starts = [*(start for start in self._recorder_starts if now - start < 60.0), now]
        self._recorder = self._child(
            "daemon.recorder", [str(self._directory / "recorder.json")], "the recorder"
        )

    def _watch_recorder(self, node: OwnNode) -> None:
        """A recorder that died is started again and goes on where it was; at most once a second, and not for ever."""
        if self._recorder is None:
            return
        if self._progress.exists():
            node.recorder_lost = ProgressFile(self._progress).load().lost
        if self._recorder.alive():
            return
        if len(self._recorder_starts) > _RECORDER_STARTS:
            print("jtqd: the recorder died too often; the loop goes on without a log", file=sys.stderr)
            self._recording, self._recorder = self._account("the recorder died too often"), None
        elif time.monotonic() - self._recorder_starts[-1] > 1.0:
            code = self._recorder.process.returncode
            print(
                f"jtqd: the recorder ended with exit status {code}; started again, the loop goes on",
                file=sys.stderr,
            )
            self._run_recorder()

    def _account(self, error: str) -> dict[str, Any]:
        """What the recorder left behind that could not say it itself; what nobody wrote counts as lost."""
        settled = ProgressFile(self._progress).load() if self._progress.exists() else Account()
        cycles = SnapshotReader(self._snapshot).read().counters["cycles"]
        return {
            "path": None,
            "cycles": cycles,
            "written": settled.written,
            "lost": cycles - settled.written,
            "error": error,
        }

    def _end_recorder(self) -> None:
        if self._recorder is None:
            return
        self._recorder.process.send_signal(signal.SIGTERM)
        self._recorder.process.send_signal(signal.SIGCONT)  # a stopped one would sleep through it
        try:
            self._recording = self._recorder.answer(10.0)
        except ChildError as error:
            self._recording = self._account(str(error))

    # End -----------------------------------------------------------------------------------------------------------------

    def _leave(self, send: Any) -> None:
        """The SYNC has ended with the loop: put the nodes that we started back to pre-operational."""
        nodes = [joint.node_id for joint in self._config.joints]
        nodes += [self._config.sensor.node_id] if self._config.sensor else []
        for node in nodes:
            try:
                send(pack(0x000, bytes((_NMT_PRE_OPERATIONAL, node))))
            except BusError:
                return

    def _leftovers(self) -> list[str]:
        """Files of this run whose recorder died before it could end them."""
        if self._log_directory is None or len(self._recorder_starts) < 2:
            return []
        files = self._log_directory.glob(f"jtqd-{self._instance}-*.mcap.active")
        return sorted(str(file) for file in files if file.stat().st_mtime >= self._started)

    def _summary(self, reader: SnapshotReader, result: dict[str, Any], refused: list[str]) -> Summary:
        view = reader.read()
        if self._recording is not None:
            self._recording["left"] = self._leftovers()
        p50, p99, worst = reader.work_us(0.5, 0.99, 1.0)
        late50, late99, late_worst = reader.late_us(0.5, 0.99, 1.0)
        return Summary(
            cycles=view.counters["cycles"],
            missed=view.counters["missed"],
            stale_inputs=view.counters["stale_inputs"],
            work_us=(p50, p99, worst),
            late_us=(late50, late99, late_worst),
            rmse_nm=view.rmse_nm,
            counters=view.counters,
            refused=tuple(refused),
            recording=self._recording,
            error=result.get("error") or result.get("failed"),
            inputs=result.get("counters", {}),
            deviations=(self._deviation.episodes[0], self._deviation.episodes[1]),
        )


def _checked_load(config: Config) -> BusLoad:
    try:
        return check_bus_load(bus_load_of(config))
    except BusLoadError as error:
        raise SupervisorError(f"{config.path}: {error}") from None


def _check_gear_ratio(number: int, node: int, expected: float, path: Path, report: dict[str, Any]) -> None:
    """A drive that tells another gear ratio (6091h) than the joint file belongs to another joint."""
    found = report["nodes"][str(node)].get("gear_ratio")
    if found and abs(found - expected) > 0.005 * expected:
        raise SupervisorError(
            f"node {node}: 6091h gear ratio: expected {expected:g} ({path}, joint {number}), found {found:g}"
        )


def _check(answer: dict[str, Any]) -> None:
    if "failed" in answer:
        raise SupervisorError(str(answer["failed"]))


def _log_directory(record: str | None) -> Path | None:
    if record == "none":
        return None
    if record is None:
        record = os.environ.get("LOGS_DIRECTORY", "").split(":")[0] or "logs"
    return Path(record)
