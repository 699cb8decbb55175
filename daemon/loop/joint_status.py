"""Status of a joint, from the estimate and inputs of each cycle: worse at once, better only after a while. Pure.

    estimate and inputs  ->  faults of this cycle  ->  status with hysteresis and latches  ->  status and flags

`JointSafety` holds limits and checks, `JointStatus` the hysteresis, `JointTally` counts, and `JointRules` applies the rules
of docs/safety.md to one cycle after the other: a number leaves only through `JointRules.judge`. What it needs beside the
estimate comes from the log again: the inputs, `cr.FLAG_WITHDRAWN` (`late`), `cr.FLAG_RESET` (`reset_latch`),
`FLAG_NETWORK_SKIPPED`. So a replay gives the same.

The statuses have an order, from good to bad:

    2 valid, 6 standstill  <  3 degraded  <  1 starting  <  0 off  <  4 stale  <  15 invalid  <  5 drive fault

- A worse one is published in the cycle in which it arises. A better one only when some cycles in a row (`NEEDED`: of the
  status that is left) have asked for one; the worst that they asked for is then published.
- Standstill has a hysteresis of its own (speed) and is published at once in place of valid and degraded.
- A joint that falls back into a status without a number soon after it had left one (within RELAPSE times the cycles that it
  had to wait) waits twice as long each time, at most MOST times as long: an input that comes and goes makes a joint that is
  stale, not one that flickers. A single lost frame costs little.
- A fault that is latched (`safety.latch`) stays until `reset_latch()`: its status, or a worse one, is published whatever
  the inputs say. Status 5, 4 or 15, see `jtqd.daemon.shared.faults.status_of`.

No clock and no randomness: the same statuses and faults give the same answer again, in the loop and from a log.
"""

from __future__ import annotations

from math import inf, isnan
from typing import Any, Final, Protocol

from jtqd.daemon.config import Config, SafetySettings
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.cycle_record import FLAG_LATCHED, FLAG_NETWORK_SKIPPED
from jtqd.daemon.shared.snapshot import COUNTERS
from jtqd.estimator import status as st
from jtqd.estimator.joint import Joint
from jtqd.estimator.plausibility import Plausibility
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Estimate

TORQUE_RANGE_NM: Final = 327.67
"""Of the field of the estimate PDO."""


class JointSafety:
    """Limits and checks of one joint, for the loop or a replay of its log; made once.

    Without a joint there is no check that needs its parameters.

    Attributes:
        settings: as configured.
        plausibility: checks of its inputs, None for none.
        torque_limit_nm: a torque beyond it is never published.
        network_limit_nm: a network further from physics than this has been dropped by the estimator.
        deviation_cycles: length of the fault `deviation`, 0 where it is not latched.
    """

    __slots__ = ("deviation_cycles", "network_limit_nm", "plausibility", "settings", "torque_limit_nm")

    def __init__(
        self,
        settings: SafetySettings | None = None,
        estimator: EstimatorSettings | None = None,
        joint: Joint | None = None,
        period_ns: int = 1_000_000,
    ) -> None:
        self.settings: Final = settings or SafetySettings()
        self.plausibility: Plausibility | None = None
        self.torque_limit_nm, self.network_limit_nm = TORQUE_RANGE_NM, inf
        self.deviation_cycles = 0
        if self.settings.latch & faults.DEVIATION:
            self.deviation_cycles = max(1, round(self.settings.deviation_s * 1e9 / period_ns))
        if joint is None or estimator is None:
            return
        self.torque_limit_nm = min(TORQUE_RANGE_NM, estimator.torque_limit * joint.rated_torque_nm)
        self.network_limit_nm = estimator.network_limit * joint.rated_torque_nm
        if self.settings.plausibility is not None:
            self.plausibility = Plausibility(
                joint, estimator.torque_limit, self.settings.plausibility, period_ns * 1e-9
            )


def safety_of(config: Config) -> list[JointSafety]:
    """Return the configured limits and checks of joints 1 and 2."""
    return [
        JointSafety(config.safety, config.estimator, joint.joint, config.period_ns) for joint in config.joints
    ]


NEEDED: Final = {
    st.DEGRADED: 100,
    st.STARTING: 1,
    st.OFF: 20,
    st.STALE: 5,
    st.INVALID: 50,
    st.DRIVE_FAULT: 100,
}
"""Cycles in a row that must be better before this status is left; the last of them is published already."""
RELAPSE: Final = 10
MOST: Final = 4

_ORDER: Final = (
    st.VALID,
    st.STANDSTILL,
    st.DEGRADED,
    st.STARTING,
    st.OFF,
    st.STALE,
    st.INVALID,
    st.DRIVE_FAULT,
)
_RANK: Final = tuple(_ORDER.index(code) if code in _ORDER else len(_ORDER) for code in range(16))
_STANDS: Final = _RANK[st.STANDSTILL]
_WITH_NUMBER: Final = _RANK[st.DEGRADED]
"""Up to this rank a torque is published."""


class JointStatus:
    """State of one joint.

    Attributes:
        latched: bits of the faults that are latched (`daemon/shared/cycle_record.py`).
        reasons: faults since a number was last published; 0 while one is.
        news, latches: faults that began, and how often one was latched, since whoever counts them set these to 0.
    """

    __slots__ = (
        "_asked",
        "_calm",
        "_factor",
        "_found",
        "_held",
        "_latching",
        "_needed",
        "_run",
        "_since",
        "_stale_limit",
        "_window",
        "latched",
        "latches",
        "news",
        "reasons",
    )

    def __init__(self, settings: SafetySettings) -> None:
        self.use(settings)
        self._held = st.STARTING
        self._asked = st.VALID
        self._needed = NEEDED[st.STARTING]
        self._calm = self._run = 0
        self._factor = 1
        self._since = self._window = 0
        self._found = 0
        self.latched = self.latches = self.news = self.reasons = 0

    def use(self, settings: SafetySettings) -> None:
        """Latch these faults from now on; held and latched states stay."""
        self._latching, self._stale_limit = settings.latch, settings.stale_latch_cycles

    def update(self, status: int, found: int = 0) -> int:
        """Return the status to publish for the requested `status` and the faults `found` (`shared/cycle_record.py`)."""
        self._since += 1
        if status == self._held and not found and not self.latched and _RANK[status] <= _WITH_NUMBER:
            self._calm = self._run = self._found = 0
            return status
        if found:
            self.news |= found & ~self._found
            self.reasons |= found
        self._found = found
        if found and _RANK[status] < _RANK[st.INVALID]:
            status = st.INVALID
        if status == st.STALE:
            found |= self._another()
        else:
            self._run = 0
            found |= faults.DRIVE_FAULT if status == st.DRIVE_FAULT else 0
        return self._publish(status, found)

    def pass_over(self, cycles: int) -> None:
        """Repeat the last cycle this many times: it got the requested status, and no fault."""
        self._since += cycles

    def late(self) -> int:
        """Return the status to publish if the estimate of this cycle was not ready in time, after `update`."""
        return self._publish(st.STALE, self._another())

    def reset_latch(self) -> bool:
        """Release latched faults; an existing fault latches again in the next cycle. Return whether there was one."""
        was, self.latched = self.latched, 0
        return bool(was)

    def _another(self) -> int:
        """Count a consecutive cycle without a torque; return the fault STALE when there were too many."""
        self._run += 1
        return faults.STALE if self._stale_limit is not None and self._run >= self._stale_limit else 0

    def _publish(self, status: int, found: int) -> int:
        new = found & self._latching & ~self.latched
        if new:
            self.latched |= new
            self.latches += 1
        if self.latched:
            status = _worse(status, faults.status_of(self.latched))
        held = self._held
        rank, worst = _RANK[status], _RANK[held]
        if rank > worst:
            self._fall(status)
        if rank >= worst or worst <= _STANDS:
            self._held, self._calm = status, 0
            return status
        self._asked = _worse(status, self._asked) if self._calm else status
        self._calm += 1
        if self._calm < self._needed:
            return status if status == st.STANDSTILL and worst <= _WITH_NUMBER else held
        self._rise(self._asked)
        return self._asked

    def _fall(self, status: int) -> None:
        """Change to a worse status."""
        if _RANK[self._held] <= _WITH_NUMBER < _RANK[status]:
            self._factor = min(2 * self._factor, MOST) if self._since < self._window else 1
        self._needed = self._cycles(status)

    def _rise(self, status: int) -> None:
        """Change to a better status after the hold time."""
        if _RANK[status] <= _WITH_NUMBER < _RANK[self._held]:
            self._since, self._window = 0, RELAPSE * self._needed
        if _RANK[status] <= _WITH_NUMBER:
            self.reasons = 0
        self._held, self._calm = status, 0
        self._needed = self._cycles(status)

    def _cycles(self, status: int) -> int:
        """Return the hold time of a status in cycles."""
        needed = NEEDED.get(status, 1)
        return needed if _RANK[status] <= _WITH_NUMBER else needed * self._factor


def _worse(a: int, b: int) -> int:
    return a if _RANK[a] >= _RANK[b] else b


_FALLBACKS, _LATCHES = COUNTERS.index("network_fallbacks"), COUNTERS.index("latches")
_NOT_FINITE, _FAR, _OUTSIDE, _NO_TIME = (
    COUNTERS.index(f"network_{why}") for why in ("not_finite", "far", "outside", "no_time")
)
_FAULTS: Final = tuple((bit, COUNTERS.index(f"fault_{faults.NAMES[bit]}")) for bit in faults.COUNTED)


class JointCounts(Protocol):
    """Target of a joint's counts: the loop's snapshot, or two lists in a replay.

    Attributes:
        counters: in the order of `jtqd.daemon.shared.snapshot.COUNTERS`.
        errors: sum of squared errors and number of samples of each joint.
    """

    counters: Any
    errors: Any


class JointTally:
    """Counts of joint `number` (0 or 1): why its network was dropped, its faults, its squared errors against the sensor."""

    __slots__ = ("_counters", "_errors", "_number")

    def __init__(self, number: int, tally: JointCounts) -> None:
        self._counters, self._errors = tally.counters, tally.errors
        self._number = number

    def faults(self, state: JointStatus) -> int:
        """Count the faults that are new in this cycle; return the flags that explain the missing torque."""
        counters = self._counters
        new = state.news
        if new:
            for bit, index in _FAULTS:
                if new & bit:
                    counters[index] += 1
            state.news = 0
        flags = (state.reasons & 0xFF) << 8
        if state.latched:
            counters[_LATCHES] += state.latches
            state.latches = 0
            flags |= FLAG_LATCHED | (state.latched & 0xFF) << 8
        return flags

    def network(
        self, status: int, wanted: bool, network_nm: float, physics_nm: float, limit_nm: float
    ) -> None:
        """Count a cycle in which the network is not fully used (status 3), or gave no torque."""
        counters = self._counters
        if status == st.DEGRADED:
            counters[_FALLBACKS] += 1
        if not wanted:
            counters[_NO_TIME] += 1
        elif network_nm - network_nm != 0.0:
            counters[_NOT_FINITE] += 1
        elif abs(network_nm - physics_nm) > limit_nm:
            counters[_FAR] += 1
        else:
            counters[_OUTSIDE] += 1

    def error(self, difference_nm: float) -> None:
        """Add the error of a published estimate against the sensor."""
        number, errors = self._number, self._errors
        errors[2 * number] += difference_nm**2
        errors[2 * number + 1] += 1.0


_POWERED = {0x27, 0x07}
"""Operation enabled and quick stop active (6041h masked with 6Fh): the states in which the motor carries current."""
_FAULT_STATES = {0x0F, 0x08}
"""Fault reaction active and fault (6041h masked with 4Fh)."""
_USUAL: Final = frozenset((st.VALID, st.STANDSTILL))
_PUBLISHED, _INVALID, _STARTING = frozenset(st.PUBLISHED), st.INVALID, st.STARTING


def drive_status(statusword: int) -> int | None:
    """Return the status forced by a drive's statusword (6041h), or None if the motor carries current."""
    if statusword & 0x6F in _POWERED:
        return None
    return st.DRIVE_FAULT if statusword & 0x4F in _FAULT_STATES else st.OFF


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

    def __init__(self, number: int, tally: JointCounts, safety: JointSafety, with_network: bool) -> None:
        self._tally = JointTally(number, tally)
        self.error = self._tally.error
        self._state = JointStatus(safety.settings)
        self.use(safety, with_network)

    def use(self, safety: JointSafety, with_network: bool) -> None:
        """Use these limits; held and latched states stay."""
        self._safety, self._with_network = safety, with_network
        self._check = _no_check if safety.plausibility is None else safety.plausibility.step
        self._limit = safety.torque_limit_nm
        # Nearly all cycles have one of these, and then nothing more has to be looked at.
        self._usual = frozenset() if safety.deviation_cycles else _USUAL
        self._state.use(safety.settings)
        self._deviates = 0

    def begin_again(self) -> None:
        """Restart after a restart of the drive: earlier encoder positions are invalid."""
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
        """Return the status to publish and the bits of `input_flags`.

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
        """Return status and bits of `input_flags` for a missing input."""
        state = self._state
        status = state.update(st.STALE)
        return status, self._tally.faults(state) if state.reasons or state.latched else 0

    def late(self) -> int:
        """Return the status to publish if the estimate was not ready in time."""
        return self._state.late()

    @property
    def latched(self) -> int:
        """Bits of the faults that are latched (`shared/cycle_record.py`)."""
        return self._state.latched

    def reset_latch(self) -> bool:
        """Release latched faults; return whether there was one."""
        return self._state.reset_latch()

    def _numbers(self, estimate: Estimate, sensor_nm: float, network_wanted: bool) -> int:
        """Return the faults of numbers that the estimator marked as good."""
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
