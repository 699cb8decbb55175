"""Plausibility of one joint's encoders and current against each other: a sample in, bits of faults out.

    slip     = theta_m(k) - theta_m(k-1) - omega_m dt       motor side: what the position moved beyond the drive's velocity
    mismatch = sum of slip, forgotten with FORGET_S         a drive's velocity lags: single slips mean little, their sum does
    twist    = theta_m/G - theta_l - reference              joint side: what the gear would have to be twisted by

| fault | when | what it shows |
|---|---|---|
| MOTOR_JUMP | abs(slip) > motor_jump_rad + JUMP_RAD_S dt | motor position jumped |
| LINK_JUMP | twist changes by more than half its limit in one step | link position jumped |
| VELOCITY_MISMATCH | abs(mismatch) > mismatch_rad + LAG_S abs(omega_m) | frozen or reversed motor position, or velocity |
| TORSION | abs(twist) > its limit | link encoder frozen, reversed or slipped; wrong gear ratio; motor encoder frozen |
| CURRENT_FROZEN | the same current, not 0, for frozen_s while the motor turned by FROZEN_RAD | current or its PDO frozen |

Nothing is concluded from a value that stands still beside others that stand still: a joint at rest is no fault. The limit of
the twist is what twice the largest believable torque does to the gear, and `twist_rad` for encoder errors: the
reference is the first sample, whose own torque is not known. It stays, over gaps too, until `reset()`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from typing import Annotated, Final

from jtqd.estimator.decoder import check, limits
from jtqd.estimator.joint import Joint
from jtqd.estimator.status import CURRENT_FROZEN, LINK_JUMP, MOTOR_JUMP, TORSION, VELOCITY_MISMATCH

FORGET_S: Final = 1.0
JUMP_RAD_S: Final = 300.0
"""Motor side: how wrong the velocity of one sample may be, as a drive's filter lags while the motor accelerates."""
LAG_S: Final = 0.05
"""Motor side: with FORGET_S, the velocity's scale may be wrong by a twentieth."""
FROZEN_RAD: Final = 5.0
"""Motor side: a current that is regulated moves its last digits while the motor turns so far."""
LONGEST_STEP_S: Final = 0.05
"""Differences over a longer step are not judged."""
_GAP_PERIODS: Final = 5.0
"""A longer step is a gap: its slip is acceleration that was not measured, and is not added up."""


@dataclass(frozen=True, slots=True)
class PlausibilityLimits:
    """Thresholds, see the table above. Values out of range raise ConfigError.

    motor_jump_rad, mismatch_rad: motor side; twist_rad: joint side, for eccentric encoders and the like; frozen_s: of the
    current. docs/safety.md says how far the runs of the bench stay below them.
    """

    motor_jump_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 1.0
    mismatch_rad: Annotated[float, limits("rad", ge=0.01, le=1e6)] = 4.0
    twist_rad: Annotated[float, limits("rad", ge=1e-4, le=1e3)] = 0.01
    frozen_s: Annotated[float, limits("s", ge=0.01, le=1e6)] = 0.5

    def __post_init__(self) -> None:
        check(self, "plausibility")


class Plausibility:
    """Plausibility checks of one joint, sample by sample; `mismatch_rad` is that of the last sample.

    joint: gear ratio, stiffness and rated torque; torque_limit: largest believable torque in rated torques; period_s: of the
    samples.
    """

    __slots__ = (
        "_current",
        "_frozen_from",
        "_frozen_s",
        "_gap_s",
        "_high",
        "_jump",
        "_limit",
        "_longest_frozen_s",
        "_low",
        "_mismatch",
        "_motor",
        "_per_turn",
        "_twist",
        "_twist_jump",
        "_twist_limit",
        "mismatch_rad",
    )

    def __init__(
        self, joint: Joint, torque_limit: float, limits: PlausibilityLimits, period_s: float = 0.001
    ) -> None:
        self._gap_s: Final = _GAP_PERIODS * period_s
        self._per_turn: Final = 1.0 / joint.gear_ratio
        self._jump: Final = limits.motor_jump_rad
        self._limit: Final = limits.mismatch_rad
        self._longest_frozen_s: Final = limits.frozen_s
        self._twist_limit: Final = (
            2.0 * torque_limit * joint.rated_torque_nm / joint.stiffness_nm_per_rad + limits.twist_rad
        )
        self._twist_jump: Final = 0.5 * self._twist_limit
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next sample is the reference."""
        self._low, self._high = nan, nan
        self._motor = self._twist = self._current = nan
        self._frozen_from = nan
        self._frozen_s = 0.0
        self.mismatch_rad = 0.0

    def step(
        self,
        dt_s: float,
        motor_position_rad: float,
        motor_velocity_rad_s: float,
        link_position_rad: float,
        current_a: float,
    ) -> int:
        """Return the faults of this sample, dt_s [s] after the one before: 0, or the bits of the table above."""
        slip = motor_position_rad - self._motor - motor_velocity_rad_s * dt_s
        twist = motor_position_rad * self._per_turn - link_position_rad
        change = twist - self._twist
        self.mismatch_rad = mismatch = self.mismatch_rad * (1.0 - dt_s * (1.0 / FORGET_S)) + slip
        self._motor = motor_position_rad
        self._twist = twist
        if current_a == self._current:
            self._frozen_s += dt_s
        else:
            self._current = current_a
            self._frozen_from = motor_position_rad
            self._frozen_s = 0.0
        jump, limit, twist_jump = self._jump, self._limit, self._twist_jump
        if (
            -jump < slip < jump
            and -limit < mismatch < limit
            and self._low < twist < self._high
            and -twist_jump < change < twist_jump
            and 0.0 < dt_s < self._gap_s
            and self._frozen_s < self._longest_frozen_s
        ):
            return 0
        return self._faults(dt_s, slip, motor_velocity_rad_s, change)

    def _faults(self, dt_s: float, slip: float, velocity: float, change: float) -> int:
        """Return the faults of a sample that is not clearly good: starts, gaps, long constant currents, faults."""
        if self._low != self._low:  # NaN: the first sample
            self._low, self._high = self._twist - self._twist_limit, self._twist + self._twist_limit
            self.mismatch_rad = 0.0
            return 0
        faults = 0 if self._low < self._twist < self._high else TORSION
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            self.mismatch_rad = self._frozen_s = 0.0
            return faults
        if abs(slip) > self._jump + JUMP_RAD_S * dt_s:
            faults |= MOTOR_JUMP
            self.mismatch_rad = 0.0  # reported once: it is no velocity that is wrong
        elif abs(change) > self._twist_jump:
            faults |= LINK_JUMP
        if dt_s >= self._gap_s:
            self.mismatch_rad = 0.0
        elif abs(self.mismatch_rad) > self._limit + LAG_S * abs(velocity):
            faults |= VELOCITY_MISMATCH
        if (
            self._frozen_s >= self._longest_frozen_s
            and self._current != 0.0
            and abs(self._motor - self._frozen_from) > FROZEN_RAD
        ):
            faults |= CURRENT_FROZEN
        return faults
