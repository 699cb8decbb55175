"""One run of `jtqd-arm`: memory of several jtqd in; estimate out to a log, to viewers and to the operator.

It only reads what the loops leave in shared memory, some cycles at a time; it may lag or die without effect on them.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.live import Live

from jtqd.daemon.arm.alignment import Aligned, Aligner, Bus
from jtqd.daemon.arm.arm_file import ArmConfig
from jtqd.daemon.arm.estimator import ArmEstimate, ArmEstimator, ArmNoise
from jtqd.daemon.arm.messages import ArmMessages, shown_status, texts_of
from jtqd.daemon.arm.model import ArmModel, Payload
from jtqd.daemon.arm.sources import Source
from jtqd.daemon.live import Address
from jtqd.daemon.live.gateway import Gateway
from jtqd.daemon.live.process import LiveServer, Message, obstacle
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, NamedData, message_record
from jtqd.daemon.recording.messages import EventLog, records_of
from jtqd.daemon.recording.parts import Parts
from jtqd.daemon.recording.recorder import RecorderRequest
from jtqd.daemon.recording.run_files import Account, free_run
from jtqd.daemon.shared.processes import CannotBegin, Stop
from jtqd.estimator.decoder import FieldError, in_file
from jtqd.estimator.errors import ConfigError, Verbatim
from jtqd.estimator.status import NAMES
from jtqd.estimator.text import finite, number, table_lines

_POLL_S: Final = 0.008
"""A wake-up costs as much CPU as eight cycles."""
_VIEW_S, _LINE_S = 0.2, 5.0
_REPEAT_EVERY: Final = 60


def warn(text: str) -> None:
    """Print a line for the operator."""
    with suppress(OSError):  # who read it has gone, or its disk is full
        print(f"jtqd-arm: {text}", file=sys.stderr, flush=True)


class ArmLog:
    """MCAP files of one run; names, parts, budget and full disks are as of jtqd's. Raises ConfigError."""

    def __init__(self, config: ArmConfig, directory: Path) -> None:
        if directory.exists() and not directory.is_dir():
            raise ConfigError(f"--record {directory}: found a file there, expected a directory for logs")
        settings, prefix = asdict(config.recording), f"jtqd-arm-{config.name}"
        del settings["ring_cycles"]
        request = RecorderRequest(Path(), directory, prefix, **settings)
        self.rules = request.rules(free_run(directory, prefix, time.time_ns()))
        schemas, channels = records_of(texts_of(len(config.file.joints)))
        attached = [
            NamedData("arm.yaml", "application/yaml", config.text.encode()),
            NamedData("arm.urdf", "application/xml", config.urdf.encode()),
        ]
        self._builder = ChunkBuilder(schemas, channels, [(channels[0].id, 0)], _REPEAT_EVERY)
        self._account, self._chunk_ns, self._due_ns = Account(), round(1e9 * request.chunk_s), 0
        head, events = Head(schemas, channels, attached), EventLog(self._builder.add, warn)
        self._parts = Parts(self.rules, head, self._builder, events, self._account)
        self._parts.open("start")

    def add(self, messages: list[Message], instant_ns: int) -> None:
        """Take the messages of a cycle; the first is one that every cycle has."""
        first, *others = messages
        self._builder.add_block(message_record(first.topic, first.time_ns, first.payload), first.time_ns)
        for each in others:
            self._builder.add(*each)
        if instant_ns >= self._due_ns:
            self._due_ns = instant_ns + self._chunk_ns
            self._flush(instant_ns)

    def _flush(self, instant_ns: int) -> None:
        span = self._builder.seal()
        if span is not None:
            self._parts.write(span, instant_ns)

    def end(self) -> None:
        """End the file."""
        self._flush(time.monotonic_ns())
        self._parts.end()

    def account(self) -> dict[str, Any]:
        """Return what was recorded, as plain data."""
        rules, account = self.rules, self._account
        files = str(rules.directory / f"{rules.prefix}-{rules.run}-*.mcap")
        complete = self._parts.all_ended and not account.lost
        return {"files": files, "written": account.written, "lost": account.lost, "complete": complete}


class Viewers:
    """Foxglove and Lichtblick at one address. Raises CannotBegin."""

    def __init__(self, config: ArmConfig, where: Address) -> None:
        why, definitions = obstacle(where), records_of(texts_of(len(config.file.joints)))
        try:
            if why:
                raise OSError(why)
            self._server = LiveServer(f"jtqd-arm {config.name}", *definitions)
            self._gateway = Gateway(where, self._server.address, page=False)
        except (RuntimeError, OSError) as error:
            raise CannotBegin(f"{where.host}:{where.port}: {error}") from None
        self.port = self._gateway.port
        warn(f"Foxglove and Lichtblick: {where._replace(port=self.port).of('ws')}")

    def send(self, messages: list[Message]) -> None:
        """Send messages to those who look."""
        for each in messages if self._server.watched else ():
            self._server.send(each)

    def end(self) -> None:
        """End all connections."""
        self._gateway.stop()
        self._server.stop()


class Display:
    """A live table on a terminal, else a line every few seconds."""

    def __init__(self, joints: tuple[str, ...], stack: ExitStack) -> None:
        console = Console(stderr=True, markup=False, highlight=False)
        self._live = None
        if console.is_terminal:
            self._live = stack.enter_context(Live(console=console, auto_refresh=False))
        self._joints, self._due = joints, 0.0

    def turn(self, now: float, aligned: Aligned, estimate: ArmEstimate) -> None:
        """Show a cycle if it is time to, `now` in seconds."""
        if now < self._due:
            return
        self._due = now + (_VIEW_S if self._live else _LINE_S)
        names = [NAMES.get(int(code), "?") for code in shown_status(aligned, estimate)]
        torques, sigmas = map(number, estimate.external_nm), map(number, estimate.sigma_nm)
        rows = [*zip(self._joints, torques, sigmas, names, strict=True)]
        force, moment = (number(float(np.linalg.norm(each)), 1) for each in np.split(estimate.wrench, 2))
        touched = f"{number(estimate.strength_n, 1)} N behind {self._joints[estimate.contact - 1]}"
        rest = f"tool {force} N, {moment} Nm; payload {number(estimate.payload_kg)} kg; contact "
        rest += touched if estimate.contact else "none"
        if self._live is None:
            joints = (f"{name} {status} {nm} +- {sigma} Nm" for name, nm, sigma, status in rows)
            warn("; ".join((*joints, rest)))
        else:
            head = ("joint", "external [Nm]", "sigma [Nm]", "status")
            self._live.update("\n".join((*table_lines([head, *rows], (0, 3)), rest)), refresh=True)


class Arm:
    """The estimator behind the memory of the buses' jtqd, and what it has found so far."""

    def __init__(self, config: ArmConfig) -> None:
        file = config.file
        urdf = str(config.urdf_path)
        self.model = ArmModel(config.urdf, [*file.joints], file.tool, up=file.up, name=urdf)
        self._file = file
        buses = dict.fromkeys(each.bus for each in file.joints.values())
        self._sources = [Source(bus, {k: v for k, v in file.joints.items() if v.bus == bus}) for bus in buses]
        self._why = [""] * len(buses)
        self._buses, self._periods_ns = list[Bus](), list[int]()
        """Of the buses; none as long as one was never there."""
        self.cycles = self.contacts = self._touched = 0
        self.estimated = np.zeros(self.model.n, int)
        self.payload_kg = self.payload_sigma_kg = math.nan

    def _begin(self, periods_ns: list[int]) -> None:
        """Build what depends on the periods of the buses [ns]."""
        noise, names = self._file.noise, self.model.joints
        if self._buses:
            warn(f"period {self._periods_ns} ns is {periods_ns} ns now: begins again")
        self._periods_ns, period_ns = periods_ns, max(periods_ns)
        self.messages = ArmMessages(self.model, self._file.tool, period_ns)
        self._buses = [
            Bus({names.index(name): each for name, each in source.joints.items()}, period)
            for source, period in zip(self._sources, periods_ns, strict=True)
        ]
        self._aligner = Aligner(self._buses, period_ns)
        known = payload = None
        if noise is not None:
            total, tests, position_rad = (
                np.array([values[name] for name in names])
                for values in (noise.total, noise.tests, noise.position_rad)
            )
            known = ArmNoise(total, noise.offset, tests.T, position_rad)
        if self._file.payload is not None:
            x, y, z = self._file.payload.centre_m
            payload = Payload(self._file.payload.mass_kg, (x, y, z))
        self._estimator = ArmEstimator(self.model, 1e-9 * period_ns, known, payload)

    def new(self, now_ns: int) -> Iterator[tuple[Aligned, ArmEstimate, int]]:
        """Yield numbers, estimate and its cycle of what has become known. now_ns: CLOCK_MONOTONIC. Raises FieldError."""
        records = [each.read(now_ns) for each in self._sources]
        for n, source in enumerate(self._sources):
            if source.why != self._why[n]:
                self._why[n] = source.why
                warn(f"waiting: {source.why}" if source.why else f"reading jtqd on {source.bus}")
        found = {each.bus: each.about for each in self._sources if each.about is not None}
        periods_ns = [1000 * each.period_us for each in found.values()]
        if len(found) == len(self._sources) and periods_ns != self._periods_ns:
            if len({each.instance for each in found.values()}) < len(found):
                same = Verbatim(f"one jtqd behind several of {', '.join(found)}")
                raise FieldError("arm", "joints", same, "one name of each bus")
            self._begin(periods_ns)
        if not self._buses:
            return
        for bus, new in zip(self._buses, records, strict=True):
            bus.take(new)
        for aligned in self._aligner.ready(now_ns):
            estimate = self._estimator.step(*aligned[1:4])
            self.cycles += 1
            self.estimated += np.isfinite(estimate.external_nm)
            self.contacts += estimate.contact != 0 and self._touched == 0
            self._touched = estimate.contact
            self.payload_kg, self.payload_sigma_kg = estimate.payload_kg, estimate.payload_sigma_kg
            yield aligned, estimate, self._estimator.cycle

    def summary(self) -> dict[str, Any]:
        """Return the figures of the run as plain data; estimated: cycles with an external torque of each joint."""
        return {
            "cycles": self.cycles,
            "estimated": dict(zip(self.model.joints, self.estimated.tolist(), strict=True)),
            "overwritten": sum(each.lost for each in self._sources),
            "contacts": self.contacts,
            "payload_kg": finite(self.payload_kg),
            "payload_sigma_kg": finite(self.payload_sigma_kg),
            "waiting": [why for why in self._why if why],
        }


def run(
    config: ArmConfig, record: Path | None, live: Address | None, duration_s: float | None, stop: Stop
) -> dict[str, Any]:
    """Run until stopped or for `duration_s`; return the summary. Raises ConfigError, CannotBegin."""
    arm = Arm(config)
    end = math.inf if duration_s is None else time.monotonic() + duration_s
    with in_file(str(config.path)), ExitStack() as stack:
        log = viewers = None
        if live is not None:
            viewers = Viewers(config, live)
            stack.callback(viewers.end)
        if record is not None:
            log = ArmLog(config, record)
            stack.callback(log.end)
        display = Display(arm.model.joints, stack)
        while not stop.requested and time.monotonic() < end:
            now_ns, realtime_ns = time.monotonic_ns(), time.time_ns()
            for aligned, estimate, cycle in arm.new(now_ns):
                if log is not None or viewers is not None:
                    time_ns = aligned.instant_ns + realtime_ns - now_ns
                    made, shown = arm.messages.of(aligned, estimate, cycle, time_ns)
                    if log is not None:
                        log.add(made, aligned.instant_ns)
                    if viewers is not None and shown:
                        viewers.send(made)
                display.turn(time.monotonic(), aligned, estimate)
            time.sleep(_POLL_S)
    return arm.summary() | {"recording": None if log is None else log.account()}
