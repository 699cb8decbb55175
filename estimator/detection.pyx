"""Faults of encoders and current, and contacts of the link, detected sample by sample.

**Plausibility** of one joint's encoders and current against each other:

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
| REPEATED | samples, all four numbers, equal those of a fixed number of samples ago for longer than chance | they have come before: all later ones are as old |

Noise does not come twice. What has the probability q came 1/q samples ago, in the mean (Kac 1947), whatever q is: of a run of samples
that equal those of `lag` samples ago, n samples after the nearest equal one each, chance has the probability 1/product(n) at most:

    sum(log n) > RARE + log(lag)              within its lag, where a position has changed: the current alone may have a limit cycle
    2 sum(log(lag/c)) - log(lag!/prod(c!)) > RARE_WHOLE + log(lag)      where it ends after its lag: no limit cycle

c: how often each sample is in a period; no probabilities make such a period, and it again, likelier than c/lag (Gibbs). No evidence
is a sample that goes on with a shorter period. Enough is a run of AFTER_A_JUMP, alone, that begins with a jump of the motor:
abs(slip) > JUMPS times the largest of SLIP_S, 2.4 times in 280 000 samples. At rest chance exceeds RARE once in three years.
Nothing is concluded from a value that stands still beside others that stand still: a joint at rest is no fault. The limit of
the twist is what twice the largest believable torque does to the gear, and `twist_rad` for encoder errors: the
reference is the first sample, whose own torque is not known. It stays, over gaps too, until `reset()`.

**Encoders that are alive and quiet**, as torques by the stiffness of the torsion: what a reading may be off by widens sigma in
the same sample. A step of a reading is in order where it continues the last steps, or the drive's velocity:

    |step - last step|, or |step - omega_m dt|  <=  max(NOISE_SIGMAS noise, COUNTS counts, FASTER rated torques dt^2/inertia)
    off    += step beyond that; a reading that steps back brings it back to 0
    unseen  = sum of omega_m dt while the reading stands still; link encoder: or what the current has changed by
    slipped = range, over RANGE_S, of sum(theta_m(k) - theta_m(k-1) - omega_m dt (1 + scale) - lag (omega_m dt less the last)), beyond
              max(NOISE_SIGMAS times what is usual in motion, LEAST_SLIPPED tolerances) and lag^2 times the acceleration over it
    longer  = samples by which a run of equal ones at rest is longer than healthy noise gives with exp(-RARE): with n of them seen,
              (1 + run/(n (mean + 1/2)))^-n (Lomax 1954). After a gap a joint with KNOWN_RUNS is alive when a sample has differed
    doubt   = max(|off|, |unseen|) - TOLERANCE, slipped, or LOAD_HZ longer dt: how far the fastest load may have gone
    louder  = mean square of the second differences of theta_m/G - theta_l, by 6, less SURELY times what the file's sigma has

Of white noise, and of counts that are passed quickly, a second difference has six times the variance; of a motion it has nothing,
because both encoders have it. The noise is learned from steps in order. After STRANGE samples out of order `off` is the sum of
noise, and fades. In motion it is bounded by what the current path leaves possible.

A drive's velocity is its position behind a filter, to first order a lag, to second order at most lag^2; lag and scale are those of
least squares over the motion in order so far, from a squared tolerance of changes on. What no step shows, the sum does: counts that
are lost, an angle error, data of before. A velocity that is wrong counts as well, as it is not known which of the two is. On four
emulated plants the range is at most 0.004 Nm in health.

**Contacts**: a sudden external torque on the link, from the link's momentum. Figures and limits: docs/estimator.md.

Link side of one joint, own frame, without current and friction. k: sample, T: step, q: link position:

    tau     = torsion, unfiltered: tau_t + K (d - d_f) + D (d' - d_f')    d_f: d through the torsion's own filter g_t
    rate    = g_t K (d - d_f)                                             tau' through g_t/(s + g_t)
              K d_f'                                                      where the torsion is tracked, as is d_f
    p_k     = J (q_k - q_(k-1))/T                                         momentum of the link over a step
    load    = tau_(k-1) - (p_k - p_(k-1))/T                               torque on the load beyond the link

A contact makes `load` less than the torque that the load takes:

    x = -load                       one joint: the load is unknown, and constant or slow
    x = load_other - load           two joints that turn one link against each other: the other one measures the load
    e = x - w - z                   w: waves of 1 and 2 per motor turn, z: trend; both adapt to e more slowly than a contact acts
    m = (e_k + e_(k-1))/2           or SINGLE e_k where that is larger; the residual. Encoder noise enters as second differences
                                    and mostly cancels in the mean; a large residual need not wait for it
    contact where |m| > threshold, until m steps back by as much and by RELEASE of the push, or |m| < RELEASE threshold
    within 1/TREND_RAD_S, or LONGEST_S have passed; then BLANK samples without a result, since z starts again

During a contact, neither w nor z adapts: m is the size of the push. The load may change meanwhile, so that m alone does not show
when the push ends; a step back is taken from a second trend, of e since the contact began.
"""

from libc.math cimport INFINITY, NAN, cos, expm1, fabs, isfinite, isnan, log, sin, sqrt
from libc.stdint cimport uint8_t, uint64_t
from libc.string cimport memcpy, memset

from typing import Final

import numpy as np

from jtqd.estimator.fusion cimport local_stiffness

from jtqd.estimator import status as st

# Plausibility ----------------------------------------------------------------------------------------------------------

FROZEN_RAD: Final = 5.0
"""Motor side: a current that is regulated moves its last digits while the motor turns so far."""

cdef double FORGET_S = 1.0, FORGET_RATE = 1.0 / FORGET_S
cdef double JUMP_RAD_S = 300.0  # motor side: how wrong the velocity of one sample may be, as a drive's filter lags while the motor accelerates
cdef double LAG_S = 0.05  # motor side: with FORGET_S, the velocity's scale may be wrong by a twentieth
cdef double FROZEN = FROZEN_RAD, WINDUP = 1.25
cdef double LONGEST_STEP_S = 0.05  # differences over a longer step are not judged
cdef double GAP_PERIODS = 5.0  # a longer step is a gap: its slip is acceleration that was not measured, and is not added up
cdef int MOTOR_JUMP = st.MOTOR_JUMP, LINK_JUMP = st.LINK_JUMP, VELOCITY_MISMATCH = st.VELOCITY_MISMATCH
cdef int TORSION = st.TORSION, CURRENT_FROZEN = st.CURRENT_FROZEN, REPEATED = st.REPEATED
cdef double RARE = 24.0, RARE_WHOLE = 20.5, AFTER_A_JUMP = 3.0  # evidence that chance has once in years of rest; samples
cdef double JUMPS = 4.0, SLIP_S = 0.05, LEAST_SLIP = 1e-3  # ratio; [s]; [rad], of a channel without noise
cdef uint64_t ODD = 0x9E3779B97F4A7C15
cdef double LOG[256]
LOG[:] = [0.0, *np.log(np.arange(1, 256))]

cdef inline uint64_t _mixed(uint64_t word, double value) noexcept nogil:
    """Return a hash of all values so far."""
    cdef uint64_t bits
    memcpy(&bits, &value, sizeof(bits))
    word = (word ^ bits) * ODD
    return word ^ word >> 29


cdef double _twice(const Samples *s, uint8_t lag) noexcept nogil:
    """Return the evidence of a period of `lag` samples and the same again, whose last one is not stored yet."""
    cdef double evidence = -LOG[lag]
    cdef int i, j, count, before, end = s.next - 2
    for i in range(lag):
        count = before = 0
        for j in range(lag):
            if s.words[<uint8_t> (end - i)] == s.words[<uint8_t> (end - j)]:
                count, before = count + 1, before + (j <= i)
        evidence += 2.0 * (LOG[lag] - LOG[count]) - LOG[i + 1] + LOG[before]
    return evidence


cdef bint _repeats(Samples *s, uint64_t word, bint jumped, bint still) noexcept nogil:
    """Take a sample's hash, and of its step; return whether the last ones are the same as earlier ones, by more than chance."""
    cdef uint8_t k = s.next, slot = word & 0xFF, at = s.at[slot], lag = k - at, before = 0, nearest = 0, ended = s.whole
    cdef bint repeats = False, periodic = False
    cdef unsigned int length = 0
    cdef Run *run
    s.next, s.count, s.whole = k + 1, s.count + 1, 0
    s.since, s.still = 0 if jumped else s.since + 1, s.still + 1 if still else 0
    while lag > before and s.words[at] & 0xFF == slot and length < 256:
        if s.words[at] == word:
            run = &s.runs[lag]
            if run.last != s.count - 1:
                run.first, run.evidence, run.alone = s.count, -LOG[lag], 0
            run.last, length = s.count, s.count - run.first + 1
            nearest, periodic = nearest or lag, periodic or length > lag
            if not periodic:
                run.evidence, run.alone = run.evidence + LOG[nearest], run.alone + (nearest == lag)
                repeats |= (run.evidence > RARE and s.still < length) or (run.alone >= AFTER_A_JUMP and s.since == length - 1)
                if length == lag > 7:  # a shorter one has less than RARE_WHOLE, whatever its samples
                    run.evidence = _twice(s, lag)
            if lag <= length < 2 * lag and run.evidence > RARE_WHOLE:
                s.whole = lag
        before, lag, at = lag, k - s.older[at], s.older[at]
    s.words[k], s.older[k], s.at[slot] = word, s.at[slot], k
    return repeats or (ended and s.runs[ended].last != s.count)


cdef class Plausibility:
    """Plausibility checks of one joint, sample by sample; `mismatch_rad` is that of the last sample.

    joint: gear ratio, stiffness and rated torque; torque_limit: largest believable torque in rated torques; period_s: of the
    samples.
    """

    def __init__(self, joint, double torque_limit, limits, double period_s=0.001):
        self.gap_s = GAP_PERIODS * period_s
        self.per_turn = 1.0 / joint.gear_ratio
        self.jump, self.limit = limits.motor_jump_rad, limits.mismatch_rad
        self.longest_frozen_s = limits.frozen_s
        self.twist_limit = (2.0 * torque_limit * joint.rated_torque_nm / joint.stiffness_nm_per_rad + limits.twist_rad)
        self.twist_jump = 0.5 * self.twist_limit
        self.reset()

    def reset(self):
        """Forget everything: the next sample is the reference."""
        self.low = self.high = NAN
        self.motor = self.twist = self.current = self.frozen_from = NAN
        self.frozen_s = self.mismatch_rad = 0.0
        self.slip = LEAST_SLIP
        memset(&self.samples, 0, sizeof(Samples))

    def step(
        self, double dt_s, double motor_position_rad, double motor_velocity_rad_s, double link_position_rad,
        double current_a
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
        cdef uint64_t word = _mixed(_mixed(_mixed(_mixed(ODD, motor_position), link_position), motor_velocity), current)
        cdef bint still = change == 0.0 and motor_position == self.motor, jumped = fabs(slip) > JUMPS * self.slip
        cdef bint repeats = _repeats(&self.samples, word, jumped, still)
        self.slip = max(fabs(slip), self.slip - (self.slip - LEAST_SLIP) * min(dt_s / SLIP_S, 1.0))
        self.mismatch_rad = self.mismatch_rad * (1.0 - dt_s * FORGET_RATE) + slip
        self.motor, self.twist = motor_position, twist
        if current == self.current:
            self.frozen_s += dt_s
        else:
            self.current, self.frozen_from, self.frozen_s = current, motor_position, 0.0
        if (
            -self.jump < slip < self.jump
            and -self.limit < self.mismatch_rad < self.limit
            and self.low < twist < self.high
            and -self.twist_jump < change < self.twist_jump
            and 0.0 < dt_s < self.gap_s
            and self.frozen_s < self.longest_frozen_s
            and not repeats
        ):
            return 0
        return self.faults(dt_s, slip, motor_velocity, change) | (REPEATED if repeats else 0)

    cdef int faults(self, double dt_s, double slip, double velocity, double change) noexcept nogil:
        """Return the faults of a sample that is not clearly good: starts, gaps, long constant currents, faults."""
        cdef int faults = 0
        if isnan(self.low):  # the first sample
            self.low, self.high = self.twist - self.twist_limit, self.twist + self.twist_limit
            self.mismatch_rad = 0.0
            return 0
        if not self.low < self.twist < self.high:
            faults |= TORSION
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            self.mismatch_rad = self.frozen_s = 0.0
            return faults
        if fabs(slip) > self.jump + JUMP_RAD_S * dt_s:
            faults |= MOTOR_JUMP
            self.mismatch_rad = 0.0  # reported once: it is no velocity that is wrong
        elif fabs(change) > self.twist_jump:
            faults |= LINK_JUMP
        if dt_s >= self.gap_s:
            self.mismatch_rad = 0.0
        elif fabs(self.mismatch_rad) > self.limit + LAG_S * fabs(velocity):
            faults |= VELOCITY_MISMATCH
            # what is far beyond its limit, too, is forgotten soon after its end
            self.mismatch_rad *= min(WINDUP * (self.limit + LAG_S * fabs(velocity)) / fabs(self.mismatch_rad), 1.0)
        if self.frozen_s >= self.longest_frozen_s and self.current != 0.0 and fabs(self.motor - self.frozen_from) > FROZEN:
            faults |= CURRENT_FROZEN
        return faults


# Encoders that are alive and quiet ---------------------------------------------------------------------------------------

cdef double NOISE_SIGMAS = 6.5  # of a second difference: once in hours
cdef double ROUNDING = 1e-6  # [Nm], of float64: no count is as small
cdef double COUNTS = 1.5  # of an encoder, by which its steps differ however smooth the motion
cdef double NOISE_S = 1.0  # in which the noise of a channel is learned
cdef double PER_NOISE = 6.0  # variance of a second difference by that of white noise
cdef double SURELY = 1.2  # times the file's variance: four standard errors of what is measured in NOISE_S
cdef double FASTER = 2.0  # rated torques that accelerate the rotor
cdef double TOLERANCE = 0.025  # of the rated torque
cdef double LOAD_HZ = 25.0  # rated torques per second of the fastest load
cdef double SETTLE_RATE = 1.0 / 0.03  # of the filters behind: doubt fades with it once its cause has gone
cdef double STRANGE_S = 0.5, UNKNOWN_RATE = 1.0 / 0.05
cdef double STRANGE = 20.0  # samples out of order, of the last STRANGE_S: the sum of their steps is no displacement
cdef double MOST = 100.0  # rated torques: no doubt is larger
cdef double UNSEEN = 2.5, LONGER = 4.0  # tolerances, samples: beyond what healthy inputs come to
cdef double RANGE_S = 0.1, LEAST_SLIPPED = 0.25  # [s]; tolerances: with one, a motor position held for 5 cycles is 3.1 Nm off
cdef double CALM = 0.1  # samples out of order, of the last STRANGE_S
cdef double FOLLOW_RATE = 50.0  # at which the torque follows the current
# logarithms of how rarely healthy noise gives so long a run of equal samples, of a joint's inputs and of its link encoder alone
cdef double RARE_EQUAL = 10.0, RARE_STILL = 14.0
cdef int KNOWN_RUNS = 64  # of equal samples at rest, that their mean is of at most


cdef int fill_inputs(InputLaw *law, joint, torsion, double noise) except -1:
    """Set the parameters; noise: variance of both readings that the file's sigma has [Nm^2]."""
    law.used = torsion is not None
    if not law.used:
        return 0
    law.link = torsion.stiffness_nm_per_rad
    law.motor = law.link / joint.gear_ratio
    law.current = joint.gear_ratio * joint.torque_constant_nm_per_a
    law.acceleration = law.link * FASTER * joint.rated_torque_nm / (joint.rotor_inertia_kgm2 * joint.gear_ratio**2)
    law.tolerance = TOLERANCE * joint.rated_torque_nm
    law.most = MOST * joint.rated_torque_nm
    law.noise = noise
    law.load_rate = LOAD_HZ * joint.rated_torque_nm
    return 0


cdef void restart_inputs(const InputLaw *law, InputState *s) noexcept nogil:
    memset(s, 0, sizeof(InputState))
    s.noise = PER_NOISE * law.noise


cdef void drop_inputs(InputState *s) noexcept nogil:
    """Forget readings that the observer has refused; what is usual stays known."""
    s.going = False
    s.motor.off = s.link.off = s.motor.noise = s.link.noise = s.doubt = s.strange = 0.0


cdef double _channel(
    Channel *c, double reading, double expected, double faster, double acceleration, double dt, bint calm, double *bend
) noexcept nogil:
    """Take a reading [Nm]; return what it may be off by [Nm].

    expected: its step by the drive's velocity, and faster: how much more that is than the last; calm: nothing was out of order
    lately, so that its noise is that of a healthy channel; bend: set to the second difference, NaN where that is not in order.
    """
    cdef double step = reading - c.last, by_rate = step - c.rate * dt, by_velocity = step - c.unseen - expected
    cdef double limit = max(acceleration * dt * dt, NOISE_SIGMAS * sqrt(c.noise)), change = fabs(step - c.step)
    if change > ROUNDING and (change < c.quantum or c.quantum == 0.0):
        c.quantum = change
    limit = max(limit, COUNTS * c.quantum)
    c.last = reading
    bend[0] = by_rate if fabs(by_rate) <= limit else NAN
    if step == 0.0:
        c.unseen += expected
        c.step, c.rate = 0.0, expected / dt
        return max(fabs(c.unseen) - COUNTS * c.quantum, fabs(c.off))
    if fabs(by_rate) <= limit or fabs(by_velocity) <= limit or change <= limit:
        if calm and c.step != 0.0 and fabs(by_rate) <= limit:
            c.noise += (by_rate * by_rate - c.noise) * min(dt / NOISE_S, 1.0)
        c.rate = (step if c.step != 0.0 else expected) / dt
    else:
        c.off += by_rate if fabs(by_rate) < fabs(by_velocity) else by_velocity
        c.rate += faster / dt
    c.step = step
    c.unseen = 0.0
    return fabs(c.off)


cdef double _range(Range *r, double x, double part) noexcept nogil:
    """Take a number; return the range of the last ones, which are forgotten by this part."""
    r.high = max(x, r.high + (x - r.high) * part)
    r.low = min(x, r.low + (x - r.low) * part)
    return r.high - r.low


cdef double _slipped(
    const InputLaw *law, Slip *s, double slip, double expected, double faster, double limit, double count, double dt, bint calm
) noexcept nogil:
    """Take what the motor's position moved beyond its velocity [Nm]; return by how much its range is beyond healthy ones [Nm].

    expected, faster, calm: as `_channel`; limit: of what one sample counts; count: of the motor's position.
    """
    cdef double part = min(dt / RANGE_S, 1.0), square = law.tolerance * law.tolerance, range, slipped = 0.0
    s.sum += max(-limit, min(slip - s.scale * expected - s.lag * faster, limit))
    range = _range(&s.range, s.sum, part)
    part *= s.lag * s.lag * _range(&s.velocity, expected, part)
    if s.changes > square:
        slipped = max(range - part - max(NOISE_SIGMAS * sqrt(s.usual), LEAST_SLIPPED * law.tolerance, count), 0.0)
        if calm and slipped == 0.0 and fabs(expected) > count:
            s.usual += (range * range - s.usual) * min(dt / NOISE_S, 1.0)
    if not calm or slipped > 0.0:
        return slipped
    s.by_change, s.changes = s.by_change + slip * faster, s.changes + faster * faster
    s.by_step, s.steps, s.both = s.by_step + slip * expected, s.steps + expected * expected, s.both + faster * expected
    part = s.changes * s.steps - s.both * s.both
    if part > 0.0:
        s.lag = (s.by_change * s.steps - s.by_step * s.both) / part
        s.scale = (s.by_step * s.changes - s.by_change * s.both) / part
    return 0.0


cdef double _too_long(Runs *r, bint equal, bint standing, double rare) noexcept nogil:
    """Take a sample that is equal to the last one or not; return by how many the run of equal ones is too long.

    It is where healthy noise gives a longer one with a probability of exp(-rare), by the mean of those at rest so far.
    """
    cdef double beyond = 0.0
    cdef int still = r.still + equal
    if still and standing and r.seen:
        beyond = still - r.seen * (r.usual + 0.5) * expm1(rare / r.seen)
    r.still = still if equal else 0
    if equal:
        return beyond
    if standing and beyond <= 0.0:
        r.seen = min(r.seen + 1, KNOWN_RUNS)
        r.usual += (still - r.usual) / r.seen
    return 0.0


cdef void check_inputs(const InputLaw *law, InputState *s, const Sample *x, bint standing) noexcept nogil:
    """Take a sample; set `doubt`, what the torsion may be off by [Nm], in the same cycle."""
    cdef double dt = x.dt_s, current = law.current * x.current_a, slipped = 0.0
    cdef double expected = law.motor * x.motor_velocity_rad_s * dt, faster = expected - s.velocity
    cdef double motor = law.motor * x.motor_position_rad, link = law.link * x.link_position_rad
    cdef double doubt, unseen, longer, off = s.motor.off + s.link.off, bend, other, step = motor - s.motor.last
    cdef bint equal, link_still = link == s.link.last, calm = in_order(s)
    if not s.going or not 0.0 < dt <= LONGEST_STEP_S or not isfinite(motor + link + expected + current):
        s.going = isfinite(motor + link + expected + current)
        s.motor.last, s.link.last, s.velocity, s.current = motor, link, expected, x.current_a
        s.motor.rate = s.link.rate = law.motor * x.motor_velocity_rad_s
        s.motor.step = s.link.step = NAN
        s.noise = PER_NOISE * law.noise
        s.slip.sum, s.slip.range.high, s.slip.range.low, s.dt = 0.0, 0.0, 0.0, dt
        s.still_nm = current
        s.link_runs.still = s.runs.still = 0
        s.motor.unseen = s.link.unseen = 0.0
        s.alive = s.runs.seen < KNOWN_RUNS
        return
    equal = link_still and motor == s.motor.last and x.current_a == s.current
    s.alive = s.alive or not equal
    equal = equal and expected == s.velocity
    if link_still and s.link.step != 0.0:
        s.still_nm = current
    doubt = _channel(&s.motor, motor, expected, faster, law.acceleration, dt, calm, &bend)
    if fabs(dt - s.dt) <= UNEVEN * dt:
        slipped = _slipped(
            law, &s.slip, step - expected, expected, faster, INFINITY if isnan(bend) else law.acceleration * dt * dt,
            COUNTS * s.motor.quantum, dt, calm
        )
    doubt = max(doubt, _channel(&s.link, link, expected, faster, law.acceleration, dt, calm, &other))
    if link_still:
        unseen = fabs(current - s.still_nm) * min((s.link_runs.still + 1) * dt * FOLLOW_RATE, 1.0)
        doubt = max(doubt, unseen - COUNTS * s.link.quantum)
    doubt = max(doubt - law.tolerance, slipped)
    # an encoder whose noise is below a count changes or stands still as its angle happens to lie
    standing = standing and s.link.noise > s.link.quantum * s.link.quantum
    longer = max(_too_long(&s.runs, equal, standing, RARE_EQUAL), _too_long(&s.link_runs, link_still, standing, RARE_STILL))
    doubt = max(doubt, law.load_rate * dt * longer)
    s.velocity, s.current, s.dt = expected, x.current_a, dt
    s.strange *= 1.0 - min(dt / STRANGE_S, 1.0)
    if (
        s.motor.off + s.link.off != off or longer > LONGER
        or fabs(s.motor.unseen) > UNSEEN * law.tolerance + COUNTS * s.motor.quantum
        or fabs(s.link.unseen) > UNSEEN * law.tolerance + COUNTS * s.link.quantum
    ):
        s.strange += 1.0
    if slipped > law.tolerance:
        s.strange = max(s.strange, 1.0)
    bend -= other
    if calm and not isnan(bend):
        s.noise += (bend * bend - s.noise) * min(dt / NOISE_S, 1.0)
    if s.strange > STRANGE:
        s.motor.off *= 1.0 - min(dt * UNKNOWN_RATE, 1.0)
        s.link.off *= 1.0 - min(dt * UNKNOWN_RATE, 1.0)
    s.doubt = min(max(doubt, s.doubt * (1.0 - min(dt * SETTLE_RATE, 1.0))), law.most)


cdef double louder_nm2(const InputLaw *law, const InputState *s) noexcept nogil:
    """Return the variance of both readings [Nm^2], by the second differences of the twist, beyond that of the file."""
    return max(s.noise / PER_NOISE - SURELY * law.noise, 0.0)


cdef bint in_order(const InputState *s) noexcept nogil:
    """Return whether nothing has been out of order lately: what is learned now is not learned from a fault."""
    return s.strange < CALM


cdef void bound_inputs(InputState *s, double most) noexcept nogil:
    """Bound displacements by what the current path of a joint in motion leaves possible [Nm]."""
    s.motor.off = max(-most, min(most, s.motor.off))
    s.link.off = max(-most, min(most, s.link.off))


# Contacts --------------------------------------------------------------------------------------------------------------

cdef double TREND_RAD_S = 50.0  # of z: slower changes are load
cdef double NOTCH_RAD_S = 10.0  # rate at which w adapts
cdef double RELEASE = 0.5  # of a push, that a step back must have (the link swings); of the threshold, in a contact's beginning
cdef double SINGLE = 0.8  # weight of one residual beside the mean of two: ratio of their largest values in hours without contact
cdef double LONGEST_S = 0.5  # what lasts longer is load
cdef int BLANK = 6  # samples after a contact: two in which the push may still be ending, and RESTART
cdef int RESTART = 4  # samples of which the new trend is the mean
cdef double SETTLE_S = 0.1  # after a start, without a result
# Two steps in a row that differ by more give no acceleration, and neither does the next: at 1 rad/s an error of 50 us of a stamp
# looks like 1 Nm on a link of 0.01 kg m2.
cdef double UNEVEN = 0.05
cdef int LONGEST_GAP = 50  # samples without inputs, after which the state restarts


# The link of a joint --------------------------------------------------------------------------------------------------

cdef int fill_link(LinkLaw *law, joint, torsion) except -1:
    law.used = torsion is not None
    law.inertia = joint.link_inertia_kgm2
    law.damping = torsion.damping_nms_per_rad if law.used else 0.0
    return 0


cdef void restart_link(LinkState *s) noexcept nogil:
    s.samples = 0
    s.torque = s.fast = s.q = s.step = s.dt = 0.0


cdef void update_link(
    const LinkLaw *law, LinkState *s, const FusedObserverLaw *observer, const FusedObserverState *observed,
    double torsion_nm, double dt, LinkLoad *out
) noexcept nogil:
    """Take a sample of the observer, dt [s] after the last; torsion_nm: tau_t."""
    cdef double fast, stiffness, step, torque
    out.rate_nm_s = out.load_nm = NAN
    if not law.used:
        return
    stiffness = local_stiffness(observer, observed.z.d)
    fast = observed.last.d - observed.z.d
    torque = torsion_nm + stiffness * fast
    step = (observed.link - s.q) / dt
    if observer.tracking > 0.0:
        out.rate_nm_s = stiffness * observed.d_rate
        if s.samples >= 1:
            torque += law.damping * (observed.d_moved - observed.d_rate)
    else:
        out.rate_nm_s = observer.torsion_rate * stiffness * fast
        if s.samples >= 1:
            torque += law.damping * (fast - s.fast) / dt
    if s.samples >= 1 and fabs(dt - s.dt) > UNEVEN * dt:
        s.samples = 1
    if s.samples >= 3:
        out.load_nm = s.torque - law.inertia * (step - s.step) / dt
    if s.samples < 3:
        s.samples += 1
    s.torque, s.fast, s.q, s.step, s.dt = torque, fast, observed.link, step, dt


# The detector ---------------------------------------------------------------------------------------------------------

cdef int fill_contact(ContactLaw *law, double threshold_nm, double period_s) except -1:
    """Set the parameters for samples period_s [s] apart. Raises ValueError for a threshold or period out of range."""
    if not threshold_nm > 0.0 or not 0.0 < period_s < 0.01:
        raise ValueError(f"found a threshold of {threshold_nm} Nm at {period_s} s, expected both > 0, and less than 10 ms")
    law.threshold, law.release = threshold_nm, RELEASE * threshold_nm
    law.trend, law.notch = TREND_RAD_S * period_s, 2.0 * NOTCH_RAD_S * period_s
    law.settle, law.longest = <int> (SETTLE_S / period_s + 0.5), <int> (LONGEST_S / period_s + 0.5)
    law.brief = <int> (1.0 / law.trend + 0.5)
    return 0


cdef void restart_contact(ContactState *s) noexcept nogil:
    s.samples = s.missed = s.active = s.blank = s.at = 0
    memset(s.wave, 0, sizeof(s.wave))
    s.last, s.residual_nm, s.code = 0.0, NAN, CONTACT_UNKNOWN


cdef void detect_contact(const ContactLaw *law, ContactState *s, double external_nm, double angle) noexcept nogil:
    """Take x [Nm] at a motor angle [rad], NaN where unknown; sets `residual_nm` and `code`."""
    cdef double c1, s1, c2, s2, x, e, m
    cdef int k
    if isnan(external_nm + angle):
        s.residual_nm, s.code, s.last = NAN, CONTACT_UNKNOWN, 0.0
        s.missed += 1
        if s.missed > LONGEST_GAP:
            restart_contact(s)
        return
    s.missed = 0
    c1, s1 = cos(angle), sin(angle)
    c2, s2 = c1 * c1 - s1 * s1, 2.0 * s1 * c1
    x = external_nm - (s.wave[0] * c1 + s.wave[1] * s1 + s.wave[2] * c2 + s.wave[3] * s2)
    if s.samples == 0:
        set_trend(s, x)
    if s.samples < law.settle:
        s.samples += 1
    if s.blank:
        s.residual_nm, s.code, s.last = NAN, CONTACT_UNKNOWN, 0.0
        if s.blank <= RESTART:
            set_trend(s, s.trend + (x - s.trend) / (RESTART - s.blank + 1))
        s.blank -= 1
        return
    e = x - s.trend
    m, s.last = 0.5 * (e + s.last), e
    if SINGLE * fabs(e) > fabs(m):
        m = SINGLE * e
    if s.samples == law.settle:
        s.residual_nm, s.code = m, CONTACT_NONE
    else:
        s.residual_nm, s.code = NAN, CONTACT_UNKNOWN
    if s.active:
        s.active += 1
        if s.active <= law.brief:
            s.peak = max(s.peak, fabs(m))
        if (
            (s.baseline - m) * s.sign > max(law.threshold, RELEASE * s.peak)
            or s.active > law.longest
            or (s.active <= law.brief and fabs(m) < law.release)
        ):
            s.residual_nm, s.code = NAN, CONTACT_UNKNOWN
            s.active, s.blank = 0, BLANK
            return
        s.code = CONTACT_PRESENT
        s.baseline += law.trend * (delayed(s, e) - s.baseline)
        return
    if s.code == CONTACT_NONE and fabs(m) > law.threshold:
        s.code, s.active, s.baseline = CONTACT_PRESENT, 1, e
        s.sign, s.peak = 1.0 if m > 0.0 else -1.0, fabs(m)
        for k in range(CONTACT_DELAY):
            s.delayed[k] = e
        return
    s.wave[0] += law.notch * e * c1
    s.wave[1] += law.notch * e * s1
    s.wave[2] += law.notch * e * c2
    s.wave[3] += law.notch * e * s2
    s.trend += law.trend * (delayed(s, x) - s.trend)


cdef void set_trend(ContactState *s, double x) noexcept nogil:
    """Set the trend, and the samples by which it is delayed, to x [Nm]."""
    cdef int k
    s.trend = x
    for k in range(CONTACT_DELAY):
        s.delayed[k] = x


cdef double delayed(ContactState *s, double x) noexcept nogil:
    """Return the x [Nm] of CONTACT_DELAY samples ago, and store this one."""
    cdef double oldest = s.delayed[s.at]
    s.delayed[s.at] = x
    s.at = (s.at + 1) % CONTACT_DELAY
    return oldest


def detect_contacts(external_nm, motor_position_rad, double threshold_nm, double period_s=0.001):
    """Return (residual [n] in Nm, NaN where unknown; code [n], see ContactCode) for x [n] in Nm and motor angles [n] in rad.

    Raises ValueError for a threshold or a period out of range, or arrays of different length.
    """
    cdef const double[::1] x = np.ascontiguousarray(external_nm, np.float64)
    cdef const double[::1] angle = np.ascontiguousarray(motor_position_rad, np.float64)
    residual, code = np.empty(len(x)), np.empty(len(x), np.uint8)
    cdef double[::1] m = residual
    cdef unsigned char[::1] c = code
    cdef ContactLaw law
    cdef ContactState state
    cdef Py_ssize_t k
    if angle.shape[0] != x.shape[0]:
        raise ValueError(f"found {angle.shape[0]} angles, expected {x.shape[0]}")
    fill_contact(&law, threshold_nm, period_s)
    restart_contact(&state)
    for k in range(x.shape[0]):
        detect_contact(&law, &state, x[k], angle[k])
        m[k], c[k] = state.residual_nm, state.code
    return residual, code
