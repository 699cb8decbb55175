"""One joint in the loop: counts of this cycle into SI units, the estimate, its status, and what goes out and is recorded."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isnan, nan

from daemon import estimate_pdo
from daemon.intake import Intake
from daemon.snapshot import COUNTERS, Snapshot
from daemon.temperature import UNKNOWN
from daemon.unwrap import Unwrap
from estimator import status as st
from estimator.methods import AnyEstimator

STAMP_ACCURACY_NS = 5_000
"""Kernel software stamps differ by a few us from the time on the wire."""
FLAG_POSITION, FLAG_MOTION, FLAG_SENSOR, FLAG_TEMPERATURE = 1, 2, 4, 8
"""`input_flags` of record and snapshot: TPDO1, TPDO2 and the sensor's PDO are of this cycle; the temperature is known."""
_POWERED = {0x27, 0x07}
"""Operation enabled and quick stop active (6041h masked with 6Fh): the states in which the motor carries current."""
_FAULTS = {0x0F, 0x08}
"""Fault reaction active and fault (6041h masked with 4Fh)."""
_FALLBACKS = COUNTERS.index("network_fallbacks")


@dataclass(frozen=True)
class JointInputs:
    """Where one joint's inputs stand among the intake's PDOs, and what one count of each is worth.

    Attributes:
        position: index of TPDO1 (motor position, link position).
        motion: index of TPDO2 (motor velocity, current, statusword).
        sensor: index of the sensor's PDO, None without reference.
        temperature: index among the intake's temperatures, None where the drive tells none.
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
    """What the loop keeps of one joint from cycle to cycle.

    Args:
        number: 0 for joint 1, 1 for joint 2.
        inputs: which PDOs are its inputs, and their scaling.
        estimator: its estimator.
        intake: decides which PDOs are fresh.
        snapshot: counts fallbacks and squared errors.
        period_ns: of the SYNC.

    Attributes:
        published: its fields of the estimate PDO, see `estimate_pdo.field`.
        status: as published.
        sample: its block of the cycle record, a `JointRecord`.
        view: its block of the snapshot, a `JointView`.
    """

    __slots__ = (
        "_counters",
        "_errors",
        "_last_ns",
        "_link",
        "_motion",
        "_motor",
        "_number",
        "_period_ns",
        "_position",
        "_sensor",
        "_temperature",
        "estimator",
        "inputs",
        "published",
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
        snapshot: Snapshot,
        period_ns: int,
    ) -> None:
        self.inputs, self.estimator = inputs, estimator
        states = intake.views()
        self._position, self._motion = states[inputs.position], states[inputs.motion]
        self._sensor = None if inputs.sensor is None else states[inputs.sensor]
        self._temperature = UNKNOWN if inputs.temperature is None else intake.temperatures[inputs.temperature]
        self._number = number
        self._counters, self._errors = snapshot.counters, snapshot.errors
        self._period_ns = period_ns
        self._last_ns = 0
        self._motor, self._link = Unwrap(), Unwrap()
        self.status = st.STARTING
        self.sample: tuple[float, ...] = (nan,) * 12 + (0, 0, 0, 0)
        self.view: tuple[float, ...] = (nan,) * 6 + (0, 0, 0, 0)
        self.published = estimate_pdo.field(nan, inf, st.STARTING)

    def begin_again(self) -> None:
        """The drive restarted: its positions and the observer's past mean nothing any more."""
        self._motor, self._link = Unwrap(), Unwrap()
        self._last_ns = 0
        self.estimator.reset()

    def withdraw(self, status: int = st.STALE) -> None:
        """Take the estimate back: nothing of it goes out or is logged as published."""
        self.published = estimate_pdo.field(nan, inf, status)
        self.status = status
        self.sample = (*self.sample[:6], nan, nan, *self.sample[8:13], status, *self.sample[14:])
        self.view = (nan, nan, *self.view[2:7], status, *self.view[8:])

    def observe(self, sync_ns: int, starting: bool) -> None:
        """Estimate from the inputs of the cycle whose SYNC went out at `sync_ns` (CLOCK_MONOTONIC).

        While `starting`, an estimate that would be published has status 1 instead.
        """
        inputs, position, motion = self.inputs, self._position, self._motion
        sensor_nm, sensor_status, flags = nan, 0, 0
        sensor = self._sensor
        if sensor is not None and sensor.fresh:
            flags = FLAG_SENSOR
            raw, sensor_status = sensor.values
            if not sensor_status & 0x07:  # 6150h: not valid, positive or negative overload
                sensor_nm = raw * inputs.sensor_nm_per_unit
        temperature = self._temperature.celsius
        if not isnan(temperature):
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
        dt_ns = sync_ns - self._last_ns if self._last_ns else 0
        # SYNC keeps an absolute grid: a deviation below the stamps' own accuracy is theirs, not time's.
        if -STAMP_ACCURACY_NS < dt_ns - self._period_ns < STAMP_ACCURACY_NS:
            dt_ns = self._period_ns
        dt = dt_ns * 1e-9
        self._last_ns = sync_ns
        estimate = self.estimator.step(
            dt, current, motor_position, motor_velocity, link_position, temperature
        )
        status = estimate.status
        if starting and status in estimate_pdo.PUBLISHED_STATUSES:
            status = st.STARTING
        if statusword & 0x6F not in _POWERED:
            status = st.DRIVE_FAULT if statusword & 0x4F in _FAULTS else st.OFF
        if status == st.DEGRADED:
            self._counters[_FALLBACKS] += 1
        torque, sigma, tob, efficiency, network = (
            estimate[0],
            estimate[1],
            estimate[3],
            estimate[4],
            estimate[5],
        )
        self.published = estimate_pdo.field(torque, sigma, status)
        status = self.published[2]  # 15 where the number does not fit the field: log and bus agree
        if status not in estimate_pdo.PUBLISHED_STATUSES:
            torque = sigma = nan
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
            efficiency,
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
            efficiency,
            network,
            sensor_nm,
            statusword,
            status,
            sensor_status,
            flags,
        )
        if status in (st.VALID, st.DEGRADED) and not isnan(sensor_nm):
            number, errors = self._number, self._errors
            errors[2 * number] += (torque - sensor_nm) ** 2
            errors[2 * number + 1] += 1.0

    def _stale(self, sensor_nm: float, temperature: float, sensor_status: int, flags: int) -> None:
        """An input of this cycle is missing: the observer keeps its state (the next dt is longer), nothing is published."""
        self.published = estimate_pdo.field(nan, inf, st.STALE)
        self.status = st.STALE
        self.sample = (nan,) * 4 + (sensor_nm, temperature) + (nan,) * 6 + (0, st.STALE, sensor_status, flags)
        self.view = (nan,) * 5 + (sensor_nm, 0, st.STALE, sensor_status, flags)
