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

from libc.math cimport NAN, fabs, isnan

from typing import Final

from jtqd.estimator import status as st

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

cdef double FORGET_RATE = 1.0 / FORGET_S
cdef double JUMP = JUMP_RAD_S, LAG = LAG_S, FROZEN = FROZEN_RAD, LONGEST = LONGEST_STEP_S
cdef int MOTOR_JUMP = st.MOTOR_JUMP, LINK_JUMP = st.LINK_JUMP, VELOCITY_MISMATCH = st.VELOCITY_MISMATCH
cdef int TORSION = st.TORSION, CURRENT_FROZEN = st.CURRENT_FROZEN


cdef class Plausibility:
    """Plausibility checks of one joint, sample by sample; `mismatch_rad` is that of the last sample.

    joint: gear ratio, stiffness and rated torque; torque_limit: largest believable torque in rated torques; period_s: of the
    samples.
    """

    def __init__(self, joint, double torque_limit, limits, double period_s=0.001):
        self.gap_s = _GAP_PERIODS * period_s
        self.per_turn = 1.0 / joint.gear_ratio
        self.jump = limits.motor_jump_rad
        self.limit = limits.mismatch_rad
        self.longest_frozen_s = limits.frozen_s
        self.twist_limit = (
            2.0 * torque_limit * joint.rated_torque_nm / joint.stiffness_nm_per_rad + limits.twist_rad
        )
        self.twist_jump = 0.5 * self.twist_limit
        self.reset()

    def reset(self):
        """Forget everything: the next sample is the reference."""
        self.low = self.high = NAN
        self.motor = self.twist = self.current = self.frozen_from = NAN
        self.frozen_s = 0.0
        self.mismatch_rad = 0.0

    def step(
        self,
        double dt_s,
        double motor_position_rad,
        double motor_velocity_rad_s,
        double link_position_rad,
        double current_a,
    ):
        """Return the faults of this sample, dt_s [s] after the one before: 0, or the bits of the table above."""
        return self.check(dt_s, motor_position_rad, motor_velocity_rad_s, link_position_rad, current_a)

    cdef int check(
        self, double dt_s, double motor_position, double motor_velocity, double link_position, double current
    ) noexcept nogil:
        """As `step`, for the loop."""
        cdef double slip = motor_position - self.motor - motor_velocity * dt_s
        cdef double twist = motor_position * self.per_turn - link_position
        cdef double change = twist - self.twist
        self.mismatch_rad = self.mismatch_rad * (1.0 - dt_s * FORGET_RATE) + slip
        self.motor = motor_position
        self.twist = twist
        if current == self.current:
            self.frozen_s += dt_s
        else:
            self.current = current
            self.frozen_from = motor_position
            self.frozen_s = 0.0
        if (
            -self.jump < slip < self.jump
            and -self.limit < self.mismatch_rad < self.limit
            and self.low < twist < self.high
            and -self.twist_jump < change < self.twist_jump
            and 0.0 < dt_s < self.gap_s
            and self.frozen_s < self.longest_frozen_s
        ):
            return 0
        return self.faults(dt_s, slip, motor_velocity, change)

    cdef int faults(self, double dt_s, double slip, double velocity, double change) noexcept nogil:
        """Return the faults of a sample that is not clearly good: starts, gaps, long constant currents, faults."""
        cdef int faults = 0
        if isnan(self.low):  # the first sample
            self.low, self.high = self.twist - self.twist_limit, self.twist + self.twist_limit
            self.mismatch_rad = 0.0
            return 0
        if not self.low < self.twist < self.high:
            faults |= TORSION
        if not 0.0 < dt_s <= LONGEST:
            self.mismatch_rad = self.frozen_s = 0.0
            return faults
        if fabs(slip) > self.jump + JUMP * dt_s:
            faults |= MOTOR_JUMP
            self.mismatch_rad = 0.0  # reported once: it is no velocity that is wrong
        elif fabs(change) > self.twist_jump:
            faults |= LINK_JUMP
        if dt_s >= self.gap_s:
            self.mismatch_rad = 0.0
        elif fabs(self.mismatch_rad) > self.limit + LAG * fabs(velocity):
            faults |= VELOCITY_MISMATCH
        if (
            self.frozen_s >= self.longest_frozen_s
            and self.current != 0.0
            and fabs(self.motor - self.frozen_from) > FROZEN
        ):
            faults |= CURRENT_FROZEN
        return faults
