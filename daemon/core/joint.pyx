"""One joint in the loop: counts of this cycle into SI units, estimate, status, its fields of PDO and record; contacts.

Quantities that a drive may not send:

    link position     one encoder. The estimator is given theta_m/G, a gear without torsion; the record has NaN. Methods that
                      live on the torsion are refused by the configuration.
    motor velocity    (theta_m(k) - theta_m(j))/(t_k - t_j), j the last cycle that had the motor position: the mean over that
                      time, half a period older than the position. The first cycle of all has none, and is without inputs.
"""

cimport cython
from cpython.object cimport PyObject
from libc.math cimport INFINITY, NAN, isnan
from libc.stdint cimport int64_t, uint8_t

from dataclasses import replace
from typing import Final

from jtqd.daemon.core.estimate_pdo cimport (
    NO_JOINT, ContactField, contact_field_of, encode_contact_into, field_of, has_torque,
)
from jtqd.daemon.core.input_pdos import DRIVE_FACTORS
from jtqd.daemon.core.intake cimport Input, Intake
from jtqd.daemon.core.record cimport MOST_JOINTS, MOST_METHODS, JointBlock, ShadowBlock, ShadowValues
from jtqd.daemon.core.status cimport JointRules
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator import status as st
from jtqd.estimator.detection cimport (
    CONTACT_PRESENT, CONTACT_UNKNOWN, ContactState, detect_contact, fill_contact, restart_contact,
)
from jtqd.estimator.estimator cimport Estimator, Values
from jtqd.estimator.observer cimport Sample, follow_reference, restart_reference
from jtqd.estimator.estimator import PythonEstimator
from jtqd.estimator.settings import bandwidth_of

STAMP_ACCURACY_NS: Final = 5_000
"""Kernel software stamps differ by a few us from the time on the wire."""

cdef int64_t HALF_RANGE = <int64_t> 1 << 31, FULL_RANGE = <int64_t> 1 << 32
cdef int64_t ACCURACY_NS = STAMP_ACCURACY_NS
cdef int POSITION = cr.FLAG_POSITION, MOTION = cr.FLAG_MOTION
cdef int SENSOR = cr.FLAG_SENSOR, TEMPERATURE = cr.FLAG_TEMPERATURE
cdef int STARTING = st.STARTING, STALE = st.STALE, STANDSTILL = st.STANDSTILL, INVALID = st.INVALID
cdef int VALID = st.VALID, DEGRADED = st.DEGRADED, OFF = st.OFF
cdef double UNKNOWN = NAN  # temperature of a joint whose drive sends none
cdef int NOT_A_REFERENCE = 0x07  # of 6150h: not valid, positive or negative overload


cdef int64_t _counts(Unwrap *unwrap, int64_t raw) noexcept nogil:
    """Return continuous counts of an INTEGER32 that rolls over; correct if two samples are less than 2^31 counts apart."""
    cdef int64_t step = raw - unwrap.last
    if not -HALF_RANGE <= step < HALF_RANGE:
        unwrap.offset += -FULL_RANGE if step > 0 else FULL_RANGE
    unwrap.last = raw
    return raw + unwrap.offset


@cython.final
cdef class JointCycle:
    """State of one joint from cycle to cycle, in the loop or in a replay of its log.

    Args:
        number: from 0 on.
        inputs: which PDOs are its inputs, and their scaling (`JointInputs`).
        estimator: one in Python is called through the interpreter.
        intake: decides which PDOs are fresh.
        snapshot: counts fallbacks and squared errors.
        period_ns: of the SYNC.
        safety: limits and checks; None for those that need no joint file.
        shadows: estimators of its shadow methods (`ShadowMethods`).

    Attributes:
        published: its fields of the estimate PDO (`estimate_pdo.field`); status: as published.
        sample: its block of the cycle record, a `JointRecord`.
    """

    def __init__(
        self, int number, inputs, estimator, *, Intake intake, snapshot, int64_t period_ns, safety=None, shadows=()
    ):
        cdef JointBlock nothing = JointBlock(
            NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN, 0, STARTING, 0, 0
        )
        joint = getattr(estimator, "joint", None)
        self.rules = JointRules(number, snapshot, safety or JointSafety(), estimator.with_network)
        self.now.held = &self.rules.status.now
        self.estimator, self.gear_ratio = estimator, 1.0 if joint is None else joint.gear_ratio
        self.core = estimator if isinstance(estimator, Estimator) else PythonEstimator(estimator)
        self.intake, self.period_ns = intake, period_ns
        self.find_inputs(inputs)
        self.set_scale(inputs)
        self.sensor = NULL if inputs.sensor is None else _input(intake, inputs.sensor, 2)
        self.celsius = &UNKNOWN if inputs.temperature is None else &intake.celsius[<int> inputs.temperature].celsius
        self.now.status = STARTING
        self.now.sample = nothing
        self.now.load_nm = NAN
        self.now.published = field_of(NAN, INFINITY, STARTING)
        self.now.shadow = NULL
        if shadows:
            self.shadows = ShadowMethods(number, shadows, snapshot)
            self.now.shadow = &self.shadows.now

    cdef int find_inputs(self, inputs) except -1:
        """Find the drive's PDOs and the numbers in them; the flags of a record count all PDOs of a kind as one."""
        cdef int position, motion
        positions, motions = inputs.positions, inputs.motion
        both = sorted(positions | motions)
        if not 0 < len(both) <= MOST_TPDOS:
            raise ValueError(f"found {len(both)} PDOs of a drive, expected 1 to {MOST_TPDOS}")
        for index in both:
            position, motion = POSITION if index in positions else 0, MOTION if index in motions else 0
            self.flags[self.input_count] = position | motion
            self.input[self.input_count] = _input(self.intake, index, 1)
            self.input_count += 1
        self.motor_count = _number_at(self.intake, inputs.places["motor_position"])
        self.motor_position = _input(self.intake, inputs.places["motor_position"].pdo, 1)
        self.link_count = self.motor_speed = NULL
        if "link_position" in inputs.places:
            self.link_count = _number_at(self.intake, inputs.places["link_position"])
        if "motor_velocity" in inputs.places:
            self.motor_speed = _number_at(self.intake, inputs.places["motor_velocity"])
        self.current_count = _number_at(self.intake, inputs.places["current"])
        self.statusword = _number_at(self.intake, inputs.places["statusword"])
        return 0

    @property
    def node_id(self):
        """Node-ID of its drive."""
        return self.input[0].node_id

    cdef int set_scale(self, inputs) except -1:
        """Take the scaling of the inputs."""
        self.scale = Scale(
            inputs.motor_rad_per_count, inputs.motor_rad_s_per_unit, inputs.link_rad_per_count, inputs.ampere_per_unit,
            inputs.sensor_nm_per_unit,
        )
        self.inputs = inputs
        return 0

    @property
    def status(self):
        return self.now.status

    @property
    def published(self):
        return self.now.published.torque, self.now.published.sigma, self.now.published.status

    @property
    def sample(self):
        return cr.JOINT.unpack((<const char *> &self.now.sample)[: sizeof(JointBlock)])

    def begin_again(self):
        """Restart after a restart of the drive: earlier positions and the observer's state are invalid."""
        self.motor = self.link = Unwrap(0, 0)
        self.now.last_ns = self.derived.last_ns = 0
        self.estimator.reset()
        self.rules.begin_again()
        for each in () if self.shadows is None else self.shadows.estimators:
            each.reset()

    def trust(self, bint trusted):
        """Let the status be better than degraded, or not: nobody has checked that these are the drive's inputs."""
        self.rules.at_most_degraded = not trusted

    def reset_latch(self):
        """Release the latched faults and restart with the present encoder positions; return whether there was one."""
        if not self.rules.status.reset_latch():
            return False
        self.begin_again()
        return True

    def resume(self, int64_t motor_offset, int64_t link_offset):
        """Continue a log in the middle of a run, with the roll-over of the positions so far [counts]."""
        self.motor, self.link = Unwrap(0, motor_offset), Unwrap(0, link_offset)

    def rescale(self, node_id, factors):
        """Set the scaling of a node that was absent at the start (`SnapshotReader.note_factors`); zeros: none."""
        inputs, pdos = self.inputs, self.intake.pdos
        if not any(factors):
            return
        if self.node_id == node_id:
            self.set_scale(replace(inputs, **dict(zip(DRIVE_FACTORS, factors, strict=True))))
        elif inputs.sensor is not None and pdos[inputs.sensor].node_id == node_id:
            first = min([n for n, pdo in enumerate(pdos) if pdo.node_id == node_id])
            self.set_scale(replace(inputs, sensor_nm_per_unit=factors[inputs.sensor - first]))

    cpdef void withdraw(self, int status) noexcept nogil:
        """Withdraw the estimate: it is neither sent nor logged as published. With status 4 it was too late."""
        if status == STALE:
            status = self.rules.status.late()
        self.now.published = field_of(NAN, INFINITY, status)
        self.now.status = self.now.sample.status = status
        self.now.sample.torque_nm = self.now.sample.sigma_nm = NAN

    cpdef void observe(self, int64_t sync_ns, bint starting, bint network_wanted) noexcept nogil:
        """Estimate from the inputs of the cycle whose SYNC went out at `sync_ns` (CLOCK_MONOTONIC).

        starting: a published status is 1 instead; not network_wanted: there is no time for it, the cycle is physics only.
        """
        cdef int flags = self.reference()
        self.now.sample.temperature_c = self.celsius[0]
        if not isnan(self.celsius[0]):
            flags |= TEMPERATURE
        cdef int n, missing = 0
        for n in range(self.input_count):
            if not self.input[n].fresh:
                missing |= self.flags[n]
        if self.motor_speed == NULL and self.motor_position.fresh and not self.derive(sync_ns):
            missing |= MOTION
        flags |= (POSITION | MOTION) & ~missing
        if not missing:
            self.estimate(sync_ns, starting, network_wanted, flags)
        else:
            self.miss(flags)

    cdef void estimate(self, int64_t sync_ns, bint starting, bint network_wanted, int flags) noexcept nogil:
        """All inputs of this cycle are there."""
        cdef Scale *scale = &self.scale
        cdef JointBlock *record = &self.now.sample
        cdef Sample sample
        cdef Values e = Values(NAN, NAN, NAN, NAN, NAN, NAN, NAN, INVALID)
        cdef int status, statusword = <int> self.statusword[0]
        sample.dt_s = self.since_last(sync_ns)
        sample.current_a = self.current_count[0] * scale.ampere
        if self.motor_speed != NULL:
            sample.motor_position_rad = _counts(&self.motor, self.motor_count[0]) * scale.motor_rad
            sample.motor_velocity_rad_s = self.motor_speed[0] * scale.motor_rad_s
        else:
            sample.motor_position_rad, sample.motor_velocity_rad_s = self.derived.last_rad, self.derived.rad_s
        if self.link_count != NULL:
            sample.link_position_rad = _counts(&self.link, self.link_count[0]) * scale.link_rad
        else:
            sample.link_position_rad = sample.motor_position_rad / self.gear_ratio
        sample.temperature_c = record.temperature_c
        self.core.advance(&sample, network_wanted, &e)
        record.reference_nm = self.rules.reference(sample.dt_s, record.sensor_torque_nm)
        status = self.rules.judge(&e, &sample, record.reference_nm, statusword, starting, network_wanted, &flags)
        self.now.published = field_of(e.torque_nm, e.sigma_nm, status)
        if not has_torque(status):
            e.torque_nm = e.sigma_nm = NAN
        elif status != STANDSTILL and not isnan(record.reference_nm):
            self.rules.error(e.torque_nm - record.reference_nm, e.torque_nm - record.sensor_torque_nm)
        record.current_a, record.motor_position_rad = sample.current_a, sample.motor_position_rad
        record.link_position_rad = sample.link_position_rad if self.link_count != NULL else NAN
        record.motor_velocity_rad_s = sample.motor_velocity_rad_s
        record.torque_nm, record.sigma_nm, record.tob_nm = e.torque_nm, e.sigma_nm, e.tob_nm
        record.physics_nm, record.network_nm = e.physics_nm, e.network_nm
        record.dt_s = sample.dt_s
        if status == INVALID:  # its inputs are not believed: no rate, and contacts are unknown
            e.torque_rate_nm_s = e.load_nm = NAN
        record.torque_rate_nm_s, self.now.load_nm = e.torque_rate_nm_s, e.load_nm
        record.statusword, record.input_flags = statusword, flags
        self.now.status = record.status = status

    cdef void miss(self, int flags) noexcept nogil:
        """Handle a missing input: the observer keeps its state (the next dt is longer), nothing is published."""
        cdef JointBlock *record = &self.now.sample
        cdef int status = self.rules.stale(&flags)
        self.now.published = field_of(NAN, INFINITY, status)
        record.current_a = record.motor_position_rad = record.motor_velocity_rad_s = record.link_position_rad = NAN
        record.torque_nm = record.sigma_nm = record.tob_nm = record.physics_nm = record.network_nm = NAN
        record.dt_s = record.reference_nm = record.torque_rate_nm_s = self.now.load_nm = NAN
        record.statusword, record.input_flags = 0, flags
        self.now.status = record.status = status

    cpdef void observe_shadows(self) noexcept nogil:
        """Estimate by the shadow methods, after the estimate of this cycle was sent, from the inputs in its record."""
        cdef const JointBlock *record = &self.now.sample
        cdef double angle = record.motor_position_rad, link = record.link_position_rad
        if self.link_count == NULL:
            link = angle / self.gear_ratio
        cdef Sample sample = Sample(record.dt_s, record.current_a, angle, record.motor_velocity_rad_s, link, record.temperature_c)
        self.shadows.advance(&sample, record)

    cdef int reference(self) noexcept nogil:
        """Record the sensor's torque and its 6150h in this cycle, NaN and 0 where there is none; return its flag."""
        cdef JointBlock *record = &self.now.sample
        record.sensor_torque_nm, record.sensor_status, record.age_ms = NAN, 0, self.rules.age_ms
        if self.sensor == NULL or not self.sensor.fresh:
            return 0
        record.sensor_status = self.sensor.values[1]
        if not record.sensor_status & NOT_A_REFERENCE:
            record.sensor_torque_nm = self.sensor.values[0] * self.scale.sensor_nm
        return SENSOR

    cdef double since_last(self, int64_t sync_ns) noexcept nogil:
        """Return the time step [s] from the last cycle with inputs, 0 at the first; this one's SYNC becomes the last."""
        cdef int64_t dt_ns = self.on_grid(sync_ns - self.now.last_ns) if self.now.last_ns else 0
        self.now.last_ns = sync_ns
        return dt_ns * 1e-9

    cdef int64_t on_grid(self, int64_t dt_ns) noexcept nogil:
        """Return a time step; SYNC keeps an absolute grid: a deviation below the stamps' accuracy is theirs, not time's."""
        return self.period_ns if -ACCURACY_NS < dt_ns - self.period_ns < ACCURACY_NS else dt_ns

    cdef bint derive(self, int64_t sync_ns) noexcept nogil:
        """Derive the motor's velocity from its position, which has come; return whether there is one."""
        cdef double position = _counts(&self.motor, self.motor_count[0]) * self.scale.motor_rad
        cdef int64_t dt_ns = self.on_grid(sync_ns - self.derived.last_ns)
        cdef bint known = self.derived.last_ns != 0 and dt_ns > 0
        if known:
            self.derived.rad_s = (position - self.derived.last_rad) / (dt_ns * 1e-9)
        self.derived.last_ns, self.derived.last_rad = sync_ns, position
        if self.derived.is_replayed:
            self.derived.rad_s = self.derived.replayed_rad_s
            return not isnan(self.derived.replayed_rad_s)
        return known


cdef Input *_input(Intake intake, int index, int count) except NULL:
    """Return the PDO of this index; raises ValueError when it does not hold at least `count` objects."""
    cdef Input *state = &intake.inputs[index]
    if state.field_count < count:
        raise ValueError(f"{intake.pdos[index].name}: found {state.field_count} objects, expected {count}")
    return state


cdef const int64_t *_number_at(Intake intake, place) except NULL:
    """Return where a number lies when its PDO has come (`drivers.drive.Place`); raises ValueError without such an entry."""
    cdef Input *state = _input(intake, place.pdo, place.entry + 1)
    return &state.values[<int> place.entry]


# Shadow methods --------------------------------------------------------------------------------------------------------


@cython.final
cdef class ShadowMethods:
    """Further methods of joint `number` (from 0 on): computed from the same inputs as its estimate, recorded, never sent.

    estimators: one for each method, none of them the joint's own; tally: `shadow_errors` of a `Snapshot`, or an array of that
    layout, for the squared errors. What an estimator raises is printed, and its values are NaN in that cycle.
    """

    def __init__(self, int number, estimators, tally):
        cdef ShadowMethod *method
        cdef int n
        self.estimators, self.count = tuple(estimators), len(estimators)
        self.errors = tally.shadow_errors[3 * MOST_METHODS * number :]
        if self.count > MOST_METHODS:
            raise ValueError(f"found {self.count} shadow methods, expected at most {MOST_METHODS}")
        for n in range(MOST_METHODS):
            self.now.methods[n], self.now.status[n] = ShadowValues(NAN, NAN, NAN, NAN), OFF
        for n in range(self.count):
            each, method = self.estimators[n], &self.methods[n]
            method.estimator = <PyObject *> (<Estimator?> each)
            method.place = cr.SHADOW_METHODS.index(each.settings.method)
            method.bandwidth = bandwidth_of(each.joint, each.settings, network=each.with_network)
            method.max_gap = each.settings.max_gap_s
            restart_reference(&method.seen)
            self.now.methods[method.place].age_ms = 1e3 / method.bandwidth

    cdef void advance(self, const Sample *sample, const JointBlock *record) noexcept nogil:
        """Estimate from one sample (of step NaN where an input is missing), with the sensor and status in the cycle's record."""
        cdef bint missing = isnan(sample.dt_s), moving = record.status == VALID or record.status == DEGRADED
        cdef ShadowMethod *method
        cdef ShadowValues *to
        cdef Values e
        cdef double *sums
        cdef double error, now
        cdef int n
        for n in range(self.count):
            method = &self.methods[n]
            to = &self.now.methods[method.place]
            e = Values(NAN, NAN, NAN, NAN, NAN, NAN, NAN, STALE if missing else INVALID)
            to.reference_nm = NAN
            if not missing:
                (<Estimator> method.estimator).advance(sample, True, &e)
                to.reference_nm = follow_reference(
                    &method.seen, method.bandwidth, method.max_gap, sample.dt_s, record.sensor_torque_nm
                )
            to.torque_nm, to.sigma_nm, self.now.status[method.place] = e.torque_nm, e.sigma_nm, e.status
            error, now = e.torque_nm - to.reference_nm, e.torque_nm - record.sensor_torque_nm
            if moving and error - error == 0.0:
                sums = &self.errors[3 * method.place]
                sums[0], sums[1], sums[2] = sums[0] + error * error, sums[1] + now * now, sums[2] + 1.0


# Contacts of all joints ------------------------------------------------------------------------------------------------
#
# The rules of one detector stand in `jtqd.estimator.detection`. Joints that turn one link against each other (`opposed`: 1 and
# 2, 3 and 4) share a detector, in the frame of the first; alone, each has its own.

cdef int KNOWN = cr.FLAG_CONTACT_KNOWN, THERE = cr.FLAG_CONTACT


cdef class ContactWatch:
    """Detectors of a bus.

    thresholds_nm: of each joint; opposed: the smaller threshold of the two counts; sends: the contact PDOs are sent; period_s: of
    SYNC. Raises ValueError for opposed joints that are not in twos, and a threshold or period that is none.
    """

    def __init__(self, thresholds_nm, *, bint opposed=False, bint sends=True, double period_s=0.001):
        cdef int n
        self.count, self.opposed, self.sends = len(thresholds_nm), opposed, sends
        if not 1 <= self.count <= MOST_JOINTS or (opposed and self.count % 2):
            raise ValueError(f"found {self.count} joints, expected 1 to {MOST_JOINTS}, and 2 or 4 that are opposed")
        for n in range(self.count):
            least = min(thresholds_nm[n : n + 2]) if opposed and n % 2 == 0 else thresholds_nm[n]
            fill_contact(&self.law[n], least, period_s)
        for n in range(MOST_JOINTS):
            restart_contact(&self.state[n])
            self.fields[n] = NO_JOINT

    cdef void watch(self, JointState **joints) noexcept nogil:
        """Take the loads of a cycle; sets the joints' fields of the record."""
        cdef int n = 0, before
        cdef ContactState *s
        self.begun = 0
        while n < self.count:
            s = &self.state[n]
            before = s.code
            if self.opposed:
                detect_contact(
                    &self.law[n], s, joints[n + 1].load_nm - joints[n].load_nm, joints[n].sample.motor_position_rad
                )
                self.report(joints[n + 1], n + 1, -s.residual_nm, s.code)
            else:
                detect_contact(&self.law[n], s, -joints[n].load_nm, joints[n].sample.motor_position_rad)
            self.report(joints[n], n, s.residual_nm, s.code)
            if s.code == CONTACT_PRESENT and before != CONTACT_PRESENT:  # a receiver stops on it, whatever was known before
                self.begun += 1
            n += 2 if self.opposed else 1

    cdef void report(self, JointState *joint, int n, double contact_nm, int state) noexcept nogil:
        """Write one joint's fields of the record and of the PDO."""
        cdef JointBlock *record = &joint.sample
        record.contact_nm = contact_nm
        record.input_flags &= ~(KNOWN | THERE)
        if state != CONTACT_UNKNOWN:
            record.input_flags |= KNOWN | THERE if state == CONTACT_PRESENT else KNOWN
        self.fields[n] = contact_field_of(record.torque_rate_nm_s, contact_nm, state)

    cdef void withdraw(self, JointState **joints) noexcept nogil:
        """Of a cycle whose answer came too late: nothing is known."""
        cdef int n
        for n in range(self.count):
            joints[n].sample.torque_rate_nm_s = NAN
            self.report(joints[n], n, NAN, CONTACT_UNKNOWN)

    cdef void encode(self, uint8_t *data, int pair, int sequence) noexcept nogil:
        """Write the four bytes of joints 2 pair + 1 and 2 pair + 2."""
        cdef const ContactField *second = &self.fields[2 * pair + 1] if 2 * pair + 1 < self.count else &NO_JOINT
        encode_contact_into(data, &self.fields[2 * pair], second, sequence)


def contacts_of(config):
    """Return the detectors of contacts as configured; None for none."""
    contact = config.contact
    if contact is None:
        return None
    thresholds = [contact.threshold_of(joint.joint.rated_torque_nm) for joint in config.joints]
    return ContactWatch(thresholds, opposed=contact.opposed, sends=contact.pdo, period_s=config.period_ns * 1e-9)
