"""Contact: a sudden torque from outside on the link, told by the link's momentum. Why so, figures, limits: docs/estimator.md.

Link side of one joint, own frame; neither current nor friction is in it. k: sample, T: step, q: link position:

    tau     = torsion, unfiltered: young + K (d - d_f) + D (d' - d_f')    d_f: d through the torsion's own filter g_t
    rate    = g_t K (d - d_f)                                             tau' through g_t/(s + g_t)
              K d_f'                                                      where the torsion is tracked, as is d_f
    p_k     = J (q_k - q_(k-1))/T                                         momentum of the link over a step
    load    = tau_(k-1) - (p_k - p_(k-1))/T                               what the joint hands on to what is beyond its link

A torque from outside on the link makes `load` less than what is beyond the link takes:

    x = -load                       joint alone: what is beyond is not known, and steady or slow
    x = load_other - load           two joints that turn one link against each other: the other one says what is beyond
    e = x - w - z                   w: waves of 1 and 2 per motor turn, z: trend; both learned from e, slower than a contact
    m = (e_k + e_(k-1))/2, or ALONE e_k where that is larger; told as the residual. Encoder noise is in second differences,
                                    and mostly cancels in the mean; what is large at once need not wait for it
    contact where |m| > threshold, until m steps back by as much and by RELEASE of the push, or |m| < RELEASE threshold
    within 1/TREND_RAD_S, or LONGEST_S have passed; then BLIND samples in which nothing is told, since z begins anew

While there is a contact, neither w nor z learns: m is the size of the push. The load under it goes on meanwhile, with the
error that it has by the torque, so that m alone does not say when the push ends; a second trend, of e from its beginning,
says what a step back is.
"""

from libc.math cimport NAN, cos, fabs, isnan, sin

from typing import Final

import numpy as np

from jtqd.estimator.observer cimport fill_fused_observer, fill_guard, observe_fused, restart_guard
from jtqd.estimator.observer cimport FusedObserved, GuardLaw, GuardState
from jtqd.estimator.sample cimport Sample
from jtqd.estimator.path_difference cimport local_stiffness

from jtqd.estimator.sample import columns
from jtqd.estimator.settings import tracking_of
from jtqd.estimator.status import CONTACT_CODES

OFF, UNKNOWN, NONE, CONTACT = CONTACT_CODES

TREND_RAD_S: Final = 50.0
"""Of z: loads that change slower are load."""
NOTCH_RAD_S: Final = 10.0
"""Rate at which w is learned."""
RELEASE: Final = 0.5
"""Part of a push that a step back must have, since the link swings; a contact that has just begun ends below this part of
the threshold."""
ALONE: Final = 0.8
"""What one residual counts beside the mean of two: the largest mean of quiet hours is this part of the largest residual."""
LONGEST_S: Final = 0.5
"""What lasts longer is load."""
BLIND: Final = 6
"""Samples after a contact: two in which a push may still be ending, and MEANT of which the new trend is the mean."""
MEANT: Final = 4
SETTLE_S: Final = 0.1
"""After a start nothing is told for so long."""
UNEVEN: Final = 0.05
"""Two steps in a row that differ by more have no acceleration between them, and neither has the one after: at 1 rad/s a stamp
that is 50 us off, of samples that are not, looks like 1 Nm on a link of 0.01 kg m2."""
LONGEST_GAP: Final = 50
"""Samples without inputs, after which the past is forgotten."""

cdef double RATE = TREND_RAD_S, LEARNED = NOTCH_RAD_S, BACK = RELEASE, ONE = ALONE, MOST_S = LONGEST_S, BELIEVED_S = SETTLE_S
cdef double UNEVEN_STEPS = UNEVEN
cdef int MOST_MISSED = LONGEST_GAP, NOT_TOLD = BLIND, MEAN_OF = MEANT


# The link of a joint --------------------------------------------------------------------------------------------------


cdef int fill_link(LinkLaw *law, joint, torsion) except -1:
    """Set the parameters from a joint file; torsion None: there is no load."""
    law.used = torsion is not None
    law.inertia = joint.link_inertia_kgm2
    law.damping = torsion.damping_nms_per_rad if law.used else 0.0
    return 0


cdef void restart_link(LinkState *s) noexcept nogil:
    """Forget the past."""
    s.samples = 0
    s.torque = s.behind = s.q = s.step = s.dt = 0.0


cdef void follow_link(
    const LinkLaw *law,
    LinkState *s,
    const FusedObserverLaw *observer,
    const FusedObserverState *now,
    double young_nm,
    double dt,
    LinkSeen *out,
) noexcept nogil:
    """Take a sample that the observer has taken, dt [s] after the one before; young_nm: torsion through g_t/(s + g_t)."""
    cdef double behind, stiffness, step, torque
    out.rate_nm_s = out.load_nm = NAN
    if not law.used:
        return
    stiffness = local_stiffness(observer, now.z.d)
    behind = now.last.d - now.z.d
    torque = young_nm + stiffness * behind
    step = (now.link - s.q) / dt
    if observer.tracking > 0.0:
        out.rate_nm_s = stiffness * now.d_rate
        if s.samples >= 1:
            torque += law.damping * (now.d_moved - now.d_rate)
    else:
        out.rate_nm_s = observer.torsion_rate * stiffness * behind
        if s.samples >= 1:
            torque += law.damping * (behind - s.behind) / dt
    if s.samples >= 1 and fabs(dt - s.dt) > UNEVEN_STEPS * dt:
        s.samples = 1
    if s.samples >= 3:
        out.load_nm = s.torque - law.inertia * (step - s.step) / dt
    if s.samples < 3:
        s.samples += 1
    s.torque, s.behind, s.q, s.step, s.dt = torque, behind, now.link, step, dt


# The detector ---------------------------------------------------------------------------------------------------------


cdef int fill_contact(ContactLaw *law, double threshold_nm, double period_s) except -1:
    """Set the parameters for samples period_s [s] apart. Raises ValueError for a threshold or period that is none."""
    if not threshold_nm > 0.0 or not 0.0 < period_s < 0.01:
        raise ValueError(f"found a threshold of {threshold_nm} Nm at {period_s} s, expected both > 0, and less than 10 ms")
    law.threshold, law.release = threshold_nm, BACK * threshold_nm
    law.trend, law.notch = RATE * period_s, 2.0 * LEARNED * period_s
    law.settle, law.longest = <int> (BELIEVED_S / period_s + 0.5), <int> (MOST_S / period_s + 0.5)
    law.brief = <int> (1.0 / law.trend + 0.5)
    return 0


cdef void restart_contact(ContactState *s) noexcept nogil:
    """Forget the past: unknown until it has settled."""
    cdef int k
    s.samples = s.missed = s.held = s.blind = s.at = 0
    for k in range(CONTACT_WAVES):
        s.wave[k] = 0.0
    s.before = 0.0
    s.residual_nm = NAN
    s.told = CONTACT_UNKNOWN


cdef void watch_contact(const ContactLaw *law, ContactState *s, double outside_nm, double angle) noexcept nogil:
    """Take x [Nm] at a motor angle [rad], NaN where it is not known; sets `residual_nm` and `told`."""
    cdef double c1, s1, c2, s2, x, e, m
    cdef int k
    if isnan(outside_nm + angle):
        s.residual_nm, s.told, s.before = NAN, CONTACT_UNKNOWN, 0.0
        s.missed += 1
        if s.missed > MOST_MISSED:
            restart_contact(s)
        return
    s.missed = 0
    c1, s1 = cos(angle), sin(angle)
    c2, s2 = c1 * c1 - s1 * s1, 2.0 * s1 * c1
    x = outside_nm - (s.wave[0] * c1 + s.wave[1] * s1 + s.wave[2] * c2 + s.wave[3] * s2)
    if s.samples == 0:
        set_trend(s, x)
    if s.samples < law.settle:
        s.samples += 1
    if s.blind:
        s.residual_nm, s.told, s.before = NAN, CONTACT_UNKNOWN, 0.0
        if s.blind <= MEAN_OF:
            set_trend(s, s.trend + (x - s.trend) / (MEAN_OF - s.blind + 1))
        s.blind -= 1
        return
    e = x - s.trend
    m, s.before = 0.5 * (e + s.before), e
    if ONE * fabs(e) > fabs(m):
        m = ONE * e
    if s.samples == law.settle:
        s.residual_nm, s.told = m, CONTACT_NONE
    else:
        s.residual_nm, s.told = NAN, CONTACT_UNKNOWN
    if s.held:
        s.held += 1
        if s.held <= law.brief:
            s.size = max(s.size, fabs(m))
        if (
            (s.under - m) * s.side > max(law.threshold, BACK * s.size)
            or s.held > law.longest
            or (s.held <= law.brief and fabs(m) < law.release)
        ):
            s.residual_nm, s.told = NAN, CONTACT_UNKNOWN
            s.held, s.blind = 0, NOT_TOLD
            return
        s.told = CONTACT_THERE
        s.under += law.trend * (later(s, e) - s.under)
        return
    if s.told == CONTACT_NONE and fabs(m) > law.threshold:
        s.told, s.held, s.under = CONTACT_THERE, 1, e
        s.side, s.size = 1.0 if m > 0.0 else -1.0, fabs(m)
        for k in range(CONTACT_LATER):
            s.later[k] = e
        return
    s.wave[0] += law.notch * e * c1
    s.wave[1] += law.notch * e * s1
    s.wave[2] += law.notch * e * c2
    s.wave[3] += law.notch * e * s2
    s.trend += law.trend * (later(s, x) - s.trend)


cdef void set_trend(ContactState *s, double x) noexcept nogil:
    """Let the trend be x [Nm], as it was for all samples that it is behind."""
    cdef int k
    s.trend = x
    for k in range(CONTACT_LATER):
        s.later[k] = x


cdef double later(ContactState *s, double x) noexcept nogil:
    """Return the x [Nm] of CONTACT_LATER samples before, and keep this one."""
    cdef double before = s.later[s.at]
    s.later[s.at] = x
    s.at = (s.at + 1) % CONTACT_LATER
    return before


cdef class ContactDetector:
    """Detector of contacts for one source of x.

    Raises ValueError for a threshold or a period that is none.

    Attributes:
        residual_nm: m of the last sample, NaN where unknown. told: OFF, UNKNOWN, NONE or CONTACT.
    """

    cdef ContactLaw law
    cdef ContactState state

    def __init__(self, double threshold_nm, double period_s=0.001):
        fill_contact(&self.law, threshold_nm, period_s)
        restart_contact(&self.state)

    @property
    def residual_nm(self):
        return self.state.residual_nm

    @property
    def told(self):
        return self.state.told

    def step(self, double outside_nm, double motor_position_rad):
        """Take x [Nm] at a motor angle [rad], NaN where it is not known; return what is told."""
        watch_contact(&self.law, &self.state, outside_nm, motor_position_rad)
        return self.state.told

    def run(self, outside_nm, motor_position_rad):
        """Return (residual [n] in Nm, told [n]) for arrays [n]: `step` for every sample."""
        cdef const double[::1] x = np.ascontiguousarray(outside_nm, np.float64)
        cdef const double[::1] angle = np.ascontiguousarray(motor_position_rad, np.float64)
        residual, told = np.empty(len(x)), np.empty(len(x), np.uint8)
        cdef double[::1] e = residual
        cdef unsigned char[::1] t = told
        cdef Py_ssize_t k
        if angle.shape[0] != x.shape[0]:
            raise ValueError(f"found {angle.shape[0]} angles, expected {x.shape[0]}")
        for k in range(x.shape[0]):
            watch_contact(&self.law, &self.state, x[k], angle[k])
            e[k], t[k] = self.state.residual_nm, self.state.told
        return residual, told


def link_loads(joint, settings, dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad):
    """Return (torque rate [n] in Nm/s, load [n] in Nm, of the sample before) of a run of one joint; arrays [n].

    Raises ValueError for a joint without torsion, or arrays of different length.
    """
    if joint.fused is None or joint.fused.torsion is None:
        raise ValueError(f"joint {joint.name}: found no section fused.torsion, expected one")
    inputs = columns(dt_s, current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad)
    cdef GuardLaw guard
    cdef GuardState guarded
    cdef FusedObserverLaw law
    cdef FusedObserverState state
    cdef FusedObserved seen
    cdef LinkLaw link
    cdef LinkState at
    cdef LinkSeen out
    cdef Sample sample
    cdef Py_ssize_t k
    fill_guard(&guard, joint, settings)
    fill_fused_observer(
        &law,
        joint,
        joint.fused.torsion,
        settings.bandwidth_rad_s,
        settings.link_bandwidth_rad_s,
        settings.own_torsion_bandwidth_rad_s,
        tracking_of(joint, settings),
    )
    fill_link(&link, joint, joint.fused.torsion)
    restart_guard(&guarded)
    restart_link(&at)
    rate, load = np.full(inputs.shape[1], NAN), np.full(inputs.shape[1], NAN)
    cdef const double[:, ::1] x = inputs
    cdef double[::1] r = rate
    cdef double[::1] l = load
    with nogil:
        for k in range(x.shape[1]):
            sample = Sample(x[0, k], x[1, k], x[2, k], x[3, k], x[4, k], NAN)
            if observe_fused(&guard, &guarded, &law, &state, &sample, &seen):
                follow_link(&link, &at, &law, &state, seen.torsion_nm + seen.ahead_nm, sample.dt_s, &out)
                r[k], l[k] = out.rate_nm_s, out.load_nm
            else:
                restart_link(&at)
    return rate, load
