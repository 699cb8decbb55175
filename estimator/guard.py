"""Guard around an observer: starts, gaps, garbage and standstill of one joint, sample by sample.

| sample | status and what follows |
|---|---|
| not finite | INVALID, and the next good sample starts again |
| the first, dt <= 0, dt too long | STARTING: the observer is set to this sample, nothing is published |
| implausible motor torque or speed | INVALID and start again: one absurd sample must not decay into the next |
| abs(v) below the threshold | STANDSTILL, until it is above twice the threshold |
| else | VALID |
"""

from __future__ import annotations

from typing import Final, Generic, Protocol, TypeVar

from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import INVALID, STANDSTILL, STARTING, VALID

RAW_LIMIT: Final = 10.0
"""Largest |tau_raw| in rated torques: no motor of the joint can give it, friction cannot hide it."""

LINK_SPEED_LIMIT_RAD_S: Final = 1e3
"""Largest link speed of a joint-side encoder that still means anything."""


class ObserverOutput(Protocol):
    """Output of an observer, as far as the guard checks it [Nm, rad/s, joint side]."""

    @property
    def raw_nm(self) -> float:
        """Motor torque without any loss."""

    @property
    def joint_velocity_rad_s(self) -> float:
        """Filtered velocity of the motor over the gear ratio."""

    @property
    def link_velocity_rad_s(self) -> float:
        """Velocity of the link encoder."""


OutputT_co = TypeVar("OutputT_co", bound=ObserverOutput, covariant=True)


class SampleObserver(Protocol[OutputT_co]):
    """Observer fed sample by sample (`observer.Observer`, `observer.FusedObserver`)."""

    def start(
        self,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> OutputT_co:
        """Set the states to this sample."""

    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> OutputT_co:
        """Advance by dt_s > 0."""


class Guard(Generic[OutputT_co]):
    """Guard around an observer of one joint; `status` is that of the last step, STARTING before the first."""

    __slots__ = ("_leave", "_max_gap", "_observer", "_raw_limit", "_running", "_standing", "_stop", "status")

    def __init__(
        self, observer: SampleObserver[OutputT_co], joint: Joint, settings: EstimatorSettings
    ) -> None:
        self._observer: Final = observer
        self._max_gap: Final = settings.max_gap_s
        self._stop: Final = settings.standstill_velocity_rad_s
        self._leave: Final = 2.0 * settings.standstill_velocity_rad_s
        self._raw_limit: Final = RAW_LIMIT * joint.rated_torque_nm
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next step starts."""
        self._running = False
        self._standing = False
        self.status = STARTING

    def step(
        self,
        dt_s: float,
        current_a: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
    ) -> OutputT_co | None:
        """Advance by dt_s to this sample; None when `status` is STARTING or INVALID."""
        total = current_a + motor_position_rad + motor_velocity_rad_s + link_position_rad
        if total - total != 0.0:  # NaN or infinite: one subtraction instead of four isfinite calls
            self._running = False
            self.status = INVALID
            return None
        if not self._running or not 0.0 < dt_s <= self._max_gap:
            out = self._observer.start(current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
            self._running = True
            self._standing = abs(out.joint_velocity_rad_s) < self._stop
            self.status = STARTING
            return None
        out = self._observer.step(
            dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad
        )
        raw = out.raw_nm
        v = out.joint_velocity_rad_s
        link_velocity = out.link_velocity_rad_s
        # written so that NaN fails too
        if not (
            -self._raw_limit <= raw <= self._raw_limit
            and -LINK_SPEED_LIMIT_RAD_S <= link_velocity <= LINK_SPEED_LIMIT_RAD_S
        ):
            self._running = False
            self.status = INVALID
            return None
        if -self._leave <= v <= self._leave:
            if -self._stop < v < self._stop:
                self._standing = True
        else:
            self._standing = False
        self.status = STANDSTILL if self._standing else VALID
        return out
