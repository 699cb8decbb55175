"""Estimates of a replay: the inputs of each cycle through the loop's own code.

What comes out is bit for bit what the loop had, or something differs. Taken from the log is what only the loop could know:
which inputs counted, how long a step was, that an estimate was ready too late. Everything else (positions that roll over,
temperatures and their age, estimate, status, the bytes of the estimate PDO) is computed from the raw frames again.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from jtqd.daemon.core.contact import contacts_of
from jtqd.daemon.core.input_pdos import input_pdos, joint_temperatures
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.replay.logged import NO_STATES, SAMPLE, EstimatorStates, Inputs, Setup, offsets
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.replay.runs import Steps
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import (
    FLAG_NETWORK_SKIPPED,
    FLAG_TEMPERATURE,
)
from jtqd.estimator.arrays import FloatArray, RecordArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.methods import AnyEstimator, AnyNetwork
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import learner_of

_PROGRESS_CYCLES = 1 << 14
"""Between two calls of `progress`."""


@dataclass
class _Counters:
    """Counters of the loop in shared memory; not read here."""

    counters: array[int] = field(default_factory=lambda: array("Q", [0] * len(COUNTERS)))
    errors: array[float] = field(default_factory=lambda: array("d", [0.0] * 3 * cr.MOST_JOINTS))


@dataclass(frozen=True)
class Model:
    """Model of one joint, its estimator without warm-up, and where it comes from: files with hashes, or "as logged"."""

    joint: Joint
    settings: EstimatorSettings
    network: AnyNetwork | None
    estimator: AnyEstimator
    source: str


@dataclass(frozen=True)
class Replayed:
    """Result over n cycles.

    Attributes:
        joints: of each joint, `SAMPLE` [n].
        estimate: bytes of the estimate PDOs, one after the other [n, 8 * PDOs].
        temperatures_from_log: cycles whose temperature does not follow from the frames alone.
        states_differ: (joint from 1 on, cycle) after which the log has another state of the estimator than the replay.
    """

    joints: tuple[RecordArray, ...]
    estimate: npt.NDArray[np.uint8]
    temperatures_from_log: int
    states_differ: tuple[tuple[int, int], ...] = ()


class Replayer:
    """Replay cycle by cycle; keeps the joints from one part of a log to the next.

    Args:
        setup: configuration and scaling.
        models: of each joint.

    Attributes:
        models: as given.
    """

    def __init__(self, setup: Setup, models: Sequence[Model]) -> None:
        config = setup.config
        self._setup, self.models = setup, models
        self._intake = Intake(input_pdos(config), joint_temperatures(config))
        counters = _Counters()
        self._joints = [
            JointCycle(
                n,
                inputs,
                model.estimator,
                intake=self._intake,
                snapshot=counters,
                period_ns=config.period_ns,
                safety=JointSafety(config.safety, model.settings, model.joint, config.period_ns),
            )
            for n, (inputs, model) in enumerate(zip(setup.inputs, models, strict=True))
        ]
        self._unknown = [True] * len(self._joints)
        self._states_differ: list[tuple[int, int]] = []
        self._contacts = contacts_of(config)
        self._time_ns = [1 << 60] * len(
            self._joints
        )  # any but 0, which would mean that there was no sample yet

    def run(
        self,
        joints: Sequence[RecordArray],
        inputs: Inputs,
        steps: Sequence[Steps],
        progress: Callable[[int], None] = lambda _: None,
        states: Sequence[EstimatorStates] = (),
    ) -> Replayed:
        """Replay the cycles of one part; `joints` are its states as logged. `progress` is called with the cycles done.

        states: of each joint, states of its estimator in the log. The first one after a place where the state was not known
        is continued from; the others are compared.
        """
        count = len(joints[0])
        celsius, happens = self._temperatures(inputs, joints)
        for n in range(len(self._joints)):
            known = states[n] if states else NO_STATES
            for row, marks in self._marks(n, joints[n], inputs, steps[n], known).items():
                happens.setdefault(row, []).extend(marks)
        times = np.array(
            [start + np.cumsum(each.dt_ns) for start, each in zip(self._time_ns, steps, strict=True)]
        )
        rows = CycleRows(
            self._intake,
            self._joints,
            fresh=[each.fresh for each in inputs.pdos],
            values=[each.values for each in inputs.pdos],
            velocity=[each["motor_velocity_rad_s"] for each in joints],
            celsius=celsius,
            cycle=joints[0]["cycle"],
            counter=joints[0]["sync_counter"],
            sync_ns=times,
            wanted=[(each["input_flags"] & FLAG_NETWORK_SKIPPED) == 0 for each in joints],
            contacts=self._contacts,
            withdrawn=(joints[0]["cycle_flags"] & cr.FLAG_WITHDRAWN) != 0,
        )
        ends = sorted({*happens, *range(0, count, _PROGRESS_CYCLES), count})
        for first, end in pairwise(ends):
            for each in happens.get(first, ()):
                each()
            rows.go_on(first, end)
            progress(end)
        if count:
            self._time_ns = times[:, -1].tolist()
        samples = tuple(each.view(SAMPLE)[:, 0] for each in rows.samples)
        differ, self._states_differ = tuple(self._states_differ), []
        return Replayed(samples, rows.estimates, rows.temperatures_from_log, differ)

    def _temperatures(
        self, inputs: Inputs, joints: Sequence[RecordArray]
    ) -> tuple[list[FloatArray], dict[int, list[Callable[[], object]]]]:
        """Return each joint temperature as logged [n], and the frames to take before a row.

        A node that restarted is not believed until it is configured, and a frame may have found no room in its record: where
        the log has another temperature than the frames, the log is right.
        """
        celsius: list[FloatArray] = []
        happens: dict[int, list[Callable[[], object]]] = {}
        for index, events in enumerate(inputs.temperatures):
            number = next(n for n, each in enumerate(self._setup.inputs) if each.temperature == index)
            known = (joints[number]["input_flags"] & FLAG_TEMPERATURE) != 0
            celsius.append(np.where(known, joints[number]["temperature_c"], np.nan))
            for row, frame in events:
                happens.setdefault(row, []).append(partial(self._intake.receive_temperature, index, frame))
        return celsius, happens

    def _marks(
        self, number: int, records: RecordArray, inputs: Inputs, steps: Steps, states: EstimatorStates
    ) -> dict[int, list[Callable[[], object]]]:
        """Apply the events of one joint before a row: continuation after a gap in the log, reset of faults, restart."""
        joint, each = self._joints[number], self._setup.inputs[number]
        marks: dict[int, list[Callable[[], object]]] = {}
        for row, _ in steps.breaks:
            found = offsets(inputs.pdos, records, each, row)
            marks.setdefault(row, []).append(partial(self._lose, number, found))
        for row, content in states.rows(records["cycle"]).items():
            marks.setdefault(row, []).append(
                partial(self._meet, number, int(records["cycle"][row]) - 1, content)
            )
        for row in np.flatnonzero(records["cycle_flags"] & cr.FLAG_RESET).tolist():
            marks.setdefault(row, []).append(joint.reset_latch)
        for row in steps.begins.tolist():
            marks.setdefault(row, []).append(partial(self._begin, number))
        return marks

    def _begin(self, number: int) -> None:
        """Continue where a joint starts, so that all about it is known."""
        self._joints[number].begin_again()
        self._unknown[number] = False

    def _lose(self, number: int, offset: tuple[int, int]) -> None:
        """Continue behind missing cycles, with these roll-overs of the positions."""
        self._joints[number].resume(*offset)
        self._unknown[number] = True

    def _meet(self, number: int, cycle: int, content: bytes) -> None:
        """Compare the estimator's state with that of the log after `cycle`, and continue from the latter."""
        learner = learner_of(self._joints[number].estimator)
        if learner is None or learner.past == content:
            return
        if not self._unknown[number]:
            self._states_differ.append((number + 1, cycle))
        learner.past = content
        self._unknown[number] = False
