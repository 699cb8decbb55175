"""What of a joint's estimate may be published: the rules of docs/safety.md, applied to one cycle after the other. Pure.

    estimate and inputs  ->  faults of this cycle  ->  status (`joint_status.py`)  ->  status and flags

A number leaves only through `JointRules.judge`. Everything that it needs beside the estimate comes from the log again: the
inputs, `cr.FLAG_WITHDRAWN` (`late`), `cr.FLAG_RESET` (`reset_latch`), `FLAG_NETWORK_SKIPPED`. So a replay gives the same.
"""

from __future__ import annotations

from math import inf, isnan
from typing import Final

from daemon.loop.joint_safety import JointSafety
from daemon.loop.joint_status import JointStatus
from daemon.loop.joint_tally import FLAG_NETWORK_SKIPPED, JointTally, Tally
from daemon.shared import faults
from estimator import status as st
from estimator.estimate import Estimate

_POWERED = {0x27, 0x07}
"""Operation enabled and quick stop active (6041h masked with 6Fh): the states in which the motor carries current."""
_FAULTS = {0x0F, 0x08}
"""Fault reaction active and fault (6041h masked with 4Fh)."""
_USUAL: Final = frozenset((st.VALID, st.STANDSTILL))
_PUBLISHED, _INVALID, _STARTING = frozenset(st.PUBLISHED), st.INVALID, st.STARTING


def drive_status(statusword: int) -> int | None:
    """Status that a drive's statusword (6041h) puts in place of any other; None for a motor that carries current."""
    if statusword & 0x6F in _POWERED:
        return None
    return st.DRIVE_FAULT if statusword & 0x4F in _FAULTS else st.OFF


def _no_check(_dt_s: float, _motor: float, _speed: float, _link: float, _current: float) -> int:
    return 0


class JointRules:
    """State of joint `number` (0 or 1): what is held and what is latched.

    Args:
        number, tally: where it counts.
        safety: limits and checks.
        with_network: the estimator uses one.

    Attributes:
        error: counts a published estimate minus the sensor's torque [Nm].
    """

    __slots__ = (
        "_check",
        "_deviates",
        "_limit",
        "_safety",
        "_state",
        "_tally",
        "_usual",
        "_with_network",
        "error",
    )

    def __init__(self, number: int, tally: Tally, safety: JointSafety, with_network: bool) -> None:
        self._tally = JointTally(number, tally)
        self.error = self._tally.error
        self._state = JointStatus(safety.settings)
        self.use(safety, with_network)

    def use(self, safety: JointSafety, with_network: bool) -> None:
        """From now on these limits; what is held and latched stays."""
        self._safety, self._with_network = safety, with_network
        self._check = _no_check if safety.plausibility is None else safety.plausibility.step
        self._limit = safety.torque_limit_nm
        # Nearly all cycles have one of these, and then nothing more has to be looked at.
        self._usual = frozenset() if safety.deviation_cycles else _USUAL
        self._state.use(safety.settings)
        self._deviates = 0

    def begin_again(self) -> None:
        """The drive restarted: where its encoders stood means nothing any more."""
        self._deviates = 0
        if self._safety.plausibility is not None:
            self._safety.plausibility.reset()

    def judge(  # noqa: PLR0917 - once per cycle: a call with names costs three times one without
        self,
        estimate: Estimate,
        dt_s: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        current_a: float,
        sensor_nm: float,
        statusword: int,
        starting: bool,
        network_wanted: bool,
    ) -> tuple[int, int]:
        """Status to publish and bits of `input_flags`.

        Time step to current: what the estimate was made of; `sensor_nm` NaN where unknown; while `starting`, an estimate
        with a number has status 1 instead.
        """
        found = self._check(dt_s, motor_position_rad, motor_velocity_rad_s, link_position_rad, current_a)
        torque, sigma, status, _, _, network = estimate
        flags = 0 if network_wanted or not self._with_network else FLAG_NETWORK_SKIPPED
        state, limit = self._state, self._limit
        if statusword & 0x6F not in _POWERED:
            status = drive_status(statusword) or st.OFF
        elif status in _PUBLISHED:
            if not (
                status in self._usual
                and -limit <= torque <= limit
                and 0.0 <= sigma < inf
                and (network - network == 0.0 or not self._with_network)
            ):
                found |= self._numbers(estimate, sensor_nm, network_wanted)
            if starting:
                status = _STARTING
        elif status == _INVALID:
            found |= faults.OUT_OF_RANGE
        status = state.update(status, found)
        if state.reasons or state.latched:
            flags |= self._tally.faults(state)
        return status, flags

    def stale(self) -> tuple[int, int]:
        """An input of this cycle is missing: status to publish and bits of `input_flags`."""
        state = self._state
        status = state.update(st.STALE)
        return status, self._tally.faults(state) if state.reasons or state.latched else 0

    def late(self) -> int:
        """The estimate that `judge` has seen, or the missing one, was not ready in time: status to publish."""
        return self._state.late()

    @property
    def latched(self) -> int:
        """Bits of the faults that are latched (`daemon/shared/faults.py`)."""
        return self._state.latched

    def reset_latch(self) -> bool:
        """Release what is latched; True if anything was."""
        return self._state.reset_latch()

    def _numbers(self, estimate: Estimate, sensor_nm: float, network_wanted: bool) -> int:
        """Faults of numbers that the estimator takes for good."""
        torque, sigma, status, _, physics, network = estimate
        safety = self._safety
        limit = safety.torque_limit_nm
        found = 0
        if not (-limit <= torque <= limit and 0.0 <= sigma < inf):  # so that NaN fails too
            finite = torque - torque == 0.0 and 0.0 <= sigma < inf
            found = faults.OUT_OF_RANGE if finite else faults.NOT_FINITE
        if self._with_network and (status == st.DEGRADED or network - network != 0.0):
            self._tally.network(status, network_wanted, network, physics, safety.network_limit_nm)
        if safety.deviation_cycles:
            if abs(torque - sensor_nm) <= safety.settings.deviation_sigmas * sigma:
                self._deviates = 0
            elif not isnan(sensor_nm):
                self._deviates += 1
            if self._deviates >= safety.deviation_cycles:
                found |= faults.DEVIATION
        return found
