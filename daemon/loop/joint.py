"""One joint in the loop: counts of this cycle into SI units, the estimate, its status, and what goes out and is recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, nan

from jtqd.daemon.loop import estimate_pdo
from jtqd.daemon.loop.input_pdos import UNKNOWN
from jtqd.daemon.loop.intake import Intake
from jtqd.daemon.loop.joint_status import (
    JointCounts,
    JointRules,
    JointSafety,
)
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_POSITION, FLAG_SENSOR, FLAG_TEMPERATURE
from jtqd.estimator import status as st
from jtqd.estimator.methods import AnyEstimator

_HALF_RANGE, _FULL_RANGE = 1 << 31, 1 << 32


class Unwrap:
    """Counts of a 32-bit position without its wrap at 2^31 (object 6064h is an INTEGER32 that rolls over).

    Args:
        offset: whole ranges that it had rolled over before the first sample [counts].
    """

    __slots__ = ("_last", "_offset")

    def __init__(self, offset: int = 0) -> None:
        self._last = 0
        self._offset = offset

    def counts(self, raw: int) -> int:
        """Return continuous counts; correct if two samples are less than 2^31 counts apart."""
        step = raw - self._last
        if not -_HALF_RANGE <= step < _HALF_RANGE:
            self._offset += -_FULL_RANGE if step > 0 else _FULL_RANGE
        self._last = raw
        return raw + self._offset


STAMP_ACCURACY_NS = 5_000
"""Kernel software stamps differ by a few us from the time on the wire."""
_PUBLISHED, _STANDSTILL, _field = estimate_pdo.PUBLISHED_STATUSES, st.STANDSTILL, estimate_pdo.field


@dataclass(frozen=True)
class JointInputs:
    """Indices of one joint's inputs among the intake's PDOs, and their scaling.

    Attributes:
        position: index of TPDO1 (motor position, link position).
        motion: index of TPDO2 (motor velocity, current, statusword).
        sensor: index of the sensor's PDO, None without reference.
        temperature: index among the intake's temperatures, None where the drive sends none.
        motor_rad_per_count, motor_rad_s_per_unit, link_rad_per_count, ampere_per_unit, sensor_nm_per_unit: scaling, SI.
    """

    position: int
    motion: int
    sensor: int | None
    motor_rad_per_count: float
    motor_rad_s_per_unit: float
    link_rad_per_count: float
    ampere_per_unit: float
    sensor_nm_per_unit: float
    temperature: int | None = None


class JointCycle:
    """State of one joint from cycle to cycle, in the loop or in a replay of its log.

    Args:
        number: 0 for joint 1, 1 for joint 2.
        inputs: which PDOs are its inputs, and their scaling.
        estimator: its estimator.
        intake: decides which PDOs are fresh.
        snapshot: counts fallbacks and squared errors.
        period_ns: of the SYNC.
        safety: limits and checks; None for those that need no joint file.

    Attributes:
        published: its fields of the estimate PDO, see `estimate_pdo.field`.
        status: as published.
        safety: its limits and checks.
        sample: its block of the cycle record, a `JointRecord`.
        view: its block of the snapshot, a `JointView`.
    """

    __slots__ = (
        "_last_ns",
        "_link",
        "_motion",
        "_motor",
        "_pdos",
        "_period_ns",
        "_position",
        "_rules",
        "_sensor",
        "_temperature",
        "estimator",
        "inputs",
        "published",
        "safety",
        "sample",
        "status",
        "view",
    )

    def __init__(
        self,
        number: int,
        inputs: JointInputs,
        estimator: AnyEstimator,
        *,
        intake: Intake,
        snapshot: JointCounts,
        period_ns: int,
        safety: JointSafety | None = None,
    ) -> None:
        self.inputs, self.estimator = inputs, estimator
        self.safety = safety or JointSafety()
        self._rules = JointRules(number, snapshot, self.safety, estimator.with_network)
        self._pdos = intake.pdos
        states = intake.views()
        self._position, self._motion = states[inputs.position], states[inputs.motion]
        self._sensor = None if inputs.sensor is None else states[inputs.sensor]
        self._temperature = UNKNOWN if inputs.temperature is None else intake.temperatures[inputs.temperature]
        self._period_ns = period_ns
        self._last_ns = 0
        self._motor, self._link = Unwrap(), Unwrap()
        self.status = st.STARTING
        self.sample: tuple[float, ...] = (nan,) * 12 + (0, 0, 0, 0)
        self.view: tuple[float, ...] = (nan,) * 6 + (0, 0, 0, 0, 0)
        self.published = estimate_pdo.field(nan, inf, st.STARTING)

    def use(self, estimator: AnyEstimator, safety: JointSafety) -> None:
        """Use this estimator with these limits; latched faults stay latched."""
        self.estimator, self.safety = estimator, safety
        self._rules.use(safety, estimator.with_network)

    def begin_again(self) -> None:
        """Restart after a restart of the drive: earlier positions and the observer's state are invalid."""
        self._motor, self._link = Unwrap(), Unwrap()
        self._last_ns = 0
        self.estimator.reset()
        self._rules.begin_again()

    @property
    def latched(self) -> int:
        """Return the bits of the latched faults (`daemon/shared/cycle_record.py`)."""
        return self._rules.latched

    def reset_latch(self) -> bool:
        """Release the latched faults and restart with the present encoder positions; return whether there was one."""
        if not self._rules.reset_latch():
            return False
        self.begin_again()
        return True

    def resume(self, motor_offset: int, link_offset: int) -> None:
        """Continue a log in the middle of a run, with the roll-over of the positions so far [counts]."""
        self._motor, self._link = Unwrap(motor_offset), Unwrap(link_offset)

    def rescale(self, node_id: int, factors: Sequence[float]) -> None:
        """Set the scaling of a node that was absent at the start (`SnapshotReader.note_factors`); zeros: none."""
        inputs, pdos = self.inputs, self._pdos
        if not any(factors):
            return
        if pdos[inputs.position].node_id == node_id:
            motor, speed, link, ampere = factors
            self.inputs = replace(
                inputs,
                motor_rad_per_count=motor,
                motor_rad_s_per_unit=speed,
                link_rad_per_count=link,
                ampere_per_unit=ampere,
            )
        elif inputs.sensor is not None and pdos[inputs.sensor].node_id == node_id:
            first = min(n for n, pdo in enumerate(pdos) if pdo.node_id == node_id)
            self.inputs = replace(inputs, sensor_nm_per_unit=factors[inputs.sensor - first])

    def withdraw(self, status: int = st.STALE) -> None:
        """Withdraw the estimate: it is neither sent nor logged as published. With status 4 it was too late."""
        if status == st.STALE:
            status = self._rules.late()
        self.published = estimate_pdo.field(nan, inf, status)
        self.status = status
        self.sample = (*self.sample[:6], nan, nan, *self.sample[8:13], status, *self.sample[14:])
        self.view = (nan, nan, *self.view[2:7], status, *self.view[8:])

    def observe(self, sync_ns: int, starting: bool, network_wanted: bool = True) -> None:
        """Estimate from the inputs of the cycle whose SYNC went out at `sync_ns` (CLOCK_MONOTONIC).

        While `starting`, an estimate that would be published has status 1 instead. Without `network_wanted` there is no time
        for the network in this cycle, and it is physics only.
        """
        inputs, position, motion = self.inputs, self._position, self._motion
        sensor_nm, sensor_status, flags = self._reference()
        temperature = self._temperature.celsius
        if temperature == temperature:  # noqa: PLR0124 - false for NaN, and cheaper than a call
            flags |= FLAG_TEMPERATURE
        if not (position.fresh and motion.fresh):
            flags |= position.fresh | motion.fresh << 1
            self._stale(sensor_nm, temperature, sensor_status, flags)
            return
        flags |= FLAG_POSITION | FLAG_MOTION
        motor_counts, link_counts = position.values
        velocity_units, current_units, statusword = motion.values
        current = current_units * inputs.ampere_per_unit
        motor_position = self._motor.counts(motor_counts) * inputs.motor_rad_per_count
        motor_velocity = velocity_units * inputs.motor_rad_s_per_unit
        link_position = self._link.counts(link_counts) * inputs.link_rad_per_count
        dt = self._since_last(sync_ns)
        estimate = self.estimator.step(
            dt, current, motor_position, motor_velocity, link_position, temperature, network_wanted
        )
        status, found = self._rules.judge(
            estimate,
            dt,
            motor_position,
            motor_velocity,
            link_position,
            current,
            sensor_nm,
            statusword,
            starting,
            network_wanted,
        )
        flags |= found
        torque, sigma, _, tob, physics, network = estimate
        self.published = _field(torque, sigma, status)
        if status not in _PUBLISHED:
            torque = sigma = nan
        elif status != _STANDSTILL and sensor_nm == sensor_nm:  # noqa: PLR0124 - false for NaN
            self._rules.error(torque - sensor_nm)
        self.status = status
        self.sample = (
            current,
            motor_position,
            motor_velocity,
            link_position,
            sensor_nm,
            temperature,
            torque,
            sigma,
            tob,
            physics,
            network,
            dt,
            statusword,
            status,
            sensor_status,
            flags,
        )
        self.view = (
            torque,
            sigma,
            tob,
            physics,
            network,
            sensor_nm,
            statusword,
            status,
            sensor_status,
            flags,
            self._rules.latched,
        )

    def _reference(self) -> tuple[float, int, int]:
        """Return sensor torque [Nm], 6150h and the bit of `input_flags` of this cycle; NaN and zeros without a sensor."""
        sensor = self._sensor
        if sensor is None or not sensor.fresh:
            return nan, 0, 0
        raw, status = sensor.values
        if status & 0x07:  # 6150h: not valid, positive or negative overload
            return nan, status, FLAG_SENSOR
        return raw * self.inputs.sensor_nm_per_unit, status, FLAG_SENSOR

    def _since_last(self, sync_ns: int) -> float:
        """Return the time step [s] since the last cycle with inputs, 0 at the first; store this SYNC as the last."""
        dt_ns = sync_ns - self._last_ns if self._last_ns else 0
        # SYNC keeps an absolute grid: a deviation below the stamps' own accuracy is theirs, not time's.
        if -STAMP_ACCURACY_NS < dt_ns - self._period_ns < STAMP_ACCURACY_NS:
            dt_ns = self._period_ns
        self._last_ns = sync_ns
        return dt_ns * 1e-9

    def _stale(self, sensor_nm: float, temperature: float, sensor_status: int, flags: int) -> None:
        """Handle a missing input: the observer keeps its state (the next dt is longer), nothing is published."""
        status, found = self._rules.stale()
        flags |= found
        self.published = estimate_pdo.field(nan, inf, status)
        self.status = status
        self.sample = (nan,) * 4 + (sensor_nm, temperature) + (nan,) * 6 + (0, status, sensor_status, flags)
        self.view = (nan,) * 5 + (sensor_nm, 0, status, sensor_status, flags, self._rules.latched)
