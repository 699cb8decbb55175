"""Derive conditions from readings of the loop's snapshot: joints, input PDOs, nodes, bus counters, loop. Pure.

The loop only counts; this runs in the supervisor, some twenty times a second, and costs no cycle anything. What the
supervisor sees of the bus itself (heartbeats, controller state, configuration) is observed by `jtqd.daemon.bus`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import hypot, inf, isfinite

from jtqd.daemon.bus.service import node_subjects
from jtqd.daemon.config import GUEST, MASTER, Config
from jtqd.daemon.core.input_pdos import input_pdos, joint_temperatures, names_of_inputs, sensor_index
from jtqd.daemon.shared.conditions import (
    DEVIATION_S,
    DEVIATION_SIGMAS,
    SHOWN_BY_COUNTERS,
    THE_BUS,
    THE_LOOP,
    THE_RECORDER,
    Conditions,
    Subject,
)
from jtqd.daemon.shared.cycle_record import FLAG_TEMPERATURE, TEMPERATURE_LIFE_S
from jtqd.daemon.shared.reasons import (
    degraded_reason,
    drive_reason,
    fault_meanings,
    sensor_reason,
    stale_reason,
    unready_reason,
)
from jtqd.daemon.shared.snapshot import InputView, JointView, View
from jtqd.drivers import nmt
from jtqd.estimator import status as st
from jtqd.estimator.settings import largest_difference_nm
from jtqd.estimator.status import Zeros

NEAR_SIGMAS = 2.0
"""A deviation ends within so many sigmas: on the edge it does not begin again and again."""
_GAP_S = 0.5  # readings further apart say nothing about the time between them
COUNTER_QUIET_S = 1.0
"""A condition that shows by a counter has ended when the counter has stood still for so long."""
_STOPPED_S = 0.25
"""The snapshot is written every 8th cycle."""
_SILENT_S = 0.1
"""Without a SYNC of another master, beside three periods."""
TIMEOUT_CYCLES = 20
"""Cycles in a row without a valid frame of a PDO: timeout (EMCY 8250h)."""
LENGTH_S = 1.0
"""Errors of the length (EMCY 8210h, 8220h) have ended when no frame of a wrong length came for so long."""
_COUNTED = {counter: row for counter, row in SHOWN_BY_COUNTERS.items() if counter != "bus_errors"}
"""An interface that is down is observed by `jtqd.daemon.bus.service`, which knows more of it."""


# Deviation ----------------------------------------------------------------------------------------------------------------


class Deviation:
    """Detects an estimate that stays further from the torque sensor of the same age than its sigma allows.

    It begins after DEVIATION_S beyond DEVIATION_SIGMAS and ends after as long within NEAR_SIGMAS: friction at a reversal is
    over sooner.
    """

    def __init__(self) -> None:
        self.present = False
        self._since_s = inf
        self._last_s = -inf

    def update(self, seen: JointView, now_s: float, sensor_zero_nm: float = 0.0) -> bool:
        """Take a reading; True while the estimate is too far. A reading without a number is passed over.

        sensor_zero_nm: standard deviation of the sensor's offset, which adds to sigma.
        """
        difference = abs(seen.torque_nm - seen.reference_nm)
        if seen.status not in st.PUBLISHED or not isfinite(difference) or not seen.sigma_nm > 0.0:
            return self.present
        sigmas = difference / hypot(seen.sigma_nm, sensor_zero_nm)
        changes = sigmas < NEAR_SIGMAS if self.present else sigmas > DEVIATION_SIGMAS
        if not changes:
            self._since_s = inf
        elif self._since_s == inf or now_s - self._last_s > _GAP_S:
            self._since_s = now_s
        self._last_s = now_s
        if changes and now_s - self._since_s >= DEVIATION_S:
            self.present, self._since_s = not self.present, inf
        return self.present


# Deadline and length of each input PDO ------------------------------------------------------------------------------------


class PdoWatch:
    """Errors 8250h, 8210h and 8220h of each input PDO from the loop's counts, as conditions.

    A PDO has timed out when it brought no valid input for `TIMEOUT_CYCLES` cycles in a row, and is back with the next valid
    one. A frame of a wrong length is never used: CiA 301 allows to take the first bytes of a longer one, but a node that
    sends another length than was configured has lost its mapping.

    pdos: in the order of the snapshot's inputs; their `node` is the producer.
    """

    def __init__(self, pdos: Sequence[Subject], conditions: Conditions) -> None:
        self._pdos, self._conditions = pdos, conditions
        self._last: dict[str, InputView] = {}
        self._until_s: dict[tuple[str, str], float] = {}

    def observe(self, inputs: Sequence[InputView], absent: Collection[int], now_s: float) -> None:
        """Take a reading; PDOs of `absent` nodes (optional ones) do not time out."""
        for pdo, seen in zip(self._pdos, inputs, strict=False):
            last = self._last.get(pdo.name)
            self._last[pdo.name] = seen
            expected = pdo.node not in absent
            timed_out = expected and seen.in_a_row >= TIMEOUT_CYCLES
            if last is not None and seen.missed != last.missed:
                # A loss between two readings, over by now, counts too, with what the last reading saw of it.
                over = seen.missed - last.missed + last.in_a_row - seen.in_a_row
                if expected and over >= TIMEOUT_CYCLES and not timed_out:
                    self._conditions.update("pdo_timeout", pdo, True, now_s, str(TIMEOUT_CYCLES))
            self._conditions.update("pdo_timeout", pdo, timed_out, now_s, str(TIMEOUT_CYCLES))
            for name, count, before in (
                ("pdo_short", seen.short, 0 if last is None else last.short),
                ("pdo_long", seen.long, 0 if last is None else last.long),
            ):
                if count != before:
                    self._until_s[name, pdo.name] = now_s + LENGTH_S
                self._conditions.update(name, pdo, now_s < self._until_s.get((name, pdo.name), -inf), now_s)


def pdo_subjects(config: Config) -> list[Subject]:
    """Return the input PDOs in the order of the snapshot's inputs, with the joints that need them."""
    joints = {joint.node_id: 1 << n for n, joint in enumerate(config.joints)}
    return [
        Subject(pdo.name, pdo.cob_id, joints.get(pdo.node_id, 0), pdo.node_id) for pdo in input_pdos(config)
    ]


# All of them --------------------------------------------------------------------------------------------------------------


@dataclass
class _Joint:
    """One joint: its PDOs by name, limits, and what was last seen of it."""

    subject: Subject
    number: int
    node: int
    names: tuple[str, str]
    sensor: str | None
    sensor_node: int | None
    temperature: str | None
    network_limit_nm: float | None
    sensor_zero_nm: float
    well: dict[str, int] = field(default_factory=dict)  # counters when it last had inputs
    faults: int = 0
    latches: int = 0
    until_s: float = -inf  # what was latched last is reported, however soon it was released
    jumps: int = 0
    deviation: Deviation = field(default_factory=Deviation)


class Health:
    """Keeps the conditions up to date: call `observe` with each reading of the snapshot."""

    def __init__(self, config: Config, conditions: Conditions) -> None:
        self._conditions = conditions
        names = [pdo.name for pdo in input_pdos(config)]
        temperatures = {each.node_id: each.name for each in joint_temperatures(config)}
        self._joints = []
        for n, joint in enumerate(config.joints):
            sensor, rated_nm = sensor_index(config, joint.sensor_channel), joint.joint.rated_torque_nm
            self._joints.append(
                _Joint(
                    subject=Subject(f"joint {joint.number}", joint.node_id, joints=1 << n),
                    number=n + 1,
                    node=joint.node_id,
                    names=names_of_inputs(config, n),
                    sensor=None if sensor is None else names[sensor],
                    sensor_node=config.sensor.node_id if sensor is not None and config.sensor else None,
                    temperature=temperatures.get(joint.node_id),
                    network_limit_nm=None
                    if joint.network is None
                    else largest_difference_nm(joint.joint, config.estimator),
                    sensor_zero_nm=config.estimator.sensor_zero_nm(rated_nm),
                )
            )
        self._nodes = node_subjects(config)
        self._pdos = PdoWatch(pdo_subjects(config), conditions)
        self._counters: dict[str, tuple[int, float]] = {}
        self._cycle, self._advanced_s = -1, -inf
        self._guest, self._sync_s = None if config.role == MASTER else config, 0.0

    def observe(
        self, view: View, now_s: float, *, absent: Collection[int] = (), cycles_lost: int = 0
    ) -> None:
        """Update the conditions from a reading.

        absent: optional nodes that are not there, whose PDOs are not missed; cycles_lost: by the recorder so far.
        """
        advanced = view.cycle != self._cycle
        if advanced:
            self._cycle, self._advanced_s = view.cycle, now_s
        stopped = now_s - self._advanced_s > _STOPPED_S
        since_s = self._advanced_s if stopped else now_s
        text = f"{_STOPPED_S:g} s"
        self._conditions.update("loop_stopped", THE_LOOP, stopped, now_s, text, since_s=since_s)
        self._pdos.observe(view.inputs, absent, now_s)
        if self._guest is not None:
            self._observe_master(self._guest, view, now_s)
        for counter, (name, subject) in _COUNTED.items():
            if self._guest is not None and name == "sync_late":
                name, text = "sync_irregular", f"{1e6 * view.period_s:g} us"  # noqa: PLW2901
            self._observe_counter(name, subject, view.counters[counter], now_s, text)
        self._observe_counter("cycles_lost", THE_RECORDER, cycles_lost, now_s, str(cycles_lost))
        for joint, seen, zeros in zip(self._joints, view.joints, view.zeros[: len(view.joints)], strict=True):
            self._observe_inputs(joint, seen, view, now_s)
            self._observe_status(joint, seen, zeros, now_s)
            self._observe_zeros(joint, zeros, now_s)
            if advanced:
                far = joint.deviation.update(seen, now_s, joint.sensor_zero_nm)
                text = f"{seen.torque_nm:.2f} Nm against {seen.reference_nm:.2f} Nm, sigma {seen.sigma_nm:.2f} Nm"
                if far != self._conditions.is_present("deviation", joint.subject.name):
                    self._conditions.update("deviation", joint.subject, far, now_s, text)
        for node, subject in self._nodes.items():
            self._observe_node(node, subject, view, absent, now_s)

    def _observe_master(self, config: Config, view: View, now_s: float) -> None:
        """Observe the SYNC of another master, and the NMT state that it gives jtqd."""
        self._sync_s = view.sync_monotonic_ns * 1e-9 or self._sync_s or now_s
        silent = now_s - self._sync_s > _SILENT_S + 3e-9 * config.period_ns
        text = f"for {_SILENT_S:g} s" if view.sync_monotonic_ns else "since the start"
        self._conditions.update("sync_lost", THE_BUS, silent, now_s, text)
        state = view.node_states[config.node_id]
        idle = config.role == GUEST and state in nmt.NOT_OPERATIONAL
        self._conditions.update("not_operational", THE_BUS, idle, now_s, nmt.STATES.get(state, ""))

    def _observe_inputs(self, joint: _Joint, seen: JointView, view: View, now_s: float) -> None:
        conditions, subject = self._conditions, joint.subject
        stale = seen.status == st.STALE
        if not stale or not joint.well:
            joint.well = view.counters
        why = partial(stale_reason, joint.node, joint.names, seen, view, joint.well)
        conditions.update("stale_input", subject, stale, now_s, why)
        if joint.sensor is not None:
            why = partial(sensor_reason, joint.sensor_node, joint.sensor, seen, view)
            conditions.update("sensor_lost", subject, not isfinite(seen.sensor_nm), now_s, why)
        if joint.temperature is not None:
            # It comes twice a second: at the start nobody can have it yet.
            gone = not seen.input_flags & FLAG_TEMPERATURE and view.cycle * view.period_s > TEMPERATURE_LIFE_S
            text = (
                f"{joint.temperature} not received for {TEMPERATURE_LIFE_S:g} s, or reported as not measured"
            )
            conditions.update("temperature_lost", subject, gone, now_s, text)

    def _observe_zeros(self, joint: _Joint, zeros: Zeros, now_s: float) -> None:
        subject = joint.subject
        why = zeros.implausible
        self._conditions.update("zero_implausible", subject, not zeros.plausible, now_s, why)
        before = self._conditions.is_present("zero_jumped", subject.name)
        jumped = zeros.jumps > joint.jumps or (before and zeros.tracked and not zeros.learned)
        joint.jumps = zeros.jumps
        if jumped != before:
            text = f"from {1e6 * zeros.link_used_rad:+.0f} µrad"
            self._conditions.update("zero_jumped", subject, jumped, now_s, text)

    def _observe_status(self, joint: _Joint, seen: JointView, zeros: Zeros, now_s: float) -> None:
        conditions, subject = self._conditions, joint.subject
        if again := seen.latches != joint.latches:
            joint.until_s = now_s + COUNTER_QUIET_S
        latched = seen.latched or (seen.released if now_s < joint.until_s else 0)
        present = seen.input_flags >> 8 | latched
        joins = bool(present & ~joint.faults)
        for name, bits, news in (("joint_fault", present, joins), ("fault_latched", latched, again)):
            conditions.update(
                name, subject, bits != 0, now_s, fault_meanings(bits, names=True), log_again=news
            )
        joint.faults, joint.latches = present, seen.latches
        drive = partial(drive_reason, seen)
        conditions.update("drive_fault", subject, seen.status == st.DRIVE_FAULT, now_s, drive)
        conditions.update("drive_off", subject, seen.status == st.OFF, now_s, drive)
        why = partial(degraded_reason, seen, joint.network_limit_nm, zeros)
        conditions.update("degraded", subject, seen.status == st.DEGRADED, now_s, why)

    def _observe_counter(
        self, name: str, subject: Subject, value: int, now_s: float, details: str = ""
    ) -> None:
        before, until_s = self._counters.get(name, (0, -inf))
        if value > before:
            until_s = now_s + COUNTER_QUIET_S
        self._counters[name] = value, until_s
        self._conditions.update(name, subject, now_s < until_s, now_s, details)

    def _observe_node(
        self, node: int, subject: Subject, view: View, absent: Collection[int], now_s: float
    ) -> None:
        conditions = self._conditions
        conditions.update("node_absent", subject, node in absent, now_s)
        unready = "" if node in absent else unready_reason(node, view)
        text = unready.removeprefix(f"node {node} ")
        conditions.update("node_unconfigured", subject, bool(unready), now_s, text)
        state = view.node_states[node]
        idle = not unready and state in nmt.NOT_OPERATIONAL
        conditions.update("node_not_operational", subject, idle, now_s, nmt.STATES.get(state, ""))
