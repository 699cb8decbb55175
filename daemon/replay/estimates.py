"""Estimates of a replay, two ways: cycle by cycle through the loop's own code, and in arrays.

Cycle by cycle (`ExactReplay`), what comes out is bit for bit what the loop had, or something differs. Taken from the log
is what only the loop could know: which inputs counted, how long a step was, that an estimate was ready too late. Everything
else (positions that roll over, temperatures and their age, estimate, status, the bytes of the estimate PDO) is computed from
the raw frames again.

In arrays (`replay_whole`), one call of the estimator takes a whole run: the same numbers, without the frames. Inputs are
the SI values of the log. What the loop decides after the estimate (starting, drive off or in fault, too late, what fits the
field of the PDO) is decided here again.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core import estimate_pdo
from jtqd.daemon.core.cycle import STARTING_CYCLES
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.joint_safety import JointSafety
from jtqd.daemon.core.status import JointStatus, drive_status
from jtqd.daemon.loop.input_pdos import input_pdos, joint_temperatures
from jtqd.daemon.loop.process import contacts_of
from jtqd.daemon.replay.frames import Frames, offsets
from jtqd.daemon.replay.origin import SAMPLE, Origin
from jtqd.daemon.replay.pasts import NO_PASTS, Pasts
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.replay.runs import Steps
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.cycle_record import FLAG_LATCHED, FLAG_NETWORK_SKIPPED, FLAG_TEMPERATURE
from jtqd.daemon.shared.snapshot import COUNTERS
from jtqd.estimator.arrays import CodeArray, FloatArray, RecordArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.learned import learner_of
from jtqd.estimator.methods import AnyEstimator, AnyNetwork, estimate_steps
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, INVALID, OFF, PUBLISHED, STALE, STANDSTILL, STARTING, VALID

# ---- cycle by cycle, through the loop's own code ----

_TOLD = 1 << 14
"""Cycles between two calls of `progress`."""


@dataclass
class _Counters:
    """Counters of the loop in shared memory; not read here."""

    counters: array[int] = field(default_factory=lambda: array("Q", [0] * len(COUNTERS)))
    errors: array[float] = field(default_factory=lambda: array("d", [0.0] * 3 * cr.MOST_JOINTS))


@dataclass(frozen=True)
class Replayed:
    """Result over n cycles.

    Attributes:
        joints: of each joint, `SAMPLE` [n].
        estimate: bytes of the estimate PDOs, one after the other [n, 8 * PDOs].
        temperatures_from_log: cycles whose temperature the frames alone do not tell.
        pasts_differ: (joint from 1 on, cycle) after which the log has another state of the estimator than the replay.
    """

    joints: tuple[RecordArray, ...]
    estimate: npt.NDArray[np.uint8]
    temperatures_from_log: int
    pasts_differ: tuple[tuple[int, int], ...] = ()


class ExactReplay:
    """Replay cycle by cycle; keeps the joints from one part of a log to the next.

    Args:
        origin: configuration and scaling.
        estimators, safety: of each joint.
    """

    def __init__(
        self, origin: Origin, estimators: Sequence[AnyEstimator], safety: Sequence[JointSafety]
    ) -> None:
        config = origin.config
        self._origin = origin
        self._intake = Intake(input_pdos(config), joint_temperatures(config))
        counters = _Counters()
        self._joints = [
            JointCycle(
                n,
                inputs,
                estimator,
                intake=self._intake,
                snapshot=counters,
                period_ns=config.period_ns,
                safety=limits,
            )
            for n, (inputs, estimator, limits) in enumerate(
                zip(origin.inputs, estimators, safety, strict=True)
            )
        ]
        self._unknown = [True] * len(self._joints)
        self._pasts_differ: list[tuple[int, int]] = []
        self._contacts = contacts_of(config)
        self._time_ns = [1 << 60] * len(
            self._joints
        )  # any but 0, which would mean that there was no sample yet

    def run(
        self,
        joints: Sequence[RecordArray],
        frames: Frames,
        steps: Sequence[Steps],
        progress: Callable[[int], None] = lambda _: None,
        pasts: Sequence[Pasts] = (),
    ) -> Replayed:
        """Replay the cycles of one part; `joints` are its states as logged. `progress` is called with the cycles done.

        pasts: of each joint, states of its estimator in the log. The first one after a place where the state was not known
        is gone on from; the others are compared.
        """
        count = len(joints[0])
        celsius, happens = self._temperatures(frames, joints)
        for n in range(len(self._joints)):
            known = pasts[n] if pasts else NO_PASTS
            for row, marks in self._marks(n, joints[n], frames, steps[n], known).items():
                happens.setdefault(row, []).extend(marks)
        times = np.array(
            [start + np.cumsum(each.dt_ns) for start, each in zip(self._time_ns, steps, strict=True)]
        )
        rows = CycleRows(
            self._intake,
            self._joints,
            fresh=[each.fresh for each in frames.pdos],
            values=[each.values for each in frames.pdos],
            velocity=[each["motor_velocity_rad_s"] for each in joints],
            celsius=celsius,
            cycle=joints[0]["cycle"],
            counter=joints[0]["sync_counter"],
            sync_ns=times,
            wanted=[(each["input_flags"] & FLAG_NETWORK_SKIPPED) == 0 for each in joints],
            contacts=self._contacts,
            withdrawn=(joints[0]["cycle_flags"] & cr.FLAG_WITHDRAWN) != 0,
        )
        ends = sorted({*happens, *range(0, count, _TOLD), count})
        for first, end in pairwise(ends):
            for each in happens.get(first, ()):
                each()
            rows.go_on(first, end)
            progress(end)
        if count:
            self._time_ns = times[:, -1].tolist()
        samples = tuple(each.view(SAMPLE)[:, 0] for each in rows.samples)
        differ, self._pasts_differ = tuple(self._pasts_differ), []
        return Replayed(samples, rows.estimates, rows.temperatures_from_log, differ)

    def _temperatures(
        self, frames: Frames, joints: Sequence[RecordArray]
    ) -> tuple[list[FloatArray], dict[int, list[Callable[[], object]]]]:
        """Return each joint temperature as logged [n], and the frames to take before a row.

        A node that restarted is not believed until it is configured, and a frame may have found no room in its record: where
        the log says something else than the frames do, and there is such a reason, the log is right.
        """
        celsius: list[FloatArray] = []
        happens: dict[int, list[Callable[[], object]]] = {}
        for index, (each, events) in enumerate(
            zip(self._intake.temperatures, frames.temperatures, strict=True)
        ):
            number = next(n for n, inputs in enumerate(self._origin.inputs) if inputs.temperature == index)
            known = (joints[number]["input_flags"] & FLAG_TEMPERATURE) != 0
            celsius.append(np.where(known, joints[number]["temperature_c"], np.nan))
            for row, frame in events:
                happens.setdefault(row, []).append(partial(each.receive, bytearray(frame), 0))
        return celsius, happens

    def _marks(
        self, number: int, records: RecordArray, frames: Frames, steps: Steps, pasts: Pasts
    ) -> dict[int, list[Callable[[], object]]]:
        """Apply the events of one joint before a row: continuation after a gap in the log, reset of faults, restart."""
        joint, each = self._joints[number], self._origin.inputs[number]
        marks: dict[int, list[Callable[[], object]]] = {}
        for row, _ in steps.breaks:
            found = offsets(frames.pdos, records, each, row)
            marks.setdefault(row, []).append(partial(self._lose, number, found))
        for row, content in pasts.rows(records["cycle"]).items():
            marks.setdefault(row, []).append(
                partial(self._meet, number, int(records["cycle"][row]) - 1, content)
            )
        for row in np.flatnonzero(records["cycle_flags"] & cr.FLAG_RESET).tolist():
            marks.setdefault(row, []).append(joint.reset_latch)
        for row in steps.begins.tolist():
            marks.setdefault(row, []).append(partial(self._begin, number))
        return marks

    def _begin(self, number: int) -> None:
        """Go on where a joint began anew, so that all about it is known."""
        self._joints[number].begin_again()
        self._unknown[number] = False

    def _lose(self, number: int, offset: tuple[int, int]) -> None:
        """Go on behind cycles that are missing, with these roll-overs of the positions."""
        self._joints[number].resume(*offset)
        self._unknown[number] = True

    def _meet(self, number: int, cycle: int, content: bytes) -> None:
        """Compare the estimator's state with that of the log after `cycle`, and go on from the latter."""
        learner = learner_of(self._joints[number].estimator)
        if learner is None or learner.past == content:
            return
        if not self._unknown[number]:
            self._pasts_differ.append((number + 1, cycle))
        learner.past = content
        self._unknown[number] = False


WHOLE = np.dtype(
    [
        *((name, "<f8") for name in ("torque_nm", "sigma_nm", "tob_nm", "physics_nm", "network_nm")),
        ("status", "<u2"),
    ]
)
"""What the estimator makes of a cycle."""
_STAGES = ("torque_nm", "sigma_nm", "tob_nm", "physics_nm", "network_nm")
_IS_PUBLISHED = np.isin(np.arange(16), [*PUBLISHED])
_STEADY = frozenset((VALID, STANDSTILL, DEGRADED, OFF))
"""A status that is asked for and published stays as it is while the same is asked for."""


@dataclass(frozen=True)
class Model:
    """Estimator model of one joint."""

    joint: Joint
    settings: EstimatorSettings
    network: AnyNetwork | None


def replay_whole(
    model: Model, safety: JointSafety, records: RecordArray, steps: Steps, pasts: Pasts = NO_PASTS
) -> RecordArray:
    """Estimates [n] of the states `records` of one joint, fields as `WHOLE`. Raises ConfigError where nothing fits.

    Faults of the inputs, and those that are latched, are taken from the log. `pasts`: states to go on from, where the
    estimator's own is not known: the first one behind each such place.
    """
    rows: npt.NDArray[np.intp] | slice = slice(None) if steps.used.all() else np.flatnonzero(steps.used)
    flags, word, cycle = (records[name][rows] for name in ("input_flags", "statusword", "cycle"))
    motor, link = records["motor_position_rad"][rows].copy(), records["link_position_rad"][rows].copy()
    if np.isnan(link).all():  # one encoder: as `JointCycle`
        link = motor / model.joint.gear_ratio
    columns = JointColumns(
        current_a=records["current_a"][rows].copy(),
        motor_position_rad=motor,
        motor_velocity_rad_s=records["motor_velocity_rad_s"][rows].copy(),
        link_position_rad=link,
        temperature_c=np.where(flags & FLAG_TEMPERATURE, records["temperature_c"][rows], np.nan),
    )
    values = {name: np.full(len(records), np.nan) for name in _STAGES}
    status = np.full(len(records), STALE, np.uint16)
    found = np.zeros(len(records), np.int64)
    if len(flags):
        dt_s = steps.dt_ns[rows].astype(np.float64) * 1e-9
        wanted = (flags & FLAG_NETWORK_SKIPPED) == 0
        known = _first_known(pasts, records["cycle"], steps)
        starts = {int(np.count_nonzero(steps.used[:row])): content for row, content in known.items()}
        made = estimate_steps(model.joint, model.settings, model.network, dt_s, columns, wanted, starts)
        for name in _STAGES:
            values[name][rows] = getattr(made, name)
        asked = made.status.astype(np.uint16)
        status[rows], found[rows] = _asked(
            made.torque_nm, made.sigma_nm, asked, _Cycles(flags, word, cycle), safety
        )
    status = status_many(status, found, records, safety.settings)
    fits = fields(values["torque_nm"], values["sigma_nm"], status)[0] != estimate_pdo.NO_TORQUE
    values["torque_nm"][~fits] = values["sigma_nm"][~fits] = np.nan
    out = np.empty(len(records), WHOLE)
    for name, column in values.items():
        out[name] = column
    out["status"] = status
    return out


def _first_known(pasts: Pasts, cycle: npt.NDArray[np.uint64], steps: Steps) -> dict[int, bytes]:
    """Return the first state behind each place where it was not known, by the row before which it holds."""
    rows = pasts.rows(cycle)
    found = {}
    for lost, _ in steps.breaks:
        row = min((row for row in rows if row >= lost), default=None)
        if row is not None and not any(lost < begun <= row for begun in steps.begins.tolist()):
            found[row] = rows[row]
    return found


class _Cycles(NamedTuple):
    """Flags of the inputs, statusword and number of the cycles [n]."""

    flags: CodeArray
    statusword: CodeArray
    cycle: npt.NDArray[np.uint64]


def _asked(
    torque_nm: FloatArray, sigma_nm: FloatArray, status: CodeArray, cycles: _Cycles, safety: JointSafety
) -> tuple[CodeArray, npt.NDArray[np.int64]]:
    """Status that each cycle asks for, and its faults [n]: twin of what `JointCycle.observe` does with an estimate."""
    found = np.where(cycles.flags & FLAG_LATCHED, 0, cycles.flags >> 8).astype(np.int64)
    found &= ~(faults.OUT_OF_RANGE | faults.NOT_FINITE)
    found[status == INVALID] |= faults.OUT_OF_RANGE
    powered = np.ones(len(status), np.bool_)
    for word in np.flatnonzero(
        np.bincount(cycles.statusword)
    ).tolist():  # there are few different ones in a run
        said = drive_status(word)
        if said is not None:
            here = cycles.statusword == word
            status[here], powered[here], found[here] = said, False, found[here] & ~faults.OUT_OF_RANGE
    publishable = powered & _IS_PUBLISHED[status]
    limit = safety.torque_limit_nm
    with np.errstate(invalid="ignore"):
        sigma_good = (sigma_nm >= 0.0) & np.isfinite(sigma_nm)
        good = (np.abs(torque_nm) <= limit) & sigma_good
        finite = np.isfinite(torque_nm) & sigma_good
    found[publishable & ~good & finite] |= faults.OUT_OF_RANGE
    found[publishable & ~good & ~finite] |= faults.NOT_FINITE
    status[publishable & (cycles.cycle < STARTING_CYCLES)] = STARTING
    return status, found


def status_many(
    asked: CodeArray, found: npt.NDArray[np.int64], records: RecordArray, settings: SafetySettings
) -> CodeArray:
    """Status to publish [n]: `JointStatus` over a whole run, which is asked only where something changes."""
    state = JointStatus(settings)
    latched = (records["input_flags"] & FLAG_LATCHED) != 0
    key = asked.astype(np.int64) | found << 8 | latched.astype(np.int64) << 24
    key |= (records["cycle_flags"] & (cr.FLAG_WITHDRAWN | cr.FLAG_RESET)).astype(np.int64) << 25
    starts = np.concatenate(([0], np.flatnonzero(np.diff(key)) + 1))
    out = asked.copy()
    for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(key)], strict=True):
        if latched[start]:
            out[start:end] = records["status"][start:end]
            continue
        status, faulty = int(asked[start]), int(found[start])
        flags = int(records["cycle_flags"][start])
        row = start
        while row < end:
            if flags & cr.FLAG_RESET:
                state.reset_latch()
            said = state.update(status, faulty)
            if flags & cr.FLAG_WITHDRAWN:
                said = state.late()
            out[row] = said
            row += 1
            settled = said == status == state.held and status in _STEADY
            if settled and not faulty and not flags & cr.FLAG_WITHDRAWN:
                state.pass_over(end - row)
                out[row:end] = said
                break
    return out


def fields(
    torque_nm: FloatArray, sigma_nm: FloatArray, status: CodeArray
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint8], CodeArray]:
    """Twin of `estimate_pdo.field` [n]: integers of torque, sigma and status."""
    limit = -estimate_pdo.NO_TORQUE - 1
    publishable = _IS_PUBLISHED[status]
    with np.errstate(invalid="ignore"):
        counts = torque_nm * 100.0
        fits = publishable & (np.abs(counts) <= limit) & (sigma_nm >= 0.0) & (sigma_nm < np.inf)
        known = fits & (sigma_nm <= 12.7)
    whole = np.where(fits, np.rint(np.where(fits, counts, 0.0)), estimate_pdo.NO_TORQUE).astype(np.int16)
    widths = np.ceil(np.where(known, sigma_nm, 0.0) * 20.0 - 1e-9)
    sigma = np.where(known, widths, estimate_pdo.SIGMA_UNKNOWN).astype(np.uint8)
    return whole, sigma, np.where(publishable & ~fits, INVALID, status).astype(np.uint16)
