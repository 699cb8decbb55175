"""The bench of a campaign: jtqd's configuration as the commander takes it, the load of the bus, the motion, and processes.

jtqd is a process of its own for every run, and so is the emulated bench. In exact time the whole campaign runs in the bench
kernel, whose clock waits for the processes (docs/testing.md): the same jtqd, commander and emulated drives on SocketCAN miss
no cycle, however busy the machine is.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn

from jtqd.daemon.config import Config, JointConfig, SensorConfig, load_config
from jtqd.drivers.bus_load import BusLoad, BusLoadError, Row, check_bus_load, configured_load, heartbeat_row
from jtqd.drivers.bus_socket import PREFIX, exact
from jtqd.drivers.drive import CIA_402, DriveProfile, Temperature
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.own_objects import COMMANDER_NODE
from jtqd.drivers.sdo import Key, label, parse_key
from jtqd.drivers.sensor import SensorProfile
from jtqd.estimator.decoder import FieldError, below, in_file
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.joint import Joint
from jtqd.sim_can.bench_kernel import build, guest
from jtqd.sysid.motion.setpoints import Limits, MotionResult, OutOfPlaceError, Setpoints, Surroundings, Timing
from jtqd.sysid.motion.shell import Progress, play
from jtqd.sysid.planner.campaigns import allowed_torque, approach
from jtqd.sysid.planner.design import current_at

_LONGEST_PERIOD_MS: Final = 10
_SETPOINT_RPDO: Final = 0x200  # or 300h+n: either way four bytes
_RPDO_BYTES: Final = 4
"""RPDO1: 6040h and 6071h; RPDO2: 60FFh."""
_COMMANDER_PRIORITY: Final = 30


@dataclass(frozen=True)
class BenchConfig:
    """jtqd's configuration of the bench: parameters and drives of joints 1, 2, ..., and the sensor, if there is one."""

    config: Config
    joints: tuple[Joint, ...]
    drives: tuple[DriveProfile, ...]
    sensor: SensorProfile | None

    @classmethod
    def load(cls, path: Path | None) -> BenchConfig:
        """Read a configuration of jtqd (None: the one that ships).

        Raises ConfigError, also for a period of SYNC that is no whole milliseconds up to 10, and for drives whose velocity,
        current or state are not in the objects that command them (CiA 402).
        """
        config = load_config(path)
        with in_file(str(config.path)):
            if config.period_ns % 1_000_000 or config.period_ns > _LONGEST_PERIOD_MS * 1_000_000:
                expected = f"whole milliseconds up to {_LONGEST_PERIOD_MS} for a campaign: set-points are that far apart"
                raise FieldError("sync", "sync.period_us", config.period_ns // 1000, expected)
            drives = []
            for joint in config.joints:
                with below(f"joint_{joint.number}"):
                    drives.append(_drive(joint))
        sensor = None if config.sensor is None else _sensor(config.sensor)
        return cls(config, tuple(joint.joint for joint in config.joints), tuple(drives), sensor)

    @property
    def path(self) -> Path:
        """The file."""
        return self.config.path

    @property
    def channels(self) -> tuple[int | None, ...]:
        """Channel of the torque sensor of each joint; None: it has none."""
        return tuple(joint.sensor_channel for joint in self.config.joints)

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node-IDs of the drives."""
        return tuple(drive.node_id for drive in self.drives)

    @property
    def period_s(self) -> float:
        """Period of SYNC."""
        return 1e-9 * self.config.period_ns

    def may_have(self, joints: Mapping[int, Joint]) -> bool:
        """Return whether joints, by number, may be those of the bench, by gear ratio, torque constant and rating."""

        def known_by(joint: Joint) -> tuple[float, float, float]:
            return joint.gear_ratio, joint.torque_constant_nm_per_a, joint.rated_torque_nm

        own = {number: known_by(joint) for number, joint in enumerate(self.joints, 1)}
        return all(own.get(number) == known_by(joint) for number, joint in joints.items())

    def measured(self, number: int) -> bool:
        """Return whether a channel of the torque sensor belongs to the joint."""
        return self.sensor is not None and self.channels[number - 1] is not None

    def check_temperature(self, limit_c: float) -> None:
        """Refuse a limit of the temperature where jtqd does not receive that of a joint. Raises ConfigError.

        The commander cannot switch TPDO3 on: jtqd would take the drive for a changed one and drop its inputs.
        """
        for number, joint in enumerate(self.config.joints, 1):
            if joint.temperature is None and math.isfinite(limit_c):
                raise ConfigError(
                    f"{self.path}: joint_{number}: found no 'temperature: true', expected it for the limit of {limit_c:g} "
                    "degC (--limit temperature_c=none: not supervised)"
                )

    def timing(self, timing: Timing) -> Timing:
        """Return the supervision's times at this period of SYNC: a set-point leaves at the same part of the cycle."""
        delay_s = timing.setpoint_delay_s / timing.period_s * self.period_s
        return replace(timing, period_s=self.period_s, setpoint_delay_s=delay_s)

    def around(self, run: Setpoints) -> Surroundings:
        """Return the joints and sensor channels of the bus that are not moved by a run.

        A joint that is held may take the current of its rated torque.
        """
        held = {
            number: current_at(joint, allowed_torque(joint), 0.0)
            for number, joint in enumerate(self.joints, 1)
            if number not in run.joints
        }
        own: dict[int, tuple[int, ...]] = {}
        for number in run.joints:
            channel = self.channels[number - 1]
            if channel is not None:
                own[channel] = (*own.get(channel, ()), number)
        # two joints alone on the bus: every channel of the sensor is theirs, named in the configuration or not
        return Surroundings(held, None if len(run.joints) == 2 == len(self.joints) else own)

    def load_with_commander(self) -> BusLoad:
        """Return the load of the bus during a campaign: jtqd's configuration, the commander's heartbeat and set-points.

        Set-points go to the drives in turn, one RPDO in a cycle. Raises ConfigError above 95 % in the worst case, or for two
        users of one COB-ID.
        """
        config = self.config
        share = 1.0 / len(self.nodes)
        extra = [heartbeat_row("commander", COMMANDER_NODE, round(Timing().own_heartbeat_s * 1e3))]
        extra += [
            Row(_SETPOINT_RPDO + node, f"set-points of drive {node}", _RPDO_BYTES, share)
            for node in self.nodes
        ]
        try:
            return check_bus_load(
                configured_load(
                    {joint.node_id: joint.tpdos for joint in config.joints},
                    {} if self.sensor is None else {self.sensor.node_id: self.sensor.channels},
                    temperatures=self.nodes,
                    contacts=config.contact is not None and config.contact.pdo,
                    heartbeat_ms=config.heartbeat_ms,
                    master=config.node_id,
                    extra=extra,
                    bitrate=config.bitrate,
                    period_s=self.period_s,
                )
            )
        except BusLoadError as error:
            raise ConfigError(f"{self.path}: with the commander's set-points: {error}") from None


def _sensor(sensor: SensorConfig) -> SensorProfile:
    words = {int(word, 16): nm for word, nm in sensor.unit_words.items()}
    identity = Identity(**asdict(sensor.identity))
    return SensorProfile(sensor.node_id, identity, sensor.channels, _by_key(sensor.given), words)


def _by_key(given: Mapping[str, int]) -> dict[Key, int]:
    return {parse_key(name): value for name, value in given.items()}


def _drive(joint: JointConfig) -> DriveProfile:
    """Return the drive of a joint, as far as it can be commanded.

    60FFh counts as 606Ch does, and 6071h as 6077h, or as 6078h of 6075h. Raises FieldError where velocity or current come
    from other objects, with another sign, or not at each SYNC: the motion would not be the planned one.
    """
    objects = joint.objects

    def refuse(key: str, found: str, expected: str) -> NoReturn:
        raise FieldError(f"joint_{joint.number}", key, Verbatim(found), expected)

    if joint.max_age_ms:
        refuse(
            "max_age_ms",
            f"{joint.max_age_ms:g}",
            "none for a campaign: a motion needs every value at each SYNC",
        )
    if objects.motor_velocity is None:
        expected = "606Ch for a campaign: it counts as 60FFh does, by which the drive is commanded"
        refuse("objects.motor_velocity", "false", expected)
    for name, each, indices in (
        ("motor_velocity", objects.motor_velocity, (0x606C,)),
        ("current", objects.current, (0x6078, 0x6077)),
    ):
        if each.index not in indices or each.sign != 1:
            wanted = " or ".join(f"{index:04X}h" for index in indices)
            expected = f"{wanted} with sign 1 for a campaign: the drive is commanded in its units"
            refuse(f"objects.{name}", f"{label(each.index, each.subindex)}, sign {each.sign}", expected)
    if objects.statusword != CIA_402.statusword:
        refuse("objects.statusword", "another one", "6041h for a campaign")
    if joint.temperature not in (None, Temperature()):
        refuse("objects.temperature", "another one", "3001h for a campaign")
    return DriveProfile(
        joint.node_id,
        Identity(**asdict(joint.identity)),
        _by_key(joint.given),
        objects=objects,
        layout=joint.tpdos,
        torque_constant_nm_per_a=joint.joint.torque_constant_nm_per_a,
    )


Play = Callable[[Setpoints], MotionResult]
"""The motion: `jtqd.sysid.motion.shell.play` on the bench, or that of a test. Raises MotionError."""


@dataclass(frozen=True)
class Bench:
    """Where the runs take place: bus, jtqd's configuration (None: the one that ships) and its content.

    timing: of the commander's supervision; None: its own.
    """

    bus: str
    config_path: Path | None
    config: BenchConfig
    timing: Timing | None = None

    def play(self, limits_of: Callable[[Setpoints], Limits], on_progress: Progress) -> Play:
        """Return the commander on this bench; limits_of: the limits of a run."""
        timing = self.config.timing(self.timing or Timing())

        def played(setpoints: Setpoints) -> MotionResult:
            with _real_time():
                return play(
                    self.bus,
                    setpoints,
                    limits_of(setpoints),
                    on_progress=on_progress,
                    drives=self.config.drives,
                    sensor=self.config.sensor,
                    timing=timing,
                    around=self.config.around(setpoints),
                )

        def motion(setpoints: Setpoints) -> MotionResult:
            """Play; a joint that is moved alone and stands elsewhere is brought to the middle of its travel first."""
            try:
                return played(setpoints)
            except OutOfPlaceError as away:
                limits = limits_of(setpoints)
                middle = 0.5 * sum(limits.position_rad)
                result = played(approach(setpoints.velocity_joint, away.position_rad, middle, limits))
                if result.status == "stopped":
                    reason = f"on the way to {middle:g} rad: {result.reason}"
                    return result._replace(reason=reason, played_s=0.0)
                return played(setpoints)

        return motion


@contextmanager
def _real_time() -> Iterator[None]:
    """Give this process a real-time priority below jtqd's loop and the emulated drives, where permitted."""
    before, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_COMMANDER_PRIORITY))
    try:
        yield
    finally:
        with suppress(PermissionError):
            os.sched_setscheduler(0, before, priority)


# Processes ------------------------------------------------------------------------------------------------------

EXACT_TIME: Final = "exact"
"""As `--bus`: the emulated bench in exact time."""
EXACT_TIME_BUS: Final = "sim:vcan0"
"""The same inside the bench kernel."""
READY_S: Final = 60.0
"""Longest start of a process; a small controller loads its libraries from a slow card."""
_END_S: Final = 30.0
_MARGIN_S: Final = 60.0
"""jtqd ends by itself this long after a run, if the campaign cannot end it."""
_POLL_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1
_LIBC: Final = ctypes.CDLL(None)


class ProcessError(Exception):
    """A process did not start, or ended by a failure; one line with its last message."""


class ExactTimeError(ProcessError):
    """The bench kernel cannot be built or booted; one line."""


class Interrupted(Exception):  # noqa: N818 - an order, not an error
    """SIGINT or SIGTERM came between two motions."""


StopAsked = Callable[[], bool]


def unix_bus(folder: Path) -> str:
    """Return the address of a unix bus in a folder."""
    return f"{PREFIX}{folder / 'bus'}"


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def _start(module: str, arguments: Sequence[str], messages: Path, stdout: Any) -> subprocess.Popen[bytes]:
    """Start a Python module as a process, its standard error in the file `messages`.

    It has a session of its own: Ctrl-C on a terminal must reach the commander alone, which needs the SYNC of jtqd to bring
    the joints to rest. It gets SIGTERM when this process dies.
    """
    with messages.open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=log,
            start_new_session=True,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 - there are no threads here
        )


def _end(process: subprocess.Popen[bytes]) -> int:
    """Send SIGTERM, and SIGKILL to a process that does not end; return its exit status."""
    process.terminate()
    try:
        return process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _wait_for(
    process: subprocess.Popen[bytes], seen: Callable[[], bool], messages: Path, name: str, late: str
) -> None:
    """Wait until `seen()`, which blocks for a moment; ProcessError where the process ends, or is `late` after READY_S."""
    deadline = time.monotonic() + READY_S
    while not seen():
        if process.poll() is not None:
            raise ProcessError(f"{name} ended with exit status {process.returncode}: {_last_line(messages)}")
        if time.monotonic() > deadline:
            raise ProcessError(f"{name}{late} within {READY_S:g} s")


def _last_line(path: Path) -> str:
    try:
        lines = path.read_text(errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return lines[-1] if lines else "no message"


@contextmanager
def emulated_bench(
    bus: str, folder: Path, plant: Path, seed: int, drives: int, *, sensor: bool
) -> Iterator[None]:
    """Run the emulated bench as a process, at rest until it is commanded; a unix bus is made if there is none.

    folder: for its messages. seed: of its noise and days. drives: 1 and 2, and 3 and 4, are coupled. Raises ProcessError.
    """
    arguments = ["--bus", bus, "--profile", "rest", "--seed", str(seed), "--plant", str(plant)]
    arguments += ["--drives", str(drives), *([] if sensor else ["--no-sensor"])]
    messages = folder / "bench.log"
    process = _start("jtqd.sim_can", arguments, messages, subprocess.DEVNULL)

    def ready() -> bool:
        time.sleep(_POLL_S / 10)
        return b"bench ready" in messages.read_bytes()

    try:
        _wait_for(process, ready, messages, "the emulated bench", ": not ready")
        yield
    finally:
        _end(process)


class Jtqd:
    """jtqd during one run of duration_s: a context manager that waits for its first estimate, and ends it in order.

    Its log goes to folder/log, its messages to folder/jtqd.log. stop_asked: asked while waiting.
    """

    def __init__(self, bench: Bench, folder: Path, duration_s: float, stop_asked: StopAsked) -> None:
        self.messages: Final = folder / "jtqd.log"
        self._bus, self._stop_asked = bench.bus, stop_asked
        self._cob_id = 0x180 + bench.config.config.node_id  # of the estimate PDO
        self._arguments = ["--bus", bench.bus, "--record", str(folder / "log"), "--json"]
        self._arguments += ["--duration", f"{duration_s + _MARGIN_S:.1f}"]
        self._arguments += [] if bench.config_path is None else ["--config", str(bench.config_path)]
        self._output = folder / "jtqd.json"
        self._status = 0

    def __enter__(self) -> Jtqd:
        """Start and wait for the first estimate. Raises ProcessError, Interrupted."""
        try:
            socket = open_frame_socket(self._bus, [exact(self._cob_id)])
        except BusError as error:
            raise ProcessError(str(error)) from None
        with self._output.open("wb") as output:
            self._process = _start("jtqd.daemon.jtqd", self._arguments, self.messages, output)

        def published() -> bool:
            if socket.wait(_POLL_S):
                return True
            if self._stop_asked():
                raise Interrupted
            return False

        try:
            _wait_for(self._process, published, self.messages, "jtqd", " published nothing")
        except BaseException:
            _end(self._process)
            raise
        finally:
            socket.close()
        return self

    def __exit__(self, *_: object) -> None:
        self._status = _end(self._process)

    def log(self) -> tuple[tuple[Path, ...], dict[str, Any]]:
        """Return parts of the log in their order, and the summary, after the end.

        Raises ProcessError where it ended by a failure, or recorded nothing.
        """
        if self._status not in (0, 3):  # 3: done, with cycles missing in the log
            raise ProcessError(f"jtqd ended with exit status {self._status}: {_last_line(self.messages)}")
        try:
            summary = json.loads(self._output.read_text())
        except ValueError:
            raise ProcessError(f"jtqd ended without a summary: {_last_line(self.messages)}") from None
        recording = summary.get("recording") or {}
        if not recording.get("path"):
            raise ProcessError(f"jtqd recorded nothing: {recording.get('error') or 'no reason given'}")
        return tuple(map(Path, recording.get("paths") or [recording["path"]])), summary


def in_exact_time() -> bool:
    """Return whether this process runs in the bench kernel."""
    return os.environ.get(guest.TIME_TRAVEL_MARK) == "1"


def exact_time_ready() -> bool:
    """Return whether the bench kernel is there, and this process is not in it."""
    try:
        return not in_exact_time() and build.find() is not None and not build.missing(build.GUEST)
    except RuntimeError:
        return False


def run_in_exact_time(argv: Sequence[str], out: Path) -> int:
    """Run `jtq campaign` with these arguments in the bench kernel; return its exit status.

    Raises ExactTimeError where the kernel cannot be built or booted, ProcessError where a signal ended it.
    """
    command = [sys.executable, "-P", "-m", "jtqd.daemon.jtq", "campaign", *argv, "--bus", EXACT_TIME_BUS]
    sys.stdout.flush()
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        result = guest.run(
            command, time_travel=True, out_dir=out, sinks=(sys.stdout.buffer, sys.stderr.buffer)
        )
    except RuntimeError as error:  # every error of the bench kernel is one
        raise ExactTimeError(f"exact time: {error}") from None
    except KeyboardInterrupt:
        raise ProcessError("ended by a signal; the same command continues with the remaining runs") from None
    finally:
        signal.signal(signal.SIGTERM, before)
    return result.returncode


def _terminated(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
