"""Replay cycle by cycle through the loop's own code (`daemon.loop.joint_cycle.JointCycle`).

What comes out is bit for bit what the loop had, or something is different.

Taken from the log is what only the loop could know: which inputs counted, how long a step was, that an estimate was ready
too late. Everything else (positions that roll over, temperatures and their age, estimate, status, the bytes of the
estimate PDO) is computed from the raw frames again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isnan

import numpy as np
import numpy.typing as npt

from daemon.loop import estimate_pdo
from daemon.loop.cycle import STARTING_CYCLES
from daemon.loop.input_pdos import input_pdos, joint_temperatures
from daemon.loop.intake import Intake
from daemon.loop.joint_cycle import FLAG_TEMPERATURE, JointCycle
from daemon.loop.joint_safety import JointSafety
from daemon.loop.joint_tally import FLAG_NETWORK_SKIPPED
from daemon.loop.temperature import JointTemperature
from daemon.replay.breaks import Steps
from daemon.replay.fields import SAMPLE
from daemon.replay.frames import Frames, Pdo, offsets
from daemon.replay.origin import Origin
from daemon.shared import cycle_record as cr
from daemon.shared.snapshot import COUNTERS
from estimator.methods import AnyEstimator

Records = npt.NDArray[np.void]


@dataclass
class _Tally:
    """What the loop counts in shared memory; nobody reads it here."""

    counters: list[int] = field(default_factory=lambda: [0] * len(COUNTERS))
    errors: list[float] = field(default_factory=lambda: [0.0] * 4)


@dataclass(frozen=True)
class Replayed:
    """Result over n cycles.

    Attributes:
        joints: of joint 1 and 2, `SAMPLE` [n].
        estimate: bytes of the estimate PDO [n, 8].
        temperatures_from_log: cycles whose temperature the frames alone do not tell.
    """

    joints: tuple[Records, Records]
    estimate: npt.NDArray[np.uint8]
    temperatures_from_log: int


class ExactReplay:
    """Keeps the joints from one part of a log to the next.

    Args:
        origin: configuration and scaling.
        estimators, safety: of joint 1 and 2.
    """

    def __init__(
        self, origin: Origin, estimators: Sequence[AnyEstimator], safety: Sequence[JointSafety]
    ) -> None:
        config = origin.config
        self._origin = origin
        self._intake = Intake(input_pdos(config), joint_temperatures(config))
        tally = _Tally()
        self._joints = [
            JointCycle(
                n,
                inputs,
                estimator,
                intake=self._intake,
                snapshot=tally,
                period_ns=config.period_ns,
                safety=limits,
            )
            for n, (inputs, estimator, limits) in enumerate(
                zip(origin.inputs, estimators, safety, strict=True)
            )
        ]
        self._time_ns = [1 << 60, 1 << 60]  # any but 0, which would mean that there was no sample yet

    def run(
        self,
        joints: Sequence[Records],
        frames: Frames,
        steps: Sequence[Steps],
        progress: Callable[[int], None] = lambda _: None,
    ) -> Replayed:
        """Replay the cycles of one part; `joints` are its states as logged. `progress` is told the cycles done."""
        count = len(joints[0])
        views = self._intake.views()
        feeds = [_feed(each) for each in frames.pdos]
        temperatures = _Temperatures(self._origin, self._intake.temperatures, frames, joints)
        cycles = joints[0]["cycle"].tolist()
        counters = joints[0]["sync_counter"].tolist()
        withdrawn = ((joints[0]["cycle_flags"] & cr.FLAG_WITHDRAWN) != 0).tolist()
        marks = [self._marks(n, joints[n], frames, steps[n]) for n in (0, 1)]
        wanted = [((each["input_flags"] & FLAG_NETWORK_SKIPPED) == 0).tolist() for each in joints]
        plans = list(zip(self._joints, [each.dt_ns.tolist() for each in steps], marks, wanted, strict=True))
        out: tuple[list[tuple[float, ...]], list[tuple[float, ...]]] = ([], [])
        pdos = bytearray()
        one, two = self._joints
        times = self._time_ns
        for row, (cycle, counter) in enumerate(zip(cycles, counters, strict=True)):
            for view, (fresh, values) in zip(views, feeds, strict=True):
                view.fresh = fresh[row]
                view.values = next(values)
            temperatures.at(row, cycle)
            starting = cycle < STARTING_CYCLES
            for n, (joint, dt_ns, mark, network) in enumerate(plans):
                if row in mark:
                    for happens in mark[row]:
                        happens()
                times[n] += dt_ns[row]
                joint.observe(times[n], starting, network[row])
                if withdrawn[row]:
                    joint.withdraw()
                out[n].append(joint.sample)
            pdos += estimate_pdo.encode(one.published, two.published, counter)
            if not row & 0x3FFF:
                progress(row)
        progress(count)
        return Replayed(
            (np.array(out[0], SAMPLE), np.array(out[1], SAMPLE)),
            np.frombuffer(bytes(pdos), np.uint8).reshape(-1, 8),
            temperatures.from_log,
        )

    def _marks(
        self, number: int, records: Records, frames: Frames, steps: Steps
    ) -> dict[int, list[Callable[[], object]]]:
        """What happens to one joint before a row: faults are reset, it begins anew, the log goes on after a hole."""
        joint, each = self._joints[number], self._origin.inputs[number]
        marks: dict[int, list[Callable[[], object]]] = {}
        for row in np.flatnonzero(records["cycle_flags"] & cr.FLAG_RESET).tolist():
            marks.setdefault(row, []).append(joint.reset_latch)
        for row in steps.begins.tolist():
            marks.setdefault(row, []).append(joint.begin_again)
        for row, _ in steps.breaks:
            found = offsets(frames.pdos[each.position], records, each, row)
            marks.setdefault(row, []).append(partial(joint.resume, *found))
        return marks


def _feed(pdo: Pdo) -> tuple[list[bool], Iterator[tuple[int, ...]]]:
    values = zip(*(column.tolist() for column in pdo.values), strict=True)
    return pdo.fresh.tolist(), values


class _Temperatures:
    """The joints' temperatures from cycle to cycle, by their frames.

    A node that restarted is not believed until it is configured, and a frame may have found no room in its record: where
    the log says something else than the frames do, and there is such a reason, the log is right.
    """

    def __init__(
        self,
        origin: Origin,
        temperatures: Sequence[JointTemperature],
        frames: Frames,
        joints: Sequence[Records],
    ) -> None:
        self.from_log = 0
        self._all = []
        for each, events in zip(temperatures, frames.temperatures, strict=True):
            number = next(
                n
                for n, inputs in enumerate(origin.inputs)
                if inputs.temperature is not None and temperatures[inputs.temperature] is each
            )
            records = joints[number]
            due: dict[int, list[bytes]] = {}
            for row, frame in events:
                due.setdefault(row, []).append(frame)
            known = (records["input_flags"] & FLAG_TEMPERATURE) != 0
            logged = np.where(known, records["temperature_c"], np.nan).tolist()
            self._all.append((each, due, logged))

    def at(self, row: int, cycle: int) -> None:
        """The inputs of this cycle have been taken."""
        for temperature, due, logged in self._all:
            if row in due:
                for frame in due[row]:
                    temperature.receive(bytearray(frame), 0)
            temperature.at(cycle)
            said = logged[row]
            if temperature.celsius != said and not (isnan(said) and isnan(temperature.celsius)):
                self.from_log += 1
                temperature.celsius = said


def published_bytes(joints: Sequence[Records]) -> npt.NDArray[np.uint8]:
    """Estimate PDO [n, 8] by the states in a log: the bytes that the loop sent, as they follow from what it recorded."""
    parts = [
        zip(each["torque_nm"].tolist(), each["sigma_nm"].tolist(), each["status"].tolist(), strict=True)
        for each in joints
    ]
    data = bytearray()
    for first, second, counter in zip(*parts, joints[0]["sync_counter"].tolist(), strict=True):
        data += estimate_pdo.encode(estimate_pdo.field(*first), estimate_pdo.field(*second), counter)
    return np.frombuffer(bytes(data), np.uint8).reshape(-1, 8)


def logged_samples(records: Records) -> Records:
    """The same fields of a log's states, `SAMPLE` [n]."""
    out = np.zeros(len(records), SAMPLE)
    for name in SAMPLE.names or ():
        out[name] = records[name]
    return out


__all__ = ["ExactReplay", "Replayed", "logged_samples", "published_bytes"]
