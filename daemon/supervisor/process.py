"""The supervisor: starts bench, loop, boot and recorder, shows the state of the loop, and ends all in order.

It also serves the own node. It has no thread and touches no frame of the cycle; if it is busy, or dies, no
cycle is late for it.
"""

from __future__ import annotations

import json
import os
import platform
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from jtqd.daemon.bus.boot import ReturningNodes, boot_request, bus_load_of, gear_ratio_error, own_eds
from jtqd.daemon.bus.service import BusService, nodes_of, sdo_timeouts_s, service_filters
from jtqd.daemon.config import MASTER, Config, Ros2Settings, as_booted
from jtqd.daemon.core.input_pdos import input_pdos, names_of_inputs, sensor_index
from jtqd.daemon.live import Address, LiveView
from jtqd.daemon.loop.realtime import stolen_s
from jtqd.daemon.recording.launch import RecorderProcess, recording_request
from jtqd.daemon.ros2 import Ros2Publisher
from jtqd.daemon.shared.conditions import THE_MACHINE, Conditions, ConditionsFile
from jtqd.daemon.shared.events import FILE as NOTICES
from jtqd.daemon.shared.events import Notices, OperatorLog, Priority
from jtqd.daemon.shared.processes import Child, ChildError, ChildSilence, StartChild
from jtqd.daemon.shared.runtime_dir import (
    About,
    AboutJoint,
    claim,
    instance_name,
    remove,
    start_ticks,
    versions,
    write_about,
)
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.daemon.supervisor.display import Display, Summary, summary_of
from jtqd.daemon.supervisor.health import Health
from jtqd.daemon.supervisor.service import Service
from jtqd.drivers import nmt
from jtqd.drivers.bus_load import BusLoad, BusLoadError, check_bus_load
from jtqd.drivers.drive import tpdos_as_json
from jtqd.drivers.frame_socket import BusError, FrameSocket, open_frame_socket
from jtqd.drivers.object_dictionary import ObjectStore, entries_from_json
from jtqd.estimator.settings import largest_difference_nm, largest_torque_nm

_WARM_UP_TIMEOUT_S = 60.0
"""Generous: a controller may load its libraries from a slow card; nothing is published meanwhile."""
_BOOT_REQUESTS = 100
"""SDO requests of a node's boot, at most; each may take the time that the configuration allows it."""

Stopped = Callable[[], bool]


class SupervisorError(Exception):
    """The daemon cannot start; the message is one line for the operator."""


class ConfigurationRefused(SupervisorError):  # noqa: N818 - what happens to the operator
    """The configuration, or a file that it names, cannot be used; the message is one line for the operator."""


def checked_load(config: Config) -> BusLoad:
    """Return the worst-case bus load of a configuration. Raises ConfigurationRefused if it is too high."""
    try:
        return check_bus_load(bus_load_of(config))
    except BusLoadError as error:
        raise ConfigurationRefused(f"{config.path}: {error}") from None


def log_directory(record: str | None) -> Path | None:
    """Return the log directory of the option `--record`, created if missing; None: no recording.

    A disk that is full, read-only or not permitted may change later: the recorder reports it and waits. Raises
    SupervisorError for a path that cannot be a directory.
    """
    if record == "none":
        return None
    if record is None:
        record = os.environ.get("LOGS_DIRECTORY", "").split(":")[0] or "logs"
    if not record:
        raise SupervisorError("--record '': expected a directory for logs, or none")
    directory = Path(record)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        text = f"--record {record}: found a file there, expected a directory for logs"
        raise SupervisorError(text) from None
    except FileNotFoundError:  # an existing parent without room for one: /proc, a broken link
        raise SupervisorError(f"--record {record}: the directory cannot be created") from None
    except OSError:
        pass
    return directory


def start_bench(config: Config, bus: str, start_child: StartChild) -> Child:
    """Start the emulated bench on `bus` ("unix:PATH"); `await_bench` waits for the bus."""
    path = Path(bus.removeprefix("unix:"))
    path.unlink(missing_ok=True)
    arguments = ["--bus", bus]
    if len(config.joints) != 2:
        arguments += ["--drives", str(len(config.joints))]
        arguments += [] if config.sensor else ["--no-sensor"]
    return start_child("jtqd.sim_can", arguments, "the emulated bench")


def await_bench(bus: str, bench: Child) -> None:
    """Wait until the emulated bench has opened its bus. Raises SupervisorError."""
    path = Path(bus.removeprefix("unix:"))
    deadline = time.monotonic() + _WARM_UP_TIMEOUT_S
    while not path.exists():
        if not bench.alive():
            raise SupervisorError(f"the emulated bench ended with exit status {bench.process.returncode}")
        if time.monotonic() > deadline:
            raise SupervisorError("the emulated bench did not open its bus")
        time.sleep(0.01)


def boot_nodes(config: Config, bus: str, child: Child, stopped: Stopped) -> dict[str, Any] | None:
    """Boot all nodes; the report holds their scaling. None after a stop order. Raises SupervisorError.

    The child sends jtqd's heartbeat until its input ends.
    """
    child.send(boot_request(config, bus).as_json())
    slowest_s = _BOOT_REQUESTS * sum(sdo_timeouts_s(config).values())
    report = wait_for(child, stopped, _WARM_UP_TIMEOUT_S + slowest_s)
    if report is not None and not report["ok"]:
        raise SupervisorError(report["error"]["message"])
    return report


def wait_for(child: Child, stopped: Stopped, longest_s: float = _WARM_UP_TIMEOUT_S) -> dict[str, Any] | None:
    """Return the child's next answer; None after a stop order.

    Raises ChildError where it ended or kept silent for too long, SupervisorError where it reports that it has failed
    (ConfigurationRefused where a file is the reason).
    """
    deadline = time.monotonic() + longest_s
    while not stopped():
        try:
            answer = child.answer(0.25)
        except ChildSilence:
            if time.monotonic() > deadline:
                raise ChildSilence(f"{child.name} did not answer within {longest_s:g} s") from None
            continue
        if "failed" in answer:
            failure = ConfigurationRefused if answer.get("configuration") else SupervisorError
            raise failure(str(answer["failed"]))
        return None if stopped() else answer
    return None


def about(config: Config, *, bus: str, instance: str, log_directory: Path | None) -> About:
    """Describe this process: a daemon on `bus` that logs to `log_directory` (None: nowhere)."""
    names = tuple(pdo.name for pdo in input_pdos(config))
    return About(
        bus=bus,
        instance=instance,
        pid=os.getpid(),
        started=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        started_ticks=start_ticks(os.getpid()) or 0,
        configuration=str(config.path.resolve()),
        configuration_sha256=config.sha256,
        method=config.estimator.method,
        node=config.node_id,
        bitrate=config.bitrate,
        period_us=config.period_ns // 1000,
        deadline_us=config.input_deadline_ns / 1000,
        heartbeat_ms=config.heartbeat_ms,
        joints=tuple(_about_joint(config, number, names) for number in range(len(config.joints))),
        sensor_node=config.sensor.node_id if config.sensor else None,
        inputs=names,
        log_directory=str(log_directory.resolve()) if log_directory else None,
        log_prefix=f"jtqd-{instance}-",
        versions=versions() | {"kernel": platform.release()},
        tpdos={str(joint.node_id): tpdos_as_json(joint.tpdos) for joint in config.joints},
    )


def _about_joint(config: Config, number: int, names: tuple[str, ...]) -> AboutJoint:
    joint = config.joints[number]
    sensor = sensor_index(config, joint.sensor_channel)
    rated = joint.joint.rated_torque_nm
    return AboutJoint(
        number=joint.number,
        name=joint.joint.name,
        node=joint.node_id,
        rated_torque_nm=rated,
        torque_limit_nm=largest_torque_nm(joint.joint, config.estimator),
        network=joint.network.path.name if joint.network else None,
        network_limit_nm=largest_difference_nm(joint.joint, config.estimator),
        inputs=names_of_inputs(config, number),
        sensor=None if sensor is None else names[sensor],
        temperature=joint.temperature is not None,
        contact_threshold_nm=None if config.contact is None else config.contact.threshold_of(rated),
    )


_LOOP_END_S = 3.0
_ON_HANGUP = (
    "SIGHUP ignored: a changed file takes effect at a restart; `jtq check --config FILE` judges it before"
)
_STOLEN_PERIOD_S = 1.0


class Supervisor:
    """One run of the daemon. Raises SupervisorError, ConfigError where it cannot start.

    Args:
        config, config_path: what was read, and from which file; None for the one that ships.
        bus: SocketCAN interface, "unix:PATH" or "sim".
        record: directory for logs, "none", or None for the default.
        duration_s: end by itself after this time, None to run until stopped.
        live: where to serve viewers, None for no live view.
        ros2: publish for ROS 2.
    """

    def __init__(  # noqa: PLR0917 - the command line's options
        self,
        config: Config,
        bus: str,
        config_path: Path | None,
        record: str | None,
        duration_s: float | None,
        live: Address | None = None,
        *,
        ros2: bool = False,
    ) -> None:
        self._config, self._config_path, self._duration_s = config, config_path, duration_s
        self._stop = self._hung_up = self._bus_gone = False
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)
        self._send: Callable[[bytes], bool] | None = None
        """Set as long as nodes that we have started are on the bus."""
        self._load = checked_load(config)
        if bus == "sim" and config.role != MASTER:
            raise SupervisorError(f"--bus sim: its bench has no master, which role {config.role} needs")
        self._log_directory = log_directory(record)
        self._sides: list[LiveView | Ros2Publisher] = [] if live is None else [LiveView(self._child, live)]
        self._sides += [Ros2Publisher(self._child, config.ros2 or Ros2Settings())] if ros2 else []
        try:
            self._directory, self._lock = claim(bus)
        except BlockingIOError as error:
            raise SupervisorError(f"{bus}: {error}: one jtqd per bus") from None
        except OSError as error:
            raise SupervisorError(f"no directory for shared memory: {error}") from None
        self._emulate = bus == "sim"
        self._bus = f"unix:{self._directory / 'bus'}" if self._emulate else bus
        self._instance = instance_name(bus)
        self._ring = self._directory / "ring"
        self._snapshot = self._directory / "snapshot"
        self._children: list[Child] = []
        self._recorder = RecorderProcess(self._child, self._directory)
        self._log = OperatorLog()
        self._conditions = Conditions()
        self._conditions_file = ConditionsFile(self._directory)
        self._health = Health(config, self._conditions)
        self._service = Service(
            config,
            self._directory,
            self._instance,
            self._log,
            save=self._recorder.save,
            conditions=self._conditions,
        )
        signal.signal(signal.SIGHUP, self._on_hangup)

    def stop(self) -> None:
        """End in order, as for SIGTERM."""
        self._stop = True

    def run(self) -> Summary | None:
        """Run to the end. None when it was stopped before the loop ran. Raises SupervisorError, BusError."""
        try:
            return self._run()
        except ChildError as error:
            raise SupervisorError(str(error)) from None
        except OSError as error:  # of the runtime directory: everything else has its own word for it
            where = error.filename or self._directory
            raise SupervisorError(f"{where}: {error.strerror or error}") from None
        finally:
            self._service.close()
            for child in reversed(self._children):
                child.end()
            self._leave()
            remove(self._directory)

    # Start ---------------------------------------------------------------------------------------------------------------

    def _run(self) -> Summary | None:
        if self._stop:
            return None
        self._about = self._own_description()
        write_about(self._directory, self._about)
        bench = start_bench(self._config, self._bus, self._child) if self._emulate else None
        # A bus that is not there starts nothing; the emulated one comes up while the others load.
        socket = None if bench is not None else self._open_bus()
        loop = self._child("jtqd.daemon.loop.process", [json.dumps(self._loop_request())], "the loop")
        boot = self._child("jtqd.drivers.boot", own_eds(self._config), "the boot")
        if bench is not None:
            await_bench(self._bus, bench)
        socket = self._open_bus() if socket is None else socket
        report = boot_nodes(self._config, self._bus, boot, self._stopped)
        if report is None:
            return None
        if self._config.role == MASTER:
            self._send = socket.send  # from here on the nodes are ours to put back
        for number, booted in report["nodes"].items():
            wrong = gear_ratio_error(self._config, int(number), booted.get("gear_ratio"))
            if wrong is not None:
                raise SupervisorError(wrong)
        self._take_layout(report)
        ready = wait_for(loop, self._stopped)
        if ready is None:
            return None
        for line in ready["notes"]:
            self._log(line, Priority.INFO)
        loop.send({**report, "worst_load": self._load.worst})
        running = wait_for(loop, self._stopped)
        if running is None:
            return None
        boot.end_of_input()
        for line in running["refused"]:
            self._log(f"not granted: {line}", Priority.WARNING)
        text = "; ".join(running["refused"])
        self._conditions.update("not_granted", THE_MACHINE, bool(text), time.monotonic(), text)
        reader = SnapshotReader(self._snapshot, supervisor=True)
        self._log.notices = Notices(self._directory / NOTICES)
        self._record(report)
        for side in self._sides:
            side.start(self._config, self._directory, self._instance)
        store = ObjectStore(entries_from_json(report["own_entries"]), self._config.node_id)
        self._bus_service = BusService(
            socket,
            self._config,
            report,
            reader=reader,
            store=store,
            returning=ReturningNodes(self._config, self._bus, report, self._child, self._log.event),
            conditions=self._conditions,
            log=self._log.event,
            directory=self._directory,
        )
        self._bus_service.begin(time.monotonic())
        self._report = report
        self._service.open(reader)
        began_s = time.monotonic()
        first_s = self._stolen_s = stolen_s()
        self._stolen_due_s = 0.0
        result = self._watch(loop, reader, bench)
        stolen = stolen_s() - first_s
        self._leave()
        failed = result.get("error") or result.get("failed")
        if failed:
            self._log(f"ended: {failed}", Priority.ERROR)
        recording = self._recorder.end(failed=bool(failed))
        return summary_of(
            reader,
            result,
            running["refused"],
            recording,
            history=self._conditions.history(time.monotonic()),
            began_s=began_s,
            stolen_s=stolen,
            contacts=self._config.contact is not None,
            deadline_us=self._config.input_deadline_ns / 1000,
            bench=self._emulate,
        )

    def _open_bus(self) -> FrameSocket:
        """Open the supervisor's socket. Raises BusError."""
        return open_frame_socket(self._bus, service_filters(self._config), error_frames=True)

    def _take_layout(self, report: dict[str, Any]) -> None:
        """Go on with the TPDOs that the drives have, where their mapping is fixed. Raises SupervisorError."""
        config = as_booted(self._config, report["nodes"])
        if config != self._config:
            self._config, self._load = config, checked_load(config)
            self._health = Health(config, self._conditions)
            self._about = replace(self._own_description(), started=self._about.started)
            write_about(self._directory, self._about)

    def _own_description(self) -> About:
        return about(self._config, bus=self._bus, instance=self._instance, log_directory=self._log_directory)

    def _record(self, report: dict[str, Any], *, again: bool = False) -> None:
        if self._log_directory is None:
            return
        request = recording_request(
            self._config, report, runtime=self._directory, directory=self._log_directory, bus=self._instance
        )
        if again:
            self._recorder.renew(request)
        else:
            self._recorder.start(request)

    def _child(self, module: str, arguments: list[str], name: str) -> Child:
        child = Child(module, arguments, name=name)
        # One that has ended is kept by who started it, as long as it matters: nodes may be booted for months.
        self._children[:] = [*(each for each in self._children if each.process.poll() is None), child]
        return child

    def _loop_request(self) -> dict[str, Any]:
        return {
            "config": str(self._config_path) if self._config_path else None,
            "role": self._config.role,
            "config_sha256": self._config.files_sha256,
            "bus": self._bus,
            "ring": str(self._ring),
            "snapshot": str(self._snapshot),
            "worst_load": self._load.worst,
            "duration_s": self._duration_s,
        }

    # Run -----------------------------------------------------------------------------------------------------------------

    def _watch(self, loop: Child, reader: SnapshotReader, bench: Child | None) -> dict[str, Any]:
        """Serve table, SDO requests and recorder until the loop ends; return the loop's last answer."""
        role = "" if self._config.role == MASTER else f" as {self._config.role}"
        title = f"jtqd on {self._instance}{role}, node {self._config.node_id:02X}h, {self._config.estimator.method}"
        stopping, node = 0.0, self._bus_service.own
        watched = self._config.contact is not None
        with Display(reader, self._config.bitrate, title, self._log, contacts=watched) as display:
            while True:
                sockets = [] if self._bus_gone else [self._bus_service.socket.fd]
                select.select([*loop.outputs, *sockets, *self._service.descriptors], [], [], 0.05)
                answer = loop.poll_answer()
                if answer is not None and answer.get("done"):
                    return answer
                if not loop.alive():
                    final = loop.poll_answer()
                    return final or {"error": f"the loop ended with exit status {loop.process.returncode}"}
                if bench is not None and not bench.alive():
                    text = f"the emulated bench ended with exit status {bench.process.returncode}"
                    self._log(text, Priority.ERROR)
                    bench = None
                if self._stop and not stopping:
                    stopping = time.monotonic()
                    self._service.stopping()
                    loop.process.send_signal(signal.SIGTERM)
                    loop.process.send_signal(signal.SIGCONT)  # a stopped one would sleep through it
                if stopping and time.monotonic() - stopping > _LOOP_END_S:
                    loop.process.kill()
                    return {"error": f"the loop did not end within {_LOOP_END_S:g} s"}
                if self._hung_up:
                    self._hung_up = False
                    self._log(_ON_HANGUP, Priority.NOTICE, "SIGHUP")
                self._recorder.watch()
                for side in self._sides:
                    side.watch()
                node.recorder_lost = self._recorder.lost
                reader.note_alive()
                view, now = reader.read(), time.monotonic()
                absent = self._bus_service.returning.absent
                self._health.observe(view, now, absent=absent, cycles_lost=node.recorder_lost)
                self._observe_stolen(now)
                self._serve(view, now)
                self._report_conditions(now)
                self._service.serve(view, node.recorder_lost)
                display.turn(now)

    def _observe_stolen(self, now: float) -> None:
        """Read once a second whether the hypervisor takes processor time."""
        if now < self._stolen_due_s:
            return
        self._stolen_due_s = now + _STOLEN_PERIOD_S
        before, self._stolen_s = self._stolen_s, stolen_s()
        self._conditions.update("stolen_time", THE_MACHINE, self._stolen_s > before, now)

    def _report_conditions(self, now: float) -> None:
        """Log the lines that are due and keep `conditions.json` up to date."""
        for line in self._conditions.lines(now):
            topic, node = line.definition.topic, line.subject.node
            self._log.event(topic, node, line.text, line.rate_class, line.severity)
        self._conditions_file.write(self._conditions.present())

    def _serve(self, view: View, now: float) -> None:
        """Run the own node's duties while there is a bus; the loop reports its end."""
        if self._bus_gone:
            return
        known = len(self._report["nodes"])
        try:
            self._bus_service.turn(view, now)
        except BusError:
            self._bus_gone = True
        if len(self._report["nodes"]) > known:  # one was absent at the start: the log needs its scaling
            self._record(self._report, again=True)

    def _stopped(self) -> bool:
        return self._stop

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.stop()

    def _on_hangup(self, number: int, frame: FrameType | None) -> None:
        self._hung_up = True

    # End -----------------------------------------------------------------------------------------------------------------

    def _leave(self) -> None:
        """Reset the started nodes to pre-operational, after the end of SYNC or a failed start."""
        send, self._send = self._send, None
        if send is None:
            return
        with suppress(BusError):
            for node in nodes_of(self._config):
                send(nmt.command(nmt.ENTER_PRE_OPERATIONAL, node))
