"""Contacts of all joints of a cycle, after their estimates: detectors, fields of the record, bytes of the PDO.

The rules of one detector stand in `jtqd.estimator.contact`. Joints that turn one link against each other (`opposed`: 1 and 2, 3 and 4)
share a detector, in the frame of the first; alone, each has its own.
"""

from libc.math cimport NAN
from libc.stdint cimport uint8_t

from jtqd.daemon.core.contact_pdo cimport NO_JOINT, contact_field, encode_contact
from jtqd.daemon.core.record cimport JointBlock
from jtqd.daemon.shared import cycle_record as cr
from jtqd.estimator.contact cimport (
    CONTACT_OFF,
    CONTACT_PRESENT,
    CONTACT_UNKNOWN,
    fill_contact,
    restart_contact,
    detect_contact,
)

cdef int KNOWN = cr.FLAG_CONTACT_KNOWN, THERE = cr.FLAG_CONTACT


cdef class ContactWatch:
    """Detectors of a bus.

    Args:
        thresholds_nm: of each joint.
        opposed: joints 1 and 2, and 3 and 4, turn one link against each other; the smaller threshold of the two counts.
        sends: the contact PDOs are sent.
        period_s: of SYNC.

    Raises:
        ValueError: opposed joints that are not in twos; a threshold or period that is none.
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
        self.fields[n] = contact_field(record.torque_rate_nm_s, contact_nm, state)

    cdef void withdraw(self, JointState **joints) noexcept nogil:
        """Of a cycle whose answer came too late: nothing is known."""
        cdef int n
        for n in range(self.count):
            joints[n].sample.torque_rate_nm_s = NAN
            self.report(joints[n], n, NAN, CONTACT_UNKNOWN)

    cdef void encode(self, uint8_t *data, int pair, int sequence) noexcept nogil:
        """Write the four bytes of joints 2 pair + 1 and 2 pair + 2."""
        encode_contact(
            data, &self.fields[2 * pair], &self.fields[2 * pair + 1] if 2 * pair + 1 < self.count else &NO_JOINT, sequence
        )


def contacts_of(config):
    """Return the detectors of contacts as configured; None for none."""
    contact = config.contact
    if contact is None:
        return None
    thresholds = [contact.threshold_of(joint.joint.rated_torque_nm) for joint in config.joints]
    return ContactWatch(
        thresholds, opposed=contact.opposed, sends=contact.pdo, period_s=config.period_ns * 1e-9
    )
